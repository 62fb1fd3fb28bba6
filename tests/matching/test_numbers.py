"""Numbers that decide: each of them, halved or doubled, fails a test here, and none of these searches."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from worlds.lattices import contest
from worlds.scenes import Sight, camera, estimator_of, look, scene_of

from roadgeo.geometry.homography import Homography
from roadgeo.geometry.mask import PIXEL_TO_PLANE
from roadgeo.matching import checking, rivals, verdict
from roadgeo.matching.events import Ledger
from roadgeo.matching.evidence import Evidence, _anyhow, _log_ratios, statement_px, tolerance_m
from roadgeo.matching.hints import read_hint
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.picture import Picture
from roadgeo.matching.place import Place
from roadgeo.matching.refinement import Refined
from roadgeo.matching.rivals import Rivals, log10_gap
from roadgeo.matching.search import Search
from roadgeo.matching.shifts import Shift, move_about, shifted

SIZE = (900, 700)
TRUTH = camera((2000, 2000), SIZE, 1.0, 20.0, 10.0, 0.0)


# --- likelihoods ------------------------------------------------------------------------------------------------------


def test_a_statement_is_480_m_of_road_and_roads_agree_within_three_deviations():
    assert [statement_px(gsd_m) for gsd_m in (0.5, 1.0, 10.0)] == [960.0, 480.0, 96.0]
    assert [tolerance_m(gsd_m) for gsd_m in (0.5, 10.0)] == pytest.approx([5.604, 30.482], abs=1e-3)


def test_ratios_of_residuals_are_those_of_the_formula():
    """24 residuals of up to four usual deviations, and none: log[(1 - f) g(r; sigma) / b + f]."""
    residual = (np.arange(24) + 0.5) / 6.0
    for n, sigma in enumerate((0.25, 0.3976, 0.6325, 1.0059, 1.6)):
        usual = math.sqrt(2.0 / math.pi) / sigma * np.exp(-0.5 * (residual / sigma) ** 2)
        for k, share in enumerate((0.04, 0.1351, 0.2862, 0.4935, 0.7569)):
            expected = np.log((1.0 - share) * np.append(4.0 * usual / 0.5, 0.0) + share)
            assert _log_ratios(math.log(0.5), 0.0)[n, k] == pytest.approx(expected, rel=1e-3, abs=1e-3)


def test_roads_by_chance_are_not_less_than_the_least_share():
    assert [_anyhow(expected) for expected in (10.0, 1.0, 0.3, 0.1, 1e-6)] == [0.0, -0.5, -1.4, -2.4, -3.2]


@pytest.fixture(scope="module")
def view(town):
    """A view of the town, where a tenth of the roads are false and three tenths missing, and what weighs places."""
    scene = scene_of(look(town[0], TRUTH, SIZE, Sight(1.5, 0.3, 0.1)), SIZE)
    return Evidence(scene, town[1], 1.0)


def test_places_of_a_town_weigh_what_they_did(view):
    beside = shifted(TRUTH, 7.0, 4.0)
    middle = Homography(TRUTH)(view.scene.center)
    turned = move_about(middle, Shift(0.0, 0.0, 1.5, 1.0, 0.0)) @ TRUTH
    weighed = [view.weigh(TRUTH), view.weigh(beside), view.agreement(beside).forward, view.agreement(beside).backward]
    weighed += [view.nearby(TRUTH), *view.compared_with(TRUTH)(turned), view.contradicted(turned)]
    weighed += [view.shared(TRUTH, turned), view.mapped_px(TRUTH)]
    kept = [34.4645, 14.1790, 0.5983, 0.7082, -1.8553, 11.7078, 18.4045, 0.1099, 1.0, 8269.075]
    assert weighed == pytest.approx(kept, rel=1e-3)


# --- the lead over rivals ---------------------------------------------------------------------------------------------


def test_a_gap_is_judged_by_the_next_twenty_places():
    assert log10_gap(50.0, [40.0] * 5) == 0.0  # too few others
    assert log10_gap(50.0, [40.0] * 6) == pytest.approx(5 * math.log10(1.0 + 10.0 / (5 * 0.3)))
    assert log10_gap(50.0, [40.0] * 21) == pytest.approx(20 * math.log10(1.0 + 10.0 / (20 * 0.3)))
    assert log10_gap(50.0, [40.0] * 21 + [0.0] * 30) == log10_gap(50.0, [40.0] * 21)


def test_contradicted_roads_cost_up_to_60():
    assert rivals._penalty(SimpleNamespace(contradicted=0.1)) == pytest.approx(6.0)


def test_places_of_large_maps_lose_what_chance_gives_them():
    assert Rivals({}, Ledger(n_reference=15_000), 3.5)._by_chance == 0.0
    assert Rivals({}, Ledger(n_reference=1_500_000), 3.5)._by_chance == pytest.approx(2.0)


@pytest.fixture(scope="module")
def lattice():
    return contest(0.8, (900, 700))


def scored(place, score):
    return place.but(score=score, rival=None)


def test_the_picture_is_asked_where_traced_roads_lead_by_less_than_12(lattice, monkeypatch):
    truth, index, evidence = lattice
    estimator = estimator_of(evidence.scene, index)
    estimator.scene = replace(evidence.scene, probability=np.zeros((2, 2), np.float32))
    place, part = Place(evidence.scene, index, truth), Search(estimator)
    compared = Rivals({part: estimator}, Ledger(n_reference=866), 3.5)
    elsewhere = Place(evidence.scene, index, shifted(truth, 400.0, 0.0))
    monkeypatch.setattr(estimator, "look_for_equals", lambda *_: True)
    monkeypatch.setattr(compared, "_by_picture", lambda _: scored(elsewhere, 4.0))
    monkeypatch.setattr(compared, "_by_roads", lambda _: scored(place, 12.0))
    assert compared.compare(part).score == 12.0
    monkeypatch.setattr(compared, "_by_roads", lambda _: scored(place, 11.9))
    assert compared.compare(part).score == pytest.approx(7.9)


@pytest.mark.parametrize(
    ("nearby", "contradicted", "lead", "is_certain"),
    [
        (0.45, 0.0, 12.5, True),
        (0.55, 0.0, 12.5, False),  # streets repeat
        (0.45, 0.005, 12.5, False),
        (0.45, 0.0, 11.5, False),
    ],
)
def test_a_place_is_certain_where_it_leads_by_12_nothing_speaks_against_it_and_streets_do_not_repeat(
    lattice, monkeypatch, nearby, contradicted, lead, is_certain
):
    truth, index, evidence = lattice
    estimator = estimator_of(evidence.scene, index)
    place = scored(Place(evidence.scene, index, truth), lead)
    vars(place).update(contradicted=contradicted, refined=object())
    monkeypatch.setattr(estimator, "nearby", lambda _: nearby * place.log10_likelihood)
    monkeypatch.setattr(rivals, "similar_places", lambda *_: [])
    compared = Rivals({}, Ledger(n_reference=10**9), 3.5)._compare(estimator, place, [place])
    assert (compared.score == pytest.approx(lead - 60.0 * contradicted)) is is_certain


@pytest.mark.parametrize(("share", "is_searched"), [(0.4, False), (0.6, True)])
def test_streets_around_are_searched_where_half_of_the_lead_needed_is_there(lattice, monkeypatch, share, is_searched):
    truth, index, evidence = lattice
    estimator, reached = estimator_of(evidence.scene, index), []
    place = scored(Place(evidence.scene, index, truth), 5.0)
    explained = place.log10_likelihood
    vars(place).update(contradicted=explained * (1.0 - share) / 60.0, refined=object())
    monkeypatch.setattr(estimator, "nearby", lambda _: 0.0)
    monkeypatch.setattr(rivals, "similar_places", lambda *args: reached.append(args[-1].reach_m) or [])
    Rivals({}, Ledger(n_reference=866), explained)._compare(estimator, place, [place])
    assert bool(reached) is is_searched


@pytest.mark.parametrize(
    ("east_m", "shared", "is_rival"), [(15.0, 0.0, False), (30.0, 0.0, True), (30.0, 0.6, True), (30.0, 0.75, False)]
)
def test_another_place_lies_apart_and_meets_other_roads(lattice, monkeypatch, east_m, shared, is_rival):
    """By 4 hundredths of half the frame's diagonal, 23 m here, and a third of its roads."""
    truth, index, evidence = lattice
    estimator = estimator_of(evidence.scene, index)
    place, other = (scored(Place(evidence.scene, index, shifted(truth, east, 0.0)), 5.0) for east in (0.0, east_m))
    vars(place).update(contradicted=0.0, refined=object())
    monkeypatch.setattr(Evidence, "shared", lambda *_: shared)
    monkeypatch.setattr(estimator, "nearby", lambda _: 0.0)
    monkeypatch.setattr(rivals, "similar_places", lambda *_: [])
    compared = Rivals({}, Ledger(n_reference=866), 3.5)._compare(estimator, place, [place, other])
    assert (compared.rival is not None) is is_rival


