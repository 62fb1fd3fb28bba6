"""Two roads of a mask that are one on the map: their middle is laid there."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matching.test_explanation import mask_of
from worlds.motorways import motorways
from worlds.scenes import camera, estimator_of, look, mapped, random_network, scene_of

from roadgeo.geometry.camera import CameraFault
from roadgeo.matching.finishing import measure_corners
from roadgeo.matching.index import build_index
from roadgeo.matching.place import Place, Weight
from roadgeo.matching.refinement import RefineOptions, between_carriageways, nearest_of, refine, refine_between
from roadgeo.reference.reference import Reference
from roadgeo.workflows import locate

SIDE = 1000


def has_two(truth, most):
    """Whether a road lies where the frame's roads are drawn as two: left of that part of its width."""
    back = np.linalg.inv(truth)
    return lambda at: bool(mapped(back, np.atleast_2d(at))[0, 0] < most * SIDE)


def sight(town, truth, most=0.6, apart_m=18.0):
    """What a camera sees of the town whose roads on one side are carriageways; the town's index has one for both."""
    return scene_of(look(motorways(town[0], has_two(truth, most), apart_m), truth))


def fit(truth, scene, index, options=None):
    """A fit to points and roads alone, from the truth."""
    return refine(truth, scene, index, np.full(len(scene.intersections), -1), options)


def error_of(matrix, truth, scene):
    gaps = np.hypot(*(mapped(matrix, scene.corners) - mapped(truth, scene.corners)).T)
    return float(np.sqrt(np.mean(gaps**2)))


@pytest.mark.parametrize("tilt", [0, 15, 40])
@pytest.mark.parametrize("apart_m", [12.0, 18.0, 24.0])
def test_their_middle_is_laid_on_the_road(town, tilt, apart_m):
    truth = camera((2000, 1900), gsd_m=1.0, tilt_deg=tilt, azimuth_deg=70, heading_deg=30)
    scene, options = sight(town, truth, apart_m=apart_m), RefineOptions()
    given = fit(truth, scene, town[1], options)
    nothing = np.full(len(scene.intersections), -1)
    found, seen = refine_between(given, scene, town[1], nothing, options)
    error, claimed = error_of(found.matrix, truth, scene), found.corner_sigma_m.mean()
    assert seen is not scene
    assert error < 0.4 * error_of(given.matrix, truth, scene)
    assert error < 2.0 * claimed


@pytest.fixture(scope="module")
def seen(town):
    """(truth, scene) of a frame of which the left part shows two roads for each."""
    truth = camera((2000, 1900), heading_deg=30)
    return truth, sight(town, truth)


def test_points_move_to_the_middle_and_matches_there_are_dropped(town, seen):
    truth, cut = seen  # its roads do not meet: the intersections are those of the roads before they were made two
    scene = replace(cut, intersections=scene_of(look(town[0], truth)).intersections)
    matched = np.arange(len(scene.intersections))
    moved, left = between_carriageways(truth, scene, town[1], matched)
    by = np.hypot(*(moved.points - scene.points).T)
    carriageways = scene.points[:, 0] < 0.5 * SIDE
    assert np.median(by[carriageways]) == pytest.approx(9.0, abs=0.5)
    assert (by[carriageways] > 0).mean() > 0.7
    assert (by[scene.points[:, 0] > 0.75 * SIDE] > 0).mean() < 0.02
    kept = left >= 0
    assert np.array_equal(left[kept], matched[kept])
    assert kept[scene.intersections.xy[:, 0] > 0.75 * SIDE].mean() > 0.95
    assert kept[scene.intersections.xy[:, 0] < 0.5 * SIDE].mean() < 0.3


@pytest.mark.parametrize(("part", "are_one"), [(0.25, True), (0.5, False)])
def test_two_roads_of_the_map_that_lie_much_nearer_than_the_masks_are_one(town, seen, part, are_one):
    truth, scene = seen
    index = build_index(motorways(town[0], has_two(truth, 0.6), part * 18.0))
    moved, _ = between_carriageways(truth, scene, index, np.full(len(scene.intersections), -1))
    there = scene.points[:, 0] < 0.5 * SIDE
    assert bool((moved.points != scene.points).any(axis=1)[there].mean() > 0.5) is are_one


@pytest.mark.parametrize(("apart_m", "are_one"), [(2.2, False), (4.5, True), (25.0, True), (45.0, False)])
def test_carriageways_are_neither_the_edges_of_a_road_nor_a_block_apart(town, seen, apart_m, are_one):
    truth, _ = seen
    scene = sight(town, truth, apart_m=apart_m)
    moved, _ = between_carriageways(truth, scene, town[1], np.full(len(scene.intersections), -1))
    there = scene.points[:, 0] < 0.5 * SIDE
    assert bool((moved.points != scene.points).any(axis=1)[there].mean() > 0.5) is are_one


