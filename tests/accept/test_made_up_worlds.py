"""Small worlds whose truth is known, through what `import roadgeo` offers: what must be found, and what must not."""

import functools

import cv2
import numpy as np
import pytest
from worlds.drawn import ORIGIN, draw, lattice, mapped, roads_of, town, view

import roadgeo

SIZE = (1000, 1000)
BESIDE = np.array([4000.0, 0.0])


@pytest.fixture(scope="module")
def known():
    """A town of 3.6 x 3.6 km, and its reference."""
    streets = town(1)
    return streets, roadgeo.index(roads_of(streets))


def miss(found, matrix, size=SIZE):
    """Return how far the frame's middle and its farthest corner lie from the truth, metres."""
    width, height = size
    points = np.array([[width / 2, height / 2], [0, 0], [width, 0], [width, height], [0, height]], float)
    there = mapped(np.array(found.homography), points) - ORIGIN
    off = np.hypot(*(there - mapped(matrix, points)).T)
    return off[0], off[1:].max()


def refused(found):
    return found.status in {"not_located", "ambiguous"}


@pytest.mark.parametrize(
    ("seen", "wear", "off_m"),
    [
        ({}, {}, 1.0),
        ({"heading_deg": 123.0, "gsd_m": 0.8}, {"missing": 0.1, "false": 0.05}, 2.0),
        ({"heading_deg": 250.0}, {"missing": 0.4, "false": 0.1}, 5.0),
        ({"heading_deg": 70.0, "tilt_deg": 30.0}, {"missing": 0.1, "false": 0.05}, 5.0),
        ({"heading_deg": 10.0, "tilt_deg": 45.0}, {}, 10.0),
        ({"heading_deg": 200.0, "gsd_m": 0.5}, {}, 2.0),
        ({"heading_deg": 300.0, "gsd_m": 0.5}, {"missing": 0.15, "false": 0.05}, 5.0),
    ],
    ids=["clean", "mild", "noisy", "tilted", "steep", "500 m", "500 m worn"],
)
def test_a_mask_of_the_town_is_located(known, seen, wear, off_m):
    streets, reference = known
    truth = view((1700.0, 1900.0), SIZE, **seen)
    found = roadgeo.locate(draw(streets, truth, SIZE, gsd_m=seen.get("gsd_m", 1.0), seed=3, **wear), reference)
    assert found.status == "located", found.reason
    middle, corner = miss(found, truth)
    assert middle < off_m
    assert corner < 3.0 * off_m


@pytest.mark.parametrize("heading", [0.0, 35.0, 160.0])
def test_a_mask_that_is_turned_over_is_refused(known, heading):
    streets, reference = known
    mask = draw(streets, view((1700.0, 1900.0), SIZE, heading_deg=heading), SIZE)
    assert refused(roadgeo.locate(np.ascontiguousarray(mask[:, ::-1]), reference))


@pytest.mark.parametrize("seed", [2, 3, 4])
@pytest.mark.parametrize("gsd", [0.5, 1.0])
def test_a_mask_of_another_town_is_refused(known, seed, gsd):
    truth = view((1800.0, 1800.0), SIZE, gsd, heading_deg=40.0 * seed)
    assert refused(roadgeo.locate(draw(town(seed), truth, SIZE, gsd_m=gsd, missing=0.05), known[1]))


@pytest.mark.parametrize(("share", "located"), [(0.25, False), (0.75, True)])
def test_a_piece_that_fits_is_no_place_where_most_of_the_frame_does_not(known, share, located):
    """Ground that is cut out of the map, or a quarter that is like its mirror image: a part of the frame is there."""
    streets, reference = known
    truth = view((1700.0, 1900.0), (1300, 1300), heading_deg=40.0)
    mask, strange = (draw(some, truth, (1300, 1300)) for some in (streets, town(2)))
    kept = int(share * 1300)
    mask[:, kept:] = strange[:, kept:]
    found = roadgeo.locate(mask, reference)
    assert (found.status == "located") == located, found.reason
    assert not located or miss(found, truth, (1300, 1300))[0] < 5.0