def test_the_picture_counts_a_statement_each_250_m_and_no_likelihood_beyond_10(view):
    soft = replace(view.scene, probability=np.zeros((2, 2), np.float32))
    assert [Picture(soft, view.index, gsd_m).statement_px for gsd_m in (1.0, 10.0)] == [250.0, 50.0]
    assert Picture.lead(8.0, 3.0) == pytest.approx(5.0)
    assert Picture.lead(20.0, 15.0) == pytest.approx(2.5)


@pytest.mark.parametrize(("score", "is_compared"), [(1.5, False), (3.0, True)])
def test_a_place_that_leads_those_met_by_2_is_compared_with_places_nearby(view, monkeypatch, score, is_compared):
    estimator, asked = estimator_of(view.scene, view.index), []
    monkeypatch.setattr(estimator, "_scored", lambda place: place)
    monkeypatch.setattr(estimator, "nearby", asked.append)
    estimator._weigh(SimpleNamespace(score=score))
    assert bool(asked) is is_compared


# --- hints, and places that are given ---------------------------------------------------------------------------------


def test_a_heading_may_be_off_by_10_degrees_and_a_single_scale_by_a_quarter():
    assert read_hint("heading", "90") == ("heading_deg", (90.0, 10.0))
    assert read_hint("gsd", "0.3") == ("gsd_m", pytest.approx((0.24, 0.375)))


