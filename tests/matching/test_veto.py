"""Hints that leave no rival prove nothing: a told place stands only if no other place explains more."""

import re
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from worlds.scenes import camera, look, random_network, scene_of

from roadgeo.errors import Reason
from roadgeo.geometry.camera import CameraOptions
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.projection import to_lonlat
from roadgeo.location import Location, Seconds
from roadgeo.matching import veto
from roadgeo.matching.index import build_index
from roadgeo.matching.methods import Searched, search_references
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.parts import Whole
from roadgeo.matching.place import Place
from roadgeo.matching.scene import Query
from roadgeo.matching.shifts import Shift, move_about, shifted
from roadgeo.matching.verdict import _fits_elsewhere, decide

TRUTH = camera((1000, 1000), (1000, 1000), 1.0, 0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def town():
    network = random_network(21, 2000.0)
    index, graph = build_index(network), look(network, TRUTH)
    scene = scene_of(graph)
    return Query("frame", scene, graph, Seconds()), index


def hinted(town, east_m=0.0, radius_m=60.0, **camera):
    """Options with a circle so far east of the truth."""
    query, index = town
    middle = Homography(TRUTH).everywhere(query.scene.center) + np.array([east_m, 0.0])
    lon, lat = to_lonlat(index.plane.crs, index.plane.to_crs(middle[None]))[0].tolist()
    options = LocateOptions(near=(lon, lat, radius_m))
    return replace(options, match=replace(options.match, camera=replace(CameraOptions(), **camera)))


def answer(town, options, places):
    """What is decided where hints lead to these places."""
    query, index = town
    searched = [Searched(index, tuple(places), counts=Counter(searched=len(index)))]
    return decide(query, veto.contest(query, searched, [Whole(index)], options, 60.0), options)


def found(town, options):
    """The places of a search without hints, as if hints had led there."""
    query, index = town
    (one,) = search_references(query, [Whole(index)], veto.without_hints(options), 60.0)
    return one.places


def test_a_place_that_is_told_truly_stands(town):
    options = hinted(town)
    assert answer(town, options, found(town, options)).located


def test_a_place_that_is_told_falsely_is_refused_and_the_refusal_says_where_the_roads_fit_better(town):
    query, index = town
    options = hinted(town, 300.0, gsd_m=(0.95, 1.05))
    (best, *_) = found(town, options)
    wrong = best.but(matrix=shifted(best.matrix, 300.0, 0.0), score=9.0, rival=None)
    wrong = replace(Place(query.scene, index, wrong.matrix), refined=best.refined, score=9.0)
    location = answer(town, options, [wrong])
    assert (location.status, location.reason_code) == ("not_located", Reason.FITS_ELSEWHERE)
    away = "the roads fit better (299|300) m away, outside the circle given: leave --near out"
    assert re.fullmatch(away, location.reason)
    assert np.allclose(location.places[0].center[2:], best.lonlat, atol=1e-5)


def test_where_the_search_without_hints_finds_nothing_the_blocks_beside_may_still_fit_better(town, monkeypatch):
    """As in a lattice, in which a place must lead many others to be found."""
    query, index = town
    options = hinted(town, 300.0)
    (best, *_) = found(town, options)
    monkeypatch.setattr(veto, "search_references", lambda *_: [Searched(index)])
    wrong = Place(query.scene, index, shifted(best.matrix, 300.0, 0.0)).but(refined=best.refined, score=9.0)
    assert answer(town, options, [wrong]).reason_code is Reason.FITS_ELSEWHERE
    assert answer(town, hinted(town), [best]).located


@pytest.mark.parametrize("score", [9.0, 1.0])
def test_where_the_search_without_hints_leads_nowhere_places_alike_are_searched(town, monkeypatch, score):
    """Of the hinted place's own heading and scale; only where that one would be reported."""
    query, index = town
    (best, *_) = found(town, hinted(town))
    searched = []

    def search(_query, _parts, options, _limit_s):
        searched.append(options.match.camera)
        is_alike = options.match.camera.heading is not None
        return [Searched(index, likeliest=(best,)) if is_alike else Searched(index)]

    monkeypatch.setattr(veto, "search_references", search)
    monkeypatch.setattr(veto, "places_beside", lambda *_: [])
    wrong = Place(query.scene, index, shifted(best.matrix, 900.0, 0.0)).but(refined=best.refined, score=score)
    is_better = answer(town, hinted(town, 900.0), [wrong]).reason_code is Reason.FITS_ELSEWHERE
    assert (is_better, len(searched)) == ((True, 2) if score == 9.0 else (False, 1))
    assert searched[0] == CameraOptions()
    for alike in searched[1:]:
        assert alike.gsd_m[0] < best.gsd_m < alike.gsd_m[1]
        assert alike.turned_off(*(best.corners[0] - best.corners[3])) < 0.0


def test_where_time_ends_before_the_search_without_hints_the_place_is_not_reported(town, monkeypatch):
    """What took the search with hints is part of the time."""
    query, index = town
    limits = []

    def search(_query, _parts, _options, limit_s):
        limits.append(limit_s)
        return [Searched(index, stopped="time")]

    options = hinted(town)
    (best, *_) = found(town, options)
    monkeypatch.setattr(veto, "search_references", search)
    searched = [Searched(index, (best,), counts=Counter(searched=len(index)), seconds=Seconds(match=59.0))]
    location = decide(query, veto.contest(query, searched, [Whole(index)], options, 60.0), options)
    assert (location.status, location.reason_code, limits) == ("not_located", Reason.TIME_LIMIT, [1.0])
    assert "without the hints" in location.reason


def test_where_time_ends_a_search_without_hints_that_led_to_the_place_it_stands(town, monkeypatch):
    _, index = town
    options = hinted(town)
    (best, *_) = found(town, options)
    monkeypatch.setattr(veto, "search_references", lambda *_: [Searched(index, (best,), stopped="time")])
    assert answer(town, options, [best]).located


@pytest.mark.parametrize(
    ("score", "near_m", "where"),
    [
        (9.0, 450.0, "(299|300) m away"),  # from the place that hints led to
        (1.0, 450.0, "(449|450) m away"),  # from the middle of the circle
        (9.0, None, "(299|300) m away"),
        (1.0, None, "on town 21"),
        (1.0, 0.0, "on town 21"),  # within the circle: another hint is false
    ],
)
def test_a_refusal_says_how_far_away_the_roads_fit_better(town, score, near_m, where):
    query, index = town
    options = LocateOptions() if near_m is None else hinted(town, near_m)
    (best, *_) = found(town, hinted(town))
    wrong = Place(query.scene, index, shifted(best.matrix, 300.0, 0.0)).but(score=score)
    location = _fits_elsewhere(Location("q", "not_located", ""), [best, wrong], options)
    assert re.match(f"the roads fit better {where}", location.reason)


def test_a_place_that_agrees_with_the_hints_and_that_they_led_past_is_the_answer(town):
    options = hinted(town)
    assert answer(town, options, []).located


def test_where_hints_lead_to_nothing_only_a_place_that_would_be_reported_is_named(town):
    options = hinted(town, 700.0)
    assert answer(town, options, []).reason_code is Reason.FITS_ELSEWHERE
    strict = replace(options, min_log10_odds=1e6)
    assert answer(town, strict, []).reason_code is Reason.NOTHING_STANDS_OUT


@pytest.mark.parametrize(("score", "least_s", "most_s"), [(1.0, 0.7, 1.4), (9.0, 9.0, 11.0)])
def test_where_hints_lead_to_nothing_little_work_is_spent_without_them(town, monkeypatch, score, least_s, most_s):
    query, index = town
    limits = []
    monkeypatch.setattr(veto, "search_references", lambda *of: limits.append(of[2].search.work_limit_s) or [])
    answer(town, hinted(town), [Place(query.scene, index, TRUTH, score=score)])
    assert least_s < limits[0] < most_s


@pytest.mark.parametrize(
    ("turn_deg", "scale", "east_m", "is_other"),
    [
        (0.0, 1.0, 0.0, False),
        (30.0, 1.0, 0.0, False),
        (60.0, 1.0, 0.0, True),
        (0.0, 1.2, 0.0, False),
        (0.0, 1.3, 0.0, True),
        (0.0, 1.0, 40.0, False),
        (0.0, 1.0, 60.0, True),
    ],
)
def test_another_place_lies_elsewhere_is_turned_or_is_of_another_size(town, turn_deg, scale, east_m, is_other):
    query, index = town
    middle = Homography(TRUTH).everywhere(query.scene.center)
    moved = move_about(middle, Shift(east_m, 0.0, turn_deg, scale, 0.0)) @ TRUTH
    assert veto._is_other(Place(query.scene, index, TRUTH), Place(query.scene, index, moved)) is is_other


@pytest.mark.parametrize(("more", "is_better"), [(0.1, False), (0.2, True)])
def test_a_place_that_explains_hardly_more_is_no_better_one(town, monkeypatch, more, is_better):
    """Where streets repeat a hint is what tells equal places apart."""
    query, index = town
    here = Place(query.scene, index, TRUTH)
    there = Place(query.scene, index, shifted(TRUTH, 300.0, 0.0))
    own = here.agreement.log10_likelihood
    monkeypatch.setattr(veto.Evidence, "weigh", lambda *_: own + more)
    assert (veto._better(here, [there]) is not None) is is_better


def test_each_hint_that_a_place_breaks_is_named(town):
    query, index = town
    options = hinted(town, 500.0, gsd_m=(2.0, 3.0), heading_deg=(90.0, 5.0))
    options = replace(options, match=replace(options.match, within=(10.0, 10.0, 11.0, 11.0)))
    ways = veto.broken_hints(Place(query.scene, index, TRUTH), options)
    assert [way.split(": leave ")[1] for way in ways] == ["--near out", "--within out", "--gsd out", "--heading out"]
    assert veto.broken_hints(Place(query.scene, index, TRUTH), hinted(town)) == []


def test_without_hints_there_is_nothing_to_contest(town):
    options = LocateOptions()
    assert veto.without_hints(options) is None
    wider = replace(options, match=replace(options.match, camera=CameraOptions(gsd_m=(0.4, 48.0))))
    assert veto.without_hints(wider) is None  # all scales, in pixels four times as coarse
    bare = veto.without_hints(hinted(town, gsd_m=(0.9, 1.1), heading_deg=(0.0, 5.0)))
    assert bare == options


def test_no_map_is_opened_for_it_that_the_hints_exclude(town):
    query, index = town

    class Far(Whole):
        def may_hold(self, near, frame_m=0.0):
            return False

        def open(self):
            raise AssertionError("it was opened")

    options = hinted(town)
    searched = [Searched(index, found(town, options), counts=Counter(searched=len(index)))]
    parts = [Whole(index), Far(index)]
    assert decide(query, veto.contest(query, searched, parts, options, 60.0), options).located
