"""What each piece of a frame says of a place: metres of road that agree there, of the query's and of the map's.

Roads are missed, or invented, over some length; so neighbouring points of a road tell no more than one, and evidence is
counted by pieces of the frame. Two places are compared piece by piece: what both explain alike tells nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from roadgeo._arrays import BoolArray, FloatArray, IntArray
from roadgeo.geometry.homography import Homography
from roadgeo.kernels.roads import forward_distances
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.scene import Scene
from roadgeo.matching.verification import VerifyOptions, tolerance_m

__all__ = ["PieceCounts", "Pieces", "log10_lead", "sample_roads"]


class PieceCounts(NamedTuple):
    """Metres of road in each piece of a frame at a place, (P,) each, at the scale that all places are compared at.

    Attributes
    ----------
    drawn, agreeing : (P,) float64
        Of the query; of these, on a road of the map.
    mapped, shown : (P,) float64
        Of the map; of these, shown by the query.
    """

    drawn: FloatArray
    agreeing: FloatArray
    mapped: FloatArray
    shown: FloatArray

    @property
    def shares(self) -> FloatArray:
        """Share of the roads that agree; a half where there are none."""
        there = self.drawn + self.mapped
        return np.asarray(np.where(there > 0, (self.agreeing + self.shown) / np.maximum(there, 1e-9), 0.5))


@dataclass(frozen=True, eq=False)
class Pieces:
    """The pieces of a scene's frame, about `piece_m` wide.

    Attributes
    ----------
    gsd_m : float
        Metres per pixel, of all places that are compared.
    """

    scene: Scene
    index: ReferenceIndex
    gsd_m: float
    piece_m: float
    verify: VerifyOptions

    @property
    def step_m(self) -> float:
        """Distance between samples of the map's roads."""
        return self.verify.backward_step_m

    @cached_property
    def _cell_px(self) -> float:
        return max(self.piece_m / self.gsd_m, 1.0)

    @cached_property
    def _cells(self) -> tuple[int, int]:
        width, height = self.scene.size
        return math.ceil(height / self._cell_px), math.ceil(width / self._cell_px)

    def count(self, matrix: FloatArray, samples: FloatArray, scale: float = 1.0) -> PieceCounts:
        """Compare the scene with the map at a place.

        Parameters
        ----------
        matrix : (3, 3) float64
            Query plane to reference plane.
        samples : (S, 2) float64
            Points along the map's roads, one in `step_m` metres, wherever the frame may lie (see `sample_roads`).
        scale : float
            Metres per pixel at this place, as a multiple of `gsd_m`. Roads agree within as many pixels at all scales:
            within as many metres they would agree by chance wherever the frame is laid small.
        """
        scene, verify = self.scene, self.verify
        tolerance = tolerance_m(self.gsd_m, verify)
        points = scene.dense_points
        away = np.empty(len(points))
        forward_distances(
            matrix, points, scene.dense_directions, scale * tolerance, math.cos(math.radians(verify.max_turn_deg)),
            0.0, 0.0, self.index.road_buckets, away,
        )  # fmt: skip
        seen, inside = self.in_frame(matrix, samples)
        seen = seen[inside]
        rows, columns = self._field_cells(seen)
        near = scene.field[rows, columns] * scene.field_scale <= tolerance / self.gsd_m + 0.7 * scene.field_scale
        spacing_m = scene.road_length_px * self.gsd_m / max(len(points), 1)
        step_m, n = self.step_m / scale, self._cells[0] * self._cells[1]
        at, back = self._cell_of(points), self._cell_of(seen)
        return PieceCounts(
            np.asarray(np.bincount(at, minlength=n) * spacing_m, float),
            np.asarray(np.bincount(at, np.isfinite(away), n) * spacing_m, float),
            np.asarray(np.bincount(back, minlength=n) * step_m, float),
            np.asarray(np.bincount(back, near, n) * step_m, float),
        )

    def in_frame(self, matrix: FloatArray, samples: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Return the map's samples on the query plane, and which of them lie on observed ground of the frame."""
        scene, to_query = self.scene, Homography(matrix).facing(self.scene.center).inverse()
        seen = to_query(samples)
        x, y = seen[:, 0], -seen[:, 1]
        inside = (x > 0) & (y > 0) & (x < scene.size[0]) & (y < scene.size[1])
        rows, columns = self._field_cells(seen[inside])
        inside[inside] = scene.observed[rows, columns]
        return seen, inside

    def _field_cells(self, xy: FloatArray) -> tuple[IntArray, IntArray]:
        """Return rows and columns of the scene's reduced frame."""
        cells = (xy * (1.0, -1.0) / self.scene.field_scale).astype(np.int64)
        return (
            np.minimum(cells[:, 1], self.scene.field.shape[0] - 1),
            np.minimum(cells[:, 0], self.scene.field.shape[1] - 1),
        )

    def _cell_of(self, xy: FloatArray) -> IntArray:
        """Return the number of the piece of the frame that each point lies in."""
        cells = (xy * (1.0, -1.0) / self._cell_px).astype(np.int64)
        rows, columns = (np.clip(cells[:, k], 0, self._cells[1 - k] - 1) for k in (1, 0))
        return np.asarray(rows * self._cells[1] + columns)


def sample_roads(index: ReferenceIndex, low: FloatArray, high: FloatArray, step_m: float) -> FloatArray:
    """Return points (S, 2) along the map's roads that touch a box from `low` to `high`, one in `step_m` metres."""
    a, b = index.segments[:, :2].astype(float), index.segments[:, 2:].astype(float)
    near = (np.maximum(a, b) > low).all(axis=1) & (np.minimum(a, b) < high).all(axis=1)
    a, b = a[near], b[near]
    if not len(a):
        return np.empty((0, 2))
    along = np.concatenate(([0.0], np.cumsum(np.hypot(*(b - a).T))))
    at = np.arange(step_m / 2, along[-1], step_m)
    segment = np.minimum(np.searchsorted(along, at, side="right") - 1, len(a) - 1)
    share = (at - along[segment]) / np.maximum(np.diff(along)[segment], 1e-9)
    return np.asarray(a[segment] + share[:, None] * (b - a)[segment])


#: Weighted sums of random signs exceed their standard deviation times z at most so many times as often as a normal
#: variable does (Bentkus and Dzindzalieta, Bernoulli 21, 2015).
_OFTENER_THAN_NORMAL = 0.25 / (0.5 * math.erfc(1.0))


def log10_lead(difference: FloatArray) -> float:
    """Log10 odds that one place agrees better than another by more than chance, from their difference in each piece.

    Were they alike, each piece of the frame would speak for either with the same probability: the signed ranks of the
    differences (Wilcoxon, 1945) add up to more than z times the root of the sum of their squares with a probability of
    at most exp(-z^2 / 2) (Hoeffding), and of at most 3.18 times that of a normal variable; the smaller one counts.
    Ranks, for a few pieces may tell much where one place lies beside a road, and most tell a little.
    """
    told = difference[difference != 0.0]
    if not len(told):
        return 0.0
    _, rank, n_alike = np.unique(np.abs(told), return_inverse=True, return_counts=True)
    ranks = (np.cumsum(n_alike) - 0.5 * (n_alike - 1))[rank]
    z = float(np.sign(told) @ ranks) / math.sqrt(float(ranks @ ranks))
    if z <= 0.0:
        return 0.0
    hoeffding = -0.5 * z**2 / math.log(10.0)
    tail = _OFTENER_THAN_NORMAL * 0.5 * math.erfc(z / math.sqrt(2.0))
    return -min(hoeffding, math.log10(tail)) if tail > 0.0 else -hoeffding
