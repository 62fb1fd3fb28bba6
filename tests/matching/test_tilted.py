"""Steep views: which way the camera leaned, and what the mask shows once that is taken out."""

import math
from dataclasses import replace

import numpy as np
import pytest
from worlds.scenes import Sight, camera, look, mapped, scene_of

from roadgeo.geometry.homography import Homography
from roadgeo.location import Seconds
from roadgeo.matching.estimator import MatchOptions
from roadgeo.matching.foreground import before
from roadgeo.matching.methods import search_references
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.parts import Whole
from roadgeo.matching.query import Query
from roadgeo.matching.road_views import RoadViews
from roadgeo.matching.shared_sweeps import SharedSweeps
from roadgeo.matching.tilted import TiltOptions, evenness, likely_views, rectification, rectify
from roadgeo.matching.verdict import decide

SIZE = (1000, 1000)


def seen(network, seed, tilt_deg, sight=None):
    """(truth, graph, scene) of a camera that leans by `tilt_deg` over the town."""
    rng = np.random.default_rng(seed)
    place = tuple(rng.uniform(1500, 2500, 2))
    truth = camera(place, SIZE, 1.0, tilt_deg, rng.uniform(0, 360), rng.uniform(0, 360), 1200.0)
    graph = look(network, truth, SIZE, sight, seed)
    return truth, graph, scene_of(graph)


def horizon_deg(truth):
    """Direction of the horizon in the query plane: where depth falls fastest."""
    return math.degrees(math.atan2(-truth[2, 1], -truth[2, 0]))


def apart_deg(a, b):
    return abs((a - b + 180.0) % 360.0 - 180.0)


@pytest.mark.parametrize("tilt_deg", [0.0, 35.0, 55.0])
def test_the_right_tilt_leaves_a_turn_and_a_scale(town, tilt_deg):
    truth, _, scene = seen(town[0], 3, tilt_deg)
    view = rectification(scene, tilt_deg, horizon_deg(truth), 1.2)
    middle = scene.center
    assert np.allclose(Homography(view)(middle[None])[0], middle)
    assert np.linalg.det(Homography(view).jacobian(middle)) == pytest.approx(1.0)
    left = truth @ np.linalg.inv(view)
    left /= left[2, 2]
    (a, b), (c, d) = left[:2, :2]
    assert np.allclose([a - d, b + c], 0.0, atol=1e-9)
    assert np.abs(left[2, :2]).max() < 1e-12


def test_scenes_move_with_their_roads(town):
    truth, _, scene = seen(town[0], 3, 50.0)
    view = rectification(scene, 50.0, horizon_deg(truth), 1.2)
    moved = rectify(scene, view)
    back = np.linalg.inv(view)
    assert np.allclose(mapped(back, moved.intersections.xy), scene.intersections.xy)
    assert np.allclose(mapped(back, moved.dense_points), scene.dense_points)
    assert np.allclose(np.hypot(*moved.dense_directions.T), 1.0)
    there = np.isfinite(scene.intersections.rays)
    assert (np.isfinite(moved.intersections.rays) == there).all()
    # A small step along a ray is a small step along the moved one.
    n, ray = np.argwhere(there)[7]
    start, angle = scene.intersections.xy[n], float(scene.intersections.rays[n, ray])
    step = mapped(view, (start + 1e-3 * np.array([math.cos(angle), math.sin(angle)]))[None])[0]
    away = step - moved.intersections.xy[n]
    assert apart_deg(math.degrees(math.atan2(*away[::-1])), math.degrees(moved.intersections.rays[n, ray])) < 0.5


def test_far_roads_are_left_out(town):
    truth, _, scene = seen(town[0], 3, 50.0)
    view = rectification(scene, 50.0, horizon_deg(truth), 1.2)
    moved = rectify(scene, view, 1.6)
    kept = before(scene.dense_points, view, scene, 1.6)
    assert 0.2 < kept.mean() < 0.9
    assert np.allclose(mapped(np.linalg.inv(view), moved.dense_points), scene.dense_points[kept])
    assert len(moved.dense_directions) == kept.sum()
    assert len(moved.intersections) == len(scene.intersections)


def test_far_intersections_do_not_vote(town):
    """Their numbers are those of the scene, by which hypotheses know them."""
    _, _, scene = seen(town[0], 5, 54.0)
    options, index = MatchOptions(), town[1]
    views = RoadViews(scene, index, options, None, SharedSweeps(scene, options.camera))
    for view in views.tilted():
        near = np.flatnonzero(before(scene.intersections.xy, views.seen_by(view), scene, options.tilted.coarser))
        voters = views.search(view).voters
        assert np.array_equal(voters, near)
        assert 0 < len(near) < len(scene.intersections)
        tried = {one.anchor for one in views.search(view).rounds() if one.anchor >= 0}
        assert tried
        assert tried <= set(near)
    assert len(views.tilted()) > 0
    assert len(views.search(0).voters) == len(scene.intersections)


def test_roads_crowd_towards_the_horizon(town):
    """They lie more evenly once the tilt is taken out, and one of the views that are tried leans that way, mostly."""
    found = 0
    for seed in range(10):
        truth, _, scene = seen(town[0], seed, 54.0)
        towards = horizon_deg(truth)
        right, wrong = (rectification(scene, 54.0, turn, 1.2) for turn in (towards, towards + 180.0))
        assert evenness(scene, right) < evenness(scene, wrong)
        turns = [45.0 * k for k in range(8) if apart_deg(45.0 * k, towards) <= 45.0]
        near = [rectification(scene, 50.0, turn, 1.2) for turn in turns]
        found += any(np.allclose(one, other) for one in likely_views(scene, TiltOptions()) for other in near)
    assert found >= 7


def test_where_the_horizon_shows_nothing_is_even(town):
    _, _, scene = seen(town[0], 1, 0.0)
    assert evenness(scene, rectification(scene, 80.0, 0.0, 1.2)) == math.inf
    assert len(likely_views(scene, TiltOptions(tilt_deg=80.0))) == 0


@pytest.mark.slow
def test_a_steep_view_is_found_as_it_would_look_from_above(town):
    """Of 40 % of its roads nothing is left, a fifth of the others are false: similarities propose no place."""
    truth, graph, scene = seen(town[0], 5, 54.0, Sight(2.0, 0.4, 0.2))
    query, options = Query("q", scene, graph, Seconds()), LocateOptions()
    without = replace(options, match=replace(options.match, tilted=None))
    refused, found = (
        decide(query, search_references(query, [Whole(town[1])], one, 60.0), one) for one in (without, options)
    )
    assert (refused.status, found.status) == ("not_located", "located")
    middle = town[1].plane.to_crs(mapped(truth, scene.center[None]))[0]
    assert math.hypot(found.center.x - middle[0], found.center.y - middle[1]) < 5.0
    level = replace(options, match=replace(options.match, camera=replace(options.match.camera, max_tilt_deg=45.0)))
    assert decide(query, search_references(query, [Whole(town[1])], level, 60.0), level).status == "not_located"
