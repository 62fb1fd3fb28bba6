"""A lens behind a fit: k1 and the homography are found together, and only where there is a lens."""

from dataclasses import replace

import numpy as np
import pytest
from worlds.scenes import Sight, mapped, shaken, sight_of

from roadgeo.geometry.lens import Lens
from roadgeo.matching.lens import LensOptions, find_lens, fit_lens, straighten_scene
from roadgeo.matching.refinement import RefineOptions


def through_lens(scene, k1):
    """The scene as a lens shows it."""
    lens = Lens.of(k1, scene.size, y_up=True)
    ahead = lens.bend(scene.points + 0.5 * scene.directions) - lens.bend(scene.points - 0.5 * scene.directions)
    directions = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
    found = replace(scene.intersections, xy=lens.bend(scene.intersections.xy))
    return replace(scene, points=lens.bend(scene.points), directions=directions, intersections=found)


@pytest.mark.parametrize("k1", [-0.12, -0.03, 0.06])
def test_homography_and_lens_are_found_together_and_corners_are_as_sure_as_claimed(town, k1):
    truth, straight = sight_of(town[0], 5, tilt=15, sight=Sight(0.6))
    scene = through_lens(straight, k1)
    start = shaken(truth, straight, 4.0, np.random.default_rng(1))
    found = fit_lens(start, scene, town[1])
    assert found.k1 == pytest.approx(k1, abs=5 * found.k1_sigma + 1e-4)
    assert found.k1_sigma < 0.001
    gaps = np.hypot(*(mapped(found.matrix, scene.corners) - mapped(truth, scene.corners)).T)
    assert np.sqrt(np.mean(gaps**2)) < 1.5
    assert (found.refined.corner_sigma_m < 2.0).all()
    assert straighten_scene(scene, found.k1).points == pytest.approx(straight.points, abs=1.0)


@pytest.mark.parametrize(("k1", "pays"), [(0.0, False), (0.002, False), (-0.1, True)])
def test_a_lens_is_taken_only_where_it_pays(town, k1, pays):
    truth, straight = sight_of(town[0], 7, tilt=10, sight=Sight(0.6))
    scene = through_lens(straight, k1)
    found = find_lens(truth, scene, town[1], 0.9 if k1 == 0.0 else 0.5, RefineOptions(), LensOptions(least_px=5.0))
    assert (found is not None) == pays


def test_roads_that_lie_nowhere_near_the_map_have_no_lens(town):
    truth, scene = sight_of(town[0], 8)
    assert fit_lens(truth + np.array([[0, 0, 90_000.0], [0, 0, 0], [0, 0, 0]]), scene, town[1]) is None
