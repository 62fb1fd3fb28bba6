"""Refinement on made-up towns with known homographies."""

from dataclasses import replace

import numpy as np
import pytest
from worlds.scenes import Sight, mapped, shaken, sight_of

from roadgeo.matching.index import IndexOptions, build_index
from roadgeo.matching.refinement import RefineOptions, refine
from roadgeo.matching.verification import VerifyOptions, agreement

NO_SEEDS = np.array([], int)


def refined(start, scene, index, gsd=1.0, rounds=3):
    matrix, result = start, None
    for _ in range(rounds):
        _, matched, _ = agreement(matrix, scene, index, gsd, NO_SEEDS, VerifyOptions())
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


@pytest.mark.slow
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
    errors, sigmas = calibration(town, range(30), **view)
    assert 0.7 < np.sqrt(np.mean((errors / sigmas) ** 2)) < 1.3
    assert np.median(errors) < 1.5


@pytest.mark.slow
def test_more_noise_is_claimed_as_such(town):
    claims = [calibration(town, range(4), sight=Sight(s))[1].mean() for s in (0.3, 1.0, 2.5)]
    assert claims[0] < claims[1] < claims[2]


def test_wrong_matches_do_no_harm(town):
    truth, scene = sight_of(town[0], 5, 20.0, Sight(0.5))
    index = town[1]
    _, matched, _ = agreement(truth, scene, index, 1.0, NO_SEEDS, VerifyOptions())
    swapped = matched.copy()
    few = np.flatnonzero(matched >= 0)[::6]
    swapped[few] = index.neighbours[matched[few], 0]
    right, wrong = refine(truth, scene, index, matched), refine(truth, scene, index, swapped)
    assert np.abs(mapped(right.matrix, scene.corners) - mapped(wrong.matrix, scene.corners)).max() < 0.3


def test_fewer_points_do_nearly_as_well(town):
    truth, scene = sight_of(town[0], 6, 20.0, Sight(0.5))
    _, matched, _ = agreement(truth, scene, town[1], 1.0, NO_SEEDS, VerifyOptions())
    result = refine(truth, scene, town[1], matched, n_points=150)
    assert np.abs(mapped(result.matrix, scene.corners) - mapped(truth, scene.corners)).max() < 2


def test_a_floor_under_every_claim(town):
    truth, scene = sight_of(town[0], 7)
    _, matched, _ = agreement(truth, scene, town[1], 1.0, NO_SEEDS, VerifyOptions())
    floor = RefineOptions(sigma_floor_m=3.0)
    assert (refine(truth, scene, town[1], matched, floor).corner_sigma_m >= 3.0).all()


def test_nothing_to_stand_on_is_no_refinement(town):
    truth, scene = sight_of(town[0], 8)
    nowhere = np.array([[1, 0, 1e6], [0, 1, 1e6], [0, 0, 1]]) @ truth
    assert refine(nowhere, scene, town[1], np.full(len(scene.intersections), -1)) is None


@pytest.mark.parametrize("n_matches", [0, 1, 3, 5])
def test_few_true_matches_are_enough_where_roads_agree(town, n_matches):
    """Of a few lone matches the filter leaves none: the fit used to forget where it began, and failed."""
    truth, scene = sight_of(town[0], 8, 15.0, Sight(0.8))
    _, matched, _ = agreement(truth, scene, town[1], 1.0, NO_SEEDS, VerifyOptions())
    few = np.full(len(matched), -1)
    chosen = np.flatnonzero(matched >= 0)[:: max(1, int((matched >= 0).sum()) // max(n_matches, 1))][:n_matches]
    few[chosen] = matched[chosen]
    result = refine(truth, scene, town[1], few)
    assert result is not None
    gaps = np.hypot(*(mapped(result.matrix, scene.corners) - mapped(truth, scene.corners)).T)
    assert gaps.max() < 2.0


@pytest.fixture(scope="module")
def merged_sight(town):
    """(truth, scene, merged, at_merged): in a quarter of the frame roads lie 4 m beside where they are.

    The middle of a motorway is none of its carriageways.
    """
    truth, scene = sight_of(town[0], 10, 10)
    merged, at_merged = (
        (at[:, 0] > scene.center[0]) & (at[:, 1] > scene.center[1]) for at in (scene.points, scene.intersections.xy)
    )
    across = scene.directions[:, ::-1] * (-1.0, 1.0)
    points = np.where(merged[:, None], scene.points + 4.0 * across, scene.points)
    return truth, replace(scene, points=points), merged, at_merged


def error_of(sight, index, options=None, **flags):
    """Root mean square over the inner frame, metres, and what is claimed of its corners."""
    truth, scene, _, _ = sight
    nothing = np.full(len(scene.intersections), -1)
    result = refine(truth, replace(scene, **flags), index, nothing, options)
    inner = scene.center + 0.8 * (scene.corners - scene.center)
    gaps = np.hypot(*(mapped(result.matrix, inner) - mapped(truth, inner)).T)
    return float(np.sqrt(np.mean(gaps**2))), float(result.corner_sigma_m.mean())


def test_merged_roads_do_not_bend_the_fit(merged_sight, exact):
    _, _, merged, at_merged = merged_sight
    without, _ = error_of(merged_sight, exact)
    error, claimed = error_of(merged_sight, exact, merged=merged, at_merged=at_merged)
    assert error < 0.3
    assert error < 0.3 * without
    assert error < 2.0 * claimed


def test_where_most_roads_have_merged_they_are_all_that_there_is(merged_sight, exact):
    _, _, merged, at_merged = merged_sight
    without, _ = error_of(merged_sight, exact)
    options = RefineOptions(most_merged=0.1)
    assert error_of(merged_sight, exact, options, merged=merged, at_merged=at_merged)[0] == without


def test_intersections_on_merged_roads_are_left_out(town, exact):
    truth, scene = sight_of(town[0], 10, 10)
    _, matched, _ = agreement(truth, scene, exact, 1.0, NO_SEEDS, VerifyOptions())
    at_merged = np.zeros(len(matched), np.bool_)
    at_merged[np.flatnonzero(matched >= 0)[:5]] = True
    merged = np.arange(len(scene.points)) < 3
    with_them = replace(scene, merged=merged, at_merged=np.zeros_like(at_merged))
    without = replace(scene, merged=merged, at_merged=at_merged)
    one, other = (refine(truth, seen, exact, matched) for seen in (with_them, without))
    assert not np.allclose(one.matrix, other.matrix, rtol=0.0, atol=1e-9)
    spoiled = np.where(at_merged, (matched + 7) % len(exact), matched)
    same = refine(truth, without, exact, spoiled)
    assert np.abs(mapped(same.matrix, scene.corners) - mapped(other.matrix, scene.corners)).max() < 0.05
