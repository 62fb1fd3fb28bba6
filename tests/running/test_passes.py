"""Several passes share the limits of one search, and each costs its part of the odds."""

from dataclasses import replace

import numpy as np
import pytest
from worlds.answers import moved, placed

from roadgeo.errors import MaskError
from roadgeo.geometry.mask import RoadMask
from roadgeo.location import Location, Reason, Spent, Stats
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.verdict import how_clear
from roadgeo.running.passes import PassRoads, locate_passes

OPTIONS = LocateOptions()
MASK = RoadMask(np.eye(40, dtype=bool))
H = np.array([[2.0, 0.0, 500_000.0], [0.0, -2.0, 5_500_000.0], [0.0, 0.0, 1.0]])


def found(status="located", odds=9.0, east_m=0.0, seconds=1.0):
    places = () if status == "not_located" else (moved(placed(H, "EPSG:32632", score=odds), east_m, 0.0),)
    return Location("q", status, "why", places=places, spent=Spent(stats=Stats(work_ms=round(1000 * seconds))))


def take(*answers, options=OPTIONS):
    """Locate passes whose answers are given; return the sighting and the limits of work that were set."""
    limits, left = [], list(answers)

    def how(mask, references, options):
        limits.append(options.search.work_limit_s)
        answer = left.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer

    passes = range(len(answers))
    return locate_passes(passes, lambda i: PassRoads(f"pass {i}", MASK), [], options, how).location, limits


def test_the_first_pass_that_is_located_is_the_answer():
    location, limits = take(found(), found(odds=30.0))
    assert location.log10_odds == 9.0
    assert location.reason == "why"
    assert limits == [6.0]


def test_a_single_pass_has_all_the_time():
    assert take(found())[1] == [10.0]


def test_each_pass_costs_its_part_of_the_odds_and_of_the_time():
    location, limits = take(found("not_located"), MaskError("no road"), found(odds=9.0))
    assert location.status == "located"
    assert location.log10_odds == pytest.approx(9 - np.log10(3))
    assert location.places[0].score == location.log10_odds
    assert "its roads were traced in 3 ways, here at pass 2" in location.reason
    np.testing.assert_allclose(limits, [6.0, 5.4, 9.0])


def test_a_place_where_the_map_has_nothing_is_no_place_for_other_passes():
    nothing = replace(found("not_located"), reason="0 intersections", reason_code=Reason.FEW_NEAR)
    location, limits = take(nothing, found(odds=30.0))
    assert location.reason == "0 intersections"
    assert limits == [6.0]


@pytest.mark.parametrize(("lead", "n_passes"), [(6.9, 2), (7.0, 1)])
def test_where_the_roads_fit_far_better_elsewhere_no_other_pass_is_taken(lead, n_passes):
    elsewhere = replace(found(odds=lead), status="not_located", reason_code=Reason.FITS_ELSEWHERE)
    location, limits = take(elsewhere, found("not_located"))
    assert location.reason_code is Reason.FITS_ELSEWHERE
    assert len(limits) == n_passes


def test_that_the_image_is_mirrored_is_told_though_another_pass_has_a_better_score():
    mirrored = replace(found(odds=-5.0), status="not_located", reason="flip it", reason_code=Reason.MIRRORED)
    refused = replace(found(odds=1.0), status="not_located")
    assert take(mirrored, refused)[0].reason.startswith("flip it")


def test_what_is_too_unlikely_for_a_second_pass_is_refused():
    location, _ = take(MaskError("no road"), found(odds=OPTIONS.min_log10_odds + 0.2))
    assert location.status == "not_located"
    assert location.center is None
    assert location.log10_odds < OPTIONS.min_log10_odds
    assert location.reason == "one place stands out, at pass 1, but not clearly enough"


def test_a_refusal_counts_the_ways_once():
    unsure = found(odds=OPTIONS.min_log10_odds + 0.2)
    location, _ = take(found("not_located"), unsure, found("not_located"))
    assert location.reason == "one place stands out, at pass 1, but not clearly enough; its roads were traced in 3 ways"


def test_no_pass_is_taken_when_the_time_is_gone():
    location, limits = take(found("not_located", seconds=9.8), found())
    assert location.status == "not_located"
    assert len(limits) == 1


@pytest.mark.parametrize(("odds", "said"), [(3.0, "a score of 2.6, 3.5"), (0.3, "another fits as well")])
def test_a_refusal_states_the_score_that_it_lists(odds, said):
    refused = replace(found(odds=odds), status="not_located", reason=f"none: {how_clear(odds, 3.5)}; more may help")
    location, _ = take(MaskError("no road"), refused)
    assert location.log10_odds == pytest.approx(odds - np.log10(2))
    assert said in location.reason
    assert "more may help" in location.reason


def test_what_is_ambiguous_stays_so_in_a_later_pass():
    """It had no score that could be lost: its places are equal."""
    equal = replace(found("ambiguous", odds=0.4), reason="streets repeat", reason_code=Reason.TWO_PLACES)
    location, _ = take(found("not_located"), equal)
    assert (location.status, location.reason_code) == ("ambiguous", Reason.TWO_PLACES)
    assert location.reason == "streets repeat; its roads were traced in 2 ways, here at pass 1"


def test_two_passes_at_two_places_are_ambiguous():
    location, _ = take(found("ambiguous", odds=10.0, east_m=30_000.0), found(odds=9.0))
    assert location.status == "ambiguous"
    assert location.runner_up.center.x == pytest.approx(location.center.x + 30_000.0)
    assert location.alternatives == (location.runner_up,)
    same, _ = take(found("ambiguous", odds=10.0), found(odds=9.0))
    assert same.status == "located"


def test_passes_that_show_nothing_raise_the_first_reason():
    with pytest.raises(MaskError, match="first"):
        take(MaskError("first"), MaskError("second"))
    with pytest.raises(MaskError, match="nothing to look at"):
        take()