@pytest.mark.parametrize(("significance", "found"), [(15.0, "unknown"), (22.0, "off")])
def test_a_place_is_off_where_chance_moves_one_in_1000_so_far(lattice, monkeypatch, significance, found):
    truth, index, evidence = lattice
    offset = SimpleNamespace(over=lambda _: 20.0, sigma_over=lambda _: 1.0, significance=significance)
    monkeypatch.setattr(checking, "_displacement", lambda *_: offset)
    location = SimpleNamespace(
        located=True, places=[SimpleNamespace(matrix=truth @ PIXEL_TO_PLANE, score=9.0, rival=None)]
    )
    given = Place(evidence.scene, index, truth)
    assert checking._judge(location, given, checking.CheckOptions()).verdict == found


# --- the verdict ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("agreeing", "are_alike"), [(0.8, False), (0.9, True)])
def test_two_places_are_alike_where_both_agree_like_the_truth(agreeing, are_alike):
    assert verdict._are_alike(SimpleNamespace(agreeing=0.95), SimpleNamespace(agreeing=agreeing)) is are_alike


@pytest.mark.parametrize(("along_m", "is_half"), [(25.0, False), (35.0, True)])
def test_a_place_is_half_known_where_its_middle_is_uncertain_by_3_hundredths_of_the_frame(along_m, is_half):
    error = SimpleNamespace(along_m=along_m, across_m=3.0, azimuth_deg=45.0)
    assert bool(verdict._only_half(SimpleNamespace(center_error=error, gsd_m=1.0, size=(1000, 1000)))) is is_half


@pytest.mark.parametrize(("lost", "is_level"), [(0.015, True), (0.03, False)])
def test_a_camera_looks_straight_down_where_that_loses_hardly_a_road(monkeypatch, lost, is_level):
    level = SimpleNamespace(matrix=np.eye(3), corner_covariance=np.eye(8), by_tilt=0.0)
    monkeypatch.setattr(verdict, "find_similarity", lambda *_: level)
    place, levelled = (SimpleNamespace(agreement=SimpleNamespace(forward=forward)) for forward in (0.9, 0.9 - lost))
    vars(place).update(
        refined=Refined(np.eye(3), 1.0, np.eye(8), 0.0, 0.0, 1.0), lens_k1=0.0, matrix=np.eye(3), at=lambda _: levelled
    )
    vars(place).update(scene=SimpleNamespace(corners=None))
    assert (verdict._level(place) is levelled) is is_level


def test_a_score_of_3_5_is_needed():
    assert LocateOptions().min_log10_odds == 3.5
