"""Graphs and their packed geometry."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from roadgeo.roads.graph import RoadGraph

LINES = [
    np.array([[0.0, 0], [3, 4]]),
    np.array([[3.0, 4], [3, 0], [0, 0]]),
    np.array([[3.0, 4], [4, 4], [3, 5], [3, 4]]),
]


@pytest.fixture
def graph() -> RoadGraph:
    """Two nodes, two parallel edges and a loop."""
    return RoadGraph.from_polylines(np.array([[0.0, 0], [3, 4]]), np.array([[0, 1], [1, 0], [1, 1]]), LINES)


def test_lengths(graph):
    assert graph.edge_lengths() == pytest.approx([5, 7, 2 + np.sqrt(2)])


@pytest.mark.parametrize("n", [0, 3])
def test_a_graph_without_edges(n):
    graph = RoadGraph.from_polylines(np.zeros((n, 2)), np.empty((0, 2)), [])
    assert (graph.n_nodes, graph.n_edges) == (n, 0)
    assert graph.degree().tolist() == [0] * n
    assert graph.edge_lengths().shape == (0,)
    assert graph.polylines() == []


lines = st.integers(2, 6).flatmap(lambda n: arrays(float, (n, 2), elements=st.floats(-1e3, 1e3)))


@given(st.lists(lines, min_size=1, max_size=6))
def test_packing_keeps_every_line(polylines):
    ends = np.array([[2 * e, 2 * e + 1] for e in range(len(polylines))])
    xy = np.concatenate([line[[0, -1]] for line in polylines])
    graph = RoadGraph.from_polylines(xy, ends, polylines)
    assert all(np.array_equal(a, b) for a, b in zip(graph.polylines(), polylines, strict=True))
    assert graph.edge_lengths() == pytest.approx([np.hypot(*np.diff(line, axis=0).T).sum() for line in polylines])
    assert (graph.degree() == 1).all()
