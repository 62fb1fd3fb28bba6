"""Roads in buckets against roads searched one by one."""

import math

import numpy as np
import pytest
from naive import kernels as naive

from roadgeo.kernels.roads import (
    bin_segments,
    count_residuals,
    meets_road,
    nearest_road,
    road_residuals,
    screen,
    shares_near_roads,
)
from roadgeo.kernels.structs import RoadBuckets

GRID, SHAPE = (-50.0, 20.0, 100.0), (8, 6)
MIN_COS = np.cos(np.radians(25))


def binned(segments, grid=GRID, shape=SHAPE):
    """Segments in buckets, as the kernels take them."""
    segments = np.asarray(segments, np.float32).reshape(-1, 4)
    counts = np.zeros(shape[0] * shape[1] + 1, np.int64)
    total = bin_segments(segments, grid, shape, counts, np.empty(0, np.int32))
    starts = np.cumsum(counts)
    ids = np.empty(total, np.int32)
    free = starts.copy()
    assert bin_segments(segments, grid, shape, free, ids) == total
    if total:
        assert np.array_equal(free[:-1], starts[1:])
    return RoadBuckets(segments, starts.astype(np.int32), ids, grid, shape)


def town(seed=0, n=120, longest=150.0):
    rng = np.random.default_rng(seed)
    start = rng.uniform((-40, 30), (740, 610), (n, 2))
    return binned(np.hstack([start, start + rng.uniform(-longest, longest, (n, 2))]))


def directions(rng, n):
    angle = rng.uniform(0, 2 * np.pi, n)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


class TestBinSegments:
    @pytest.mark.parametrize("seed", range(3))
    def test_lists_whatever_crosses_a_bucket(self, seed):
        segments, starts, ids, grid, shape = town(seed)
        expected = naive.bin_segments(segments, grid, shape)
        for c, crossing in enumerate(expected):
            listed = ids[starts[c] : starts[c + 1]].tolist()
            assert len(set(listed)) == len(listed)
            assert crossing <= set(listed)
        assert len(ids) < 1.6 * sum(map(len, expected))

    def test_keeps_what_lies_outside_in_the_rim(self):
        _, starts, ids, *_ = binned([[-900, -900, -800, -950], [5000, 5000, 5100, 5000]])
        assert ids[starts[0] : starts[1]].tolist() == [0]
        assert ids[starts[-2] : starts[-1]].tolist() == [1]

    def test_no_segments(self):
        _, starts, ids, *_ = binned(np.empty((0, 4)))
        assert len(ids) == 0
        assert not starts.any()

    def test_a_segment_of_no_length(self):
        assert len(binned([[100, 100, 100, 100]])[2]) == 1


class TestNearestRoad:
    @pytest.mark.parametrize("radius", [5.0, 40.0, 260.0])
    @pytest.mark.parametrize("min_cos", [0.0, MIN_COS, 0.9999])
    def test_like_the_twin(self, radius, min_cos):
        roads = town(1)
        rng = np.random.default_rng(2)
        for (x, y), (dx, dy) in zip(rng.uniform(-100, 800, (120, 2)), directions(rng, 120), strict=True):
            d, *rest = nearest_road(x, y, dx, dy, radius, min_cos, *roads)
            distance, foot, direction = naive.nearest_road(x, y, dx, dy, radius, min_cos, roads[0])
            if not (roads[3][0] < x < 750 and roads[3][1] < y < 620):
                continue  # outside the grid only its rim is known
            assert d == pytest.approx(distance, abs=1e-3)
            if np.isfinite(distance):
                assert rest == pytest.approx([*foot, *direction], abs=2e-3)

    def test_no_roads_and_roads_of_no_length(self):
        assert nearest_road(0.0, 0.0, 1.0, 0.0, 50.0, 0.0, *binned(np.empty((0, 4))))[0] == np.inf
        assert nearest_road(100.0, 100.0, 1.0, 0.0, 50.0, 0.0, *binned([[100, 100, 100, 100]]))[0] == np.inf

    @pytest.mark.parametrize("place", [(np.nan, 0.0), (1e300, 0.0), (-1e300, 1e300), (np.inf, 100.0)])
    def test_places_that_are_none(self, place):
        assert nearest_road(*place, 1.0, 0.0, 50.0, 0.0, *town())[0] == np.inf


