"""The adjustment against a slow twin and a known homography."""

import numpy as np
import pytest
from kernels.test_roads import binned
from naive import kernels as naive

from roadgeo.kernels.adjustment import adjust, carry, own_sigma
from roadgeo.kernels.homography_fit import add_row, point_row
from roadgeo.kernels.structs import AdjustLimits, Held, Plane, PointPairs, RoadSamples

P = np.array([0.9, -0.2, 0.05, 0.25, 1.1, -0.02, 0.12, -0.08])
UNIT, ORIGIN = 400.0, np.array([350.0, 320.0])
GRID, SHAPE = (-400.0, -400.0, 100.0), (15, 15)
N_CELLS = 9


def jittered(p, size, seed=0):
    return p + np.random.default_rng(seed).normal(0, size, 8)


class Town:
    """Crooked streets on the reference plane, road points that a query saw of them, and matched intersections."""

    def __init__(self, seed=0, noise=0.0, points=80, pairs=12):
        rng = np.random.default_rng(seed)
        lines = []
        for k in range(9):
            for flip in (False, True):
                at = 100.0 * k - 50 + rng.uniform(-20, 20, 9)
                line = np.c_[np.linspace(-50, 750, 9), at]
                line = line[:, ::-1] if flip else line
                lines.append(np.hstack([line[:-1], line[1:]]))
        self.roads = binned(np.vstack(lines), GRID, SHAPE)
        segments = self.roads[0].astype(float)
        inverse = np.linalg.inv(np.append(P, 1.0).reshape(3, 3))
        chosen = segments[rng.integers(0, len(segments), 600)]
        t = rng.uniform(0, 1, (len(chosen), 1))
        places = chosen[:, :2] + t * (chosen[:, 2:] - chosen[:, :2])
        across = (chosen[:, 2:] - chosen[:, :2])[:, ::-1] * (-1, 1)
        across /= np.hypot(*across.T)[:, None]
        along = across[:, ::-1] * (1, -1)
        normal = (places + noise * rng.normal(0, 1, (len(chosen), 1)) * across - ORIGIN) / UNIT
        query = np.array([naive.transform(inverse, n) for n in normal])
        ahead = np.array([naive.jacobian(inverse, n) @ d for n, d in zip(normal, along, strict=True)])
        kept = np.flatnonzero((np.abs(query) < 0.7).all(axis=1))[:points]
        self.points = query[kept]
        self.directions = ahead[kept] / np.hypot(*ahead[kept].T)[:, None]
        self.pairs = rng.uniform(-0.6, 0.6, (pairs, 2))
        self.targets = np.array([naive.predict(P, *q) for q in self.pairs]).reshape(-1, 2)
        self.targets += rng.normal(0, noise / UNIT, self.targets.shape)

    def cells(self, xy):
        return (np.clip((xy + 0.7) / 1.4 * 3, 0, 2).astype(np.int64) @ (1, 3)).astype(np.int64)

    def held(self, p):
        """A grid of points over the frame, and where `p` puts them."""
        grid = np.stack(np.meshgrid([-0.6, 0.0, 0.6], [-0.6, 0.0, 0.6]), axis=-1).reshape(-1, 2)
        return grid, np.array([naive.predict(p, *q) for q in grid])

    def arguments(self, held_at=None, **changes):
        values = {
            "point_weight": 0.8, "pair_weight": 0.3, "n_cells": N_CELLS, "least_share": 0.5, "max_radius": 30.0,
            "min_cos": float(np.cos(np.radians(25))), "sigma_m": 2.0, "map_sigma_m": 1.6, "mask_sigma": 0.003,
            "prior": 1e-4, "n_iterations": 12, "tolerance_m": 1e-4, **changes,
        }  # fmt: skip
        scalars = list(values.values())
        observations = (self.points, self.directions, self.cells(self.points), scalars[0])
        matches = (self.pairs, self.targets, self.cells(self.pairs), scalars[1])
        held = (np.empty((0, 2)), np.empty((0, 2))) if held_at is None else self.held(held_at)
        return (*observations, *matches, *held, 0.05, *scalars[2:])


