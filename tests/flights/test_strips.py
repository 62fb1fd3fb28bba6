"""Frames in no order are linked, solved together and placed."""

import cv2
import numpy as np
import pytest

from examples.simulated_flights import FlightOptions, simulate_flight
from roadgeo.evaluation.landscape import Landscape
from roadgeo.flights.motion import TracedMask, overlay
from roadgeo.flights.strips import Link, adjust, find_nets, place_strips
from roadgeo.flights.tracker import FlightFrame
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.mask import RoadMask
from roadgeo.reference.reference import Reference

STRIP = FlightOptions(
    size_px=(500, 500), n_frames=(6, 6), gsd_m=(1.0, 1.2), tilt_deg=(0.0, 3.0), turn_deg=1.0, intersections=(4, 90)
)
ORDER = [3, 0, 5, 1, 4, 2]


@pytest.fixture(scope="module")
def strip(town):
    network, index = town
    flight = simulate_flight(Landscape.from_network(network), STRIP, 2)
    masks = [RoadMask(mask > 127) for mask in flight.masks()]
    return flight, masks, Reference(index, network)


def errors(tracked, flight):
    """How far each frame's middle lies from the truth, metres."""
    return [
        np.hypot(
            *(sighting.pose.center - flight.views[int(sighting.frame.name)].homography(sighting.frame.frame.center))
        )
        for sighting in tracked
    ]


def shuffled(masks):
    return [FlightFrame(n, str(k), float(n), masks[k]) for n, k in enumerate(ORDER)]


def test_masks_in_no_order_are_placed_in_that_of_the_strip(strip):
    flight, masks, reference = strip
    tracked = place_strips([(item, None) for item in shuffled(masks)], [reference])
    assert {sighting.status for sighting in tracked} == {"located"}
    assert [sighting.frame.name for sighting in tracked] == ["0", "1", "2", "3", "4", "5"]
    assert [sighting.frame.number for sighting in tracked] == list(range(6))
    assert max(errors(tracked, flight)) < 4.0


def test_a_frame_that_was_scanned_upside_down_and_one_from_elsewhere(strip):
    flight, masks, reference = strip
    other = np.zeros((500, 500), bool)
    other[240:250] = other[:, 100:110] = other[:, 400:410] = True
    turned = [RoadMask(masks[2].roads[::-1, ::-1].copy()) if k == 2 else mask for k, mask in enumerate(masks)]
    frames = [*shuffled(turned), FlightFrame(6, "elsewhere", 6.0, RoadMask(other))]
    tracked = place_strips([(frame, None) for frame in frames], [reference])
    assert [sighting.frame.name for sighting in tracked if sighting.status == "lost"] == ["elsewhere"]
    placed = [sighting for sighting in tracked if sighting.status == "located"]
    assert len(placed) == 6
    assert max(errors(placed, flight)) < 4.0


def test_pictures_link_frames_that_their_roads_do_not(strip):
    flight, masks, reference = strip
    rng = np.random.default_rng(0)
    ground = cv2.GaussianBlur(rng.uniform(0, 255, (1500, 1500)).astype(np.float32), (0, 0), 2.0)
    ground = cv2.normalize(ground, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    low = np.min([view.footprint.min(axis=0) for view in flight.views], axis=0) - 20.0
    to_ground = np.array([[0.5, 0.0, -0.5 * low[0]], [0.0, 0.5, -0.5 * low[1]], [0.0, 0.0, 1.0]])
    greys = [
        cv2.warpPerspective(ground, np.linalg.inv(to_ground @ view.homography.matrix), (500, 500))
        for view in flight.views
    ]
    bare = [RoadMask(mask.roads & (np.arange(500) % 250 < 150)) for mask in masks]  # stripes without any road
    frames = [(FlightFrame(n, str(k), float(n), bare[k]), greys[k]) for n, k in enumerate(ORDER)]
    tracked = place_strips(frames, [reference])
    assert [sighting.frame.name for sighting in tracked] == ["0", "1", "2", "3", "4", "5"]
    assert all(sighting.status != "lost" for sighting in tracked)
    assert max(errors(tracked, flight)) < 6.0


def test_neighbours_are_laid_on_each_other_and_frames_far_apart_are_not(strip):
    flight, masks, _ = strip
    traced = [TracedMask.of(masks[k]) for k in (0, 1, 4)]
    motion, sure = overlay(traced[0], traced[1])[0]
    exact = flight.views[0].homography.inverse() @ flight.views[1].homography
    corners = Frame(500, 500).corners
    assert np.abs(Homography(motion)(corners) - exact(corners)).max() < 15.0
    assert 0.2 < sure < 1.0
    assert overlay(traced[0], traced[2]) == []


def test_all_links_are_heeded_and_one_that_contradicts_the_others_is_not():
    frame = Frame(400, 300)
    truth = [np.array([[1.0, 0.02 * k, 150.0 * k], [-0.02 * k, 1.0, 8.0 * k], [1e-5 * k, 0.0, 1.0]]) for k in range(5)]
    rng = np.random.default_rng(1)

    def link(i, j, weight=1.0):
        exact = np.linalg.inv(truth[i]) @ truth[j]
        corners = Homography(exact)(frame.corners) + rng.normal(0.0, 0.5, (4, 2))
        return Link(
            i, j, cv2.getPerspectiveTransform(frame.corners.astype(np.float32), corners.astype(np.float32)), weight
        )

    good = [link(i, j) for i in range(5) for j in range(i + 1, min(i + 3, 5))]
    wrong = Link(0, 4, np.eye(3), 0.4)
    ((net, matrices),) = find_nets([frame] * 5, [*good, wrong])
    assert sorted(net) == list(range(5))

    def worst(found):
        to_truth = truth[net[0]] @ np.linalg.inv(found[0])
        return max(
            np.abs(Homography(to_truth @ result)(frame.corners) - Homography(truth[k])(frame.corners)).max()
            for k, result in zip(net, found, strict=True)
        )

    assert worst(matrices) < 6.0
    chained = [np.eye(3)]
    for k in range(4):
        chained.append(chained[-1] @ next(link.motion for link in good if (link.first, link.other) == (k, k + 1)))
    net = list(range(5))
    adjusted = adjust(chained, frame, good)
    assert worst(adjusted) < worst(chained)


def test_nothing_overlaps():
    frames = [Frame(100, 80)] * 3
    assert [net for net, _ in find_nets(frames, [])] == [[0], [1], [2]]
