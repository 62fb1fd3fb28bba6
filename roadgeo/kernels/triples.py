"""Triples of neighbouring intersections: their affine-invariant codes, the table of codes, and its look-up.

A triple (X, Y, Z), counterclockwise, is sent by an affine map to an equilateral triangle; two tangent lines at each
vertex then give six angles that hardly change from map to image. At a vertex with edge vectors e1, e2 to the next two
vertices, a direction d = alpha e1 + beta e2 has, against the axis towards the triangle's middle, the angle
atan2((beta - alpha) sin 30, (alpha + beta) cos 30). Angles are measured in units of pi / 72, in cells of 8 units (20
degrees).

Two sorted cells at a vertex make one of 45 pairs, three vertices one of 45^3 table cells. An entry is a uint64:
`anchor << 40 | slot of Y << 37 | slot of Z << 34 | sides << 24 | six positions within the cells`, slots being columns
of `neighbours`. Each position takes 4 bits of which the highest is 0: with that bit set as a guard, one subtraction
compares all six. `sides` says on which sides of each vertex the road along a tangent leaves it: most entries whose
angles agree are told apart by them, before anything else of the map is read.
"""

import math

import numpy as np
from numpy.typing import NDArray

from roadgeo.kernels.arrays import Floats2, Int8s2, Int8s3, Int32s1, Int32s2, Ints1, Ints2, Ints3, Singles2, UInt64s1
from roadgeo.kernels.compilation import kernel
from roadgeo.kernels.rays import rays_agree

UNITS = 72  # per half turn
CELL_UNITS = 8
GUARDS = 0x888888
CELLS = UNITS // CELL_UNITS
PAIRS = CELLS * (CELLS + 1) // 2
TABLE = PAIRS**3
MAX_NEIGHBOURS = 8  # slots take 3 bits
MAX_ANCHORS = 1 << 24
FORWARDS, BACKWARDS, BOTH = 0, 1, 2

