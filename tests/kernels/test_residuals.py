"""Ways from road points to the roads of the map, against a slow twin."""

import numpy as np
from kernels.test_roads import MIN_COS, directions, town
from naive import kernels as naive

from roadgeo.kernels.residuals import road_residuals


def test_like_the_twin():
    roads = town(3)
    rng = np.random.default_rng(4)
    mapped, along = rng.uniform((0, 60), (700, 600), (60, 2)), directions(rng, 60)
    radii, out = rng.uniform(5, 60, 60), np.empty((60, 3))
    n = road_residuals(mapped, along, radii, MIN_COS, roads, out)
    expected = naive.road_residuals(mapped, along, radii, MIN_COS, roads.segments)
    assert 0 < n == np.isfinite(expected[:, 0]).sum() < 60
    assert np.allclose(out, expected, atol=2e-3, equal_nan=True)


def test_places_that_are_none():
    out = np.empty((1, 3))
    assert road_residuals(np.array([[np.nan, 0.0]]), np.array([[1.0, 0.0]]), np.array([9.0]), 0.5, town(), out) == 0
    assert np.isnan(out).all()
