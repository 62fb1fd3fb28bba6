"""Equal places, on one map or several: where the map is as it is at a place, at any turn and scale, is its rival."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import shapely
from shapely import affinity
from worlds.scenes import PLANE, camera, estimator_of, look, random_lines, scene_of

from roadgeo.geometry.homography import Homography
from roadgeo.location import Seconds
from roadgeo.matching.index import build_index
from roadgeo.matching.methods import search_references
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.parts import Whole
from roadgeo.matching.place import Place
from roadgeo.matching.scene import Query
from roadgeo.matching.shifts import shifted
from roadgeo.matching.verdict import _stand_out, decide
from roadgeo.roads.network import build_network

TRUTH = camera((800, 800), (900, 900), 1.0, 0.0, 0.0, 25.0)


def turned(scale, turn_deg, east_m):
    """A turn about the origin, a scale and a shift, as shapely takes them."""
    turn = np.radians(turn_deg)
    a, b = scale * np.cos(turn), scale * np.sin(turn)
    return [a, -b, b, a, east_m, 0.0]


@pytest.fixture(scope="module")
def twice():
    """A district, once more 1.2 times as large and turned by 37 degrees, and the middle of the frame there."""
    lines = random_lines(31, 1600.0)
    again = [affinity.affine_transform(line, turned(1.2, 37.0, 4000.0)) for line in lines]
    network = build_network(lines + again, PLANE, {"name": "twice"})
    graph = look(build_network(lines, PLANE, {"name": "once"}), TRUTH, (900, 900))
    scene = scene_of(graph, (900, 900))
    middle = shapely.Point(Homography(TRUTH).everywhere(scene.center))
    there = shapely.get_coordinates(affinity.affine_transform(middle, turned(1.2, 37.0, 4000.0)))[0]
    return Query("frame", scene, graph, Seconds()), build_index(network), there


def test_where_the_map_is_as_it_is_at_a_place_is_verified_once(twice):
    query, index, there = twice
    estimator = estimator_of(query.scene, index)
    place, _ = estimator.settle(Place(query.scene, index, TRUTH))
    assert not estimator.look_for_equals(place, deadline=0.0)
    assert not any(np.hypot(*(other.center - there)) < 5.0 for other in estimator.verified)
    anchors, work = estimator.n_anchors, estimator.work
    assert estimator.look_for_equals(place)
    assert any(np.hypot(*(other.center - there)) < 5.0 for other in estimator.verified)
    assert estimator.n_anchors == anchors  # no intersection of the query was looked up
    assert estimator.work > work + 12 * 1e-4  # but the work is counted
    n_verified = estimator.n_verified
    estimator.look_for_equals(place)
    assert estimator.n_verified == n_verified


def test_equal_places_on_other_maps_are_verified_too(twice):
    query, _, there = twice
    lines = random_lines(31, 1600.0)
    again = [affinity.affine_transform(line, turned(1.2, 37.0, 4000.0)) for line in lines]
    here, other, third = (
        estimator_of(query.scene, build_index(build_network(some, PLANE, {"name": name})))
        for name, some in (("here", lines), ("other", again), ("third", random_lines(32, 1600.0)))
    )
    place, _ = here.settle(Place(query.scene, here.index, TRUTH))
    assert here.look_for_equals(place, beside=[third, other])
    assert any(np.hypot(*(found.center - there)) < 5.0 for found in other.verified)
    assert not any(found.log10_likelihood > 0.5 * place.log10_likelihood for found in third.verified)


def test_an_equal_place_that_the_hints_exclude_is_no_rival(twice):
    query, index, there = twice
    center = Homography(TRUTH).everywhere(query.scene.center)
    reach_m = np.hypot(*(there - center)) - 200.0  # its first guess may lie within a frame of the circle
    estimator = estimator_of(query.scene, index, near=(*center, reach_m))
    place, _ = estimator.settle(Place(query.scene, index, TRUTH))
    estimator.look_for_equals(place)
    assert estimator.n_hypotheses > 0
    assert all(np.hypot(*(other.center - center)) < reach_m for other in estimator.verified)


def test_places_that_are_equal_but_for_turn_and_scale_are_ambiguous(twice):
    query, index, _ = twice
    options = LocateOptions()
    location = decide(query, search_references(query, [Whole(index)], options, 60.0), options)
    assert location.status == "ambiguous"


@pytest.mark.parametrize(
    ("likelihoods", "others", "stand_out"),
    [
        ((8.0, 7.5), [], True),
        ((8.0, 6.5), [], False),  # explains too little
        ((20.0, 16.8), [-9.0], True),
        ((20.0, 16.2), [-9.0], False),  # explains less than the best
        ((20.0, 19.9), [-3.8], True),
        ((20.0, 19.9), [-3.2], False),  # one of many
    ],
)
def test_two_places_stand_out_that_explain_much_and_alike_and_more_than_all_others(likelihoods, others, stand_out):
    index = SimpleNamespace(is_of_map=lambda _: True)
    best, rival = (SimpleNamespace(log10_likelihood=worth, score=-0.1, index=index) for worth in likelihoods)
    assert _stand_out(best, rival, [SimpleNamespace(score=score) for score in others], 3.5) is stand_out


def test_what_a_mask_lacks_and_shows_falsely_hides_no_equal_place(twice):
    """No intersection of the mask is one of the map's: the map's own are looked up."""
    query, index, there = twice
    scene = query.scene
    wrong = replace(scene.intersections, tangents=scene.intersections.tangents[::-1].copy())
    worn = replace(scene, intersections=wrong, branches=scene.branches[::-1].copy())
    estimator = estimator_of(worn, index)
    place, _ = estimator.settle(Place(worn, index, TRUTH))
    estimator.look_for_equals(place)
    assert any(np.hypot(*(other.center - there)) < 5.0 for other in estimator.verified)
    n_equal = sum(np.hypot(*(other.center - there)) < 5.0 for other in estimator.verified)
    assert n_equal <= 2  # as it was met, and refined to the end: others are not crowded out


def test_where_the_map_has_no_intersections_nothing_is_looked_up(twice):
    query, index, _ = twice
    nowhere = Place(query.scene, index, shifted(TRUTH, 90_000.0, 0.0))
    estimator = estimator_of(query.scene, index)
    assert estimator.look_for_equals(nowhere)
    assert estimator.verified == []
