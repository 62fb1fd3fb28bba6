"""Growth of a hypothesis: from a few matched intersections outwards over the whole query.

The model is a homography in normalised coordinates, query (x - xa) / s to reference (X - XA) / (s g), s being the query's half
size in pixels and g the ground sampling at the anchor, so that it is near a rotation. Its eight parameters
p = (h00 h01 h02 h10 h11 h12 h20 h21), h22 = 1, come from linear least squares with a prior on the two perspective ones: with few
matches it is an affine map, with many a homography. The same normal matrix predicts how far off a new point may be.
"""

import math

import numpy as np
from numba import njit

from roadgeo.kernels.rays import rays_agree


@njit(cache=True)
def cholesky(matrix, factor):
    """Fill `factor` with the lower Cholesky factor of a positive definite (n, n) matrix; return whether that worked."""
    n = matrix.shape[0]
    for i in range(n):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i == j:
                if total <= 1e-300:
                    return False
                factor[i, i] = math.sqrt(total)
            else:
                factor[i, j] = total / factor[j, j]
    return True


@njit(cache=True)
def solve_cholesky(factor, right):
    """Solve L L^T x = right in place."""
    n = factor.shape[0]
    for i in range(n):
        for k in range(i):
            right[i] -= factor[i, k] * right[k]
        right[i] /= factor[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            right[i] -= factor[k, i] * right[k]
        right[i] /= factor[i, i]


@njit(cache=True)
def fit_homography(query, image, matched, prior, p, normal, factor):
    """Fit the eight parameters `p` to the pairs query[i] -> image[i] with matched[i] >= 0; return whether that worked.

    Both are normalised coordinates; `prior` is the weight (1 / variance, in units of the residuals' variance) that holds the two
    perspective parameters near zero. The equations are divided by the previous w, so that residuals are distances.
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
    p[:] = right
    return True


@njit(cache=True)
def predict(p, u, v):
    """Return (X, Y, w) of a normalised query point."""
    w = 1.0 + p[6] * u + p[7] * v
    return (p[0] * u + p[1] * v + p[2]) / w, (p[3] * u + p[4] * v + p[5]) / w, w


@njit(cache=True)
def prediction_variance(factor, p, u, v, work):
    """Return the variance of a predicted point, summed over x and y, in units of the residuals' variance."""
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


@njit(cache=True)
def nearest_alike(x, y, radius, branches, i, ref_xy, ref_branches, starts, grid, shape, j00, j01, j10, j11, min_cos):
    """Return (reference id, distance) of the nearest intersection within `radius` whose rays agree, or (-1, radius)."""
    best, where = radius, -1
    c0 = int(np.floor((x - radius - grid[0]) / grid[2]))
    c1 = int(np.floor((x + radius - grid[0]) / grid[2]))
    r0 = int(np.floor((y - radius - grid[1]) / grid[2]))
    r1 = int(np.floor((y + radius - grid[1]) / grid[2]))
    for r in range(max(r0, 0), min(r1, shape[1] - 1) + 1):
        low = r * shape[0] + max(c0, 0)
        high = r * shape[0] + min(c1, shape[0] - 1)
        if high < low:
            continue
        for j in range(starts[low], starts[high + 1]):
            dx, dy = ref_xy[j, 0] - x, ref_xy[j, 1] - y
            d = math.sqrt(dx * dx + dy * dy)
            if d < best and rays_agree(branches, i, ref_branches, j, j00, j01, j10, j11, min_cos):
                best, where = d, j
    return where, best


@njit(cache=True)
def grow(
    xy, branches, order, half_size, anchor, ref_anchor, affine, neighbours, partners,
    ref_xy, ref_branches, starts, grid, shape,
    sigma_m, radius_m, min_cos, perspective_sigma, hit_rate, chance_rate, patience,
    matched, distance, matrix,
):  # fmt: skip
    """Grow a hypothesis; return (matches besides the seeds, points tested besides the seeds, log-likelihood ratio).

    `order` lists the query points by distance from the anchor. Seeds are the anchor and its placed neighbours
    (`partners[s]` >= 0 for column s of `neighbours[anchor]`). Each further point is predicted; its search radius grows with the
    prediction's own standard deviation up to `radius_m`. A sequential probability ratio test (`hit_rate` if true, `chance_rate` if not) gives up
    below -`patience` nats. On return `matched` (N) holds reference ids or -1, `distance` (N) metres, and `matrix` the 3 x 3
    homography from the query plane to the reference plane. A ratio of -inf: given up.
    """
    n = xy.shape[0]
    det = affine[0] * affine[3] - affine[1] * affine[2]
    gsd = math.sqrt(det)
    unit = half_size * gsd
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
        for index in range(n):
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
        for i in range(n):
            matched[i] = -1
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
        for i in range(n):
            for k in range(i):
                if matched[k] >= 0 and matched[k] == matched[i]:
                    loser = k if distance[i] < distance[k] else i
                    matched[loser] = -1
        for i in range(n):
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


@njit(cache=True)
def match_all(
    matrix, xy, branches, radius, min_cos, shift_x, shift_y, one_to_one,
    ref_xy, ref_branches, starts, grid, shape, matched, distance,
):  # fmt: skip
    """Match every query intersection to the nearest one of the map with agreeing rays; return the number of matches.

    The query is mapped by `matrix` and shifted. `matched` (N) holds reference ids or -1, `distance` (N) metres. With `one_to_one` the nearer of two
    claimants keeps an intersection.
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
    if not one_to_one:
        return count
    for i in range(n):
        for k in range(i):
            if matched[k] >= 0 and matched[k] == matched[i]:
                loser = k if distance[i] < distance[k] else i
                matched[loser] = -1
                count -= 1
    return count
