"""How much agrees at a place, on scenes with a known one."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from worlds.scenes import Sight, camera, look, mapped, scene_of

from roadgeo.geometry.camera import sampling
from roadgeo.matching.evidence import MAP_SIGMA_M, PIXEL_SIGMA_PX, Evidence, agreement, tolerance_m

TRUTH = camera((2000, 1900), (1000, 1000), 1.0, 20.0, 50.0, 130.0)
ELSEWHERE = np.array([[1, 0, 333.0], [0, 1, -271.0], [0, 0, 1]]) @ TRUTH


@pytest.fixture(scope="module")
def scene(town):
    """A sharp view of the town."""
    return scene_of(look(town[0], TRUTH, sight=Sight(0.5)))


class TestAgreement:
    def test_everything_agrees_in_the_true_place(self, town, scene):
        found, matched, distance = agreement(TRUTH, scene, town[1])
        assert found.rate > 0.8  # at the frame's border branches are cut off
        assert found.tested == len(scene.intersections)
        assert found.matched == (matched >= 0).sum()
        assert min(found.forward, found.backward) > 0.97
        assert (distance[matched >= 0] < 1.5 * tolerance_m(1.0)).all()
        gaps = mapped(TRUTH, scene.intersections.xy)[matched >= 0] - town[1].xy[matched[matched >= 0]]
        assert distance[matched >= 0] == pytest.approx(np.hypot(*gaps.T))

    def test_little_agrees_elsewhere(self, town, scene):
        found, *_ = agreement(ELSEWHERE, scene, town[1])
        assert max(found.rate, found.forward, found.backward) < 0.4

    def test_off_the_map_nothing_does(self, town, scene):
        far = np.array([[1, 0, 1e5], [0, 1, 0], [0, 0, 1]]) @ TRUTH
        found, matched, _ = agreement(far, scene, town[1])
        assert (found.rate, found.forward, found.backward) == (0, 0, 0)
        assert (matched == -1).all()

    def test_its_likelihood_is_that_of_the_evidence(self, town, scene):
        for matrix in (TRUTH, ELSEWHERE):
            evidence = Evidence(scene, town[1], sampling(matrix, scene.size))
            assert agreement(matrix, scene, town[1])[0].log10_likelihood == evidence.weigh(matrix)

    def test_roads_that_the_query_misses_count_against_it(self, town):
        gaps = scene_of(look(town[0], TRUTH, sight=Sight(missing=0.4)))
        found, *_ = agreement(TRUTH, gaps, town[1])
        assert found.forward > 0.95
        assert found.backward < 0.8

    def test_unobserved_ground_counts_for_nothing(self, town):
        gaps = scene_of(look(town[0], TRUTH, sight=Sight(missing=0.4)))
        blind = replace(gaps, observed=gaps.field < 6)
        found, *_ = agreement(TRUTH, blind, town[1])
        assert found.backward > 0.9

    def test_a_scene_of_nothing(self, town, scene):
        empty = scene_of(look(town[0], np.array([[1, 0, 1e6], [0, 1, 1e6], [0, 0, 1.0]])))
        found, *_ = agreement(TRUTH, empty, town[1])
        assert (found.rate, found.forward) == (0, 0)


@given(st.floats(0.1, 10))
def test_tolerance_grows_with_the_sampling(gsd):
    assert tolerance_m(gsd) > 3 * max(MAP_SIGMA_M, PIXEL_SIGMA_PX * gsd)