def run(town, p, **changes):
    p, normal = p.copy(), np.empty((8, 8))
    values = town.arguments(**changes)
    points, pairs, held, limits = RoadSamples(*values[:4]), PointPairs(*values[4:8]), Held(*values[8:11]), values[11:]
    n, rms = adjust(p, Plane(UNIT, *ORIGIN), points, pairs, held, AdjustLimits(*limits), town.roads, normal)
    return p, n, rms, normal


def corner_gap(p, q):
    corners = [(-0.7, -0.7), (0.7, -0.7), (0.7, 0.7), (-0.7, 0.7)]
    return UNIT * max(np.hypot(*(naive.predict(p, *c) - naive.predict(q, *c))) for c in corners)


@pytest.mark.parametrize("axis", [(1.0, 0.0), (0.0, 1.0), (0.6, -0.8)])
def test_point_row_is_the_derivative(axis):
    row = np.empty(8)
    x, y, w = point_row(P, 0.3, -0.5, *axis, row)
    assert (x, y) == pytest.approx(naive.predict(P, 0.3, -0.5))
    assert w == pytest.approx(1 + P[6] * 0.3 - P[7] * 0.5)
    assert np.allclose(row, axis @ naive.predict_rows(P, 0.3, -0.5), atol=1e-8)


@pytest.mark.parametrize("uv", [(0.3, -0.5), (-0.6, 0.1)])
def test_carry_maps_a_point_and_a_direction(uv):
    x, y, w, dx, dy, length = carry(P, *uv, 0.6, -0.8)
    assert (x, y) == pytest.approx(naive.predict(P, *uv))
    ahead = naive.jacobian(np.append(P, 1.0).reshape(3, 3), np.array(uv)) @ (0.6, -0.8)
    assert np.array([dx, dy]) / w == pytest.approx(ahead, abs=1e-6)
    assert length == pytest.approx(np.hypot(dx, dy))


@pytest.mark.parametrize("times", [0.5, 1.5, 5.0])
def test_a_point_is_less_sure_where_a_pixel_reaches_further(times):
    usual = np.hypot(1.6, 0.003 * UNIT)  # the map's and the mask's part, metres
    sigma = own_sigma(times * UNIT, usual, 1.6, 0.003)
    assert sigma == pytest.approx(naive.own_sigma(times * UNIT, usual, 1.6, 0.003))
    assert (sigma > 1.0) == (times > 1.0)


def test_beyond_the_horizon_nothing_is_carried():
    assert carry(P, -10.0, 10.0, 1.0, 0.0)[2] < 0.02


@pytest.mark.slow
def test_add_row_sums_normal_equations():
    rng = np.random.default_rng(0)
    A, W, b = rng.normal(0, 1, (20, 8)), rng.uniform(0, 1, 20), rng.normal(0, 1, 20)
    normal, right = np.zeros((8, 8)), np.zeros(8)
    for row, weight, residual in zip(A, W, b, strict=True):
        add_row(normal, right, row, weight, residual)
    assert np.allclose(np.tril(normal), np.tril(A.T @ (W[:, None] * A)))
    assert np.allclose(right, A.T @ (W * b))


@pytest.mark.parametrize("seed", range(5))
def test_exact_observations_give_the_homography(seed):
    town = Town(seed)
    start = jittered(P, 0.008, seed)
    assert corner_gap(start, P) > 2
    p, n, rms, _ = run(town, start, prior=0.0)
    assert n > 60
    assert rms < 1e-3
    assert corner_gap(p, P) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("changes", [{}, {"max_radius": 12.0}, {"least_share": 0.8}, {"prior": 10.0}])
