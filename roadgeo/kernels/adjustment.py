"""Least squares for a camera and its lens: a fit to points, to roads, or to both, and its covariance.

The model is a homography in normalised coordinates, query (x - x0) / half_size to reference (X - X0) / unit, `unit`
being half_size times the ground sampling there, so that it is near a rotation; before it, the lens of `geometry.lens`.
Its nine parameters are p = (h00 h01 h02 h10 h11 h12 h20 h21 k1), h22 = 1. A normal matrix of 8 x 8 leaves the lens as
it is. With few observations a prior on the perspective makes the model affine. The normal matrix predicts how far off
a new point may be.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from roadgeo.kernels.arrays import Floats1, Floats2
from roadgeo.kernels.compilation import kernel
from roadgeo.kernels.roads import nearest_road
from roadgeo.kernels.structs import AdjustLimits, Held, Met, Plane, PointPairs, RoadBuckets, RoadSamples

__all__ = [
    "LEAST_W",
    "add_point",
    "add_row",
    "adjust",
    "begin_system",
    "carry",
    "cholesky",
    "meet_roads",
    "own_sigma",
    "point_row",
    "solve_cholesky",
    "solve_system",
    "spread",
    "straighten",
]

#: Points nearer to the horizon than this w are not seen.
LEAST_W = 0.02
#: Steps of an adjustment in which points are held near their start.
_HELD_STEPS = 6
#: As in `geometry.lens`, and the greatest k1 of a fit.
_UNFOLDED, _NEWTON_STEPS, _MOST_K1 = 0.98, 8, 0.5


# --- normal equations -------------------------------------------------------------------------------------------------


@kernel()
def cholesky(matrix: NDArray[np.float64], factor: NDArray[np.float64]) -> bool:
    """Factorise a symmetric matrix; return whether it is positive definite.

    Parameters
    ----------
    matrix : (n, n) float64
        Only its lower triangle is read.
    factor : (n, n) float64
        Its lower triangle is filled with L, L L^T = matrix, and its diagonal with the reciprocals of L's: they divide.
    """
    n = matrix.shape[0]
    for i in range(n):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i == j:
                if not total > 1e-300:  # NaN neither
                    return False
                factor[i, i] = 1.0 / math.sqrt(total)
            else:
                factor[i, j] = total * factor[j, j]
    return True


@kernel()
def solve_cholesky(factor: NDArray[np.float64], right: NDArray[np.float64]) -> None:
    """Solve L L^T x = right, L (n, n) as left by `cholesky`; x replaces `right` (n,)."""
    n = factor.shape[0]
    for i in range(n):
        for k in range(i):
            right[i] -= factor[i, k] * right[k]
        right[i] *= factor[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            right[i] -= factor[k, i] * right[k]
        right[i] *= factor[i, i]


@kernel()
def add_row(
    normal: NDArray[np.float64],
    right: NDArray[np.float64],
    row: NDArray[np.float64],
    weight: float,
    residual: float,
) -> None:
    """Add the equation row . dp = residual to the lower triangle of the normal equations `normal` dp = `right`."""
    for r in range(right.shape[0]):
        scaled = weight * row[r]
        for c in range(r + 1):
            normal[r, c] += scaled * row[c]
        right[r] += scaled * residual


@kernel()
def begin_system(
    p: NDArray[np.float64], prior: NDArray[np.float64], normal: NDArray[np.float64], right: NDArray[np.float64]
) -> None:
    """Empty normal equations (n, n) and (n,) but for the weights `prior` (9,) that hold parameters near zero."""
    normal[:] = 0.0
    for r in range(right.shape[0]):
        normal[r, r] = 1e-9 + prior[r]
        right[r] = -prior[r] * p[r]


@kernel()
def solve_system(
    p: NDArray[np.float64], normal: NDArray[np.float64], right: NDArray[np.float64], factor: NDArray[np.float64]
) -> float:
    """Solve normal equations and move the parameters; return the largest move, -1 if the solution fails."""
    if not cholesky(normal, factor):
        return -1.0
    solve_cholesky(factor, right)
    largest = 0.0
    for r in range(right.shape[0]):
        p[r] += right[r]
        largest = max(largest, abs(right[r]))
    return largest


@kernel(forceinline=True)
def spread(row: NDArray[np.float64], factor: NDArray[np.float64], work: NDArray[np.float64]) -> float:
    """Return the variance of the value whose derivative is `row`, |L^-1 row|^2, L the factor of the step before."""
    total = 0.0
    for r in range(row.shape[0]):
        value = row[r]
        for c in range(r):
            value -= factor[r, c] * work[c]
        work[r] = value * factor[r, r]
        total += work[r] * work[r]
    return total


# --- the camera -------------------------------------------------------------------------------------------------------


@kernel()
def _radius(seen: float, k1: float) -> float:
    """Solve r (1 + k1 r^2) = seen, by Newton's method from where it converges."""
    if k1 < 0.0:
        farthest = _UNFOLDED / math.sqrt(-3.0 * k1)
        seen = min(seen, farthest * (1.0 + k1 * farthest**2))
    r = seen
    for _ in range(_NEWTON_STEPS):
        step = (r * (1.0 + k1 * r * r) - seen) / (1.0 + 3.0 * k1 * r * r)
        r -= step
        if abs(step) < 1e-12:
            break
    return r