class TestMeetsRoad:
    @pytest.mark.parametrize("radius", [5.0, 30.0, 120.0])
    def test_like_the_twin(self, radius):
        roads = town(3)
        rng = np.random.default_rng(8)
        places, along = rng.uniform(-50, 650, (80, 2)), directions(rng, 80)
        met = [meets_road(*place, *way, radius, MIN_COS, roads) for place, way in zip(places, along, strict=True)]
        expected = [
            naive.meets_road(*place, *way, radius, MIN_COS, roads.segments)
            for place, way in zip(places, along, strict=True)
        ]
        assert met == expected
        assert 0 < sum(met) < len(met)

    def test_no_roads_roads_of_no_length_and_places_that_are_none(self):
        assert not meets_road(0.0, 0.0, 1.0, 0.0, 50.0, 0.0, binned(np.empty((0, 4))))
        assert not meets_road(100.0, 100.0, 1.0, 0.0, 50.0, 0.0, binned([[100, 100, 100, 100]]))
        assert not meets_road(np.nan, 0.0, 1.0, 0.0, 50.0, 0.0, town())


TILTED = np.array([[0.9, -0.3, 260.0], [0.25, 1.1, 420.0], [2e-4, -3e-4, 1.0]])


class TestRoadResiduals:
    def test_like_the_twin(self):
        roads = town(3)
        rng = np.random.default_rng(4)
        points, along = rng.uniform((0, -250), (250, 0), (60, 2)), directions(rng, 60)
        radii, out = rng.uniform(5, 60, 60), np.empty((60, 3))
        n = road_residuals(TILTED, points, along, radii, MIN_COS, roads, out)
        expected = naive.road_residuals(TILTED, points, along, radii, MIN_COS, roads.segments)
        assert 0 < n == np.isfinite(expected[:, 0]).sum() < 60
        assert np.allclose(out, expected, atol=2e-3, equal_nan=True)

    def test_beyond_the_horizon_there_is_nothing(self):
        horizon = np.array([[1.0, 0, 300], [0, 1.0, 300], [0, -0.1, 1.0]])
        points, along, out = np.array([[0.0, 20.0], [0.0, 10.0]]), np.array([[1.0, 0], [0, 1]]), np.empty((2, 3))
        assert road_residuals(horizon, points, along, np.full(2, 1e3), 0.0, town(3), out) == 0  # w = -1, 0
        assert np.isnan(out).all()

    def test_places_that_are_none(self):
        nowhere, along, out = np.array([[np.nan, 0.0]]), np.array([[1.0, 0.0]]), np.empty((1, 3))
        assert road_residuals(np.eye(3), nowhere, along, np.array([9.0]), 0.5, town(), out) == 0
        assert np.isnan(out).all()

    def test_no_points(self):
        nothing = np.empty((0, 2)), np.empty((0, 2)), np.empty(0), 0.5
        assert road_residuals(TILTED, *nothing, town(), np.empty((0, 3))) == 0


class TestSharesNearRoads:
    @pytest.mark.parametrize("weigh", [np.ones_like, lambda points: points % 1.0])
    def test_like_the_twin(self, weigh):
        roads = town(3)
        rng = np.random.default_rng(4)
        points, along = rng.uniform((0, -250), (250, 0), (40, 2)), directions(rng, 40)
        shifts = np.array([(0.0, 0.0), (31.0, -17.0), (-200.0, 60.0)])
        weights, shares = weigh(points[:, 0]), np.empty(3)
        shares_near_roads(TILTED, points, along, weights, 30.0, MIN_COS, shifts, roads, shares)
        expected = naive.shares_near_roads(TILTED, points, along, weights, 30.0, MIN_COS, shifts, roads.segments)
        np.testing.assert_allclose(shares, expected, rtol=1e-12)
        assert min(expected) > 0


