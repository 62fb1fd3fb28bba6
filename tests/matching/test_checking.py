"""Given places on made-up towns: right, off, or not to be judged."""

import re
from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from shapely import affinity
from worlds.motorways import motorways
from worlds.scenes import PLANE, Sight, camera, look, random_lines, scene_of, soft

from roadgeo.geometry.camera import CameraFault, judge
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.mask import PIXEL_TO_PLANE
from roadgeo.location import Location, Seconds
from roadgeo.matching import checking
from roadgeo.matching.checking import CheckOptions, check_place
from roadgeo.matching.index import build_index
from roadgeo.matching.methods import Searched
from roadgeo.matching.place import Place
from roadgeo.matching.scene import Query
from roadgeo.matching.shifts import LocalSearchOptions, Shift, move_about, search_nearby
from roadgeo.matching.verdict import decide
from roadgeo.roads.network import build_network

SIGHT = Sight(sigma_m=1.0, missing=0.2, false=0.1)


@pytest.fixture(scope="module", params=["drawn", "soft"])
def sights(town, request):
    """(truth, scene) of three frames without tilt, as masks and as pictures of probabilities."""
    found = []
    for seed, heading in ((1, 10.0), (2, 200.0), (3, 300.0)):
        truth = camera((1700.0 + 200 * seed, 2000.0), (900, 700), 1.0, heading_deg=heading)
        query = query_of(look(town[0], truth, (900, 700), SIGHT, seed), (900, 700))
        found.append((truth, replace(query, scene=soft(query.scene, seed=seed)) if request.param == "soft" else query))
    return found


def query_of(graph, size):
    """A query whose roads are known."""
    return Query("", scene_of(graph, size), graph, Seconds())


def lied(truth, query, shift):
    """Where a georeference that is off by a shift puts the query."""
    return move_about(Homography(truth)(query.scene.center), shift) @ truth


def test_a_right_place_agrees(town, sights) -> None:
    for truth, query in sights:
        found = check_place(truth, query, town[1])
        assert found.verdict == "agrees", found.reason
        assert found.agreeing == pytest.approx(found.agreeing_as_given, abs=0.05)


@pytest.mark.parametrize(
    "shift", [Shift(6, 0, 0, 1, 0), Shift(-3, -4, 1, 1, 0), Shift(80, -60, -5, 1, 0), Shift(-200, 220, 3, 1, 0)]
)
def test_a_wrong_one_is_off_by_what_it_was_moved_by(town, sights, shift) -> None:
    for truth, query in sights:
        found = check_place(lied(truth, query, shift), query, town[1])
        assert found.verdict == "off", found.reason
        middle = np.array(query.scene.size) / 2.0
        center = Homography(found.placement.matrix)(middle)
        assert np.hypot(*(center - Homography(truth)(query.scene.center))) < 1.5
        assert found.displacement.turn_deg == pytest.approx(-shift.turn_deg, abs=0.2)
        assert np.hypot(found.displacement.east_m + shift.east_m, found.displacement.north_m + shift.north_m) < 1.5


def test_what_lies_beyond_the_reach_or_on_another_map_is_not_judged(town, sights) -> None:
    truth, query = sights[0]
    for shift, how in (
        (Shift(700, 500, 0, 1, 0), r"\d+ m away"),
        (Shift(0, 0, 90, 1, 0), "turned by 90 degrees"),
        (Shift(0, 0, 0, 1.4, 0), "0.71 times as large"),
    ):
        found = check_place(lied(truth, query, shift), query, town[1])
        assert found.verdict == "unknown"
        assert re.fullmatch(f"the roads fit better {how}", found.reason)
    away = check_place(lied(truth, query, Shift(50_000, 0, 0, 1, 0)), query, town[1])
    assert (away.verdict, away.displacement) == ("unknown", None)
    assert "not on this map" in away.reason


@pytest.mark.parametrize("away_m", [1500.0, 4000.0])
def test_a_place_beyond_the_reach_that_explains_more_refutes_one_within(away_m) -> None:
    """A district, and what it was before it grew, which stands out from all within reach."""
    lines, truth, size = random_lines(31, 1200.0), camera((600, 600), (800, 800), 1.0, heading_deg=25.0), (800, 800)
    before = [affinity.translate(line, away_m) for k, line in enumerate(lines) if k % 5]
    index = build_index(build_network(lines + before, PLANE, {"name": "twice"}))
    query = query_of(look(build_network(lines, PLANE, {"name": "once"}), truth, size), size)
    assert check_place(lied(truth, query, Shift(60, 0, 0, 1, 0)), query, index).verdict == "off"
    found = check_place(lied(truth, query, Shift(away_m + 60.0, 0, 0, 1, 0)), query, index)
    assert (found.verdict, found.displacement) == ("unknown", None)
    assert "the roads fit better" in found.reason


