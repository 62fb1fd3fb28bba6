"""The last fit of a place: no part of the frame stays beside where it belongs."""

import cv2
import numpy as np
import pytest
from worlds.scenes import Sight, mapped, sight_of

from roadgeo.matching.finishing import refine_beside
from roadgeo.matching.refinement import Refined, RefineOptions


def moved(truth, scene, corner, step):
    """A homography that puts one corner elsewhere, metres, and the others where the truth does."""
    places = mapped(truth, scene.corners)
    middle = places.mean(axis=0)
    places[corner] += step
    back = np.array([[1.0, 0.0, middle[0]], [0.0, 1.0, middle[1]], [0.0, 0.0, 1.0]])
    return back @ cv2.getPerspectiveTransform(scene.corners.astype(np.float32), (places - middle).astype(np.float32))


def gaps(matrix, truth, scene):
    return np.hypot(*(mapped(matrix, scene.corners) - mapped(truth, scene.corners)).T)


@pytest.mark.parametrize("corner", range(4))
def test_a_corner_beside_where_it_belongs_comes_back(town, corner):
    truth, scene = sight_of(town[0], 5, tilt=15, sight=Sight(0.6))
    beside = Refined(moved(truth, scene, corner, (14.0, -9.0)), np.ones(4), 1.0, np.eye(8))
    found = refine_beside(beside, scene, town[1], RefineOptions())
    assert gaps(beside.matrix, truth, scene).max() > 15.0
    assert gaps(found.matrix, truth, scene).max() < 1.5


def test_where_all_belongs_nothing_better_is_found(town):
    truth, scene = sight_of(town[0], 5, tilt=15, sight=Sight(0.6))
    assert refine_beside(Refined(truth, np.ones(4), 1.0, np.eye(8)), scene, town[1], RefineOptions()) is None


def test_far_from_all_roads_nothing_is_found(town):
    truth, scene = sight_of(town[0], 5)
    nowhere = truth + np.array([[0, 0, 90_000.0], [0, 0, 0], [0, 0, 0]])
    assert refine_beside(Refined(nowhere, np.ones(4), 1.0, np.eye(8)), scene, town[1], RefineOptions()) is None
