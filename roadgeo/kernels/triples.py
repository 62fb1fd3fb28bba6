"""Look-up of triples: which triples of the map have the codes of a query's triple (see `kernels.triple_codes`)."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from roadgeo.kernels.arrays import Floats2, Int8s2, Int32s1, Int32s2, Ints1, Ints2, Ints3, Singles2
from roadgeo.kernels.compilation import kernel
from roadgeo.kernels.rays import rays_agree
from roadgeo.kernels.structs import Hits, TripleLimits, TripleMap, TripleQuery
from roadgeo.kernels.triple_codes import (
    BOTH,
    CELL_UNITS,
    CELLS,
    PAIRS,
    count_neighbours,
    neighbour_pair,
    pair_id,
    triple_codes,
    turned,
)

__all__ = ["count_alike", "gather", "look_up_each", "next_alike", "vertex_probes"]

GUARDS = 0x888888

#: In longer cells, entries whose sides are not alike are skipped; in shorter cells skipping would take longer.
LONG_CELL = 32

#: Bit r of `ALIKE[q]`: whether sides r of a map vertex contain sides q, or are contained in q, on both tangents.
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


@kernel(writes=("costs",))
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

    -1 without such a triple. The cost measures how common a triple is on the map: cheap triples are looked up first.
    """
    codes = np.empty((3, limit, 3), np.int64)
    n = np.empty(3, np.int64)
    costs[:] = -1
    for i in range(anchors.shape[0]):
        a = anchors[i]
        n_around = count_neighbours(neighbours, a)
        for s in range(n_around):
            for t in range(s + 1, n_around):
                b, c, _, _ = neighbour_pair(xy, neighbours, a, s, t, min_shape)
                if b < 0:
                    continue
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


class _Triangle(NamedTuple):
    """A query triple, counterclockwise: its points, the slots of two of them, its edges, twice its area."""

    a: int
    b: int
    c: int
    s: int
    t: int
    abx: float
    aby: float
    acx: float
    acy: float
    cross: float


@kernel()
def _triangle(query: TripleQuery, a: int, s: int, t: int) -> _Triangle:
    """Return the triple of an anchor and two of its neighbours."""
    xy = query.xy
    b, c = int(np.int64(query.neighbours[a, s])), int(np.int64(query.neighbours[a, t]))
    if (xy[b, 0] - xy[a, 0]) * (xy[c, 1] - xy[a, 1]) - (xy[b, 1] - xy[a, 1]) * (xy[c, 0] - xy[a, 0]) < 0:
        b, c, s, t = c, b, t, s
    abx, aby = xy[b, 0] - xy[a, 0], xy[b, 1] - xy[a, 1]
    acx, acy = xy[c, 0] - xy[a, 0], xy[c, 1] - xy[a, 1]
    return _Triangle(a, b, c, s, t, abx, aby, acx, acy, abx * acy - aby * acx)


@kernel(forceinline=True)
def _places(entry: np.uint64, turn: int, ref_neighbours: NDArray[np.int32]) -> tuple[int, int, int]:
    """Return the map's triple of an entry, the partner of the query's anchor first; -1 for an invalid entry.

    A damaged file may hold any bits, so every number is checked.
    """
    x = np.int64(entry >> np.uint64(40))
    y = np.int64((entry >> np.uint64(37)) & np.uint64(7))
    z = np.int64((entry >> np.uint64(34)) & np.uint64(7))
    if x >= ref_neighbours.shape[0] or max(y, z) >= ref_neighbours.shape[1]:
        return -1, -1, -1
    y, z = np.int64(ref_neighbours[x, y]), np.int64(ref_neighbours[x, z])
    if min(y, z) < 0:
        return -1, -1, -1
    if turn == 1:
        return int(y), int(z), int(x)
    if turn == 2:
        return int(z), int(x), int(y)
    return int(x), int(y), int(z)


@kernel(forceinline=True)
def _fit_affine(
    seen: _Triangle, ref_xy: NDArray[np.float64], x: int, y: int, z: int, limits: TripleLimits
) -> tuple[bool, float, float, float, float]:
    """Return the 2 x 2 map (row-major) from the query's triple to the map's triple x, y, z, and whether it passes."""
    bx, by = ref_xy[y, 0] - ref_xy[x, 0], ref_xy[y, 1] - ref_xy[x, 1]
    cx, cy = ref_xy[z, 0] - ref_xy[x, 0], ref_xy[z, 1] - ref_xy[x, 1]
    det = (bx * cy - by * cx) / seen.cross
    if det < limits.scale[0] * limits.scale[0] or det > limits.scale[1] * limits.scale[1]:
        return False, 0.0, 0.0, 0.0, 0.0
    j00 = (bx * seen.acy - cx * seen.aby) / seen.cross
    j01 = (cx * seen.abx - bx * seen.acx) / seen.cross
    j10 = (by * seen.acy - cy * seen.aby) / seen.cross
    j11 = (cy * seen.abx - by * seen.acx) / seen.cross
    # singular values s1 >= s2: s1 s2 = det, s1^2 + s2^2 = |J|^2
    square = j00 * j00 + j01 * j01 + j10 * j10 + j11 * j11
    passes = not square * limits.min_ratio > det * (1.0 + limits.min_ratio * limits.min_ratio)
    return passes, j00, j01, j10, j11


