import numpy as np
import pytest
import shapely
from hypothesis import assume, example, given
from hypothesis import strategies as st
from naive import simplification as naive
from shapely.geometry import LineString, MultiLineString

from roadgeo.errors import RoadSourceError
from roadgeo.kernels import parallel_roads
from roadgeo.kernels import simplification as kernels
from roadgeo.roads.coverage import coverage
from roadgeo.roads.graph import RoadGraph
from roadgeo.roads.simplification import (
    SimplifyOptions,
    _keep_edges,
    _walk_faces,
    cut_edges,
    narrow_faces,
    planarize,
    simplify,
)


def network(*lines):
    return planarize([LineString(line) for line in lines])


def degrees(graph):
    return sorted(graph.degree().tolist())


def valid(graph):
    """Edges start and end at their nodes, and every node is used."""
    if graph.n_edges == 0:
        return graph.n_nodes == 0
    starts, ends = graph.coords[graph.offsets[:-1]], graph.coords[graph.offsets[1:] - 1]
    return (
        np.allclose(starts, graph.xy[graph.edges[:, 0]])
        and np.allclose(ends, graph.xy[graph.edges[:, 1]])
        and (np.diff(graph.offsets) >= 2).all()
        and set(graph.edges.ravel()) == set(range(graph.n_nodes))
    )


def test_ways_are_noded_where_they_cross():
    graph = network([(-100, 0), (100, 0)], [(0, -100), (0, 100)])
    assert degrees(graph) == [1, 1, 1, 1, 4]
    assert [0.0, 0.0] in graph.xy.tolist()
    assert valid(graph)


def test_vertices_that_nearly_coincide_are_one():
    assert degrees(network([(-100, 0), (0, 0), (100, 0.3)], [(0.04, 0.04), (0, 100)])) == [1, 1, 1, 3]


def test_noding_that_fails_is_done_on_a_grid(monkeypatch):
    def fail(_):
        raise shapely.GEOSException("TopologyException")

    monkeypatch.setattr(shapely, "node", fail)
    assert degrees(network([(-100, 0), (100, 0)], [(0, -100), (0, 100)])) == [1, 1, 1, 1, 4]


@pytest.mark.parametrize(
    "lines",
    [
        [],
        [LineString()],
        [LineString([(1, 1), (1, 1)])],
        [MultiLineString()],
    ],
    ids=["nothing", "empty", "zero length", "empty multi"],
)
def test_nothing_gives_an_empty_graph(lines):
    graph = planarize(lines)
    assert (graph.n_nodes, graph.n_edges) == (0, 0)
    assert simplify(graph).n_edges == 0


def test_duplicates_heights_and_multi_parts_do_not_matter():
    plain = planarize([LineString([(0, 0), (50, 0)]), LineString([(60, 0), (90, 0)])])
    odd = planarize(
        [
            LineString([(0, 0, 7), (50, 0, 9)]),
            LineString([(50, 0), (0, 0)]),
            MultiLineString([[(0, 0), (50, 0)], [(60, 0), (90, 0)]]),
        ]
    )
    assert sorted(plain.edge_lengths()) == sorted(odd.edge_lengths()) == [30, 50]


def test_chains_become_one_edge():
    graph = simplify(network([(0, 0), (50, 0)], [(50, 0), (100, 0)], [(100, 0), (100, 80)]))
    assert graph.n_edges == 1
    assert graph.edge_lengths().tolist() == [180]
    assert valid(graph)


def test_a_staggered_crossing_becomes_one():
    graph = simplify(network([(-200, 0), (200, 0)], [(-5, 0), (-5, 100)], [(5, 0), (5, -100)]))
    assert degrees(graph) == [1, 1, 1, 1, 4]
    np.testing.assert_allclose(graph.xy[graph.degree() == 4], [[0, 0]], atol=1e-9)
    assert valid(graph)


def test_crossings_further_apart_stay_two():
    graph = simplify(network([(-200, 0), (200, 0)], [(-15, 0), (-15, 100)], [(15, 0), (15, -100)]))
    assert degrees(graph) == [1, 1, 1, 1, 3, 3]