def test_hardly_a_road_is_no_evidence(town) -> None:
    truth = camera((2000.0, 2000.0), (60, 60), 1.0)
    found = check_place(truth, query_of(look(town[0], truth, (60, 60)), (60, 60)), town[1])
    assert found.verdict == "unknown"
    assert "too few roads" in found.reason


@pytest.mark.parametrize(
    ("shown_m", "mapped_m", "reason"),
    [(220.0, 9e3, "too few roads"), (420.0, 220.0, "not on this map"), (420.0, 420.0, "no place within")],
)
def test_mask_and_map_must_show_some_hundred_metres_of_road(
    town, sights, monkeypatch, shown_m, mapped_m, reason
) -> None:
    truth, query = sights[0]
    monkeypatch.setattr(checking.Place, "gsd_m", 1.0)
    monkeypatch.setattr("roadgeo.matching.evidence.Evidence.mapped_px", lambda *_: mapped_m)
    monkeypatch.setattr(checking, "_locate", lambda *_: Location("", "not_located", ""))
    few = replace(query, scene=replace(query.scene, road_length_px=shown_m))
    assert reason in check_place(truth, few, town[1]).reason


@pytest.mark.parametrize(
    ("off_m", "sigma_m", "verdict"),
    [(2.2, 0.5, "agrees"), (4.5, 0.5, "off"), (2.2, 2.2, "agrees"), (2.2, 4.5, "unknown"), (9.0, 4.5, "unknown")],
)
def test_a_place_agrees_to_3_m_and_is_judged_where_it_is_known_to_3_m(
    town, sights, monkeypatch, off_m, sigma_m, verdict
) -> None:
    truth, query = sights[0]
    offset = SimpleNamespace(over=lambda _: off_m, sigma_over=lambda _: sigma_m, significance=100.0)
    monkeypatch.setattr(checking, "_displacement", lambda *_: offset)
    best = SimpleNamespace(matrix=truth @ PIXEL_TO_PLANE, score=9.0, rival=None)
    location = SimpleNamespace(located=True, places=[best])
    assert checking._judge(location, Place(query.scene, town[1], truth), CheckOptions()).verdict == verdict


@pytest.mark.parametrize(
    ("east_m", "score", "verdict"),
    [(0.0, 0.7, "unknown"), (0.0, 1.4, "agrees"), (20.0, 1.4, "unknown"), (20.0, 2.8, "off")],
)
def test_the_given_place_needs_a_lower_score_than_another(town, sights, east_m, score, verdict) -> None:
    truth, query = sights[0]
    given, options = Place(query.scene, town[1], truth), CheckOptions()
    best = Place(query.scene, town[1], lied(truth, query, Shift(east_m, 0, 0, 1, 0)), score=score)
    searched = Searched(town[1], (best,), counts=Counter(searched=len(town[1])))
    location = decide(query, [searched], checking._as_hints(given, options))
    assert checking._judge(location, given, options).verdict == verdict


@pytest.mark.parametrize(
    ("gsd_m", "tilt_deg", "fault"),
    [
        (1.08, 0.0, None),
        (1.15, 0.0, CameraFault.SAMPLING),
        (0.93, 0.0, None),
        (0.87, 0.0, CameraFault.SAMPLING),
        (1.0, 24.0, None),  # the tilt of a homography is told to some 20 degrees
        (1.0, 28.0, CameraFault.TILT),
    ],
)
def test_scale_and_tilt_may_be_a_little_off(town, gsd_m, tilt_deg, fault) -> None:
    size = (1000, 1000)
    views = [camera((2000.0, 2000.0), size, *view, focal_px=700.0) for view in ((1.0, 0.0), (gsd_m, tilt_deg))]
    scene = scene_of(look(town[0], views[0], size), size)
    hints = checking._as_hints(Place(scene, town[1], views[0]), CheckOptions())
    assert judge(views[1], size, hints.match.camera) is fault


def test_the_search_finds_shift_and_turn_to_its_steps(town, sights) -> None:
    truth, query = sights[1]
    best = search_nearby(lied(truth, query, Shift(150, -90, 4, 1, 0)), query.scene, town[1], LocalSearchOptions())[0]
    assert (best.east_m, best.north_m) == pytest.approx((-150, 90), abs=8)
    assert best.turn_deg == pytest.approx(-4, abs=1.2)


@pytest.mark.parametrize("heading", [10.0, 120.0, 250.0])
def test_two_roads_of_a_mask_that_are_one_on_the_map_do_not_put_it_off(town, heading) -> None:
    """A fit to either of them would, by half of how far they are apart; here all roads are such."""
    truth = camera((2000.0, 2000.0), (900, 700), 1.0, heading_deg=heading)
    query = query_of(look(motorways(town[0], lambda at: True, 20.0), truth, (900, 700)), (900, 700))
    found = check_place(truth, query, town[1])
    assert found.verdict != "off", found.reason
