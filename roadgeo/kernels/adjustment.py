"""Least-squares adjustment of a homography to matched intersections and to the roads of the map.

The parameters are those of `kernels.growth`: p = (h00 h01 h02 h10 h11 h12 h20 h21), h22 = 1, between normalised
coordinates, query (x - x0) / half_size and reference (X - X0) / unit.
"""

import math

import numpy as np
from numpy.typing import NDArray

from roadgeo.kernels.arrays import Floats1, Floats2, Int32s1, Ints1, Singles2
from roadgeo.kernels.compilation import kernel
from roadgeo.kernels.growth import cholesky, solve_cholesky
from roadgeo.kernels.roads import nearest_road

#: Steps of an adjustment in which points are held near their start.
_HELD_STEPS = 6

__all__ = ["add_row", "adjust", "point_row"]


@kernel()
def point_row(p: Floats1, u: float, v: float, axis_x: float, axis_y: float, row: Floats1) -> tuple[float, float, float]:
    """Differentiate a predicted point's component along (axis_x, axis_y) by the parameters `p` (8,).

    Parameters
    ----------
    u, v : float
        Normalised query point.
    row : (8,) float64
        Filled with the derivative.

    Returns
    -------
    x', y', w : float
        The point, normalised, and its denominator.
    """
    w = 1.0 + p[6] * u + p[7] * v
    x, y = (p[0] * u + p[1] * v + p[2]) / w, (p[3] * u + p[4] * v + p[5]) / w
    row[0], row[1], row[2] = axis_x * u / w, axis_x * v / w, axis_x / w
    row[3], row[4], row[5] = axis_y * u / w, axis_y * v / w, axis_y / w
    along = axis_x * x + axis_y * y
    row[6], row[7] = -along * u / w, -along * v / w
    return x, y, w


@kernel()
def add_row(
    normal: NDArray[np.float64],
    right: NDArray[np.float64],
    row: NDArray[np.float64],
    weight: float,
    residual: float,
) -> None:
    """Add the equation row . dp = residual to the lower triangle of the normal equations `normal` dp = `right`."""
    for r in range(8):
        scaled = weight * row[r]
        for c in range(r + 1):
            normal[r, c] += scaled * row[c]
        right[r] += scaled * residual


