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

__all__ = [
    "PairBuckets",
    "PairQuery",
    "cross_ratios",
    "describe_pairs",
    "evaluate_pairs",
    "list_pairs",
    "nearest_of_type",
    "order_tree",
    "search_tree",
]

_MAX_TANGENTS = 8
_LEAF_SIZE = 8


class PairBuckets(NamedTuple):
    """Reference intersections sorted by square cells: cell c = W row + column owns places `starts[c]:starts[c + 1]`.

    Dimensions: N intersections, H rows, W columns.
    """

    origin: NDArray[Any]  # (2,) lower left corner, metres
    cell: float  # side of a cell, metres
    n_rows: int
    n_cols: int
    starts: NDArray[Any]  # (H W + 1,)
    items: NDArray[Any]  # (N,) the intersection at each place
    xy: NDArray[Any]  # (N, 2) its position
    codes: NDArray[Any]  # (N,) uint8, its type


class PairQuery(NamedTuple):
    """The query as a tuple (P1, P2) of its intersections sees it, in the tuple's frame."""

    uv: NDArray[Any]  # (N, 2) float64, intersections: those likely to miss come first, so that failures end soon
    codes: NDArray[Any]  # (N,) uint8, their types
    corners: NDArray[Any]  # (4, 2) float64, the image's
    cot_1: NDArray[Any]  # (N_q,) float64, cotangents of the tangents at P1 in the order in which they correspond
    cot_2: NDArray[Any]  # at P2


@kernel(error_model="numpy")
def list_pairs(xy, directions, codes, by_x, d_max, min_sine, out):  # type: ignore[no-untyped-def]
    """List the pairs nearer than `d_max` (eq. 8) whose tangents all leave the connecting line (eq. 7).

    Parameters
    ----------
    xy : (N, 2) float64
    directions : (N, R, 2) float64
        Unit vectors of the tangents; only the first N_q of each row are read.
    codes : (N,) uint8
    by_x : (N,) int64
        Intersections in order of x.
    d_max, min_sine : float
        Greatest distance; least |sine| between a tangent and the connecting line.
    out : (P, 2) int32
        Receives the pairs, the end of lesser code (then lesser number) first. With P = 0 they are only counted.

    Returns
    -------
    int
        Number of pairs.
    """
    n = 0
    for a in range(len(by_x)):
        i = by_x[a]
        for b in range(a + 1, len(by_x)):
            j = by_x[b]
            dx = xy[j, 0] - xy[i, 0]
            if dx >= d_max:
                break
            dy = xy[j, 1] - xy[i, 1]
            distance = math.sqrt(dx * dx + dy * dy)
            if distance >= d_max or distance == 0.0:
                continue
            limit = min_sine * distance
            if _near_line(directions, i, codes[i] & 15, dx, dy, limit):
                continue
            if _near_line(directions, j, codes[j] & 15, dx, dy, limit):
                continue
            if len(out) > 0:
                first = codes[i] < codes[j] or (codes[i] == codes[j] and i < j)
                out[n, 0] = i if first else j
                out[n, 1] = j if first else i
            n += 1
    return n


@kernel(error_model="numpy")
def _near_line(directions, i, n_tangents, dx, dy, limit):  # type: ignore[no-untyped-def]
    """Say whether any tangent of intersection i is nearly parallel to (dx, dy), or there are too few for eq. 9."""
    for k in range(n_tangents):
        if abs(dx * directions[i, k, 1] - dy * directions[i, k, 0]) <= limit:
            return True
    return n_tangents < 2


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
def describe_pairs(pairs, xy, tangents, codes, subsets, n_first, out):  # type: ignore[no-untyped-def]
    """Compute the cross-ratio descriptors d_c of pairs of one type (eq. 4).

    Parameters
    ----------
    pairs : (P, 2) int32
    xy : (N, 2) float64
    tangents : (N, R) float32
        Directions modulo pi.
    codes : (N,) uint8
    subsets : (D, 4) uint8
        The lines of each cross ratio (see `cross_ratios`): `n_first` rows for the first end, the rest for the second.
    out : (P, D) float32
        Receives the descriptors.
    """
    cot = np.empty(_MAX_TANGENTS)
    for p in range(len(pairs)):
        i, j = pairs[p, 0], pairs[p, 1]
        phi = math.atan2(xy[j, 1] - xy[i, 1], xy[j, 0] - xy[i, 0])
        _cotangents(tangents, i, codes[i] & 15, phi, cot)
        cross_ratios(cot, subsets[:n_first], out[p, :n_first])
        _cotangents(tangents, j, codes[j] & 15, phi, cot)
        cross_ratios(cot, subsets[n_first:], out[p, n_first:])