@kernel(forceinline=True)
def straighten(
    k1: float, half_side: float, u: float, v: float, du: float, dv: float
) -> tuple[float, float, float, float, float, float, float]:
    """Return where a pinhole would have shown a point, and a direction there, unscaled; both are normalised.

    Besides them the derivative of the point by k1 (2), and by how much areas shrink. `half_side` is half of the
    frame's longer side, normalised: the unit of k1.
    """
    ou, ov = u / half_side, v / half_side
    seen = ou * ou + ov * ov
    if k1 == 0.0 or seen == 0.0:
        return u, v, du, dv, -u * seen, -v * seen, 1.0
    seen = math.sqrt(seen)
    r = _radius(seen, k1)
    scale, square = r / seen, r * r
    u, v = u * scale, v * scale
    across, outwards = 1.0 / (1.0 + k1 * square), 1.0 / (1.0 + 3.0 * k1 * square)
    along = (outwards - across) * (ou * du + ov * dv) / (seen * seen)
    mu, mv = -u * square * outwards, -v * square * outwards
    return u, v, across * du + along * ou, across * dv + along * ov, mu, mv, across * outwards


@kernel(forceinline=True)
def carry(
    p: NDArray[np.float64], u: float, v: float, du: float, dv: float
) -> tuple[float, float, float, float, float, float]:
    """Map a point as a pinhole shows it and a direction there; return x', y', w, the direction unscaled, its length.

    Near the horizon (w < 0.02) only w is meant.
    """
    w = 1.0 + p[6] * u + p[7] * v
    if not w >= LEAST_W:
        return 0.0, 0.0, w, 0.0, 0.0, 0.0
    x, y = (p[0] * u + p[1] * v + p[2]) / w, (p[3] * u + p[4] * v + p[5]) / w
    dw = p[6] * du + p[7] * dv
    dx = p[0] * du + p[1] * dv - x * dw
    dy = p[3] * du + p[4] * dv - y * dw
    return x, y, w, dx, dy, math.sqrt(dx * dx + dy * dy)


