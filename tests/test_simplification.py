import naive_simplification as naive
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from shapely.geometry import LineString, MultiLineString

from roadgeo.graph import RoadGraph
from roadgeo.kernels import simplification as kernels
from roadgeo.simplification import SimplifyOptions, planarize, simplify


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
@given(small_graphs(), st.integers(0, 3))
def test_simplified_graphs_are_whole(graph, turns):
    """Whatever comes in, edges hang on their nodes; and a turned plane gives the turned result."""
    graph = RoadGraph.from_polylines(graph.xy, graph.edges, graph.polylines())
    result = simplify(graph)
    assert valid(result)
    assert (
        SimplifyOptions().stub_length
        <= min(
            (d for (a, b), d in zip(result.edges, result.edge_lengths(), strict=True) if 1 in result.degree()[[a, b]]),
            default=np.inf,
        )
        or result.n_edges > 0
    )
    assume(turns)
    spin = np.linalg.matrix_power(np.array([[0, -1], [1, 0]]), turns).T
    turned = simplify(RoadGraph(graph.xy @ spin, graph.edges, graph.coords @ spin, graph.offsets))
    assert turned.edge_lengths().sum() == pytest.approx(result.edge_lengths().sum(), rel=1e-6)
