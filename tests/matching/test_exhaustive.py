"""The roads of a scene laid everywhere on a map, where heading and scale are told."""

import numpy as np
import pytest
from worlds.scenes import camera, look, random_network, scene_of

from roadgeo.geometry.camera import CameraOptions
from roadgeo.geometry.homography import Homography
from roadgeo.matching.exhaustive import is_told, propose_everywhere
from roadgeo.matching.index import build_index

SIZE = (900, 900)
MIDDLE = (2600.0, 1400.0)


@pytest.fixture(scope="module")
def world():
    """A town, a view of it at 1 m per pixel whose up points 203 degrees from north, and the view's place."""
    network = random_network(4, 5000.0)
    truth = camera(MIDDLE, SIZE, 1.0, heading_deg=203.0)
    return scene_of(look(network, truth, SIZE), SIZE), build_index(network), truth


def middles(scene, places):
    return np.array([Homography(place).everywhere(scene.center) for place in places]).reshape(-1, 2)


@pytest.mark.parametrize(("heading", "gsd"), [((200.0, 5.0), (0.92, 1.12)), ((207.0, 5.0), (0.9, 1.02))])
def test_the_place_is_the_first_wherever_it_lies_on_the_map(world, heading, gsd):
    scene, index, truth = world
    told = CameraOptions(gsd_m=gsd, heading_deg=heading)
    assert is_told(told)
    found = middles(scene, propose_everywhere(scene, index, told))
    there = Homography(truth).everywhere(scene.center)
    assert np.hypot(*(found[0] - there)) < 15.0


def test_nothing_is_proposed_outside_the_circle_that_is_given(world):
    scene, index, _ = world
    told = CameraOptions(gsd_m=(0.95, 1.05), heading_deg=(203.0, 5.0))
    x, y = Homography(world[2]).everywhere(scene.center)
    assert list(propose_everywhere(scene, index, told, (x + 20_000.0, y, 500.0))) == []
    near = middles(scene, propose_everywhere(scene, index, told, (x + 100.0, y, 300.0)))
    assert np.hypot(*(near[0] - (x, y))) < 15.0
