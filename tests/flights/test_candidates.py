"""Places that earlier frames proposed, weighed again with all that later ones show."""

import numpy as np
import pytest

from roadgeo.flights.candidates import PER_LOOK, Candidates, Look
from roadgeo.flights.mosaic import lay_together
from roadgeo.geometry.homography import Homography
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.scene import read_query


def look_at(flown, count, searched):
    flight, masks, _ = flown
    mosaic = lay_together(masks[:count], list(flight.motion[:count]), 8.0)
    return Look(read_query(mosaic.mask), mosaic, range(count), searched)


def off_by(location, flown, look):
    """How far the middle of the last frame lies from the truth, metres."""
    flight, _, reference = flown
    middle = np.array([200.0, 150.0])
    found = location.pixel_to_map(Homography(look.mosaic.to_mosaic[-1])(middle)[None])[0]
    truth = reference.index.plane.to_crs(flight.views[look.numbers[-1]].homography(middle)[None])[0]
    return np.hypot(*(found - truth))


def weak():
    """A bar that no search of these frames reaches."""
    return LocateOptions(min_log10_odds=60.0)


def test_what_a_weak_look_proposed_is_found_by_ground_that_comes_later(flown):
    """The map is not searched again: the place stands by what is seen after it was proposed."""
    candidates = Candidates([flown[2]])
    first = candidates.look(look_at(flown, 4, True), weak())
    assert not first.located
    assert len(candidates) > 1
    alone = candidates.look(look_at(flown, 4, False), weak())
    assert alone.log10_odds == pytest.approx(first.log10_odds, abs=1.0)  # the same ground tells the same again
    later = look_at(flown, 8, False)
    location = candidates.look(later, LocateOptions())
    assert location.located
    assert location.log10_odds > first.log10_odds
    assert off_by(location, flown, later) < 5.0


def test_each_search_takes_its_share_off(flown):
    first, again = Candidates([flown[2]]), Candidates([flown[2]], n_looks=9)
    odds = [item.look(look_at(flown, 6, True), LocateOptions()).log10_odds for item in (first, again)]
    assert odds[0] - odds[1] == pytest.approx(1.0)
    assert (first.n_looks, again.n_looks) == (1, 10)
    before = first.look(look_at(flown, 6, False), LocateOptions()).log10_odds
    assert first.n_looks == 1
    assert before == pytest.approx(odds[0], abs=1.0)


def test_no_more_than_so_many_places_are_kept_those_that_explain_most(flown, monkeypatch):
    all_of_them, few = Candidates([flown[2]]), Candidates([flown[2]])
    all_of_them.look(look_at(flown, 4, True), weak())
    monkeypatch.setattr("roadgeo.flights.candidates.MOST", 3)
    few.look(look_at(flown, 4, True), weak())
    worth = sorted((item.fit.log10_likelihood for item in all_of_them._kept), reverse=True)
    assert len(all_of_them) <= 2 * PER_LOOK  # of a quick search, and of a full one
    assert len(few) == 3
    assert [item.fit.log10_likelihood for item in few._kept] == pytest.approx(worth[:3])


def test_the_best_place_is_compared_with_all_others(flown):
    """Its odds are those by which it leads any of them, and those around it."""
    candidates, look = Candidates([flown[2]]), look_at(flown, 8, True)
    location = candidates.look(look, LocateOptions())
    assert location.located
    worth = sorted((item.fit.log10_likelihood for item in candidates._kept), reverse=True)
    assert location.log10_odds < worth[0]


def test_places_whose_frames_left_the_view_are_forgotten(flown):
    """A place is known by one of its frames: where that is no longer laid with the others, it says nothing of them."""
    candidates = Candidates([flown[2]])
    candidates.look(look_at(flown, 4, True), weak())
    assert len(candidates) > 1
    elsewhere = look_at(flown, 4, False)
    gone = Look(elsewhere.query, elsewhere.mosaic, [100 + number for number in elsewhere.numbers], False)
    location = candidates.look(gone, LocateOptions())
    assert not location.located
    assert len(candidates) == 0
