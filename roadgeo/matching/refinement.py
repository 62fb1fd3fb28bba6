"""Refinement of a homography to the map's accuracy: road points and matched intersections against the reference."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from roadgeo._arrays import FloatArray, IntArray
from roadgeo.geometry.homography import Homography
from roadgeo.kernels.adjustment import adjust
from roadgeo.kernels.structs import AdjustLimits, Held, Plane, PointPairs, RoadSamples
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.scene import MIN_COS, Scene

__all__ = [
    "SIGMA_M",
    "SIGMA_PX",
    "TOLERANCE_M",
    "RefineOptions",
    "Refined",
    "corner_covariance",
    "corner_sigmas",
    "denormalise",
    "max_radius_m",
    "normalise",
    "point_weight",
    "refine",
    "robust_rms",
    "scatter_m",
]


#: Points whose place is less sure than a third of the sum of metres and pixels do not take part yet.
_MAX_RADIUS = (20.0, 10.0)
#: Standard deviation of a road point across the road, the map's in metres and the mask's in pixels, and scale of the
#: Cauchy weights.
SIGMA_M, SIGMA_PX = 1.2, 0.9
#: Weight of a matched intersection against an independent road point: its centre is less certain. Matches take part
#: when at least this share of their neighbours are matched.
_INTERSECTION_WEIGHT, _LEAST_SUPPORT = 0.3, 0.3
#: Cells of the frame a side.
_N_CELLS = 8
#: Errors of the map and of the mask keep their sign over about this length of road, metres: points closer than that are
#: no independent observations.
_CORRELATION_M = 60.0
#: Rms of road points in units of their standard deviation. Where it is more, the mask is bent: its errors are not only
#: greater, they keep their sign as much further. Fitted to the corners of training masks.
_USUAL_RMS = 0.7
#: How far off a homography that is held near its start may be, metres and pixels. With fewer matches it is held: they
#: alone would not determine a homography, and the start would be forgotten.
_HELD, _FEW_MATCHES = (5.0, 3.0), 8
#: Iterations, which end where nothing moves by more, metres.
_N_ITERATIONS, TOLERANCE_M = 15, 0.02


@dataclass(frozen=True)
class RefineOptions:
    """How points are weighted.

    Attributes
    ----------
    perspective_sigma : float
        Prior standard deviation of the two perspective parameters.
    least_share : float
        A cell of the frame takes part when at least this share of its road points meet roads.
    sigma_floor_m, sigma_floor_px : float
        Accuracy of the map and of the mask as a whole, which no number of points improves: lines are drawn and thinned
        to whole pixels. Fitted to the corners of training masks.
    """

    perspective_sigma: float = 0.5
    least_share: float = 0.5
    sigma_floor_m: float = 0.1
    sigma_floor_px: float = 0.15


@dataclass(frozen=True)
class Refined:
    """A refined homography and its accuracy.

    Attributes
    ----------
    matrix : (3, 3) float64
        Query plane to reference plane.
    corner_sigma_m : (4,) float64
        Standard deviations of the frame's corners: root mean squares of their distances from the truth.
    rms_m : float
        Of the road points' distances from the map's roads, robustly.
    corner_covariance_m2 : (8, 8) float64
        Of the corners' x and y, in the order x, y of the first, x, y of the second, and so on.
    lens_k1 : float
        Of the lens behind which the query plane is that of a pinhole (see `geometry.lens`); 0 without one.
    """

    matrix: FloatArray
    corner_sigma_m: FloatArray
    rms_m: float
    corner_covariance_m2: FloatArray
    lens_k1: float = 0.0


def normalise(matrix: FloatArray, center: FloatArray, half_size: float) -> tuple[FloatArray, FloatArray, float]:
    """Normalise a homography.

    Return the eight parameters (see `kernels.homography_fit`), the reference point under the middle, and the unit in
    metres.
    """
    homography = Homography(matrix)
    origin = homography.everywhere(center)
    unit = half_size * float(np.sqrt(abs(np.linalg.det(homography.jacobian(center)))))
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


def max_radius_m(gsd: float) -> float:
    """Return how sure the place of a point must be, times three."""
    return _MAX_RADIUS[0] + _MAX_RADIUS[1] * gsd


def point_weight(scene: Scene, unit: float, step: int = 1) -> float:
    """Return the weight of each `step`-th road point against an independent one."""
    spacing_m = scene.road_length_px * unit / scene.half_size / max(len(scene.points), 1)
    return min(1.0, spacing_m * step / _CORRELATION_M)


def _cells(uv: FloatArray) -> IntArray:
    """Return the number of the frame's cell that each normalised point lies in."""
    n = _N_CELLS
    columns = np.clip(((uv + 1.0) * (n / 2.0)).astype(np.int64), 0, n - 1)
    return np.asarray(columns[:, 1] * n + columns[:, 0])


