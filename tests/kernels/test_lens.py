"""Road points behind a lens and the roads that they meet, against slow twins that use the classes of `geometry`."""

import numpy as np
import pytest
from kernels.test_roads import MIN_COS, directions, town
from naive import lens as naive

from roadgeo.kernels.lens import MeetLimits, lens_rows, meet_roads

HALF_SIDE = 0.8
P = np.array([0.9, -0.3, 0.01, 0.35, 1.1, 0.02, 0.2, -0.3])
LIMITS = MeetLimits(240.0, 350.0, 320.0, 1.5, 40.0, MIN_COS, 6.0, 5.0, 0.02)
LENSES = [0.0, -0.12, -0.45, 0.1]


def points(seed=0, n=60):
    """Road points all over a frame, one of them in its middle, and unit vectors."""
    rng = np.random.default_rng(seed)
    uv = rng.uniform((-0.8, -0.6), (0.8, 0.6), (n, 2))
    uv[0] = 0.0
    return uv, directions(rng, n)


@pytest.mark.parametrize("k1", LENSES)
def test_places_and_derivatives_like_the_twin(k1):
    uv, along = points()
    places, rows = np.empty((60, 2)), np.empty((60, 2, 9))
    lens_rows(P, k1, HALF_SIDE, uv, along, places, rows)
    expected_places, _, expected_rows = naive.lens_rows(P, k1, HALF_SIDE, uv, along)
    assert np.allclose(places, expected_places, atol=1e-12)
    assert np.allclose(rows, expected_rows, atol=1e-9)


@pytest.mark.parametrize("k1", [0.0, -0.1])
def test_derivatives_are_those_of_the_places(k1):
    uv, along = points(1)
    nine = np.append(P, k1)

    def at(values):
        places, rows = np.empty((60, 2)), np.empty((60, 2, 9))
        lens_rows(values[:8].copy(), values[8], HALF_SIDE, uv, along, places, rows)
        return places, rows

    _, rows = at(nine)
    for i, step in enumerate(1e-6 * np.eye(9)):
        difference = (at(nine + step)[0] - at(nine - step)[0]) / 2e-6
        assert np.allclose(rows[..., i], difference, atol=1e-4)


def met(k1, inverse, limits=LIMITS, p=P):
    uv, along = points(2)
    rows, residuals, sigmas, own = np.empty((60, 9)), np.empty(60), np.empty(60), np.empty(60)
    roads = town(3)
    n = meet_roads(p, k1, HALF_SIDE, uv, along, inverse, limits, roads, rows, residuals, sigmas, own)
    expected = naive.meet_roads(p, k1, HALF_SIDE, uv, along, inverse, limits, roads.segments)
    return n, rows, residuals, (sigmas, own), expected


@pytest.mark.parametrize("k1", LENSES)
@pytest.mark.parametrize("spread", [0.0, 0.1])
def test_roads_like_the_twin(k1, spread):
    inverse = spread * np.eye(9) + 0.01 * spread
    n, rows, residuals, (sigmas, own), expected = met(k1, inverse)
    assert n == sum(one is not None for one in expected)
    assert 5 < n < 60
    for i, one in enumerate(expected):
        assert np.isnan(residuals[i]) == (one is None)
        if one is not None:
            assert np.allclose(rows[i], one[0], atol=1e-9)
            assert residuals[i] == pytest.approx(one[1], abs=2e-3)
            assert sigmas[i] == pytest.approx(one[2], rel=1e-5)
            assert own[i] == pytest.approx(one[3], rel=1e-5)


def test_points_that_are_unsure_or_beyond_the_horizon_meet_nothing():
    assert met(0.0, np.full((9, 9), np.nan))[0] == 0
    assert met(0.0, 1e6 * np.eye(9))[0] == 0
    beyond = np.append(P[:6], [-40.0, 0.0])
    n, _, residuals, _, expected = met(-0.1, np.zeros((9, 9)), p=beyond)
    assert 0 < n == sum(one is not None for one in expected)
    uv, along = points(2)
    assert np.isnan(residuals[uv[:, 0] > 0.1]).all()
    places, rows = np.empty((60, 2)), np.empty((60, 2, 9))
    lens_rows(beyond, -0.1, HALF_SIDE, uv, along, places, rows)
    assert np.isnan(rows[uv[:, 0] > 0.1]).all()
