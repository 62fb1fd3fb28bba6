"""An image is placed by points that its user gives, as they are; nothing is searched."""

import numpy as np
import pytest
from worlds.answers import placed

from roadgeo.errors import MaskError, Reason
from roadgeo.geometry.projection import to_lonlat
from roadgeo.location import Content, Location
from roadgeo.reference.reference import Reference
from roadgeo.running.choosing import place_by_points, take_place

SIZE = (900, 600)
PIXELS = np.array([(100.0, 80.0), (820.0, 120.0), (700.0, 540.0), (150.0, 500.0), (450.0, 300.0)])


@pytest.fixture
def refused():
    return Location("q", "not_located", "why", "town", content=Content(SIZE))


def points_of(index, matrix, n):
    """So many points of an image that lies on the map as a homography (3, 3) to the map's plane has it."""
    mapped = np.c_[PIXELS[:n], np.ones(n)] @ np.array(matrix).T
    lonlat = to_lonlat(index.plane.crs, index.plane.to_crs(mapped[:, :2] / mapped[:, 2:]))
    return np.c_[PIXELS[:n], lonlat]


H = np.array([[2.0, 0.0, 500_000.0], [0.0, -2.0, 5_500_000.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize(
    ("number", "code", "said"),
    [
        (1, Reason.NOTHING_STANDS_OUT, "chosen by you: place 1 of 2; the score is 9.0"),
        (1, Reason.FITS_ELSEWHERE, "chosen by you: place 1 of 2, which the hints exclude; the score is 9.0"),
        (2, Reason.FITS_ELSEWHERE, "chosen by you: place 2 of 2; the score is 1.0, 3.5 is asked for"),
    ],
)
def test_a_place_that_is_taken_says_what_spoke_against_it(number, code, said):
    places = tuple(placed(H, "EPSG:32632", score=score) for score in (9.0, 1.0))
    assert take_place(Location("q", "not_located", "why", places=places, reason_code=code), number).reason == said


LEVEL = [[0.5, 0.1, 100.0], [0.1, -0.5, 300.0], [0.0, 0.0, 1.0]]
TILTED = [[0.5, 0.1, 100.0], [0.1, -0.5, 300.0], [1e-4, 2e-4, 1.0]]


@pytest.mark.parametrize(("n", "matrix"), [(3, LEVEL), (4, TILTED), (5, TILTED)])
def test_three_points_or_more_place_the_image_as_they_are(town, refused, n, matrix):
    network, index = town
    points = points_of(index, matrix, n)
    placed = place_by_points(refused, points, [Reference(index, network)])
    assert (placed.status, placed.reason_code.value, placed.reference) == ("chosen", "chosen", index.name)
    checked = "; they are off by 0.0 m (root mean square)"
    unchecked = ": nothing checks them, for so few fit any picture exactly; give five or more"
    assert placed.reason == f"placed by {n} points, as given{checked if n > 4 else unchecked}"
    there = to_lonlat(placed.crs, placed.pixel_to_map(points[:, :2]))
    assert np.abs(there - points[:, 2:]).max() < 1e-8
    assert placed.to_dict()["log10_odds"] is None


@pytest.mark.parametrize(
    ("n", "change", "said"),
    [
        (3, lambda points: np.c_[points[:, :1], points[:, :1], points[:, 2:]], "lie on a line"),
        (3, lambda points: points[[0, 0, 0]], "lie on a line"),
        (3, lambda points: np.c_[points[:, :2], points[[1, 0, 2], 2:]], "exchanged"),
        (4, lambda points: np.c_[points[:, :2], points[[1, 0, 2, 3], 2:]], "exchanged"),
    ],
)
def test_points_that_no_camera_saw_are_refused(town, refused, n, change, said):
    network, index = town
    with pytest.raises(MaskError, match=said):
        place_by_points(refused, change(points_of(index, LEVEL, n)), [Reference(index, network)])
