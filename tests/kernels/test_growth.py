"""Growth of hypotheses against slow twins and known homographies."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from naive import kernels as naive

from roadgeo.kernels.growth import grow_each
from roadgeo.kernels.point_matching import keep_nearest, match_all, nearest_alike
from roadgeo.kernels.structs import GrowthLimits, GrowthQuery, PointBuckets
from roadgeo.matching.index import neighbour_grid, sort_by_bucket

TOLERANCE = np.radians(25)
MIN_COS = np.cos(TOLERANCE)
TRUTH = np.array([[0.8, -0.55, 700.0], [0.5, 0.75, 900.0], [1.5e-4, -1e-4, 1.0]])


def branches_of(angles):
    """(N, 8, 2) int8 from (N, k) radians, NaN-padded."""
    vectors = np.full((len(angles), 8, 2), np.nan)
    vectors[:, : angles.shape[1]] = np.stack([np.cos(angles), np.sin(angles)], -1)
    return np.round(127 * np.nan_to_num(vectors)).astype(np.int8)


class World:
    """Scattered intersections with three or four branches, in buckets, and a noisy view of some of them."""

    def __init__(self, seed=0, n=150, noise=0.5, false=10, missing=0.1):
        rng = np.random.default_rng(seed)
        xy = rng.uniform(0, 1500, (n, 2))
        angles = rng.uniform(0, 2 * np.pi, (n, 1)) + np.radians([0, 95, 185, 275]) + rng.uniform(-0.1, 0.1, (n, 4))
        angles[rng.uniform(size=n) < 0.6, 3] = np.nan
        self.grid, self.shape = neighbour_grid(xy, 100.0)
        order, self.starts = sort_by_bucket(xy, self.grid, self.shape)
        self.ref_xy, angles = np.ascontiguousarray(xy[order]), angles[order]
        self.ref_branches = branches_of(angles)
        back = np.linalg.inv(TRUTH)
        places = [naive.transform(back, point) for point in self.ref_xy]
        self.truth = np.array([i for i, q in enumerate(places) if (0 < q[0] < 700) and (-700 < q[1] < 0)])
        self.truth = rng.permutation(self.truth[rng.uniform(size=len(self.truth)) > missing])
        rays = np.full((len(self.truth), 4), np.nan)
        for row, i in enumerate(self.truth):
            J = naive.jacobian(back, self.ref_xy[i])
            turned = J @ np.array([np.cos(angles[i]), np.sin(angles[i])])
            rays[row] = np.arctan2(turned[1], turned[0])
        invented = np.c_[rng.uniform(0, 7, (false, 3)), np.full((false, 1), np.nan)]
        self.xy = np.vstack([[places[i] for i in self.truth], rng.uniform((0, -700), (700, 0), (false, 2))])
        self.xy += rng.normal(0, noise, self.xy.shape)
        self.branches = branches_of(np.vstack([rays, invented]))
        self.truth = np.r_[self.truth, np.full(false, -1)]

    @property
    def reference(self):
        return PointBuckets(self.ref_xy, self.ref_branches, self.starts, self.grid, self.shape)

    def seeds(self, anchor, k=8, placed=3):
        """(order, neighbours, partners, affine) around an anchor whose nearest neighbours are placed right."""
        away = np.hypot(*(self.xy - self.xy[anchor]).T)
        order = np.argsort(away, kind="stable")
        neighbours = np.full((len(self.xy), k), -1, np.int32)
        neighbours[anchor] = order[1 : k + 1]
        partners = self.truth[neighbours[anchor]].copy()
        partners[np.flatnonzero(partners >= 0)[placed:]] = -1
        return order, neighbours, partners, naive.jacobian(TRUTH, self.xy[anchor]).ravel()


@pytest.fixture(scope="module")
def world():
    return World()


class TestNearestAlike:
    @pytest.mark.parametrize("radius", [3.0, 80.0, 1e4])
    def test_like_the_twin(self, world, radius):
        rng = np.random.default_rng(3)
        for i, (x, y) in enumerate(rng.uniform(-100, 1600, (len(world.xy), 2))):
            J = rng.normal(0, 1, (2, 2))
            found = nearest_alike(x, y, radius, world.branches, i, *world.reference, tuple(J.ravel()), MIN_COS)
            near = {
                naive.nearest_alike(x, y, radius, world.branches, i, world.ref_xy, world.ref_branches, J, TOLERANCE + e)
                for e in (-0.02, 0.0, 0.02)
            }
            if len(near) == 1:
                assert found == pytest.approx(near.pop())

    @pytest.mark.parametrize("place", [(np.nan, 0.0), (1e300, 100.0), (-1e300, -1e300), (700.0, np.inf)])
    def test_places_that_are_none(self, world, place):
        found = nearest_alike(*place, 50.0, world.branches, 0, *world.reference, (1.0, 0.0, 0.0, 1.0), MIN_COS)
        assert found == (-1, 50.0)


class TestKeepNearest:
    @given(st.lists(st.tuples(st.integers(-1, 12), st.integers(0, 9)), max_size=60))
    def test_like_the_twin(self, claims):
        matched = np.array([partner for partner, _ in claims], np.int64)
        distance = np.array([float(d) for _, d in claims])
        expected = naive.keep_nearest(matched, distance)
        n = keep_nearest(matched, distance)
        assert np.array_equal(matched, expected)
        assert n == (expected >= 0).sum()

    def test_partners_with_large_numbers(self):
        matched = np.array([2**31 - 1, 2**40, 2**31 - 1, 2**40, -1])
        assert keep_nearest(matched, np.array([2.0, 1.0, 1.0, 1.0, 0.0])) == 2
        assert matched.tolist() == [-1, 2**40, 2**31 - 1, -1, -1]


class TestMatchAll:
    def test_like_the_twin(self, world):
        matched, distance = np.empty(len(world.xy), np.int64), np.empty(len(world.xy))
        n = match_all(TRUTH, world.xy, world.branches, 90.0, MIN_COS, world.reference, matched, distance)
        assert n == (matched >= 0).sum() > 0
        (strict, _), (expected, away), (lax, _) = (
            naive.match_all(TRUTH, world.xy, world.branches, 90.0, t, world.ref_xy, world.ref_branches)
            for t in (TOLERANCE - 0.02, TOLERANCE, TOLERANCE + 0.02)
        )
        clear = (strict == expected) & (lax == expected)  # branches are compared to a degree
        assert clear.mean() > 0.8
        assert np.array_equal(matched[clear], naive.keep_nearest(np.where(clear, expected, matched), distance)[clear])
        assert np.allclose(distance[clear], away[clear], atol=1e-3)

    def test_no_query(self, world):
        nothing = np.empty((0, 2)), np.empty((0, 8, 2), np.int8), 5.0, MIN_COS
        assert match_all(TRUTH, *nothing, world.reference, np.empty(0, np.int64), np.empty(0)) == 0


class TestGrow:
    NUMBERS = (2.0, 25.0)
    RATES = (0.4, 0.45, 0.08, 4.0)

    def run(self, world, anchor, ref_anchor, seeds, least=0):
        """Grow one proposal; it needs so many matches."""
        order, neighbours, partners, affine = seeds
        matched, matrices, ratios = np.empty((1, len(world.xy)), np.int64), np.empty((1, 3, 3)), np.empty(1)
        sigma_m, radius_m = self.NUMBERS
        limits = GrowthLimits((sigma_m, 0.0), (radius_m, 0.0), MIN_COS, *self.RATES)
        query = GrowthQuery(world.xy, world.branches, neighbours, order, 500.0, anchor)
        grow_each(
            query, np.array([ref_anchor]), affine[None], partners[None], world.reference, limits, least,
            matched, matrices, ratios,
        )  # fmt: skip
        return ratios[0], matched[0], matrices[0]

    @pytest.mark.parametrize(("seed", "most"), [(0, None), (1, None), (2, None), (3, None), (1, 40), (3, 25)])
    def test_like_the_twin(self, seed, most):
        world = World(seed, n=90, noise=1.0)
        rng = np.random.default_rng(seed)
        for anchor in rng.permutation(np.flatnonzero(world.truth >= 0))[:3]:
            for ref_anchor in (world.truth[anchor], rng.integers(90)):
                order, neighbours, partners, affine = world.seeds(anchor)
                order = order[:most]
                seeds = order, neighbours, partners, affine
                ratio, matched, matrix = self.run(world, anchor, ref_anchor, seeds)
                try:
                    expected = naive.grow(
                        world.xy, world.branches, order, 500.0, anchor, ref_anchor, affine, neighbours, partners,
                        world.ref_xy, world.ref_branches, *self.NUMBERS, TOLERANCE, *self.RATES,
                    )  # fmt: skip
                except naive.GivenUpError:
                    assert ratio == -np.inf
                    continue
                expected_ratio, hits, _, matches, model = expected
                assert ratio == pytest.approx(expected_ratio)
                for n, is_enough in ((hits, True), (hits + 1, False)):
                    assert (self.run(world, anchor, ref_anchor, seeds, n)[0] > -np.inf) == is_enough
                assert np.array_equal(matched, matches)
                assert np.allclose(matrix / matrix[2, 2], model / model[2, 2], rtol=1e-4, atol=1e-4)

    def test_seeds_on_a_line_or_too_few_do_not_crash(self, world):
        anchor = int(np.flatnonzero(world.truth >= 0)[0])
        order, neighbours, partners, affine = world.seeds(anchor)
        nothing = np.full_like(partners, -1)
        assert self.run(world, anchor, 0, (order, neighbours, nothing, affine))[0] == -np.inf
        alone = nothing.copy()
        alone[0] = 3
        assert self.run(world, anchor, 0, (order, neighbours, alone, affine))[0] == -np.inf

    def test_each_proposal_grows_as_it_does_alone(self, world):
        anchor = int(np.flatnonzero(world.truth >= 0)[0])
        order, neighbours, partners, affine = world.seeds(anchor)
        references = np.array([world.truth[anchor], 3])
        sigma_m, radius_m = self.NUMBERS
        limits = GrowthLimits((sigma_m, 0.0), (radius_m, 0.0), MIN_COS, *self.RATES)
        query = GrowthQuery(world.xy, world.branches, neighbours, order, 500.0, anchor)
        matched, matrices = np.empty((2, len(world.xy)), np.int64), np.empty((2, 3, 3))
        for least in (1, 10**6):
            ratios = np.empty(2)
            grow_each(
                query, references, np.stack([affine] * 2), np.stack([partners] * 2), world.reference, limits, least,
                matched, matrices, ratios,
            )  # fmt: skip
            for m, reference in enumerate(references):
                ratio, alone, matrix = self.run(world, anchor, reference, world.seeds(anchor), least)
                assert ratios[m] == ratio
                assert np.array_equal(matched[m], alone)
                assert ratio == -np.inf or np.array_equal(matrices[m], matrix)
            assert (least == 1) == np.isfinite(ratios).any()
