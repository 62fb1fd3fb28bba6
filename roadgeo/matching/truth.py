"""The fate of the true place, where it is given: the stage of a search that lost it."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from roadgeo._arrays import BoolArray, FloatArray
from roadgeo.geometry.camera import CameraFault
from roadgeo.geometry.projection import from_lonlat
from roadgeo.location import Location
from roadgeo.matching.estimator import TripleEstimator
from roadgeo.matching.methods import Searched
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.place import Place
from roadgeo.matching.scene import LARGE_PIXEL_M

__all__ = ["TruthStory", "finite_or_none", "tell_truth", "true_place"]

#: Distance of a rough proposal's middle from the truth, in halves of the frame's diagonal, and at least in metres.
_ROUGHLY, _AT_LEAST_M = 0.25, 50.0

#: The stage that lost the true place, and how, by the last one that met it.
_LOST = {
    "camera": ("camera", "grew, but the camera's limits refused it"),
    "verified": ("verified", "grew, but could not be refined to the map's roads"),
    "survived": ("verified", "grew, but was not among the best of its intersection"),
    "on_roads": ("survived", "was proposed, but what was followed outwards from there did not fit"),
    "proposals": ("on_roads", "was proposed, but the roads around the intersection did not agree"),
    "": ("proposals", "was never proposed: no intersection and its neighbours are intact enough"),
}
_MET = ("proposals", "on_roads", "survived", "camera", "verified")


@dataclass(frozen=True)
class TruthStory:
    """The fate of the true place on one reference.

    Attributes
    ----------
    lost_at : str or None
        The stage that lost it: "map", "proposals", "on_roads", "survived", "camera", "verified", "odds" or "rival";
        None if the mask was located there. `said` is the same in a sentence.
    counts : dict
        The number of times the place was met at "proposals", "on_roads", "survived", "camera" (refused) and "verified".
    log10_odds : float or None
        Its best score.
    """

    lon: float
    lat: float
    lost_at: str | None
    said: str
    counts: dict[str, int]
    log10_odds: float | None


def finite_or_none(value: float) -> float | None:
    """Return a number as JSON may hold it."""
    return value if math.isfinite(value) else None


def true_place(mask: str, options: LocateOptions) -> tuple[float, float] | None:
    """Return longitude and latitude of a mask's true place if it is given."""
    for name, lon, lat in options.truths:
        if not name or Path(mask).as_posix().endswith(name):
            return lon, lat
    return None


def tell_truth(
    lonlat: tuple[float, float], searched: Searched, location: Location, options: LocateOptions
) -> TruthStory:
    """Describe the stage that lost the true place; `location` is the answer on this reference."""
    if searched.estimator is None:
        return TruthStory(*lonlat, "map", "the true place: nothing was searched", dict.fromkeys(_MET, 0), None)
    there = _TruePlace(searched.estimator, lonlat)
    return there.story(*there.met(searched), location, options.min_log10_odds)


class _TruePlace:
    """The true place on the map that was searched."""

    def __init__(self, estimator: TripleEstimator, lonlat: tuple[float, float]) -> None:
        self.estimator, self.lonlat = estimator, lonlat
        self.xy = np.asarray(from_lonlat(estimator.index.plane, np.array([lonlat]))[0], float)

    def met(self, searched: Searched) -> tuple[dict[str, int], list[CameraFault], float]:
        """Return the number of times each stage met it, the camera's objections to it, and its best score."""
        scene, index, events = self.estimator.scene, self.estimator.index, searched.events
        counts = dict.fromkeys(_MET, 0)
        for proposals, _, kept in events.of("screened"):
            linear = proposals.affine.reshape(-1, 2, 2)
            middles = index.xy[proposals.reference] + linear @ (scene.center - scene.intersections.xy[proposals.anchor])
            near = self._is_near(middles, np.sqrt(np.abs(np.linalg.det(linear))))
            counts["proposals"] += int(near.sum())
            counts["on_roads"] += int(near[kept].sum())
        settled = [place for place in events.of("settled") if self._is_there(place)]
        faults = [fault for fault, matrix in events.of("refused") if self._lies_there(matrix / matrix[2, 2])]
        faults += [place.fault for place in settled if place.fault is not None]
        survived = sum(self._lies_there(matrix) for grown in events.of("grown") for matrix in grown)
        counts |= {"survived": survived, "camera": len(faults), "verified": len(settled)}
        listed = (*searched.compared, *searched.places[1:])
        scores = [place.score for place in listed if self._is_there(place)] or [
            min(place.score, 0.0) for place in settled
        ]
        return counts, faults, max(scores, default=-math.inf)

    def _is_near(self, xy: FloatArray, scales: FloatArray) -> BoolArray:
        """Return which places (N, 2) of the frame's middle lie near the truth, at ground samplings (N,)."""
        limit = np.maximum(_AT_LEAST_M, _ROUGHLY * scales * self.estimator.scene.half_size)
        return np.asarray(np.hypot(*(xy - self.xy).T) <= limit)

    def _lies_there(self, matrix: FloatArray) -> bool:
        """Return whether a homography puts the middle of the frame near the truth."""
        return self._is_there(Place(self.estimator.scene, self.estimator.index, matrix))

    def _is_there(self, place: Place) -> bool:
        """Return whether a place lies near the truth."""
        return bool(self._is_near(place.center[None], np.array([place.gsd_m]))[0])

    def story(
        self, counts: dict[str, int], faults: list[CameraFault], best: float, location: Location, needed: float
    ) -> TruthStory:
        """Describe the stage that lost it."""
        estimator = self.estimator
        reach_m = estimator.scene.half_size * min(estimator.options.camera.gsd_m[1], LARGE_PIXEL_M)
        lost_at: str | None
        if np.hypot(*(estimator.index.xy - self.xy).T).min() > 2.0 * reach_m:
            lost_at, how = "map", "lies off the map that was searched"
        elif counts.get("verified") and math.isfinite(best):
            lost_at, how = self._weighed(best, location, needed)
        else:
            last = next((stage for stage in _LOST if counts.get(stage)), "")
            lost_at, how = _LOST[last]
            if last == "camera":
                how += ": " + ", ".join(fault.value for fault, _ in Counter(faults).most_common())
        return TruthStory(*self.lonlat, lost_at, f"the true place {how}", counts, finite_or_none(best))

    def _weighed(self, best: float, location: Location, needed: float) -> tuple[str | None, str]:
        """Describe the fate of the truth after it was compared with the map."""
        score, located = f"reached a score of {best:.1f}", False
        if location.located and location.center is not None:
            center = np.array([[location.center.lon, location.center.lat]])
            xy = from_lonlat(self.estimator.index.plane, center)
            located = bool(self._is_near(xy, np.array([location.gsd_m or 1.0]))[0])
        if best < needed and not located:
            return "odds", f"{score}, {needed:g} are needed"
        if not located:
            return "rival", f"{score}, but another place as much, or it was met too late"
        if best < needed:
            return None, f"{score}, but leads any other place where these streets repeat, and was located"
        return None, f"{score} and was located"
