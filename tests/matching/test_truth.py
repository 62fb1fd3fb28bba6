"""The stage that lost the true place is the first that it did not come out of."""

import math
from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest
from worlds.scenes import PLANE, random_network

from roadgeo.geometry.camera import CameraFault, CameraOptions
from roadgeo.geometry.placement import Placement
from roadgeo.geometry.projection import to_lonlat
from roadgeo.location import Location
from roadgeo.matching.index import build_index
from roadgeo.matching.methods import Searched
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.truth import _TruePlace, tell_truth

REFUSED = Location("q", "not_located", "")


@pytest.fixture(scope="module")
def estimator():
    """What a record asks of an estimator: the map, the frame (of 1000 pixels) and the camera."""
    scene = SimpleNamespace(half_size=707.0, size=(1000, 1000))
    return SimpleNamespace(
        index=build_index(random_network(1, 1000.0)), scene=scene, options=SimpleNamespace(camera=CameraOptions())
    )


def lonlat(x, y):
    return tuple(to_lonlat(PLANE.crs, PLANE.to_crs(np.array([[x, y]])))[0])


def story_of(estimator, met=(), best=-math.inf, at=(500.0, 500.0), answer=REFUSED):
    faults = [CameraFault.TILT, CameraFault.SKEW, CameraFault.TILT] if "camera" in met else []
    return _TruePlace(estimator, lonlat(*at)).story(dict(Counter(met)), faults, best, answer, 3.0)


@pytest.mark.parametrize(
    ("met", "lost_at", "said"),
    [
        ([], "proposals", "was never proposed"),
        (["proposals"], "on_roads", "the roads around the intersection did not agree"),
        (["proposals", "on_roads"], "survived", "what was followed outwards from there did not fit"),
        (["proposals", "on_roads", "survived"], "verified", "was not among the best of its intersection"),
        (["survived", "verified"], "verified", "could not be refined"),
        (["survived", "camera"], "camera", "refused it: tilt out of range, no camera sees a plane so"),
    ],
)
def test_the_first_stage_that_it_did_not_come_out_of(estimator, met, lost_at, said):
    story = story_of(estimator, met)
    assert story.lost_at == lost_at
    assert said in story.said
    assert story.log10_odds is None
    assert {stage for stage, n in story.counts.items() if n} == set(met)


def place(x, y):
    place = Placement((1000, 1000), PLANE, np.array([[1.0, 0.0, x - 500.0], [0.0, -1.0, y + 500.0], [0.0, 0.0, 1.0]]))
    return Location("q", "located", "", places=(place,))


@pytest.mark.parametrize(
    ("best", "answer", "lost_at", "said"),
    [
        (2.5, REFUSED, "odds", "reached a score of 2.5, 3 are needed"),
        (9.0, REFUSED, "rival", "reached a score of 9.0, but another place as much"),
        (9.0, place(5000.0, 500.0), "rival", "but another place as much"),
        (9.0, place(520.0, 500.0), None, "reached a score of 9.0 and was located"),
        (-1.0, place(520.0, 500.0), None, "score of -1.0, but leads any other place where these streets repeat"),
    ],
)
def test_what_was_measured_is_weighed(estimator, best, answer, lost_at, said):
    story = story_of(estimator, ["verified"], best, answer=answer)
    assert (story.lost_at, story.log10_odds) == (lost_at, best)
    assert said in story.said


def test_off_the_map_nothing_else_counts(estimator):
    story = story_of(estimator, ["proposals"], at=(90_000.0, 500.0))
    assert (story.lost_at, story.said) == ("map", "the true place lies off the map that was searched")


def test_where_nothing_was_searched_it_is_said(estimator):
    story = tell_truth((-71.0, 42.0), Searched(estimator.index), REFUSED, LocateOptions())
    assert (story.lost_at, story.said) == ("map", "the true place: nothing was searched")
