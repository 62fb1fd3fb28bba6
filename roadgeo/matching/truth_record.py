"""Which stage of a search lost the true place: what `Record` keeps, and what became of the truth on the way."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from roadgeo._arrays import BoolArray, FloatArray, IntArray
from roadgeo.geometry.camera import CameraFault, sampling
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.projection import from_lonlat
from roadgeo.location import Location
from roadgeo.matching.estimator import TripleEstimator
from roadgeo.matching.explanation import Story
from roadgeo.matching.hypothesis import Hypothesis
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.record import Record
from roadgeo.matching.triples import Proposals
from roadgeo.matching.verdict import Needed

__all__ = ["TruthRecord", "TruthStory", "make_record", "tell_truth"]

#: How far the middle of a rough proposal may lie from the truth, in halves of the frame's diagonal, and at least.
_ROUGHLY, _AT_LEAST_M = 0.25, 50.0


@dataclass(frozen=True)
class TruthStory:
    """What became of the true place on one reference.

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


class TruthRecord(Record):
    """A `Record` that also counts how often each stage met the true place."""

    def __init__(self, lonlat: tuple[float, float]) -> None:
        """`lonlat` is where the middle of the frame lies."""
        super().__init__()
        self.lonlat = lonlat
        self.met: Counter[str] = Counter()
        self.faults: Counter[CameraFault] = Counter()
        self.best = -math.inf
        self._xy: FloatArray | None = None

    def began(self, estimator: TripleEstimator) -> None:
        """Find the true place on the map that is searched."""
        self.estimator = estimator
        self._xy = np.asarray(from_lonlat(estimator.index.plane, np.array([self.lonlat]))[0], float)

    def screened(self, proposals: Proposals, allowed: BoolArray, kept: IntArray) -> None:
        """Count proposals that put the middle of the frame near the truth."""
        super().screened(proposals, allowed, kept)
        if self.estimator is None:
            return
        scene, index = self.estimator.scene, self.estimator.index
        linear = proposals.affine.reshape(-1, 2, 2)
        middles = index.xy[proposals.reference] + linear @ (scene.center - scene.intersections.xy[proposals.anchor])
        scales = np.sqrt(np.abs(np.linalg.det(linear)))
        near = self._is_near(middles, scales)
        self.met["proposals"] += int(near.sum())
        self.met["on_roads"] += int(near[kept].sum())

    def grown(self, hypotheses: Sequence[Hypothesis]) -> None:
        """Count what grew there."""
        super().grown(hypotheses)
        self.met["survived"] += sum(self._is_there(one.matrix) for one in hypotheses)

    def refused(self, fault: CameraFault, matrix: FloatArray) -> None:
        """Count what a camera refused there."""
        super().refused(fault, matrix)
        if self._is_there(matrix / matrix[2, 2]):
            self.met["camera"] += 1
            self.faults[fault] += 1

    def scored(self, model: Hypothesis) -> None:
        """Keep the best score there."""
        super().scored(model)
        if self._is_there(model.matrix):
            self.met["verified"] += 1
            self.best = max(self.best, model.log10_odds)
            if model.fault is not None and not math.isfinite(model.log10_odds):
                self.met["camera"] += 1
                self.faults[model.fault] += 1

    def _is_near(self, xy: FloatArray, scales: FloatArray) -> BoolArray:
        """Tell which places (N, 2) of the frame's middle lie near the truth, at ground samplings (N,)."""
        if self._xy is None or self.estimator is None:
            return np.zeros(len(xy), bool)
        limit = np.maximum(_AT_LEAST_M, _ROUGHLY * scales * self.estimator.scene.half_size)
        return np.asarray(np.hypot(*(xy - self._xy).T) <= limit)

    def _is_there(self, matrix: FloatArray) -> bool:
        """Whether a homography puts the middle of the frame near the truth."""
        if self.estimator is None:
            return False
        scene = self.estimator.scene
        scale = np.array([sampling(matrix, scene.size)])
        return bool(self._is_near(Homography(matrix).everywhere(scene.center)[None], scale)[0])

    def told(self, location: Location, needed: Needed) -> TruthStory:
        """Tell which stage lost the truth; `location` is the answer on this reference."""
        lost_at, said = self._lost(location, needed)
        counts = {stage: self.met[stage] for stage in ("proposals", "on_roads", "survived", "camera", "verified")}
        return TruthStory(*self.lonlat, lost_at, said, counts, self.best if math.isfinite(self.best) else None)

    def _lost(self, location: Location, needed: Needed) -> tuple[str | None, str]:
        met = self.met
        if self.estimator is None or self._xy is None:
            return "map", "the true place: nothing was searched"
        index = self.estimator.index
        if np.hypot(*(index.xy - self._xy).T).min() > 2.0 * needed_reach(self.estimator):
            return "map", "the true place lies off the map that was searched"
        if met["verified"] and math.isfinite(self.best):
            return self._weighed(location, needed)
        if met["camera"]:
            why = ", ".join(fault.value for fault, _ in self.faults.most_common())
            return "camera", f"the true place grew, but the camera's limits refused it: {why}"
        if met["verified"]:
            return "verified", "the true place grew, but could not be refined to the map's roads"
        if met["survived"]:
            return "verified", "the true place grew, but was not among the best of its intersection"
        if met["on_roads"]:
            return "survived", "the true place was proposed, but what was followed outwards from there did not fit"
        if met["proposals"]:
            return "on_roads", "the true place was proposed, but the roads around the intersection did not agree"
        return "proposals", "the true place was never proposed: no intersection and its neighbours are intact enough"

    def _weighed(self, location: Location, needed: Needed) -> tuple[str | None, str]:
        """Tell what became of the truth after it was compared with the map."""
        score = f"the true place reached log10 odds {self.best:.1f}"
        located = location.located and location.center is not None and self._is_answer(location)
        if located and self.best < needed.log10_odds:
            return None, f"{score}, but leads any other place where these streets repeat, and was located"
        if self.best < needed.log10_odds:
            return "odds", f"{score}, {needed.log10_odds:g} are needed"
        if located:
            return None, f"{score} and was located"
        return "margin", f"{score}, but another place as much, or it was met too late"

    def _is_answer(self, location: Location) -> bool:
        if location.center is None or self.estimator is None or self._xy is None:
            return False
        xy = from_lonlat(self.estimator.index.plane, np.array([[location.center.lon, location.center.lat]]))[0]
        return bool(self._is_near(xy[None], np.array([location.gsd_m or 1.0]))[0])


def needed_reach(estimator: TripleEstimator) -> float:
    """Return how far from all intersections the middle of a frame may lie on a map: half a frame, metres."""
    return float(estimator.scene.half_size * min(estimator.options.camera.gsd_m[1], 5.0))


def make_record(mask: str, options: LocateOptions) -> Record:
    """Make a record for a mask, of its true place where that is given."""
    for name, lon, lat in options.truths:
        if not name or Path(mask).as_posix().endswith(name):
            return TruthRecord((lon, lat))
    return Record()


def tell_truth(story: Story, record: Record, location: Location, needed: Needed) -> Story:
    """Add what became of the true place to a story, where it is known."""
    if not isinstance(record, TruthRecord):
        return story
    truth = record.told(location, needed)
    missing = story.missing if truth.lost_at is None else (truth.said, *story.missing)
    return replace(story, truth=truth, missing=missing)