class TestCountResiduals:
    RADIUS, BINS = 30.0, 12
    CORNERS = np.array([[0.0, 0.0], [300.0, 0.0], [300.0, -250.0], [0.0, -250.0]])

    def count(self, roads, matrix, points, along, weights, field, scale, observed, bounds=(-1e4, -1e4, 1e4, 1e4)):
        inverse, bounds = np.linalg.inv(matrix), np.array(bounds)
        for piece_px, columns, pieces in ((40.0, 8, 56), (math.inf, 1, 1)):
            forward, backward = np.full((2, pieces, self.BINS + 1), 7.0)  # what is left of the last call
            count_residuals(
                matrix, inverse, bounds, points, along, weights, self.RADIUS, MIN_COS, 4.0, roads, field, scale,
                observed, piece_px, columns, forward, backward,
            )  # fmt: skip
            if pieces > 1:
                by_piece = forward.sum(axis=0), backward.sum(axis=0)
        np.testing.assert_allclose(by_piece, (forward[0], backward[0]))  # together the pieces are the frame
        return forward[0], backward[0]

    def test_a_road_counts_in_the_piece_of_the_frame_where_it_lies(self):
        points, along = np.array([[10.0, -10.0], [130.0, -10.0], [10.0, -130.0]]), np.array([[1.0, 0.0]] * 3)
        forward, backward = np.empty((2, 4, 2))
        empty, seen = np.zeros((10, 10), np.float32), np.ones((10, 10), bool)
        count_residuals(
            np.eye(3), np.eye(3), np.zeros(4), points, along, np.array([1.0, 2.0, 3.0]), 5.0, MIN_COS, 4.0, binned([]),
            empty, 20.0, seen, 100.0, 2, forward, backward,
        )  # fmt: skip
        assert forward[:, 1].tolist() == [1.0, 2.0, 3.0, 0.0]

    def scene(self, scale=1.0, n=60):
        rng = np.random.default_rng(4)
        points, along = rng.uniform((0, -250), (300, 0), (n, 2)), directions(rng, n)
        cells = (int(250 / scale), int(300 / scale))
        field = rng.uniform(0, 60 / scale, cells).astype(np.float32)
        return points, along, rng.uniform(size=n), field, scale, rng.uniform(size=cells) < 0.7

    @pytest.mark.parametrize("matrix", [TILTED, np.array([[1.1, 0.2, 250.0], [-0.2, 1.1, 400.0], [0, 0, 1]])])
    @pytest.mark.parametrize("scale", [1.0, 2.5])
    def test_like_the_twin(self, matrix, scale):
        roads, (*points, field, _, observed) = town(5), self.scene(scale)
        corners = np.c_[self.CORNERS, np.ones(4)] @ matrix.T
        corners = corners[:, :2] / corners[:, 2:]
        bounds = np.concatenate([corners.min(axis=0), corners.max(axis=0)])
        forward, backward = self.count(roads, matrix, *points, field, scale, observed, bounds)

        def inside(x, y):
            return GRID[0] <= x < GRID[0] + 800 and GRID[1] <= y < GRID[1] + 600

        expected = naive.count_residuals(
            matrix, *points, self.RADIUS, MIN_COS, 4.0, roads.segments, inside, field, scale, observed, self.BINS
        )
        np.testing.assert_allclose(forward, expected[0], atol=1e-9)
        assert forward.sum() == pytest.approx(points[2].sum())
        assert (forward[:-1] > 0).sum() > 5
        np.testing.assert_allclose(backward, expected[1], atol=10.0)  # a sample may lie on the border of two cells
        assert backward.sum() == pytest.approx(expected[1].sum(), rel=0.01)
        assert expected[1].min() > 20.0

    def test_the_map_is_counted_in_pixels_of_road_wherever_it_is_observed(self):
        """One road of 100 m across the frame, at half a metre per pixel, of which a quarter is not observed."""
        roads, matrix = binned([[100, 200, 200, 200]]), np.array([[0.5, 0, 100], [0, 0.5, 250], [0, 0, 1]])
        field, observed = np.full((20, 20), 3.5, np.float32), np.ones((20, 20), bool)
        observed[:, :5] = False
        nothing = np.empty((0, 2)), np.empty((0, 2)), np.empty(0)
        forward, backward = self.count(roads, matrix, *nothing, field, 10.0, observed)
        assert not forward.any()
        # three cells of 10 pixels, each half a metre: 15 m off
        assert backward[int(self.BINS * 15.0 / self.RADIUS)] == pytest.approx(150.0, abs=8.0)
        assert np.count_nonzero(backward) == 1

    def test_no_roads(self):
        *points, field, scale, observed = self.scene()
        forward, backward = self.count(binned(np.empty((0, 4))), TILTED, *points, field, scale, observed)
        assert forward[-1] == pytest.approx(points[2].sum())
        assert not forward[:-1].any()
        assert not backward.any()

    def test_nothing_seen_counts_for_nothing(self):
        *points, field, scale, observed = self.scene()
        assert not self.count(town(5), TILTED, *points, field, scale, np.zeros_like(observed))[1].any()

    def test_roads_and_points_beyond_the_horizon(self):
        horizon = np.array([[1.0, 0, 300], [0, 1.0, 300], [0, -0.1, 1.0]])
        points, along = np.array([[0.0, 20.0], [0.0, 10.0]]), np.array([[1.0, 0], [0, 1]])  # w = -1, 0
        field, observed = np.zeros((10, 10), np.float32), np.ones((10, 10), bool)
        forward, _ = self.count(town(5), horizon, points, along, np.ones(2), field, 20.0, observed)
        assert forward.tolist() == [0.0] * self.BINS + [2.0]
        behind = -np.array([[1.0, 0, -100], [0, 1, -400], [0, 0, 1]])  # the map is behind the camera
        assert not self.count(town(5), behind, points, along, np.ones(2), field, 20.0, observed)[1].any()

    @pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
    def test_places_that_are_none(self, value):
        *points, field, scale, observed = self.scene()
        points[0][:] = value
        with np.errstate(invalid="ignore"):  # as plain Python numpy tells that infinity less infinity is no number
            forward, _ = self.count(town(5), TILTED, *points, field, scale, observed)
        assert forward[-1] == pytest.approx(points[2].sum())

    @pytest.mark.parametrize("w", [1e-300, np.nan])
    def test_pixels_at_infinity_are_outside(self, w):
        roads, field, observed = town(5), np.zeros((10, 10), np.float32), np.ones((10, 10), bool)
        inverse, bounds = np.array([[1.0, 0, 0], [0, -1.0, 0], [0, 0, w]]), np.array([-1e4, -1e4, 1e4, 1e4])
        nothing, (forward, backward) = np.empty((0, 2)), np.empty((2, 1, self.BINS + 1))
        count_residuals(
            TILTED, inverse, bounds, nothing, nothing, np.empty(0), self.RADIUS, MIN_COS, 4.0, roads, field, 20.0,
            observed, math.inf, 1, forward, backward,
        )  # fmt: skip
        assert not backward.any()


