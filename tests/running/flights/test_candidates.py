"""Places that earlier frames proposed, tested by later ones."""

import math

import numpy as np
import pytest

from roadgeo.evaluation.flights import FlightOptions, simulate_flight
from roadgeo.evaluation.landscape import Landscape
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.mask import RoadMask
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.query import read_query
from roadgeo.reference.reference import Reference
from roadgeo.running.flights.candidates import CandidateOptions, Candidates, Look, _Candidate
from roadgeo.running.flights.mosaic import MosaicOptions, lay_together, unseen_before

FLIGHT = FlightOptions(size_px=(400, 300), n_frames=(9, 9), gsd_m=(1.0, 1.2), turn_deg=1.0, intersections=(2, 30))


@pytest.fixture(scope="module")
def flown(town):
    network, index = town
    flight = simulate_flight(Landscape.from_network(network), FLIGHT, 1)
    return flight, [RoadMask(mask > 127) for mask in flight.masks()], Reference(index, network)


def look_at(flown, count, searched):
    flight, masks, _ = flown
    mosaic = lay_together(masks[:count], list(flight.motion[:count]), 8.0)
    return Look(read_query(mosaic.mask), mosaic, range(count), masks[:count], searched)


def off_by(location, flown, look):
    """How far the middle of the last frame lies from the truth, metres."""
    flight, _, reference = flown
    middle = np.array([200.0, 150.0])
    found = location.pixel_to_map(Homography(look.mosaic.to_mosaic[-1])(middle)[None])[0]
    truth = reference.index.plane.to_crs(flight.views[look.numbers[-1]].homography(middle)[None])[0]
    return np.hypot(*(found - truth))


@pytest.mark.slow
def test_what_a_weak_look_proposed_is_found_by_ground_that_comes_later(flown):
    """With a bar that no search of these frames reaches, the place stands by what is seen after it was proposed."""
    candidates = Candidates([flown[2]])
    first = candidates.look(look_at(flown, 4, True), LocateOptions(min_log10_odds=60.0))
    assert not first.located
    assert len(candidates) > 1
    alone = candidates.look(look_at(flown, 4, False), LocateOptions(min_log10_odds=60.0))
    assert alone.log10_odds == pytest.approx(first.log10_odds, abs=1.0)  # the same ground tells the same again
    assert all(one.tested == 0.0 for one in candidates._kept)
    later = look_at(flown, 8, False)
    location = candidates.look(later, LocateOptions())
    assert location.located
    assert off_by(location, flown, later) < 5.0
    assert max(one.tested for one in candidates._kept) > 3.0


@pytest.mark.slow
def test_each_frame_counts_though_it_brings_too_little_ground_for_a_test(flown):
    candidates = Candidates([flown[2]], CandidateOptions(fewest_roads=1000))
    candidates.look(look_at(flown, 4, True), LocateOptions(min_log10_odds=60.0))
    later = look_at(flown, 8, False)
    location = candidates.look(later, LocateOptions())
    assert all(one.tested == 0.0 for one in candidates._kept)
    assert location.located
    assert off_by(location, flown, later) < 5.0


@pytest.mark.slow
def test_each_look_and_each_rank_takes_its_share_off(flown):
    first, again = Candidates([flown[2]]), Candidates([flown[2]], n_looks=9)
    odds = [one.look(look_at(flown, 6, True), LocateOptions()).log10_odds for one in (first, again)]
    assert odds[0] - odds[1] == pytest.approx(1.0)
    kept = sorted(first._kept, key=lambda one: one.rank)
    assert [one.rank for one in kept] == list(range(len(kept)))
    assert len(kept) <= CandidateOptions().per_look
    for one in kept[1:]:
        paid = max(one.proposed, -math.log10((one.rank + 1) * (one.rank + 2)))
        assert one.log10_odds == paid  # not tested yet
    assert sum(1.0 / ((rank + 1) * (rank + 2)) for rank in range(10_000)) < 1.0


def test_ground_counts_once():
    masks = [RoadMask(np.zeros((60, 80), bool)) for _ in range(3)]
    for mask in masks:
        mask.roads[:, 40:46] = True
        mask.roads[20:26] = True
    step = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 20.0], [0.0, 0.0, 1.0]])
    mosaic = lay_together(masks, [np.eye(3), step, step], 6.0, MosaicOptions())
    fresh = unseen_before(masks, mosaic, 1)
    assert fresh.observed.sum() == pytest.approx(40 * 80, rel=0.05)
    assert unseen_before(masks, mosaic, 3).observed.sum() == 0
    everything = unseen_before(masks, mosaic, 0)
    assert np.array_equal(everything.roads, mosaic.mask.roads)
    assert not (fresh.roads & ~mosaic.mask.roads).any()


@pytest.mark.slow
def test_the_place_that_agrees_best_is_compared_with_all_others(flown):
    """Its odds are, at least, those by which it leads its twins, also where chance nearby leaves little of them."""
    candidates = Candidates([flown[2]])
    location = candidates.look(look_at(flown, 8, True), LocateOptions())
    compared = [one for one in candidates._kept if one.leading > -math.inf]
    assert location.located
    assert len(compared) == 1
    assert compared[0].leading > 3.5
    assert compared[0].log10_odds >= compared[0].leading - math.log10(compared[0].n_looks)


@pytest.mark.slow
def test_where_nothing_stands_out_no_twin_is_looked_for(flown):
    candidates = Candidates([flown[2]])
    candidates.look(look_at(flown, 8, True), LocateOptions(min_log10_odds=300.0))
    assert len(candidates)
    assert all(one.leading == -math.inf for one in candidates._kept)


def test_places_that_agree_are_kept_though_many_others_have_better_odds():
    """In a lattice the place has the odds of many others; of late ones, which paid for less, too many pushed it out."""
    candidates = Candidates([], CandidateOptions(most=4))
    for proposed, worth in ((-4.0, 1.0), (-4.1, 2.0), (-4.2, 3.0), (-4.3, 4.0), (-4.4, 5.0), (-5.5, 60.0)):
        kept = _Candidate(None, None, np.eye(3), 0, 0, 1, proposed, 9, 1, worth=worth)
        candidates._kept.append(kept)
    assert [one.worth for one in candidates._best_kept()] == [1.0, 2.0, 60.0, 5.0]