@kernel(forceinline=True)
def _agree(
    branches: NDArray[np.int8],
    seen: _Triangle,
    ref_branches: NDArray[np.int8],
    x: int,
    y: int,
    z: int,
    j00: float,
    j01: float,
    j10: float,
    j11: float,
    min_cos: float,
) -> bool:
    """Return whether the branches at all three vertices agree."""
    return (
        rays_agree(branches, seen.a, ref_branches, x, j00, j01, j10, j11, min_cos)
        and rays_agree(branches, seen.b, ref_branches, y, j00, j01, j10, j11, min_cos)
        and rays_agree(branches, seen.c, ref_branches, z, j00, j01, j10, j11, min_cos)
    )


@kernel(forceinline=True)
def _sides(entry: np.uint64) -> int:
    """Return the sides of an entry's three vertices, 81 x + 9 y + z: the sort key of a cell's entries."""
    return int(np.int64((entry >> np.uint64(24)) & np.uint64(1023)))


@kernel()
def _first_with(entries: NDArray[np.uint64], e: int, end: int, sides: int) -> int:
    """Return the first entry from `e` to `end` whose sides are at least `sides`: in steps that double, then halve."""
    step = 1
    while e + step < end and _sides(entries[e + step]) < sides:
        e += step
        step *= 2
    low, high = e, min(e + step, end)
    while low < high:
        middle = (low + high) // 2
        if _sides(entries[middle]) < sides:
            low = middle + 1
        else:
            high = middle
    return low


