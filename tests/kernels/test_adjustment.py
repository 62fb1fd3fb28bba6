"""The adjustment against a slow twin and a known homography."""

import numpy as np
import pytest
from kernels.test_roads import binned
from naive import kernels as naive

from roadgeo.geometry.lens import Lens
from roadgeo.kernels.adjustment import (
    add_point,
    add_row,
    adjust,
    begin_system,
    carry,
    cholesky,
    meet_roads,
    own_sigma,
    point_row,
    solve_cholesky,
    solve_system,
    spread,
    straighten,
)
from roadgeo.kernels.structs import AdjustLimits, Held, Met, Plane, PointPairs, RoadSamples

P = np.array([0.9, -0.2, 0.05, 0.25, 1.1, -0.02, 0.12, -0.08, 0.0])
UNIT, ORIGIN, HALF_SIDE = 400.0, np.array([350.0, 320.0]), 0.7
GRID, SHAPE = (-400.0, -400.0, 100.0), (15, 15)
N_CELLS = 9


def jittered(p, size, seed=0):
    return p + np.append(np.random.default_rng(seed).normal(0, size, 8), 0.0)


def lens_of(k1):
    return Lens(k1, (0.0, 0.0), HALF_SIDE)


def moves(lens, points):
    """Return the derivative of straightened points by k1."""
    straight = (lens.straighten(points) - lens.center) / lens.half_side
    square = (straight**2).sum(axis=-1, keepdims=True)
    return -lens.half_side * straight * square / (1.0 + 3.0 * lens.k1 * square)


class Town:
    """Crooked streets on the reference plane, road points that a query saw of them, and matched intersections."""

    def __init__(self, seed=0, noise=0.0, points=80, pairs=12, k1=0.0):
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
        inverse = np.linalg.inv(np.append(P[:8], 1.0).reshape(3, 3))
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
        lens, straight = lens_of(k1), query[kept]
        self.points = lens.bend(straight)
        ahead = lens.bend(straight + 1e-4 * ahead[kept]) - self.points
        self.directions = ahead / np.hypot(*ahead.T)[:, None]
        self.pairs = rng.uniform(-0.6, 0.6, (pairs, 2))
        self.targets = np.array([naive.predict(P[:8], *q) for q in self.pairs]).reshape(-1, 2)
        self.pairs = lens.bend(self.pairs)
        self.targets += rng.normal(0, noise / UNIT, self.targets.shape)

    def cells(self, xy):
        return (np.clip((xy + 0.7) / 1.4 * 3, 0, 2).astype(np.int64) @ (1, 3)).astype(np.int64)

    def held(self, p):
        """A grid of points over the frame, and where `p` puts them."""
        grid = np.stack(np.meshgrid([-0.6, 0.0, 0.6], [-0.6, 0.0, 0.6]), axis=-1).reshape(-1, 2)
        return grid, np.array([naive.see(p, HALF_SIDE, q) for q in grid])

    def arguments(self, held_at=None, **changes):
        """Of the kernel and of its twin: all between the parameters and the roads."""
        values = {
            "point_weight": 0.8, "pair_weight": 0.3, "n_cells": N_CELLS, "least_share": 0.5, "max_radius": 30.0,
            "min_cos": float(np.cos(np.radians(25))), "sigma_m": 2.0, "map_sigma_m": 1.6, "mask_sigma": 0.003,
            "prior": 1e-4, "n_iterations": 12, "tolerance_m": 1e-4, **changes,
        }  # fmt: skip
        values["prior"] = np.array([0.0] * 6 + [values["prior"]] * 2 + [1e-4])
        point_weight, pair_weight, *limits = values.values()
        points = RoadSamples(self.points, self.directions, self.cells(self.points), point_weight, HALF_SIDE)
        pairs = PointPairs(self.pairs, self.targets, self.cells(self.pairs), pair_weight)
        held = (np.empty((0, 2)), np.empty((0, 2))) if held_at is None else self.held(held_at)
        return Plane(UNIT, *ORIGIN), points, pairs, Held(*held, 0.05), AdjustLimits(*limits)


def room(points, free):
    n = len(points.xy)
    return Met(np.empty((n, free)), np.empty(n), np.empty(n), np.empty(n), np.empty(n, np.bool_))


def run(town, p, free=8, **changes):
    p, normal, arguments = p.copy(), np.empty((free, free)), town.arguments(**changes)
    n, rms = adjust(p, *arguments, town.roads, normal, room(arguments[1], free))
    return p, n, rms, normal


def corner_gap(p, q):
    corners = [(-0.7, -0.7), (0.7, -0.7), (0.7, 0.7), (-0.7, 0.7)]
    return UNIT * max(np.hypot(*(naive.predict(p[:8], *c) - naive.predict(q[:8], *c))) for c in corners)


