"""Places that earlier frames proposed, weighed again with all that later ones show."""

import numpy as np
import pytest
import shapely
from shapely import affinity

from roadgeo.flights.candidates import Candidates, MosaicQuery
from roadgeo.flights.mosaic import stitch
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.projection import to_lonlat
from roadgeo.location import Reason
from roadgeo.matching.index import build_index
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.scene import read_query
from roadgeo.reference.reference import Reference
from roadgeo.roads.network import build_network


def mosaic_of(flown, count, searched):
    flight, masks, _ = flown
    mosaic = stitch(masks[:count], list(flight.motion[:count]), 8.0)
    return MosaicQuery(read_query(mosaic.mask), mosaic, range(count), searched)


def off_by(location, flown, frames):
    """How far the middle of the last frame lies from the truth, metres."""
    flight, _, reference = flown
    middle = np.array([200.0, 150.0])
    found = location.pixel_to_map(Homography(frames.mosaic.to_mosaic[-1])(middle)[None])[0]
    truth = reference.index.plane.to_crs(flight.views[frames.numbers[-1]].homography(middle)[None])[0]
    return np.hypot(*(found - truth))


def weak():
    """A bar that no search of these frames reaches."""
    return LocateOptions(min_log10_odds=60.0)


def test_what_a_weak_look_proposed_is_found_by_ground_that_comes_later(flown):
    """The map is not searched again: the place stands by what is seen after it was proposed."""
    candidates = Candidates([flown[2]])
    first = candidates.decide(mosaic_of(flown, 4, True), weak())
    assert not first.located
    assert len(candidates) > 1
    alone = candidates.decide(mosaic_of(flown, 4, False), weak())
    assert alone.log10_odds == pytest.approx(
        first.log10_odds, abs=3.0
    )  # the same ground, and no places that were tried
    later = mosaic_of(flown, 8, False)
    location = candidates.decide(later, LocateOptions())
    assert location.located
    assert location.log10_odds > first.log10_odds
    assert off_by(location, flown, later) < 5.0


def test_each_search_takes_its_share_off(flown):
    first, again = Candidates([flown[2]]), Candidates([flown[2]], n_searches=9)
    odds = [item.decide(mosaic_of(flown, 6, True), LocateOptions()).log10_odds for item in (first, again)]
    assert odds[0] - odds[1] == pytest.approx(1.0)
    assert (first.n_searches, again.n_searches) == (1, 10)
    before = first.decide(mosaic_of(flown, 6, False), LocateOptions()).log10_odds
    assert first.n_searches == 1
    assert before == pytest.approx(odds[0], abs=3.0)


def test_the_places_that_explain_most_are_kept(flown, monkeypatch):
    monkeypatch.setattr("roadgeo.flights.candidates.MOST", 3)
    candidates = Candidates([flown[2]])
    candidates.decide(mosaic_of(flown, 4, True), weak())
    assert len(candidates) == 3
    later = mosaic_of(flown, 8, False)
    location = candidates.decide(later, LocateOptions())
    assert location.located
    assert off_by(location, flown, later) < 5.0


def test_places_whose_frames_left_the_view_are_forgotten(flown):
    """A place is known by one of its frames: where that is no longer laid with the others, it says nothing of them."""
    candidates = Candidates([flown[2]])
    candidates.decide(mosaic_of(flown, 4, True), weak())
    assert len(candidates) > 1
    elsewhere = mosaic_of(flown, 4, False)
    gone = MosaicQuery(elsewhere.query, elsewhere.mosaic, [100 + number for number in elsewhere.numbers], False)
    location = candidates.decide(gone, LocateOptions())
    assert not location.located
    assert len(candidates) == 0


@pytest.fixture(scope="module")
def twice(flown):
    """The town, and six kilometres east what it was before it grew; a circle around where the frames would lie."""
    flight, _, reference = flown
    plane, lines = reference.index.plane, [shapely.LineString(line) for line in reference.network.graph.polylines()]
    before = [affinity.translate(line, 6000.0) for k, line in enumerate(lines) if k % 5]
    network = build_network(lines + before, plane, {"name": "twice"})
    middle = flight.views[2].homography(np.array([200.0, 150.0])) + np.array([6000.0, 0.0])
    lon, lat = to_lonlat(plane.crs, plane.to_crs(middle[None]))[0].tolist()
    return Reference(build_index(network), network), (lon, lat, 200.0)


def test_a_false_circle_is_refuted_where_the_roads_fit_better(flown, twice):
    reference, near = twice
    location = Candidates([reference]).decide(mosaic_of(flown, 6, True), LocateOptions(near=near))
    assert location.reason_code is Reason.FITS_ELSEWHERE, location.reason
