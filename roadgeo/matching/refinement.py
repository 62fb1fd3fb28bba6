"""Refinement of a homography to the map's accuracy: road points and matched intersections against the reference."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from roadgeo._arrays import BoolArray, FloatArray, IntArray
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.lens import Lens
from roadgeo.geometry.uncertainty import corner_sigmas
from roadgeo.kernels.adjustment import adjust, meet_roads
from roadgeo.kernels.parallel_roads import roads_alongside
from roadgeo.kernels.roads import road_residuals
from roadgeo.kernels.structs import AdjustLimits, Held, Met, Plane, PointPairs, RoadSamples
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.scene import APART_M, LEAST_SHARE, MIN_COS, N_ROUGHLY, NOTICEABLE, Scene, and_pixels, at_least

__all__ = [
    "TOLERANCE_M",
    "Equations",
    "RefineOptions",
    "Refined",
    "between_carriageways",
    "denormalise",
    "nearest_of",
    "normalise",
    "points_on_map",
    "refine",
    "refine_between",
    "weight_on_roads",
]


#: Standard deviation of a road point across the road, the map's in metres and the mask's in pixels, and scale of the
#: Cauchy weights.
_SIGMA_M, _SIGMA_PX = 1.2, 0.9
#: Weight of a matched intersection relative to an independent road point, for its centre is less certain.
_INTERSECTION_WEIGHT = 0.3
#: Cells of the frame a side.
_N_CELLS = 8
#: Rms of road points in units of their standard deviation. Where it is more, the mask is bent: its errors are not only
#: greater, they keep their sign as much further. Fitted to the corners of training masks.
_USUAL_RMS = 0.7
#: How far off a homography that is held near its start may be, metres. With fewer matches it is held: they
#: alone would not determine a homography, and the start would be forgotten.
_HELD_M, _FEW_MATCHES = 5.0, 8
#: Iterations, which end where nothing moves by more, metres.
_N_ITERATIONS, TOLERANCE_M = 15, 0.02
#: Accuracy of the map, metres, and of the mask, pixels, as a whole, which no number of points improves: lines are drawn
#: and thinned to whole pixels. Fitted to the corners of training masks.
_SIGMA_FLOOR = (0.1, 0.15)
#: Prior standard deviation of k1.
_K1_SIGMA = 0.1


@dataclass(frozen=True)
class RefineOptions:
    """How points are weighted.

    Attributes
    ----------
    perspective_sigma : float
        Prior standard deviation of the two perspective parameters.
    least_share : float
        A cell of the frame takes part when at least this share of its road points meet roads.
    max_radius : (float, float)
        Points whose place is less sure than a third of the sum of metres and pixels do not take part yet.
    """

    perspective_sigma: float = 0.5
    least_share: float = 0.5
    max_radius: tuple[float, float] = and_pixels(20.0)


@dataclass(frozen=True)
class Refined:
    """A refined homography and its accuracy.

    Attributes
    ----------
    matrix : (3, 3) float64
        Query plane to reference plane.
    rms_m : float
        Robust root mean square of the road points' distances from the map's roads, metres.
    corner_covariance_m2 : (8, 8) float64
        Covariance of the corners' x and y, in the order x, y of the first, x, y of the second, and so on.
    lens_k1, k1_sigma : float
        Radial distortion whose removal makes the query plane a pinhole's (see `geometry.lens`), and its standard
        deviation; 0 without a lens.
    share : float
        Share of the road points that lie on roads.
    """

    matrix: FloatArray
    rms_m: float
    corner_covariance_m2: FloatArray
    lens_k1: float
    k1_sigma: float
    share: float

    @property
    def corner_sigma_m(self) -> FloatArray:
        """Standard deviations of the frame's corners: root mean squares of their distances from the truth, (4,)."""
        return corner_sigmas(self.corner_covariance_m2)


def normalise(matrix: FloatArray, center: FloatArray, half_size: float) -> tuple[FloatArray, FloatArray, float]:
    """Normalise a homography.

    Return the eight parameters (see `kernels.adjustment`), the reference point under the middle, and the unit in
    metres.
    """
    homography = Homography(matrix)
    origin = homography.everywhere(center)
    unit = half_size * math.sqrt(abs(homography.area_scale(*center.tolist())))
    to_query = np.array([[half_size, 0.0, center[0]], [0.0, half_size, center[1]], [0.0, 0.0, 1.0]])
    from_reference = np.array([[1.0, 0.0, -origin[0]], [0.0, 1.0, -origin[1]], [0.0, 0.0, unit]])
    p = from_reference @ matrix @ to_query
    return (p / p[2, 2]).ravel()[:8], origin, unit