@kernel()
def adjust(
    p: Floats1,
    unit: float,
    origin_x: float,
    origin_y: float,
    points: Floats2,
    directions: Floats2,
    point_cells: Ints1,
    point_weight: float,
    pairs: Floats2,
    targets: Floats2,
    pair_cells: Ints1,
    pair_weight: float,
    held: Floats2,
    held_targets: Floats2,
    held_weight: float,
    n_cells: int,
    least_share: float,
    max_radius: float,
    min_cos: float,
    sigma_m: float,
    prior: float,
    n_iterations: int,
    tolerance_m: float,
    segments: Singles2,
    starts: Int32s1,
    ids: Int32s1,
    grid: tuple[float, float, float],
    shape: tuple[int, int],
    normal: Floats2,
) -> tuple[int, float]:
    """Adjust a homography by Gauss-Newton with Cauchy weights.

    The first step takes matched intersections, and points held where the map to be adjusted put them. Then a road
    point's residual is its distance across the nearest road of the map that runs its way. How far off it may be is
    predicted from the system so far: it is searched as far as three times that, and not at all beyond `max_radius`, so
    that the fit grows outwards from where it is sure. Where fewer than `least_share` of a cell's searched points meet a
    road, what does meet one is chance, and the cell waits.

    Parameters
    ----------
    p : (8,) float64
        Adjusted in place.
    unit, origin_x, origin_y : float
        Metres per normalised unit, and the reference point of the normalised (0, 0).
    points, directions : (S, 2) float64
        The query's road points, normalised, and unit vectors along the road.
    pairs, targets : (M, 2) float64
        Matched intersections in query and reference, normalised.
    point_cells : (S,) int64, pair_cells : (M,) int64
        The one of `n_cells` cells of the frame that each lies in.
    point_weight, pair_weight : float
        Of an observation, against one of standard deviation `sigma_m`.
    held, held_targets : (G, 2) float64
        Points that hold the fit near its start while little else does, normalised.
    held_weight : float
        As `point_weight`, of each, in the first step; half of it in the next, and so on, and none after `_HELD_STEPS`.
    max_radius, sigma_m, tolerance_m : float
        Metres. The iteration ends when no parameter moves by more than the tolerance.
    min_cos, segments, starts, ids, grid, shape
        As in `nearest_road`.
    prior : float
        Weight that holds the two perspective parameters near zero.
    normal : (8, 8) float64
        Filled with the last normal matrix.

    Returns
    -------
    n : int
        Road points that took part; -1 where the adjustment failed.
    rms : float
        Scale of their residuals, metres: its square times the inverse of `normal` is the covariance of an M-estimate
        (Huber 1981, 7.6), which a merely weighted rms would claim too small. inf where it failed or there are none.
    """
    right = np.empty(8)
    row = np.empty(8)
    work = np.empty(8)
    factor = np.zeros((8, 8))
    n = points.shape[0]
    met = np.empty(n, np.bool_)
    normals = np.empty((n, 2))
    residuals = np.empty(n)
    sigmas = np.empty(n)
    searched = np.empty(n_cells)
    hits = np.empty(n_cells)
    shares = np.ones(n_cells)
    previous = -1
    rms = np.inf
    for iteration in range(n_iterations + 1):
        normal[:] = 0.0
        right[:] = 0.0
        for r in range(8):
            normal[r, r] = 1e-9
        for r in range(6, 8):
            normal[r, r] += prior
            right[r] -= prior * p[r]
        for i in range(pairs.shape[0]):
            if shares[pair_cells[i]] < least_share:
                continue
            for axis in range(2):
                x, y, w = point_row(p, pairs[i, 0], pairs[i, 1], 1.0 - axis, 1.0 * axis, row)
                if w < 0.02:
                    return -1, np.inf
                dx, dy = targets[i, 0] - x, targets[i, 1] - y
                far = math.sqrt(dx * dx + dy * dy) * unit
                if far > max_radius:
                    continue
                weight = pair_weight / (1.0 + (far / (2.0 * sigma_m)) ** 2)
                add_row(normal, right, row, weight, dx if axis == 0 else dy)
        if iteration < _HELD_STEPS:
            for i in range(held.shape[0]):
                for axis in range(2):
                    x, y, w = point_row(p, held[i, 0], held[i, 1], 1.0 - axis, 1.0 * axis, row)
                    if w < 0.02:
                        return -1, np.inf
                    residual = held_targets[i, 0] - x if axis == 0 else held_targets[i, 1] - y
                    add_row(normal, right, row, held_weight * 0.5**iteration, residual)
        used, weights, slopes, squares = 0, 0.0, 0.0, 0.0
        if iteration > 0:
            searched[:] = 0.0
            hits[:] = 0.0
            for i in range(n):
                met[i] = False
                u, v = points[i, 0], points[i, 1]
                w = 1.0 + p[6] * u + p[7] * v
                if w < 0.02:
                    return -1, np.inf
                x, y = (p[0] * u + p[1] * v + p[2]) / w, (p[3] * u + p[4] * v + p[5]) / w
                dw = p[6] * directions[i, 0] + p[7] * directions[i, 1]
                dx = p[0] * directions[i, 0] + p[1] * directions[i, 1] - x * dw
                dy = p[3] * directions[i, 0] + p[4] * directions[i, 1] - y * dw
                length = math.sqrt(dx * dx + dy * dy)
                if length == 0.0:
                    continue
                dx /= length
                dy /= length
                point_row(p, u, v, -dy, dx, row)
                spread = 0.0
                for r in range(8):  # |L^-1 row|^2
                    value = row[r]
                    for c in range(r):
                        value -= factor[r, c] * work[c]
                    work[r] = value / factor[r, r]
                    spread += work[r] * work[r]
                sigma = sigma_m * math.sqrt(1.0 + spread)
                if 3.0 * sigma > max_radius:
                    continue
                searched[point_cells[i]] += 1.0
                gx, gy = origin_x + unit * x, origin_y + unit * y
                d, fx, fy, rx, ry = nearest_road(
                    gx, gy, dx, dy, 3.0 * sigma, min_cos, segments, starts, ids, grid, shape
                )
                if d == np.inf:
                    continue
                met[i] = True
                hits[point_cells[i]] += 1.0
                normals[i, 0], normals[i, 1] = -ry, rx
                residuals[i] = (fx - gx) * -ry + (fy - gy) * rx
                sigmas[i] = sigma
            for c in range(n_cells):
                shares[c] = hits[c] / searched[c] if searched[c] > 0.0 else 1.0
            for i in range(n):
                if not met[i] or shares[point_cells[i]] < least_share:
                    continue
                point_row(p, points[i, 0], points[i, 1], normals[i, 0], normals[i, 1], row)
                weight = 1.0 / (1.0 + (residuals[i] / sigmas[i]) ** 2)
                add_row(normal, right, row, point_weight * weight, residuals[i] / unit)
                used += 1
                weights += weight
                slopes += weight * (2.0 * weight - 1.0)  # of the influence, by the residual
                squares += (weight * residuals[i]) ** 2
            if weights > 0.0:
                rms = math.sqrt(squares * weights) / max(slopes, 0.1 * weights)
        for r in range(8):
            for c in range(r):
                normal[c, r] = normal[r, c]
        if not cholesky(normal, factor):
            return -1, np.inf
        solve_cholesky(factor, right)
        largest = 0.0
        for r in range(8):
            p[r] += right[r]
            largest = max(largest, abs(right[r]))
        if iteration > (1 if held.shape[0] == 0 else _HELD_STEPS) and largest * unit < tolerance_m and used <= previous:
            break
        previous = used
    return previous, rms
