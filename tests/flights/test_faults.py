"""Flights whose link fails: frames that are repeated or missing, and an aircraft that is displaced meanwhile."""

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from flights.conftest import OPTIONS

from examples.simulated_flights import simulate_flight, with_fault
from roadgeo.evaluation.landscape import Landscape
from roadgeo.flights.mavlink import fix_of
from roadgeo.flights.motion import Odometer
from roadgeo.flights.rows import make_rows
from roadgeo.flights.tracker import FlightFrame, Tracker
from roadgeo.geometry.mask import RoadMask
from roadgeo.reference.reference import Reference

pytestmark = pytest.mark.slow

VIDEO = replace(OPTIONS, size_px=(500, 400), n_frames=(20, 20), overlap=0.93)


@pytest.fixture(scope="module")
def video(town):
    """Twenty frames, each of which moves by a fourteenth of the height, and the reference."""
    network, index = town
    return simulate_flight(Landscape.from_network(network), VIDEO, 2), Reference(index, network)


def frames_of(flight, held=None):
    """Yield frames with the motion of their masks; the frame `held` goes on as the one before did."""
    odometer, before, motion, error_px = Odometer(), None, None, 1.5
    for k, picture in enumerate(flight.masks()):
        mask = RoadMask(picture > 127)
        if before is not None and k != held:
            motion, error_px = odometer.move(before, mask)
        yield FlightFrame(k, str(k), float(k), mask, motion, error_px)
        before = mask


def followed(flight, reference, **how):
    """Follow a flight; return the last state of each frame, and its distance from the truth in standard deviations."""
    tracker = Tracker([reference])
    known = {state.frame.number: state for frame in frames_of(flight, **how) for state in tracker.feed(frame)}
    states = [known[k] for k in sorted(known)]
    truths = [view.homography(state.frame.frame.center) for view, state in zip(flight.views, states, strict=True)]
    off = [
        0.0 if state.pose is None else float(np.hypot(*(state.pose.center - truth))) / state.pose.sigma_m
        for state, truth in zip(states, truths, strict=True)
    ]
    return states, off


@pytest.mark.parametrize(
    ("fault", "at", "length"), [("frozen", 0, 6), ("frozen", 8, 4), ("slipped", 9, 3), ("missing", 8, 5)]
)
def test_a_flight_whose_link_fails_is_followed_or_lost_and_found_again(video, fault, at, length):
    flight, reference = video
    states, off = followed(with_fault(flight, fault, at, length), reference)
    assert max(off) < 5.0
    assert [state.status for state in states[-3:]] == ["tracked"] * 3


def test_a_jump_that_its_motion_does_not_show_is_noticed_by_the_fall_of_agreement(video):
    flight, reference = video
    states, off = followed(with_fault(flight, "missing", 9, 4), reference, held=9)
    assert max(off) < 5.0
    assert states[9].status == "located"
    assert "agree" in states[9].reason
    assert [state.status for state in states[-3:]] == ["tracked"] * 3


def test_a_place_that_the_roads_contradict_is_not_sent(video, monkeypatch):
    """Where nothing around stands out, either."""
    flight, reference = video
    monkeypatch.setattr(Tracker, "_search_around", lambda *_: None)
    tracker = Tracker([reference])
    frames = islice(frames_of(with_fault(flight, "missing", 9, 4), held=9), 12)
    first = [tracker.feed(frame)[-1] for frame in frames]
    assert [state.status for state in first[8:12]] == ["tracked", "predicted", "predicted", "lost"]
    assert [fix_of(row.to_dict(), 0.0) for row in make_rows(first[9:12])] == [None] * 3


def test_a_frame_that_equals_the_last_did_not_move_and_the_flight_goes_on_after_it(video):
    flight, _ = video
    masks = [RoadMask(picture > 127) for picture in flight.masks()][:5]
    odometer = Odometer()
    before, _ = odometer.move(masks[0], masks[1])
    still, error_px = odometer.move(masks[1], masks[1])
    after, _ = odometer.move(masks[1], masks[2])
    assert (still == np.eye(3)).all()
    assert error_px < 2.0
    assert np.hypot(*(after[:2, 2] - before[:2, 2])) < 15.0
