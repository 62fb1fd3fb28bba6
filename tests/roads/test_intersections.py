import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from naive import intersections as naive

from roadgeo.roads.graph import RoadGraph
from roadgeo.roads.intersections import IntersectionOptions, find_intersections


def star(*ends, centre=(0.0, 0.0)):
    """Straight roads from one centre to each end."""
    xy = np.array([centre, *ends], float)
    edges = np.array([(0, k + 1) for k in range(len(ends))], np.int32)
    return RoadGraph.from_polylines(xy, edges, [xy[list(e)] for e in edges])


def test_a_tee_has_three_branches_and_two_tangents():
    found = find_intersections(star((50, 0), (-50, 0), (0, 40)))
    assert len(found) == 1
    assert found.n_branches.tolist() == [3]
    assert found.n_tangents.tolist() == [2]
    np.testing.assert_allclose(found.xy, [[0, 0]], atol=1e-9)
    np.testing.assert_allclose(found.rays[0, :3], [-np.pi, 0, np.pi / 2], atol=1e-6)
    np.testing.assert_allclose(found.tangents[0, :2], [0, np.pi / 2], atol=1e-6)
    assert found.residual[0] == pytest.approx(0, abs=1e-6)
    assert np.isnan(found.rays[0, 3:]).all()


@pytest.mark.parametrize("ends", [[], [(50, 0)], [(50, 0), (0, 50)]])
def test_fewer_than_three_branches_are_no_intersection(ends):
    graph = star(*ends) if ends else RoadGraph.from_polylines(np.empty((0, 2)), np.empty((0, 2)), [])
    assert len(find_intersections(graph)) == 0


def test_branches_too_short_do_not_count():
    assert len(find_intersections(star((50, 0), (-50, 0), (0, 5)))) == 0


def test_more_branches_than_columns_are_cut_off():
    ends = [(50 * np.cos(a), 50 * np.sin(a)) for a in np.linspace(0, 2 * np.pi, 11)[:-1]]
    found = find_intersections(star(*ends))
    assert found.n_branches.tolist() == [8]


def test_the_centre_is_where_the_branch_lines_meet():
    bent = [np.array([(0, 0), (2, 1), (60, 1)]), np.array([(0, 0), (-2, 1), (-60, 1)]), np.array([(0, 0), (0, 60)])]
    graph = RoadGraph.from_polylines([(0, 0), (60, 1), (-60, 1), (0, 60)], [(0, 1), (0, 2), (0, 3)], bent)
    found = find_intersections(graph)
    np.testing.assert_allclose(found.xy, [[0, 1]], atol=0.06)


def test_oblique_lines_that_miss_each_other_and_the_node_are_met_by_least_squares():
    """Equation 1: the node counts as little."""
    angle, away = np.radians([20.0, 75.0, 160.0]), np.array([1.0, -0.5, 2.0])
    along, across = (np.stack([np.cos(a), np.sin(a)], axis=1) for a in (angle, angle + np.pi / 2))
    lines = [np.array([(0, 0), w * n + 3 * d, w * n + 60 * d]) for w, n, d in zip(away, across, along, strict=True)]
    graph = RoadGraph.from_polylines([(0, 0), *(line[-1] for line in lines)], [(0, 1), (0, 2), (0, 3)], lines)
    expected = np.linalg.solve(across.T @ across + 0.05 * np.eye(2), across.T @ away)
    np.testing.assert_allclose(find_intersections(graph).xy, [expected], atol=1e-6)


def test_nearly_parallel_lines_do_not_carry_the_centre_away():
    lines = [np.array([(0, 0), (0.5, y), (60, 1.5 * y)]) for y in (-3, 0, 3)]
    graph = RoadGraph.from_polylines([(0, 0), *(line[-1] for line in lines)], [(0, 1), (0, 2), (0, 3)], lines)
    assert np.hypot(*find_intersections(graph).xy[0]) <= IntersectionOptions().max_shift


def test_a_loop_counts_two_branches():
    ring = np.array([(0, 0), (30, 10), (40, 40), (10, 30), (0, 0)], float)
    graph = RoadGraph.from_polylines(
        [(0, 0), (-50, 0)], np.array([(0, 0), (0, 1)]), [ring, np.array([(0, 0), (-50, 0)])]
    )
    assert find_intersections(graph).n_branches.tolist() == [3]


@st.composite
def branches(draw):
    steps = st.tuples(st.floats(-20, 20), st.floats(-20, 20)).filter(lambda s: np.hypot(*s) > 1)
    return [
        np.concatenate(([(0, 0)], np.cumsum(draw(st.lists(steps, min_size=1, max_size=5)), axis=0)))
        for _ in range(draw(st.integers(3, 6)))
    ]


@given(branches(), st.integers(0, 63))
def test_lines_agree_with_the_slow_twin(lines, turned):
    options = IntersectionOptions()
    edges = [(k + 1, 0) if turned >> k & 1 else (0, k + 1) for k in range(len(lines))]
    stored = [line[::-1] if turned >> k & 1 else line for k, line in enumerate(lines)]
    graph = RoadGraph.from_polylines([(0, 0), *(line[-1] for line in lines)], edges, stored)
    found = find_intersections(graph, options)
    fits = [naive.fit_branch(x, options.skip_length, options.tangent_length, options.min_branch_length) for x in lines]
    fits = [fit for fit in fits if fit is not None]
    if len(fits) < 3:
        assert len(found) == 0
        return
    count = found.n_branches[0]
    assert count == len(fits)
    assert found.residual[0] == pytest.approx(np.sqrt(max(np.mean([f[2] for f in fits]), 0)), abs=1e-2)
    assert np.all(np.diff(found.rays[0, :count]) >= 0)
    merged = naive.merge_lines(found.rays[0, :count].astype(float), np.radians(options.merge_angle_deg))
    assert found.n_tangents[0] == len(merged)
    apart = np.abs(np.sin(np.subtract.outer(merged, found.tangents[0, : len(merged)].astype(float))))
    assert apart.min(axis=1).max() < 1e-4
    clear = [f for f in fits if f[2] < 1]  # a branch that coils has no clear direction
    for fit in clear:
        assert np.abs(np.exp(1j * found.rays[0, :count]) - np.exp(1j * fit[1])).min() < 1e-2