@kernel(error_model="numpy")
def cross_ratios(cot, subsets, out):  # type: ignore[no-untyped-def]
    """Compute cross ratios of concurrent lines: (a, b; c, d) = sin(ac) sin(bd) / (sin(bc) sin(ad)).

    For lines in rotational order they are greater than 1, so that a relative error (eq. 6) makes sense.

    Parameters
    ----------
    cot : (N_q,) float64
        Cotangents of the tangents, relative to the connecting line, in rotational order.
    subsets : (D, 4) uint8
        Four lines for each cross ratio, ascending: 0 is the connecting line, k the tangent of `cot[k - 1]`.
    out : (D,) float32 or float64
        Receives them.
    """
    for s in range(len(subsets)):
        b, c, d = cot[subsets[s, 1] - 1], cot[subsets[s, 2] - 1], cot[subsets[s, 3] - 1]
        if subsets[s, 0] == 0:  # the connecting line's cotangent is infinite: its two factors cancel
            out[s] = (b - d) / (b - c)
        else:
            a = cot[subsets[s, 0] - 1]
            out[s] = (a - c) * (b - d) / ((b - c) * (a - d))


@kernel()
def order_tree(values, order):  # type: ignore[no-untyped-def]
    """Reorder `order` into an implicit k-d tree over `values[order]`; nothing else is stored.

    The middle of a range [lo, hi) is its node: everything before it is not greater, everything after it not less, in
    dimension depth mod D. Ranges of up to 8 points are leaves.

    Parameters
    ----------
    values : (P, D) float32, D > 0
    order : (P,) int32
        A permutation, changed in place.
    """
    stack = np.empty((128, 3), np.int64)
    stack[0, 0], stack[0, 1], stack[0, 2] = 0, len(order), 0
    top = 1
    while top > 0:
        top -= 1
        lo, hi, dim = stack[top, 0], stack[top, 1], stack[top, 2]
        if hi - lo <= _LEAF_SIZE:
            continue
        middle = (lo + hi) // 2
        left, right = lo, hi - 1
        while left < right:  # Hoare's selection of the median
            pivot = values[order[(left + right) // 2], dim]
            i, j = left, right
            while i <= j:
                while values[order[i], dim] < pivot:
                    i += 1
                while values[order[j], dim] > pivot:
                    j -= 1
                if i <= j:
                    order[i], order[j] = order[j], order[i]
                    i += 1
                    j -= 1
            if middle <= j:
                right = j
            elif middle >= i:
                left = i
            else:
                break
        below = (dim + 1) % values.shape[1]
        stack[top, 0], stack[top, 1], stack[top, 2] = lo, middle, below
        stack[top + 1, 0], stack[top + 1, 1], stack[top + 1, 2] = middle + 1, hi, below
        top += 2


@kernel()
def search_tree(values, low, high, out):  # type: ignore[no-untyped-def]
    """Find the points of an implicit k-d tree (see `order_tree`) strictly inside a box.

    Parameters
    ----------
    values : (P, D) float32
        Points in tree order.
    low, high : (D,) float64
    out : (P,) int32
        Receives the rows found.

    Returns
    -------
    int
        Number of rows found.
    """
    n = 0
    stack = np.empty((128, 3), np.int64)
    stack[0, 0], stack[0, 1], stack[0, 2] = 0, len(values), 0
    top = 1
    while top > 0:
        top -= 1
        lo, hi, dim = stack[top, 0], stack[top, 1], stack[top, 2]
        is_leaf = hi - lo <= _LEAF_SIZE
        middle = (lo + hi) // 2
        for row in range(lo if is_leaf else middle, hi if is_leaf else middle + 1):
            inside = True
            for k in range(values.shape[1]):
                if not low[k] < values[row, k] < high[k]:
                    inside = False
                    break
            if inside:
                out[n] = row
                n += 1
        if is_leaf:
            continue
        below = (dim + 1) % values.shape[1]
        if values[middle, dim] > low[dim]:
            stack[top, 0], stack[top, 1], stack[top, 2] = lo, middle, below
            top += 1
        if values[middle, dim] < high[dim]:
            stack[top, 0], stack[top, 1], stack[top, 2] = middle + 1, hi, below
            top += 1
    return n


@kernel(error_model="numpy")
def _nearest(buckets, x, y, code, radius):  # type: ignore[no-untyped-def]
    """Return the place of the reference intersection of type `code` nearest to (x, y) within `radius`, or -1."""
    inverse = 1.0 / buckets.cell
    left = (x - radius - buckets.origin[0]) * inverse
    right = (x + radius - buckets.origin[0]) * inverse
    low = (y - radius - buckets.origin[1]) * inverse
    high = (y + radius - buckets.origin[1]) * inverse
    if not (right >= 0.0 and left < buckets.n_cols and high >= 0.0 and low < buckets.n_rows):
        return -1
    col_0, col_1 = int(max(left, 0.0)), int(min(right, buckets.n_cols - 1.0))
    row_0, row_1 = int(max(low, 0.0)), int(min(high, buckets.n_rows - 1.0))
    best = radius * radius
    found = -1
    for row in range(row_0, row_1 + 1):
        first = row * buckets.n_cols
        for slot in range(buckets.starts[first + col_0], buckets.starts[first + col_1 + 1]):
            if buckets.codes[slot] != code:
                continue
            dx = buckets.xy[slot, 0] - x
            dy = buckets.xy[slot, 1] - y
            squared = dx * dx + dy * dy
            if squared < best:
                best = squared
                found = slot
    return found


@kernel(error_model="numpy")
def nearest_of_type(xy, codes, buckets, radius, out):  # type: ignore[no-untyped-def]
    """Find for each point the nearest reference intersection of its own type.

    Parameters
    ----------
    xy : (N, 2) float64
        Reference plane, metres; NaN has no neighbour.
    codes : (N,) uint8
    buckets : PairBuckets
    radius : float
        Metres; a neighbour lies strictly nearer.
    out : (N,) int32
        Receives its number, or -1.
    """
    for q in range(len(xy)):
        place = _nearest(buckets, xy[q, 0], xy[q, 1], codes[q], radius)
        out[q] = buckets.items[place] if place >= 0 else -1


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
    query,
    pairs,
    rows,
    draws,
    xy,
    tangents,
    buckets,
    radius,
    is_physical,
    best,
    model,
    stamps,
):
    """Test a query tuple against candidates: H from all lines in closed form (eq. 9), inlier count (eq. 10), the best.

    Both planes are taken to frames where P1 = (0, 0) and P2 = (1, 0): a normalisation under which every homography
    that keeps the connecting line is ``[[a1, b1, 0], [0, 1, 0], [a1 - a2, b1 - b2, a2]]``, and eq. 9 falls apart into
    one linear equation cot r' = a_i cot r + b_i for each tangent at P_i. It is not mirrored and has no horizon between
    the two ends just if a1, a2 > 0.

    Parameters
    ----------
    query : PairQuery
    pairs : (P, 2) int32
        All reference tuples of this type.
    rows : (C,) int32
        The candidates among them; empty: all of them.
    draws : (4,) int64
        Draws number `draws[0]` up to `draws[1]`; draw j takes candidate (draws[2] + j draws[3]) mod C, which repeats
        none where draws[3] and C have no common divisor.
    xy : (M, 2) float64
        Of the reference.
    tangents : (M, R) float32
        Of the reference.
    buckets : PairBuckets
    radius : float
        Inlier distance, metres.
    is_physical : bool
        Demand a1, a2 > 0 and w > 0 over the whole frame.
    best : int
        The inlier count to beat.
    model : (8,) float64
        Receives a1, b1, a2, b2, P1' and P2' - P1' of the best hypothesis, if `best` was beaten.
    stamps : (M,) int64 or (0,)
        Scratch, less than any draw at first: each reference intersection counts once. Empty: as often as it is met.

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
    n_candidates = len(rows) if len(rows) > 0 else len(pairs)
    for draw in range(draws[0], draws[1]):
        chosen = (draws[2] + draw * draws[3]) % n_candidates
        row = rows[chosen] if len(rows) > 0 else chosen
        # The homography of a candidate, from the directions of the roads at its two ends.
        i, j = pairs[row, 0], pairs[row, 1]
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
