"""Growth of a hypothesis: from a few matched intersections outwards over the whole query.

The model has the parameters p of `kernels.adjustment`, without a lens, around the anchor: it maps query
(x - xa) / half_size to reference (X - XA) / unit.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from roadgeo.kernels.adjustment import add_point, begin_system, point_row, solve_system, spread
from roadgeo.kernels.arrays import Bools1, Floats1, Floats2, Floats3, Ints1, Ints2
from roadgeo.kernels.compilation import kernel
from roadgeo.kernels.point_matching import keep_nearest, nearest_alike
from roadgeo.kernels.structs import GrowthLimits, GrowthQuery, PointBuckets

__all__ = ["grow", "grow_each"]

#: Rounds of growth, each over all points not tested yet; a fit when the points matched have grown by this factor.
_ROUNDS, _MORE = 8, 1.2
#: Search radius in standard deviations; points nearer to the horizon than this w are left out.
_SIGMAS, _LEAST_W = 2.5, 0.1
#: Matches that a fit needs.
_FEWEST = 3


class _Growth(NamedTuple):
    """A hypothesis as it grows."""

    x0: float  # the map intersection that the anchor may be, metres
    y0: float
    unit: float  # metres per normalised unit
    sigma_m: float
    radius_m: float
    prior: Floats1  # (9,), see `begin_system`
    gain: float  # of the log-likelihood ratio by a hit, and by a miss
    loss: float
    query: Floats2  # (N, 2) normalised
    image: Floats2  # (N, 2) places of the partners, normalised
    seed: Bools1  # (N,)
    p: Floats1  # (9,)
    normal: Floats2  # (8, 8)
    factor: Floats2  # (8, 8)
    right: Floats1  # (8,)
    row: Floats1  # (8,)
    work: Floats1  # (8,)


@kernel(forceinline=True)
def _begin(
    query: GrowthQuery, ref_anchor: int, affine: NDArray[np.float64], points: PointBuckets, limits: GrowthLimits
) -> _Growth:
    """Normalise the query around its anchor."""
    n = query.xy.shape[0]
    gsd = math.sqrt(affine[0] * affine[3] - affine[1] * affine[2])
    unit = query.half_size * gsd
    sigma_m = math.sqrt(limits.sigma[0] ** 2 + (limits.sigma[1] * gsd) ** 2)
    normalised = np.empty((n, 2))
    for i in range(n):
        normalised[i, 0] = (query.xy[i, 0] - query.xy[query.anchor, 0]) / query.half_size
        normalised[i, 1] = (query.xy[i, 1] - query.xy[query.anchor, 1]) / query.half_size
    prior = np.zeros(9)
    prior[6] = prior[7] = (sigma_m / unit) ** 2 / limits.perspective_sigma**2
    return _Growth(
        points.xy[ref_anchor, 0],
        points.xy[ref_anchor, 1],
        unit,
        sigma_m,
        limits.radius[0] + limits.radius[1] * gsd,
        prior,
        math.log(limits.hit_rate / limits.chance_rate),
        math.log((1.0 - limits.hit_rate) / (1.0 - limits.chance_rate)),
        normalised,
        np.zeros((n, 2)),
        np.zeros(n, np.bool_),
        np.zeros(9),
        np.empty((8, 8)),
        np.empty((8, 8)),
        np.empty(8),
        np.empty(8),
        np.empty(8),
    )


@kernel(forceinline=True)
def _match(growth: _Growth, i: int, j: int, points: PointBuckets, matched: NDArray[np.int64]) -> None:
    """Match query point i to map intersection j."""
    matched[i] = j
    growth.image[i, 0] = (points.xy[j, 0] - growth.x0) / growth.unit
    growth.image[i, 1] = (points.xy[j, 1] - growth.y0) / growth.unit


@kernel(forceinline=True)
def _place_seeds(
    growth: _Growth,
    query: GrowthQuery,
    ref_anchor: int,
    partners: NDArray[np.int64],
    points: PointBuckets,
    matched: NDArray[np.int64],
) -> int:
    """Match the anchor and its placed neighbours; return how many."""
    matched[:] = -1
    matched[query.anchor] = ref_anchor
    growth.seed[query.anchor] = True
    n_seeds = 1
    for s in range(query.neighbours.shape[1]):
        if partners[s] >= 0:
            i = int(np.int64(query.neighbours[query.anchor, s]))  # the same type everywhere: `_match` is compiled once
            _match(growth, i, partners[s], points, matched)
            growth.seed[i] = True
            n_seeds += 1
    return n_seeds


@kernel()
def _fit(growth: _Growth, matched: NDArray[np.int64]) -> bool:
    """Take one least-squares step to all matches; return whether it worked."""
    query, image, p, normal, right, row = (
        growth.query, growth.image, growth.p, growth.normal, growth.right, growth.row,
    )  # fmt: skip
    begin_system(p, growth.prior, normal, right)
    n = 0
    for i in range(matched.shape[0]):
        if matched[i] >= 0:
            n += 1
            point, place = (query[i, 0], query[i, 1]), (image[i, 0], image[i, 1])
            if not add_point(p, 1.0, point, place, 1.0, normal, right, row) >= 0.5 * _LEAST_W:
                return False
    return n >= _FEWEST and solve_system(p, normal, right, growth.factor) >= 0.0


@kernel(forceinline=True)
def _predict_radius(
    p: NDArray[np.float64],
    factor: NDArray[np.float64],
    row: NDArray[np.float64],
    work: NDArray[np.float64],
    u: float,
    v: float,
    sigma_m: float,
) -> tuple[float, float, float, float]:
    """Return where a query point is predicted, its w, and its search radius in metres: -1 at the horizon.

    The radius follows from the summed variance of x and y, in units of the residuals' variance: the trace of
    J (L L^T)^-1 J^T, where J (2, 8) is the derivative of the point by p, and L L^T the normal matrix.
    """
    x, y, w = point_row(p, u, v, (0.0, 0.0), 1.0, 0.0, row)
    variance = spread(row, factor, work)
    point_row(p, u, v, (0.0, 0.0), 0.0, 1.0, row)
    variance += spread(row, factor, work)
    return x, y, w, -1.0 if w < _LEAST_W else _SIGMAS * sigma_m * math.sqrt(0.5 * variance + 1.0)


@kernel(forceinline=True)
def _jacobian(p: NDArray[np.float64], x: float, y: float, w: float) -> tuple[float, float, float, float]:
    """Return the derivatives of a predicted point by u and v, row-major."""
    return (p[0] - x * p[6]) / w, (p[1] - x * p[7]) / w, (p[3] - y * p[6]) / w, (p[4] - y * p[7]) / w


@kernel(forceinline=True)
def _expand(
    growth: _Growth,
    query: GrowthQuery,
    points: PointBuckets,
    limits: GrowthLimits,
    n_seeds: int,
    matched: NDArray[np.int64],
) -> tuple[int, int, bool]:
    """Match ever more points, the nearest first, and refit; return matches, tests, and whether growth goes on."""
    uv, image, p, factor, row, work = growth.query, growth.image, growth.p, growth.factor, growth.row, growth.work
    x0, y0, unit, branches = growth.x0, growth.y0, growth.unit, query.branches
    ref_xy, ref_branches, starts, grid, shape = points
    ratio = 0.0
    done = growth.seed.copy()
    n_matched, n_tested = 0, 0
    fitted = n_seeds
    for _ in range(_ROUNDS):
        news = 0
        for index in range(query.order.shape[0]):
            i = query.order[index]
            if done[i]:
                continue
            # A point waits until it is predicted well enough.
            x, y, w, radius = _predict_radius(p, factor, row, work, uv[i, 0], uv[i, 1], growth.sigma_m)
            if w < _LEAST_W or radius > growth.radius_m:
                continue
            j, _ = nearest_alike(
                x0 + unit * x, y0 + unit * y, radius, branches, i,
                ref_xy, ref_branches, starts, grid, shape, _jacobian(p, x, y, w), limits.min_cos,
            )  # fmt: skip
            done[i] = True
            n_tested += 1
            if j < 0:
                ratio += growth.loss
                if ratio < -limits.patience:
                    return n_matched, n_tested, False
                continue
            ratio += growth.gain
            matched[i] = j
            image[i, 0], image[i, 1] = (ref_xy[j, 0] - x0) / unit, (ref_xy[j, 1] - y0) / unit
            n_matched += 1
            news += 1
            if n_seeds + n_matched >= _MORE * fitted:
                if not _fit(growth, matched):
                    return n_matched, n_tested, False
                fitted = n_seeds + n_matched
        if not _fit(growth, matched):
            return n_matched, n_tested, False
        if news == 0:
            break
    return n_matched, n_tested, True


@kernel(forceinline=True)
def _match_anew(
    growth: _Growth,
    query: GrowthQuery,
    points: PointBuckets,
    min_cos: float,
    matched: NDArray[np.int64],
    distance: NDArray[np.float64],
) -> tuple[int, int, float]:
    """Match all points anew, one to one; return matches and tests besides the seeds, and the log-likelihood ratio."""
    uv, image, p, factor, row, work = growth.query, growth.image, growth.p, growth.factor, growth.row, growth.work
    x0, y0, unit, branches = growth.x0, growth.y0, growth.unit, query.branches
    ref_xy, ref_branches, starts, grid, shape = points
    n_matched, n_tested, ratio = 0, 0, 0.0
    matched[:] = -1
    for index in range(query.order.shape[0]):
        i = query.order[index]
        x, y, w, radius = _predict_radius(p, factor, row, work, uv[i, 0], uv[i, 1], growth.sigma_m)
        if w < _LEAST_W:
            continue
        j, distance[i] = nearest_alike(
            x0 + unit * x, y0 + unit * y, min(radius, growth.radius_m), branches, i,
            ref_xy, ref_branches, starts, grid, shape, _jacobian(p, x, y, w), min_cos,
        )  # fmt: skip
        matched[i] = j
        if j >= 0:
            image[i, 0], image[i, 1] = (ref_xy[j, 0] - x0) / unit, (ref_xy[j, 1] - y0) / unit
    keep_nearest(matched, distance)
    for index in range(query.order.shape[0]):
        i = query.order[index]
        if growth.seed[i]:
            continue
        n_tested += 1
        if matched[i] >= 0:
            n_matched += 1
            ratio += growth.gain
        else:
            ratio += growth.loss
    return n_matched, n_tested, ratio


@kernel(forceinline=True)
def _write_matrix(growth: _Growth, query: GrowthQuery, matrix: NDArray[np.float64]) -> None:
    """Undo the normalisation: X = x0 + unit * predict((x - xa) / half_size)."""
    p, half_size = growth.p, query.half_size
    xa, ya = query.xy[query.anchor, 0], query.xy[query.anchor, 1]
    a, b = p[6] / half_size, p[7] / half_size
    c = 1.0 - a * xa - b * ya
    for axis in range(2):
        origin = growth.x0 if axis == 0 else growth.y0
        h0, h1 = p[3 * axis] / half_size, p[3 * axis + 1] / half_size
        h2 = p[3 * axis + 2] - h0 * xa - h1 * ya
        matrix[axis, 0] = growth.unit * h0 + origin * a
        matrix[axis, 1] = growth.unit * h1 + origin * b
        matrix[axis, 2] = growth.unit * h2 + origin * c
    matrix[2, 0], matrix[2, 1], matrix[2, 2] = a, b, c


@kernel()
def grow(
    query: GrowthQuery,
    ref_anchor: int,
    affine: NDArray[np.float64],
    partners: NDArray[np.int64],
    points: PointBuckets,
    limits: GrowthLimits,
    matched: NDArray[np.int64],
    distance: NDArray[np.float64],
    matrix: NDArray[np.float64],
) -> tuple[int, int, float]:
    """Grow a hypothesis from its seeds, give up early or match the whole query.

    Seeds are the anchor and its placed neighbours. Each further point is predicted, the nearest first, once its search
    radius, 2.5 standard deviations of the prediction, no longer exceeds the largest radius. Matches refit the model. A
    sequential probability ratio test (Wald 1945) counts hits and misses and gives up below -`patience`. At the end all
    points in `query.order` are matched anew, one to one, twice.

    Parameters
    ----------
    ref_anchor : int
        The map intersection that the anchor may be.
    affine : (4,) float64
        The 2 x 2 map, row-major, around them; not mirrored.
    partners : (K,) int64
        `partners[s]` is the map intersection of query point `query.neighbours[query.anchor, s]`, or -1.
    matched : (N,) int64
        Filled with map intersections or -1.
    distance : (N,) float64
        Filled with metres where matched.
    matrix : (3, 3) float64
        Filled with the homography from the query plane to the reference plane, unless given up.

    Returns
    -------
    matches, tests : int
        Besides the seeds.
    ratio : float
        Log-likelihood ratio in nats; -inf: given up.
    """
    growth = _begin(query, ref_anchor, affine, points, limits)
    n_seeds = _place_seeds(growth, query, ref_anchor, partners, points, matched)
    for _ in range(2):
        if not _fit(growth, matched):
            return 0, 0, -np.inf
    n_matched, n_tested, goes_on = _expand(growth, query, points, limits, n_seeds, matched)
    if not goes_on:
        return n_matched, n_tested, -np.inf
    # The model now rests on all matches: match everything anew and fit again.
    ratio = 0.0
    for _ in range(2):
        n_matched, n_tested, ratio = _match_anew(growth, query, points, limits.min_cos, matched, distance)
        if not _fit(growth, matched):
            return n_matched, n_tested, -np.inf
    _write_matrix(growth, query, matrix)
    return n_matched, n_tested, ratio


@kernel(writes=("matched", "matrices", "ratios"))
def grow_each(
    query: GrowthQuery,
    references: Ints1,
    affines: Floats2,
    partners: Ints2,
    points: PointBuckets,
    limits: GrowthLimits,
    min_matched: int,
    matched: Ints2,
    matrices: Floats3,
    ratios: Floats1,
) -> None:
    """Grow the M proposals of one anchor (see `grow`).

    Parameters
    ----------
    references : (M,) int64, affines : (M, 4) float64, partners : (M, K) int64
        `ref_anchor`, `affine` and `partners` of each.
    min_matched : int
        Least matches besides the seeds.
    matched : (M, N) int64, matrices : (M, 3, 3) float64, ratios : (M,) float64
        Filled; a ratio of -inf: given up.
    """
    distance = np.empty(query.xy.shape[0])
    for m in range(references.shape[0]):
        n, _, ratio = grow(
            query, references[m], affines[m], partners[m], points, limits, matched[m], distance, matrices[m]
        )
        ratios[m] = ratio if n >= min_matched else -np.inf
