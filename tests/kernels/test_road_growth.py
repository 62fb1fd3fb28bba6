"""Growth by roads alone, on made-up towns with known homographies."""

import numpy as np
import pytest
from naive import kernels as naive
from worlds.scenes import random_network

from roadgeo.kernels.road_growth import Stages, fit_to_roads, grow_by_roads, share_on_roads
from roadgeo.matching.index import build_index
from roadgeo.matching.scene import sample_roads

MIN_COS = np.cos(np.radians(25))
STAGES = Stages(0.45, 0.3, 8.0, 0.4, MIN_COS)
UNIT = 500.0
ORIGIN = np.array([1000.0, 1000.0])
NO_HOLDS = np.zeros(8)


@pytest.fixture(scope="module")
def roads():
    network = random_network(3, 2000.0)
    index = build_index(network)
    return network, index.road_buckets


def truth(turn_deg=25.0, tilt=(0.06, -0.04)):
    a = np.radians(turn_deg)
    return np.array([np.cos(a), -1.05 * np.sin(a), 0.0, 0.95 * np.sin(a), np.cos(a), 0.0, *tilt])


def seen(network, p, n=500, false=0.0, seed=0):
    """The town's road points within the frame as a camera of parameters `p` sees them, and some that are false."""
    points, along = sample_roads(network.graph, 15.0)
    to_query = np.linalg.inv(np.append(p, 1.0).reshape(3, 3))

    def back(xy):
        q = np.c_[(xy - ORIGIN) / UNIT, np.ones(len(xy))] @ to_query.T
        return q[:, :2] / q[:, 2:]

    uv, ahead = back(points), back(points + 0.5 * along)
    inside = (np.abs(uv) < 0.8).all(axis=1)
    uv, direction = uv[inside], (ahead - uv)[inside]
    rng = np.random.default_rng(seed)
    lies = rng.random(len(uv)) < false
    uv[lies] = rng.uniform(-0.8, 0.8, (lies.sum(), 2))
    order = np.argsort(np.hypot(*uv.T))
    return uv[order], (direction / np.hypot(*direction.T)[:, None])[order]


def corner_gap(p, q):
    """Greatest distance in metres between where two maps put the frame's corners."""
    corners = np.array([[x, y, 1.0] for x in (-0.8, 0.8) for y in (-0.8, 0.8)])
    a, b = (corners @ np.append(one, 1.0).reshape(3, 3).T for one in (p, q))
    return np.hypot(*(a[:, :2] / a[:, 2:] - b[:, :2] / b[:, 2:]).T).max() * UNIT


@pytest.mark.parametrize("false", [0.0, 0.3])
@pytest.mark.parametrize("turn_deg", [0.0, 25.0, 170.0])
def test_grows_to_the_truth_from_a_rough_start(roads, turn_deg, false):
    network, buckets = roads
    p = truth(turn_deg)
    points, along = seen(network, p, false=false)
    start = np.append(truth(turn_deg + 3.0)[:6] * 1.03, [0.0, 0.0])
    assert corner_gap(start, p) > 40
    share = grow_by_roads(start, UNIT, ORIGIN, points, along, STAGES, buckets)
    assert corner_gap(start, p) < 3
    assert share == pytest.approx(1 - false, abs=0.1)


def test_gives_up_in_the_wrong_place(roads):
    network, buckets = roads
    points, along = seen(network, truth())
    for shift in ((130.0, 40.0), (-90.0, 160.0)):
        p = np.append(truth()[:6], [0.0, 0.0])
        assert grow_by_roads(p, UNIT, ORIGIN + shift, points, along, STAGES._replace(least_share=0.5), buckets) == -1.0


@pytest.mark.parametrize("n", [0, 5])
def test_too_few_points(roads, n):
    points, along = seen(roads[0], truth())
    assert grow_by_roads(truth(), UNIT, ORIGIN, points[:n], along[:n], STAGES, roads[1]) == -1.0


def test_a_step_from_the_truth_goes_nowhere(roads):
    network, buckets = roads
    p = truth()
    points, along = seen(network, p)
    before = p.copy()
    assert fit_to_roads(p, UNIT, ORIGIN, points, along, 10.0, MIN_COS, NO_HOLDS, buckets)
    assert corner_gap(p, before) < 0.5


@pytest.mark.parametrize("holds", [NO_HOLDS, np.array([0.0, 0.5, 0, 0, 0, 2.0, 1e9, 1e9])])
def test_a_step_like_the_twin(roads, holds):
    network, buckets = roads
    points, along = (array[::25] for array in seen(network, truth()))
    start = truth() + np.random.default_rng(1).normal(0, 0.004, 8)
    p = start.copy()
    assert fit_to_roads(p, UNIT, ORIGIN, points, along, 20.0, MIN_COS, holds, buckets)
    expected = naive.fit_to_roads(start, UNIT, ORIGIN, points, along, 20.0, MIN_COS, holds, buckets.segments)
    assert corner_gap(p, start) > 1
    assert np.allclose(p, expected, atol=1e-5)


@pytest.mark.slow
def test_share_like_the_twin(roads):
    network, buckets = roads
    points, along = (array[::10] for array in seen(network, truth(), false=0.3))
    for radius in (4.0, 15.0):
        arguments = truth(), UNIT, ORIGIN, points, along, radius, MIN_COS
        share = share_on_roads(*arguments, buckets)
        assert share == pytest.approx(naive.share_on_roads(*arguments, buckets.segments))
        assert 0 < share < 1


def test_a_held_parameter_stays(roads):
    network, buckets = roads
    points, along = seen(network, truth())
    p = np.append(truth()[:6], [0.0, 0.0])
    holds = np.array([0, 0, 0, 0, 0, 0, 1e9, 1e9], float)
    assert fit_to_roads(p, UNIT, ORIGIN, points, along, 20.0, MIN_COS, holds, buckets)
    assert np.abs(p[6:]).max() < 1e-6


def test_points_beyond_the_horizon_are_refused(roads):
    points, along = seen(roads[0], truth())
    p = np.append(truth()[:6], [-3.0, 0.0])
    assert not fit_to_roads(p, UNIT, ORIGIN, points, along, 20.0, MIN_COS, NO_HOLDS, roads[1])


def test_share_counts_points_on_roads_that_run_their_way(roads):
    network, buckets = roads
    points, along = seen(network, truth())
    everything = share_on_roads(truth(), UNIT, ORIGIN, points, along, 2.0, MIN_COS, buckets)
    assert everything > 0.99
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    assert share_on_roads(truth(), UNIT, ORIGIN, points, across, 2.0, MIN_COS, buckets) < 0.2
    nothing = share_on_roads(truth(), UNIT, ORIGIN, points[:0], along[:0], 2.0, MIN_COS, buckets)
    assert nothing == 0.0
