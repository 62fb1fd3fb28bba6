"""Kernels of the paper's matcher: pairs of intersections, their cross ratios, and hypotheses tested on a bucket grid.

Notation. At each end of a pair (P1, P2) every tangent has an angle r in (0, pi), counterclockwise from the connecting
line l; its cotangent falls as r grows, so "sorted in one rotational sense, starting from l" is "falling cotangents".
`codes` are intersection types, 16 N_B + N_q; `buckets` is a `PairBuckets`. Arrays of the reference are
read-only, so that one compiled version serves built and memory-mapped indices alike.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from roadgeo.kernels.compilation import kernel

__all__ = ["PairBuckets", "PairQuery", "evaluate_pairs"]

_MAX_TANGENTS = 8


class PairBuckets(NamedTuple):
    """Reference intersections sorted by bucket (see `kernels.buckets`)."""

    xy: NDArray[Any]  # (N, 2)
    codes: NDArray[Any]  # (N,) their types
    starts: NDArray[Any]  # (B + 1,)
    grid: tuple[float, float, float]
    shape: tuple[int, int]


class PairQuery(NamedTuple):
    """The query as a tuple (P1, P2) of its intersections sees it, in the tuple's frame."""

    uv: NDArray[Any]  # (N, 2) float64, intersections: those likely to miss come first, so that failures end soon
    codes: NDArray[Any]  # (N,) uint8, their types
    corners: NDArray[Any]  # (4, 2) float64, the image's
    cot_1: NDArray[Any]  # (N_q,) float64, cotangents of the tangents at P1 in the order in which they correspond
    cot_2: NDArray[Any]  # at P2


@kernel(error_model="numpy")
def _cotangents(tangents, i, n_tangents, phi, out):  # type: ignore[no-untyped-def]
    """Write the cotangents of intersection i's tangents relative to a line of direction `phi`, falling."""
    for k in range(n_tangents):
        r = np.float64(tangents[i, k]) - phi
        value = math.cos(r) / math.sin(r)
        slot = k
        while slot > 0 and out[slot - 1] < value:
            out[slot] = out[slot - 1]
            slot -= 1
        out[slot] = value


@kernel(error_model="numpy")
def _nearest(buckets, x, y, code, radius):  # type: ignore[no-untyped-def]
    """Return the place of the reference intersection of type `code` nearest to (x, y) within `radius`, or -1."""
    xy, codes, starts, grid, shape = buckets
    left, right = (x - radius - grid[0]) / grid[2], (x + radius - grid[0]) / grid[2]
    low, high = (y - radius - grid[1]) / grid[2], (y + radius - grid[1]) / grid[2]
    if not (right >= 0.0 and left < shape[0] and high >= 0.0 and low < shape[1]):  # NaN neither
        return -1
    first, last = int(max(left, 0.0)), int(min(right, shape[0] - 1.0))
    best, found = radius * radius, -1
    for row in range(int(max(low, 0.0)), int(min(high, shape[1] - 1.0)) + 1):
        for slot in range(starts[row * shape[0] + first], starts[row * shape[0] + last + 1]):
            if codes[slot] != code:
                continue
            dx, dy = xy[slot, 0] - x, xy[slot, 1] - y
            squared = dx * dx + dy * dy
            if squared < best:
                best, found = squared, slot
    return found


@kernel(error_model="numpy")
def _fit_pencil(query, reference, n):  # type: ignore[no-untyped-def]
    """Fit cot r' = alpha cot r + beta to n corresponding lines of two pencils: exact for two, gold standard for more.

    Each line is weighted by the inverse variance of its equation when all angles r, r' carry equal noise (the Sampson
    error, Hartley & Zisserman 4.2.6), from d cot r = -(1 + cot^2 r) dr.
    """
    alpha = (reference[0] - reference[n - 1]) / (query[0] - query[n - 1])
    beta = reference[0] - alpha * query[0]
    for _ in range(3 if n > 2 else 0):
        sw = sx = sy = sxx = sxy = 0.0
        for k in range(n):
            of_query = alpha * (1.0 + query[k] * query[k])
            of_reference = 1.0 + reference[k] * reference[k]
            w = 1.0 / (of_query * of_query + of_reference * of_reference)
            sw += w
            sx += w * query[k]
            sy += w * reference[k]
            sxx += w * query[k] * query[k]
            sxy += w * query[k] * reference[k]
        alpha = (sw * sxy - sx * sy) / (sw * sxx - sx * sx)
        beta = (sy - alpha * sx) / sw
    return alpha, beta


