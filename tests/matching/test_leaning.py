"""What grew and no camera sees so: a steep view that fits around its seeds alone."""

from dataclasses import replace

import numpy as np
import pytest
from worlds.scenes import Sight, camera, look, mapped, scene_of

from roadgeo.geometry.camera import _USUAL_FOCAL, CameraFault, CameraOptions, judge
from roadgeo.geometry.homography import Homography
from roadgeo.matching.estimator import TripleEstimator
from roadgeo.matching.hypothesis import Hypothesis
from roadgeo.matching.leaning import lean_as_a_camera
from roadgeo.matching.verification import VerifyOptions

SIZE = (1000, 1000)
CAMERA, VERIFY = CameraOptions(), VerifyOptions()
FOCAL = _USUAL_FOCAL * np.hypot(*SIZE) / 2.0
TRUTH = camera((2000, 1900), SIZE, 1.0, 54.0, 50.0, 130.0, FOCAL)


@pytest.fixture(scope="module")
def scene(town):
    return scene_of(look(town[0], TRUTH, SIZE, Sight(0.5)))


def affine_around(matrix, at):
    """What a proposal knows: the map around one intersection."""
    linear, place = Homography(matrix).jacobian(at), mapped(matrix, at[None])[0]
    return np.block([[linear, (place - linear @ at)[:, None]], [np.zeros((1, 2)), np.ones((1, 1))]])


def hypothesis(scene, matrix, seed):
    return Hypothesis(matrix, np.array([seed]), 1.0, np.full(len(scene.intersections), -1))


def near_the_middle(scene):
    return int(np.argmin(np.hypot(*(scene.intersections.xy - scene.center).T)))


def test_a_proposal_tells_how_a_camera_leans(town, scene):
    """Of the two ways in which it may, the one that fits the map."""
    seed = near_the_middle(scene)
    model = hypothesis(scene, affine_around(TRUTH, scene.intersections.xy[seed]), seed)
    assert judge(model.matrix, SIZE, CAMERA) is CameraFault.SKEW
    assert lean_as_a_camera(model, scene, town[1], CAMERA, VERIFY)
    assert judge(model.matrix, SIZE, CAMERA) is None
    assert np.abs(mapped(model.matrix, scene.corners) - mapped(TRUTH, scene.corners)).max() < 1.0
    assert (model.matched >= 0).mean() > 0.7
    assert model.by_roads


def test_what_a_camera_can_see_stays_as_it_is(town, scene):
    model = hypothesis(scene, TRUTH, 0)
    assert lean_as_a_camera(model, scene, town[1], CAMERA, VERIFY)
    assert model.matrix is TRUTH
    assert not model.by_roads


def test_what_none_can_see_stays_as_it_is(town, scene):
    seed = near_the_middle(scene)
    skewed = affine_around(TRUTH, scene.intersections.xy[seed])
    model = hypothesis(scene, skewed, seed)
    assert not lean_as_a_camera(model, scene, town[1], replace(CAMERA, max_tilt_deg=30.0), VERIFY)
    assert model.matrix is skewed
    assert not model.by_roads


def test_where_no_camera_fits_nothing_is_verified(town, scene):
    """Seen by a camera as it may be, but not on this map's roads."""
    seed = near_the_middle(scene)
    away = np.array([[1, 0, 260.0], [0, 1, -140.0], [0, 0, 1]]) @ TRUTH
    model = hypothesis(scene, affine_around(away, scene.intersections.xy[seed]), seed)
    assert not lean_as_a_camera(model, scene, town[1], CAMERA, VERIFY)
    assert model.fault is CameraFault.SKEW


def test_the_search_refuses_it_for_its_skew(town, scene):
    seed = near_the_middle(scene)
    away = np.array([[1, 0, 260.0], [0, 1, -140.0], [0, 0, 1]]) @ TRUTH
    model = hypothesis(scene, affine_around(away, scene.intersections.xy[seed]), seed)
    estimator = TripleEstimator(scene, town[1])
    assert estimator.score(model) == -np.inf
    assert estimator.n_verified == 0


def test_the_search_verifies_what_leans(town, scene):
    seed = near_the_middle(scene)
    model = hypothesis(scene, affine_around(TRUTH, scene.intersections.xy[seed]), seed)
    assert TripleEstimator(scene, town[1]).score(model) > 20.0
    assert np.abs(mapped(model.refined.matrix, scene.corners) - mapped(TRUTH, scene.corners)).max() < 2.0