#: Bit r of `ALIKE[q]`: whether sides r of a vertex of the map are those of q or more, or fewer, on both tangents.
ALIKE = np.array(
    [
        sum(
            1 << r
            for r in range(9)
            if (q // 3 in (r // 3, BOTH) and q % 3 in (r % 3, BOTH))
            or (r // 3 in (q // 3, BOTH) and r % 3 in (q % 3, BOTH))
        )
        for q in range(9)
    ],
    np.int64,
)


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


@kernel()
def find_sides(tangents: Singles2, branches: Int8s3, sides: Int8s2) -> None:
    """Find on which sides branches run along each tangent.

    Parameters
    ----------
    tangents : (N, T) float32
        Directions in radians, NaN behind the last.
    branches : (N, R, 2) int8
        As in `rays_agree`.
    sides : (N, T) int8
        Filled with FORWARDS, BACKWARDS or BOTH; BOTH too where no branch is found.
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

    A code is a sorted pair of units u1 <= u2, and 3 s1 + s2, the sides of the two (see `find_sides`) as the equilateral
    frame sees them. There is one for every two of the vertex's tangents; of more than `limit`, those that cross most
    openly.
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
                out[place] = out[place - 1]
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


@kernel()
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
        for s in range(neighbours.shape[1]):
            b0 = int(np.int64(neighbours[a, s]))  # of one type everywhere, vertex_codes is compiled once
            if b0 < 0:
                break
            for t in range(s + 1, neighbours.shape[1]):
                c0 = int(np.int64(neighbours[a, t]))
                if c0 < 0:
                    break
                turn = orient(xy, a, b0, c0, min_shape)
                if turn == 0:
                    continue
                if (b0 < a and has_both(neighbours, b0, a, c0)) or (c0 < a and has_both(neighbours, c0, a, b0)):
                    continue
                b, c, sb, sc = (b0, c0, s, t) if turn > 0 else (c0, b0, t, s)
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


@kernel()
def vertex_probes(code: NDArray[np.int64], tolerance: int, probes: NDArray[np.int64]) -> int:
    """Write (pair, lows, highs, alike) for every pair of cells that may hold a vertex's `code`; return how many.

    Units may differ by `tolerance`. Lows and highs are the bounds of the entry's two positions within their cells,
    packed like them: first << 4 | second. Bit r of `alike` is set where the entry's sides may be r. A tangent that is
    found across the half turn is seen from its other end.
    """
    n = 0
    u1, u2 = code[0], code[1]
    for c1 in range((u1 - tolerance) // CELL_UNITS, (u1 + tolerance) // CELL_UNITS + 1):
        low1 = max(u1 - tolerance - c1 * CELL_UNITS, 0)
        high1 = min(u1 + tolerance - c1 * CELL_UNITS, CELL_UNITS - 1)
        s1 = c1 % CELLS
        side1 = code[2] // 3 if 0 <= c1 < CELLS else turned(code[2] // 3)
        for c2 in range((u2 - tolerance) // CELL_UNITS, (u2 + tolerance) // CELL_UNITS + 1):
            low2 = max(u2 - tolerance - c2 * CELL_UNITS, 0)
            high2 = min(u2 + tolerance - c2 * CELL_UNITS, CELL_UNITS - 1)
            s2 = c2 % CELLS
            side2 = code[2] % 3 if 0 <= c2 < CELLS else turned(code[2] % 3)
            if s1 <= s2:
                probes[n, 0] = pair_id(s1, s2)
                probes[n, 1] = low1 << 4 | low2
                probes[n, 2] = high1 << 4 | high2
                probes[n, 3] = ALIKE[3 * side1 + side2]
                n += 1
            if s2 <= s1 and not (s1 == s2 and low1 == low2 and high1 == high2 and side1 == side2):
                probes[n, 0] = pair_id(s2, s1)
                probes[n, 1] = low2 << 4 | low1
                probes[n, 2] = high2 << 4 | high1
                probes[n, 3] = ALIKE[3 * side2 + side1]
                n += 1
    return n


@kernel()
def count_alike(
    xy: Floats2,
    tangents: Singles2,
    sides: Int8s2,
    neighbours: Int32s2,
    anchors: Ints1,
    min_shape: float,
    limit: int,
    starts: Int32s1,
    costs: Ints3,
) -> None:
    """Fill `costs[i, s, t]` with the number of table entries in the cells of a triple (anchors[i], slot s, slot t).

    -1 where there is no such triple. It says how common a triple is on the map: cheap ones are looked up first.
    """
    codes = np.empty((3, limit, 3), np.int64)
    n = np.empty(3, np.int64)
    costs[:] = -1
    for i in range(anchors.shape[0]):
        a = anchors[i]
        for s in range(neighbours.shape[1]):
            b0 = int(np.int64(neighbours[a, s]))  # of one type everywhere, vertex_codes is compiled once
            if b0 < 0:
                break
            for t in range(s + 1, neighbours.shape[1]):
                c0 = int(np.int64(neighbours[a, t]))
                if c0 < 0:
                    break
                turn = orient(xy, a, b0, c0, min_shape)
                if turn == 0:
                    continue
                b, c = (b0, c0) if turn > 0 else (c0, b0)
                triple_codes(xy, tangents, sides, a, b, c, limit, codes, n)
                total = 0
                for p in range(n[0]):
                    for q in range(n[1]):
                        for r in range(n[2]):
                            k0 = pair_id(codes[0, p, 0] // CELL_UNITS, codes[0, p, 1] // CELL_UNITS)
                            k1 = pair_id(codes[1, q, 0] // CELL_UNITS, codes[1, q, 1] // CELL_UNITS)
                            k2 = pair_id(codes[2, r, 0] // CELL_UNITS, codes[2, r, 1] // CELL_UNITS)
                            for cell in (
                                (k0 * PAIRS + k1) * PAIRS + k2,
                                (k2 * PAIRS + k0) * PAIRS + k1,
                                (k1 * PAIRS + k2) * PAIRS + k0,
                            ):
                                total += starts[cell + 1] - starts[cell]
                costs[i, s, t] = total if n[0] * n[1] * n[2] > 0 else -1


@kernel()
def look_up(
    xy: Floats2,
    branches: Int8s3,
    tangents: Singles2,
    sides: Int8s2,
    a: int,
    s: int,
    t: int,
    neighbours: Int32s2,
    limit: int,
    tolerance: int,
    min_cos: float,
    ref_xy: Floats2,
    ref_branches: Int8s3,
    ref_neighbours: Int32s2,
    starts: Int32s1,
    entries: UInt64s1,
    scale: tuple[float, float],
    min_ratio: float,
    hit_ids: Ints2,
    hit_affine: Floats2,
    n_hits: int,
) -> tuple[int, int]:
    """Append the map's triples whose codes agree with those of the query triple (a, slot s, slot t).

    Angles may differ by `tolerance` units, branches by an angle of cosine `min_cos`. A hit is `hit_ids` = (A, slot of
    b, B, slot of c, C), b and c counterclockwise after a, and `hit_affine` = the 2 x 2 matrix (row-major) that takes
    the query triangle to the reference triangle. Gates: `scale` = (least, greatest) root of its determinant, and
    `min_ratio`, the least ratio of its singular values. Returns (hits so far, entries compared).
    """
    b, c = int(np.int64(neighbours[a, s])), int(np.int64(neighbours[a, t]))
    abx, aby = xy[b, 0] - xy[a, 0], xy[b, 1] - xy[a, 1]
    acx, acy = xy[c, 0] - xy[a, 0], xy[c, 1] - xy[a, 1]
    if abx * acy - aby * acx < 0:
        b, c, s, t = c, b, t, s
        abx, aby, acx, acy = acx, acy, abx, aby
    cross = abx * acy - aby * acx
    codes = np.empty((3, limit, 3), np.int64)
    n = np.empty(3, np.int64)
    triple_codes(xy, tangents, sides, a, b, c, limit, codes, n)
    probes = np.empty((3, 64, 4), np.int64)
    n_probes = np.empty(3, np.int64)
    compared = 0
    for p in range(n[0]):
        n_probes[0] = vertex_probes(codes[0, p], tolerance, probes[0])
        for q in range(n[1]):
            n_probes[1] = vertex_probes(codes[1, q], tolerance, probes[1])
            for r in range(n[2]):
                n_probes[2] = vertex_probes(codes[2, r], tolerance, probes[2])
                for turn in range(3):
                    # The stored triple may start at another vertex: X, Y, Z = a, b, c or c, a, b or b, c, a.
                    vx, vy, vz = (0, 1, 2) if turn == 0 else ((2, 0, 1) if turn == 1 else (1, 2, 0))
                    for i in range(n_probes[vx]):
                        ki = probes[vx, i, 0] * PAIRS
                        li, hi = probes[vx, i, 1] << 16, probes[vx, i, 2] << 16 | GUARDS
                        for j in range(n_probes[vy]):
                            kj = (ki + probes[vy, j, 0]) * PAIRS
                            lj, hj = li | probes[vy, j, 1] << 8, hi | probes[vy, j, 2] << 8
                            for k in range(n_probes[vz]):
                                cell = kj + probes[vz, k, 0]
                                lows = lj | probes[vz, k, 1]
                                highs = hj | probes[vz, k, 2]
                                alike_x, alike_y, alike_z = probes[vx, i, 3], probes[vy, j, 3], probes[vz, k, 3]
                                for e in range(starts[cell], starts[cell + 1]):
                                    compared += 1
                                    entry = entries[e]
                                    fine = np.int64(entry & np.uint64(0xFFFFFF))
                                    if ((fine | GUARDS) - lows) & (highs - fine) & GUARDS != GUARDS:
                                        continue
                                    around = np.int64((entry >> np.uint64(24)) & np.uint64(1023))
                                    if (alike_x >> (around // 81)) & (alike_y >> (around // 9 % 9)) & (
                                        alike_z >> (around % 9)
                                    ) & 1 == 0:
                                        continue
                                    x = np.int64(entry >> np.uint64(40))
                                    y = np.int64((entry >> np.uint64(37)) & np.uint64(7))
                                    z = np.int64((entry >> np.uint64(34)) & np.uint64(7))
                                    # A file's bits may have been flipped: no entry is believed.
                                    if x >= ref_xy.shape[0] or max(y, z) >= ref_neighbours.shape[1]:
                                        continue
                                    y, z = np.int64(ref_neighbours[x, y]), np.int64(ref_neighbours[x, z])
                                    if min(y, z) < 0:
                                        continue
                                    if turn == 1:
                                        x, y, z = y, z, x
                                    elif turn == 2:
                                        x, y, z = z, x, y
                                    bx, by = ref_xy[y, 0] - ref_xy[x, 0], ref_xy[y, 1] - ref_xy[x, 1]
                                    cx, cy = ref_xy[z, 0] - ref_xy[x, 0], ref_xy[z, 1] - ref_xy[x, 1]
                                    det = (bx * cy - by * cx) / cross
                                    if det < scale[0] * scale[0] or det > scale[1] * scale[1]:
                                        continue
                                    j00 = (bx * acy - cx * aby) / cross
                                    j01 = (cx * abx - bx * acx) / cross
                                    j10 = (by * acy - cy * aby) / cross
                                    j11 = (cy * abx - by * acx) / cross
                                    # singular values s1 >= s2: s1 s2 = det, s1^2 + s2^2 = |J|^2
                                    square = j00 * j00 + j01 * j01 + j10 * j10 + j11 * j11
                                    if square * min_ratio > det * (1.0 + min_ratio * min_ratio):
                                        continue
                                    if not (
                                        rays_agree(branches, a, ref_branches, int(x), j00, j01, j10, j11, min_cos)
                                        and rays_agree(
                                            branches, int(b), ref_branches, int(y), j00, j01, j10, j11, min_cos
                                        )
                                        and rays_agree(
                                            branches, int(c), ref_branches, int(z), j00, j01, j10, j11, min_cos
                                        )
                                    ):
                                        continue
                                    if n_hits >= hit_ids.shape[0]:
                                        return n_hits, compared
                                    hit_ids[n_hits, 0] = x
                                    hit_ids[n_hits, 1] = s
                                    hit_ids[n_hits, 2] = y
                                    hit_ids[n_hits, 3] = t
                                    hit_ids[n_hits, 4] = z
                                    hit_affine[n_hits, 0] = j00
                                    hit_affine[n_hits, 1] = j01
                                    hit_affine[n_hits, 2] = j10
                                    hit_affine[n_hits, 3] = j11
                                    n_hits += 1
    return n_hits, compared


@kernel()
def look_up_each(
    xy: Floats2,
    branches: Int8s3,
    tangents: Singles2,
    sides: Int8s2,
    a: int,
    slots: Ints2,
    max_compared: int,
    neighbours: Int32s2,
    limit: int,
    tolerance: int,
    min_cos: float,
    ref_xy: Floats2,
    ref_branches: Int8s3,
    ref_neighbours: Int32s2,
    starts: Int32s1,
    entries: UInt64s1,
    scale: tuple[float, float],
    min_ratio: float,
    hit_ids: Ints2,
    hit_affine: Floats2,
) -> tuple[int, int]:
    """Look up the triples of one anchor, `slots` (T, 2), until there is no room for hits or enough was compared.

    See `look_up`. Returns (hits, entries compared).
    """
    n_hits, n_compared = 0, 0
    for i in range(slots.shape[0]):
        if n_hits == hit_ids.shape[0] or n_compared > max_compared:
            break
        n_hits, compared = look_up(
            xy, branches, tangents, sides, a, slots[i, 0], slots[i, 1], neighbours, limit, tolerance, min_cos,
            ref_xy, ref_branches, ref_neighbours, starts, entries, scale, min_ratio, hit_ids, hit_affine, n_hits,
        )  # fmt: skip
        n_compared += compared
    return n_hits, n_compared


@kernel()
def gather(
    hit_ids: Ints2,
    hit_affine: Floats2,
    order: Ints1,
    n_slots: int,
    tolerance: float,
    out_ids: Ints2,
    out_affine: Floats2,
    out_score: Ints1,
) -> int:
    """Find map intersections A on which hits from different triples of one anchor agree; return how many.

    `order` sorts the hits by A. Two hits agree when they send the neighbours they share to the same places and their
    affine maps differ by less than `tolerance` of their size. For each A the hit with most agreement becomes a
    proposal: `out_ids` = (A, then for each neighbour slot its partner or -1), `out_affine` the mean map, `out_score`
    the number of neighbours placed.
    """
    n = 0
    partner = np.empty(n_slots, np.int64)
    start = 0
    while start < order.shape[0]:
        stop = start + 1
        a = hit_ids[order[start], 0]
        while stop < order.shape[0] and hit_ids[order[stop], 0] == a:
            stop += 1
        if stop - start >= 2 and n < out_score.shape[0]:
            best = 2
            size = min(stop - start, 200)
            for i in range(start, start + size):
                u = order[i]
                det = hit_affine[u, 0] * hit_affine[u, 3] - hit_affine[u, 1] * hit_affine[u, 2]
                limit = tolerance * tolerance * det * 2.0
                partner[:] = -1
                partner[hit_ids[u, 1]] = hit_ids[u, 2]
                partner[hit_ids[u, 3]] = hit_ids[u, 4]
                placed = 2
                m00, m01, m10, m11, m = 0.0, 0.0, 0.0, 0.0, 0
                for j in range(start, start + size):
                    v = order[j]
                    d00 = hit_affine[v, 0] - hit_affine[u, 0]
                    d01 = hit_affine[v, 1] - hit_affine[u, 1]
                    d10 = hit_affine[v, 2] - hit_affine[u, 2]
                    d11 = hit_affine[v, 3] - hit_affine[u, 3]
                    if d00 * d00 + d01 * d01 + d10 * d10 + d11 * d11 > limit:
                        continue
                    sb, sc = hit_ids[v, 1], hit_ids[v, 3]
                    pb, pc = hit_ids[v, 2], hit_ids[v, 4]
                    if (partner[sb] >= 0 and partner[sb] != pb) or (partner[sc] >= 0 and partner[sc] != pc):
                        continue
                    if partner[sb] < 0:
                        partner[sb] = pb
                        placed += 1
                    if partner[sc] < 0:
                        partner[sc] = pc
                        placed += 1
                    m00 += hit_affine[v, 0]
                    m01 += hit_affine[v, 1]
                    m10 += hit_affine[v, 2]
                    m11 += hit_affine[v, 3]
                    m += 1
                if placed > best:
                    best = placed
                    out_ids[n, 0] = a
                    for slot in range(n_slots):
                        out_ids[n, 1 + slot] = partner[slot]
                    out_affine[n, 0] = m00 / m
                    out_affine[n, 1] = m01 / m
                    out_affine[n, 2] = m10 / m
                    out_affine[n, 3] = m11 / m
                    out_score[n] = placed
            if best > 2:
                n += 1
        start = stop
    return n