def test_ground_that_was_cut_out_of_the_map_is_refused():
    """Roads reach into the frame from two sides; its middle is not on the map."""
    streets = town(5)
    kept = [street for street in streets if not 1300.0 < street[:, 0].mean() < 2300.0]
    reference = roadgeo.index(roads_of(kept))
    for heading in (0.0, 100.0):
        mask = draw(streets, view((1800.0, 1800.0), (1100, 1100), heading_deg=heading), (1100, 1100))
        assert refused(roadgeo.locate(mask, reference))


class TestTwins:
    """Two quarters of a map that are alike."""

    @pytest.fixture(scope="class")
    @staticmethod
    def twin():
        """A town, and a copy of its middle beside it, 1.4 km wide, in another one."""
        streets, other = town(6), town(7)
        around = [street + BESIDE for street in other if not self_box(street)]
        copy = [street + BESIDE for street in streets if self_box(street)]
        return streets, roadgeo.index(roads_of([*streets, *around, *copy]))

    def test_what_fits_both_is_ambiguous(self, twin):
        streets, reference = twin
        mask = draw(streets, view((1800.0, 1800.0), (800, 800), heading_deg=20.0), (800, 800), missing=0.05, false=0.02)
        found = roadgeo.locate(mask, reference)
        assert found.status == "ambiguous", found.reason

    def test_what_lies_beyond_tells_them_apart(self, twin):
        streets, reference = twin
        truth = view((1100.0, 1800.0), (1200, 1200), heading_deg=20.0)
        found = roadgeo.locate(draw(streets, truth, (1200, 1200)), reference)
        assert found.status == "located", found.reason
        assert miss(found, truth, (1200, 1200))[0] < 2.0


def self_box(street):
    """Whether a street lies in the square of 1.4 km that both quarters share."""
    return bool((np.abs(street.mean(axis=0) - 1800.0) < 700.0).all())


@functools.cache
def map_of(seed, kept):
    return roadgeo.index(roads_of(lattice(seed, kept)))


class TestLattices:
    """Equal blocks: chance nearby is other blocks, and whole blocks are the same everywhere."""

    def test_a_lattice_without_gaps_has_no_place(self):
        streets = lattice(1, 1.0)
        mask = draw(streets, view((1600.0, 1500.0), (700, 700), heading_deg=15.0), (700, 700))
        assert refused(roadgeo.locate(mask, map_of(1, 1.0)))

    @pytest.mark.parametrize(("kept", "wear"), [(0.8, {}), (0.9, {}), (0.85, {"missing": 0.1, "false": 0.03})])
    def test_gaps_tell_where_it_is(self, kept, wear):
        streets = lattice(5, kept)
        truth = view((1600.0, 1500.0), (1200, 1200), heading_deg=15.0)
        found = roadgeo.locate(draw(streets, truth, (1200, 1200), **wear), map_of(5, kept))
        assert found.status == "located", found.reason
        assert miss(found, truth, (1200, 1200))[0] < 5.0

    @pytest.mark.parametrize(("kept", "size"), [(0.8, (1100, 1100)), (0.9, (600, 600)), (0.97, (1100, 1100))])
    def test_a_lattice_with_other_gaps_is_another_one(self, kept, size):
        """As a mask of Portland fitted a piece of Chicago's lattice, with 10^6."""
        mask = draw(lattice(6, kept), view((1600.0, 1500.0), size, heading_deg=15.0), size)
        assert refused(roadgeo.locate(mask, map_of(5, kept)))


@pytest.mark.parametrize("gsd", [4.0, 8.0])
@pytest.mark.parametrize("seed", [8, 9])
def test_main_roads_of_a_region_do_not_lie_in_a_corner_of_a_town(known, gsd, seed):
    """A mask of main roads was located in a frame of 180 m at 10^5: what few roads the map has there agreed."""
    region = town(seed, 30_000.0, 1200.0)
    truth = view((15_000.0, 15_000.0), SIZE, gsd, heading_deg=30.0 * seed)
    assert refused(roadgeo.locate(draw(region, truth, SIZE, width_m=24.0, gsd_m=gsd), known[1]))


@pytest.mark.parametrize("ends", [((0, 300), (999, 700)), ((500, 0), (500, 999))])
def test_one_road_has_no_place(known, ends):
    mask = cv2.line(np.zeros(SIZE, np.uint8), *ends, 255, 9)
    assert refused(roadgeo.locate(mask, known[1]))
