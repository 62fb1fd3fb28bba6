"""Twins on a lattice: a block beside fits nearly as well, and piece by piece it does not."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from worlds.scenes import Sight, camera, look, scene_of

from roadgeo.geometry.camera import CameraOptions
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.projection import LocalPlane
from roadgeo.location import Reason, Seconds
from roadgeo.matching.estimator import MatchOptions
from roadgeo.matching.index import build_index
from roadgeo.matching.local_search import Shift, move_about
from roadgeo.matching.methods import Fit, Found
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.pieces import log10_lead
from roadgeo.matching.query import Query
from roadgeo.matching.twins import Contest, TwinOptions, best_twin
from roadgeo.matching.verdict import decide
from roadgeo.roads.graph import RoadGraph
from roadgeo.workflows import build_network

NOTHING = RoadGraph.from_polylines(np.empty((0, 2)), np.empty((0, 2), int), [])
BLOCK = (110, 90)
SIZE = (700, 500)


def lattice(kept: float):
    """Equal blocks over 3.3 by 3.2 km, of which some are not parted by a street."""
    rng, (width, height) = np.random.default_rng(5), BLOCK
    lines = [
        shapely.LineString([a, b])
        for x in range(0, 30 * width, width)
        for y in range(0, 35 * height, height)
        for a, b in (((x, y), (x + width, y)), ((x, y), (x, y + height)))
        if rng.random() < kept
    ]
    network = build_network(lines, LocalPlane("EPSG:32619", (330000.0, 4690000.0)), {"name": "lattice"})
    return network, build_index(network)


def contest(kept: float, size: tuple[int, int] = SIZE):
    """Return the true place, the map, and places of a view of it that are compared."""
    network, index = lattice(kept)
    low, high = network.graph.xy.min(axis=0), network.graph.xy.max(axis=0)
    truth = camera(tuple(((low + high) / 2).tolist()), size, 1.0, heading_deg=15.0)
    scene = scene_of(look(network, truth, size, Sight(sigma_m=1.0, missing=0.15, false=0.05), 2), size)
    return truth, index, Contest(scene, 1.0, MatchOptions())


@pytest.fixture(scope="module")
def broken():
    return contest(0.8)


@pytest.fixture(scope="module")
def wider():
    return contest(0.8, (900, 700))


def beside(truth, among):
    shift = Shift(float(BLOCK[0]), 0.0, 0.0, 1.0, 0.0)
    return move_about(Homography(truth)(among.scene.center), shift) @ truth


def test_the_place_leads_a_block_beside_by_the_streets_that_are_missing_there(broken):
    truth, index, among = broken
    here, there = (among.weigh(matrix, index) for matrix in (truth, beside(truth, among)))
    assert log10_lead(here - there) > 2.0
    assert log10_lead(there - here) == 0.0


@pytest.mark.slow
def test_twins_are_found_all_over_the_lattice_and_laid_on_its_streets(broken):
    truth, index, among = broken
    twins = among.twins_of(beside(truth, among), index)
    away = [np.hypot(*(Homography(one)(among.scene.center) - Homography(truth)(among.scene.center))) for one in twins]
    assert min(away) < 3.0  # from a block beside, the place itself is among its twins
    assert sum(distance > 500.0 for distance in away) > 5
    here = among.weigh(truth, index)
    leads = [log10_lead(here - among.weigh(one, index)) for one, far in zip(twins, away, strict=True) if far > 50.0]
    assert min(leads) > 1.0


@pytest.mark.slow
def test_where_all_blocks_are_equal_nothing_leads():
    truth, index, among = contest(1.0)
    here = among.weigh(truth, index)
    twins = among.twins_of(truth, index)
    assert min(log10_lead(here - among.weigh(one, index)) for one in twins) < 1.0
    twin = best_twin(truth, among.scene, index, MatchOptions(), TwinOptions(n_places=12))
    assert twin is not None
    assert twin.log10_lead < 1.0


@pytest.mark.slow
def test_the_best_twin_leads_a_wrong_place_and_not_the_right_one(broken):
    truth, index, among = broken
    options = TwinOptions(n_places=12)
    wrong = best_twin(beside(truth, among), among.scene, index, MatchOptions(), options)
    right = best_twin(truth, among.scene, index, MatchOptions(), options)
    assert wrong.log10_lead == 0.0
    assert right.log10_lead > 1.0
    middle = Homography(truth)(among.scene.center)
    assert np.hypot(*(Homography(right.matrix)(among.scene.center) - middle)) > 10.0


@pytest.mark.parametrize(
    ("odds", "options", "status"),
    [
        (6.0, {}, "ambiguous"),
        (25.0, {}, "located"),  # beyond doubt
        (6.0, {"twins": None}, "located"),
        (6.0, {"twins": TwinOptions(repeating=1.1)}, "located"),  # streets that do not repeat
    ],
)
def test_a_weak_place_must_lead_its_twins(broken, odds, options, status):
    truth, index, among = broken
    nobody = np.full(len(among.scene.intersections), -1)
    wrong = Fit(index, beside(truth, among), nobody, np.zeros(len(nobody)), 0.7, odds, np.ones(4))
    query = Query("view.png", among.scene, NOTHING, Seconds())
    answer = decide(query, [Found(index, (wrong,))], LocateOptions(**options))
    assert answer.status == status
    if status == "ambiguous":
        assert answer.reason.startswith("streets repeat: 110 m away they agree almost as well")
        assert answer.reason_code == Reason.TWO_PLACES
        assert answer.runner_up.log10_odds == odds


@pytest.mark.parametrize(
    ("at", "agreement", "n_searched", "status"),
    [
        ("truth", 0.9, 15_000, "located"),
        ("truth", 0.6, 15_000, "not_located"),  # much of the mask has no place there
        ("truth", 0.9, 10**12, "not_located"),  # many such places on so large a map
        ("beside", 0.9, 15_000, "not_located"),
    ],
)
def test_a_place_of_low_odds_is_proved_by_its_lead_where_streets_repeat(wider, at, agreement, n_searched, status):
    truth, index, among = wider
    matrix = truth if at == "truth" else beside(truth, among)
    nobody = np.full(len(among.scene.intersections), -1)
    fit = Fit(index, matrix, nobody, np.zeros(len(nobody)), 0.9, -1.0, np.ones(4), agreement=agreement)
    query = Query("view.png", among.scene, NOTHING, Seconds())
    answer = decide(query, [Found(index, (fit,), n_searched=n_searched)], LocateOptions())
    assert answer.status == status
    if answer.located:
        assert answer.log10_odds >= 3.5
        assert "any other place where these streets repeat" in answer.reason


def test_a_place_as_good_on_another_map_keeps_a_lead_from_proving_anything(wider):
    truth, index, among = wider
    nobody = np.full(len(among.scene.intersections), -1)
    fit = Fit(index, truth, nobody, np.zeros(len(nobody)), 0.9, -1.0, np.ones(4), agreement=0.9)
    away = move_about(Homography(truth)(among.scene.center), Shift(900.0, 0.0, 0.0, 1.0, 0.0)) @ truth
    other = replace(fit, matrix=away, log10_odds=-2.0)
    query = Query("view.png", among.scene, NOTHING, Seconds())
    answer = decide(query, [Found(index, (fit,)), Found(index, (other,))], LocateOptions())
    assert answer.status == "ambiguous"


def test_only_what_the_user_allows_is_a_twin(broken):
    truth, index, among = broken
    options, middle = TwinOptions(n_places=12), Homography(truth)(among.scene.center)
    assert best_twin(truth, among.scene, index, MatchOptions(), options, (*middle, 20.0)) is None
    turned = MatchOptions(camera=CameraOptions(north_up=True))
    wrong = best_twin(beside(truth, among), among.scene, index, turned, options)
    assert wrong is None  # the view is turned by 15 degrees
