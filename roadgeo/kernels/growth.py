"""Growth of a hypothesis: from a few matched intersections outwards over the whole query.

The model is a homography in normalised coordinates, query (x - xa) / s to reference (X - XA) / (s g), s being the
query's half size in pixels and g the ground sampling at the anchor, so that it is near a rotation. Its eight parameters
p = (h00 h01 h02 h10 h11 h12 h20 h21), h22 = 1, come from linear least squares with a prior on the two perspective ones:
with few matches it is an affine map, with many a homography. The same normal matrix predicts how far off a new point
may be.
"""

import math

import numpy as np
from numpy.typing import NDArray

from roadgeo.kernels.arrays import Floats1, Floats2, Floats3, Int8s3, Int32s1, Int32s2, Ints1, Ints2
from roadgeo.kernels.compilation import kernel
from roadgeo.kernels.rays import rays_agree

__all__ = [
    "cholesky",
    "count_matches",
    "fit_homography",
    "grow",
    "grow_each",
    "keep_nearest",
    "match_all",
    "nearest_alike",
    "predict",
    "prediction_variance",
    "solve_cholesky",
]


@kernel()
def cholesky(matrix: NDArray[np.float64], factor: NDArray[np.float64]) -> bool:
    """Factorise a symmetric matrix; return whether it is positive definite.

    Parameters
    ----------
    matrix : (n, n) float64
        Only its lower triangle is read.
    factor : (n, n) float64
        Its lower triangle is filled with L, L L^T = matrix.
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
                factor[i, i] = math.sqrt(total)
            else:
                factor[i, j] = total / factor[j, j]
    return True


@kernel()
def solve_cholesky(factor: NDArray[np.float64], right: NDArray[np.float64]) -> None:
    """Solve L L^T x = right, L (n, n) as left by `cholesky`; x replaces `right` (n,)."""
    n = factor.shape[0]
    for i in range(n):
        for k in range(i):
            right[i] -= factor[i, k] * right[k]
        right[i] /= factor[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            right[i] -= factor[k, i] * right[k]
        right[i] /= factor[i, i]


@kernel()
def fit_homography(
    query: NDArray[np.float64],
    image: NDArray[np.float64],
    matched: NDArray[np.int64],
    prior: float,
    p: NDArray[np.float64],
    normal: NDArray[np.float64],
    factor: NDArray[np.float64],
) -> bool:
    """Fit a homography to matched points by one step of linear least squares; return whether that worked.

    x' (1 + p6 u + p7 v) = p0 u + p1 v + p2 is linear in p. The equations are divided by the w of the `p` given, so that
    residuals are distances on the reference plane.

    Parameters
    ----------
    query, image : (N, 2) float64
        Normalised points u, v and their images; those with `matched` >= 0 count.
    prior : float
        Weight that holds the two perspective parameters near zero: variance of a residual over theirs.
    p : (8,) float64
        Parameters so far; replaced.
    normal, factor : (8, 8) float64
        Their lower triangles are filled with the normal matrix and its Cholesky factor.
    """
    right = np.zeros(8)
    row = np.zeros(8)
    normal[:] = 0.0
    n = 0
    for i in range(query.shape[0]):
        if matched[i] < 0:
            continue
        n += 1
        u, v = query[i, 0], query[i, 1]
        w = 1.0 + p[6] * u + p[7] * v
        if w < 0.05:
            return False
        for axis in range(2):
            target = image[i, axis]
            row[:] = 0.0
            row[3 * axis] = u / w
            row[3 * axis + 1] = v / w
            row[3 * axis + 2] = 1.0 / w
            row[6] = -target * u / w
            row[7] = -target * v / w
            for r in range(8):
                for c in range(r + 1):
                    normal[r, c] += row[r] * row[c]
                right[r] += row[r] * target / w
    if n < 3:
        return False
    normal[6, 6] += prior
    normal[7, 7] += prior
    for r in range(8):
        normal[r, r] += 1e-9
    if not cholesky(normal, factor):
        return False
    solve_cholesky(factor, right)
    for r in range(8):
        p[r] = right[r]
    return True


@kernel()
def predict(p: NDArray[np.float64], u: float, v: float) -> tuple[float, float, float]:
    """Return (x', y', w) of a normalised query point under the parameters `p` (8,)."""
    w = 1.0 + p[6] * u + p[7] * v
    return (p[0] * u + p[1] * v + p[2]) / w, (p[3] * u + p[4] * v + p[5]) / w, w


@kernel()
def prediction_variance(
    factor: NDArray[np.float64], p: NDArray[np.float64], u: float, v: float, work: NDArray[np.float64]
) -> float:
    """Return the variance of a predicted point, summed over x and y, in units of the residuals' variance.

    With J (2, 8) the derivative of the point by p, it is the trace of J (L L^T)^-1 J^T, the squared norm of L^-1 J^T.

    Parameters
    ----------
    factor : (8, 8) float64
        L, as left by `fit_homography`.
    work : (8,) float64
        Room to work in.
    """
    x, y, w = predict(p, u, v)
    total = 0.0
    for axis in range(2):
        work[:] = 0.0
        work[3 * axis] = u / w
        work[3 * axis + 1] = v / w
        work[3 * axis + 2] = 1.0 / w
        target = x if axis == 0 else y
        work[6] = -target * u / w
        work[7] = -target * v / w
        for i in range(8):  # |L^-1 row|^2
            for k in range(i):
                work[i] -= factor[i, k] * work[k]
            work[i] /= factor[i, i]
            total += work[i] * work[i]
    return total


@kernel()
def nearest_alike(
    x: float,
    y: float,
    radius: float,
    branches: NDArray[np.int8],
    i: int,
    ref_xy: NDArray[np.float64],
    ref_branches: NDArray[np.int8],
    starts: NDArray[np.int32],
    grid: tuple[float, float, float],
    shape: tuple[int, int],
    j00: float,
    j01: float,
    j10: float,
    j11: float,
    min_cos: float,
) -> tuple[int, float]:
    """Return the number and distance of the nearest intersection of the map with agreeing branches, or (-1, `radius`).

    Parameters
    ----------
    x, y, radius : float
        Metres on the reference plane; intersections nearer than this count.
    branches, i, ref_branches, j00, j01, j10, j11, min_cos
        As in `rays_agree`.
    ref_xy : (N, 2) float64, starts : (B + 1,) int32
        The map's intersections, sorted by bucket (see `kernels.buckets`).
    """
    best, where = radius, -1
    if not abs(x) + abs(y) < 1e15:  # infinite or NaN: no bucket has such a number
        return where, best
    c0 = max(int(np.floor((x - radius - grid[0]) / grid[2])), 0)
    c1 = min(int(np.floor((x + radius - grid[0]) / grid[2])), shape[0] - 1)
    r0 = max(int(np.floor((y - radius - grid[1]) / grid[2])), 0)
    r1 = min(int(np.floor((y + radius - grid[1]) / grid[2])), shape[1] - 1)
    if c1 < c0:
        return where, best
    for r in range(r0, r1 + 1):
        for j in range(starts[r * shape[0] + c0], starts[r * shape[0] + c1 + 1]):
            dx, dy = ref_xy[j, 0] - x, ref_xy[j, 1] - y
            d = math.sqrt(dx * dx + dy * dy)
            if d < best and rays_agree(branches, i, ref_branches, j, j00, j01, j10, j11, min_cos):
                best, where = d, j
    return where, best


@kernel()
def keep_nearest(matched: NDArray[np.int64], distance: NDArray[np.float64]) -> int:
    """Let the nearest of several claimants keep a partner, the first of equals; return the number of matches left.

    Parameters
    ----------
    matched : (N,) int64
        Partners or -1; the losers' are set to -1.
    distance : (N,) float64
        Of each to its partner.
    """
    n = matched.shape[0]
    size = 4
    while size < 2 * n:
        size *= 2
    keeper = np.full(size, -1, np.int64)  # a hash table by partner, probed linearly
    count = 0
    for i in range(n):
        if matched[i] < 0:
            continue
        slot = (matched[i] * 40503) & (size - 1)
        while keeper[slot] >= 0 and matched[keeper[slot]] != matched[i]:
            slot = (slot + 1) & (size - 1)
        k = keeper[slot]
        if k < 0:
            keeper[slot] = i
            count += 1
        elif distance[i] < distance[k]:
            keeper[slot] = i
            matched[k] = -1
        else:
            matched[i] = -1
    return count


@kernel()
def grow(
    xy: NDArray[np.float64],
    branches: NDArray[np.int8],
    order: NDArray[np.int64],
    half_size: float,
    anchor: int,
    ref_anchor: int,
    affine: NDArray[np.float64],
    neighbours: NDArray[np.int32],
    partners: NDArray[np.int64],
    ref_xy: NDArray[np.float64],
    ref_branches: NDArray[np.int8],
    starts: NDArray[np.int32],
    grid: tuple[float, float, float],
    shape: tuple[int, int],
    sigma_m: float,
    radius_m: float,
    min_cos: float,
    perspective_sigma: float,
    hit_rate: float,
    chance_rate: float,
    patience: float,
    matched: NDArray[np.int64],
    distance: NDArray[np.float64],
    matrix: NDArray[np.float64],
) -> tuple[int, int, float]:
    """Grow a hypothesis from its seeds, give up early or match the whole query.

    Seeds are the anchor and its placed neighbours. Each further point is predicted, the nearest ones first, once its
    search radius, 2.5 of the prediction's own standard deviations, has come down to `radius_m`; matches refit the
    model. A sequential probability ratio test (Wald 1945) counts hits and misses and gives up below -`patience`. In the
    end all in `order` are matched anew, one to one, twice.

    Parameters
    ----------
    xy : (N, 2) float64, branches : (N, R, 2) int8
        The query's intersections.
    order : (M,) int64
        Query points by distance from the anchor: all of them or the nearest, the others are left out.
    half_size : float
        Of the frame, pixels.
    anchor, ref_anchor : int
        The anchor in the query, and the map intersection that it may be.
    affine : (4,) float64
        The 2 x 2 map, row-major, around them; not mirrored.
    neighbours : (N, K) int32, partners : (K,) int64
        `partners[s]` is the map intersection of query point `neighbours[anchor, s]`, or -1.
    ref_xy, ref_branches, starts
        As in `nearest_alike`.
    sigma_m, radius_m : float
        Standard deviation of a matched intersection, and the greatest search radius, metres.
    min_cos : float
        As in `rays_agree`.
    perspective_sigma : float
        Standard deviation of the two perspective parameters, a priori.
    hit_rate, chance_rate : float
        Share of points that meet a partner in the right place, and by chance.
    patience : float
        Nats.
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
    n = xy.shape[0]
    det = affine[0] * affine[3] - affine[1] * affine[2]
    unit = half_size * math.sqrt(det)
    query = np.empty((n, 2))
    image = np.zeros((n, 2))
    for i in range(n):
        query[i, 0] = (xy[i, 0] - xy[anchor, 0]) / half_size
        query[i, 1] = (xy[i, 1] - xy[anchor, 1]) / half_size
    x0, y0 = ref_xy[ref_anchor, 0], ref_xy[ref_anchor, 1]
    matched[:] = -1
    seed = np.zeros(n, np.bool_)
    matched[anchor] = ref_anchor
    seed[anchor] = True
    n_seeds = 1
    for s in range(neighbours.shape[1]):
        if partners[s] >= 0:
            i = neighbours[anchor, s]
            matched[i] = partners[s]
            seed[i] = True
            image[i, 0] = (ref_xy[partners[s], 0] - x0) / unit
            image[i, 1] = (ref_xy[partners[s], 1] - y0) / unit
            n_seeds += 1
    p = np.zeros(8)
    normal = np.empty((8, 8))
    factor = np.empty((8, 8))
    work = np.empty(8)
    prior = (sigma_m / unit) ** 2 / perspective_sigma**2
    for _ in range(2):
        if not fit_homography(query, image, matched, prior, p, normal, factor):
            return 0, 0, -np.inf
    gain = math.log(hit_rate / chance_rate)
    loss = math.log((1.0 - hit_rate) / (1.0 - chance_rate))
    ratio = 0.0
    tested = np.zeros(n, np.bool_)
    n_matched, n_tested = 0, 0
    fitted = n_seeds
    for _ in range(8):
        news = 0
        for index in range(order.shape[0]):
            i = order[index]
            if seed[i] or matched[i] >= 0 or tested[i]:
                continue
            u, v = query[i, 0], query[i, 1]
            px, py, w = predict(p, u, v)
            if w < 0.1:
                continue
            sigma = sigma_m * math.sqrt(0.5 * prediction_variance(factor, p, u, v, work))
            radius = 2.5 * math.sqrt(sigma * sigma + sigma_m * sigma_m)
            if radius > radius_m:
                continue
            j00 = (p[0] - px * p[6]) / w
            j01 = (p[1] - px * p[7]) / w
            j10 = (p[3] - py * p[6]) / w
            j11 = (p[4] - py * p[7]) / w
            j, d = nearest_alike(
                x0 + unit * px, y0 + unit * py, radius, branches, i, ref_xy, ref_branches, starts, grid, shape,
                j00, j01, j10, j11, min_cos,
            )  # fmt: skip
            tested[i] = True
            n_tested += 1
            if j < 0:
                ratio += loss
                if ratio < -patience:
                    return n_matched, n_tested, -np.inf
                continue
            ratio += gain
            matched[i] = j
            image[i, 0] = (ref_xy[j, 0] - x0) / unit
            image[i, 1] = (ref_xy[j, 1] - y0) / unit
            n_matched += 1
            news += 1
            if n_seeds + n_matched >= 1.2 * fitted:
                if not fit_homography(query, image, matched, prior, p, normal, factor):
                    return n_matched, n_tested, -np.inf
                fitted = n_seeds + n_matched
        if not fit_homography(query, image, matched, prior, p, normal, factor):
            return n_matched, n_tested, -np.inf
        if news == 0:
            break
    # The model now stands on all: match everything anew, one to one, and fit once more.
    for _ in range(2):
        n_matched, n_tested, ratio = 0, 0, 0.0
        matched[:] = -1
        for index in range(order.shape[0]):
            i = order[index]
            u, v = query[i, 0], query[i, 1]
            px, py, w = predict(p, u, v)
            if w < 0.1:
                continue
            sigma = sigma_m * math.sqrt(0.5 * prediction_variance(factor, p, u, v, work))
            radius = min(2.5 * math.sqrt(sigma * sigma + sigma_m * sigma_m), radius_m)
            j00 = (p[0] - px * p[6]) / w
            j01 = (p[1] - px * p[7]) / w
            j10 = (p[3] - py * p[6]) / w
            j11 = (p[4] - py * p[7]) / w
            j, d = nearest_alike(
                x0 + unit * px, y0 + unit * py, radius, branches, i, ref_xy, ref_branches, starts, grid, shape,
                j00, j01, j10, j11, min_cos,
            )  # fmt: skip
            distance[i] = d
            matched[i] = j
            if j < 0:
                continue
            image[i, 0] = (ref_xy[j, 0] - x0) / unit
            image[i, 1] = (ref_xy[j, 1] - y0) / unit
        keep_nearest(matched, distance)
        for index in range(order.shape[0]):
            i = order[index]
            if seed[i]:
                continue
            n_tested += 1
            if matched[i] >= 0:
                n_matched += 1
                ratio += gain
            else:
                ratio += loss
        if not fit_homography(query, image, matched, prior, p, normal, factor):
            return n_matched, n_tested, -np.inf
    # undo the normalisation: X = x0 + unit * predict((x - xa) / half_size)
    a, b = p[6] / half_size, p[7] / half_size
    c = 1.0 - a * xy[anchor, 0] - b * xy[anchor, 1]
    for axis in range(2):
        origin = x0 if axis == 0 else y0
        h0, h1 = p[3 * axis] / half_size, p[3 * axis + 1] / half_size
        h2 = p[3 * axis + 2] - h0 * xy[anchor, 0] - h1 * xy[anchor, 1]
        matrix[axis, 0] = unit * h0 + origin * a
        matrix[axis, 1] = unit * h1 + origin * b
        matrix[axis, 2] = unit * h2 + origin * c
    matrix[2, 0], matrix[2, 1], matrix[2, 2] = a, b, c
    return n_matched, n_tested, ratio