class TestScreen:
    def run(self, points, along, least, n=40):
        roads = town(7)
        rng = np.random.default_rng(8)
        ref_xy = rng.uniform((100, 100), (600, 500), (20, 2))
        references = rng.integers(0, 20, n)
        turn = rng.uniform(0, 2 * np.pi, n)
        affines = (
            rng.uniform(0.5, 2, n) * np.array([np.cos(turn), -np.sin(turn), np.sin(turn), np.cos(turn)])
        ).T.copy()
        affines += rng.normal(0, 0.05, affines.shape)
        shares = np.full(n, np.nan)
        anchor = np.array([40.0, -30.0])
        screen(references, affines, anchor, ref_xy, points, along, 8.0, 4.0, MIN_COS, least, roads, shares)
        expected = naive.screen(references, affines, anchor, ref_xy, points, along, 8.0, 4.0, MIN_COS, least, roads[0])
        return shares, expected

    @pytest.mark.parametrize("least", [0.0, 0.2, 0.4])
    def test_like_the_twin(self, least):
        rng = np.random.default_rng(9)
        shares, expected = self.run(rng.uniform((0, -80), (80, 0), (25, 2)), directions(rng, 25), least)
        assert (expected > 0).any()
        assert np.allclose(shares, expected)

    def test_without_points_nothing_speaks_against_a_proposal(self):
        shares, _ = self.run(np.empty((0, 2)), np.empty((0, 2)), 0.6)
        assert (shares == 1).all()
