"""Which intersections the paper keeps: those whose branches are long and straight."""

import numpy as np
import pytest
from shapely import LineString
from worlds.scenes import PLANE

from roadgeo.matching import pairs
from roadgeo.matching.index import build_index
from roadgeo.matching.pairs import well_fitted
from roadgeo.roads.network import build_network


@pytest.fixture(scope="module")
def index():
    """A lattice of 200 m with one street that winds."""
    at = np.arange(6) * 200.0
    bent = [(x, 400.0 + 3.0 * (-1) ** k) for k, x in enumerate(np.arange(-50.0, 1051.0, 10.0))]
    rows = [LineString(bent) if y == 400.0 else LineString([(-50, y), (1050, y)]) for y in at]
    return build_index(build_network([*rows, *(LineString([(x, -50), (x, 1050)]) for x in at)], PLANE, {"name": "l"}))


def test_bent_branches_are_discarded_and_straight_ones_kept(index):
    good = well_fitted(index)
    bent = np.abs(index.xy[:, 1] - 400.0) < 10.0
    assert bent.sum() >= 4
    assert not good[bent].any()
    inside = (index.xy > 1.0).all(axis=1)
    assert good[inside & ~bent].all()


def test_branches_too_short_to_fit_are_discarded(index, monkeypatch):
    monkeypatch.setattr(pairs, "_LENGTH_M", 3000.0)
    assert not well_fitted(index).any()
