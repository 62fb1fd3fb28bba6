"""One likelihood: how well a place explains the roads of the query, and those of the map in the frame.

Each piece of the query's roads either lies on a road of the map, off it by a residual, or is false; each piece of the
map's roads in the frame either is seen, off by a residual, or is missing. Under a place H

    log L(H) = sum over the query's roads  log[ (1 - f) g(r; sigma) / b + f ]
             + sum over the map's roads    log[ (1 - m) g(r; sigma) / b + m ]

with r the residual, g half a normal density, b the density of residuals where roads lie anyhow, f the share of false
roads and m that of missing ones. The quality of a query is unknown: sigma, m and f are
marginalised over a small grid. Neighbouring pieces agree together, so that `statement_m` metres of road count once.

By itself log L is of little use where streets repeat. A place is scored by its lead over the best other one (see
`rivals`), and that is measured piece by piece: were two places alike, each piece of the frame would speak for either
with the same probability.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from roadgeo._arrays import FloatArray, IntArray
from roadgeo.geometry.camera import sampling
from roadgeo.geometry.homography import Homography
from roadgeo.kernels.point_matching import match_all
from roadgeo.kernels.roads import count_residuals, road_residuals, shares_near_roads
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.scene import MIN_COS, Scene

__all__ = ["Agreement", "Evidence", "agreement", "log10_lead", "match_intersections", "statement_px", "tolerance_m"]

#: Grid of the marginalised parameters: residuals' deviation, in usual ones; shares of missing, and of false roads.
_SIGMAS = np.array([0.25, 0.4, 0.65, 1.0, 1.6])
_SHARES = np.array([0.03, 0.1, 0.25, 0.5, 0.75])
#: Range of residuals, in usual deviations, and number of bins; those of roads that agree.
_REACH, _BINS, _AGREEING = 4.0, 24, 18
#: This share of roads that lie anywhere runs along a road piece, as streets go; directions of the map's roads are not
#: compared with those of the query. Shares of pieces with such a road nearby are rounded to a ladder.
_ALONG, _STEP, _STEPS = 0.42, 0.8, 14
#: Accuracy of the distance to the query's roads, in cells of its raster.
_BLUR_CELLS = 0.35
#: Usual distance between a mapped road and the road, and usual error of a traced one.
MAP_SIGMA_M, PIXEL_SIGMA_PX = 1.8, 1.0
#: This length of road, of the query and of the map together, counts as one independent statement, but never less than
#: pixels can show.
STATEMENT_M, STATEMENT_PX = 480.0, 96.0
#: Width of the frame's pieces, by which two places are compared; the greater one.
_PIECE_M, _PIECE_PX = 60.0, 12.0
#: Regions of the longer side of the frame, at most, in which a place may be contradicted, their least width, and how
#: many times coarser pixels are than in its middle where it is too far away for that.
_N_REGIONS, _REGION_M, _FAR = 6, 170.0, 1.6
#: A region is contradicted where the place explains less than this part of what it explains elsewhere.
_HARDLY = 0.1
#: Step of the samples along the map's roads, at least; no less than a cell of the query's raster.
STEP_M = 12.0
#: Places nearby: shifts of these lengths, spread evenly, and those that lay one of some intersections of the map near
#: the middle on others around it; they are compared by this number of road points, and the best of them weighed.
_SHIFT_M, _N_SHIFTS, _N_ANCHORS, _N_POINTS, _WEIGHED = (30.0, 320.0), 150, 3, 150, 6


@dataclass(frozen=True)
class Agreement:
    """What agrees at a place.

    Attributes
    ----------
    matched, tested : int
        Intersections of the query that meet one of the map, and all of them.
    forward, backward : float
        Share of the query's roads on roads of the map, and of the map's roads on roads of the query, within three
        standard deviations.
    log10_likelihood : float
        That of `Evidence`, by the yardstick of the place itself.
    """

    matched: int
    tested: int
    forward: float
    backward: float
    log10_likelihood: float = -math.inf

    @property
    def rate(self) -> float:
        """Share of intersections matched."""
        return self.matched / max(self.tested, 1)

    @property
    def mean(self) -> float:
        """Mean of the shares of intersections, of the query's roads and of the map's roads that agree."""
        return (self.rate + self.forward + self.backward) / 3


class Evidence:
    """Weighs places of one scene on one map, all with the same yardstick.

    Attributes
    ----------
    gsd_m : float
        Metres per pixel by which roads are measured. A place at another scale is compared within as many pixels: within
        as many metres roads would agree anyhow wherever the frame is laid small.
    """

    def __init__(self, scene: Scene, index: ReferenceIndex, gsd_m: float) -> None:
        self.scene, self.index, self.gsd_m = scene, index, gsd_m
        self._sigma_m = math.hypot(MAP_SIGMA_M, PIXEL_SIGMA_PX * gsd_m)
        self._statement_px = statement_px(gsd_m)
        self._piece_px = max(_PIECE_M / gsd_m, _PIECE_PX)
        width, height = scene.size
        self._shape = math.ceil(height / self._piece_px), math.ceil(width / self._piece_px)
        self._observed_px = float(scene.observed.sum()) * scene.field_scale**2
        self._blur = round(_BLUR_CELLS * scene.field_scale * gsd_m / self._sigma_m, 1)

    def weigh(self, matrix: FloatArray) -> float:
        """Return log10 L of a place, query plane to reference plane (3, 3)."""
        seen, mapped = self._count(matrix, math.inf, (1, 1))
        return self._log10(seen[0], mapped[0])

    def agreement(self, matrix: FloatArray, matched: IntArray) -> Agreement:
        """Return what agrees at a place, where intersections of the query are `matched` (N,) with the map's, or -1."""
        seen, mapped = self._count(matrix, math.inf, (1, 1))
        forward, backward = (float(one[0, :_AGREEING].sum() / max(one.sum(), 1e-9)) for one in (seen, mapped))
        return Agreement(int((matched >= 0).sum()), len(matched), forward, backward, self._log10(seen[0], mapped[0]))

    def _log10(self, seen: FloatArray, mapped: FloatArray) -> float:
        """Return log10 L of histograms."""
        nats = self._nats(*self._ratios(mapped), seen, mapped)
        most = float(nats.max())
        return (most + math.log(float(np.exp(nats - most).mean()))) / math.log(10.0)

    def mapped_px(self, matrix: FloatArray) -> float:
        """Return how much road the map has on observed ground of the frame, pixels."""
        return float(self._count(matrix, math.inf, (1, 1))[1].sum())

    def compared_with(self, matrix: FloatArray) -> Callable[[FloatArray], tuple[float, float]]:
        """Return what compares a place with others: log10 L of another, and by how much the place leads it.

        The lead counts powers of ten, piece by piece. All are compared by the deviation and the share of false roads
        that explain the place best, and by the query's roads alone: of many wrong places the best lies where the map
        shows little that the query lacks, and all others show more in every piece.
        """
        seen, mapped = self._count(matrix, self._piece_px, self._shape)
        of_query, of_map = self._ratios(mapped)
        nats = self._nats(of_query, of_map, seen.sum(axis=0), mapped.sum(axis=0))
        sigma, _, false = np.unravel_index(int(nats.argmax()), nats.shape)
        ratios = of_query[sigma, false]

        def compare(other: FloatArray) -> tuple[float, float]:
            there, mapped = self._count(other, self._piece_px, self._shape)
            return self._log10(there.sum(axis=0), mapped.sum(axis=0)), log10_lead((seen - there) @ ratios)

        return compare

    def shared(self, matrix: FloatArray, other: FloatArray) -> float:
        """Return of which share of the query's roads on roads at another place the same road is met at this one.

        A version of the place slides along some roads, and loses others; a block beside meets most roads elsewhere.
        """
        scene, reach_m = self.scene, tolerance_m(self.gsd_m)
        met = np.empty((len(scene.points), 3))
        radii = np.full(len(scene.points), reach_m)
        road_residuals(other, scene.points, scene.directions, radii, MIN_COS, self.index.road_buckets, met)
        on_road = np.isfinite(met[:, 0])
        moved = (Homography(matrix).everywhere(scene.points) - Homography(other).everywhere(scene.points))[on_road]
        across = np.abs((moved * met[on_road, 1:]).sum(axis=1))
        alike = (across < 2.0 * reach_m) & (np.hypot(*moved.T) < _PIECE_M)
        return float(alike.mean()) if on_road.any() else 0.0

    def contradicted(self, matrix: FloatArray) -> float:
        """Return which share of the roads lies in regions of the frame where the place explains little or nothing.

        There the query and the map both show roads, but different ones: a place that fits in part, as in a city built
        like its own mirror image, is not it. Where only one of them shows roads nothing is contradicted. Far
        ground of a steep view, which cannot be traced, does not count.
        """
        scene = self.scene
        side = max(max(scene.size) / _N_REGIONS, _REGION_M / self.gsd_m)
        columns, rows = (max(round(length / side), 1) for length in scene.size)
        seen, mapped = self._count(matrix, side, (rows, columns))
        of_query, of_map = self._ratios(mapped)
        nats = self._nats(of_query, of_map, seen.sum(axis=0), mapped.sum(axis=0))
        sigma, missing, false = np.unravel_index(int(nats.argmax()), nats.shape)
        worth = seen @ of_query[sigma, false] + mapped @ of_map[sigma, missing]
        row, column = np.divmod(np.arange(rows * columns), columns)
        middles = np.stack(((column + 0.5) * side, -(row + 0.5) * side), axis=1)
        scales = np.sqrt(np.abs(np.linalg.det(Homography(matrix).jacobian(middles)))) / sampling(matrix, scene.size)
        near = np.nan_to_num(scales, nan=math.inf) < _FAR
        both = np.minimum(seen.sum(axis=1), mapped.sum(axis=1)) * near
        if not both.any():
            return 0.0
        least = _HARDLY * max(float(worth[near].sum()), 0.0) * both / both.sum()
        share = float(both[worth < least].sum() / both.sum())
        return max(share - 0.5 / len(both), 0.0)  # that of half a region is usual: a railway may run through one

    def _count(self, matrix: FloatArray, piece_px: float, shape: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
        """Return histograms of the residuals of the query's roads and of the map's, pixels of road, (P, bins) each."""
        scene, index = self.scene, self.index
        scale = sampling(matrix, scene.size) / self.gsd_m
        ground, step_m = Homography(matrix).everywhere(scene.corners), max(STEP_M, scene.field_scale * self.gsd_m)
        seen, mapped = (np.empty((shape[0] * shape[1], _BINS + 1)) for _ in range(2))
        count_residuals(
            matrix, np.asarray(np.linalg.inv(matrix), float), np.concatenate([ground.min(axis=0), ground.max(axis=0)]),
            scene.points, scene.directions, scene.weights, _REACH * self._sigma_m * scale, MIN_COS,
            step_m, index.road_buckets, scene.field, scene.field_scale, scene.observed, piece_px, shape[1],
            seen, mapped,
        )  # fmt: skip
        seen *= scene.road_length_px / max(len(scene.points), 1)
        return seen, mapped

    def _ratios(self, mapped: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return log likelihood ratios of residuals of the query's roads and of the map's (sigma, share, bin).

        The more roads there are in the frame, the more of the others have one near anyhow.
        """
        reach = 2.0 * _REACH * self._sigma_m / self.gsd_m / max(self._observed_px, 1.0)
        of_query = _anyhow(_ALONG * reach * float(mapped.sum()))
        of_map = _anyhow(reach * self.scene.road_length_px)
        return _log_ratios(of_query, 0.0), _log_ratios(of_map, self._blur)

    def _nats(self, of_query: FloatArray, of_map: FloatArray, seen: FloatArray, mapped: FloatArray) -> FloatArray:
        """Return log L by (sigma, missing, false)."""
        return np.asarray(((of_query @ seen)[:, None, :] + (of_map @ mapped)[:, :, None]) / self._statement_px)

    def nearby(
        self,
        matrix: FloatArray,
        near: tuple[float, float, float] | None = None,
        n_shifts: int = _N_SHIFTS,
        n_anchors: int = _N_ANCHORS,
    ) -> float:
        """Return log10 L of the best place that a shift leads to.

        Shifts lie on a sunflower spiral, so that all directions and distances are met evenly, and where intersections
        of the map come to lie on others, unless that takes the middle of the frame out of the circle `near` =
        (x, y, radius), plane metres.
        """
        scene = self.scene
        reach_m = 2.0 * self._sigma_m * sampling(matrix, scene.size) / self.gsd_m
        shifts = np.concatenate(
            (self._spiral(reach_m, n_shifts), self._onto_neighbours(matrix, reach_m, near, n_anchors))
        )
        shares = np.empty(len(shifts))
        thin = max(1, len(scene.points) // _N_POINTS)
        points, directions, weights = (
            np.ascontiguousarray(array[::thin]) for array in (scene.points, scene.directions, scene.weights)
        )
        shares_near_roads(
            matrix, points, directions, weights, reach_m, MIN_COS, shifts, self.index.road_buckets, shares
        )
        best = np.argsort(-shares, kind="stable")[:_WEIGHED]
        return max((self.weigh(_shifted(matrix, shifts[k])) for k in best), default=0.0)

    def _least_shift(self, reach_m: float) -> float:
        """Shifts no shorter than three times what roads may be apart, and agree: nearer is the place itself."""
        return max(1.0, 4.5 * reach_m / _SHIFT_M[0])

    def _spiral(self, reach_m: float, n_shifts: int) -> FloatArray:
        """Return shifts (n_shifts, 2) in metres on a sunflower spiral."""
        k, wider = np.arange(n_shifts), self._least_shift(reach_m)
        low, high = (wider * end for end in _SHIFT_M)
        radius = np.sqrt(low**2 + (high**2 - low**2) * (k + 0.5) / len(k))
        angle = k * math.pi * (3.0 - math.sqrt(5.0))
        return np.stack((radius * np.cos(angle), radius * np.sin(angle)), axis=1)

    def _onto_neighbours(
        self, matrix: FloatArray, reach_m: float, within: tuple[float, float, float] | None, n_anchors: int
    ) -> FloatArray:
        """Return shifts (M, 2) in metres that lay an intersection of the map near the frame's middle on others."""
        wider = self._least_shift(reach_m)
        low, high = (wider * end for end in _SHIFT_M)
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
        return np.asarray(shifts[np.argsort(length)[:_N_SHIFTS]])


def statement_px(gsd_m: float) -> float:
    """Return how many pixels of road count as one independent statement.

    A likelihood times that compares places of different scale: it is what they explain of the same pixels. By
    themselves those of larger pixels have more statements to make.
    """
    return max(STATEMENT_M / gsd_m, STATEMENT_PX)


def tolerance_m(gsd_m: float) -> float:
    """Return how far roads that agree may lie apart: three standard deviations, metres."""
    return 3.0 * math.hypot(MAP_SIGMA_M, PIXEL_SIGMA_PX * gsd_m)


def match_intersections(matrix: FloatArray, scene: Scene, index: ReferenceIndex) -> tuple[IntArray, FloatArray]:
    """Return the map's intersection that each of the query's is (N,), or -1, and metres between them (N,)."""
    found = scene.intersections
    matched, distance = np.empty(len(found), np.int64), np.empty(len(found))
    reach_m = 1.5 * tolerance_m(sampling(matrix, scene.size))
    match_all(matrix, found.xy, scene.branches, reach_m, MIN_COS, index.point_buckets, matched, distance)
    return matched, distance


def agreement(matrix: FloatArray, scene: Scene, index: ReferenceIndex) -> tuple[Agreement, IntArray, FloatArray]:
    """Return what agrees at a place, and which intersections are matched, and how well (see `match_intersections`)."""
    matched, distance = match_intersections(matrix, scene, index)
    return Evidence(scene, index, sampling(matrix, scene.size)).agreement(matrix, matched), matched, distance


def _shifted(matrix: FloatArray, shift: FloatArray) -> FloatArray:
    """Return a place (3, 3) moved by a shift (2,) in metres."""
    moved = matrix.copy()
    moved[:2] += np.outer(shift, matrix[2])
    return moved


def _anyhow(expected: float) -> int:
    """Return the share of pieces that have one of the expected number of roads near, as a step of the ladder."""
    share = 1.0 - math.exp(-expected)
    return min(max(round(math.log(max(share, 1e-9)) / math.log(_STEP)), 0), _STEPS)


@lru_cache(maxsize=256)
def _log_ratios(anyhow: int, blur: float) -> FloatArray:
    """Return log likelihood ratios (sigma, share, bin) of a residual, against a road that lies there anyhow.

    Deviations and residuals count usual deviations, and so does the `blur`; the last bin is no road within reach.
    """
    sigmas = np.hypot(_SIGMAS, blur)[:, None]
    residual = (np.arange(_BINS) + 0.5) * (_REACH / _BINS)
    density = math.sqrt(2.0 / math.pi) / sigmas * np.exp(-0.5 * (residual / sigmas) ** 2)
    ratio = np.concatenate((density * (_REACH / _STEP**anyhow), np.zeros((len(sigmas), 1))), axis=1)
    return np.asarray(np.log((1.0 - _SHARES)[None, :, None] * ratio[:, None, :] + _SHARES[None, :, None]))


#: Factor by which weighted sums of random signs may exceed their standard deviation times z more often than a normal
#: variable does (Bentkus and Dzindzalieta, Bernoulli 21, 2015).
_OFTENER_THAN_NORMAL = 0.25 / (0.5 * math.erfc(1.0))


def log10_lead(difference: FloatArray) -> float:
    """Log10 odds that one place agrees better than another by more than chance, from their difference in each piece.

    Were they alike, each piece of the frame would speak for either with the same probability: the signed ranks of the
    differences (Wilcoxon, 1945) add up to more than z times the root of the sum of their squares with a probability of
    at most exp(-z^2 / 2) (Hoeffding), and of at most 3.18 times that of a normal variable; the smaller one counts.
    Ranks, for a few pieces may differ much where one place lies beside a road, while most differ little.
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
