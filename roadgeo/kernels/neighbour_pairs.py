"""Pairs of neighbouring intersections: their cotangents, and the map's pairs that look like one of the query's.

In frames where a pair's two ends are (0, 0) and (1, 0), every affine map that keeps them takes the cotangent c of a
direction to alpha c + beta, alpha > 0 where it is not mirrored: eq. 9 of the paper with the same two numbers at both
ends. Two tangents at each end give four equations for two unknowns.

A pair is (c1, c2, c3, c4, spread): falling cotangents of two tangents at the first end, then at the second, relative to
the connecting line, and log (c1 - c2) - log (c3 - c4), which an affine map leaves alone.
"""

import math

import numpy as np
from numpy.typing import NDArray

from roadgeo.kernels.compilation import kernel
from roadgeo.kernels.growth import nearest_alike
from roadgeo.kernels.rays import rays_agree

__all__ = [
    "MISFIT",
    "count_pairs",
    "describe_end",
    "describe_pair",
    "find_pairs",
    "fit_pencils",
    "list_neighbour_pairs",
]

#: What `fit_pencils` returns where no map that is not mirrored fits.
MISFIT = 1e9


@kernel()
def describe_end(tangents: NDArray[np.float64], line: float, min_sine: float, out: NDArray[np.float64]) -> bool:
    """Fill `out` (2,) with the falling cotangents of the two tangents that cross most openly; False: too few.

    `tangents` (R,) are radians, NaN behind the last; those within asin `min_sine` of the direction `line` do not count.
    """
    widest = min_sine
    for p in range(tangents.shape[0]):
        if np.isnan(tangents[p]):
            break
        sin_p = math.sin(tangents[p] - line)
        for q in range(p):
            sin_q = math.sin(tangents[q] - line)
            open_by = abs(math.sin(tangents[p] - tangents[q]))
            if min(abs(sin_p), abs(sin_q)) < min_sine or open_by <= widest:
                continue
            widest = open_by
            cot_p, cot_q = math.cos(tangents[p] - line) / sin_p, math.cos(tangents[q] - line) / sin_q
            out[0], out[1] = max(cot_p, cot_q), min(cot_p, cot_q)
    return widest > min_sine


@kernel()
def describe_pair(
    xy: NDArray[np.float64],
    tangents: NDArray[np.float64],
    a: int,
    b: int,
    min_sine: float,
    out: NDArray[np.float64],
) -> bool:
    """Fill `out` (5,) with the description of the pair (a, b); False: an end has no two usable tangents.

    Parameters
    ----------
    xy : (N, 2) float64, tangents : (N, R) float64
        Radians, NaN behind the last.
    min_sine : float
        Least |sine| of the angles between tangents and connecting line, and between the two tangents.
    """
    line = math.atan2(xy[b, 1] - xy[a, 1], xy[b, 0] - xy[a, 0])
    if not (describe_end(tangents[a], line, min_sine, out[:2]) and describe_end(tangents[b], line, min_sine, out[2:4])):
        return False
    out[4] = math.log(out[0] - out[1]) - math.log(out[2] - out[3])
    return True


@kernel()
def list_neighbour_pairs(
    xy: NDArray[np.float64],
    tangents: NDArray[np.float64],
    neighbours: NDArray[np.int32],
    min_sine: float,
    ends: NDArray[np.int32],
    pairs: NDArray[np.float64],
) -> int:
    """Describe every intersection with each of its neighbours (N, K); return how many pairs were described.

    `ends` and `pairs`, of at least N K rows, are filled with the numbers of both ends and the descriptions.
    """
    n = 0
    for a in range(xy.shape[0]):
        for s in range(neighbours.shape[1]):
            b = neighbours[a, s]
            if b < 0:
                break
            if describe_pair(xy, tangents, a, b, min_sine, pairs[n]):
                ends[n, 0], ends[n, 1] = a, b
                n += 1
    return n


@kernel()
def fit_pencils(query: NDArray[np.float64], reference: NDArray[np.float64], model: NDArray[np.float64]) -> float:
    """Fit c' = alpha c + beta to the four cotangents of two pairs; return the sum of squared errors in rad^2.

    Each equation is weighted by its inverse variance when all angles carry equal noise (see `kernels.pairs`), so that
    the sum is in units of that noise's variance. `model` (2,) is filled with alpha, beta.
    """
    alpha = math.sqrt(
        (reference[0] - reference[1]) * (reference[2] - reference[3])
        / ((query[0] - query[1]) * (query[2] - query[3]))
    )  # fmt: skip
    error = MISFIT
    for _ in range(2):
        sw, sx, sy, sxx, sxy, syy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(4):
            x, y = query[k], reference[k]
            of_query, of_reference = alpha * (1.0 + x * x), 1.0 + y * y
            w = 1.0 / (of_query * of_query + of_reference * of_reference)
            sw += w
            sx += w * x
            sy += w * y
            sxx += w * x * x
            sxy += w * x * y
            syy += w * y * y
        alpha = (sw * sxy - sx * sy) / (sw * sxx - sx * sx)
        if not alpha > 0.0:
            return MISFIT
        beta = (sy - alpha * sx) / sw
        error = syy - alpha * sxy - beta * sy
        model[0], model[1] = alpha, beta
    return error


