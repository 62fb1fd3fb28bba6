"""What is charged for the places that a search tried."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from roadgeo.matching import methods
from roadgeo.matching.estimator import TripleEstimator
from roadgeo.matching.hypothesis import Hypothesis
from roadgeo.matching.search import Search


def place(odds: float, n_tried: int, stage: int) -> Hypothesis:
    nobody = np.empty(0, np.int64)
    return Hypothesis(np.eye(3), nobody, 1.0, nobody, log10_odds=odds, n_tried=n_tried, leads=[(stage, 0)])


@pytest.fixture
def estimator():
    """An estimator after a search of two stages: 10,000 places were tried in the first, 500,000 in all."""
    made = TripleEstimator.__new__(TripleEstimator)
    made.ledger = SimpleNamespace(tried_by={0: 10_000, 1: 500_000}, n_tried=500_000)
    made.same = lambda a, b: a is b
    return made


def charged(estimator, *places):
    search = Search(SimpleNamespace(stages=lambda: iter(()), same=estimator.same, work=0.0))
    for one in places:
        search._enter(one.log10_odds, one)
    return methods._charge_alike(estimator, search)[0]


def test_a_place_does_not_lead_its_twin_by_having_been_met_first(estimator):
    first, twin = place(8.0, 10, 0), place(8.0 - 3.0, 10_000, 0)  # the same evidence
    result = charged(estimator, first, twin)
    assert (result.score, result.runner_up_score) == pytest.approx((5.0, 5.0))


def test_later_stages_cost_earlier_places_nothing(estimator):
    """Else full effort would refuse what quick effort locates."""
    assert charged(estimator, place(6.0, 100, 0)).score == pytest.approx(4.0)
    assert charged(estimator, place(6.0, 100_000, 1)).score == pytest.approx(6.0 - math.log10(5.0))


def test_a_place_met_again_in_a_later_stage_is_charged_as_in_the_first(estimator):
    estimator.same = lambda a, b: True
    early, late = place(7.0, 100, 0), place(4.0, 500_000, 1)  # the later fits better: 9.7 instead of 9.0
    result = charged(estimator, early, late)
    assert (result.best, result.score) == (late, pytest.approx(5.0))


def test_nothing_found_is_nothing_charged(estimator):
    assert charged(estimator).best is None