def test_stubs_are_dropped_and_longer_dead_ends_stay():
    graph = simplify(network([(-200, 0), (200, 0)], [(0, 0), (0, 14)], [(50, 0), (50, 40)]))
    assert degrees(graph) == [1, 1, 1, 3]


def test_a_ring_alone_survives():
    ring = network([(0, 0), (100, 0), (100, 100), (0, 100), (0, 0)])
    graph = simplify(ring)
    assert graph.n_edges == 1
    assert graph.edge_lengths().tolist() == [400]


@st.composite
def small_graphs(draw):
    n = draw(st.integers(2, 9))
    xy = np.array(draw(st.lists(st.tuples(st.integers(0, 60), st.integers(0, 60)), min_size=n, max_size=n)), float)
    edges = draw(st.lists(st.tuples(st.integers(0, n - 1), st.integers(0, n - 1)), min_size=1, max_size=14))
    middles = draw(st.lists(st.tuples(st.integers(0, 60), st.integers(0, 60)), min_size=14, max_size=14))
    lines = [np.array([xy[a], m, xy[b]], float) for (a, b), m in zip(edges, middles, strict=False)]
    return RoadGraph.from_polylines(xy, np.array(edges, np.int32), lines)


@given(small_graphs())
def test_join_chains_agrees_with_its_twin(graph):
    joined = RoadGraph(graph.xy, *kernels.join_chains(graph.n_nodes, graph.edges, graph.offsets, graph.coords))
    degree = joined.degree()
    got = sorted(
        (() if a == b and degree[a] == 2 else (min(a, b), max(a, b)), d)
        for (a, b), d in zip(joined.edges.tolist(), joined.edge_lengths(), strict=True)
    )
    expected = naive.join_chains(graph.edges, graph.edge_lengths())
    assert [ends for ends, _ in got] == [ends for ends, _ in expected]
    np.testing.assert_allclose([d for _, d in got], [d for _, d in expected])
    assert joined.edge_lengths().sum() == pytest.approx(graph.edge_lengths().sum())


points = st.lists(st.tuples(st.integers(0, 40), st.integers(0, 40)), max_size=25)


@given(points)
@example([(x, y) for x in range(5) for y in range(5)])  # 300 pairs: room for 25 is made at first
def test_pairs_and_clusters_agree_with_their_twins(places):
    xy = np.array(places, float).reshape(-1, 2)
    pairs = kernels.close_pairs(xy, np.argsort(xy[:, 0], kind="stable"), 7.0)
    assert {(min(p), max(p)) for p in pairs.tolist()} == naive.close_pairs(xy, 7.0)
    pairs = pairs[np.argsort(np.hypot(*(xy[pairs[:, 0]] - xy[pairs[:, 1]]).T), kind="stable")]
    radius = np.full(len(pairs), 7.0)
    cluster, centre = kernels.draw_together(xy, pairs, radius)
    expected = naive.draw_together(xy, pairs.tolist(), radius)
    assert {frozenset(np.flatnonzero(cluster == c).tolist()) for c in set(cluster)} == set(map(frozenset, expected))
    for group in expected:
        np.testing.assert_allclose(centre[list(group)], np.tile(xy[list(group)].mean(axis=0), (len(group), 1)))


@given(small_graphs())
def test_any_graph_simplifies_to_a_whole_one(graph):
    """Skeletons are not quite plane: edges may cross, coincide or have no length."""
    assert valid(simplify(graph))


def test_two_carriageways_with_side_streets_on_one_side_become_one():
    graph = simplify(
        network(
            [(-500, 4), (500, 4)],
            [(-500, -4), (500, -4)],
            [(0, 4), (0, 200)],
            [(100, -4), (100, -200)],
            [(250, -4), (250, 4), (250, 200)],
        )
    )
    assert degrees(graph) == [1, 1, 1, 1, 1, 3, 3, 3]
    assert np.abs(graph.xy[graph.degree() == 3][:, 1]).max() < 1
    assert valid(graph)


