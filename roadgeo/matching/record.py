"""What a search tried, remembered for an explanation."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from roadgeo._arrays import BoolArray, FloatArray, IntArray
from roadgeo.geometry.camera import CameraFault, CameraOptions, sampling
from roadgeo.matching.estimator import TripleEstimator
from roadgeo.matching.hypothesis import Hypothesis
from roadgeo.matching.search import SearchResult
from roadgeo.matching.triples import Proposals
from roadgeo.matching.verification import agreement

__all__ = ["Record", "Scored", "without_limits"]

#: Places that a camera refused which are looked at again, and how many of those are kept.
_MAX_RETRIED, _MAX_REFUSED, _MAX_ELSEWHERE = 6, 200, 20

#: Limits that a user may have set too narrow; other faults hold for every camera.
_NEGOTIABLE = (CameraFault.SAMPLING, CameraFault.SKEW, CameraFault.TILT, CameraFault.HEADING)


@dataclass(frozen=True)
class Scored:
    """A hypothesis that was verified, its odds, and the camera's objection if that ended it."""

    model: Hypothesis
    log10_odds: float
    fault: CameraFault | None = None


class Record:
    """A `Trace` that remembers what became of everything a search tried."""

    def __init__(self) -> None:
        """Begin empty."""
        self.anchors: list[int] = []
        self.n_proposals = self.n_on_roads = self.n_survived = 0
        self.refusals: Counter[CameraFault] = Counter()
        self.unscaled: list[tuple[CameraFault, FloatArray]] = []
        self.models: list[Scored] = []
        self.elsewhere: list[Proposals] = []
        self.estimator: TripleEstimator | None = None
        self.result: SearchResult[Hypothesis] | None = None

    def began(self, estimator: TripleEstimator) -> None:
        """Nothing is known yet."""

    def screened(self, proposals: Proposals, allowed: BoolArray, kept: IntArray) -> None:
        """Note one anchor's proposals (see `Trace`); some that point elsewhere than a camera may are kept for later."""
        self.anchors.append(proposals.anchor)
        self.n_proposals += len(proposals.reference)
        self.n_on_roads += len(kept)
        barred = np.flatnonzero(~allowed)[:_MAX_ELSEWHERE]
        if len(barred):
            self.elsewhere.append(proposals.only(barred))

    def voted(self, anchor: int, n_proposed: int) -> None:
        """Count proposals of roads: all of them lie on roads."""
        self.anchors.append(anchor)
        self.n_proposals += n_proposed
        self.n_on_roads += n_proposed

    def grown(self, hypotheses: Sequence[Hypothesis]) -> None:
        """Count what survived."""
        self.n_survived += len(hypotheses)

    def refused(self, fault: CameraFault, matrix: FloatArray) -> None:
        """Count a camera's refusal; those that other limits would allow are looked at again (see `without_limits`)."""
        self.refusals[fault] += 1
        if fault in _NEGOTIABLE and len(self.unscaled) < _MAX_REFUSED:
            self.unscaled.append((fault, matrix))

    def scored(self, model: Hypothesis) -> None:
        """Keep what was verified."""
        fault = None if math.isfinite(model.log10_odds) else model.fault
        if fault is not None:
            self.refusals[fault] += 1
        self.models.append(Scored(model, model.log10_odds, fault))

    def finished(self, estimator: TripleEstimator, result: SearchResult[Hypothesis]) -> None:
        """Keep the result, and grow what points elsewhere than a camera may: to tell that it would fit."""
        self.estimator, self.result = estimator, result
        for proposals in self.elsewhere:
            for hypothesis in estimator.grow(proposals, np.arange(len(proposals.reference)))[:_MAX_RETRIED]:
                fault = estimator.judge(hypothesis.matrix, rough=True)
                if fault is not None:
                    self.refused(fault, hypothesis.matrix)


def without_limits(record: Record, estimator: TripleEstimator) -> list[Scored]:
    """Verify the best of the places that the camera refused as if it had not."""
    scene, index, options = estimator.scene, estimator.index, estimator.options
    camera = CameraOptions(gsd_m=(0.0, math.inf), max_tilt_deg=180.0, max_skew=math.inf)
    free = TripleEstimator(scene, index, replace(options, camera=camera), ledger=estimator.ledger)
    nobody = np.empty(0, np.int64)
    compared = []
    for fault, unscaled in record.unscaled:
        matrix = unscaled / unscaled[2, 2]
        gsd = sampling(matrix, scene.size)
        found, matched, _ = agreement(matrix, scene, index, gsd, nobody, options.verify)
        compared.append((found.rate + found.forward, fault, Hypothesis(matrix, nobody, 0.0, matched)))
    compared.sort(key=lambda entry: -entry[0])
    return [Scored(model, free.score(model), fault) for _, fault, model in compared[:_MAX_RETRIED]]
