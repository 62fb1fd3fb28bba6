"""Doubt which of two roads was met."""

import numpy as np
import pytest
from matching.test_merged_roads import motorways
from worlds.scenes import camera, look, mapped, scene_of

from roadgeo.matching.accuracy import with_honest_corners
from roadgeo.matching.index import IndexOptions, build_index
from roadgeo.matching.lens import LensOptions
from roadgeo.matching.lens_equations import LensEquations
from roadgeo.matching.other_roads import covariance_of_doubt
from roadgeo.matching.refinement import RefineOptions, refine
from roadgeo.matching.verification import VerifyOptions

SIDE, APART = 1000, 14.0
TRUTH = camera((2000, 1900), heading_deg=30)


def twice(at):
    """Whether a road lies where the map has two for each: in the frame's right half."""
    return bool(mapped(np.linalg.inv(TRUTH), np.atleast_2d(at))[0, 0] > 0.5 * SIDE)


def index_of(network):
    return build_index(network, IndexOptions(simplify_m=0.01))


@pytest.fixture(scope="module")
def carriageways(town):
    """The map of the town that has two roads for each in the right half, and what shows one of them, and both."""
    one, both = (scene_of(look(motorways(town[0], twice, APART, sides), TRUTH)) for sides in ((1,), (1, -1)))
    return index_of(motorways(town[0], twice, APART)), one, both


def fit(scene, index):
    return refine(TRUTH, scene, index, np.full(len(scene.intersections), -1))


def doubt(scene, index):
    """What the parameters' covariance gains, and all that it is computed from."""
    equations = LensEquations(fit(scene, index).matrix, scene, index, RefineOptions())
    seen = equations.observe(0.0, np.zeros((9, 9)))
    rows, used = seen.rows[:, :8], np.ones(len(seen.rows), bool)
    weights = equations.weight * seen.cauchy / seen.own**2
    inverse = np.linalg.pinv((weights[:, None] * rows).T @ rows + np.diag(equations.prior(0.3)[:8]), hermitian=True)
    return covariance_of_doubt(equations, 0.0, seen, used, inverse, rows, weights)


def claimed(scene, index):
    """Standard deviations of the left corners, and of the right ones."""
    one = with_honest_corners(
        fit(scene, index), scene, index, 1.0, RefineOptions(), LensOptions(), VerifyOptions()
    ).corner_sigma_m
    return one[[0, 3]].mean(), one[[1, 2]].mean()


def test_corners_by_one_of_two_roads_are_less_sure(town, carriageways):
    index, one, _ = carriageways
    sure = claimed(scene_of(look(town[0], TRUTH)), town[1])
    left, right = claimed(one, index)
    assert right > 2.0 * sure[1]
    assert left < right


def test_what_is_gained_is_a_covariance(carriageways):
    index, one, _ = carriageways
    gained = doubt(one, index)
    assert gained.max() > 0.0
    assert np.array_equal(gained, gained.T)
    assert np.linalg.eigvalsh(gained).min() > -1e-9 * gained.max()


def test_there_is_no_doubt_where_the_mask_shows_both(carriageways):
    index, one, both = carriageways
    assert np.trace(doubt(both, index)) < 0.02 * np.trace(doubt(one, index))


def test_there_is_none_where_the_map_has_one(town, carriageways):
    index, one, _ = carriageways
    seen = scene_of(look(town[0], TRUTH))
    assert np.trace(doubt(seen, town[1])) < 0.02 * np.trace(doubt(one, index))


def test_no_roads_no_doubt(carriageways):
    index, one, _ = carriageways
    equations = LensEquations(TRUTH, one.of_points(slice(0)), index, RefineOptions())
    seen = equations.observe(0.0, np.zeros((9, 9)))
    nothing = np.zeros(0, bool)
    assert not covariance_of_doubt(equations, 0.0, seen, nothing, np.eye(8), np.zeros((0, 8)), np.zeros(0)).any()