def test_roads_further_apart_than_a_mask_fuses_stay_two():
    graph = simplify(network([(-500, 10), (500, 10)], [(-500, -10), (500, -10)], [(0, 10), (0, 200)]))
    assert degrees(graph) == [1, 1, 1, 1, 1, 3]


def test_roads_that_part_slowly_part_where_a_gap_is_seen():
    graph = simplify(network([(-300, 0), (0, 0), (300, 30)], [(0, 0), (300, -30)]))
    assert degrees(graph) == [1, 1, 1, 3]
    (fork,) = graph.xy[graph.degree() == 3]
    assert 25 < fork[0] < 60
    assert abs(fork[1]) < 1


@pytest.mark.parametrize("radius", [6.0, 9.0])
def test_small_roundabouts_become_one_intersection(radius):
    angles = np.linspace(0, 2 * np.pi, 25)
    ring = radius * np.stack((np.cos(angles), np.sin(angles)), axis=1)
    roads = [[ring[k], ring[k] * 20] for k in (0, 6, 12, 18)]
    graph = simplify(network(ring, *roads))
    assert degrees(graph) == [1, 1, 1, 1, 4]
    np.testing.assert_allclose(graph.xy[graph.degree() == 4], [[0, 0]], atol=0.1)


def test_large_roundabouts_stay_round():
    angles = np.linspace(0, 2 * np.pi, 65)
    ring = 40 * np.stack((np.cos(angles), np.sin(angles)), axis=1)
    graph = simplify(network(ring, *[[ring[k], ring[k] * 5] for k in (0, 16, 32, 48)]))
    assert degrees(graph) == [1, 1, 1, 1, 3, 3, 3, 3]


def test_a_long_narrow_loop_becomes_a_dead_end():
    graph = simplify(network([(-200, 0), (200, 0)], [(-4, 0), (-4, 150), (4, 150), (4, 0)]))
    assert degrees(graph) == [1, 1, 1, 3]


def test_a_dead_end_at_the_side_of_a_road_meets_it():
    graph = simplify(network([(-200, 0), (200, 0)], [(0, 8), (0, 100)]))
    assert degrees(graph) == [1, 1, 1, 3]


def area(ring):
    x, y = ring.T
    return (x[:-1] * y[1:] - x[1:] * y[:-1]).sum() / 2


def test_coverage_surrounds_the_roads_and_what_they_enclose():
    (ring,) = coverage(network([(0, 0), (3000, 0), (3000, 3000), (0, 3000), (0, 0)]))
    np.testing.assert_allclose([ring.min(axis=0), ring.max(axis=0)], [[0, 0], [3010, 3010]])
    np.testing.assert_array_equal(ring[0], ring[-1])
    assert area(ring) == pytest.approx(3010**2)


@pytest.mark.parametrize("turn", [0.0, 0.8])
def test_coverage_ends_where_the_roads_end(turn):
    """Whichever way a grid of streets lies, and where a bay cuts into it."""
    at = np.arange(0.0, 4001.0, 200.0)
    streets = [[(x, 0), (x, 4000)] for x in at] + [[(0, y), (4000 if y < 2500 else 1500, y)] for y in at]
    streets = [street for street in streets if street[0][0] <= 1500 or street[0] != street[1]]
    streets += [[(x, 0), (x, 2400)] for x in at[at > 1500]]
    streets = [street for street in streets if not (street[0][0] > 1500 and street[1][1] > 2500)]
    matrix = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    (ring,) = coverage(network(*(np.array(street) @ matrix.T for street in streets)))
    roads = shapely.union_all([LineString(np.array(street) @ matrix.T) for street in streets])
    whole = shapely.Polygon(ring)
    assert whole.difference(roads.convex_hull.buffer(15.0)).area < 1.0
    assert whole.difference(roads.buffer(215.0)).area < 0.02e6  # the diagonal of a cell; and the inner corner
    known = shapely.union_all([shapely.box(0, 0, 4000, 2400), shapely.box(0, 0, 1400, 4000)])
    known = shapely.transform(known, lambda xy: xy @ matrix.T)
    assert known.difference(whole).area < 0.001 * known.area  # roads that cut a cell's corner