def corner_covariance(
    p: FloatArray, covariance: FloatArray, scene: Scene, unit: float, options: RefineOptions
) -> FloatArray:
    """Return the covariance (8, 8) of the frame's corners, square metres (see `Refined`), from that of `p` (8, 8)."""
    homography = Homography(np.append(p, 1.0).reshape(3, 3))
    derivatives = homography.by_elements((scene.corners - scene.center) / scene.half_size).reshape(8, 8)
    floor = options.sigma_floor_m**2 + (options.sigma_floor_px * unit / scene.half_size) ** 2
    return np.asarray(derivatives @ covariance @ derivatives.T * unit**2 + 0.5 * floor * np.eye(8))


def scatter_m(rms: float, sigma_m: float) -> float:
    """Return the scatter in the covariance of a fit of road points of this rms and standard deviation, metres."""
    return rms * max(1.0, rms / (_USUAL_RMS * sigma_m))


def robust_rms(residuals: FloatArray, weights: FloatArray) -> float:
    """Return the scale of residuals (M,) with Cauchy weights: as of `kernels.adjustment.adjust`."""
    slopes = max(float((weights * (2.0 * weights - 1.0)).sum()), 0.1 * float(weights.sum()))
    return math.sqrt(float(((weights * residuals) ** 2).sum()) * float(weights.sum())) / slopes


def corner_sigmas(covariance: FloatArray) -> FloatArray:
    """Return the standard deviations (4,) of corners from their covariance (8, 8)."""
    return np.asarray(np.sqrt(np.diag(covariance).reshape(4, 2).sum(axis=1)))


@lru_cache(maxsize=4)
def _grid(n: int) -> FloatArray:
    """Return n x n normalised points over the frame, (n * n, 2)."""
    side = np.linspace(-0.7, 0.7, n)
    return np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)


def _held_points(p: FloatArray, n: int) -> tuple[FloatArray, FloatArray]:
    """Return n x n points over the frame that are held, and where `p` puts them."""
    uv = _grid(n)
    return uv, Homography(np.append(p, 1.0).reshape(3, 3)).everywhere(uv)


def refine(
    matrix: FloatArray,
    scene: Scene,
    index: ReferenceIndex,
    matched: IntArray,
    options: RefineOptions | None = None,
    n_points: int | None = None,
    held: bool = False,
) -> Refined | None:
    """Adjust a homography by Gauss-Newton with Cauchy weights; None where that fails.

    Parameters
    ----------
    matrix : (3, 3)
        Query plane to reference plane, right to some metres over part of the frame.
    matched : (N,) int
        Map intersection of each query intersection, or -1.
    n_points : int, optional
        Use about this number of the scene's road points.
    held : bool
        Hold the homography near its start also where there are matches enough: it is right all over the frame.
    """
    options = options or RefineOptions()
    center, half_size = scene.center, scene.half_size
    p, origin, unit = normalise(matrix, center, half_size)
    gsd = unit / half_size
    sigma_m = math.hypot(SIGMA_M, SIGMA_PX * gsd)
    chosen = matched >= 0
    step = 1 if n_points is None else max(1, len(scene.points) // n_points)
    points = (scene.points[::step] - center) / half_size
    # Isolated matches are probably accidental.
    around = scene.neighbours[chosen]
    support = ((matched[around] >= 0) & (around >= 0)).sum(axis=1) / np.maximum((around >= 0).sum(axis=1), 1)
    chosen[chosen] = support >= _LEAST_SUPPORT
    pairs = (scene.intersections.xy[chosen] - center) / half_size
    grid, targets = _held_points(p, 6 if held or len(pairs) < _FEW_MATCHES else 0)
    held_weight = 8.0 / 36.0 * (sigma_m / max(_HELD[0], _HELD[1] * gsd)) ** 2
    normal = np.empty((8, 8))
    limits = AdjustLimits(
        _N_CELLS**2, options.least_share, max_radius_m(gsd),
        MIN_COS, sigma_m, SIGMA_M, SIGMA_PX / half_size,
        (sigma_m / unit / options.perspective_sigma) ** 2, _N_ITERATIONS, TOLERANCE_M,
    )  # fmt: skip
    directions = np.ascontiguousarray(scene.directions[::step])
    weight = point_weight(scene, unit, step)
    places = (index.xy[matched[chosen]] - origin) / unit
    _, rms = adjust(
        p,
        Plane(unit, origin[0], origin[1]),
        RoadSamples(points, directions, _cells(points), weight),
        PointPairs(pairs, places, _cells(pairs), _INTERSECTION_WEIGHT),
        Held(grid, targets, held_weight),
        limits,
        index.road_buckets,
        normal,
    )
    if not np.isfinite(rms):
        return None
    inverse = np.asarray(np.linalg.inv(normal) * (scatter_m(rms, sigma_m) / unit) ** 2, float)
    result = denormalise(p, center, half_size, origin, unit)
    covariance = corner_covariance(p, inverse, scene, unit, options)
    return Refined(result / result[2, 2], corner_sigmas(covariance), rms, covariance)