@pytest.mark.parametrize("seed", range(3))
def test_like_the_twin(seed, changes):
    town = Town(seed, noise=1.5, points=50)
    town.directions[:12] = town.directions[:12, ::-1]  # some roads run across
    start = jittered(P, 0.006, seed)
    p, n, rms, normal = run(town, start, n_iterations=4, **changes)
    arguments = town.arguments(n_iterations=4, **changes)
    expected, n_expected, rms_expected, system = naive.adjust(start, UNIT, ORIGIN, *arguments, town.roads[0])
    assert n == n_expected
    assert rms == pytest.approx(rms_expected, rel=1e-3)
    assert corner_gap(p, expected) < 1e-3
    assert np.allclose(normal, system, rtol=1e-2, atol=1e-3)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.slow
def test_like_the_twin_where_points_are_held(seed):
    town, start = Town(seed, noise=1.5, pairs=3), jittered(P, 0.004, seed)
    p, n, rms, normal = run(town, start, held_at=start)
    expected = naive.adjust(start, UNIT, ORIGIN, *town.arguments(held_at=start), town.roads[0].astype(float))
    assert np.allclose(p, expected[0], atol=1e-6)
    assert n == expected[1]
    assert rms == pytest.approx(expected[2], rel=1e-4)
    assert np.allclose(np.tril(normal), np.tril(expected[3]), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("pairs", [0, 2])
def test_held_near_its_start_roads_are_enough(pairs):
    town, start = Town(pairs=pairs), jittered(P, 0.006, 4)
    assert corner_gap(start, P) > 4
    free, n_free, *_ = run(town, start)
    assert n_free == -1 or corner_gap(free, P) > 4
    p, n, *_ = run(town, start, held_at=start)
    assert n > 50
    assert corner_gap(p, P) < 0.5


def test_wrong_matches_are_outvoted():
    town = Town(4, noise=0.5)
    town.targets[:4] += (0.05, -0.05)  # 28 m off
    p, *_ = run(town, jittered(P, 0.004))
    assert corner_gap(p, P) < 2


def test_cells_where_roads_do_not_meet_wait():
    town = Town(6)
    town.cells = lambda xy: (xy[:, 0] > 0).astype(np.int64)
    right = town.points[:, 0] > 0
    rng = np.random.default_rng(0)
    town.points[right] += rng.uniform(-0.2, 0.2, (right.sum(), 2))  # what is there is not on the map
    n = run(town, P, least_share=0.6, max_radius=8.0)[1]
    assert n <= (~right).sum()
    assert run(town, P, least_share=0.0, max_radius=8.0)[1] > n


@pytest.mark.parametrize("pairs", [0, 1])
def test_too_little_to_stand_on(pairs):
    town = Town(0, points=0, pairs=pairs)
    p, n, rms, _ = run(town, P)
    assert rms == np.inf
    assert n <= 0
    assert np.isfinite(p).all()


@pytest.mark.parametrize("beyond", ["pairs", "points", "held"])
def test_the_horizon_is_refused(beyond):
    town, place = Town(0), np.array([-10.0, 10.0])
    if beyond == "held":
        town.held = lambda p: (place[None], place[None])
    else:
        getattr(town, beyond)[0] = place
    town.cells = lambda xy: np.zeros(len(xy), np.int64)
    assert run(town, P, held_at=P)[1:3] == (-1, np.inf)


def test_a_match_that_is_no_place_is_refused():
    town = Town(0)
    town.targets[0] = np.nan
    assert run(town, P)[1:3] == (-1, np.inf)


def test_matches_beyond_the_greatest_radius_do_not_count():
    town, start = Town(2, noise=0.5), jittered(P, 0.002)
    town.targets[:3] += 0.1  # 57 m off
    p, n, rms, _ = run(town, start)
    town.pairs, town.targets = town.pairs[3:], town.targets[3:]
    expected, n_expected, rms_expected, _ = run(town, start)
    assert np.array_equal(p, expected)
    assert (n, rms) == (n_expected, rms_expected)