def test_coverage_bridges_gaps_but_no_bays():
    near = coverage(network([(0, 0), (1000, 0), (1000, 1000)], [(0, 500), (900, 500)]))
    far = coverage(network([(0, 0), (3000, 0), (3000, 3000)]))
    assert len(near) == len(far) == 1
    assert area(near[0]) > 0.3e6
    assert area(far[0]) < 6000 * 2 * 150


def test_far_roads_are_covered_apart():
    rings = coverage(network([(0, 0), (100, 0)], [(9000, 0), (9100, 0)]))
    assert len(rings) == 2
    assert coverage(planarize([])) == []


lines = st.lists(
    st.lists(st.tuples(st.integers(0, 150), st.integers(0, 150)), min_size=2, max_size=4), min_size=1, max_size=8
)


@given(lines)
def test_noded_lines_simplify_to_a_whole_graph(drawn):
    graph = network(*drawn)
    result = simplify(graph, SimplifyOptions(max_passes=50))
    assert valid(graph)
    assert valid(result)
    assert result.edge_lengths().sum() <= graph.edge_lengths().sum() * 1.5 + 50
    dead = (result.degree() == 1)[result.edges].any(axis=1)
    assert (result.edge_lengths()[dead] >= SimplifyOptions().stub_length).all()


@given(small_graphs())
def test_edges_are_measured(graph):
    measured = kernels.measure_edges(graph.offsets, graph.coords)
    np.testing.assert_allclose(measured, [LineString(line).length for line in graph.polylines()])
    np.testing.assert_allclose(measured, graph.edge_lengths())


@given(small_graphs(), st.lists(st.floats(0.05, 0.95), min_size=28, max_size=28))
def test_edges_are_cut_as_by_the_twin(graph, shares):
    lengths = graph.edge_lengths()
    cuts = [sorted({lengths[e] * shares[2 * e], lengths[e] * shares[2 * e + 1]}) for e in range(graph.n_edges)]
    pieces = cut_edges(graph, np.concatenate(cuts), np.array([len(c) for c in cuts]))
    assert valid(pieces) or graph.degree().min() == 0 or lengths.min() == 0
    expected = [piece for line, c in zip(graph.polylines(), cuts, strict=True) for piece in naive.cut_edge(line, c)]
    if lengths.min() > 0:
        assert pieces.n_edges == len(expected)
        np.testing.assert_allclose(pieces.edge_lengths(), [piece.length for piece in expected], atol=1e-9)
        np.testing.assert_allclose(
            pieces.coords[pieces.offsets[:-1]], [piece.coords[0] for piece in expected], atol=1e-9
        )


@given(small_graphs(), st.floats(5, 30))
def test_edges_that_run_side_by_side_are_found_as_by_the_twin(graph, distance):
    back = graph.edges[:, 0] > graph.edges[:, 1]
    lines = [line[::-1] if turned else line for line, turned in zip(graph.polylines(), back, strict=True)]
    graph = RoadGraph.from_polylines(graph.xy, np.sort(graph.edges, axis=1), lines)
    by_ends = np.lexsort((graph.edges[:, 1], graph.edges[:, 0]))
    found = parallel_roads.find_twins(graph.edges, graph.offsets, graph.coords, graph.edge_lengths(), by_ends, distance)
    heads: list[list[int]] = []
    for e in by_ends:
        for group in heads:
            same = (graph.edges[group[0]] == graph.edges[e]).all() and graph.edges[e, 0] != graph.edges[e, 1]
            if same and naive.are_twins(lines[group[0]], lines[e], distance):
                group.append(e)
                break
        else:
            heads.append([e])
    first = {e: group[0] for group in heads for e in group}
    assert found.tolist() == [first[e] for e in range(graph.n_edges)]


