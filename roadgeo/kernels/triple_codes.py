"""Triples of neighbouring intersections: their affine-invariant codes, and the table of codes.

A triple (X, Y, Z), counterclockwise, is sent by an affine map to an equilateral triangle; two tangent lines at each
vertex then give six angles that hardly change from map to image. At a vertex with edge vectors e1, e2 to the next two
vertices, a direction d = alpha e1 + beta e2 has, against the axis towards the triangle's middle, the angle
atan2((beta - alpha) sin 30, (alpha + beta) cos 30). Angles are measured in units of pi / 72, in cells of 8 units (20
degrees).

Two sorted cells at a vertex make one of 45 pairs, three vertices one of 45^3 table cells. An entry is a uint64:
`anchor << 40 | slot of Y << 37 | slot of Z << 34 | sides << 24 | six positions within the cells`, slots being columns
of `neighbours`. Each position takes 4 bits of which the highest is 0: with that bit set as a guard, one subtraction
compares all six. `sides` holds the sides on which the road along a tangent leaves each vertex: most entries whose
angles agree differ in their sides, before anything else of the map is read. A cell's entries are sorted by `sides`.
"""

import math

import numpy as np
from numpy.typing import NDArray

from roadgeo.kernels.arrays import Floats2, Int8s2, Int8s3, Int32s2, Ints1, Singles2, UInt64s1
from roadgeo.kernels.compilation import kernel

UNITS = 72  # per half turn
CELL_UNITS = 8
CELLS = UNITS // CELL_UNITS
PAIRS = CELLS * (CELLS + 1) // 2
TABLE = PAIRS**3
MAX_NEIGHBOURS = 8  # slots take 3 bits
MAX_ANCHORS = 1 << 24
FORWARDS, BACKWARDS, BOTH = 0, 1, 2


@kernel()
def pair_id(low: int, high: int) -> int:
    """Return the number of the sorted pair of cells low <= high, from 0 to PAIRS - 1."""
    return low * CELLS - (low * (low - 1)) // 2 + (high - low)


@kernel()
def vertex_angle(e1x: float, e1y: float, e2x: float, e2y: float, tangent: float) -> float:
    """Return a direction's angle in the equilateral frame, in units, 0 <= angle < 2 UNITS (float)."""
    dx, dy = math.cos(tangent), math.sin(tangent)
    alpha = dx * e2y - dy * e2x
    beta = e1x * dy - e1y * dx
    angle = math.atan2((beta - alpha) * 0.5, (alpha + beta) * 0.8660254037844386)
    angle = angle * (UNITS / math.pi)
    return angle % (2 * UNITS)


@kernel(writes=("sides",))
def find_sides(tangents: Singles2, branches: Int8s3, sides: Int8s2) -> None:
    """Find on which sides branches (N, R, 2), as in `rays_agree`, run along each tangent (N, T), in radians.

    `sides` (N, T) is filled with FORWARDS, BACKWARDS or BOTH; BOTH too where no branch is found.
    """
    for i in range(tangents.shape[0]):
        for t in range(tangents.shape[1]):
            sides[i, t] = BOTH
            if np.isnan(tangents[i, t]):
                continue
            dx, dy = math.cos(tangents[i, t]), math.sin(tangents[i, t])
            forwards, backwards = False, False
            for r in range(branches.shape[1]):
                along = dx * branches[i, r, 0] + dy * branches[i, r, 1]
                forwards |= along > 0.87 * 127.0
                backwards |= along < -0.87 * 127.0
            if forwards != backwards:
                sides[i, t] = FORWARDS if forwards else BACKWARDS


@kernel()
def turned(side: int) -> int:
    """Return a side as seen from the other end."""
    return BOTH if side == BOTH else 1 - side


@kernel()
def vertex_codes(
    xy: NDArray[np.float64],
    tangents: NDArray[np.float32],
    sides: NDArray[np.int8],
    i: int,
    j: int,
    k: int,
    limit: int,
    out: NDArray[np.int64],
) -> int:
    """Write the codes of vertex i of the triangle i, j, k; return how many.

    A code is a sorted pair of units u1 <= u2, and 3 s1 + s2, the sides of the two (see `find_sides`) in the equilateral
    frame. Every pair of the vertex's tangents has a code; beyond `limit` codes, the pairs that cross at the largest
    angles are kept.
    """
    e1x, e1y = xy[j, 0] - xy[i, 0], xy[j, 1] - xy[i, 1]
    e2x, e2y = xy[k, 0] - xy[i, 0], xy[k, 1] - xy[i, 1]
    n = 0
    m = 0
    while m < tangents.shape[1] and not np.isnan(tangents[i, m]):
        m += 1
    openness = np.empty(limit, np.int64)
    units = np.empty(m, np.int64)
    seen = np.empty(m, np.int64)
    for p in range(m):
        units[p] = int(vertex_angle(e1x, e1y, e2x, e2y, tangents[i, p])) % (2 * UNITS)
        side = int(np.int64(sides[i, p]))
        seen[p] = side if units[p] < UNITS else turned(side)
        units[p] %= UNITS
    for p in range(m):
        for q in range(p + 1, m):
            between = min(abs(units[p] - units[q]), UNITS - abs(units[p] - units[q]))
            if n == limit and between <= openness[n - 1]:
                continue
            place = min(n, limit - 1)
            while place > 0 and openness[place - 1] < between:
                openness[place] = openness[place - 1]
                for column in range(3):  # a row at once would take numba a tenth of all compilation
                    out[place, column] = out[place - 1, column]
                place -= 1
            openness[place] = between
            first, second = (p, q) if units[p] <= units[q] else (q, p)
            out[place, 0], out[place, 1], out[place, 2] = units[first], units[second], 3 * seen[first] + seen[second]
            n = min(n + 1, limit)
    return n