def test_matches_within_two_steps_of_such_a_road_are_dropped(town, seen):
    truth, scene = seen
    xy = np.random.default_rng(2).uniform((0, -SIDE), (0.5 * SIDE, 0), (600, 2))
    scene = replace(scene, intersections=replace(scene.intersections, xy=xy))
    moved, left = between_carriageways(truth, scene, town[1], np.arange(len(xy)))
    there = scene.points[(moved.points != scene.points).any(axis=1)]
    steps = np.hypot(*(xy[:, None] - there).T).min(axis=0) / (scene.road_length_px / len(scene.points))
    assert (left[(steps > 1.2) & (steps < 1.8)] < 0).all()
    assert (left[(steps > 2.2) & (steps < 3.8)] >= 0).all()
    assert ((steps > 1.2) & (steps < 1.8)).any()
    assert ((steps > 2.2) & (steps < 3.8)).any()


def test_where_the_map_has_two_they_stay(town, seen):
    truth, scene = seen
    index = build_index(motorways(town[0], has_two(truth, 0.6), 18.0))
    moved, _ = between_carriageways(truth, scene, index, np.full(len(scene.intersections), -1))
    assert (moved.points != scene.points).any(axis=1).mean() < 0.05


def test_a_road_that_is_not_there_beside_one_that_is(town):
    """Half of the roads have a false one on the same side."""
    truth = camera((2000, 1900), heading_deg=30)
    true = scene_of(look(town[0], truth))
    beside = np.flatnonzero(true.points[:, 0] < 0.5 * SIDE)
    shift = 14.0 * true.directions[beside][:, ::-1] * (-1.0, 1.0)
    scene = replace(
        true,
        points=np.concatenate([true.points, true.points[beside] + shift]),
        directions=np.concatenate([true.directions, true.directions[beside]]),
        weights=np.ones(len(true.points) + len(beside)),
        road_length_px=true.road_length_px * (1 + len(beside) / len(true.points)),
    )
    nothing = np.full(len(scene.intersections), -1)
    given = fit(truth, scene, town[1])
    assert between_carriageways(given.matrix, scene, town[1], nothing)[0] is not scene
    found, as_seen = refine_between(given, scene, town[1], nothing, RefineOptions())
    assert found is given
    assert as_seen is scene


def test_without_any_nothing_changes(town):
    truth = camera((2000, 1900), heading_deg=30)
    scene = scene_of(look(town[0], truth))
    given, nothing = fit(truth, scene, town[1]), np.full(len(scene.intersections), -1)
    alone = replace(scene, points=scene.points[:1], directions=scene.directions[:1], weights=scene.weights[:1])
    none = replace(alone, points=np.empty((0, 2)), directions=np.empty((0, 2)), weights=np.empty(0))
    for item in (alone, none):
        assert between_carriageways(truth, item, town[1], nothing) == (item, nothing)
    found, _ = refine_between(given, scene, town[1], nothing, RefineOptions())
    assert error_of(found.matrix, truth, scene) < error_of(given.matrix, truth, scene) + 0.05


@pytest.mark.parametrize("fault", [None, CameraFault.TILT])
def test_a_place_is_refined_so_for_the_last_time_unless_no_camera_sees_it(town, seen, monkeypatch, fault):
    truth, scene = seen
    estimator = estimator_of(scene, town[1])
    monkeypatch.setattr(estimator, "judge", lambda matrix, rough=False: fault)
    given = fit(truth, scene, town[1])
    nothing = np.full(len(scene.intersections), -1)
    weight = Weight(20.0, 480.0)
    compared = Place(scene, town[1], given.matrix, grown=nothing, refined=given, score=10.0, by=weight)
    best = measure_corners(estimator, compared)
    error, before = (error_of(matrix, truth, scene) for matrix in (best.refined.matrix, given.matrix))
    assert (best.score, best.by) == (10.0, weight)  # the answer rests on it
    assert np.array_equal(best.matrix, best.refined.matrix)
    assert error == before if fault else error < 0.4 * before


def test_a_located_mask_lies_right(town):
    """As a user meets it: all roads of the mask are carriageways that the map has as one."""
    network = random_network(4)
    truth = camera((1500, 1500), (900, 900), heading_deg=20)
    mask = mask_of(motorways(network, lambda at: True, 20.0), truth, (900, 900))
    location = locate(mask, Reference(build_index(network), network))
    assert location.located
    corners = np.array([[0, 0], [900, 0], [900, 900], [0, 900]], float)
    have = mapped(np.asarray(location.homography), corners)
    want = network.plane.to_crs(mapped(truth, corners * (1, -1)))
    assert np.hypot(*(have - want).T).max() < 2.0


@given(st.integers(0, 30), st.integers(1, 30), st.floats(0.1, 60.0), st.integers(0, 2**32 - 1))
def test_the_nearest_of_some_points(n, m, away, seed):
    rng = np.random.default_rng(seed)
    xy, points = rng.uniform(0, 100, (n, 2)), rng.uniform(0, 100, (m, 2))
    among = np.flatnonzero(rng.random(m) < 0.5)
    found = nearest_of(xy, points, among, away)
    for point, number in zip(xy, found, strict=True):
        distances = np.hypot(*(points[among] - point).T)
        if len(among) and distances.min() < away:
            assert number == among[np.argmin(distances)]
        else:
            assert number == -1
