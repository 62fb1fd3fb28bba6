"""A lens behind a fit: k1 and the homography are found together, and only where there is a lens."""

from dataclasses import replace

import numpy as np
import pytest
from worlds.scenes import (
    Sight,
    camera,
    estimator_of,
    look,
    mapped,
    random_network,
    scene_of,
    search,
    shaken,
    sight_of,
)

from roadgeo.geometry.lens import Lens
from roadgeo.matching import finishing
from roadgeo.matching.events import Events
from roadgeo.matching.finishing import with_honest_corners
from roadgeo.matching.lens import _core, find_lens, fit_lens, grow_whole, straighten_scene
from roadgeo.matching.refinement import Refined, RefineOptions, refine
from roadgeo.matching.search import SearchOptions


def through_lens(scene, k1):
    """The scene as a lens shows it."""
    bent = Lens.of(k1, scene.size, y_up=True)
    ahead = bent.bend(scene.points + 0.5 * scene.directions) - bent.bend(scene.points - 0.5 * scene.directions)
    directions = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
    found = replace(scene.intersections, xy=bent.bend(scene.intersections.xy))
    return replace(scene, points=bent.bend(scene.points), directions=directions, intersections=found)


@pytest.mark.parametrize("k1", [-0.12, -0.03, 0.06])
def test_homography_and_lens_are_found_together_and_corners_are_as_sure_as_claimed(town, k1):
    truth, straight = sight_of(town[0], 5, tilt=15, sight=Sight(0.6))
    scene = through_lens(straight, k1)
    start = shaken(truth, straight, 4.0, np.random.default_rng(1))
    found = fit_lens(start, scene, town[1], RefineOptions())
    assert found.lens_k1 == pytest.approx(k1, abs=5 * found.k1_sigma + 1e-4)
    assert found.k1_sigma < 0.001
    gaps = np.hypot(*(mapped(found.matrix, scene.corners) - mapped(truth, scene.corners)).T)
    assert np.sqrt(np.mean(gaps**2)) < 1.5
    assert (found.corner_sigma_m < 2.0).all()
    assert straighten_scene(scene, found.lens_k1).points == pytest.approx(straight.points, abs=1.0)


def test_roads_in_the_middle_of_a_frame_hardly_tell_a_lens_and_are_believed_in_part(town):
    """Lenses seldom have a k1 of more than a tenth."""
    truth, straight = sight_of(town[0], 5)
    scene = through_lens(straight, -0.15)
    near = np.hypot(*(scene.points - scene.center).T) < 160.0
    few = replace(scene, points=scene.points[near], directions=scene.directions[near], weights=scene.weights[near])
    assert -0.075 < fit_lens(truth, few, town[1], RefineOptions()).lens_k1 < -0.025


@pytest.mark.parametrize(("k1", "pays"), [(0.0, False), (0.002, False), (-0.1, True)])
def test_a_lens_is_taken_only_where_it_pays(town, k1, pays):
    truth, straight = sight_of(town[0], 7, tilt=10, sight=Sight(0.6))
    scene = through_lens(straight, k1)
    found = find_lens(truth, scene, town[1], RefineOptions())
    assert (found is not None) == pays


def test_roads_that_lie_nowhere_near_the_map_have_no_lens(town):
    truth, scene = sight_of(town[0], 8)
    assert fit_lens(truth + np.array([[0, 0, 90_000.0], [0, 0, 0], [0, 0, 0]]), scene, town[1], RefineOptions()) is None


def bent_start(truth, scene, k1):
    """A homography that is right in one part of the frame, as growth from there would leave it: affine, of a lens."""
    bent = Lens.of(k1, scene.size, y_up=True)
    there = scene.center + 0.25 * (scene.corners[0] - scene.center)
    seen = there + np.array([[0.0, 0.0], [30.0, 0.0], [0.0, 30.0]])
    places = mapped(truth, bent.straighten(seen))
    linear = np.stack([places[1] - places[0], places[2] - places[0]], axis=1) / 30.0
    matrix = np.eye(3)
    matrix[:2, :2], matrix[:2, 2] = linear, places[0] - linear @ seen[0]
    return matrix