@kernel()
def orient(xy: NDArray[np.float64], a: int, b: int, c: int, min_shape: float) -> int:
    """Return +1 if a, b, c run counterclockwise, -1 if clockwise, 0 if the triangle is too thin.

    The shape is twice the area over the square of the longest side: 0.87 for an equilateral triangle, 0 for a line.
    """
    abx, aby = xy[b, 0] - xy[a, 0], xy[b, 1] - xy[a, 1]
    acx, acy = xy[c, 0] - xy[a, 0], xy[c, 1] - xy[a, 1]
    bcx, bcy = acx - abx, acy - aby
    cross = abx * acy - aby * acx
    longest = max(abx * abx + aby * aby, acx * acx + acy * acy, bcx * bcx + bcy * bcy)
    if not abs(cross) > min_shape * longest:  # three points in one place are thin too
        return 0
    return 1 if cross > 0 else -1


@kernel()
def count_neighbours(neighbours: NDArray[np.int32], a: int) -> int:
    """Return how many neighbours an intersection has: they fill the first slots, -1 stands in the others."""
    n = 0
    while n < neighbours.shape[1] and neighbours[a, n] >= 0:
        n += 1
    return n


@kernel()
def neighbour_pair(
    xy: NDArray[np.float64], neighbours: NDArray[np.int32], a: int, s: int, t: int, min_shape: float
) -> tuple[int, int, int, int]:
    """Return b, c and their slots: neighbours s and t of a, counterclockwise; b = -1 where the triangle is too thin."""
    b, c = int(np.int64(neighbours[a, s])), int(np.int64(neighbours[a, t]))  # the same type everywhere
    turn = orient(xy, a, b, c, min_shape)
    if turn == 0:
        return -1, -1, s, t
    return (b, c, s, t) if turn > 0 else (c, b, t, s)


@kernel()
def has_both(neighbours: NDArray[np.int32], i: int, j: int, k: int) -> bool:
    """Whether j and k both stand among the neighbours of i."""
    found = 0
    for s in range(neighbours.shape[1]):
        if neighbours[i, s] == j or neighbours[i, s] == k:
            found += 1
    return found == 2


@kernel()
def triple_codes(
    xy: NDArray[np.float64],
    tangents: NDArray[np.float32],
    sides: NDArray[np.int8],
    a: int,
    b: int,
    c: int,
    limit: int,
    codes: NDArray[np.int64],
    n: NDArray[np.int64],
) -> None:
    """Fill `codes[v, :n[v]]` for the three vertices of the counterclockwise triangle a, b, c."""
    n[0] = vertex_codes(xy, tangents, sides, a, b, c, limit, codes[0])
    n[1] = vertex_codes(xy, tangents, sides, b, c, a, limit, codes[1])
    n[2] = vertex_codes(xy, tangents, sides, c, a, b, limit, codes[2])


@kernel(writes=("starts", "entries"))
def fill_table(
    xy: Floats2,
    tangents: Singles2,
    sides: Int8s2,
    neighbours: Int32s2,
    min_shape: float,
    limit: int,
    starts: Ints1,
    entries: UInt64s1,
) -> int:
    """Count codes per table cell, or write the entries.

    With an empty `entries`, `starts[cell + 1]` is incremented for every code. Otherwise `starts` holds each cell's
    first free place, and is moved on as entries are written. A triple that several vertices could anchor is stored
    once, by the lowest of them.
    """
    write = entries.shape[0] > 0
    codes = np.empty((3, limit, 3), np.int64)
    n = np.empty(3, np.int64)
    total = 0
    for a in range(xy.shape[0]):
        n_around = count_neighbours(neighbours, a)
        for s in range(n_around):
            for t in range(s + 1, n_around):
                b, c, sb, sc = neighbour_pair(xy, neighbours, a, s, t, min_shape)
                if b < 0:
                    continue
                # Several vertices could anchor it: the lowest does.
                if (b < a and has_both(neighbours, b, a, c)) or (c < a and has_both(neighbours, c, a, b)):
                    continue
                # One entry for every combination of the codes of its three vertices.
                triple_codes(xy, tangents, sides, a, b, c, limit, codes, n)
                for p in range(n[0]):
                    for q in range(n[1]):
                        for r in range(n[2]):
                            cell = 0
                            fine, around = np.uint64(0), np.uint64(0)
                            for v in range(3):
                                w = p if v == 0 else (q if v == 1 else r)
                                u1, u2 = codes[v, w, 0], codes[v, w, 1]
                                cell = cell * PAIRS + pair_id(u1 // CELL_UNITS, u2 // CELL_UNITS)
                                fine = (fine << np.uint64(8)) | np.uint64((u1 % CELL_UNITS) * 16 + u2 % CELL_UNITS)
                                around = around * np.uint64(9) + np.uint64(codes[v, w, 2])
                            if write:
                                head = (np.uint64(a) << np.uint64(40)) | (np.uint64((sb << 3) | sc) << np.uint64(34))
                                entries[starts[cell]] = head | (around << np.uint64(24)) | fine
                                starts[cell] += 1
                            else:
                                starts[cell + 1] += 1
                            total += 1
    return total
