"""Several looks at one scene: a soft map at several thresholds, a photograph at several scales.

Each look is a mask of its own and is located by `workflows.locate`. All share the limits of one search. Who looks k
times finds a chance resemblance k times as often, so log10(k) is taken off the odds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from roadgeo.errors import MaskError
from roadgeo.geometry.mask import RoadMask
from roadgeo.geometry.projection import metres_apart
from roadgeo.location import Location, Place, Reason, Seconds
from roadgeo.matching.explanation import Explanation
from roadgeo.matching.options import LocateOptions
from roadgeo.reference.reference import AnyReference
from roadgeo.sources.segmentation.probability import ProbabilityMap

__all__ = ["Locate", "Seen", "Sighting", "locate_looks", "total_seconds"]

#: Share of the work left that a look may take; the last one may take all.
_SHARE = 0.6

Locate = Callable[[RoadMask, Sequence[AnyReference], LocateOptions], "Location | Explanation"]


T = TypeVar("T")


@dataclass(frozen=True)
class Seen:
    """The roads that one look shows.

    Attributes
    ----------
    what : str
        The look's name among the others, for people: "threshold 63".
    probability : ProbabilityMap, optional
        What a segmenter saw, where the mask is made of that.
    """

    what: str
    mask: RoadMask
    probability: ProbabilityMap | None = None


@dataclass(frozen=True)
class Sighting:
    """The answer of the best look, and the mask that it rests on."""

    location: Location
    mask: RoadMask
    explanation: Explanation | None = None
    probability: ProbabilityMap | None = None
    of_photograph: bool = False


def locate_looks(
    looks: Sequence[T],
    look: Callable[[T], Seen],
    references: Sequence[AnyReference],
    options: LocateOptions,
    how: Locate,
) -> Sighting:
    """Take one look after another until a mask is located, within the limits of one search.

    Parameters
    ----------
    looks : sequence
        What distinguishes them, such as thresholds, the most promising first.
    look : callable
        Takes one of them; may raise MaskError.

    Raises
    ------
    MaskError
        No look shows roads that can be traced; the first one's reason.
    """
    sightings: list[Sighting] = []
    failure: MaskError | None = None
    work_left, time_left = options.search.work_limit_s, options.search.time_limit_s
    for tried, which in enumerate(looks, 1):
        if tried > 1 and (work_left <= 0.05 * options.search.work_limit_s or time_left <= 0.0):
            break
        share = 1.0 if tried == len(looks) else _SHARE
        try:
            seen = look(which)
            found = how(seen.mask, references, _limited(options, share * work_left, time_left))
        except MaskError as error:
            failure = failure or error
            continue
        explanation, location = (found, found.location) if isinstance(found, Explanation) else (None, found)
        seconds = location.seconds
        work_left -= location.stats.work_ms / 1000
        time_left -= seconds.vectorize + seconds.match + seconds.refine
        location = _discount(location, seen.what, tried, options)
        sightings.append(Sighting(location, seen.mask, explanation, seen.probability))
        if sightings[-1].location.located:
            break
    if not sightings:
        raise failure or MaskError("nothing to look at; give a mask or a photograph")
    return _best_of(sightings, options)


def _limited(options: LocateOptions, work_limit_s: float, time_limit_s: float) -> LocateOptions:
    limits = replace(options.search, work_limit_s=work_limit_s, time_limit_s=max(time_limit_s, 0.0))
    return replace(options, search=limits)


def _discount(location: Location, what: str, tried: int, options: LocateOptions) -> Location:
    """Take log10 of the number of looks off the odds; a place that is then too unlikely is not located."""
    off = math.log10(tried)
    if tried == 1 or location.log10_odds is None:
        return location
    odds = location.log10_odds - off
    if odds < options.min_log10_odds:
        few = f"one place stands out, at {what}, but not clearly enough; {_in_ways(tried)}"
        return _refused(location, few)
    reason = f"{location.reason}; {_in_ways(tried)}, here at {what}"
    center = None if location.center is None else replace(location.center, log10_odds=odds)
    others = tuple(_less_sure(place, off) for place in location.alternatives)
    runner_up = location.runner_up and _less_sure(location.runner_up, off)
    return replace(location, reason=reason, log10_odds=odds, center=center, runner_up=runner_up, alternatives=others)


def _in_ways(tried: int) -> str:
    """Count the looks, as every reason does."""
    return f"its roads were traced in {tried} ways"


def _less_sure(place: Place, off: float) -> Place:
    return replace(place, log10_odds=place.log10_odds - off)


def _refused(location: Location, reason: str) -> Location:
    """Return a location of which nothing is left but what was seen."""
    names = ("query", "reference", "attribution", "size", "n_intersections", "seconds", "stats", "stopped", "seen")
    kept: dict[str, Any] = {name: getattr(location, name) for name in names}
    code = Reason.TOO_MANY_LOOKS
    return Location(status="not_located", reason=reason, reason_code=code, alternatives=location.places, **kept)


def _best_of(sightings: Sequence[Sighting], options: LocateOptions) -> Sighting:
    """Return the best answer, the first of equals; a rival elsewhere that is almost as sure makes it ambiguous."""
    rank = {"located": 2, "ambiguous": 1, "not_located": 0}
    best = max(
        sightings,
        key=lambda sighting: (
            rank[sighting.location.status],
            sighting.location.reason_code is Reason.FITS_ELSEWHERE,
            sighting.location.log10_odds or -math.inf,
        ),
    )
    locations = [sighting.location for sighting in sightings]
    location = replace(best.location, seconds=total_seconds(*(sighting.location.seconds for sighting in sightings)))
    if len(sightings) > 1 and location.status == "not_located":
        location = replace(location, reason=f"{location.reason}; {_in_ways(len(sightings))}")
    rivals = [found for found in locations if found is not best.location and _elsewhere(found, location)]
    rival = max(rivals, key=lambda found: found.log10_odds or -math.inf, default=None)
    if location.located and rival is not None:
        lead = (location.log10_odds or 0.0) - (rival.log10_odds or 0.0)
        if lead < options.min_margin:
            reason = f"two places fit almost equally; {_in_ways(len(sightings))}"
            others = (*rival.places[:1], *location.alternatives)
            location = replace(
                location,
                status="ambiguous",
                reason=reason,
                reason_code=Reason.TWO_LOOKS,
                runner_up=rival.center,
                alternatives=others,
            )
    return replace(best, location=location)


def total_seconds(*spent: Seconds) -> Seconds:
    """Return the time of several searches of one query."""
    steps = ("vectorize", "match", "refine")
    return replace(spent[0], **{step: sum(getattr(seconds, step) for seconds in spent) for step in steps})


def _elsewhere(other: Location, best: Location) -> bool:
    """Whether a location, sure or ambiguous, lies more than half a frame from another."""
    if other.center is None or best.center is None or best.footprint is None:
        return False
    apart_m = metres_apart(*(np.array([place.lon, place.lat]) for place in (other.center, best.center)))
    return bool(apart_m > 0.5 * np.hypot(*(best.footprint[1] - best.footprint[0])))