@pytest.mark.parametrize("k1", [-0.16, -0.08, 0.1])
def test_what_fits_in_one_part_of_the_frame_grows_over_all_of_it_behind_a_lens(town, k1):
    truth, straight = sight_of(town[0], 5, tilt=15, sight=Sight(0.6))
    scene = through_lens(straight, k1)
    start = bent_start(truth, scene, k1)
    corners = mapped(truth, scene.corners)
    assert np.hypot(*(mapped(start, scene.corners) - corners).T).max() > 60.0  # metres
    found = find_lens(start, scene, town[1], RefineOptions())
    assert found.lens_k1 == pytest.approx(k1, abs=0.002)
    assert np.hypot(*(mapped(found.matrix, scene.corners) - corners).T).max() < 2.0


def test_what_fits_in_one_part_of_the_frame_grows_over_all_of_it_without_a_lens(town):
    truth, scene = sight_of(town[0], 5, tilt=35, sight=Sight(0.6))
    start = bent_start(truth, scene, 0.0)
    corners = mapped(truth, scene.corners)
    assert np.hypot(*(mapped(start, scene.corners) - corners).T).max() > 60.0  # metres
    given = (scene, town[1], RefineOptions())
    found = grow_whole(start, *given)
    assert found.lens_k1 == 0.0  # else it would be taken for one behind a lens
    assert np.hypot(*(mapped(found.matrix, scene.corners) - corners).T).max() < 2.0
    assert grow_whole(truth, *given) is None  # nothing is gained