@kernel(error_model="numpy")
def _count_inliers(uv, codes, buckets, model, radius, least, stamps, stamp):  # type: ignore[no-untyped-def]
    """Count query intersections that land near a reference intersection of their type, while `least` can be beaten."""
    alpha_1, beta_1, alpha_2, beta_2, x, y, dx, dy = model
    misses_left = len(uv) - least
    inliers = 0
    for q in range(len(uv)):
        u, v = uv[q, 0], uv[q, 1]
        w = 1.0 / ((alpha_1 - alpha_2) * u + (beta_1 - beta_2) * v + alpha_2)
        along = (alpha_1 * u + beta_1 * v) * w
        across = v * w
        place = _nearest(buckets, x + dx * along - dy * across, y + dy * along + dx * across, codes[q], radius)
        if place >= 0 and (len(stamps) == 0 or stamps[place] != stamp):
            if len(stamps) > 0:
                stamps[place] = stamp
            inliers += 1
        else:
            misses_left -= 1
            if misses_left <= 0:
                return -1
    return inliers


@kernel(error_model="numpy")
def evaluate_pairs(  # type: ignore[no-untyped-def]
    query, candidates, xy, tangents, buckets, radius, is_physical, one_to_one, best, model
):
    """Test a query tuple against candidates: H from all lines in closed form (eq. 9), inlier count (eq. 10), the best.

    Both planes are taken to frames where P1 = (0, 0) and P2 = (1, 0): a normalisation under which every homography
    that keeps the connecting line is ``[[a1, b1, 0], [0, 1, 0], [a1 - a2, b1 - b2, a2]]``, and eq. 9 falls apart into
    one linear equation cot r' = a_i cot r + b_i for each tangent at P_i. It is not mirrored and has no horizon between
    the two ends just if a1, a2 > 0.

    Parameters
    ----------
    query : PairQuery
    candidates : (C, 2) int64
        Reference tuples.
    xy : (M, 2) float64
        Of the reference.
    tangents : (M, R) float32
        Of the reference.
    buckets : PairBuckets
    radius : float
        Inlier distance, metres.
    is_physical : bool
        Demand a1, a2 > 0 and w > 0 over the whole frame.
    one_to_one : bool
        Each reference intersection counts once; else as often as it is met.
    best : int
        The inlier count to beat.
    model : (8,) float64
        Receives a1, b1, a2, b2, P1' and P2' - P1' of the best hypothesis, if `best` was beaten.

    Returns
    -------
    best : int
        The best inlier count, or `best` as given.
    n_models : int
        Hypotheses whose inliers were counted.
    """
    n_models = 0
    corners = query.corners
    found_1 = np.empty(_MAX_TANGENTS)
    found_2 = np.empty(_MAX_TANGENTS)
    stamps = np.full(len(xy) if one_to_one else 0, -1, np.int64)  # of the last candidate that met each of them
    for draw in range(len(candidates)):
        # The homography of a candidate, from the directions of the roads at its two ends.
        i, j = candidates[draw, 0], candidates[draw, 1]
        x, y = xy[i, 0], xy[i, 1]
        dx, dy = xy[j, 0] - x, xy[j, 1] - y
        phi = math.atan2(dy, dx)
        _cotangents(tangents, i, len(query.cot_1), phi, found_1)
        _cotangents(tangents, j, len(query.cot_2), phi, found_2)
        alpha_1, beta_1 = _fit_pencil(query.cot_1, found_1, len(query.cot_1))
        alpha_2, beta_2 = _fit_pencil(query.cot_2, found_2, len(query.cot_2))
        # A camera sees it only where neither end is mirrored and no corner lies beyond the horizon.
        if is_physical:
            ahead = alpha_1 > 0.0 and alpha_2 > 0.0
            for c in range(4):
                w = (alpha_1 - alpha_2) * corners[c, 0] + (beta_1 - beta_2) * corners[c, 1] + alpha_2
                ahead = ahead and w > 0.0
            if not ahead:
                continue
        n_models += 1
        trial = (alpha_1, beta_1, alpha_2, beta_2, x, y, dx, dy)
        inliers = _count_inliers(query.uv, query.codes, buckets, trial, radius, best, stamps, draw)
        if inliers > best:
            best = inliers
            for k in range(8):
                model[k] = trial[k]
    return best, n_models
