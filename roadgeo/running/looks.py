"""Several looks at one scene: a soft map at several thresholds, a photograph at several scales.

Each look is a mask of its own and is located by `workflows.locate`. All share the limits of one search. Who looks k
times finds a chance resemblance k times as often, so log10(k) is taken off the odds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar, overload

import numpy as np

from roadgeo.errors import MaskError
from roadgeo.geometry.mask import RoadMask
from roadgeo.location import Location, Place, Reason
from roadgeo.matching.explanation import Explanation
from roadgeo.matching.options import LocateOptions
from roadgeo.reference.reference import AnyReference
from roadgeo.sources.segmentation.probability import ProbabilityMap

__all__ = ["Later", "Locate", "Look", "Sighting", "locate_looks"]

#: Share of the work left that a look may take; the last one may take all.
_SHARE = 0.6

Locate = Callable[[RoadMask, Sequence[AnyReference], LocateOptions], "Location | Explanation"]


T = TypeVar("T")


class Later(Sequence[T]):
    """A sequence of known length whose elements are made when they are asked for: most looks are never taken."""

    def __init__(self, makers: Sequence[Callable[[], T]]) -> None:
        self._makers = makers

    def __len__(self) -> int:
        return len(self._makers)

    @overload
    def __getitem__(self, index: int) -> T: ...

    @overload
    def __getitem__(self, index: slice) -> Later[T]: ...

    def __getitem__(self, index: int | slice) -> T | Later[T]:
        """Make an element, or leave the others out."""
        return Later(self._makers[index]) if isinstance(index, slice) else self._makers[index]()


@dataclass(frozen=True)
class Look:
    """A mask to locate, made when it is needed.

    Attributes
    ----------
    what : str
        Its name among the others, for people: "threshold 63".
    make : callable
        Returns the mask; may raise MaskError.
    probability : callable, optional
        Returns what a segmenter saw, where the mask is made of that.
    """

    what: str
    make: Callable[[], RoadMask]
    probability: Callable[[], ProbabilityMap] | None = None


@dataclass(frozen=True)
class Sighting:
    """The answer of the best look, and the mask that it rests on."""

    location: Location
    mask: RoadMask
    explanation: Explanation | None = None
    probability: ProbabilityMap | None = None
    of_photograph: bool = False


def locate_looks(
    looks: Sequence[Look], references: Sequence[AnyReference], options: LocateOptions, how: Locate
) -> Sighting:
    """Take one look after another until one is located, within the limits of one search.

    Raises
    ------
    MaskError
        No look shows roads that can be traced; the first one's reason.
    """
    sightings: list[Sighting] = []
    failure: MaskError | None = None
    work_left, time_left = options.search.work_limit_s, options.search.time_limit_s
    for tried, look in enumerate(looks, 1):
        if tried > 1 and (work_left <= 0.05 * options.search.work_limit_s or time_left <= 0.0):
            break
        share = 1.0 if tried == len(looks) else _SHARE
        try:
            sighting = _take(look, references, _limited(options, share * work_left, time_left), how)
        except MaskError as error:
            failure = failure or error
            continue
        seconds = sighting.location.seconds
        work_left -= sighting.location.stats.work_ms / 1000
        time_left -= seconds.vectorize + seconds.match + seconds.refine
        sightings.append(_discount(sighting, look, tried, options))
        if sightings[-1].location.located:
            break
    if not sightings:
        raise failure or MaskError("nothing to look at; give a mask or a photograph")
    return _best_of(sightings, options)


def _limited(options: LocateOptions, work_limit_s: float, time_limit_s: float) -> LocateOptions:
    limits = replace(options.search, work_limit_s=work_limit_s, time_limit_s=max(time_limit_s, 0.0))
    return replace(options, search=limits)


def _take(look: Look, references: Sequence[AnyReference], options: LocateOptions, how: Locate) -> Sighting:
    mask = look.make()
    found = how(mask, references, options)
    probability = look.probability() if look.probability else None
    if isinstance(found, Explanation):
        return Sighting(found.location, mask, found, probability)
    return Sighting(found, mask, probability=probability)


def _discount(sighting: Sighting, look: Look, tried: int, options: LocateOptions) -> Sighting:
    """Take log10 of the number of looks off the odds; a place that is then too unlikely is not located."""
    location, off = sighting.location, math.log10(tried)
    if tried == 1 or location.log10_odds is None:
        return sighting
    odds = location.log10_odds - off
    if odds < options.min_log10_odds:
        few = f"seen in {tried} ways one place stands out, at {look.what}, but not clearly enough for so many tries"
        return replace(sighting, location=_refused(location, few))
    reason = f"{location.reason}; seen in another way ({look.what}) than at first"
    center = None if location.center is None else replace(location.center, log10_odds=odds)
    others = tuple(_less_sure(one, off) for one in location.alternatives)
    runner_up = location.runner_up and _less_sure(location.runner_up, off)
    location = replace(
        location, reason=reason, log10_odds=odds, center=center, runner_up=runner_up, alternatives=others
    )
    return replace(sighting, location=location)


def _less_sure(place: Place, off: float) -> Place:
    return replace(place, log10_odds=place.log10_odds - off)


def _refused(location: Location, reason: str) -> Location:
    """Return a location of which nothing is left but what was seen."""
    bare = Location(
        location.query,
        "not_located",
        reason,
        location.reference,
        location.attribution,
        reason_code=Reason.TOO_MANY_LOOKS,
        alternatives=tuple(filter(None, (location.center, *location.alternatives))),
    )
    kept = ("size", "n_intersections", "seconds", "stats", "stopped", "seen")
    seen = {name: getattr(location, name) for name in kept}
    return replace(bare, **seen)


def _best_of(sightings: Sequence[Sighting], options: LocateOptions) -> Sighting:
    """Return the best answer, the first of equals; a rival elsewhere that is almost as sure makes it ambiguous."""
    rank = {"located": 2, "ambiguous": 1, "not_located": 0}
    best = max(sightings, key=lambda one: (rank[one.location.status], one.location.log10_odds or -math.inf))
    locations = [one.location for one in sightings]
    seconds = replace(
        best.location.seconds,
        vectorize=sum(one.seconds.vectorize for one in locations),
        match=sum(one.seconds.match for one in locations),
        refine=sum(one.seconds.refine for one in locations),
    )
    location = replace(best.location, seconds=seconds)
    if len(sightings) > 1 and location.status == "not_located":
        location = replace(location, reason=f"{location.reason} (seen in {len(sightings)} ways)")
    rivals = [one for one in locations if one is not best.location and _elsewhere(one, location)]
    rival = max(rivals, key=lambda one: one.log10_odds or -math.inf, default=None)
    if location.located and rival is not None:
        lead = (location.log10_odds or 0.0) - (rival.log10_odds or 0.0)
        if lead < options.min_margin:
            reason = "seen in two ways it fits at two places, almost equally"
            others = () if rival.center is None else (rival.center, *location.alternatives)
            location = replace(
                location,
                status="ambiguous",
                reason=reason,
                reason_code=Reason.TWO_LOOKS,
                runner_up=rival.center,
                alternatives=others,
            )
    return replace(best, location=location)


def _elsewhere(one: Location, best: Location) -> bool:
    """Whether a location, sure or ambiguous, lies more than half a frame from another."""
    if one.center is None or best.center is None or best.footprint is None:
        return False
    east = math.radians(one.center.lon - best.center.lon) * math.cos(math.radians(best.center.lat))
    north = math.radians(one.center.lat - best.center.lat)
    side = float(np.hypot(*(best.footprint[1] - best.footprint[0])))
    return 6.371e6 * math.hypot(east, north) > 0.5 * side