@pytest.mark.parametrize(("azimuth_deg", "k1"), [(0.0, 0.0), (0.0, -0.16), (50.0, 0.1)])
def test_a_fit_grows_over_an_oblique_frame_of_two_kilometres(town, azimuth_deg, k1):
    """It takes a dozen steps, of which each reaches a little further."""
    size = (2000, 2000)
    truth = camera((2000, 2000), size, 1.0, 35.0, azimuth_deg, 0.6 * azimuth_deg, 2000.0)
    straight = scene_of(look(town[0], truth, size, Sight(0.6, 0.1, 0.1), int(azimuth_deg) // 50), size)
    scene = through_lens(straight, k1)
    found = fit_lens(bent_start(truth, scene, k1), scene, town[1], RefineOptions(), 0.0 if k1 else None)
    assert np.hypot(*(mapped(found.matrix, scene.corners) - mapped(truth, scene.corners)).T).max() < 1.2


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_fit_grows_over_the_frame_where_a_fifth_of_the_roads_is_missing_and_two_fifths_are_false(town, seed):
    truth, straight = sight_of(town[0], seed, tilt=25, sight=Sight(0.6, 0.2, 0.4))
    scene = through_lens(straight, -0.12)
    found = find_lens(bent_start(truth, scene, -0.12), scene, town[1], RefineOptions())
    assert found.lens_k1 == pytest.approx(-0.12, abs=0.002)
    assert np.hypot(*(mapped(found.matrix, scene.corners) - mapped(truth, scene.corners)).T).max() < 2.0


def test_a_fit_begins_with_the_largest_part_that_lies_on_roads_not_with_a_small_one_that_does_by_chance():
    x, y = (item.ravel() for item in np.meshgrid(np.arange(10.0, 1000.0, 20.0), np.arange(10.0, 1000.0, 20.0)))
    left, corner = x < 500, (x > 800) & (y < 200)
    met = np.where(left, (x + y) % 100 != 20, corner)  # four of five
    core = _core(met, np.stack((x, -y), axis=1), (1000, 1000))
    assert core.sum() > 0.7 * (met & left).sum()
    assert not core[corner].any()


def test_a_wrong_place_does_not_grow(town):
    truth, scene = sight_of(town[0], 5, tilt=15, sight=Sight(0.6))
    wrong = np.array([[1.0, 0, 137.0], [0, 1.0, 211.0], [0, 0, 1]]) @ truth
    given = (scene, town[1])
    assert find_lens(wrong, *given, RefineOptions()) is None
    assert grow_whole(wrong, *given, RefineOptions()) is None


def honest(matrix, scene, index):
    """The deviations of the corners that are claimed for a homography."""
    return with_honest_corners(
        Refined(matrix, 1.0, np.eye(8), 0.0, 0.0, 1.0), scene, index, RefineOptions()
    ).corner_sigma_m


def test_corners_that_a_tilted_frame_shows_far_away_are_less_sure(town):
    truth, scene = sight_of(town[0], 5, tilt=45, sight=Sight(0.6))
    refined = refine(truth, scene, town[1], np.full(len(scene.intersections), -1), held=True)
    sigma = honest(refined.matrix, scene, town[1])
    corners = np.c_[scene.corners, np.ones(4)] @ refined.matrix[2]
    assert np.argmax(sigma) in np.argsort(corners)[:2]  # a smaller w is further away


def test_where_a_mask_is_bent_corners_are_about_as_sure_as_claimed(town):
    truth, straight = sight_of(town[0], 5, tilt=15, sight=Sight(1.0))
    ratios = []
    for phases in np.random.default_rng(4).uniform(0, 2 * np.pi, (12, 2)):
        bent = straight.points + 3.0 * np.sin(straight.points[:, ::-1] * (2 * np.pi / 300.0) + phases)
        scene = replace(straight, points=bent)
        refined = refine(truth, scene, town[1], np.full(len(scene.intersections), -1), held=True)
        gaps = np.hypot(*(mapped(refined.matrix, scene.corners) - mapped(truth, scene.corners)).T)
        ratios.append(np.sqrt(np.mean(gaps**2) / np.mean(honest(refined.matrix, scene, town[1]) ** 2)))
    assert 0.4 < np.sqrt(np.mean(np.square(ratios))) < 1.4


def test_the_unknown_middle_of_a_lens_makes_corners_less_sure(town, monkeypatch):
    truth, straight = sight_of(town[0], 5, tilt=15, sight=Sight(0.6))
    scene = through_lens(straight, -0.12)
    claimed = Refined(truth, 1.0, np.eye(8), -0.12, 0.0, 1.0)
    corners = []
    for sigma in (0.0, 2.0):
        monkeypatch.setattr(finishing, "_CENTER_SIGMA_PX", sigma)
        corners.append(with_honest_corners(claimed, scene, town[1], RefineOptions()))
    known, unknown = corners
    assert (unknown.corner_sigma_m > 1.2 * known.corner_sigma_m).all()


def test_where_hardly_a_road_is_met_the_claim_stays(town):
    truth, scene = sight_of(town[0], 8)
    nowhere = truth + np.array([[0, 0, 90_000.0], [0, 0, 0], [0, 0, 0]])
    assert honest(nowhere, scene, town[1]) == pytest.approx(np.full(4, np.sqrt(2.0)))


def test_where_most_of_a_frame_is_astray_and_hardly_a_road_is_left_the_claim_stays(town):
    truth, scene = sight_of(town[0], 8)
    few = replace(scene, points=scene.points[:20], directions=scene.directions[:20], weights=scene.weights[:20])
    shifted = np.array([[1.0, 0, 23.0], [0, 1.0, 17.0], [0, 0, 1]]) @ truth
    assert np.isfinite(honest(shifted, few, town[1])).all()


def test_a_place_that_is_grown_anew_behind_a_lens_is_told_as_grown_once(town):
    """It grew before it was dropped: else more would be said to survive than was proposed."""

    _, elsewhere = sight_of(random_network(72), 5, sight=Sight(0.6))
    events = Events(kept=True)
    search(estimator_of(elsewhere, town[1], events=events))
    grew = [id(matrix) for grown in events.of("grown") for matrix in grown]
    assert len(set(grew)) == len(grew) > 0


@pytest.mark.parametrize("k1", [-0.12, -0.04, 0.0, 0.05])
def test_a_search_finds_what_a_lens_saw(town, k1):
    """Also where the lens bends so much that a pinhole fits one part of the frame only."""
    truth, straight = sight_of(town[0], 5, tilt=10, sight=Sight(0.6))
    scene = through_lens(straight, k1)
    result = search(estimator_of(scene, town[1]))
    refined = result.best.refined
    assert result.score > SearchOptions().accept
    assert refined.lens_k1 == pytest.approx(k1, abs=0.005)
    gaps = np.hypot(*(mapped(refined.matrix, straight.corners) - mapped(truth, straight.corners)).T)
    assert gaps.max() < 6.0
