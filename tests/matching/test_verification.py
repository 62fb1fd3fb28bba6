"""Evidence for a place, against chance on the same map."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from worlds.scenes import PLANE, Sight, camera, look, mapped, random_network, scene_of

from roadgeo.matching.index import build_index
from roadgeo.matching.verification import (
    Agreement,
    VerifyOptions,
    agreement,
    chance_agreement,
    log10_odds,
    tolerance_m,
)
from roadgeo.reference.reference import build_network

OPTIONS = VerifyOptions()
NO_SEEDS = np.array([], int)
TRUTH = camera((2000, 1900), (1000, 1000), 1.0, 20.0, 50.0, 130.0)
ELSEWHERE = np.array([[1, 0, 333.0], [0, 1, -271.0], [0, 0, 1]]) @ TRUTH


@pytest.fixture(scope="module")
def scene(town):
    """A sharp view of the town."""
    return scene_of(look(town[0], TRUTH, sight=Sight(0.5)))


def agree(matrix, scene, index, seeds=NO_SEEDS):
    return agreement(matrix, scene, index, 1.0, seeds, OPTIONS)


class TestAgreement:
    def test_everything_agrees_in_the_true_place(self, town, scene):
        found, matched, distance = agree(TRUTH, scene, town[1])
        assert found.rate > 0.8  # at the frame's border branches are cut off
        assert found.tested == len(scene.intersections)
        assert found.matched == (matched >= 0).sum()
        assert min(found.forward, found.backward) > 0.97
        assert found.n_seen > 300
        assert (distance[matched >= 0] < 1.5 * tolerance_m(1.0, OPTIONS)).all()
        gaps = mapped(TRUTH, scene.intersections.xy)[matched >= 0] - town[1].xy[matched[matched >= 0]]
        assert distance[matched >= 0] == pytest.approx(np.hypot(*gaps.T))

    def test_little_agrees_elsewhere(self, town, scene):
        found, *_ = agree(ELSEWHERE, scene, town[1])
        assert max(found.rate, found.forward, found.backward) < 0.4

    def test_off_the_map_nothing_does(self, town, scene):
        far = np.array([[1, 0, 1e5], [0, 1, 0], [0, 0, 1]]) @ TRUTH
        found, matched, _ = agree(far, scene, town[1])
        assert (found.rate, found.forward, found.backward, found.n_seen) == (0, 0, 0, 0)
        assert (matched == -1).all()

    def test_seeds_are_matched_but_not_counted(self, town, scene):
        seeds = np.array([3, 5, 8])
        every, matched, _ = agree(TRUTH, scene, town[1])
        fewer, again, _ = agree(TRUTH, scene, town[1], seeds)
        assert np.array_equal(matched, again)
        assert fewer.tested == every.tested - 3
        assert fewer.matched == every.matched - (matched[seeds] >= 0).sum()

    def test_roads_that_the_query_misses_count_against_it(self, town):
        gaps = scene_of(look(town[0], TRUTH, sight=Sight(missing=0.4)))
        found, *_ = agree(TRUTH, gaps, town[1])
        assert found.forward > 0.95
        assert found.backward < 0.8

    def test_unobserved_ground_counts_for_nothing(self, town):
        gaps = scene_of(look(town[0], TRUTH, sight=Sight(missing=0.4)))
        blind = replace(gaps, observed=gaps.field < 6)
        found, *_ = agree(TRUTH, blind, town[1])
        assert found.backward > 0.9
        assert found.n_seen < agree(TRUTH, gaps, town[1])[0].n_seen

    def test_a_scene_of_nothing(self, town, scene):
        empty = scene_of(look(town[0], np.array([[1, 0, 1e6], [0, 1, 1e6], [0, 0, 1.0]])))
        found, *_ = agree(TRUTH, empty, town[1])
        assert (found.rate, found.forward) == (0, 0)


class TestChance:
    def test_chance_is_far_below_the_truth(self, town, scene):
        chance = chance_agreement(TRUTH, scene, town[1], 1.0, OPTIONS)
        assert all(0 < rate < 0.6 for rate in chance)

    def test_chance_is_high_where_blocks_repeat(self):
        streets = [shapely.LineString([(100 * k, -50), (100 * k, 2050)]) for k in range(21)]
        streets += [shapely.LineString([(-50, 100 * k), (2050, 100 * k)]) for k in range(21)]
        network = build_network(streets, PLANE, {})
        index = build_index(network)
        truth = camera((1000, 1000), (700, 700))
        lattice = scene_of(look(network, truth, (700, 700)), (700, 700))
        chance = chance_agreement(truth, lattice, index, 1.0, OPTIONS)
        assert min(chance) > 0.8
        found, *_ = agree(truth, lattice, index)
        assert found.forward > 0.97
        assert log10_odds(found, chance, lattice.n_statements, 100, OPTIONS) < 4

    @pytest.mark.parametrize("gsd_m", [1.0, 3.0, 6.0, 12.0])
    def test_chance_is_as_low_where_pixels_are_large(self, gsd_m):
        """Roads agree within 3 pixels: shifts by less are the place itself, and chance would be as good as it."""
        wide = random_network(4, 2000.0 * gsd_m, 120.0 * gsd_m)
        truth = camera((1000.0 * gsd_m, 1000.0 * gsd_m), gsd_m=gsd_m)
        chance = chance_agreement(truth, scene_of(look(wide, truth)), build_index(wide), gsd_m, OPTIONS)
        assert max(chance) < 0.6

    def test_the_same_place_has_the_same_chance(self, town, scene):
        assert chance_agreement(TRUTH, scene, town[1], 1.0, OPTIONS) == chance_agreement(
            3.0 * TRUTH, scene, town[1], 1.0, OPTIONS
        )


rates = st.floats(0, 1)
trials = st.integers(1, 300)


class TestOdds:
    def odds(self, rate, forward, backward, n=40, chance=(0.1, 0.3, 0.3), n_roads=80.0, n_candidates=1):
        return log10_odds(Agreement(rate * n, n, forward, backward, 100), chance, n_roads, n_candidates, OPTIONS)

    @given(rates, rates, rates, trials, st.integers(1, 10**6))
    def test_every_candidate_tried_costs_its_share(self, rate, forward, backward, n, n_candidates):
        one = self.odds(rate, forward, backward, n)
        assert self.odds(rate, forward, backward, n, n_candidates=n_candidates) == pytest.approx(
            one - np.log10(n_candidates)
        )

    @pytest.mark.slow
    @given(rates, rates, rates, trials, st.floats(0.01, 0.3))
    def test_more_agreement_is_better(self, rate, forward, backward, n, more):
        better = (min(value + more, 1.0) for value in (rate, forward, backward))
        assert self.odds(*better, n) >= self.odds(rate, forward, backward, n) - 1e-9

    @given(rates, rates, rates, trials, st.floats(0.01, 0.3))
    def test_more_chance_is_worse(self, rate, forward, backward, n, more):
        usual, higher = (0.1, 0.3, 0.3), (0.1 + more, 0.3 + more, 0.3 + more)
        assert self.odds(rate, forward, backward, n, higher) <= self.odds(rate, forward, backward, n, usual) + 1e-9

    def test_a_piece_that_fits_is_no_place(self):
        # A mirrored mask of Montevideo, at the best wrong place: much more than chance, and much too little.
        assert self.odds(39 / 184, 0.30, 0.30, 184, (0.05, 0.15, 0.27), 347.0, 269) < 1
        assert self.odds(0.25, 0.55, 0.60, 184, (0.05, 0.15, 0.27), 347.0, 269) > 10

    def test_a_few_roads_of_the_map_are_no_proof(self):
        """A frame of 180 m, laid on a corner of the map, agrees with a mask of a whole region as far as it goes."""
        found = Agreement(0, 37, 0.32, 0.91, 102)
        assert log10_odds(found, (0.0, 0.12, 0.40), 108.0, 1, OPTIONS) < 3.5
        assert log10_odds(replace(found, n_seen=900), (0.0, 0.12, 0.40), 108.0, 1, OPTIONS) > 7

    def test_chance_itself_is_no_evidence(self):
        assert self.odds(0.3, 0.6, 0.6, chance=(0.3, 0.6, 0.6)) == pytest.approx(0, abs=1e-9)
        assert self.odds(0.1, 0.3, 0.3) < 0
        assert self.odds(1.0, 1.0, 1.0, 2500, (1.0, 1.0, 0.99), 5000.0) == pytest.approx(0, abs=1e-9)
        assert self.odds(0.05, 0.2, 0.2) < 0

    @pytest.mark.parametrize("chance", [(0, 0, 0), (1, 1, 1)])
    @pytest.mark.parametrize("rate", [0.0, 1.0])
    def test_rates_of_none_and_all_are_finite(self, chance, rate):
        assert np.isfinite(self.odds(rate, rate, rate, chance=chance))

    def test_nothing_to_test_is_no_evidence(self):
        nothing = Agreement(0, 0, 0.0, 0.0, 0)
        assert log10_odds(nothing, (0.1, 0.3, 0.3), 0.0, 0, OPTIONS) == pytest.approx(0)


@given(st.floats(0.1, 10))
def test_tolerance_grows_with_the_sampling(gsd):
    assert tolerance_m(gsd, OPTIONS) > 3 * max(OPTIONS.map_sigma_m, OPTIONS.pixel_sigma_px * gsd)
