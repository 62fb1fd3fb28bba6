"""Motion between frames: files, photographs, masks."""

from itertools import pairwise

import cv2
import numpy as np
import pytest

from examples.simulated_flights import FlightOptions, simulate_flight
from roadgeo.errors import RoadSourceError
from roadgeo.evaluation.landscape import Landscape
from roadgeo.flights.motion import (
    Odometer,
    TracedMask,
    between_images,
    between_masks,
    read_motion,
)
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.mask import RoadMask

MOTION = np.array([[0.99, 0.03, 12.0], [-0.03, 1.01, -80.0], [1e-5, -2e-5, 1.0]])
CORNERS = np.array([[0.0, 0.0], [320, 0], [320, 240], [0, 240]])


def seen(before, motion):
    """What the next frame shows of the ground that `before` shows."""
    half = np.array([[1.0, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    warp = np.linalg.inv(half) @ motion @ half
    return cv2.warpPerspective(before, warp, before.shape[::-1], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)


def gap(found, truth):
    return np.hypot(*(Homography(found)(CORNERS) - Homography(truth)(CORNERS)).T).max()


def test_photographs_tell_it_to_a_pixel():
    rng = np.random.default_rng(1)
    ground = cv2.resize(rng.integers(0, 255, (60, 80)).astype(np.uint8), (320, 240), interpolation=cv2.INTER_CUBIC)
    found = between_images(ground, seen(ground, MOTION))
    assert found is not None
    assert gap(found, MOTION) < 1.0


def test_photographs_of_other_places_tell_nothing():
    rng = np.random.default_rng(1)
    first, other = rng.integers(0, 255, (2, 240, 320)).astype(np.uint8)
    assert between_images(first, other) is None
    assert between_images(np.zeros((240, 320), np.uint8), first) is None


def streets():
    mask = np.zeros((240, 320), np.uint8)
    for a, b in (((0, 40), (320, 70)), ((60, 0), (90, 240)), ((200, 0), (180, 240)), ((0, 170), (320, 130)),
                 ((90, 150), (160, 240)), ((250, 60), (320, 20))):  # fmt: skip
        cv2.line(mask, a, b, 255, 9)
    return mask


def test_masks_tell_it_roughly():
    before = streets()
    motion = np.array([[0.998, 0.03, 5.0], [-0.03, 0.998, -50.0], [0.0, 0.0, 1.0]])
    after = seen(before, motion)
    found = between_masks(*map(TracedMask.of, (RoadMask(before > 127), RoadMask(after > 127))))
    assert found is not None
    assert gap(found, motion) < 8.0


def lattice(left, top):
    """A frame of streets that repeat every 60 pixels."""
    columns, rows = np.arange(left, left + 320)[None], np.arange(top, top + 240)[:, None]
    return RoadMask((columns % 60 < 9) | (rows % 60 < 9))


def test_masks_whose_streets_repeat_tell_it_only_to_who_knows_how_the_frame_before_moved():
    before, after = map(TracedMask.of, (lattice(0, 0), lattice(3, -85)))
    assert between_masks(before, after) is None
    last = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, -80.0], [0.0, 0.0, 1.0]])
    found = between_masks(before, after, last)
    assert found is not None
    assert gap(found, np.array([[1.0, 0.0, 3.0], [0.0, 1.0, -85.0], [0.0, 0.0, 1.0]])) < 5.0


def test_a_flight_goes_on_as_it_went_for_two_frames_that_tell_nothing():
    motion = np.array([[0.998, 0.03, 5.0], [-0.03, 0.998, -50.0], [0.0, 0.0, 1.0]])
    first, second = RoadMask(streets() > 127), RoadMask(seen(streets(), motion) > 127)
    blank, odometer = [RoadMask(np.zeros((240, 320), bool)) for _ in range(3)], Odometer()
    known, sigma = odometer.move(first, second)
    assert gap(known, motion) < 8.0
    for before, after in pairwise([second, *blank[:2]]):
        held, unsure = odometer.move(before, after)
        assert np.array_equal(held, known)
        assert unsure > sigma
    assert odometer.move(blank[1], blank[2])[0] is None
    assert odometer.move(blank[2], first)[0] is None


def test_masks_of_a_flight_tell_it_frame_by_frame(town):
    options = FlightOptions(
        size_px=(500, 400), n_frames=(10, 10), gsd_m=(0.6, 0.7), turn_deg=1.0, intersections=(2, 12)
    )
    flown = simulate_flight(Landscape.from_network(town[0]), options, 2)
    masks, middle, odometer = [RoadMask(mask > 127) for mask in flown.masks()], np.array([250.0, 200.0]), Odometer()
    off = []
    for k in range(1, 10):
        found, _ = odometer.move(masks[k - 1], masks[k])
        if found is not None:
            truth = flown.views[k - 1].homography.inverse()(flown.views[k].homography(middle))
            off.append(np.hypot(*(Homography(found)(middle) - truth)))
    assert len(off) >= 7
    assert np.median(off) < 5.0
    assert max(off) < 50.0


def test_masks_without_roads_tell_nothing():
    blank = RoadMask(np.zeros((240, 320), bool))
    assert TracedMask.of(blank) is None
    assert Odometer().move(blank, RoadMask(streets() > 127))[0] is None


def write_motion(names, motion):
    """The table that `read_motion` reads."""
    columns = ",".join(f"h{i}{j}" for i in range(3) for j in range(3))
    rows = [",".join([name, *map(repr, np.ravel(matrix).tolist())]) for name, matrix in zip(names, motion, strict=True)]
    return "\n".join([f"frame,{columns}", *rows])


def test_a_file_is_read_as_it_was_written(tmp_path):
    path = tmp_path / "motion.csv"
    path.write_text(write_motion(["a.png", "b.png"], [np.eye(3), MOTION]))
    assert np.array_equal(read_motion(path)["b.png"], MOTION)


@pytest.mark.parametrize(
    "text",
    [
        "",
        f"frame,h00\n{'x' * 200_000},1\n",
        "frame,h00\na,1\n",
        "frame,h00,h01,h02,h10,h11,h12,h20,h21,h22\na,0,0,0,0,0,0,0,0,0\n",
        "\0\xff",
    ],
)
def test_other_files_are_refused(tmp_path, text):
    path = tmp_path / "motion.csv"
    path.write_text(text)
    with pytest.raises(RoadSourceError):
        read_motion(path)