@kernel(writes=("row",))
def point_row(
    p: Floats1, u: float, v: float, moves: tuple[float, float], axis_x: float, axis_y: float, row: Floats1
) -> tuple[float, float, float]:
    """Differentiate a predicted point's component along (axis_x, axis_y) by the parameters `p`.

    Parameters
    ----------
    u, v : float
        Normalised query point, as a pinhole shows it.
    moves : (float, float)
        Its derivative by k1.
    row : (n,) float64
        Filled with the derivative by the first n parameters, 8 or 9.

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
    if row.shape[0] == 9:
        by_u, by_v = axis_x * p[0] + axis_y * p[3] - along * p[6], axis_x * p[1] + axis_y * p[4] - along * p[7]
        row[8] = (by_u * moves[0] + by_v * moves[1]) / w
    return x, y, w


@kernel()
def add_point(
    p: NDArray[np.float64],
    half_side: float,
    point: tuple[float, float],
    place: tuple[float, float],
    weight: float,
    normal: NDArray[np.float64],
    right: NDArray[np.float64],
    row: NDArray[np.float64],
) -> float:
    """Add the two equations of a query point that belongs at a place, both normalised; return its w."""
    u, v, _, _, mu, mv, _ = straighten(p[8], half_side, point[0], point[1], 0.0, 0.0)
    x, y, w = point_row(p, u, v, (mu, mv), 1.0, 0.0, row)
    if w >= LEAST_W:
        add_row(normal, right, row, weight, place[0] - x)
        point_row(p, u, v, (mu, mv), 0.0, 1.0, row)
        add_row(normal, right, row, weight, place[1] - y)
    return w


# --- adjustment -------------------------------------------------------------------------------------------------------


@kernel(forceinline=True)
def _determinant(p: NDArray[np.float64]) -> float:
    """Return the determinant of a homography: areas become larger by |it| / w^3."""
    return float(p[0] * (p[4] - p[5] * p[7]) - p[1] * (p[3] - p[5] * p[6]) + p[2] * (p[3] * p[7] - p[4] * p[6]))


@kernel(forceinline=True)
def own_sigma(reach_m: float, sigma_m: float, map_sigma_m: float, mask_sigma: float) -> float:
    """Return a point's standard deviation, relative to the middle of the frame, from the reach of a step of 1 there.

    The other arguments are as in `structs.AdjustLimits`.
    """
    return math.sqrt(map_sigma_m**2 + (mask_sigma * reach_m) ** 2) / sigma_m


class _System(NamedTuple):
    """Normal equations, (n, n) and (n,), and the Cholesky factor of those before."""

    normal: Floats2
    right: Floats1
    factor: Floats2
    row: Floats1


@kernel(forceinline=True)
def _add_pairs(
    p: NDArray[np.float64],
    unit: float,
    half_side: float,
    pairs: PointPairs,
    limits: AdjustLimits,
    shares: NDArray[np.float64],
    system: _System,
) -> bool:
    """Add matched intersections; False: one lies at the horizon."""
    area = abs(_determinant(p))
    for i in range(pairs.query.shape[0]):
        if shares[pairs.cells[i]] < limits.least_share:
            continue
        point, place = (pairs.query[i, 0], pairs.query[i, 1]), (pairs.reference[i, 0], pairs.reference[i, 1])
        u, v, _, _, _, _, shrink = straighten(p[8], half_side, point[0], point[1], 0.0, 0.0)
        x, y, w, _, _, _ = carry(p, u, v, 0.0, 0.0)
        if w < LEAST_W:
            return False
        far = math.hypot(place[0] - x, place[1] - y) * unit
        if far > limits.max_radius:
            continue
        reach_m = unit * math.sqrt(area * shrink / w**3)
        own = own_sigma(reach_m, limits.sigma_m, limits.map_sigma_m, limits.mask_sigma)
        weight = pairs.weight / (own**2 + (far / (2.0 * limits.sigma_m)) ** 2)
        add_point(p, half_side, point, place, weight, system.normal, system.right, system.row)
    return True


@kernel(writes=("met",))
def meet_roads(
    p: Floats1,
    plane: Plane,
    points: RoadSamples,
    limits: AdjustLimits,
    roads: RoadBuckets,
    factor: Floats2,
    met: Met,
) -> int:
    """Find the road of each road point whose place is certain enough; return the number of such points.

    Parameters
    ----------
    p : (9,) float64
    factor : (n, n) float64
        Cholesky factor of the present normal matrix, for the uncertainty of places; zeros if they are known.
    met : Met
        Filled.
    """
    segments, starts, ids, grid, shape = roads
    rows, residuals, sigmas, own, searched = met
    row, work = np.empty(rows.shape[1]), np.empty(rows.shape[1])
    area, n_met = abs(_determinant(p)), 0
    for i in range(points.xy.shape[0]):
        residuals[i], searched[i] = np.nan, False
        u, v, du, dv, mu, mv, shrink = straighten(
            p[8], points.half_side, points.xy[i, 0], points.xy[i, 1], points.directions[i, 0], points.directions[i, 1]
        )
        x, y, w, dx, dy, length = carry(p, u, v, du, dv)
        if w < LEAST_W or not length > 0.0:
            continue
        dx /= length
        dy /= length
        # The search radius follows from the uncertainty of the fit here.
        reach_m = plane.unit * area * shrink / (w * w * length)
        own[i] = own_sigma(reach_m, limits.sigma_m, limits.map_sigma_m, limits.mask_sigma)
        point_row(p, u, v, (mu, mv), -dy, dx, row)
        sigma = limits.sigma_m * math.sqrt(own[i] ** 2 + spread(row, factor, work))
        if not 3.0 * sigma <= limits.max_radius * max(1.0, own[i]):  # NaN neither
            continue
        searched[i] = True
        gx, gy = plane.x + plane.unit * x, plane.y + plane.unit * y
        d, fx, fy, rx, ry = nearest_road(
            gx, gy, dx, dy, 3.0 * sigma, limits.min_cos, segments, starts, ids, grid, shape
        )
        if d == np.inf:
            continue
        point_row(p, u, v, (mu, mv), -ry, rx, rows[i])
        residuals[i], sigmas[i] = (fy - gy) * rx - (fx - gx) * ry, sigma
        n_met += 1
    return n_met


@kernel(forceinline=True)
def _count_shares(points: RoadSamples, met: Met, shares: NDArray[np.float64]) -> None:
    """Count the share of each cell's searched points that met a road; 1 without any."""
    searched = np.zeros(shares.shape[0])
    shares[:] = 0.0
    for i in range(points.xy.shape[0]):
        searched[points.cells[i]] += met.searched[i]
        shares[points.cells[i]] += not math.isnan(met.residuals[i])
    for c in range(shares.shape[0]):
        shares[c] = shares[c] / searched[c] if searched[c] > 0.0 else 1.0


