"""Triples: codes that an affine map does not change, their table, and its look-up, against slow twins."""

from collections import Counter
from itertools import combinations, product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from kernels.test_buckets import sorted_points
from kernels.test_growth import branches_of
from naive import kernels as naive

from roadgeo.kernels.buckets import nearest_neighbours
from roadgeo.kernels.structs import Hits, TripleLimits, TripleMap, TripleQuery
from roadgeo.kernels.triple_codes import (
    BACKWARDS,
    BOTH,
    CELL_UNITS,
    CELLS,
    FORWARDS,
    PAIRS,
    TABLE,
    UNITS,
    fill_table,
    find_sides,
    has_both,
    orient,
    pair_id,
    vertex_angle,
    vertex_codes,
)
from roadgeo.kernels.triples import LONG_CELL, count_alike, gather, look_up_each, next_alike, vertex_probes

MIN_SHAPE = 0.08
MIN_COS = np.cos(np.radians(25))
WAYS = {FORWARDS: (True, False), BACKWARDS: (False, True), BOTH: (True, True)}


def sides_of(tangents, branches):
    sides = np.empty(tangents.shape, np.int8)
    find_sides(tangents, branches, sides)
    return sides


class World:
    """Scattered intersections, their neighbours and the table of their triples."""

    def __init__(self, seed=0, n=60, k=6, limit=3):
        rng = np.random.default_rng(seed)
        xy, starts, grid, shape = sorted_points(rng.uniform(0, 1000, (n, 2)))
        self.xy, self.limit = xy, limit
        self.tangents = np.full((n, 4), np.nan, np.float32)
        for row in self.tangents:
            m = rng.integers(1, 4)
            row[:m] = np.sort(rng.uniform(0, np.pi, m))
        self.branches = branches_of(np.hstack([self.tangents, self.tangents[:, :1] + np.pi]).astype(float))
        self.neighbours = nearest_neighbours(xy, starts, grid, shape, k)
        counts = np.zeros(TABLE + 1, np.int64)
        arguments = (xy, self.tangents, self.sides, self.neighbours, MIN_SHAPE, limit)
        total = fill_table(*arguments, counts, np.empty(0, np.uint64))
        self.starts = np.cumsum(counts)
        self.entries = np.empty(total, np.uint64)
        free = self.starts.copy()
        assert fill_table(*arguments, free, self.entries) == total
        assert np.array_equal(free[:-1], self.starts[1:])
        cells = np.repeat(np.arange(TABLE), np.diff(self.starts))
        self.entries = self.entries[np.lexsort((self.entries >> np.uint64(24) & np.uint64(1023), cells))]
        self.starts = self.starts.astype(np.int32)

    @property
    def sides(self):
        return sides_of(self.tangents, self.branches)

    def decoded(self):
        """(a, b, c, three codes like those of the twin) of every entry."""
        ids = {pair_id(low, high): (low, high) for low in range(CELLS) for high in range(low, CELLS)}
        cells = np.repeat(np.arange(TABLE), np.diff(self.starts))
        for cell, entry in zip(cells.tolist(), self.entries.tolist(), strict=True):
            a = entry >> 40
            b, c = (int(self.neighbours[a, entry >> shift & 7]) for shift in (37, 34))
            pairs = (cell // PAIRS**2, cell // PAIRS % PAIRS, cell % PAIRS)
            code = []
            for v, pair in enumerate(pairs):
                fine = entry >> (16 - 8 * v) & 255
                sides = (entry >> 24 & 1023) // 9 ** (2 - v) % 9
                units = ids[pair][0] * CELL_UNITS + (fine >> 4), ids[pair][1] * CELL_UNITS + (fine & 15)
                code.append(tuple((u, WAYS[s]) for u, s in zip(units, divmod(sides, 3), strict=True)))
            yield a, b, c, tuple(code)


def seen_through(world, A, noise=0.0):
    """The world under an affine map, its tangents turned by some noise besides."""
    query = World()
    query.xy = world.xy @ A.T
    angles = world.tangents + np.random.default_rng(0).normal(0, noise, world.tangents.shape)
    angles = np.hstack([angles, angles[:, :1] + np.pi])
    turned = np.einsum("ij,njr->nir", A, np.stack([np.cos(angles), np.sin(angles)], axis=1))
    angles = np.arctan2(turned[:, 1], turned[:, 0])
    query.tangents = (angles[:, :-1] % np.pi).astype(np.float32)
    query.branches = branches_of(angles)
    return query


@pytest.fixture(scope="module")
def world():
    return World()


def test_pairs_of_cells_are_numbered_without_gap():
    assert [pair_id(low, high) for low in range(CELLS) for high in range(low, CELLS)] == list(range(PAIRS))


angles = st.floats(0, 3.14159)
lengths = st.floats(0.1, 10)


@given(angles, st.floats(0.2, 2.9), lengths, lengths, angles)
def test_vertex_angle_like_the_twin(phi, wide, first, two, tangent):
    e1 = first * np.array([np.cos(phi), np.sin(phi)])
    e2 = two * np.array([np.cos(phi + wide), np.sin(phi + wide)])
    found = vertex_angle(*e1, *e2, tangent)
    assert 0 <= found < 2 * UNITS + 1e-9
    gap = (found - naive.vertex_angle(e1, e2, tangent)) % (2 * UNITS)
    assert min(gap, 2 * UNITS - gap) < 1e-6


@given(st.lists(st.tuples(st.floats(-9, 9), st.floats(-9, 9)), min_size=3, max_size=3), st.floats(0.01, 0.8))
def test_orient_like_the_twin(points, min_shape):
    xy = np.array(points)
    if any(np.hypot(*(p - q)) < 1e-3 for p, q in combinations(xy, 2)):
        return
    shape = naive.shape_of(xy, 0, 1, 2)
    if abs(abs(shape) - min_shape) > 1e-9:
        assert orient(xy, 0, 1, 2, min_shape) == (0 if abs(shape) < min_shape else np.sign(shape))


def test_points_in_one_place_make_no_triangle():
    assert orient(np.zeros((3, 2)), 0, 1, 2, 0.06) == 0
    assert orient(np.full((3, 2), np.nan), 0, 1, 2, 0.06) == 0
    assert orient(np.array([[0.0, 0], [1, 1], [2, 2]]), 0, 1, 2, 0.06) == 0


def test_has_both():
    neighbours = np.array([[1, 2, -1]], np.int32)
    assert has_both(neighbours, 0, 2, 1)
    assert not has_both(neighbours, 0, 1, 3)


class TestVertexCodes:
    def codes(self, world, i, j, k, limit):
        out = np.full((limit, 3), -1)
        n = vertex_codes(world.xy, world.tangents, world.sides, i, j, k, limit, out)
        return [((u, WAYS[sides // 3]), (v, WAYS[sides % 3])) for u, v, sides in out[:n].tolist()]

    @pytest.mark.parametrize("limit", [1, 2, 3])
    def test_like_the_twin(self, world, limit):
        rng = np.random.default_rng(1)
        for _ in range(60):
            i, j, k = rng.choice(len(world.xy), 3, replace=False)
            if naive.shape_of(world.xy, i, j, k) < 0:
                j, k = k, j
            expected = naive.vertex_codes(world.xy, world.tangents, world.branches, i, j, k, limit)
            assert self.codes(world, i, j, k, limit) == expected

    def test_a_single_tangent_gives_none(self, world):
        i = int(np.argmin(np.isfinite(world.tangents).sum(axis=1)))
        assert self.codes(world, i, 0, 1, 3) == []


class TestFillTable:
    @pytest.mark.parametrize("limit", [2, 3])
    def test_like_the_twin(self, limit):
        world = World(2, limit=limit)
        expected = naive.fill_table(world.xy, world.tangents, world.branches, world.neighbours, MIN_SHAPE, limit)
        assert len(expected) > 100
        assert Counter(world.decoded()) == Counter(expected)

    def test_no_point(self):
        counts = np.zeros(TABLE + 1, np.int64)
        nothing = np.empty((0, 2)), np.empty((0, 4), np.float32), np.empty((0, 4), np.int8), np.empty((0, 6), np.int32)
        assert fill_table(*nothing, MIN_SHAPE, 3, counts, np.empty(0, np.uint64)) == 0


class TestSides:
    def test_branches_along_a_tangent(self):
        tangents = np.array([[0.0, np.pi / 2, np.nan], [0.3, np.nan, np.nan]], np.float32)
        branches = branches_of(np.array([[0.1, np.pi, -np.pi / 2], [2.0, np.nan, np.nan]]))
        assert sides_of(tangents, branches)[0, :2].tolist() == [BOTH, BACKWARDS]
        assert sides_of(tangents, branches[:, :1])[0, :2].tolist() == [FORWARDS, BOTH]
        assert sides_of(tangents, branches)[1, 0] == BOTH  # nothing is known

    def test_like_the_twin(self, world):
        for i, row in enumerate(world.sides.tolist()):
            for tangent, side in zip(world.tangents[i], row, strict=True):
                if np.isfinite(tangent):
                    assert WAYS[side] == naive.sides_of(tangent, world.branches[i])


class TestVertexProbes:
    @pytest.mark.parametrize("tolerance", [0, 2, 5])
    def test_probe_exactly_what_is_alike(self, tolerance):
        rng = np.random.default_rng(3)
        every = [(u, v, sides) for u in range(UNITS) for v in range(u, UNITS) for sides in range(9)]
        in_cells = {}
        for u, v, sides in every:
            in_cells.setdefault(pair_id(u // CELL_UNITS, v // CELL_UNITS), []).append((u, v, sides))
        for u1, u2 in np.sort(rng.integers(0, UNITS, (2, 2)), axis=1).tolist():
            own = int(rng.integers(9))
            probes = np.empty((64, 4), np.int64)
            n = vertex_probes(np.array([u1, u2, own]), tolerance, probes)
            found = {
                (u, v, sides)
                for pair, lows, highs, alike in probes[:n].tolist()
                for u, v, sides in in_cells.get(pair, ())
                if lows >> 4 <= u % CELL_UNITS <= highs >> 4
                and lows & 15 <= v % CELL_UNITS <= highs & 15
                and alike >> sides & 1
            }

            def code(u, v, sides):
                return (u, WAYS[sides // 3]), (v, WAYS[sides % 3])

            assert found == {other for other in every if naive.alike(code(u1, u2, own), code(*other), tolerance)}


class TestNextAlike:
    @given(
        st.lists(st.one_of(st.integers(0, 728), st.integers(0, 20)), max_size=80),
        st.tuples(*[st.sets(st.integers(0, 8))] * 3),
        st.integers(0, 80),
    )
    def test_like_the_twin(self, sides, alike, e):
        sides = np.sort(np.array(sides, np.int64))
        noise = np.random.default_rng(0).integers(0, 2**24, len(sides))
        entries = (sides.astype(np.uint64) << np.uint64(24)) | noise.astype(np.uint64) | np.uint64(5 << 40)
        e = min(e, len(sides))
        bits = [sum(1 << digit for digit in some) for some in alike]
        assert next_alike(entries, e, len(sides), *bits) == naive.next_alike(sides, e, alike)

    def test_ends_where_nothing_is_in_order(self):
        entries = np.random.default_rng(1).integers(0, 2**63, 500).astype(np.uint64)
        e, n = 0, 0
        while e < 500:
            first, stop = next_alike(entries, e, 500, 5, 9, 511)
            assert e <= first <= stop <= 500
            assert first < stop or stop == 500
            e, n = stop, n + 1
        assert n > 0


def cell_of(code):
    """The cells of three codes."""
    return tuple((u // CELL_UNITS, v // CELL_UNITS) for (u, _), (v, _) in code)


class TestCountAlike:
    def test_counts_the_cells_of_each_triple(self, world):
        k = world.neighbours.shape[1]
        anchors = np.arange(0, len(world.xy), 20)
        costs = np.empty((len(anchors), k, k), np.int64)
        count_alike(world.xy, world.tangents, world.sides, world.neighbours, anchors, MIN_SHAPE, 3, world.starts, costs)
        cells = Counter()
        for *_, code in world.decoded():
            cells.update(cell_of(code[t:] + code[:t]) for t in range(3))
        for i, a in enumerate(anchors):
            for s in range(k):
                for t in range(k):
                    b, c = world.neighbours[a, s], world.neighbours[a, t]
                    shape = naive.shape_of(world.xy, a, b, c) if s < t else 0.0
                    if abs(shape) < MIN_SHAPE:
                        assert costs[i, s, t] == -1
                        continue
                    b, c = (b, c) if shape > 0 else (c, b)
                    corners = [(a, b, c), (b, c, a), (c, a, b)]
                    codes = [naive.vertex_codes(world.xy, world.tangents, world.branches, *v, 3) for v in corners]
                    expected = sum(cells[cell_of(code)] for code in product(*codes))
                    assert costs[i, s, t] == (expected if all(codes) else -1)


class TestLookUp:
    SCALE, MIN_RATIO = (0.2, 5.0), 0.3

    def run(self, world, query, a, slots, tolerance, room=5000, most=10**9):
        hits = Hits(np.empty((room, 5), np.int64), np.empty((room, 4)))
        n, compared = look_up_each(
            TripleQuery(query.xy, query.branches, query.tangents, query.sides, query.neighbours),
            a, np.array(slots), most,
            TripleMap(world.xy, world.branches, world.neighbours, world.starts, world.entries),
            TripleLimits(3, tolerance, MIN_COS, self.SCALE, self.MIN_RATIO), hits,
        )  # fmt: skip
        return hits.ids[:n], hits.affine[:n], compared

    @pytest.mark.parametrize("tolerance", [1, 5])
    def test_like_the_twin(self, world, tolerance):
        query = seen_through(world, np.array([[1.2, -0.4], [0.3, 0.9]]), noise=0.05)
        n = 0
        for a in range(0, 60, 8):
            around = [query.neighbours[a, slot] for slot in range(4)]
            slots = [
                (s, t)
                for s, t in combinations(range(4), 2)
                if abs(naive.shape_of(query.xy, a, around[s], around[t])) >= MIN_SHAPE
            ]
            ids, _, compared = self.run(world, query, a, slots, tolerance)
            found = {(around[s], around[t], *hit) for s, t, *hit in ids[:, [1, 3, 0, 2, 4]].tolist()}
            expected = naive.look_up_each(
                query, a, slots, world, 3, tolerance, np.radians(25), self.SCALE, self.MIN_RATIO
            )
            assert found == expected  # a hit may be reported more than once
            assert compared >= len(ids)
            n += len(expected)
        assert n > 5

    def test_entries_that_are_not_alike_are_passed_over_in_long_cells(self):
        """Many times the same triples, with other sides too: each is found as often, and few others are compared."""
        world = World()
        copies, rng = 40, np.random.default_rng(5)
        cells = np.repeat(np.arange(TABLE), np.diff(world.starts))
        entries = np.repeat(world.entries, copies)
        others = np.arange(len(entries)) % copies > 0
        sides = rng.integers(0, 729, len(entries)).astype(np.uint64) << np.uint64(24)
        entries[others] = (entries & ~np.uint64(1023 << 24) | sides)[others]
        many = World()
        cells = np.repeat(cells, copies)
        many.entries = entries[np.lexsort((entries >> np.uint64(24) & np.uint64(1023), cells))]
        many.starts = (world.starts * copies).astype(np.int32)
        assert np.diff(many.starts).max() > LONG_CELL
        n, n_before, n_compared = 0, 0, 0
        for a, s, t in list(self.slots(world))[::40]:
            before = self.run(world, world, a, [sorted((s, t))], 5)
            after = self.run(many, world, a, [sorted((s, t))], 5)
            found = Counter(map(tuple, after[0].tolist()))
            assert not Counter(map(tuple, before[0].tolist())) - found
            n, n_before, n_compared = n + 1, n_before + before[2], n_compared + after[2]
        assert n > 5
        assert n_compared < 0.7 * copies * n_before

    def test_enough_is_enough(self, world):
        slots = list(combinations(range(4), 2))
        _, _, compared = self.run(world, world, 8, slots, 5)
        for most in (0, compared // 2):
            assert most < self.run(world, world, 8, slots, 5, most=most)[2] <= compared

    def test_every_triple_finds_itself_through_its_affine_map(self, world):
        A = np.array([[1.2, -0.4], [0.3, 0.9]])
        query = seen_through(world, A)
        n_found = 0
        for a, s, t in {(a, *sorted(slots)) for a, *slots in self.slots(world)}:
            ids, affine, _ = self.run(world, query, a, [(s, t)], 2)
            b, c = world.neighbours[a, s], world.neighbours[a, t]
            hits = [row for row, hit in enumerate(ids[:, [0, 2, 4]].tolist()) if hit in ([a, b, c], [a, c, b])]
            assert hits
            assert np.allclose(affine[hits[0]].reshape(2, 2), np.linalg.inv(A), atol=1e-6)
            assert set(ids[hits[0], [1, 3]].tolist()) == {s, t}
            assert all(world.neighbours[a, ids[hits[0], slot]] == ids[hits[0], slot + 1] for slot in (1, 3))
            n_found += 1
        assert n_found > 50

    def slots(self, world):
        for entry in world.entries.tolist():
            yield entry >> 40, entry >> 37 & 7, entry >> 34 & 7

    def test_stops_where_the_room_ends(self, world):
        a, s, t = next(self.slots(world))
        everything = self.run(world, world, a, [sorted((s, t))], 5)[0]
        assert len(everything) >= 1
        assert len(self.run(world, world, a, [sorted((s, t))], 5, room=0)[0]) == 0

    def test_believes_no_entry(self, world):
        damaged = World()
        rng = np.random.default_rng(0)
        damaged.entries = (damaged.entries & np.uint64(0xFFFFFF)) | rng.integers(
            0, 2**40, len(damaged.entries), dtype=np.uint64
        ) << np.uint64(24)
        for a, s, t in list(self.slots(world))[::40]:
            ids, *_ = self.run(damaged, world, a, [sorted((s, t))], 5)
            assert ((ids[:, [0, 2, 4]] >= 0) & (ids[:, [0, 2, 4]] < 60)).all()


class TestGather:
    def run(self, hits, affines, n_slots=4, tolerance=0.3):
        ids, affine = np.array(hits, np.int64).reshape(-1, 5), np.array(affines, float).reshape(-1, 4)
        order = np.argsort(ids[:, 0], kind="stable")
        room = max(len(ids) // 2, 1)
        out = np.empty((room, n_slots + 1), np.int64), np.empty((room, 4)), np.empty(room, np.int64)
        n = gather(ids, affine, order, n_slots, tolerance, *out)
        return [array[:n] for array in out]

    def test_hits_that_agree_make_a_proposal(self):
        first, other = [1.0, 0, 0, 1], [1.1, 0, 0, 1.1]
        ids, affine, placed = self.run([(7, 0, 70, 1, 71), (7, 1, 71, 2, 72)], [first, other])
        assert ids.tolist() == [[7, 70, 71, 72, -1]]
        assert affine[0] == pytest.approx([1.05, 0, 0, 1.05])
        assert placed.tolist() == [3]

    @pytest.mark.parametrize(
        ("hits", "affines"),
        [
            ([], []),
            ([(7, 0, 70, 1, 71)], [[1, 0, 0, 1]]),  # alone
            ([(7, 0, 70, 1, 71), (8, 1, 71, 2, 72)], [[1, 0, 0, 1]] * 2),  # elsewhere
            ([(7, 0, 70, 1, 71), (7, 0, 70, 1, 71)], [[1, 0, 0, 1]] * 2),  # the same triple twice
            ([(7, 0, 70, 1, 71), (7, 1, 99, 2, 72)], [[1, 0, 0, 1]] * 2),  # a neighbour in two places
            ([(7, 0, 70, 1, 71), (7, 1, 71, 2, 72)], [[1, 0, 0, 1], [0, -1, 1, 0]]),  # maps that differ
        ],
    )
    def test_hits_that_do_not(self, hits, affines):
        assert len(self.run(hits, affines)[0]) == 0

    @pytest.mark.parametrize("seed", range(4))
    def test_like_the_twin(self, seed):
        rng = np.random.default_rng(seed)
        slots = np.sort([rng.choice(5, 2, replace=False) for _ in range(80)], axis=1)
        hits = np.c_[rng.integers(0, 6, 80), slots[:, 0], rng.integers(0, 3, 80), slots[:, 1], rng.integers(0, 3, 80)]
        affines = np.array([1.0, 0, 0, 1]) + rng.normal(0, 0.2, (80, 4))
        ids, affine, placed = self.run(hits, affines, 5)
        expected = naive.gather(hits, affines, 5, 0.3)
        assert len(expected) > 2
        assert ids.tolist() == [[a, *places] for a, places, *_ in expected]
        assert placed.tolist() == [n for _, _, n, _ in expected]
        assert np.allclose(affine, [mean for *_, mean in expected])
