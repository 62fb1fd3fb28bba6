"""A flight over a made-up town: found, followed, lost where it ends."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from flights.conftest import OPTIONS
from worlds.lattices import lattice

from examples.simulated_flights import simulate_flight
from roadgeo.evaluation.landscape import Landscape
from roadgeo.flights.mavlink import fix_of
from roadgeo.flights.pose import start
from roadgeo.flights.rows import make_rows
from roadgeo.flights.tracker import FlightFrame, Tracked, Tracker, _falls, follow, latest
from roadgeo.geometry.mask import RoadMask
from roadgeo.reference.reference import Reference


@pytest.fixture(scope="module")
def flight(flown):
    seen, masks, reference = flown
    frames = [FlightFrame(k, f"{k}", float(k), mask, seen.motion[k] if k else None) for k, mask in enumerate(masks)]
    return seen, frames, reference


def error(flown, one):
    truth = flown.views[one.frame.number].homography(one.frame.frame.center)
    return np.hypot(*(one.pose.center - truth))


def test_all_frames_are_placed_to_metres_those_that_waited_too(flight):
    flown, frames, reference = flight
    tracked = latest(follow(frames, [reference]))
    assert [one.frame.number for one in tracked] == list(range(9))
    assert {one.status for one in tracked} <= {"located", "tracked", "predicted"}
    assert max(error(flown, one) for one in tracked) < 5.0
    assert tracked[0].status == "located"
    assert tracked[0].known_at > 0 or len(flown.views) == 1


def followed(frames, reference):
    """Return a tracker that was fed frames."""
    tracker = Tracker([reference])
    for frame in frames:
        tracker.feed(frame)
    return tracker


def test_a_cut_is_noticed_within_three_frames_and_taken_back(flight):
    frames, tracker = flight[1], followed(*flight[1:])
    assert not tracker.is_lost
    rng = np.random.default_rng(3)
    news = []
    for k in range(3):
        strange = np.zeros((300, 400), bool)
        for row in rng.integers(0, 280, 3):
            strange[row : row + 9] = True
        news = tracker.feed(FlightFrame(9 + k, f"{9 + k}", 0.0, RoadMask(strange), frames[1].motion))
    assert tracker.is_lost
    assert [one.status for one in news] == ["lost"] * 3
    assert [one.pose for one in news] == [None] * 3


def test_a_frame_without_roads_is_followed_by_its_motion(flight):
    flown, frames, reference = flight
    blank = RoadMask(np.zeros((300, 400), bool))
    frames = [*frames[:7], FlightFrame(7, "7", 7.0, blank, frames[7].motion), frames[8]]
    tracked = latest(follow(frames, [reference]))
    assert tracked[7].status == "predicted"
    assert error(flown, tracked[7]) < 10.0
    assert tracked[8].status == "tracked"


def test_a_frame_that_contradicts_its_motion_may_be_anywhere_and_is_not_sent(flight):
    """As after frames that a link dropped: the motion is that of before."""
    frames, tracker = flight[1], followed(flight[1][:4], flight[2])
    assert not tracker.is_lost
    (news,) = tracker.feed(replace(frames[8], motion=frames[4].motion))
    (row,) = make_rows([news])
    assert (news.status, math.isnan(news.log10_odds)) == ("predicted", False)
    width_m = news.frame.frame.width * news.pose.gsd_m
    assert news.pose.sigma_m > width_m
    assert news.pose.corner_sigma_m.min() > width_m
    assert fix_of(row.to_dict(), 0.0) is None


def test_without_motion_a_flight_is_lost(flight):
    frames, tracker = flight[1], followed(*flight[1:])
    news = tracker.feed(FlightFrame(9, "9", 9.0, frames[8].mask))
    assert [one.status for one in news] == ["lost"]


@pytest.fixture(scope="module")
def blocks():
    """Equal blocks of 110 x 90 m, of which some are not parted by a street."""
    network, index = lattice(0.9)
    flown = simulate_flight(Landscape.from_network(network), replace(OPTIONS, n_frames=(12, 12)), 3)
    return flown, Reference(index, network)


def test_frames_of_another_town_are_told_so_without_hints_that_flights_lack(flight, blocks):
    lost = [one.reason for one in latest(follow(flight[1], [blocks[1]]))]
    assert lost[0] == "waits: in 1 frame 4 intersections, looked for again with 6"
    assert "frames: no place on this map stands out" in lost[-1]
    assert "--heading" not in "".join(lost)


def test_frames_are_followed_where_a_block_beside_would_do_as_well(blocks):
    """What is known is not a block off: that streets are alike tells nothing against a frame that was followed."""
    flown, reference = blocks
    tracker = Tracker([reference])
    statuses = []
    for k, mask in enumerate(flown.masks()):
        frame = FlightFrame(k, str(k), float(k), RoadMask(mask > 127), flown.motion[k])
        if k:
            before = start(flown.views[k - 1].homography(frame.frame.corners), frame.frame, 2.0 * np.eye(8))
            known = Tracked(frame, "located", "", k - 1, before, reference)
            placed = tracker.place_beside(known, frame)
            statuses.append(placed.status)
            assert error(flown, placed) < 5.0
    assert statuses.count("located") >= 10, statuses


def test_a_frame_is_not_followed_to_a_block_beside_its_place(blocks):
    """Its roads agree there nearly as well, but the true place explains more."""
    flown, reference = blocks
    masks, placed = [RoadMask(mask > 127) for mask in flown.masks()], []
    for k in range(1, len(masks)):
        before, view = flown.views[k - 1], flown.views[k]
        tracker, frame = Tracker([reference]), FlightFrame(k, str(k), float(k), masks[k], flown.motion[k])
        pose = start(before.homography(frame.frame.corners) + np.array([110.0, 0.0]), frame.frame, 2.0 * np.eye(8))
        agreed = Tracked(replace(frame, number=k - 1), "tracked", "", k - 1, pose, reference, 0.0, 0.0)
        tracker._pose, tracker._reference, tracker._agreed = pose, reference, [agreed]
        (state,) = tracker.feed(frame)
        placed.append(
            state.pose is None
            or np.hypot(*(state.pose.center - view.homography(frame.frame.center))) < 5.0 * state.pose.sigma_m
        )
    assert np.mean(placed) > 0.8


@pytest.mark.parametrize(("beside", "status"), [(0.4, "tracked"), (0.7, "predicted")])
def test_a_frame_is_doubted_where_a_block_beside_explains_more_by_half_a_power_of_ten(
    flight, monkeypatch, beside, status
):
    flown, (first, frame, *_), reference = flight
    pose = start(flown.views[0].homography(first.frame.corners), first.frame, 2.0 * np.eye(8))
    tracker = Tracker([reference])
    tracker._pose, tracker._reference = pose, reference
    tracker._agreed = [Tracked(first, "tracked", "", 0, pose, reference, 9.0, 0.9)]
    monkeypatch.setattr("roadgeo.flights.tracker._compare", lambda *_: (9.0, 0.9, beside))
    monkeypatch.setattr(tracker, "_search_around", lambda *_: None)
    assert [state.status for state in tracker.feed(frame)] == [status]


@pytest.mark.parametrize(("odds", "agreeing", "falls"), [(4.5, 0.62, True), (4.5, 0.7, False), (5.5, 0.62, False)])
def test_a_frame_agrees_less_by_half_of_the_odds_and_15_hundredths_of_its_roads(odds, agreeing, falls):
    before, frame = (SimpleNamespace(log10_odds=of, agreeing=share) for of, share in ((10.0, 0.8), (odds, agreeing)))
    assert _falls(frame, [before]) is falls


def test_a_frame_that_the_mosaic_bends_away_is_placed_from_its_neighbour(flight, monkeypatch):
    flown, frames, reference = flight
    settle = Tracker._settle

    def bent(self, location, mosaic):
        away = np.array([[1.0, 0.0, 150.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        return settle(self, location, replace(mosaic, to_mosaic=[away @ mosaic.to_mosaic[0], *mosaic.to_mosaic[1:]]))

    monkeypatch.setattr(Tracker, "_settle", bent)
    tracked = latest(follow(frames, [reference]))
    assert tracked[0].status == "located"
    assert error(flown, tracked[0]) < 3.0 * tracked[0].pose.sigma_m < 10.0


def test_frames_without_motion_stay_where_the_mosaic_puts_them(flight, monkeypatch):
    """Those of an archive have no order: the one before is no neighbour."""
    _, frames, reference = flight
    given = []
    settle = Tracker._settle
    monkeypatch.setattr(Tracker, "_settle", lambda self, *found: given.append(found) or settle(self, *found))
    known = latest(follow(frames, [reference]))
    n = sum(one.status == "located" for one in known)
    monkeypatch.setattr("roadgeo.flights.tracker.predict", lambda *_: pytest.fail("moved without a motion"))
    placed = Tracker([reference]).place(*given[-1], [replace(frame, motion=None) for frame in frames[:n]])
    assert [one.status for one in placed] == ["located"] * n