@given(small_graphs(), st.floats(2, 25))
def test_mates_and_touches_agree_with_their_twin(graph, distance):
    lengths = graph.edge_lengths()
    count = np.ceil(lengths / 6.0).astype(int) + 2
    starts = np.concatenate(([0], np.cumsum(count)))
    xy, direction = np.empty((2, starts[-1], 2))
    parallel_roads.sample_edges(graph.offsets, graph.coords, lengths, starts, xy, direction)
    for e, line in enumerate(graph.polylines()):
        shares = np.linspace(0, 1, count[e])
        expected = [LineString(line).interpolate(s, normalized=True).coords[0] for s in shares]
        np.testing.assert_allclose(xy[starts[e] : starts[e + 1]], expected, atol=1e-9)
    np.testing.assert_allclose(np.hypot(*direction.T), 1)

    edge = np.repeat(np.arange(graph.n_edges), count)
    cell = np.floor((xy - xy.min(axis=0)) / distance).astype(int) + 1
    columns = int(cell[:, 0].max()) + 2
    key = cell[:, 1] * columns + cell[:, 0]
    order = np.argsort(key, kind="stable")
    mate, apart, touch = parallel_roads.find_mates(
        xy, direction, edge, graph.edges, starts, order, key[order], columns, distance, 0.9
    )
    ends = np.stack((starts[:-1], starts[1:] - 1), axis=1).ravel()
    mates, touches = naive.find_mates(xy, direction, edge, graph.edges, ends, distance, 0.9)
    assert [None if m < 0 else d for m, d in zip(mate, apart, strict=True)] == pytest.approx(mates)
    gaps = [None if t < 0 else np.hypot(*(xy[t] - xy[i])) for t, i in zip(touch, ends, strict=True)]
    assert gaps == pytest.approx(touches)


@given(st.lists(st.sampled_from([None, 1, 2]), min_size=2, max_size=14), st.floats(0, 40))
def test_runs_are_tied_at_their_ends(mates, least):
    """One edge of three is sampled every 10 units; its mates are the samples abreast on the other two."""
    n = len(mates)
    starts = np.array([0, n, 2 * n, 3 * n])
    lengths = np.full(3, 10.0 * (n - 1))
    edge = np.repeat(np.arange(3, dtype=np.int32), n)
    mate = np.full(3 * n, -1)
    mate[:n] = [-1 if m is None else m * n + k for k, m in enumerate(mates)]
    ties = parallel_roads.tie_runs(starts, lengths, edge, mate, np.full(3 * n, 5.0), 7.0, least)
    expected = [
        [0, 10.0 * k, mates[k], 10.0 * k]
        for first, last in naive.runs(mates)
        if 10.0 * (last - first) >= least
        for k in (first, last)
    ]
    np.testing.assert_allclose(ties, np.array(expected).reshape(-1, 4))


def test_as_many_runs_as_there_are():
    """40 of them: room for 32 is made at first."""
    n = 3 * 40
    mates = [None if k % 3 == 2 else 1 for k in range(n)]
    edge, mate = np.repeat(np.int32([0, 1]), n), np.full(2 * n, -1)
    mate[:n] = [-1 if m is None else n + k for k, m in enumerate(mates)]
    ties = parallel_roads.tie_runs(
        np.array([0, n, 2 * n]), np.full(2, 10.0 * (n - 1)), edge, mate, np.full(2 * n, 5.0), 7.0, 10.0
    )
    expected = [[0, 10.0 * k, 1, 10.0 * k] for run in naive.runs(mates) for k in run]
    assert len(expected) == 80
    np.testing.assert_allclose(ties, expected)


