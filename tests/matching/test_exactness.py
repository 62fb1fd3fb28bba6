"""The odds of a place within finer tolerances: a place that agrees roughly has less, and exact ones little more."""

from dataclasses import replace

import numpy as np
import pytest
from worlds.scenes import Sight, camera, look, scene_of

from roadgeo.matching.exactness import exact_log10_odds, may_stand
from roadgeo.matching.hypothesis import Hypothesis
from roadgeo.matching.verification import VerifyOptions, agreement, chance_agreement, least_chance, log10_odds

OPTIONS = VerifyOptions()
NO_SEEDS = np.array([], int)
TRUTH = camera((2000, 1900), (1000, 1000), 1.0, 20.0, 50.0, 130.0)


@pytest.fixture(scope="module")
def scene(town):
    return scene_of(look(town[0], TRUTH, sight=Sight(0.5)))


def verified(matrix, scene, index, options=OPTIONS):
    """A place as the search verifies it, with the odds within the usual tolerance."""
    found, matched, distance = agreement(matrix, scene, index, 1.0, NO_SEEDS, options)
    chance = chance_agreement(matrix, scene, index, 1.0, options)
    odds = log10_odds(found, chance, scene.n_statements, 1, options)
    return Hypothesis(
        matrix, NO_SEEDS, 1.0, matched, found=found, chance=chance, distance=distance, gsd_m=1.0, log10_odds=odds
    )


def shifted(metres):
    return np.array([[1, 0, metres], [0, 1, 0], [0, 0, 1]]) @ TRUTH


def test_at_the_place_itself_the_odds_are_as_good(town, scene):
    model = verified(TRUTH, scene, town[1])
    exact = exact_log10_odds(model, scene, town[1], 1, OPTIONS, 1e3)
    assert model.log10_odds > 50
    assert exact > 0.9 * model.log10_odds


def test_what_agrees_roughly_has_less(town, scene):
    """Half of the roads lie 4 m off: within 6 m they agree."""
    model = verified(shifted(4.0), scene, town[1])
    assert model.found.forward > 0.9
    assert exact_log10_odds(model, scene, town[1], 1, OPTIONS, 1e3) < 0.75 * model.log10_odds


@pytest.fixture(scope="module")
def broken(town):
    """Two thirds of the roads are missing, and as many are false."""
    return scene_of(look(town[0], TRUTH, sight=Sight(0.5, 0.65, 0.65)))


def test_exactness_raises_odds_of_a_broken_mask_by_no_more_than_is_said(town, broken):
    model = replace(verified(TRUTH, broken, town[1]), log10_odds=2.0)
    assert exact_log10_odds(model, broken, town[1], 1, OPTIONS, 1e3) == 2.0 + OPTIONS.most_raised


def test_every_piece_of_a_whole_mask_is_a_statement(town, scene):
    """Two winding roads of a kilometre each are two roads, but hard to meet by chance."""
    few = replace(scene, n_edges=4, intersections=scene.intersections.only(np.arange(1)), branches=scene.branches[:1])
    model = verified(TRUTH, few, town[1])
    assert model.log10_odds < 3.5
    assert exact_log10_odds(model, few, town[1], 100_000, OPTIONS, 1e3) > 10.0


@pytest.mark.parametrize("worse", [4.0, None])
def test_pieces_of_no_other_mask_are(town, scene, broken, worse):
    one, matrix = (broken, TRUTH) if worse is None else (scene, shifted(worse))
    few = replace(one, n_edges=4, intersections=one.intersections.only(np.arange(1)), branches=one.branches[:1])
    model = verified(matrix, few, town[1])
    assert exact_log10_odds(model, few, town[1], 1, OPTIONS, 1e3) < model.log10_odds + OPTIONS.most_raised


def test_a_place_that_a_camera_cannot_see_stands_no_chance(town, scene):
    assert may_stand(replace(verified(TRUTH, scene, town[1]), log10_odds=-5.0), OPTIONS)
    assert not may_stand(replace(verified(TRUTH, scene, town[1]), log10_odds=-np.inf), OPTIONS)
    assert not may_stand(Hypothesis(TRUTH, NO_SEEDS, 1.0, NO_SEEDS), OPTIONS)


def test_places_tried_are_charged_once(town, scene):
    odds = []
    for tried in (1, 1000):
        model = verified(TRUTH, scene, town[1])
        model.log10_odds -= np.log10(tried)
        odds.append(exact_log10_odds(model, scene, town[1], tried, OPTIONS, 1e3))
    assert odds[0] - odds[1] == pytest.approx(3.0)


def test_what_is_beyond_doubt_is_not_measured_again(town, scene):
    model = verified(shifted(4.0), scene, town[1])
    assert exact_log10_odds(model, scene, town[1], 1, OPTIONS, 20.0) == model.log10_odds > 20


def test_without_finer_tolerances_nothing_changes(town, scene):
    model = verified(TRUTH, scene, town[1])
    assert exact_log10_odds(model, scene, town[1], 1, replace(OPTIONS, finer=()), 1e3) == model.log10_odds


def test_one_place_in_a_lattice_does_not_rule_out_the_others():
    """Chance is high there; elsewhere on the map it is not, and a place is not to be dropped for it."""
    lattice, elsewhere = np.array([0.4, 0.6, 0.8]), np.array([0.1, 0.25, 0.3])
    assert (least_chance([lattice]) < elsewhere).all()
    assert (least_chance([]) < elsewhere).all()
    assert least_chance([lattice, elsewhere, lattice, lattice]).tolist() == elsewhere.tolist()