def denormalise(p: FloatArray, center: FloatArray, half_size: float, origin: FloatArray, unit: float) -> FloatArray:
    """Undo `normalise`."""
    from_query = np.array([[1.0, 0.0, -center[0]], [0.0, 1.0, -center[1]], [0.0, 0.0, half_size]])
    to_reference = np.array([[unit, 0.0, origin[0]], [0.0, unit, origin[1]], [0.0, 0.0, 1.0]])
    matrix = to_reference @ np.append(p, 1.0).reshape(3, 3) @ from_query
    return np.asarray(matrix / half_size)


class Equations:
    """Least-squares equations of a scene's road points on a map, for a homography and a lens.

    Attributes
    ----------
    p : (9,) float64
        The parameters (see `kernels.adjustment`).
    unit : float
        Metres per normalised unit of the reference plane.
    weight : float
        Weight of a road point, relative to an independent observation of `sigma_m` in the middle of the frame.
    prior : (9,) float64
        Weights that hold parameters near zero.
    met : Met
        The roads that the points met last.
    """

    def __init__(
        self,
        matrix: FloatArray,
        scene: Scene,
        index: ReferenceIndex,
        options: RefineOptions,
        k1: float | None = None,
        step: int = 1,
    ) -> None:
        """Use each `step`-th road point. Without a `k1` the camera stays a pinhole."""
        self.scene, self.options, self.roads = scene, options, index.road_buckets
        p, self._origin, self.unit = normalise(matrix, scene.center, scene.half_size)
        self.p, free = np.array([*p, k1 or 0.0]), 8 if k1 is None else 9
        self.gsd = gsd = self.unit / scene.half_size
        self.sigma_m = math.hypot(_SIGMA_M, _SIGMA_PX * gsd)
        self.prior = np.zeros(9)
        self.prior[6:8] = (self.sigma_m / self.unit / options.perspective_sigma) ** 2
        self.prior[8] = (self.sigma_m / self.unit / _K1_SIGMA) ** 2
        spacing_m = scene.road_length_px * gsd / max(len(scene.points), 1)
        self.weight = min(1.0, spacing_m * step / APART_M)
        xy, along, cells = _samples(scene, step)
        half_side = max(scene.size) / 2.0 / scene.half_size
        self.samples = RoadSamples(xy, along, cells, self.weight, half_side)
        self._plane = Plane(self.unit, *self._origin.tolist())
        self._limits = AdjustLimits(
            _N_CELLS**2, options.least_share, options.max_radius[0] + options.max_radius[1] * gsd,
            MIN_COS, self.sigma_m, _SIGMA_M, _SIGMA_PX / scene.half_size, self.prior, _N_ITERATIONS, TOLERANCE_M,
        )  # fmt: skip
        n = len(xy)
        self.met = Met(np.empty((n, free)), np.full(n, np.nan), np.ones(n), np.empty(n), np.empty(n, np.bool_))

    @property
    def homography(self) -> Homography:
        """The normalised homography."""
        return Homography(np.array([*self.p[:8], 1.0]).reshape(3, 3))

    def normalised(self, points: FloatArray) -> FloatArray:
        """Normalise points (N, 2) of the query plane."""
        return np.asarray((points - self.scene.center) / self.scene.half_size)

    def places(self, points: FloatArray) -> FloatArray:
        """Return where normalised points (N, 2) come to lie on the map, normalised."""
        straight = Lens(float(self.p[8]), (0.0, 0.0), self.samples.half_side).straighten(points)
        return self.homography.everywhere(straight)

    def pairs(self, xy: FloatArray, places: FloatArray, weight: float) -> PointPairs:
        """Return points (N, 2) of the query plane that belong at places (N, 2) of the map."""
        query = self.normalised(xy)
        return PointPairs(query, (places - self._origin) / self.unit, _cells(query), weight)

    def meet(self) -> BoolArray:
        """Find the roads near all points; return which points (S,) met a road."""
        n = self.met.rows.shape[1]
        meet_roads(self.p, self._plane, self.samples, self._limits, self.roads, np.zeros((n, n)), self.met)
        return np.isfinite(self.met.residuals)

    @property
    def cauchy(self) -> FloatArray:
        """Weights (S,) that keep outliers from a fit; NaN of points that met no road."""
        return np.asarray(1.0 / (1.0 + (self.met.residuals / self.met.sigmas) ** 2))

    def adjust(self, pairs: PointPairs, held: Held) -> Refined | None:
        """Fit the parameters to roads and points (see `kernels.adjustment.adjust`); return None if the fit fails."""
        n = self.met.rows.shape[1]
        normal = np.empty((n, n))
        used, rms = adjust(self.p, self._plane, self.samples, pairs, held, self._limits, self.roads, normal, self.met)
        if not np.isfinite(rms):
            return None
        normal = normal + normal.T  # only the lower triangle was filled
        normal.flat[:: n + 1] *= 0.5
        # Where the mask is bent, larger errors are correlated over proportionally longer roads.
        scatter = rms * max(1.0, rms / (_USUAL_RMS * self.sigma_m)) / self.unit
        covariance = np.asarray(np.linalg.inv(normal) * scatter**2, float)
        corners = self.corner_covariance(covariance[:8, :8])
        matrix = denormalise(self.p[:8], self.scene.center, self.scene.half_size, self._origin, self.unit)
        k1_sigma = math.sqrt(max(float(covariance[8, 8]), 0.0)) if n == 9 else 0.0
        k1, share = float(self.p[8]), used / max(len(self.samples.xy), 1)
        return Refined(matrix / matrix[2, 2], rms, corners, k1, k1_sigma, share)

    def corner_covariance(self, covariance: FloatArray) -> FloatArray:
        """Return the covariance (8, 8) of the frame's corners, square metres, from the homography's (8, 8)."""
        derivatives = self.homography.by_elements(self.normalised(self.scene.corners)).reshape(8, 8)
        floor = _SIGMA_FLOOR[0] ** 2 + (_SIGMA_FLOOR[1] * self.gsd) ** 2
        return np.asarray(derivatives @ covariance @ derivatives.T * self.unit**2 + 0.5 * floor * np.eye(8))


