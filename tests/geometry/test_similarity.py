"""A homography that roads cannot tell from a view straight down."""

import math

import numpy as np
import pytest

from roadgeo.geometry.frame import Frame
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.pinhole import make_view
from roadgeo.geometry.similarity import find_similarity

FRAME = Frame(900, 600)


def covariance_of(sigma_m, rng):
    """Return a covariance (8, 8) of corners that is neither even nor without correlations."""
    root = rng.normal(size=(8, 8)) * 0.3 + np.eye(8)
    return sigma_m**2 * root @ root.T


def through(corners, places):
    """Return the homography that puts four corners on four places."""
    rows = []
    for (x, y), (u, v) in zip(corners, places, strict=True):
        rows += [[x, y, 1, 0, 0, 0, -u * x, -u * y], [0, 0, 0, x, y, 1, -v * x, -v * y]]
    return np.append(np.linalg.solve(np.array(rows), places.ravel()), 1.0).reshape(3, 3)


def view(tilt_deg):
    """Return the homography (3, 3) from the query plane, y up, to metres."""
    return make_view((50.0, 80.0), (900, 600), 0.8, tilt_deg, 60.0, 25.0).homography.matrix @ np.diag([1.0, -1.0, 1.0])


def straight_down(heading_deg, gsd_m):
    turn = math.radians(heading_deg)
    c, s = gsd_m * math.cos(turn), gsd_m * math.sin(turn)
    return np.array([[c, s, 3000.0], [-s, c, -700.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize("sigma_m", [0.05, 0.5, 5.0])
def test_what_a_camera_saw_straight_down_is_a_similarity_and_nearer_to_the_truth(sigma_m):
    rng = np.random.default_rng(4)
    corners, covariance = FRAME.plane_corners, covariance_of(sigma_m, rng)
    before, after, tried = 0.0, 0.0, 0
    for heading in range(0, 360, 6):
        true = Homography(straight_down(heading, 0.7)).everywhere(corners)
        seen = (true.ravel() + np.linalg.cholesky(covariance) @ rng.normal(size=8)).reshape(4, 2)
        found = find_similarity(through(corners, seen), corners, covariance)
        if found is None:
            continue
        tried += 1
        (a, b, _), (c, d, _), last = found.matrix
        assert (a, b) == (d, -c)
        assert np.array_equal(last, (0.0, 0.0, 1.0))
        assert np.all(np.diag(found.corner_covariance) <= np.diag(covariance) * (1 + 1e-9))
        before += ((seen - true) ** 2).sum()
        after += ((Homography(found.matrix).everywhere(corners) - true) ** 2).sum()
    assert tried >= 56  # 99 % of 60, less two standard deviations
    assert after < 0.75 * before


def test_the_covariance_is_that_of_what_is_left():
    rng = np.random.default_rng(7)
    corners, covariance = FRAME.plane_corners, covariance_of(0.5, rng)
    true = Homography(straight_down(40.0, 0.7)).everywhere(corners)
    errors = []
    for _ in range(400):
        seen = (true.ravel() + np.linalg.cholesky(covariance) @ rng.normal(size=8)).reshape(4, 2)
        found = find_similarity(through(corners, seen), corners, covariance)
        if found is not None:
            errors.append((Homography(found.matrix).everywhere(corners) - true).ravel())
            stated = found.corner_covariance
    measured = np.sqrt(np.mean(np.square(errors), axis=0))
    assert measured == pytest.approx(np.sqrt(np.diag(stated)), rel=0.15)


@pytest.mark.parametrize("sigma_m", [0.5, 3.0])
def test_a_tilted_view_that_is_taken_for_level_is_as_unsure_as_it_is_wrong(sigma_m):
    rng = np.random.default_rng(2)
    corners, covariance = FRAME.plane_corners, covariance_of(sigma_m, rng)
    errors, claimed = [], []
    for tilt_deg in np.linspace(0.0, 2.0, 400):
        true = Homography(view(tilt_deg)).everywhere(corners)
        seen = (true.ravel() + np.linalg.cholesky(covariance) @ rng.normal(size=8)).reshape(4, 2)
        found = find_similarity(through(corners, seen), corners, covariance)
        if found is not None:
            errors.append(np.sum((Homography(found.matrix).everywhere(corners) - true) ** 2))
            claimed.append(np.trace(found.corner_covariance + found.by_tilt))
    assert len(errors) > 20
    assert 0.6 < np.sqrt(np.mean(np.divide(errors, claimed))) < 1.4


@pytest.mark.parametrize("tilt_deg", [1.0, 10.0, 45.0])
def test_a_tilted_camera_is_left_alone(tilt_deg):
    covariance = covariance_of(0.2, np.random.default_rng(1))
    assert find_similarity(view(tilt_deg), FRAME.plane_corners, covariance) is None


def test_where_little_is_known_a_little_tilt_is_not_told():
    covariance = covariance_of(30.0, np.random.default_rng(1))
    assert find_similarity(view(1.0), FRAME.plane_corners, covariance) is not None


def test_nothing_is_found_among_numbers_that_are_none():
    assert find_similarity(view(0.0), FRAME.plane_corners, np.full((8, 8), np.nan)) is None
