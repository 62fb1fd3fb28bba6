"""The likelihood of a place: how well it explains the query's roads and the map's roads in the frame.

Each piece of the query's roads is either true, off the map's road by a residual, or false. Each piece of the map's
roads in the frame is either seen, off by a residual, or missing. Under a place H

    log L(H) = sum over the query's roads  log[ (1 - f) g(r; sigma) / b + f ]
             + sum over the map's roads    log[ (1 - m) g(r; sigma) / b + m ]

with r the residual, g a half-normal density, b the density of residuals where roads lie at random, f the share of false
roads and m the share of missing roads. The quality of a query is unknown: sigma, m and f are marginalised over a small
grid. Neighbouring pieces agree together, so `STATEMENT_M` metres of road count once.

Log L alone is of little use where streets repeat. A place is scored by its lead over the best other place (see
`rivals`). The lead is measured piece by piece: if two places were alike, each piece of the frame would favour either
with the same probability.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from roadgeo._arrays import BoolArray, FloatArray, IntArray
from roadgeo.geometry.camera import sampling
from roadgeo.geometry.homography import Homography
from roadgeo.kernels.point_matching import match_all
from roadgeo.kernels.roads import count_residuals, road_residuals, shares_near_roads
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.scene import APART_M, MIN_COS, N_CLOSELY, N_ROUGHLY, Scene, in_pixels
from roadgeo.matching.shifts import SAME_M, shifted

__all__ = ["SHARES", "Agreement", "Evidence", "log10_lead", "match_intersections", "statement_px", "tolerance_m"]

#: Grid of the marginalised parameters: residuals' deviation, in usual ones; shares of missing, and of false roads.
_SIGMAS = np.geomspace(0.25, 1.6, 5)
SHARES = np.linspace(0.2, 0.87, 5) ** 2
#: Range of residuals, in usual deviations; number of bins; number of bins of roads that agree.
_REACH, _BINS, _AGREEING = 4.0, 24, 18
#: Share of random roads that run along a road piece, as streets go; the directions of the map's roads are not compared
#: with the query's.
_ALONG = 0.42
#: Accuracy of the distance to the query's roads, in cells of its raster.
_BLUR_CELLS = 0.35
#: Usual distance between a mapped road and the true road, and usual error of a traced road.
MAP_SIGMA_M, PIXEL_SIGMA_PX = 1.8, 1.0
#: This length of road, query and map together, counts as one independent statement.
STATEMENT_M = 480.0
#: Most regions along the frame's longer side in which a place may be contradicted; their least width; and the factor by
#: which pixels are coarser than in the middle of the frame where ground is too far away to count.
_N_REGIONS, _REGION_M, _FAR = 6, 170.0, 1.6
#: A region is contradicted if the place explains less there than this part of its average elsewhere.
_HARDLY = 0.1
#: Least step of the samples along the map's roads, which is at least a cell of the query's raster.
STEP_M = 12.0
#: Places nearby: evenly spread shifts of up to this length, metres, and shifts that move one of a few map intersections
#: near the middle to another intersection around it; `N_ROUGHLY` of each.
_FARTHEST_M, _N_ANCHORS = 320.0, 3


@dataclass(frozen=True)
class Agreement:
    """The agreement of query and map at a place.

    Attributes
    ----------
    forward, backward : float
        Share of the query's roads on roads of the map, and of the map's roads on roads of the query, within three
        standard deviations.
    log10_likelihood : float
        Likelihood of `Evidence` at the place's own metres per pixel.
    """

    forward: float
    backward: float
    log10_likelihood: float = -math.inf


class Evidence:
    """Weighs places of one scene on one map, all with the same yardstick.

    Attributes
    ----------
    gsd_m : float
        Metres per pixel by which roads are measured. Residuals of a place at another scale are compared in pixels: in
        metres, roads would always agree where the frame is small on the ground.
    statement_px : float
        Pixels of road that count as one independent statement.
    """

    def __init__(self, scene: Scene, index: ReferenceIndex, gsd_m: float) -> None:
        self.scene, self.index, self.gsd_m = scene, index, gsd_m
        self._sigma_m = math.hypot(MAP_SIGMA_M, PIXEL_SIGMA_PX * gsd_m)
        self.statement_px = statement_px(gsd_m)
        self._piece_px = in_pixels(APART_M, gsd_m)  # two places are compared by pieces of the frame
        width, height = scene.size
        self._shape = math.ceil(height / self._piece_px), math.ceil(width / self._piece_px)
        self._observed_px = float(scene.observed.sum()) * scene.field_scale**2
        self._blur = round(_BLUR_CELLS * scene.field_scale * gsd_m / self._sigma_m, 1)

    def weigh(self, matrix: FloatArray) -> float:
        """Return log10 L of a place, query plane to reference plane (3, 3)."""
        traced, mapped = self._count(matrix, math.inf, (1, 1))
        return self._log10(traced[0], mapped[0])

    def agreement(self, matrix: FloatArray) -> Agreement:
        """Return the agreement at a place."""
        traced, mapped = self._count(matrix, math.inf, (1, 1))
        forward, backward = (float(bins[0, :_AGREEING].sum() / max(bins.sum(), 1e-9)) for bins in (traced, mapped))
        return Agreement(forward, backward, self._log10(traced[0], mapped[0]))

    def _log10(self, traced: FloatArray, mapped: FloatArray) -> float:
        """Return log10 L of histograms."""
        nats = self._nats(*self._ratios(mapped), traced, mapped)
        most = float(nats.max())
        return (most + math.log(float(np.exp(nats - most).mean()))) / math.log(10.0)

    def mapped_px(self, matrix: FloatArray) -> float:
        """Return the length of the map's roads on observed ground of the frame, pixels."""
        return float(self._count(matrix, math.inf, (1, 1))[1].sum())

    def compared_with(self, matrix: FloatArray) -> Callable[[FloatArray], tuple[float, float]]:
        """Return a function of another place that returns its log10 L, and the lead of this place over it (log10).

        The lead is measured piece by piece, and is no more than the likelihood by which this place is ahead, by the
        query's roads or by all: two places that are equal may differ by little everywhere. Every other place is
        compared with the deviation and the share of false roads that explain this place best, and by the query's roads
        alone: the best of many wrong places lies where the map shows few roads that the query lacks, and all other
        places show more of them in every piece.
        """
        traced, mapped = self._count(matrix, self._piece_px, self._shape)
        of_query, of_map = self._ratios(mapped)
        both = traced.sum(axis=0), mapped.sum(axis=0)
        nats, whole = self._nats(of_query, of_map, *both), self._log10(*both)
        sigma, _, false = np.unravel_index(int(nats.argmax()), nats.shape)
        ratios = of_query[sigma, false]

        def compare(other: FloatArray) -> tuple[float, float]:
            there, mapped = self._count(other, self._piece_px, self._shape)
            more = (traced - there) @ ratios
            explained = float(more.sum()) / self.statement_px / math.log(10.0)
            likelihood = self._log10(there.sum(axis=0), mapped.sum(axis=0))
            return likelihood, min(log10_lead(more), max(explained, whole - likelihood, 0.0))

        return compare

    def shared(self, matrix: FloatArray, other: FloatArray) -> float:
        """Return the fraction of road points matched at `other` that match the same map road at `matrix`.

        A variant of the same place slides along some roads and loses others; a neighbouring block matches other roads.
        """
        scene, reach_m = self.scene, tolerance_m(self.gsd_m)
        met = np.empty((len(scene.points), 3))
        radii = np.full(len(scene.points), reach_m)
        road_residuals(other, scene.points, scene.directions, radii, MIN_COS, self.index.road_buckets, met)
        on_road = np.isfinite(met[:, 0])
        moved = (Homography(matrix).everywhere(scene.points) - Homography(other).everywhere(scene.points))[on_road]
        across = np.abs((moved * met[on_road, 1:]).sum(axis=1))
        alike = (across < 2.0 * reach_m) & (np.hypot(*moved.T) < APART_M)
        return float(alike.mean()) if on_road.any() else 0.0

    def on_roads(self, matrix: FloatArray) -> BoolArray:
        """Return which road points (S,) lie on roads of the map that run their way."""
        scene = self.scene
        met, radii = np.empty((len(scene.points), 3)), np.full(len(scene.points), tolerance_m(self.gsd_m))
        road_residuals(matrix, scene.points, scene.directions, radii, MIN_COS, self.index.road_buckets, met)
        return np.asarray(np.isfinite(met[:, 0]))

    def contradicted(self, matrix: FloatArray) -> float:
        """Return the share of roads in regions of the frame where the place explains little or nothing.

        In such regions the query and the map both show roads, but different ones: a place that fits only in part, as in
        a city built like its own mirror image, is wrong. A region where either shows no roads contradicts nothing. Far
        ground of an oblique view, which cannot be traced, does not count.
        """
        scene = self.scene
        side = max(max(scene.size) / _N_REGIONS, _REGION_M / self.gsd_m)
        columns, rows = (max(round(length / side), 1) for length in scene.size)
        traced, mapped = self._count(matrix, side, (rows, columns))
        of_query, of_map = self._ratios(mapped)
        nats = self._nats(of_query, of_map, traced.sum(axis=0), mapped.sum(axis=0))
        sigma, missing, false = np.unravel_index(int(nats.argmax()), nats.shape)
        explained = traced @ of_query[sigma, false] + mapped @ of_map[sigma, missing]
        row, column = np.divmod(np.arange(rows * columns), columns)
        middles = np.stack(((column + 0.5) * side, -(row + 0.5) * side), axis=1)
        scales = np.sqrt(np.abs(np.linalg.det(Homography(matrix).jacobian(middles)))) / sampling(matrix, scene.size)
        near = np.nan_to_num(scales, nan=math.inf) < _FAR
        both = np.minimum(traced.sum(axis=1), mapped.sum(axis=1)) * near
        if not both.any():
            return 0.0
        least = _HARDLY * max(float(explained[near].sum()), 0.0) * both / both.sum()
        share = float(both[explained < least].sum() / both.sum())
        return max(share - 0.5 / len(both), 0.0)  # half a region is usual: a railway may run through it

    def _scale(self, matrix: FloatArray) -> float:
        """Return how many times larger a place's pixels are than those by which roads are measured."""
        return sampling(matrix, self.scene.size) / self.gsd_m

    def _count(self, matrix: FloatArray, piece_px: float, shape: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
        """Return histograms of the residuals of the query's roads and of the map's, pixels of road, (P, bins) each."""
        scene, index = self.scene, self.index
        scale = self._scale(matrix)
        ground, step_m = Homography(matrix).everywhere(scene.corners), max(STEP_M, scene.field_scale * self.gsd_m)
        traced, mapped = (np.empty((shape[0] * shape[1], _BINS + 1)) for _ in range(2))
        count_residuals(
            matrix, np.asarray(np.linalg.inv(matrix), float), np.concatenate([ground.min(axis=0), ground.max(axis=0)]),
            scene.points, scene.directions, scene.weights, _REACH * self._sigma_m * scale, MIN_COS,
            step_m, index.road_buckets, scene.field, scene.field_scale, scene.observed, piece_px, shape[1],
            traced, mapped,
        )  # fmt: skip
        traced *= scene.road_length_px / max(len(scene.points), 1)
        return traced, mapped

    def _ratios(self, mapped: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return log likelihood ratios of residuals of the query's roads and of the map's (sigma, share, bin).

        The more roads are in the frame, the more roads of the other side have a neighbour by chance.
        """
        reach = 2.0 * _REACH * self._sigma_m / self.gsd_m / max(self._observed_px, 1.0)
        of_query = _anyhow(_ALONG * reach * float(mapped.sum()))
        of_map = _anyhow(reach * self.scene.road_length_px)
        return _log_ratios(of_query, 0.0), _log_ratios(of_map, self._blur)

    def _nats(self, of_query: FloatArray, of_map: FloatArray, traced: FloatArray, mapped: FloatArray) -> FloatArray:
        """Return log L by (sigma, missing, false)."""
        return np.asarray(((of_query @ traced)[:, None, :] + (of_map @ mapped)[:, :, None]) / self.statement_px)

    def nearby(
        self,
        matrix: FloatArray,
        near: tuple[float, float, float] | None = None,
        n_shifts: int = N_ROUGHLY,
        n_anchors: int = _N_ANCHORS,
    ) -> float:
        """Return log10 L of the best shifted place.

        Shifts lie on a sunflower spiral, which covers all directions and distances evenly. Further shifts move
        intersections of the map onto other intersections, if the middle of the frame stays within the circle `near` =
        (x, y, radius), plane metres.
        """
        scene = self.scene
        reach_m = 2.0 * self._sigma_m * self._scale(matrix)
        shifts = np.concatenate(
            (self._spiral(reach_m, n_shifts), self._onto_neighbours(matrix, reach_m, near, n_anchors))
        )
        shares = np.empty(len(shifts))
        thin = max(1, len(scene.points) // N_ROUGHLY)
        points, directions, weights = (
            np.ascontiguousarray(array[::thin]) for array in (scene.points, scene.directions, scene.weights)
        )
        shares_near_roads(
            matrix, points, directions, weights, reach_m, MIN_COS, shifts, self.index.road_buckets, shares
        )
        best = np.argsort(-shares, kind="stable")[:N_CLOSELY]
        return max((self.weigh(shifted(matrix, *shifts[k])) for k in best), default=0.0)

    def _least_shift(self, reach_m: float) -> float:
        """Return the factor on the lengths of shifts: the shortest is three times the distance at which roads agree."""
        return max(1.0, 4.5 * reach_m / SAME_M)

    def _spiral(self, reach_m: float, n_shifts: int) -> FloatArray:
        """Return shifts (n_shifts, 2) in metres on a sunflower spiral."""
        k, wider = np.arange(n_shifts), self._least_shift(reach_m)
        low, high = (wider * end for end in (SAME_M, _FARTHEST_M))
        radius = np.sqrt(low**2 + (high**2 - low**2) * (k + 0.5) / len(k))
        angle = k * math.pi * (3.0 - math.sqrt(5.0))
        return np.stack((radius * np.cos(angle), radius * np.sin(angle)), axis=1)

    def _onto_neighbours(
        self, matrix: FloatArray, reach_m: float, within: tuple[float, float, float] | None, n_anchors: int
    ) -> FloatArray:
        """Return shifts (M, 2), metres, that move a map intersection near the middle of the frame onto others."""
        wider = self._least_shift(reach_m)
        low, high = (wider * end for end in (SAME_M, _FARTHEST_M))
        middle = Homography(matrix)(self.scene.center)
        near = self.index.within(middle, 2.0 * high)
        if not len(near):
            return np.empty((0, 2))
        anchors = near[np.argsort(((near - middle) ** 2).sum(axis=1))[:n_anchors]]
        shifts = (near - anchors[:, None]).reshape(-1, 2)
        length = np.hypot(*shifts.T)
        possible = (length > low) & (length < high)
        if within is not None:
            possible &= np.hypot(*(middle + shifts - within[:2]).T) <= within[2]
        shifts, length = shifts[possible], length[possible]
        return np.asarray(shifts[np.argsort(length)[:N_ROUGHLY]])


def statement_px(gsd_m: float) -> float:
    """Return the pixels of road that count as one independent statement.

    Likelihoods times this number compare places of different scale, for both then count the same pixels. Without it a
    place with larger pixels has more statements.
    """
    return in_pixels(STATEMENT_M, gsd_m)


def tolerance_m(gsd_m: float) -> float:
    """Return the greatest distance of roads that agree, metres: three standard deviations."""
    return 3.0 * math.hypot(MAP_SIGMA_M, PIXEL_SIGMA_PX * gsd_m)


def match_intersections(
    matrix: FloatArray, scene: Scene, index: ReferenceIndex, gsd_m: float
) -> tuple[IntArray, FloatArray]:
    """Return the map intersection matched to each query intersection (N,), or -1, and their distance (N,), metres."""
    own = scene.intersections
    matched, distance = np.empty(len(own), np.int64), np.empty(len(own))
    reach_m = 1.5 * tolerance_m(gsd_m)
    match_all(matrix, own.xy, scene.branches, reach_m, MIN_COS, index.point_buckets, matched, distance)
    return matched, distance


def _anyhow(expected: float) -> float:
    """Return the natural logarithm of the share of pieces near at least one of the expected number of roads."""
    return round(math.log(max(1.0 - math.exp(-expected), float(SHARES[0]))), 1)


@lru_cache(maxsize=256)
def _log_ratios(anyhow: float, blur: float) -> FloatArray:
    """Return log likelihood ratios (sigma, share, bin) of a residual, against a road that lies there by chance.

    Deviations, residuals and the `blur` are in usual deviations; the last bin holds roads without a road within reach.
    """
    sigmas = np.hypot(_SIGMAS, blur)[:, None]
    residual = (np.arange(_BINS) + 0.5) * (_REACH / _BINS)
    density = math.sqrt(2.0 / math.pi) / sigmas * np.exp(-0.5 * (residual / sigmas) ** 2)
    ratio = np.concatenate((density * (_REACH * math.exp(-anyhow)), np.zeros((len(sigmas), 1))), axis=1)
    return np.asarray(np.log((1.0 - SHARES)[None, :, None] * ratio[:, None, :] + SHARES[None, :, None]))


#: Factor by which weighted sums of random signs may exceed their standard deviation times z more often than a normal
#: variable does (Bentkus and Dzindzalieta, Bernoulli 21, 2015).
_OFTENER_THAN_NORMAL = 0.5 / math.erfc(1.0)


def log10_lead(difference: FloatArray) -> float:
    """Return the log10 lead of a place over another by more than chance, from their difference in each piece.

    If two places were alike, each piece of the frame would favour either with the same probability. The signed ranks of
    the differences (Wilcoxon, 1945) then exceed z times the root of the sum of their squares with a probability of at
    most exp(-z^2 / 2) (Hoeffding), and at most 3.18 times a normal variable's; the smaller bound counts. Ranks are
    used because a few pieces may differ much, where a place lies beside a road, while most differ little.
    """
    unequal = difference[difference != 0.0]
    if not len(unequal):
        return 0.0
    _, rank, n_alike = np.unique(np.abs(unequal), return_inverse=True, return_counts=True)
    ranks = (np.cumsum(n_alike) - 0.5 * (n_alike - 1))[rank]
    z = float(np.sign(unequal) @ ranks) / math.sqrt(float(ranks @ ranks))
    if z <= 0.0:
        return 0.0
    hoeffding = -0.5 * z**2 / math.log(10.0)
    tail = _OFTENER_THAN_NORMAL * 0.5 * math.erfc(z / math.sqrt(2.0))
    return -min(hoeffding, math.log10(tail)) if tail > 0.0 else -hoeffding
