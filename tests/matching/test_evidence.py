"""The likelihood of a place, on scenes with a known one."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from naive import kernels as naive
from worlds.lattices import beside, contest
from worlds.scenes import Sight, camera, look, random_network, scene_of, shaken

from roadgeo.geometry.homography import Homography
from roadgeo.matching import evidence
from roadgeo.matching.evidence import Evidence, log10_lead
from roadgeo.matching.index import build_index
from roadgeo.matching.shifts import Shift, move_about

SIZE = (900, 700)
TRUTH = camera((2000, 1900), SIZE, 1.0, 20.0, 50.0, 130.0)


def seen(town, matrix=TRUTH, size=SIZE, seed=0, **sight):
    return scene_of(look(town[0], matrix, size, Sight(**sight), seed), size)


def weigh(town, scene, matrix=TRUTH, gsd_m=1.0):
    return Evidence(scene, town[1], gsd_m).weigh(matrix)


def moved(matrix, scene, east=0.0, north=0.0, turn=0.0, scale=1.0):
    return move_about(Homography(matrix)(scene.center), Shift(east, north, turn, scale, 0.0)) @ matrix


@pytest.fixture(scope="module")
def scene(town):
    return seen(town, sigma_m=0.5)


class TestPeak:
    @pytest.mark.parametrize(
        "move",
        [
            {"east": 6.0},
            {"north": -6.0},
            {"east": 20.0, "north": 20.0},
            {"turn": 1.5},
            {"turn": -90.0},
            {"scale": 1.02},
        ],
    )
    def test_nothing_beside_explains_as_much(self, town, scene, move):
        assert weigh(town, scene) > weigh(town, scene, moved(TRUTH, scene, **move)) + 3.0

    def test_the_further_off_the_less_until_nothing_agrees(self, town, scene):
        values = [weigh(town, scene, moved(TRUTH, scene, east=away)) for away in (0.0, 3.0, 6.0, 12.0)]
        assert values == sorted(values, reverse=True)
        assert weigh(town, scene, moved(TRUTH, scene, east=410.0, north=-333.0)) < 0.0

    def test_small_errors_of_the_corners_cost_something_too(self, town, scene):
        rng = np.random.default_rng(3)
        off = [weigh(town, scene, shaken(TRUTH, scene, 4.0, rng)) for _ in range(8)]
        assert max(off) < weigh(town, scene)

    def test_a_homography_is_the_same_at_any_scale_of_its_numbers(self, town, scene):
        assert weigh(town, scene, 3.0 * TRUTH) == pytest.approx(weigh(town, scene))


class TestCost:
    def test_exact_fits_explain_more_than_rough_ones(self, town):
        values = [weigh(town, seen(town, sigma_m=sigma)) for sigma in (0.0, 1.0, 2.0, 4.0)]
        assert values == sorted(values, reverse=True)
        assert values[0] > 1.2 * values[2]

    @pytest.mark.parametrize("kind", ["missing", "false"])
    def test_roads_that_one_lacks_cost_something_and_not_everything(self, town, kind):
        values = [weigh(town, seen(town, sigma_m=0.5, **{kind: share})) for share in (0.0, 0.2, 0.4)]
        assert values == sorted(values, reverse=True)
        assert values[-1] > 0.3 * values[0] > 3.0

    def test_a_query_of_strange_roads_is_worth_no_more_than_none(self, town):
        strange = scene_of(look(random_network(9, 4000.0), TRUTH, SIZE), SIZE)
        assert weigh(town, strange) < 0.5

    def test_roads_that_nobody_could_see_cost_nothing(self, town, scene):
        east = scene.points[:, 0] > 450
        half = replace(scene, weights=scene.weights * east, field=np.where(np.arange(400) < 200, 99, scene.field))
        half = replace(half, field=np.ascontiguousarray(half.field, np.float32))
        blind = replace(half, observed=np.ascontiguousarray(scene.observed & (np.arange(400) >= 200)))
        assert weigh(town, blind) > weigh(town, half)

    def test_what_is_less_sure_counts_less(self, town, scene):
        doubted = replace(scene, weights=np.full_like(scene.weights, 0.3))
        assert 0.0 < weigh(town, doubted) < weigh(town, scene)

    def test_more_of_the_same_road_says_more(self, town, scene):
        small = seen(town, camera((2000, 1900), (450, 350), 1.0, 20.0, 50.0, 130.0), (450, 350), sigma_m=0.5)
        reported = weigh(town, small, camera((2000, 1900), (450, 350), 1.0, 20.0, 50.0, 130.0))
        assert 0.0 < reported < 0.5 * weigh(town, scene)

    def test_nothing_seen_and_nothing_mapped_say_nothing_for_a_place(self, town, scene):
        empty = scene_of(look(town[0], np.array([[1, 0, 1e6], [0, 1, 1e6], [0, 0, 1.0]]), SIZE), SIZE)
        assert weigh(town, empty) < 0.0  # all roads of the map are missing
        far = moved(TRUTH, scene, east=1e5)
        assert weigh(town, scene, far) < 0.0  # all roads of the query are false
        assert weigh(town, empty, moved(TRUTH, empty, east=1e5)) == pytest.approx(0.0, abs=1e-9)


class TestScale:
    def test_a_place_at_another_scale_is_compared_within_as_many_pixels(self, town, scene):
        """Within as many metres its roads would agree wherever it is laid small enough."""
        for scale in (0.1, 0.2, 0.5, 2.0):
            assert weigh(town, scene, moved(TRUTH, scene, scale=scale)) < 1.0

    @pytest.mark.parametrize("gsd_m", [0.5, 2.0, 4.0])
    def test_a_scene_in_other_pixels_is_worth_the_same(self, gsd_m):
        """One town, its roads and its frame stretched by the same factor, is as large in pixels."""
        wide = random_network(4, 2000.0 * gsd_m, 120.0 * gsd_m)
        truth = camera((1000.0 * gsd_m, 1000.0 * gsd_m), gsd_m=gsd_m)
        scene, index = scene_of(look(wide, truth)), build_index(wide)
        reported = Evidence(scene, index, gsd_m).weigh(truth)
        assert reported > 12.0
        assert Evidence(scene, index, gsd_m).nearby(truth) < 0.35 * reported


class TestShared:
    """Whether the same pieces of the query lie on the same roads of the map."""

    def test_a_version_of_a_place_is_the_place(self, town, scene):
        found, rng = Evidence(scene, town[1], 1.0), np.random.default_rng(3)
        assert found.shared(TRUTH, TRUTH) == 1.0
        assert min(found.shared(TRUTH, shaken(TRUTH, scene, 12.0, rng)) for _ in range(8)) > 0.7
        assert found.shared(TRUTH, moved(TRUTH, scene, turn=1.0)) > 0.7

    def test_another_place_is_not_however_near(self, town, scene):
        truth, _, lattice = contest(1.0)
        assert lattice.shared(truth, beside(truth, lattice)) < 0.3
        assert Evidence(scene, town[1], 1.0).shared(TRUTH, moved(TRUTH, scene, east=90.0, north=90.0)) < 0.3
        assert Evidence(scene, town[1], 1.0).shared(TRUTH, moved(TRUTH, scene, east=1e6)) == 0.0


def mixed(own, other, is_there):
    """A scene with the roads of another where `is_there` says so of x and y, pixels."""
    chosen = [~is_there(*own.points.T), is_there(*other.points.T)]
    roads = {
        name: np.concatenate([getattr(own, name)[chosen[0]], getattr(other, name)[chosen[1]]])
        for name in ("points", "directions", "weights")
    }
    rows, columns = ((np.arange(n) + 0.5) * own.field_scale for n in own.field.shape)
    return replace(own, field=np.where(is_there(columns, -rows[:, None]), other.field, own.field), **roads)


class TestContradicted:
    @pytest.mark.parametrize(("row", "is_counted"), [(0, False), (1, True), (3, True), (5, True)])
    def test_far_ground_of_an_oblique_view_does_not_count(self, town, row, is_counted):
        """One of six rows of regions shows other roads; pixels of the first two are 2.1 and 1.5 times as coarse."""
        size = (1000, 1000)
        truth = camera((2000, 1900), size, 1.0, 40.0, focal_px=900.0)
        own, other = (scene_of(look(network, truth, size), size) for network in (town[0], random_network(2, 4000.0)))
        scene = mixed(own, other, lambda x, y: (x > 0.0) & ((-y / size[1] * 6.0).astype(int) == row))
        contradicted = Evidence(scene, town[1], 1.0).contradicted(truth)
        assert contradicted > 0.05 if is_counted else contradicted == 0.0

    @pytest.mark.parametrize(("side", "n"), [(2000, 6), (510, 3)])
    def test_regions_are_a_sixth_of_the_frame_and_170_m_wide_at_least(self, town, side, n):
        """One of them shows other roads. Half a region is usual, which is less where regions are smaller."""
        size, width = (side, side), side / n
        truth, found = camera((2000, 1900), size), []
        own, other = (scene_of(look(network, truth, size), size) for network in (town[0], random_network(2, 4000.0)))
        for column, row in itertools.product(range(n - 3, n) if n > 3 else range(n), repeat=2):
            scene = mixed(
                own,
                other,
                lambda x, y, column=column, row=row: ((x // width) == column) & ((-y // width) == row),
            )
            found.append(Evidence(scene, town[1], 1.0).contradicted(truth) * n**2)
        assert 0.32 < np.median(found) < 0.52


class TestNearby:
    def test_it_is_far_below_the_place_where_streets_do_not_repeat(self, town, scene):
        found = Evidence(scene, town[1], 1.0)
        assert found.nearby(TRUTH) < 0.35 * found.weigh(TRUTH)

    def test_it_is_as_good_as_the_place_where_all_blocks_are_equal(self):
        truth, _, found = contest(1.0)
        assert found.nearby(truth) == pytest.approx(found.weigh(truth), abs=1.0)

    @pytest.mark.parametrize("gsd_m", [0.3, 1.0, 3.0, 12.0])
    def test_it_is_never_the_place_itself(self, town, scene, gsd_m):
        """However rough the yardstick: shifts by less than what roads may be off, and agree, are the place itself."""
        found = Evidence(scene, town[1], gsd_m)
        reach_m = 2.0 * math.hypot(1.8, gsd_m) / gsd_m
        shifts = np.concatenate((found._spiral(reach_m, 150), found._onto_neighbours(TRUTH, reach_m, None, 3)))
        assert np.hypot(*shifts.T).min() >= max(30.0, 4.5 * reach_m)
        assert found.nearby(TRUTH) < found.weigh(TRUTH)

    def test_a_shift_of_the_spiral_leads_back(self, town, scene):
        """From a place beside, the true one is what is found, where a shift lays an intersection on its neighbour."""
        xy = town[1].xy
        middle = Homography(TRUTH)(scene.center)
        a, *others = xy[np.argsort(np.hypot(*(xy - middle).T))[:20]]
        step = next(a - b for b in others if 60.0 < np.hypot(*(a - b)) < 300.0)
        wrong = moved(TRUTH, scene, *step)
        found = Evidence(scene, town[1], 1.0)
        assert found.nearby(wrong, n_anchors=20) > 0.7 * found.weigh(TRUTH) > 3.0 * found.weigh(wrong)

    def test_the_three_intersections_nearest_to_the_middle_lead_to_their_neighbours(self, town, scene):
        """The frame is shifted by the step from an intersection to another, which then lies near its middle."""
        xy, found, middle = town[1].xy, Evidence(scene, town[1], 1.0), Homography(TRUTH)(scene.center)
        leads_back = {}
        for a in xy[np.argsort(np.hypot(*(xy - middle).T))[:5]]:
            steps = xy[np.argsort(np.hypot(*(xy - a).T))[3:12]] - a
            for step in steps:
                nearer = int((np.hypot(*(xy - middle - step).T) < np.hypot(*(a - middle))).sum())
                leads_back[nearer] = found.nearby(moved(TRUTH, scene, *step)) > 0.9 * found.weigh(TRUTH)
        assert [leads_back[nearer] for nearer in range(5)] == [True, True, True, False, False]

    def test_intersections_lead_no_further_than_the_user_allows(self, town, scene):
        found, middle = Evidence(scene, town[1], 1.0), Homography(TRUTH)(scene.center)
        shifts = found._onto_neighbours(TRUTH, 4.0, (*middle, 150.0), 3)
        assert 0 < len(shifts) < len(found._onto_neighbours(TRUTH, 4.0, None, 3))
        assert np.hypot(*shifts.T).max() <= 150.0

    def test_off_the_map_there_is_nothing(self, town, scene):
        assert Evidence(scene, town[1], 1.0).nearby(moved(TRUTH, scene, east=1e6)) < 0.0

    def test_twice_the_same(self, town, scene):
        first, other = Evidence(scene, town[1], 1.0), Evidence(scene, town[1], 1.0)
        assert first.nearby(TRUTH) == other.nearby(TRUTH) == first.nearby(TRUTH)


class TestArithmetic:
    """Against a slow twin that sums over pieces of road, as the formula says."""

    def test_like_the_twin(self, town):
        small = (260, 200)
        truth = camera((2000, 1900), small, 1.3, 10.0, 50.0, 130.0)
        scene = seen(town, truth, small, sigma_m=1.0, missing=0.2, false=0.2)
        gsd = 1.3
        found = Evidence(scene, town[1], gsd)
        local = np.hypot(*(town[1].segments[:, :2] - (2000, 1900)).T) < 600.0
        assert found.weigh(truth) == pytest.approx(self.twin(truth, scene, town[1], local, gsd), abs=0.02)

    @staticmethod
    def twin(matrix, scene, index, local, gsd):
        sigma_m = math.hypot(evidence.MAP_SIGMA_M, evidence.PIXEL_SIGMA_PX * gsd)
        width, height = scene.size
        scale = math.sqrt(abs(np.linalg.det(naive.jacobian(matrix, np.array([width / 2, -height / 2])))))
        radius, blur = 4.0 * sigma_m * scale / gsd, 0.35 * scene.field_scale * gsd / sigma_m
        segments = index.segments.copy()
        segments[~local] = 1e7  # numbered as they are, but out of sight: the twin is slow
        counted = naive.count_residuals(
            matrix, scene.points, scene.directions, scene.weights, radius, evidence.MIN_COS, evidence.STEP_M, segments,
            lambda x, y: True, scene.field, scene.field_scale, scene.observed, 24,
        )  # fmt: skip
        metres = counted[0] * scene.road_length_px / len(scene.points) * gsd, counted[1] * gsd
        # so many roads per pixel, so wide to either side, are near anyhow
        near = 2.0 * 4.0 * sigma_m / gsd / (scene.observed.sum() * scene.field_scale**2)
        expected = 0.42 * near * counted[1].sum(), near * scene.road_length_px
        anyhow = [math.exp(round(math.log(1.0 - math.exp(-n)), 1)) for n in expected]
        likelihoods = []
        for sigma in evidence._SIGMAS:
            for false in evidence.SHARES:
                for missing in evidence.SHARES:
                    nats = 0.0
                    for k in range(25):
                        for length, s, share, density in (
                            (metres[0][k], sigma, false, anyhow[0]),
                            (metres[1][k], math.hypot(sigma, round(blur, 1)), missing, anyhow[1]),
                        ):
                            r = (k + 0.5) * 4.0 / 24
                            g = math.sqrt(2 / math.pi) / s * math.exp(-0.5 * (r / s) ** 2) if k < 24 else 0.0
                            b = density / 4.0  # evenly, up to the reach
                            nats += length / evidence.STATEMENT_M * math.log((1 - share) * g / b + share)
                    likelihoods.append(nats)
        most = max(likelihoods)
        return (most + math.log(np.mean(np.exp(np.array(likelihoods) - most)))) / math.log(10.0)

    @given(st.floats(0.0, 3.0), st.floats(-3.2, 0.0))
    def test_ratios_fall_with_the_residual_and_none_is_worse_than_false(self, blur, anyhow):
        for ratios in evidence._log_ratios(anyhow, blur):
            assert (np.diff(ratios, axis=1) <= 1e-12).all()
            assert ratios[:, -1] == pytest.approx(np.log(evidence.SHARES))


# --- leads, piece by piece --------------------------------------------------------------------------------------------


def test_alike_places_lead_by_nothing():
    assert log10_lead(np.zeros(9)) == 0.0
    assert log10_lead(np.array([1.0, -1.0, 0.0])) == 0.0


@given(
    st.lists(st.floats(0.1, 1.0), min_size=1, max_size=10).flatmap(
        lambda sizes: st.tuples(
            st.just(sizes), st.lists(st.sampled_from([-1, 1]), min_size=len(sizes), max_size=len(sizes))
        )
    )
)
def test_a_lead_is_never_surer_than_all_ways_to_draw_the_signs_tell(drawn):
    sizes, signs = map(np.array, drawn)
    all_signs = np.array(list(itertools.product((-1, 1), repeat=len(sizes))))
    ranks = np.sum(sizes[:, None] > sizes, 1) + (np.sum(sizes[:, None] == sizes, 1) + 1) / 2  # ties share theirs
    as_much = np.mean(all_signs @ ranks >= (signs @ ranks) - 1e-9)
    assert 10.0 ** -log10_lead(signs * sizes) >= as_much - 1e-12


def test_one_piece_outweighs_no_others():
    reported = np.append(np.linspace(1.0, 2.0, 30), -100.0)
    assert log10_lead(reported) > log10_lead(reported[:-1]) - 1.5 > 4.0


def test_a_long_lead_is_counted_without_end():
    assert 1000.0 < log10_lead(np.ones(10_000)) < 10_000 * math.log10(2.0)
