"""How much agrees at a place, on scenes with a known one."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from worlds.scenes import Sight, camera, look, mapped, scene_of

from roadgeo.matching.evidence import MAP_SIGMA_M, PIXEL_SIGMA_PX, tolerance_m
from roadgeo.matching.place import Place

TRUTH = camera((2000, 1900), (1000, 1000), 1.0, 20.0, 50.0, 130.0)
ELSEWHERE = np.array([[1, 0, 333.0], [0, 1, -271.0], [0, 0, 1]]) @ TRUTH


@pytest.fixture(scope="module")
def scene(town):
    """A sharp view of the town."""
    return scene_of(look(town[0], TRUTH, sight=Sight(0.5)))


class TestAgreement:
    def test_everything_agrees_in_the_true_place(self, town, scene):
        place = Place(scene, town[1], TRUTH)
        matched, distance = place.matches
        assert place.rate > 0.8  # at the frame's border branches are cut off
        assert place.rate == (matched >= 0).mean()
        assert min(place.agreement.forward, place.agreement.backward) > 0.97
        assert place.agreeing > 0.9
        assert (distance[matched >= 0] < 1.5 * tolerance_m(1.0)).all()
        gaps = mapped(TRUTH, scene.intersections.xy)[matched >= 0] - town[1].xy[matched[matched >= 0]]
        assert distance[matched >= 0] == pytest.approx(np.hypot(*gaps.T))
        assert place.on_roads.mean() > 0.97

    def test_little_agrees_elsewhere(self, town, scene):
        place = Place(scene, town[1], ELSEWHERE)
        assert max(place.rate, place.agreement.forward, place.agreement.backward) < 0.4

    def test_off_the_map_nothing_does(self, town, scene):
        place = Place(scene, town[1], np.array([[1, 0, 1e5], [0, 1, 0], [0, 0, 1]]) @ TRUTH)
        assert (place.rate, place.agreement.forward, place.agreement.backward) == (0, 0, 0)
        assert (place.matched == -1).all()

    def test_its_likelihood_is_that_of_the_evidence(self, town, scene):
        for matrix in (TRUTH, ELSEWHERE):
            place = Place(scene, town[1], matrix)
            assert place.log10_likelihood == place.evidence.weigh(matrix)

    def test_roads_that_the_query_misses_count_against_it(self, town):
        gaps = scene_of(look(town[0], TRUTH, sight=Sight(missing=0.4)))
        found = Place(gaps, town[1], TRUTH).agreement
        assert found.forward > 0.95
        assert found.backward < 0.8

    def test_unobserved_ground_counts_for_nothing(self, town):
        gaps = scene_of(look(town[0], TRUTH, sight=Sight(missing=0.4)))
        blind = replace(gaps, observed=gaps.field < 6)
        assert Place(blind, town[1], TRUTH).agreement.backward > 0.9

    def test_a_scene_of_nothing(self, town):
        empty = scene_of(look(town[0], np.array([[1, 0, 1e6], [0, 1, 1e6], [0, 0, 1.0]])))
        place = Place(empty, town[1], TRUTH)
        assert (place.rate, place.agreement.forward) == (0, 0)


@given(st.floats(0.1, 10))
def test_tolerance_grows_with_the_sampling(gsd):
    assert tolerance_m(gsd) > 3 * max(MAP_SIGMA_M, PIXEL_SIGMA_PX * gsd)