@kernel()
def count_pairs(
    pair: NDArray[np.float64], spread: float, max_error: float, pairs: NDArray[np.float64], step: int
) -> int:
    """Count the pairs that look like `pair` (5,) among every `step`-th of `pairs` (P, 5); bounds as in `find_pairs`."""
    model = np.empty(2)
    n = 0
    for row in range(0, pairs.shape[0], step):
        if abs(pairs[row, 4] - pair[4]) <= spread and fit_pencils(pair, pairs[row], model) <= max_error:
            n += 1
    return n


@kernel()
def find_pairs(
    xy: NDArray[np.float64],
    branches: NDArray[np.int8],
    neighbours: NDArray[np.int32],
    a: int,
    b: int,
    pair: NDArray[np.float64],
    spread: float,
    max_error: float,
    scale: tuple[float, float],
    min_ratio: float,
    min_cos: float,
    reach: tuple[float, float, float],
    least: int,
    ref_xy: NDArray[np.float64],
    ref_branches: NDArray[np.int8],
    starts: NDArray[np.int32],
    grid: tuple[float, float, float],
    shape: tuple[int, int],
    ends: NDArray[np.int32],
    pairs: NDArray[np.float64],
    out_ids: NDArray[np.int64],
    out_affine: NDArray[np.float64],
    out_placed: NDArray[np.int64],
) -> tuple[int, int]:
    """Find the map's pairs that look like the query's pair (a, b) and put more of a's neighbours on intersections.

    Parameters
    ----------
    pair : (5,) float64
        Description of (a, b).
    spread, max_error : float
        Greatest difference of the last number of two pairs, and greatest sum of squared errors (`fit_pencils`).
    scale, min_ratio, min_cos
        As in `kernels.triples.look_up`.
    reach : (least, share, greatest)
        A neighbour counts as placed where an intersection with agreeing branches lies within `least` metres and this
        share of its distance from a, in all at most `greatest` metres.
    least : int
        Neighbours to be placed, b among them.
    ends : (P, 2) int32, pairs : (P, 5) float64
        The map's pairs.
    out_ids : (M, 1 + K) int64, out_affine : (M, 4) float64, out_placed : (M,) int64
        Filled with the map intersection of a and of its K neighbours (or -1), the map around a, and how many are
        placed.

    Returns
    -------
    found, alike : int
        Rows filled, and pairs whose tangents fit.
    """
    model = np.empty(2)
    n, alike = 0, 0
    dx, dy = xy[b, 0] - xy[a, 0], xy[b, 1] - xy[a, 1]
    square = dx * dx + dy * dy
    for row in range(ends.shape[0]):
        if abs(pairs[row, 4] - pair[4]) > spread or fit_pencils(pair, pairs[row], model) > max_error:
            continue
        alike += 1
        i, j = ends[row, 0], ends[row, 1]
        ex, ey = ref_xy[j, 0] - ref_xy[i, 0], ref_xy[j, 1] - ref_xy[i, 1]
        # In the pair's frame the map is [[1, m01], [0, m11]].
        m01, m11 = model[1] / model[0], 1.0 / model[0]
        larger = (ex * ex + ey * ey) / square
        det = larger * m11
        # singular values s1 >= s2: s1 s2 = det, s1^2 + s2^2 = |J|^2
        norm = larger * (1.0 + m01 * m01 + m11 * m11)
        if not scale[0] ** 2 <= det <= scale[1] ** 2 or norm * min_ratio > det * (1.0 + min_ratio * min_ratio):
            continue
        p00, p01 = (dx - m01 * dy) / square, (dy + m01 * dx) / square
        p10, p11 = -m11 * dy / square, m11 * dx / square
        j00, j01 = ex * p00 - ey * p10, ex * p01 - ey * p11
        j10, j11 = ey * p00 + ex * p10, ey * p01 + ex * p11
        if not (
            rays_agree(branches, a, ref_branches, i, j00, j01, j10, j11, min_cos)
            and rays_agree(branches, b, ref_branches, j, j00, j01, j10, j11, min_cos)
        ):
            continue
        if n == out_ids.shape[0]:
            break
        placed = 0
        for s in range(neighbours.shape[1]):
            out_ids[n, 1 + s] = -1
            k = neighbours[a, s]
            if k < 0:
                continue
            where = j
            if k != b:
                u, v = xy[k, 0] - xy[a, 0], xy[k, 1] - xy[a, 1]
                x, y = j00 * u + j01 * v, j10 * u + j11 * v
                radius = min(reach[0] + reach[1] * math.sqrt(x * x + y * y), reach[2])
                where, _ = nearest_alike(
                    ref_xy[i, 0] + x, ref_xy[i, 1] + y, radius, branches, k, ref_xy, ref_branches, starts, grid, shape,
                    j00, j01, j10, j11, min_cos,
                )  # fmt: skip
                if where in (i, j):
                    where = -1
            if where >= 0:
                out_ids[n, 1 + s] = where
                placed += 1
        if placed < least:
            continue
        out_ids[n, 0] = i
        out_affine[n, 0], out_affine[n, 1], out_affine[n, 2], out_affine[n, 3] = j00, j01, j10, j11
        out_placed[n] = placed
        n += 1
    return n, alike