@kernel()
def grow_each(
    xy: Floats2,
    branches: Int8s3,
    order: Ints1,
    half_size: float,
    anchor: int,
    references: Ints1,
    affines: Floats2,
    neighbours: Int32s2,
    partners: Ints2,
    ref_xy: Floats2,
    ref_branches: Int8s3,
    starts: Int32s1,
    grid: tuple[float, float, float],
    shape: tuple[int, int],
    sigma: tuple[float, float],
    radius: tuple[float, float],
    min_cos: float,
    perspective_sigma: float,
    hit_rate: float,
    chance_rate: float,
    patience: float,
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
    sigma, radius : (metres, pixels)
        Both have a part in metres of the map and one in pixels of the query.
    min_matched : int
        Least matches besides the seeds.
    matched : (M, N) int64, matrices : (M, 3, 3) float64, ratios : (M,) float64
        Filled; a ratio of -inf: given up.
    """
    distance = np.empty(xy.shape[0])
    for m in range(references.shape[0]):
        affine = affines[m]
        gsd = math.sqrt(affine[0] * affine[3] - affine[1] * affine[2])
        n, _, ratio = grow(
            xy, branches, order, half_size, anchor, references[m], affine, neighbours, partners[m],
            ref_xy, ref_branches, starts, grid, shape,
            math.sqrt(sigma[0] ** 2 + (sigma[1] * gsd) ** 2), radius[0] + radius[1] * gsd, min_cos,
            perspective_sigma, hit_rate, chance_rate, patience, matched[m], distance, matrices[m],
        )  # fmt: skip
        ratios[m] = ratio if n >= min_matched else -np.inf


@kernel()
def match_all(
    matrix: Floats2,
    xy: Floats2,
    branches: Int8s3,
    radius: float,
    min_cos: float,
    shift_x: float,
    shift_y: float,
    one_to_one: bool,
    ref_xy: Floats2,
    ref_branches: Int8s3,
    starts: Int32s1,
    grid: tuple[float, float, float],
    shape: tuple[int, int],
    matched: Ints1,
    distance: Floats1,
) -> int:
    """Match every intersection of the query to the nearest one of the map with agreeing branches.

    Parameters
    ----------
    matrix : (3, 3) float64
        Query plane to reference plane; the shift, in metres, is added.
    xy : (N, 2) float64, branches : (N, R, 2) int8
        The query's intersections.
    radius : float
        Metres.
    min_cos : float
        As in `rays_agree`.
    one_to_one : bool
        Whether only the nearest of several claimants keeps an intersection.
    ref_xy, ref_branches, starts
        As in `nearest_alike`.
    matched : (N,) int64
        Filled with map intersections or -1.
    distance : (N,) float64
        Filled with metres, `radius` where there is none.

    Returns
    -------
    int
        Number of matches.
    """
    n = xy.shape[0]
    count = 0
    for i in range(n):
        matched[i] = -1
        distance[i] = radius
        u, v = xy[i, 0], xy[i, 1]
        w = matrix[2, 0] * u + matrix[2, 1] * v + matrix[2, 2]
        if w <= 0.0:
            continue
        x = (matrix[0, 0] * u + matrix[0, 1] * v + matrix[0, 2]) / w
        y = (matrix[1, 0] * u + matrix[1, 1] * v + matrix[1, 2]) / w
        matched[i], distance[i] = nearest_alike(
            x + shift_x, y + shift_y, radius, branches, i, ref_xy, ref_branches, starts, grid, shape,
            (matrix[0, 0] - x * matrix[2, 0]) / w, (matrix[0, 1] - x * matrix[2, 1]) / w,
            (matrix[1, 0] - y * matrix[2, 0]) / w, (matrix[1, 1] - y * matrix[2, 1]) / w,
            min_cos,
        )  # fmt: skip
        if matched[i] >= 0:
            count += 1
    return keep_nearest(matched, distance) if one_to_one else count


@kernel()
def count_matches(
    matrix: Floats2,
    xy: Floats2,
    branches: Int8s3,
    radius: float,
    min_cos: float,
    shifts: Floats2,
    ref_xy: Floats2,
    ref_branches: Int8s3,
    starts: Int32s1,
    grid: tuple[float, float, float],
    shape: tuple[int, int],
    counts: Ints1,
) -> None:
    """Fill `counts` (M,) with the number of matches under each of `shifts` (M, 2), metres (see `match_all`)."""
    matched = np.empty(xy.shape[0], np.int64)
    distance = np.empty(xy.shape[0])
    for m in range(shifts.shape[0]):
        counts[m] = match_all(
            matrix, xy, branches, radius, min_cos, shifts[m, 0], shifts[m, 1], False,
            ref_xy, ref_branches, starts, grid, shape, matched, distance,
        )  # fmt: skip
