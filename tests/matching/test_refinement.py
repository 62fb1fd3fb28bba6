"""Refinement on made-up towns with known homographies."""

import math

import numpy as np
import pytest
from worlds.scenes import Sight, mapped, shaken, sight_of

from roadgeo.matching import refinement
from roadgeo.matching.index import IndexOptions, build_index
from roadgeo.matching.place import Place
from roadgeo.matching.refinement import refine


def refined(start, scene, index, gsd=1.0, rounds=3):
    matrix, result = start, None
    for _ in range(rounds):
        matched = Place(scene, index, matrix).matched
        result = refine(matrix, scene, index, matched)
        assert result is not None
        matrix = result.matrix
    return result


@pytest.fixture(scope="module")
def exact(town):
    """The town's index with its roads as they are."""
    return build_index(town[0], IndexOptions(simplify_m=0.01))


@pytest.mark.parametrize("tilt", [0, 15, 30, 45])
@pytest.mark.parametrize("gsd", [0.7, 1.3])
def test_the_homography_is_recovered_where_the_query_is_exact(town, exact, tilt, gsd):
    truth, scene = sight_of(town[0], tilt, tilt, gsd=gsd)
    start = shaken(truth, scene, 4.0, np.random.default_rng(tilt))
    result = refined(start, scene, exact, gsd)
    inner = scene.center + 0.8 * (scene.corners - scene.center)
    gaps = np.hypot(*(mapped(result.matrix, inner) - mapped(truth, inner)).T)
    assert np.sqrt(np.mean(gaps**2)) < 0.1
    assert result.rms_m < 0.1
    assert (result.corner_sigma_m < 0.15 + 0.15 * gsd).all()
    variances = np.diag(result.corner_covariance_m2).reshape(4, 2).sum(axis=1)
    np.testing.assert_allclose(variances, result.corner_sigma_m**2)
    assert np.linalg.eigvalsh(result.corner_covariance_m2).min() > 0
    assert result.matrix[2, 2] == 1.0


def calibration(town, seeds, **view):
    """(errors of corners, their claimed standard deviations)."""
    errors, sigmas = [], []
    for seed in seeds:
        truth, scene = sight_of(town[0], seed, **view)
        result = refined(shaken(truth, scene, 3.0, np.random.default_rng(seed)), scene, town[1])
        errors.append(np.hypot(*(mapped(result.matrix, scene.corners) - mapped(truth, scene.corners)).T))
        sigmas.append(result.corner_sigma_m)
    return np.array(errors), np.array(sigmas)


@pytest.mark.parametrize(
    "view",
    [
        {"sight": Sight(0.6)},
        {"sight": Sight(1.2), "tilt": 25},
        {"sight": Sight(1.8), "tilt": 10},
        {"sight": Sight(1.2, missing=0.15, false=0.1), "tilt": 35},
    ],
    ids=["sharp", "tilted", "blurred", "gaps"],
)
def test_claimed_accuracy_is_honest(town, view):
    errors, sigmas = calibration(town, range(7), **view)
    assert 0.8 < np.sqrt(np.mean((errors / sigmas) ** 2)) < 1.3
    assert np.median(errors) < 1.5


def test_wrong_matches_do_no_harm(town):
    truth, scene = sight_of(town[0], 5, 20.0, Sight(0.5))
    index = town[1]
    matched = Place(scene, index, truth).matched
    swapped = matched.copy()
    few = np.flatnonzero(matched >= 0)[::6]
    swapped[few] = index.neighbours[matched[few], 0]
    right, wrong = refine(truth, scene, index, matched), refine(truth, scene, index, swapped)
    assert np.abs(mapped(right.matrix, scene.corners) - mapped(wrong.matrix, scene.corners)).max() < 0.3


def test_fewer_points_do_nearly_as_well(town):
    truth, scene = sight_of(town[0], 6, 20.0, Sight(0.5))
    matched = Place(scene, town[1], truth).matched
    result = refine(truth, scene, town[1], matched, n_points=150)
    assert np.abs(mapped(result.matrix, scene.corners) - mapped(truth, scene.corners)).max() < 2


@pytest.mark.parametrize("gsd", [0.3, 2.0])
def test_no_corner_is_surer_than_lines_are_drawn(town, exact, gsd):
    """To a tenth of a metre on the map, and a seventh of a pixel in the mask."""
    truth, scene = sight_of(town[0], 3, gsd=gsd)
    result = refined(truth, scene, exact, gsd)
    assert result.corner_sigma_m == pytest.approx(np.full(4, math.hypot(0.1, 0.15 * gsd)), rel=0.3)


def test_a_floor_under_every_claim(town, monkeypatch):
    truth, scene = sight_of(town[0], 7)
    matched = Place(scene, town[1], truth).matched
    monkeypatch.setattr(refinement, "_SIGMA_FLOOR", (3.0, 0.15))
    assert refine(truth, scene, town[1], matched).corner_sigma_m == pytest.approx(np.full(4, 3.0), rel=0.05)


def test_errors_of_a_bent_mask_keep_their_sign_further(town, monkeypatch):
    """Claims grow by the square of what the rms is more than usual."""
    truth, scene = sight_of(town[0], 7)
    matched, claims = Place(scene, town[1], truth).matched, []
    rms = refine(truth, scene, town[1], matched).rms_m / math.hypot(1.2, 0.9)  # pixels of 1 m
    monkeypatch.setattr(refinement, "_SIGMA_FLOOR", (0.0, 0.0))
    for more in (0.5, 1.0, 2.0):
        monkeypatch.setattr(refinement, "_USUAL_RMS", rms / more)
        claims.append(refine(truth, scene, town[1], matched).corner_sigma_m.mean())
    assert np.array(claims) / claims[0] == pytest.approx([1.0, 1.0, 2.0], rel=0.05)


def test_claims_of_a_blurred_mask_are_for_its_errors_two_or_three_times_as_wide_as_of_a_sharp_one(town, monkeypatch):
    monkeypatch.setattr(refinement, "_SIGMA_FLOOR", (0.0, 0.0))
    wide = []
    for sigma_m in (0.3, 3.0):
        truth, scene = sight_of(town[0], 4, sight=Sight(sigma_m))
        result = refine(truth, scene, town[1], np.full(len(scene.intersections), -1), held=True)
        wide.append(result.corner_sigma_m.mean() / result.rms_m)
    assert 1.8 < wide[1] / wide[0] < 3.8


def test_nothing_to_stand_on_is_no_refinement(town):
    truth, scene = sight_of(town[0], 8)
    nowhere = np.array([[1, 0, 1e6], [0, 1, 1e6], [0, 0, 1]]) @ truth
    assert refine(nowhere, scene, town[1], np.full(len(scene.intersections), -1)) is None


@pytest.mark.parametrize("n_matches", [0, 1, 3, 5])
def test_few_true_matches_are_enough_where_roads_agree(town, n_matches):
    """Of a few lone matches the filter leaves none: the fit used to forget where it began, and failed."""
    truth, scene = sight_of(town[0], 8, 15.0, Sight(0.8))
    matched = Place(scene, town[1], truth).matched
    few = np.full(len(matched), -1)
    chosen = np.flatnonzero(matched >= 0)[:: max(1, int((matched >= 0).sum()) // max(n_matches, 1))][:n_matches]
    few[chosen] = matched[chosen]
    result = refine(truth, scene, town[1], few)
    assert result is not None
    gaps = np.hypot(*(mapped(result.matrix, scene.corners) - mapped(truth, scene.corners)).T)
    assert gaps.max() < 2.0
