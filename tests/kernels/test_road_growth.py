"""Growth by roads alone, on made-up towns with known homographies."""

import numpy as np
import pytest
from naive import kernels as naive
from worlds.scenes import random_network

from roadgeo.kernels.road_growth import Stages, fit_to_roads, grow_by_roads, share_on_roads
from roadgeo.matching.index import build_index
from roadgeo.matching.scene import sample_roads

MIN_COS = np.cos(np.radians(25))
STAGES = Stages(0.45, 0.3, 0.4, MIN_COS, (12, 8, 6), 0)
TOLERANCE = 8.0
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
    a, b = (corners @ np.append(item, 1.0).reshape(3, 3).T for item in (p, q))
    return np.hypot(*(a[:, :2] / a[:, 2:] - b[:, :2] / b[:, 2:]).T).max() * UNIT


def grow(ps, points, along, buckets, origins=ORIGIN, stages=STAGES):
    """Grow maps (M, 8) in place, from one origin or each from its own; return their closeness."""
    n = len(ps)
    units, tolerances, closeness = np.full(n, UNIT), np.full(n, TOLERANCE), np.empty(n)
    each = np.broadcast_to(origins, (n, 2)).copy()
    grow_by_roads(ps, units, each, tolerances, points, along, stages, buckets, closeness)
    return closeness


@pytest.mark.parametrize("false", [0.0, 0.3])
@pytest.mark.parametrize("turn_deg", [0.0, 25.0, 170.0])
def test_grows_to_the_truth_from_a_rough_start(roads, turn_deg, false):
    network, buckets = roads
    p = truth(turn_deg)
    points, along = seen(network, p, false=false)
    start = np.append(truth(turn_deg + 3.0)[:6] * 1.03, [0.0, 0.0])
    assert corner_gap(start, p) > 40
    ps = start[None].copy()
    (closeness,) = grow(ps, points, along, buckets)
    assert corner_gap(ps[0], p) < 3
    assert closeness == pytest.approx(1 - false, abs=0.15)


def test_gives_up_in_the_wrong_place(roads):
    network, buckets = roads
    points, along = seen(network, truth())
    ps = np.tile(np.append(truth()[:6], [0.0, 0.0]), (2, 1))
    origins = ORIGIN + np.array([(130.0, 40.0), (-90.0, 160.0)])
    assert (grow(ps, points, along, buckets, origins, STAGES._replace(least_share=0.5)) == -1.0).all()


def rough_starts(n, seed=0):
    """The truth among places up to 300 m away, each a little turned and stretched."""
    rng = np.random.default_rng(seed)
    ps = np.tile(np.append(truth()[:6], [0.0, 0.0]), (n, 1))
    ps[:, [0, 1, 3, 4]] *= rng.uniform(0.97, 1.03, (n, 1))
    shifts = rng.uniform(-300.0, 300.0, (n, 2))
    shifts[n // 2] = 0.0
    return ps, ORIGIN + shifts


def test_the_right_one_of_many_goes_on(roads):
    network, buckets = roads
    points, along = seen(network, truth(), false=0.3)
    ps, origins = rough_starts(30)
    closeness = grow(ps, points, along, buckets, origins, STAGES._replace(least_share=0.0, go_on=(12, 8, 3)))
    assert (closeness >= 0.0).sum() == 3
    assert closeness.argmax() == 15
    assert corner_gap(ps[15], truth()) < 3


def test_the_first_are_not_given_up_for_others(roads):
    network, buckets = roads
    points, along = seen(network, truth(), false=0.3)
    ps, _ = rough_starts(8)
    closeness = grow(ps, points, along, buckets, stages=STAGES._replace(go_on=(3, 2, 1), sure=2))
    assert (closeness[:2] > 0.4).all()
    assert (closeness[2:] >= 0.0).sum() == 1


def test_side_by_side_they_grow_as_alone(roads):
    network, buckets = roads
    points, along = seen(network, truth(), false=0.3)
    ps, origins = rough_starts(6)
    together = ps.copy()
    closeness = grow(together, points, along, buckets, origins)
    for k in range(6):
        alone = ps[k : k + 1].copy()
        assert grow(alone, points, along, buckets, origins[k : k + 1]) == closeness[k]
        assert (alone[0] == together[k]).all()


def test_grows_like_the_twin(roads):
    network, buckets = roads
    points, along = (array[::8].copy() for array in seen(network, truth(), false=0.3))
    ps, origins = rough_starts(4)
    stages = STAGES._replace(least_share=0.0, go_on=(2, 2, 2))
    grown = ps.copy()
    closeness = grow(grown, points, along, buckets, origins, stages)
    expected = naive.grow_by_roads(ps, UNIT, origins, TOLERANCE, points, along, stages, buckets.segments)
    # In wrong places the last bits decide which road is nearest, and steps that differ follow.
    assert closeness == pytest.approx(expected, abs=0.03)
    assert closeness[2] == pytest.approx(expected[2], abs=1e-6)
    assert (closeness >= 0).sum() == 2
    assert corner_gap(grown[2], ps[2]) < 0.1


@pytest.mark.parametrize("seed", range(5))
def test_of_equal_ones_the_first_go_on(roads, seed):
    points, along = seen(roads[0], truth(), false=0.3, seed=seed)
    ps = np.tile(np.append(truth()[:6], [0.0, 0.0]), (5, 1))
    closeness = grow(ps, points, along, roads[1], stages=STAGES._replace(go_on=(4, 2, 2)))
    assert (closeness[:2] > 0.5).all()
    assert (closeness[2:] == -1.0).all()


@pytest.mark.parametrize("n", [0, 5])
def test_too_few_points(roads, n):
    points, along = seen(roads[0], truth())
    assert grow(truth()[None], points[:n], along[:n], roads[1]) == -1.0


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
    points, along = (array[::25].copy() for array in seen(network, truth()))
    start = truth() + np.random.default_rng(1).normal(0, 0.004, 8)
    p = start.copy()
    assert fit_to_roads(p, UNIT, ORIGIN, points, along, 20.0, MIN_COS, holds, buckets)
    expected = naive.fit_to_roads(start, UNIT, ORIGIN, points, along, 20.0, MIN_COS, holds, buckets.segments)
    assert corner_gap(p, start) > 1
    assert np.allclose(p, expected, atol=1e-5)


def test_share_like_the_twin(roads):
    network, buckets = roads
    points, along = (array[::10].copy() for array in seen(network, truth(), false=0.3))
    for radius in (4.0, 15.0):
        arguments = truth(), UNIT, ORIGIN, points, along, radius, MIN_COS
        share, closeness = share_on_roads(*arguments, buckets)
        assert (share, closeness) == pytest.approx(naive.share_on_roads(*arguments, buckets.segments))
        assert 0 < closeness < share < 1


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
    everything, closeness = share_on_roads(truth(), UNIT, ORIGIN, points, along, 2.0, MIN_COS, buckets)
    assert everything > 0.99
    assert closeness > 0.9
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    assert share_on_roads(truth(), UNIT, ORIGIN, points, across, 2.0, MIN_COS, buckets)[0] < 0.2
    nothing = share_on_roads(truth(), UNIT, ORIGIN, points[:0], along[:0], 2.0, MIN_COS, buckets)
    assert nothing == (0.0, 0.0)
