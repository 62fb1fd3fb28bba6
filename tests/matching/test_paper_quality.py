"""Which intersections the paper keeps: those whose branches are long and straight."""

import numpy as np
import pytest
from shapely import LineString
from worlds.scenes import PLANE

from roadgeo.matching import pairs
from roadgeo.matching.index import build_index
from roadgeo.matching.pairs import TupleOptions, paired
from roadgeo.matching.paper import PairOptions
from roadgeo.roads.network import build_network


@pytest.fixture(scope="module")
def index():
    """A lattice of 200 m with one street that winds."""
    at = np.arange(6) * 200.0
    bent = [(x, 400.0 + 3.0 * (-1) ** k) for k, x in enumerate(np.arange(-50.0, 1051.0, 10.0))]
    rows = [LineString(bent) if y == 400.0 else LineString([(-50, y), (1050, y)]) for y in at]
    return build_index(build_network([*rows, *(LineString([(x, -50), (x, 1050)]) for x in at)], PLANE, {"name": "l"}))


def kept(index, **options):
    found = pairs._fitted(index, TupleOptions(**options))
    return np.isin(np.arange(len(index)), found.node)


@pytest.mark.parametrize("from_center", [False, True])
def test_bent_branches_are_discarded_and_straight_ones_kept(index, from_center):
    good = kept(index, from_center=from_center)
    bent = np.abs(index.xy[:, 1] - 400.0) < 10.0
    assert bent.sum() >= 4
    assert not good[bent].any()
    inside = (index.xy > 1.0).all(axis=1)
    assert good[inside & ~bent].all()


def test_the_average_distance_from_the_line_has_a_limit():
    """A street in curves, and others that cross it."""
    x = np.arange(-50.0, 1051.0, 5.0)
    streets = [LineString([(x, -50), (x, 150)]) for x in np.arange(6) * 200.0]
    index = build_index(
        build_network([LineString(np.column_stack([x, 15.0 * np.sin(x / 37.0)])), *streets], PLANE, {"name": "c"})
    )
    at, _, error = pairs._fit_lines(index, 8.0, 15)
    worst = np.array([error[at == n].max() for n in range(len(index))])
    limit = 0.7 * worst.max()
    np.testing.assert_array_equal(kept(index, fit_error_px=limit), worst <= limit)
    assert limit > 0.01


def test_branches_too_short_to_fit_are_discarded(index):
    assert not kept(index, n_px=3000).any()


def test_tangents_from_the_center_are_those_of_straight_roads(index):
    found = pairs._fitted(index, TupleOptions(from_center=True))
    np.testing.assert_allclose(found.xy, index.xy[found.node], atol=0.05)
    off = np.degrees(found.tangents[:, :2].astype(float) - [0.0, np.pi / 2])
    assert np.abs((off + 90) % 180 - 90).max() < 0.5


def test_tables_are_kept_for_a_batch(index):
    assert paired(index, TupleOptions()) is paired(index, PairOptions(delta=0.2).tuples)
    assert paired(index, TupleOptions()) is not paired(index, PairOptions(d_max_m=500.0).tuples)