@lru_cache(maxsize=8)
def _samples(scene: Scene, step: int) -> tuple[FloatArray, FloatArray, IntArray]:
    """Return each `step`-th road point (S, 2), normalised, the road's direction there (S, 2), and its cell (S,)."""
    xy = (scene.points[::step] - scene.center) / scene.half_size
    return xy, np.ascontiguousarray(scene.directions[::step]), _cells(xy)


def _cells(uv: FloatArray) -> IntArray:
    """Return the number of the frame's cell that each normalised point lies in."""
    n = _N_CELLS
    columns = np.clip(((uv + 1.0) * (n / 2.0)).astype(np.int64), 0, n - 1)
    return np.asarray(columns[:, 1] * n + columns[:, 0])


@lru_cache(maxsize=4)
def _grid(n: int) -> FloatArray:
    """Return n x n normalised points over the frame, (n * n, 2)."""
    side = np.linspace(-0.7, 0.7, n)
    return np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)


def weight_on_roads(matrix: FloatArray, scene: Scene, index: ReferenceIndex) -> float:
    """Return the sum of the Cauchy weights of road points under a homography."""
    equations = Equations(matrix, scene, index, RefineOptions())
    equations.meet()
    return float(np.nansum(equations.cauchy))


def refine(
    matrix: FloatArray,
    scene: Scene,
    index: ReferenceIndex,
    matched: IntArray,
    options: RefineOptions | None = None,
    n_points: int | None = None,
    held: bool = False,
) -> Refined | None:
    """Adjust a homography by Gauss-Newton with Cauchy weights; return None if the adjustment fails.

    Parameters
    ----------
    matrix : (3, 3)
        Query plane to reference plane, right to some metres over part of the frame.
    matched : (N,) int
        Map intersection of each query intersection, or -1.
    n_points : int, optional
        Use about this number of the scene's road points.
    held : bool
        Hold the homography near its start even with enough matches: it is right all over the frame.
    """
    step = 1 if n_points is None else max(1, len(scene.points) // n_points)
    equations = Equations(matrix, scene, index, options or RefineOptions(), step=step)
    # Isolated matches are probably accidental.
    chosen = matched >= 0
    around = scene.neighbours[chosen]
    support = ((matched[around] >= 0) & (around >= 0)).sum(axis=1) / np.maximum((around >= 0).sum(axis=1), 1)
    chosen[chosen] = support >= LEAST_SHARE
    pairs = equations.pairs(scene.intersections.xy[chosen], index.xy[matched[chosen]], _INTERSECTION_WEIGHT)
    grid = _grid(6 if held or len(pairs.query) < _FEW_MATCHES else 0)
    weight = 8.0 / 36.0 * (equations.sigma_m / at_least(_HELD_M, equations.gsd)) ** 2
    return equations.adjust(pairs, Held(grid, equations.places(grid), weight))


# --- carriageways -----------------------------------------------------------------------------------------------------
#
# Where a mask shows two roads and the map a single road between them, both are equally near to the map's road. A fit to
# either is off by half their distance, with too small a standard deviation. So their middle line is fitted.

#: Two roads at these distances, metres, are a single road on the map if their nearest points on the map lie within this
#: part of their distance from each other.
_SIDE_BY_SIDE_M, _MERGED = (3.0, 30.0), 0.35
#: The nearest point beside a road point lies within half the step along the road, or a little more.
_BESIDE = 0.55
#: Intersections within this multiple of the step belong to such a road: the map has them in the middle too.
_NEAR = 2.0
#: The middle depends on the fit, and the fit on the middle: first some points are used, then all.
_ROUNDS = (N_ROUGHLY, None)


def refine_between(
    refined: Refined, scene: Scene, index: ReferenceIndex, matched: IntArray, options: RefineOptions
) -> tuple[Refined, Scene]:
    """Refine a homography again if the map has a single road for two roads of the mask.

    Returns the homography and the scene with road points between the two. Returns both unchanged if such points are
    few, or if no more points lie on roads afterwards: a false road beside a true road looks alike.
    """
    best, best_scene = refined, scene
    for n_points in _ROUNDS:
        moved, left = between_carriageways(best.matrix, scene, index, matched)
        again = None if moved is scene else refine(best.matrix, moved, index, left, options, n_points, held=True)
        if again is None:
            return refined, scene
        best, best_scene = again, moved
    before = weight_on_roads(refined.matrix, scene, index)
    better = weight_on_roads(best.matrix, best_scene, index) >= before
    return (best, best_scene) if better else (refined, scene)


def between_carriageways(
    matrix: FloatArray, scene: Scene, index: ReferenceIndex, matched: IntArray
) -> tuple[Scene, IntArray]:
    """Return the scene with road points halfway between two roads that the map has as one; the scene itself if few.

    Matches (N,) of intersections at such points become -1.
    """
    if not len(scene.points):
        return scene, matched
    at, along, gsd = points_on_map(matrix, scene)
    across, step_px = np.empty_like(at), scene.road_length_px / len(at)
    roads_alongside(at, along, _BESIDE * step_px * gsd, *_SIDE_BY_SIDE_M, MIN_COS, across)
    apart = np.hypot(*across.T)
    reach = np.where(np.isfinite(apart), apart, 0.0) + _SIDE_BY_SIDE_M[0]
    feet = [_nearest(start, along, reach, index) for start in (at, at + across)]
    merged = np.hypot(*(feet[0] - feet[1]).T) < _MERGED * apart  # False for NaN
    if merged.mean() < NOTICEABLE:
        return scene, matched
    points = scene.points.copy()
    points[merged] = Homography(matrix).inverse().everywhere(at[merged] + 0.5 * across[merged])
    there = nearest_of(scene.intersections.xy, scene.points, np.flatnonzero(merged), _NEAR * step_px) >= 0
    return replace(scene, points=points), np.where(there, -1, matched)


def _nearest(at: FloatArray, along: FloatArray, reach: FloatArray, index: ReferenceIndex) -> FloatArray:
    """Return the nearest points (S, 2) on roads of the map that run along points (S, 2); NaN beyond `reach` (S,)."""
    feet = np.empty((len(at), 3))
    road_residuals(np.eye(3), np.ascontiguousarray(at), along, reach, MIN_COS, index.road_buckets, feet)
    return np.asarray(at + feet[:, :1] * feet[:, 1:])


def nearest_of(xy: FloatArray, points: FloatArray, among: IntArray, away: float) -> IntArray:
    """Return the number of the nearest of `points` (S, 2), `among` these, to each of `xy` (N, 2), or -1: too far."""
    nearest, least = np.full(len(xy), -1), np.full(len(xy), away**2)
    for number in among:
        square = ((xy - points[number]) ** 2).sum(axis=1)
        closer = square < least
        nearest[closer], least[closer] = number, square[closer]
    return nearest


def points_on_map(matrix: FloatArray, scene: Scene) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return road points on the map (S, 2), unit vectors along the roads (S, 2), and metres per pixel there (S,)."""
    to_map = Homography(matrix).facing(scene.center)
    points = np.ascontiguousarray(to_map(scene.points))
    ahead = to_map(scene.points + scene.directions) - points
    length = np.maximum(np.hypot(*ahead.T), 1e-12)
    return points, np.ascontiguousarray(ahead / length[:, None]), length
