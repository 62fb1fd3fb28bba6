"""Several passes over one scene: a soft map at several thresholds, a photograph at several scales.

Each pass is a mask of its own and is located by `workflows.locate`. All share the limits of one search. A search of k
passes finds a chance resemblance k times as often, so log10(k) is taken off the odds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from roadgeo.errors import MaskError
from roadgeo.geometry.mask import RoadMask
from roadgeo.geometry.placement import Placement
from roadgeo.geometry.projection import metres_apart
from roadgeo.location import Content, Location, Reason
from roadgeo.matching.explanation import Explanation
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.verdict import how_clear
from roadgeo.reference.opening import AnyReference
from roadgeo.sources.segmentation.probability import ProbabilityMap

__all__ = ["Locate", "PassRoads", "Sighting", "locate_passes", "total_seconds"]

#: Share of the work left that a pass may take; the last one may take all.
_SHARE = 0.6
#: Score by which a place must lead one that another pass found elsewhere.
_LEAST_LEAD = 2.0

Locate = Callable[[RoadMask, Sequence[AnyReference], LocateOptions], "Location | Explanation"]


T = TypeVar("T")


@dataclass(frozen=True)
class PassRoads:
    """The roads that one pass shows.

    Attributes
    ----------
    what : str
        The pass's name among the others, for people: "threshold 63".
    probability : ProbabilityMap, optional
        What a segmenter saw, where the mask is made of that.
    """

    what: str
    mask: RoadMask
    probability: ProbabilityMap | None = None


@dataclass(frozen=True)
class Sighting:
    """The answer of the best pass, and the mask that it rests on."""

    location: Location
    mask: RoadMask
    explanation: Explanation | None = None
    probability: ProbabilityMap | None = None

    @property
    def of_photograph(self) -> bool:
        """Whether the image is a photograph."""
        return self.location.content is not None and self.location.content.kind == "photograph"

    def answering(self, location: Location) -> Sighting:
        """Return it with another answer."""
        return replace(self, location=location)

    def showing(self, **content: Any) -> Sighting:
        """Return it with more of the image's content (see `location.Content`)."""
        shown = self.location.content or Content(self.mask.shape[::-1])
        return self.answering(replace(self.location, content=replace(shown, **content)))


def locate_passes(
    passes: Sequence[T],
    show: Callable[[T], PassRoads],
    references: Sequence[AnyReference],
    options: LocateOptions,
    how: Locate,
) -> Sighting:
    """Take one pass after another until one settles the search, within the limits of one search.

    Parameters
    ----------
    passes : sequence
        What distinguishes them, such as thresholds, the most promising first.
    show : callable
        Takes one of them; may raise MaskError.

    Raises
    ------
    MaskError
        No pass shows roads that can be traced; the first one's reason.
    """
    sightings: list[Sighting] = []
    failure: MaskError | None = None
    work_left, time_left = options.search.work_limit_s, options.search.time_limit_s
    for tried, which in enumerate(passes, 1):
        if tried > 1 and (work_left <= 0.05 * options.search.work_limit_s or time_left <= 0.0):
            break
        share = 1.0 if tried == len(passes) else _SHARE
        try:
            roads = show(which)
            answer = how(roads.mask, references, _limited(options, share * work_left, time_left))
        except MaskError as error:
            failure = failure or error
            continue
        explanation, location = (answer, answer.location) if isinstance(answer, Explanation) else (None, answer)
        seconds = location.seconds
        work_left -= location.spent.stats.work_ms / 1000
        time_left -= seconds.vectorize + seconds.match + seconds.refine
        location = _discount(location, roads.what, tried, options)
        sightings.append(Sighting(location, roads.mask, explanation, roads.probability))
        if _is_settled(sightings[-1].location, options):
            break
    if not sightings:
        raise failure or MaskError("nothing to look at; give a mask or a photograph")
    return _best_of(sightings)


def _is_settled(location: Location, options: LocateOptions) -> bool:
    """Whether no other pass is needed: a place is located, or the map has none where the hints put it.

    It has none where it has no intersections there, or where the roads fit far better elsewhere.
    """
    if location.reason_code is Reason.FITS_ELSEWHERE:
        return location.places[0].score >= 2.0 * options.min_log10_odds
    return location.located or location.reason_code is Reason.FEW_NEAR


def _limited(options: LocateOptions, work_limit_s: float, time_limit_s: float) -> LocateOptions:
    limits = replace(options.search, work_limit_s=work_limit_s, time_limit_s=max(time_limit_s, 0.0))
    return replace(options, search=limits)


def _discount(location: Location, what: str, tried: int, options: LocateOptions) -> Location:
    """Take log10 of the number of passes off the scores; what was located and then scores too little is refused."""
    if tried == 1 or location.log10_odds is None:
        return location
    needed, said = options.min_log10_odds, location.places[0].score
    places = tuple(_less_sure(place, math.log10(tried)) for place in location.places)
    location = replace(location, places=places)
    if location.place is None:
        left = how_clear(places[0].score, needed)
        return replace(location, reason=location.reason.replace(how_clear(said, needed), left))
    if places[0].score >= needed or not location.located:
        return location.saying(f"{_in_ways(tried)}, here at {what}")
    few = f"one place stands out, at {what}, but not clearly enough"
    return replace(location, status="not_located", reason=few, reason_code=Reason.TOO_MANY_LOOKS)


def _in_ways(tried: int) -> str:
    """Count the passes, as every reason does."""
    return f"its roads were traced in {tried} ways"


def _less_sure(place: Placement, off: float) -> Placement:
    rival = place.rival and _less_sure(place.rival, off)
    return replace(place, score=place.score - off, rival=rival)


def _best_of(sightings: Sequence[Sighting]) -> Sighting:
    """Return the best answer, the first of equals; a rival elsewhere that is almost as sure makes it ambiguous."""
    rank = {"located": 2, "ambiguous": 1, "not_located": 0}
    best = max(
        sightings,
        key=lambda sighting: (
            rank[sighting.location.status],
            sighting.location.reason_code in (Reason.FITS_ELSEWHERE, Reason.MIRRORED),
            sighting.location.log10_odds or -math.inf,
        ),
    )
    locations = [sighting.location for sighting in sightings]
    location = best.location.spending(**total_seconds(locations))
    if len(sightings) > 1 and location.status == "not_located":
        location = location.saying(_in_ways(len(sightings)))
    rivals = [other for other in locations if other is not best.location and _elsewhere(other, location)]
    rival = max((other.places[0] for other in rivals), key=lambda place: place.score, default=None)
    if location.located and rival is not None and location.places[0].score - rival.score < _LEAST_LEAD:
        first, *others = location.places
        location = replace(
            location,
            status="ambiguous",
            reason=f"two places fit almost equally; {_in_ways(len(sightings))}",
            reason_code=Reason.TWO_LOOKS,
            places=(replace(first, rival=rival), rival, *others),
        )
    return replace(best, location=location)


def total_seconds(locations: Sequence[Location]) -> dict[str, float]:
    """Return the time of several searches of one query, by step."""
    steps = ("vectorize", "match", "refine")
    return {step: sum(getattr(location.seconds, step) for location in locations) for step in steps}


def _elsewhere(other: Location, best: Location) -> bool:
    """Whether a location, sure or ambiguous, lies more than half a frame from another."""
    if other.place is None or best.place is None:
        return False
    apart_m = metres_apart(*(np.array(place.center[2:]) for place in (other.place, best.place)))
    return bool(apart_m > 0.5 * np.hypot(*(best.place.footprint[1] - best.place.footprint[0])))
