"""Least-squares adjustment of a homography to matched intersections and to the roads of the map.

The parameters are those of `kernels.homography_fit`, between normalised coordinates: query (x - x0) / half_size and
reference (X - X0) / unit.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from roadgeo.kernels.arrays import Bools1, Floats1, Floats2
from roadgeo.kernels.compilation import kernel
from roadgeo.kernels.homography_fit import add_row, cholesky, point_row, solve_cholesky, spread
from roadgeo.kernels.roads import nearest_road
from roadgeo.kernels.structs import AdjustLimits, Held, Plane, PointPairs, RoadBuckets, RoadSamples

#: Steps of an adjustment in which points are held near their start.
_HELD_STEPS = 6
#: Points nearer to the horizon than this w make the adjustment fail.
_LEAST_W = 0.02

__all__ = ["adjust", "carry", "own_sigma"]


@kernel(forceinline=True)
def carry(p: Floats1, u: float, v: float, du: float, dv: float) -> tuple[float, float, float, float, float, float]:
    """Map a normalised point and a direction there; return x', y', w, the direction unscaled, and its length.

    Near the horizon (w < 0.02) only w is meant.
    """
    w = 1.0 + p[6] * u + p[7] * v
    if w < _LEAST_W:
        return 0.0, 0.0, w, 0.0, 0.0, 0.0
    x, y = (p[0] * u + p[1] * v + p[2]) / w, (p[3] * u + p[4] * v + p[5]) / w
    dw = p[6] * du + p[7] * dv
    dx = p[0] * du + p[1] * dv - x * dw
    dy = p[3] * du + p[4] * dv - y * dw
    return x, y, w, dx, dy, math.sqrt(dx * dx + dy * dy)


@kernel(forceinline=True)
def _determinant(p: Floats1) -> float:
    """Return the determinant of a homography: areas become larger by |it| / w^3."""
    return float(p[0] * (p[4] - p[5] * p[7]) - p[1] * (p[3] - p[5] * p[6]) + p[2] * (p[3] * p[7] - p[4] * p[6]))


@kernel(forceinline=True)
def own_sigma(reach_m: float, sigma_m: float, map_sigma_m: float, mask_sigma: float) -> float:
    """Return how many times less sure than in the middle a point is, by the reach of a step of 1 there.

    The other arguments are as in `structs.AdjustLimits`.
    """
    return math.hypot(map_sigma_m, mask_sigma * reach_m) / sigma_m


class _System(NamedTuple):
    """Normal equations, (8, 8) and (8,), and the Cholesky factor of those before."""

    normal: Floats2
    right: Floats1
    factor: Floats2
    row: Floats1
    work: Floats1


class _Met(NamedTuple):
    """Results of the search for roads: of each road point, and of each cell of the frame."""

    met: Bools1
    normals: Floats2  # unit vectors across the road
    residuals: Floats1  # metres across it
    sigmas: Floats1
    own: Floats1  # standard deviation of it where the fit is sure, in those of the middle of the frame
    searched: Floats1
    hits: Floats1
    shares: Floats1


@kernel(forceinline=True)
def _begin_system(p: NDArray[np.float64], prior: float, system: _System) -> None:
    """Empty the normal equations but for the prior on the two perspective parameters."""
    system.normal[:] = 0.0
    system.right[:] = 0.0
    for r in range(8):
        system.normal[r, r] = 1e-9
    for r in range(6, 8):
        system.normal[r, r] += prior
        system.right[r] -= prior * p[r]


@kernel(forceinline=True)
def _add_pairs(
    p: NDArray[np.float64],
    unit: float,
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
        for axis in range(2):
            x, y, w = point_row(p, pairs.query[i, 0], pairs.query[i, 1], 1.0 - axis, 1.0 * axis, system.row)
            if w < _LEAST_W:
                return False
            dx, dy = pairs.reference[i, 0] - x, pairs.reference[i, 1] - y
            far = math.sqrt(dx * dx + dy * dy) * unit
            if far > limits.max_radius:
                continue
            reach_m = unit * math.sqrt(area / w**3)
            own = own_sigma(reach_m, limits.sigma_m, limits.map_sigma_m, limits.mask_sigma)
            weight = pairs.weight / (own**2 + (far / (2.0 * limits.sigma_m)) ** 2)
            add_row(system.normal, system.right, system.row, weight, dx if axis == 0 else dy)
    return True


@kernel(forceinline=True)
def _add_held(p: NDArray[np.float64], held: Held, weight: float, system: _System) -> bool:
    """Add points that are held; False: one lies at the horizon."""
    for i in range(held.query.shape[0]):
        for axis in range(2):
            x, y, w = point_row(p, held.query[i, 0], held.query[i, 1], 1.0 - axis, 1.0 * axis, system.row)
            if w < _LEAST_W:
                return False
            residual = held.reference[i, 0] - x if axis == 0 else held.reference[i, 1] - y
            add_row(system.normal, system.right, system.row, weight, residual)
    return True


@kernel(forceinline=True)
def _search_roads(
    p: NDArray[np.float64],
    plane: Plane,
    points: RoadSamples,
    limits: AdjustLimits,
    roads: RoadBuckets,
    system: _System,
    found: _Met,
) -> bool:
    """Find each road point's road, and which share of each cell's points met one; False: one lies at the horizon."""
    xy, directions, cells, _ = points
    segments, starts, ids, grid, shape = roads
    met, normals, residuals, sigmas, own, searched, hits, shares = found
    factor, row, work = system.factor, system.row, system.work
    area = abs(_determinant(p))
    searched[:] = 0.0
    hits[:] = 0.0
    for i in range(xy.shape[0]):
        met[i] = False
        u, v = xy[i, 0], xy[i, 1]
        x, y, w, dx, dy, length = carry(p, u, v, directions[i, 0], directions[i, 1])
        if w < _LEAST_W:
            return False
        if length == 0.0:
            continue
        dx /= length
        dy /= length
        # How far the road may lie follows from how sure the fit is here.
        point_row(p, u, v, -dy, dx, row)
        reach_m = plane.unit * area / (w * w * length)
        own[i] = own_sigma(reach_m, limits.sigma_m, limits.map_sigma_m, limits.mask_sigma)
        sigma = limits.sigma_m * math.sqrt(own[i] ** 2 + spread(row, factor, work))
        if 3.0 * sigma > limits.max_radius * max(1.0, own[i]):
            continue
        searched[cells[i]] += 1.0
        gx, gy = plane.x + plane.unit * x, plane.y + plane.unit * y
        d, fx, fy, rx, ry = nearest_road(
            gx, gy, dx, dy, 3.0 * sigma, limits.min_cos, segments, starts, ids, grid, shape
        )
        if d == np.inf:
            continue
        met[i] = True
        hits[cells[i]] += 1.0
        normals[i, 0], normals[i, 1] = -ry, rx
        residuals[i] = (fx - gx) * -ry + (fy - gy) * rx
        sigmas[i] = sigma
    for c in range(limits.n_cells):
        shares[c] = hits[c] / searched[c] if searched[c] > 0.0 else 1.0
    return True


@kernel(forceinline=True)
def _add_roads(
    p: NDArray[np.float64], unit: float, points: RoadSamples, least_share: float, system: _System, found: _Met
) -> tuple[int, float]:
    """Add the road points that met a road; return how many, and the scale of their residuals (see `adjust`)."""
    xy, _, cells, usual = points
    met, normals, residuals, sigmas, own, _, _, shares = found
    normal, right, row = system.normal, system.right, system.row
    used, weights, slopes, squares = 0, 0.0, 0.0, 0.0
    for i in range(xy.shape[0]):
        if not met[i] or shares[cells[i]] < least_share:
            continue
        point_row(p, xy[i, 0], xy[i, 1], normals[i, 0], normals[i, 1], row)
        weight = 1.0 / (1.0 + (residuals[i] / sigmas[i]) ** 2)
        add_row(normal, right, row, usual / own[i] ** 2 * weight, residuals[i] / unit)
        used += 1
        weights += weight
        slopes += weight * (2.0 * weight - 1.0)  # of the influence, by the residual
        squares += (weight * residuals[i] / own[i]) ** 2
    if weights > 0.0:
        return used, math.sqrt(squares * weights) / max(slopes, 0.1 * weights)
    return used, np.inf


@kernel(forceinline=True)
def _step(p: NDArray[np.float64], system: _System) -> float:
    """Solve the normal equations and move the parameters; return the largest move, -1 where that fails."""
    for r in range(8):
        for c in range(r):
            system.normal[c, r] = system.normal[r, c]
    if not cholesky(system.normal, system.factor):
        return -1.0
    solve_cholesky(system.factor, system.right)
    largest = 0.0
    for r in range(8):
        p[r] += system.right[r]
        largest = max(largest, abs(system.right[r]))
    return largest


@kernel(writes=("p", "normal"))
def adjust(
    p: Floats1,
    plane: Plane,
    points: RoadSamples,
    pairs: PointPairs,
    held: Held,
    limits: AdjustLimits,
    roads: RoadBuckets,
    normal: Floats2,
) -> tuple[int, float]:
    """Adjust a homography by Gauss-Newton with Cauchy weights.

    The first step takes matched intersections, and points held where the map to be adjusted put them, for the first
    `_HELD_STEPS`. Then a road point's residual is its distance across the nearest road of the map that runs its way.
    Its standard deviation is predicted from the present system: it is searched as far as three times that, and not at
    all beyond the greatest radius, so that the fit grows outwards from where it is sure.

    Parameters
    ----------
    p : (8,) float64
        Adjusted in place.
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
    n = points.xy.shape[0]
    system = _System(normal, np.empty(8), np.zeros((8, 8)), np.empty(8), np.empty(8))
    found = _Met(
        np.empty(n, np.bool_), np.empty((n, 2)), np.empty(n), np.empty(n), np.empty(n),
        np.empty(limits.n_cells), np.empty(limits.n_cells), np.ones(limits.n_cells),
    )  # fmt: skip
    previous = -1
    rms = np.inf
    for iteration in range(limits.n_iterations + 1):
        _begin_system(p, limits.prior, system)
        if not _add_pairs(p, plane.unit, pairs, limits, found.shares, system):
            return -1, np.inf
        if iteration < _HELD_STEPS and not _add_held(p, held, held.weight * 0.5**iteration, system):
            return -1, np.inf
        used = 0
        if iteration > 0:
            if not _search_roads(p, plane, points, limits, roads, system, found):
                return -1, np.inf
            used, scale = _add_roads(p, plane.unit, points, limits.least_share, system, found)
            if scale != np.inf:
                rms = scale
        largest = _step(p, system)
        if largest < 0.0:
            return -1, np.inf
        # Not done while points are held, or more roads are still being met.
        settled = iteration > (1 if held.query.shape[0] == 0 else _HELD_STEPS)
        if settled and largest * plane.unit < limits.tolerance_m and used <= previous:
            break
        previous = used
    return previous, rms