class TestCholesky:
    @pytest.mark.parametrize("n", [1, 3, 8])
    def test_factorises_and_solves(self, n):
        rng = np.random.default_rng(n)
        root = rng.normal(0, 1, (n, n + 2))
        matrix = root @ root.T
        factor, right = np.zeros((n, n)), rng.normal(0, 1, n)
        expected = np.linalg.solve(matrix, right)
        assert cholesky(np.tril(matrix), factor)
        np.fill_diagonal(lower := factor.copy(), 1.0 / np.diag(factor))
        assert np.allclose(lower, np.linalg.cholesky(matrix))
        solve_cholesky(factor, right)
        assert np.allclose(right, expected)

    @pytest.mark.parametrize("matrix", [np.zeros((2, 2)), -np.eye(3), np.ones((2, 2)), np.full((2, 2), np.nan)])
    def test_refuses_what_is_not_positive_definite(self, matrix):
        assert not cholesky(matrix, np.zeros(matrix.shape))

    def test_spread_is_by_the_inverse(self):
        rng = np.random.default_rng(1)
        root, row, factor = rng.normal(0, 1, (8, 9)), rng.normal(0, 1, 8), np.zeros((8, 8))
        assert cholesky(root @ root.T, factor)
        assert spread(row, factor, np.empty(8)) == pytest.approx(row @ np.linalg.inv(root @ root.T) @ row)

    def test_a_system_moves_the_parameters(self):
        p, prior, normal, right = np.arange(9.0), np.full(9, 2.0), np.empty((8, 8)), np.empty(8)
        begin_system(p, prior, normal, right)
        assert solve_system(p, normal, right, np.zeros((8, 8))) == pytest.approx(7.0)
        assert np.allclose(p, [0.0] * 8 + [8.0])  # what holds them near zero is all there is
        assert solve_system(p, -normal, right, np.zeros((8, 8))) == -1.0


LENSES = [0.0, -0.12, 0.1]


@pytest.mark.parametrize("k1", [*LENSES, -0.45])
@pytest.mark.parametrize("uv", [(0.3, -0.5), (-0.6, 0.1), (0.0, 0.0)])
def test_straighten_like_the_lens(k1, uv):
    lens, at, along = lens_of(k1), np.array(uv), np.array([0.6, -0.8])
    found = straighten(k1, HALF_SIDE, *uv, *along)
    assert found[:2] == pytest.approx(lens.straighten(at))
    assert found[2:4] == pytest.approx(lens.stretch(at) @ along)
    assert found[4:6] == pytest.approx(moves(lens, at))
    assert found[6] == pytest.approx(np.linalg.det(lens.stretch(at)))


@pytest.mark.parametrize("n", [8, 9])
@pytest.mark.parametrize("k1", LENSES)
@pytest.mark.parametrize("axis", [(1.0, 0.0), (0.0, 1.0), (0.6, -0.8)])
def test_point_row_is_the_derivative(axis, k1, n):
    row, p, uv = np.empty(n), np.append(P[:8], k1), np.array([0.3, -0.5])
    straight = lens_of(k1).straighten(uv)
    x, y, w = point_row(p, *straight, tuple(moves(lens_of(k1), uv)), *axis, row)
    assert (x, y) == pytest.approx(naive.see(p, HALF_SIDE, uv))
    assert w == pytest.approx(1 + p[6:8] @ straight)
    assert np.allclose(row, (axis @ naive.see_rows(p, HALF_SIDE, uv))[:n], atol=1e-8)


@pytest.mark.parametrize("uv", [(0.3, -0.5), (-0.6, 0.1)])
def test_carry_maps_a_point_and_a_direction(uv):
    x, y, w, dx, dy, length = carry(P, *uv, 0.6, -0.8)
    assert (x, y) == pytest.approx(naive.predict(P[:8], *uv))
    ahead = naive.jacobian(np.append(P[:8], 1.0).reshape(3, 3), np.array(uv)) @ (0.6, -0.8)
    assert np.array([dx, dy]) / w == pytest.approx(ahead, abs=1e-6)
    assert length == pytest.approx(np.hypot(dx, dy))


@pytest.mark.parametrize("n", [8, 9])
def test_add_point_like_the_twin(n):
    p, normal, right = np.append(P[:8], -0.1), np.zeros((n, n)), np.zeros(n)
    place = (0.5, 0.1)
    assert add_point(p, HALF_SIDE, (0.3, -0.5), place, 0.7, normal, right, np.empty(n)) > 0.9
    expected, side = naive.add_point(p, HALF_SIDE, (0.3, -0.5), place, 0.7, n)
    assert np.allclose(np.tril(normal), np.tril(expected), atol=1e-8)
    assert np.allclose(right, side, atol=1e-8)