def test_a_run_ends_where_a_gap_opens():
    """Roads that part are tied where they are `split_distance` apart, not where they are out of sight."""
    apart = np.array([5.0, 5.0, 5.0, 6.0, 8.0, 9.5, 10.0])
    mate = np.array([7, 8, 9, 10, 11, 12, -1] + [-1] * 7)
    edge = np.repeat(np.int32([0, 1]), 7)
    ties = parallel_roads.tie_runs(
        np.array([0, 7, 14]), np.full(2, 60.0), edge, mate, np.concatenate((apart, apart)), 7.0, 10.0
    )
    assert ties.tolist() == [[0, 0, 1, 0], [0, 30, 1, 30]]


@given(lines, st.floats(5, 40))
@example([[(0, 95), (139, 118), (0, 75)], [(125, 52), (142, 150)]], 5.0)  # half a square metre, but for rounding
@example([[(0, 0), (81, 106), (5, 0)], [(0, 1), (70, 91), (69, 90), (6, 0)]], 5.0)  # a hole hangs on the border
def test_narrow_faces_agree_with_their_twin(drawn, width):
    noded = shapely.union_all([LineString(line) for line in drawn], grid_size=1.0)  # on integers: nothing is rounded
    whole = planarize(shapely.get_parts(noded), grid_m=1.0)
    lines = np.array([LineString(line) for line in whole.polylines()], object)
    _, cuts, dangles, _ = shapely.polygonize_full(lines)
    loose = shapely.get_parts(shapely.get_parts([cuts, dangles]))  # the twin knows no dead ends in a face
    closed = np.array([not line.equals(loose).any() for line in lines], bool)
    if not closed.any():
        return
    graph, lines = _keep_edges(whole, closed), lines[closed]
    follow, area = _walk_faces(graph)
    face = narrow_faces(follow, area, graph.edge_lengths(), width, 200.0)
    found = [
        (area[face == first].sum(), graph.edge_lengths()[np.flatnonzero(face == first) // 2].sum())
        for first in np.unique(face[face >= 0])
    ]
    for size, perimeter in naive.narrow_faces(lines, np.inf, np.inf):  # at a limit, rounding decides
        assume(abs(2 * size - width * perimeter) > 1e-6 and abs(perimeter - 200.0) > 1e-6)
    seen, wanted = (
        np.sort(np.reshape(faces, (-1, 2)), axis=0) for faces in (found, naive.narrow_faces(lines, width, 200.0))
    )
    np.testing.assert_allclose(seen, wanted, rtol=1e-6)


class TestLinesThatAreNoRoads:
    """They asked for gigabytes; they are counted first, and refused with numbers."""

    def refuse(self, lines, match):
        with pytest.raises(RoadSourceError, match=match):
            coverage(planarize(lines))

    def test_a_net_of_meridians_and_parallels(self):
        """Drawn every 30 degrees, 18 lines: not many crossings, but a quarter of a million squares for each."""
        way = np.linspace(-2e7, 2e7, 7)
        across = [LineString([(x, -2e7), (x, 2e7)]) for x in np.linspace(-2e7, 2e7, 12)]
        self.refuse(
            across + [LineString([(x, y) for x in way]) for y in way[:-1]], "squares of 150 m, expected at most"
        )

    def test_lines_that_all_cross(self):
        rng = np.random.default_rng(0)
        self.refuse(shapely.linestrings(rng.random((20_000, 2, 2)) * 1e4), "may cross each other 199,990,000 times")

    def test_one_line_that_crosses_itself(self):
        rng = np.random.default_rng(0)
        self.refuse([LineString(rng.random((20_000, 2)) * 1e4)], "may cross each other")

    def test_one_road_many_times_over(self):
        self.refuse([LineString([(0, 0), (500, k * 1e-6)]) for k in range(20_000)], "each of them many times over")

    def test_lines_beyond_the_earth(self):
        self.refuse([LineString([(0, 0), (1e12, 0)])], "km long, expected at most 10,000,000")

    def test_dense_streets_are_roads(self):
        ways = [LineString([(0, y), (3000, y)]) for y in range(0, 3000, 15)]
        graph = planarize(ways + [LineString([(x, 0), (x, 3000)]) for x in range(0, 3000, 15)])
        assert graph.n_nodes >= 200 * 200
