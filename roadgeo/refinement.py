"""Refinement of a homography to the map's accuracy: road points and matched intersections against the reference."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roadgeo.index import ReferenceIndex
from roadgeo.kernels.roads import normal_equations
from roadgeo.scene import Scene
from roadgeo.typing import FloatArray, IntArray

__all__ = ["Refined", "RefineOptions", "refine"]


@dataclass(frozen=True)
class RefineOptions:
    """How points are weighted.

    Attributes
    ----------
    radii_m : tuple of float
        Search radius for the nearest road, one per iteration.
    cauchy_m : float
        Scale of the Cauchy weights.
    intersection_weight : float
        Weight of a matched intersection against a road point: its centre is less certain, but it counts in two directions.
    max_turn_deg : float
        Roads count as partners when their directions differ by less.
    correlation_m : float
        Errors of the map and of the mask keep their sign over about this length of road; points closer than that are no
        independent observations.
    sigma_floor_m : float
        Accuracy of the map as a whole, which no number of points improves.
    """

    radii_m: tuple[float, ...] = (30.0,) * 12
    cauchy_m: float = 1.5
    intersection_weight: float = 0.3
    max_turn_deg: float = 25.0
    perspective_sigma: float = 0.5
    correlation_m: float = 60.0
    sigma_floor_m: float = 0.3


@dataclass(frozen=True)
class Refined:
    """A refined homography (3, 3), query plane to reference plane, the (4,) standard deviations of the frame's corners in metres,
    and the robust rms distance of road points from the map's roads."""

    matrix: FloatArray
    corner_sigma_m: FloatArray
    rms_m: float


def _parameters(matrix: FloatArray, center: FloatArray, half_size: float) -> tuple[FloatArray, FloatArray, float]:
    """Normalise: return the eight parameters of `kernels.growth`, the reference point under the middle, and the unit in metres."""
    mapped = matrix @ (center[0], center[1], 1.0)
    origin = mapped[:2] / mapped[2]
    linear = (matrix[:2, :2] - np.outer(origin, matrix[2, :2])) / mapped[2]
    unit = half_size * float(np.sqrt(abs(np.linalg.det(linear))))
    to_query = np.array([[half_size, 0.0, center[0]], [0.0, half_size, center[1]], [0.0, 0.0, 1.0]])
    from_reference = np.array([[1.0, 0.0, -origin[0]], [0.0, 1.0, -origin[1]], [0.0, 0.0, unit]])
    p = from_reference @ matrix @ to_query
    return (p / p[2, 2]).ravel()[:8], origin, unit


def _matrix(p: FloatArray, center: FloatArray, half_size: float, origin: FloatArray, unit: float) -> FloatArray:
    """Undo `_parameters`."""
    from_query = np.array([[1.0, 0.0, -center[0]], [0.0, 1.0, -center[1]], [0.0, 0.0, half_size]])
    to_reference = np.array([[unit, 0.0, origin[0]], [0.0, unit, origin[1]], [0.0, 0.0, 1.0]])
    matrix = to_reference @ np.append(p, 1.0).reshape(3, 3) @ from_query
    return np.asarray(matrix / half_size)


def _rows(p: FloatArray, uv: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return predicted points (M, 2) and their derivatives (M, 2, 8) at normalised query points (M, 2)."""
    w = 1.0 + uv @ p[6:8]
    xy = np.stack([uv @ p[0:2] + p[2], uv @ p[3:5] + p[5]], axis=1) / w[:, None]
    rows = np.zeros((len(uv), 2, 8))
    for axis in range(2):
        rows[:, axis, 3 * axis] = uv[:, 0] / w
        rows[:, axis, 3 * axis + 1] = uv[:, 1] / w
        rows[:, axis, 3 * axis + 2] = 1.0 / w
        rows[:, axis, 6] = -xy[:, axis] * uv[:, 0] / w
        rows[:, axis, 7] = -xy[:, axis] * uv[:, 1] / w
    return xy, rows


def _correlated_points(scene: Scene, unit: float, options: RefineOptions) -> float:
    """Return how many road points share one error."""
    spacing = scene.road_length_px * unit / scene.half_size / max(len(scene.points), 1)
    return max(1.0, options.correlation_m / max(spacing, 1e-6))


def _intersection_equations(
    p: FloatArray,
    uv: FloatArray,
    target: FloatArray,
    unit: float,
    radius_m: float,
    options: RefineOptions,
    prior_weight: float,
) -> tuple[FloatArray, FloatArray]:
    """Return the Gauss-Newton system (8, 8), (8,) of the matched intersections and the perspective prior."""
    xy, rows = _rows(p, uv)
    gap = target - xy
    far = np.hypot(*gap.T) * unit
    weight = np.where(
        far < radius_m, options.intersection_weight / (1.0 + (far / (2 * options.cauchy_m)) ** 2), 0.0
    )
    normal = np.einsum("n,nai,naj->ij", weight, rows, rows) + 1e-9 * np.eye(8)
    right = np.einsum("n,nai,na->i", weight, rows, gap)
    normal[6, 6] += prior_weight
    normal[7, 7] += prior_weight
    right[6:8] -= prior_weight * p[6:8]
    return normal, right


def refine(
    matrix: FloatArray, scene: Scene, index: ReferenceIndex, matched: IntArray, options: RefineOptions | None = None
) -> Refined:
    """Gauss-Newton on the eight parameters with Cauchy weights.

    Parameters
    ----------
    matrix : (3, 3)
        Query plane to reference plane, right to a few metres.
    matched : (N,) int
        Map intersection of each query intersection, or -1.
    """
    options = options or RefineOptions()
    center, half_size = scene.center, scene.half_size
    p, origin, unit = _parameters(matrix, center, half_size)
    chosen = matched >= 0
    uv = (scene.intersections.xy[chosen] - center) / half_size
    target = (index.xy[matched[chosen]] - origin) / unit
    min_cos = float(np.cos(np.radians(options.max_turn_deg)))
    prior_weight = (options.cauchy_m / unit / options.perspective_sigma) ** 2
    point_weight = 1.0 / _correlated_points(scene, unit, options)
    squares, weights = 0.0, 1.0
    normal, right = _intersection_equations(p, uv, target, unit, options.radii_m[0], options, prior_weight)
    used = 0
    for radius in options.radii_m:
        # Points further off than their search radius would meet the wrong road: take them only where the fit is sure.
        factor = np.linalg.cholesky(normal)
        roads, pull = np.zeros((8, 8)), np.zeros(8)
        before, used = used, 0
        used, weights, squares = normal_equations(
            _matrix(p, center, half_size, origin, unit), center[0], center[1], half_size, unit, origin[0], origin[1],
            scene.points, scene.directions, radius, min_cos, options.cauchy_m, factor,
            index.segments, index.segment_starts, index.segment_ids, index.grid, index.shape, roads, pull,
        )  # fmt: skip
        normal, right = _intersection_equations(p, uv, target, unit, radius, options, prior_weight)
        normal += point_weight * roads
        right += point_weight * pull
        step = np.linalg.solve(normal, right)
        p = p + step
        if np.abs(step).max() * unit < 0.02 and used <= before:
            break
    rms = float(np.sqrt(squares / max(weights, 1e-9)))
    result = _matrix(p, center, half_size, origin, unit)
    covariance = np.linalg.inv(normal) * (rms / unit) ** 2
    _, rows = _rows(p, (scene.corners - center) / half_size)
    variance = np.einsum("nai,ij,naj->n", rows, covariance, rows) / 2.0 * unit**2
    return Refined(result / result[2, 2], np.sqrt(variance + options.sigma_floor_m**2), rms)
