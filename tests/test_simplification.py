import naive_simplification as naive
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely.geometry import LineString, MultiLineString

from roadgeo.graph import RoadGraph
from roadgeo.kernels import simplification as kernels
from roadgeo.simplification import SimplifyOptions, coverage, planarize, simplify


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


def test_lines_that_nearly_touch_are_noded():
    assert degrees(network([(-100, 0), (100, 0)], [(0, 0.04), (0, 100)])) == [1, 1, 1, 3]


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


def test_two_carriageways_become_one_road():
    graph = simplify(
        network(
            [(-200, 0), (0, 0), (10, 4), (190, 4), (200, 0), (400, 0)],
            [(0, 0), (10, -4), (190, -4), (200, 0)],
            [(0, 0), (0, 100)],
            [(200, 0), (200, 100)],
        )
    )
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


@settings(max_examples=150, deadline=None)
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


@settings(max_examples=100, deadline=None)
@given(points)
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


@settings(max_examples=100, deadline=None)
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


def test_coverage_surrounds_the_roads_and_what_they_enclose():
    (ring,) = coverage(network([(0, 0), (3000, 0), (3000, 3000), (0, 3000), (0, 0)]), cell_m=300)
    assert ring.min(axis=0).tolist() == [-300, -300]
    assert ring.max(axis=0).tolist() == [3600, 3600]
    np.testing.assert_array_equal(ring[0], ring[-1])
    x, y = ring.T
    assert (x[:-1] * y[1:] - x[1:] * y[:-1]).sum() / 2 == 3900**2


def test_far_roads_are_covered_apart():
    rings = coverage(network([(0, 0), (100, 0)], [(9000, 0), (9100, 0)]))
    assert len(rings) == 2
    assert coverage(planarize([])) == []


lines = st.lists(
    st.lists(st.tuples(st.integers(0, 150), st.integers(0, 150)), min_size=2, max_size=4), min_size=1, max_size=8
)


@settings(max_examples=100, deadline=None)
@given(lines)
def test_noded_lines_simplify_to_a_whole_graph(drawn):
    graph = network(*drawn)
    result = simplify(graph, SimplifyOptions(max_passes=50))
    assert valid(graph)
    assert valid(result)
    assert result.edge_lengths().sum() <= graph.edge_lengths().sum() * 1.5 + 50
    dead = (result.degree() == 1)[result.edges].any(axis=1)
    assert (result.edge_lengths()[dead] >= SimplifyOptions().stub_length).all()