@pytest.mark.parametrize("k1", LENSES)
@pytest.mark.parametrize(("known", "free"), [(True, 8), (False, 9)])
def test_roads_like_the_twin(k1, known, free):
    p, town = np.append(P[:8], k1), Town(3, noise=1.5)
    plane, points, _, _, limits = town.arguments()
    root = 4.0 * np.eye(free) + np.tril(np.full((free, free), 1.0))
    factor, met = np.zeros((free, free)), room(points, free)
    assert known or cholesky(root @ root.T, factor)
    n = meet_roads(p, plane, points, limits, town.roads, factor, met)
    inverse = np.zeros((free, free)) if known else np.linalg.inv(root @ root.T)
    expected = naive.meet_roads(p, plane, points, limits, inverse, town.roads.segments)
    assert n == sum(value[1] is not None for value in expected) > 5
    for i, (searched, row, *numbers) in enumerate(expected):
        assert met.searched[i] == searched
        assert np.isnan(met.residuals[i]) == (row is None)
        if row is not None:
            assert np.allclose(met.rows[i], row, atol=1e-6)
            assert (met.residuals[i], met.sigmas[i], met.own[i]) == pytest.approx(numbers, rel=1e-4, abs=2e-3)


def test_points_beyond_the_horizon_or_nowhere_meet_nothing():
    town = Town()
    plane, points, _, _, limits = town.arguments()
    for p in (np.append(P[:6], [-40.0, 0.0, 0.0]), np.full(9, np.nan)):
        met = room(points, 8)
        meet_roads(p, plane, points, limits, town.roads, np.zeros((8, 8)), met)
        assert np.isnan(met.residuals[points.xy[:, 0] > 0.1]).all()
        assert not met.searched[points.xy[:, 0] > 0.1].any()


@pytest.mark.parametrize("times", [0.5, 1.5, 5.0])
def test_a_point_is_less_sure_where_a_pixel_reaches_further(times):
    usual = np.hypot(1.6, 0.003 * UNIT)  # the map's and the mask's part, metres
    sigma = own_sigma(times * UNIT, usual, 1.6, 0.003)
    assert sigma == pytest.approx(naive.own_sigma(times * UNIT, usual, 1.6, 0.003))
    assert (sigma > 1.0) == (times > 1.0)


def test_beyond_the_horizon_nothing_is_carried():
    assert carry(P, -10.0, 10.0, 1.0, 0.0)[2] < 0.02


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


@pytest.mark.parametrize("changes", [{}, {"max_radius": 12.0}, {"least_share": 0.8}, {"prior": 10.0}])
@pytest.mark.parametrize("seed", range(2))
def test_like_the_twin(seed, changes):
    town = Town(seed, noise=1.5, points=50)
    town.directions[:12] = town.directions[:12, ::-1]  # some roads run across
    start = jittered(P, 0.006, seed)
    p, n, rms, normal = run(town, start, n_iterations=4, **changes)
    arguments = town.arguments(n_iterations=4, **changes)
    expected, n_expected, rms_expected, system = naive.adjust(start, 8, *arguments, town.roads[0])
    assert n == n_expected
    assert rms == pytest.approx(rms_expected, rel=1e-3)
    assert corner_gap(p, expected) < 1e-3
    assert np.allclose(np.tril(normal), np.tril(system), rtol=1e-2, atol=1e-3)


def test_like_the_twin_where_points_are_held():
    town, start = Town(0, noise=1.5, pairs=3), jittered(P, 0.004, 0)
    p, n, rms, normal = run(town, start, held_at=start)
    expected = naive.adjust(start, 8, *town.arguments(held_at=start), town.roads[0].astype(float))
    assert np.allclose(p, expected[0], atol=1e-6)
    assert n == expected[1]
    assert rms == pytest.approx(expected[2], rel=1e-4)
    assert np.allclose(np.tril(normal), np.tril(expected[3]), rtol=1e-4, atol=1e-6)


def test_like_the_twin_with_a_lens():
    town, start = Town(2, noise=1.5, points=50, k1=-0.1), np.append(jittered(P, 0.004, 2)[:8], -0.05)
    p, n, rms, normal = run(town, start, 9, n_iterations=5)
    expected = naive.adjust(start, 9, *town.arguments(n_iterations=5), town.roads[0].astype(float))
    assert np.allclose(p, expected[0], atol=1e-5)
    assert n == expected[1]
    assert rms == pytest.approx(expected[2], rel=1e-3)
    assert np.allclose(np.tril(normal), np.tril(expected[3]), rtol=1e-2, atol=1e-3)


@pytest.mark.parametrize("pairs", [0, 1])
def test_too_little_to_stand_on(pairs):
    town = Town(0, points=0, pairs=pairs)
    p, n, rms, _ = run(town, P)
    assert rms == np.inf
    assert n <= 0
    assert np.isfinite(p).all()


@pytest.mark.parametrize("beyond", ["pairs", "held"])
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
