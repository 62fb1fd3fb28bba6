"""A place that leads all of its twins needs no odds against chance, which is other blocks there."""

import numpy as np
import pytest
from worlds.lattices import beside, contest

from roadgeo.matching import proof
from roadgeo.matching.estimator import TripleEstimator
from roadgeo.matching.hypothesis import Hypothesis
from roadgeo.matching.ledger import Ledger
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.proof import Prover
from roadgeo.matching.refinement import Refined
from roadgeo.matching.search import Search
from roadgeo.matching.twins import TwinOptions
from roadgeo.matching.verification import Agreement


@pytest.fixture(scope="module")
def wider():
    return contest(0.8, (900, 700))


def by_lead(wider, model, n_reference=15_000, **options):
    """Prove the places that a search has met; the first is the best."""
    _, index, among = wider
    ledger = Ledger(n_reference=n_reference)
    estimator = TripleEstimator(among.scene, index)
    one = Search(estimator)
    one.leaders = [(each.log10_odds, each) for each in model]
    prover = Prover({one: estimator}, LocateOptions(**options), ledger)
    return prover.proof(one), prover(one)


def met(wider, matrix, agreeing=0.9, chance=0.8, odds=-1.0):
    """Return a place that was met."""
    n = len(wider[2].scene.intersections)
    nobody = np.full(n, -1)
    refined = Refined(matrix, np.ones(4), 1.0, np.eye(8))
    found = Agreement(round(agreeing * n), n, agreeing, agreeing, 100)
    return Hypothesis(
        matrix, np.array([], int), 1.0, nobody, refined, found, (chance,) * 3, np.zeros(n), 1.0, log10_odds=odds
    )


def test_a_place_of_low_odds_is_proved_by_its_lead_where_streets_repeat(wider):
    truth, _, among = wider
    here, there = met(wider, truth), met(wider, beside(truth, among), agreeing=0.8)
    junk = met(wider, beside(truth, among), agreeing=0.4, chance=0.2, odds=2.0)
    proved, enough = by_lead(wider, [junk, here, there])
    assert proved.model is here
    assert proved.log10_odds == pytest.approx(proved.twin.log10_lead)
    assert enough
    assert proved.log10_odds > 5.5


def test_what_does_not_lead_its_twins_is_not_proved(wider):
    truth, _, among = wider
    places = [met(wider, beside(truth, among))]
    assert by_lead(wider, places) == (None, False)  # a part of the frame does not agree
    proved, enough = by_lead(wider, places, twins=TwinOptions(n_places=12, least_won=0.0))
    assert proved.log10_odds == 0.0
    assert not enough


def test_on_a_large_map_a_lead_proves_less(wider):
    proved, enough = by_lead(wider, [met(wider, wider[0])], n_reference=15_000 * 10**6)
    assert proved.log10_odds == pytest.approx(proved.twin.log10_lead - 6.0)
    assert not enough


@pytest.mark.parametrize(
    ("place", "options"),
    [
        ({"agreeing": 0.6}, {}),  # much of the mask has no place there
        ({"chance": 0.2}, {}),  # streets do not repeat
        ({"chance": 1.0}, {}),  # chance was not measured
        ({"odds": 25.0}, {}),  # beyond doubt
        ({}, {"twins": None}),
    ],
)
def test_not_every_place_is_compared(wider, place, options):
    assert by_lead(wider, [met(wider, wider[0], **place)], **options) == (None, False)
    assert by_lead(wider, []) == (None, False)


def test_a_place_is_compared_once_and_remembered(wider, monkeypatch):
    truth, index, among = wider
    estimator = TripleEstimator(among.scene, index)
    one, here = Search(estimator), met(wider, truth)
    prover = Prover({one: estimator}, LocateOptions(), Ledger(n_reference=866))
    one.leaders = [(-1.0, here)]
    first = prover.proof(one)
    assert one.seconds > 0.0  # it is part of the search
    monkeypatch.setattr(proof, "best_twin", None)
    one.leaders = [(2.0, met(wider, beside(truth, among), agreeing=0.4, chance=0.2, odds=2.0))]
    assert prover.proof(one) == first
