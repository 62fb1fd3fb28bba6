"""Which stage of a search lost the true place, where that is known."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from roadgeo._arrays import BoolArray, FloatArray
from roadgeo.geometry.camera import CameraFault, sampling
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.projection import from_lonlat
from roadgeo.location import Location
from roadgeo.matching.estimator import TripleEstimator
from roadgeo.matching.events import Events
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.verdict import Needed

__all__ = ["Met", "TruthStory", "tell_truth", "true_place"]

#: How far the middle of a rough proposal may lie from the truth, in halves of the frame's diagonal, and at least.
_ROUGHLY, _AT_LEAST_M = 0.25, 50.0
#: Pixels that are greater hardly reach as far as intersections are.
_LARGE_PIXEL_M = 5.0
_STAGES = ("proposals", "on_roads", "survived", "camera", "verified")


@dataclass(frozen=True)
class TruthStory:
    """The fate of the true place on one reference.

    Attributes
    ----------
    lon, lat : float
        As given.
    lost_at : str or None
        The first stage that it did not come out of: "map", "proposals", "on_roads", "survived", "camera", "verified",
        "odds" or "margin"; None where it was located there.
    said : str
        That, in a sentence.
    counts : dict
        How often the place was met at "proposals", "on_roads", "survived", "camera" (refused) and "verified".
    log10_odds : float or None
        The best that it reached.
    """

    lon: float
    lat: float
    lost_at: str | None
    said: str
    counts: dict[str, int]
    log10_odds: float | None

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for `json.dumps`."""
        return asdict(self)


@dataclass
class Met:
    """How often each stage met the true place, the camera's objections to it, and the best odds that it reached."""

    counts: Counter[str] = field(default_factory=Counter)
    faults: Counter[CameraFault] = field(default_factory=Counter)
    best: float = -math.inf


def true_place(mask: str, options: LocateOptions) -> tuple[float, float] | None:
    """Return longitude and latitude of a mask's true place where that is given."""
    for name, lon, lat in options.truths:
        if not name or Path(mask).as_posix().endswith(name):
            return lon, lat
    return None


def tell_truth(lonlat: tuple[float, float], events: Events, location: Location, needed: Needed) -> TruthStory:
    """Return which stage lost the truth; `location` is the answer on this reference."""
    if events.estimator is None:
        return TruthStory(*lonlat, "map", "the true place: nothing was searched", dict.fromkeys(_STAGES, 0), None)
    there = _Place(events.estimator, lonlat)
    return there.told(there.met(events), location, needed)


class _Place:
    """The true place on the map that was searched."""

    def __init__(self, estimator: TripleEstimator, lonlat: tuple[float, float]) -> None:
        self.estimator, self.lonlat = estimator, lonlat
        self.xy = np.asarray(from_lonlat(estimator.index.plane, np.array([lonlat]))[0], float)

    def met(self, events: Events) -> Met:
        """Count how often each stage met it."""
        met, scene, index = Met(), self.estimator.scene, self.estimator.index
        for proposals, _, kept in events.of("screened"):
            linear = proposals.affine.reshape(-1, 2, 2)
            middles = index.xy[proposals.reference] + linear @ (scene.center - scene.intersections.xy[proposals.anchor])
            near = self._is_near(middles, np.sqrt(np.abs(np.linalg.det(linear))))
            met.counts.update(proposals=int(near.sum()), on_roads=int(near[kept].sum()))
        met.counts["survived"] = sum(self._is_there(matrix) for grown in events.of("grown") for matrix in grown)
        refused = [fault for fault, matrix in events.of("refused") if self._is_there(matrix / matrix[2, 2])]
        scored = [one for one in events.of("scored") if self._is_there(one.model.matrix)]
        refused += [one.fault for one in scored if one.fault is not None]
        met.counts.update(verified=len(scored), camera=len(refused))
        met.faults.update(refused)
        met.best = max((one.log10_odds for one in scored), default=-math.inf)
        return met

    def _is_near(self, xy: FloatArray, scales: FloatArray) -> BoolArray:
        """Return which places (N, 2) of the frame's middle lie near the truth, at ground samplings (N,)."""
        limit = np.maximum(_AT_LEAST_M, _ROUGHLY * scales * self.estimator.scene.half_size)
        return np.asarray(np.hypot(*(xy - self.xy).T) <= limit)

    def _is_there(self, matrix: FloatArray) -> bool:
        """Whether a homography puts the middle of the frame near the truth."""
        scene = self.estimator.scene
        scale = np.array([sampling(matrix, scene.size)])
        return bool(self._is_near(Homography(matrix).everywhere(scene.center)[None], scale)[0])

    def told(self, met: Met, location: Location, needed: Needed) -> TruthStory:
        """Return which stage lost it."""
        lost_at, said = self._lost(met, location, needed)
        counts = {stage: met.counts[stage] for stage in _STAGES}
        return TruthStory(*self.lonlat, lost_at, said, counts, met.best if math.isfinite(met.best) else None)

    def _lost(self, met: Met, location: Location, needed: Needed) -> tuple[str | None, str]:
        estimator, counts = self.estimator, met.counts
        reach_m = estimator.scene.half_size * min(estimator.options.camera.gsd_m[1], _LARGE_PIXEL_M)
        if np.hypot(*(estimator.index.xy - self.xy).T).min() > 2.0 * reach_m:
            return "map", "the true place lies off the map that was searched"
        if counts["verified"] and math.isfinite(met.best):
            return self._weighed(met.best, location, needed)
        if counts["camera"]:
            why = ", ".join(fault.value for fault, _ in met.faults.most_common())
            return "camera", f"the true place grew, but the camera's limits refused it: {why}"
        if counts["verified"]:
            return "verified", "the true place grew, but could not be refined to the map's roads"
        if counts["survived"]:
            return "verified", "the true place grew, but was not among the best of its intersection"
        if counts["on_roads"]:
            return "survived", "the true place was proposed, but what was followed outwards from there did not fit"
        if counts["proposals"]:
            return "on_roads", "the true place was proposed, but the roads around the intersection did not agree"
        return "proposals", "the true place was never proposed: no intersection and its neighbours are intact enough"

    def _weighed(self, best: float, location: Location, needed: Needed) -> tuple[str | None, str]:
        """Describe the fate of the truth after it was compared with the map."""
        score, located = f"the true place reached log10 odds {best:.1f}", False
        if location.located and location.center is not None:
            center = np.array([[location.center.lon, location.center.lat]])
            xy = from_lonlat(self.estimator.index.plane, center)
            located = bool(self._is_near(xy, np.array([location.gsd_m or 1.0]))[0])
        if located and best < needed.log10_odds:
            return None, f"{score}, but leads any other place where these streets repeat, and was located"
        if best < needed.log10_odds:
            return "odds", f"{score}, {needed.log10_odds:g} are needed"
        if located:
            return None, f"{score} and was located"
        return "margin", f"{score}, but another place as much, or it was met too late"