@kernel(forceinline=True)
def _add_roads(
    unit: float, points: RoadSamples, least_share: float, shares: NDArray[np.float64], system: _System, met: Met
) -> tuple[int, float]:
    """Add the road points that met a road; return how many, and the scale of their residuals (see `adjust`)."""
    rows, residuals, sigmas, own, _ = met
    used, weights, slopes, squares = 0, 0.0, 0.0, 0.0
    for i in range(residuals.shape[0]):
        if math.isnan(residuals[i]) or shares[points.cells[i]] < least_share:
            continue
        weight = 1.0 / (1.0 + (residuals[i] / sigmas[i]) ** 2)
        add_row(system.normal, system.right, rows[i], points.weight / own[i] ** 2 * weight, residuals[i] / unit)
        used += 1
        weights += weight
        slopes += weight * (2.0 * weight - 1.0)  # of the influence, by the residual
        squares += (weight * residuals[i] / own[i]) ** 2
    if weights > 0.0:
        return used, math.sqrt(squares * weights) / max(slopes, 0.1 * weights)
    return used, np.inf


@kernel(writes=("p", "normal", "met"))
def adjust(
    p: Floats1,
    plane: Plane,
    points: RoadSamples,
    pairs: PointPairs,
    held: Held,
    limits: AdjustLimits,
    roads: RoadBuckets,
    normal: Floats2,
    met: Met,
) -> tuple[int, float]:
    """Adjust a camera by Gauss-Newton with Cauchy weights.

    The first step uses matched intersections, and, for `_HELD_STEPS` steps, points held where the start put them. Then
    the residual of a road point is its distance across the nearest road of the map in its direction. Its standard
    deviation is predicted from the present system. The search radius is three times that; a point whose radius exceeds
    the greatest is left out, so that the fit grows outwards from where it is certain.

    Parameters
    ----------
    p : (9,) float64
        Adjusted in place: the first n.
    normal : (n, n) float64
        Filled with the last normal matrix, its lower triangle.
    met : Met
        Filled with the last roads.

    Returns
    -------
    n : int
        Road points that took part; -1 where the adjustment failed.
    rms : float
        Scale of their residuals, metres, inf where the adjustment failed or no point took part. Its square times the
        inverse of `normal` is the covariance of an M-estimate (Huber 1981, 7.6); a weighted rms would be too small.
    """
    n = normal.shape[0]
    system = _System(normal, np.empty(n), np.zeros((n, n)), np.empty(n))
    shares = np.ones(limits.n_cells)
    previous, rms = -1, np.inf
    for iteration in range(limits.n_iterations + 1):
        begin_system(p, limits.prior, normal, system.right)
        if not _add_pairs(p, plane.unit, points.half_side, pairs, limits, shares, system):
            return -1, np.inf
        if iteration < _HELD_STEPS:
            weight = held.weight * 0.5**iteration
            for i in range(held.query.shape[0]):
                point, place = (held.query[i, 0], held.query[i, 1]), (held.reference[i, 0], held.reference[i, 1])
                w = add_point(p, points.half_side, point, place, weight, normal, system.right, system.row)
                if not w >= LEAST_W:
                    return -1, np.inf
        used = 0
        if iteration > 0:
            meet_roads(p, plane, points, limits, roads, system.factor, met)
            _count_shares(points, met, shares)
            used, scale = _add_roads(plane.unit, points, limits.least_share, shares, system, met)
            if scale != np.inf:
                rms = scale
        largest = solve_system(p, normal, system.right, system.factor)
        if largest < 0.0:
            return -1, np.inf
        p[8] = min(max(p[8], -_MOST_K1), _MOST_K1)
        # The iteration goes on while points are held, or more roads are met.
        settled = iteration > (1 if held.query.shape[0] == 0 else _HELD_STEPS)
        if settled and largest * plane.unit < limits.tolerance_m and used <= previous:
            break
        previous = used
    return previous, rms