@kernel()
def next_alike(
    entries: NDArray[np.uint64], e: int, end: int, alike_x: int, alike_y: int, alike_z: int
) -> tuple[int, int]:
    """Return the next run of entries with the same sides that are alike at all three vertices (see `vertex_probes`).

    Entries `e` to `end` are sorted by their sides. Returns (end, end) after the last run.
    """
    while e < end:
        sides = _sides(entries[e])
        if (alike_x >> (sides // 81)) & 1 == 0:
            e = _first_with(entries, e, end, (sides // 81 + 1) * 81)
        elif (alike_y >> (sides // 9 % 9)) & 1 == 0:
            e = _first_with(entries, e, end, (sides // 9 + 1) * 9)
        else:
            stop = _first_with(entries, e, end, sides + 1)
            if (alike_z >> (sides % 9)) & 1 != 0:
                return e, stop
            e = stop
    return end, end


@kernel()
def _list_probes(
    codes: NDArray[np.int64], n: NDArray[np.int64], tolerance: int, listed: NDArray[np.int64]
) -> tuple[int, NDArray[np.int64]]:
    """List the cells that may hold a triple with these codes: (cell, turn, lows, highs, alike x, y, z) each.

    Returns how many there are, and `listed` or, where it is too small, a larger array.
    """
    probes = np.empty((3, 64, 4), np.int64)
    n_probes = np.empty(3, np.int64)
    m = 0
    # Every vertex may have several codes, every code several cells, and the stored triple may start at any vertex.
    for p in range(n[0]):
        n_probes[0] = vertex_probes(codes[0, p], tolerance, probes[0])
        for q in range(n[1]):
            n_probes[1] = vertex_probes(codes[1, q], tolerance, probes[1])
            for r in range(n[2]):
                n_probes[2] = vertex_probes(codes[2, r], tolerance, probes[2])
                room = m + 3 * n_probes[0] * n_probes[1] * n_probes[2]
                if room > listed.shape[0]:
                    larger = np.empty((2 * room, 7), np.int64)
                    for i in range(m):
                        for column in range(7):
                            larger[i, column] = listed[i, column]
                    listed = larger
                for turn in range(3):
                    # X, Y, Z = a, b, c or c, a, b or b, c, a
                    vx, vy, vz = (0, 1, 2) if turn == 0 else ((2, 0, 1) if turn == 1 else (1, 2, 0))
                    for i in range(n_probes[vx]):
                        for j in range(n_probes[vy]):
                            for k in range(n_probes[vz]):
                                cell = (probes[vx, i, 0] * PAIRS + probes[vy, j, 0]) * PAIRS + probes[vz, k, 0]
                                lows = probes[vx, i, 1] << 16 | probes[vy, j, 1] << 8 | probes[vz, k, 1]
                                highs = probes[vx, i, 2] << 16 | probes[vy, j, 2] << 8 | probes[vz, k, 2] | GUARDS
                                listed[m, 0], listed[m, 1], listed[m, 2], listed[m, 3] = cell, turn, lows, highs
                                listed[m, 4], listed[m, 5] = probes[vx, i, 3], probes[vy, j, 3]
                                listed[m, 6] = probes[vz, k, 3]
                                m += 1
    return m, listed


@kernel()
def _find_cells(
    listed: NDArray[np.int64], m: int, starts: NDArray[np.int32], entries: NDArray[np.uint64], ends: NDArray[np.int64]
) -> None:
    """Fill `ends` (m + 1, 2) with the starts and ends of the listed cells' entries, and touch the first of each.

    Cells lie all over the table. Here no load waits for another, so processors overlap the loads. Without this, a
    look-up would spend most of its time waiting for each entry.
    """
    for i in range(m):
        ends[i, 0] = starts[listed[i, 0]]
        ends[i, 1] = starts[listed[i, 0] + 1]
    touched = np.uint64(0)
    for i in range(m):
        if ends[i, 0] < ends[i, 1]:
            touched ^= entries[ends[i, 0]]
    ends[m, 0] = np.int64(touched >> np.uint64(1))  # a use of it, or it would not be read


@kernel()
def _look_up(
    query: TripleQuery, seen: _Triangle, table: TripleMap, limits: TripleLimits, hits: Hits, n_hits: int
) -> tuple[int, int]:
    """Append the map's triples whose codes agree with a query triple's; return (all hits, entries compared).

    See `look_up_each`.
    """
    branches, (ids, affine) = query.branches, hits
    ref_xy, ref_branches, ref_neighbours, starts, entries = table
    codes = np.empty((3, limits.codes_per_vertex, 3), np.int64)
    n = np.empty(3, np.int64)
    triple_codes(query.xy, query.tangents, query.sides, seen.a, seen.b, seen.c, limits.codes_per_vertex, codes, n)
    m, listed = _list_probes(codes, n, limits.tolerance, np.empty((256, 7), np.int64))
    ends = np.empty((m + 1, 2), np.int64)
    _find_cells(listed, m, starts, entries, ends)
    compared = 0
    for i in range(m):
        turn, lows, highs = listed[i, 1], listed[i, 2], listed[i, 3]
        alike_x, alike_y, alike_z = listed[i, 4], listed[i, 5], listed[i, 6]
        e, end = ends[i, 0], ends[i, 1]
        while e < end:
            stop = end
            if end - e > LONG_CELL:
                e, stop = next_alike(entries, e, end, alike_x, alike_y, alike_z)
            compared += stop - e
            while e < stop:
                entry = entries[e]
                e += 1
                # All six angles at once, then the sides, then the map itself.
                fine = np.int64(entry & np.uint64(0xFFFFFF))
                if ((fine | GUARDS) - lows) & (highs - fine) & GUARDS != GUARDS:
                    continue
                around = _sides(entry)
                alike = (alike_x >> (around // 81)) & (alike_y >> (around // 9 % 9))
                if alike & (alike_z >> (around % 9)) & 1 == 0:
                    continue
                x, y, z = _places(entry, turn, ref_neighbours)
                if x < 0:
                    continue
                passes, j00, j01, j10, j11 = _fit_affine(seen, ref_xy, x, y, z, limits)
                if not passes or not _agree(branches, seen, ref_branches, x, y, z, j00, j01, j10, j11, limits.min_cos):
                    continue
                if n_hits >= ids.shape[0]:
                    return n_hits, compared
                ids[n_hits, 0], ids[n_hits, 1], ids[n_hits, 2] = x, seen.s, y
                ids[n_hits, 3], ids[n_hits, 4] = seen.t, z
                affine[n_hits, 0], affine[n_hits, 1] = j00, j01
                affine[n_hits, 2], affine[n_hits, 3] = j10, j11
                n_hits += 1
    return n_hits, compared


@kernel(writes=("hits",))
def look_up_each(
    query: TripleQuery,
    a: int,
    slots: Ints2,
    max_compared: int,
    table: TripleMap,
    limits: TripleLimits,
    hits: Hits,
) -> tuple[int, int]:
    """Find the map's triples whose codes agree with the triples of an anchor (a, slot s, slot t).

    The triples, `slots` (T, 2), are looked up one after another until there is no room for hits or enough was compared.
    A hit is `hits.ids` = (A, slot of b, B, slot of c, C), b and c counterclockwise after a, and `hits.affine` = the
    2 x 2 matrix (row-major) that takes the query triangle to the reference triangle. Returns (hits, entries compared).
    """
    n_hits, n_compared = 0, 0
    for i in range(slots.shape[0]):
        if n_hits == hits.ids.shape[0] or n_compared > max_compared:
            break
        seen = _triangle(query, a, slots[i, 0], slots[i, 1])
        n_hits, compared = _look_up(query, seen, table, limits, hits, n_hits)
        n_compared += compared
    return n_hits, n_compared


@kernel(writes=("hit_ids", "out_ids", "out_affine", "out_score"))
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
        # all hits on one map intersection
        stop = start + 1
        a = hit_ids[order[start], 0]
        while stop < order.shape[0] and hit_ids[order[stop], 0] == a:
            stop += 1
        if stop - start >= 2 and n < out_score.shape[0]:
            # the hit with most agreement
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
                # hits with similar maps that send no shared neighbour elsewhere
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
