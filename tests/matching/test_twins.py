"""Twins on a lattice: a block beside fits nearly as well, and piece by piece it does not."""

from dataclasses import replace

import numpy as np
import pytest
from worlds.lattices import beside, contest

from roadgeo.geometry.camera import CameraOptions
from roadgeo.geometry.homography import Homography
from roadgeo.location import Reason, Seconds
from roadgeo.matching.estimator import MatchOptions
from roadgeo.matching.local_search import Shift, move_about
from roadgeo.matching.methods import Fit, Found
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.pieces import log10_lead
from roadgeo.matching.query import Query
from roadgeo.matching.twins import Twin, TwinOptions, best_twin, loses_part
from roadgeo.matching.verdict import decide
from roadgeo.roads.graph import RoadGraph

NOTHING = RoadGraph.from_polylines(np.empty((0, 2)), np.empty((0, 2), int), [])


@pytest.fixture(scope="module")
def broken():
    return contest(0.8)


@pytest.fixture(scope="module")
def wider():
    return contest(0.8, (900, 700))


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


def test_a_place_as_good_on_another_map_keeps_a_lead_from_proving_anything(wider):
    truth, index, among = wider
    nobody = np.full(len(among.scene.intersections), -1)
    fit = Fit(index, truth, nobody, np.zeros(len(nobody)), 0.9, 9.0, np.ones(4), agreement=0.9, by_twins=True)
    away = move_about(Homography(truth)(among.scene.center), Shift(900.0, 0.0, 0.0, 1.0, 0.0)) @ truth
    other = replace(fit, matrix=away, log10_odds=-2.0, by_twins=False)
    query = Query("view.png", among.scene, NOTHING, Seconds())
    answer = decide(query, [Found(index, (fit,)), Found(index, (other,))], LocateOptions())
    assert answer.status == "ambiguous"
    alone = decide(query, [Found(index, (fit,))], LocateOptions())
    assert alone.located
    assert "any other place where these streets repeat" in alone.reason


@pytest.fixture(scope="module")
def torn(wider):
    """Return a scene of which the streets of one corner lie elsewhere."""
    _, _, among = wider
    scene, (width, height) = among.scene, among.scene.size
    points = scene.dense_points.copy()
    points[(points[:, 0] < 0.45 * width) & (points[:, 1] > -0.45 * height)] += (40.0, 33.0)
    return replace(scene, dense_points=points)


@pytest.mark.parametrize(("odds", "status"), [(6.0, "not_located"), (12.0, "located")])
def test_a_weak_place_must_agree_all_over_the_frame(wider, torn, odds, status):
    truth, index, among = wider
    assert loses_part(truth, torn, index, MatchOptions(), TwinOptions())
    assert not loses_part(truth, among.scene, index, MatchOptions(), TwinOptions())
    nobody = np.full(len(torn.intersections), -1)
    twin = Twin(beside(truth, among), 4.0)
    fit = Fit(index, truth, nobody, np.zeros(len(nobody)), 0.8, odds, np.ones(4), agreement=0.8, twin=twin)
    answer = decide(Query("view.png", torn, NOTHING, Seconds()), [Found(index, (fit,))], LocateOptions())
    assert answer.status == status
    if status == "not_located":
        assert answer.log10_odds == 0.0
        assert answer.reason_code == Reason.NOTHING_STANDS_OUT
        assert "in a part of the frame the roads do not agree" in answer.reason


def test_only_what_the_user_allows_is_a_twin(broken):
    truth, index, among = broken
    options, middle = TwinOptions(n_places=12), Homography(truth)(among.scene.center)
    assert best_twin(truth, among.scene, index, MatchOptions(), options, (*middle, 20.0)) is None
    turned = MatchOptions(camera=CameraOptions(north_up=True))
    wrong = best_twin(beside(truth, among), among.scene, index, turned, options)
    assert wrong is None  # the view is turned by 15 degrees
