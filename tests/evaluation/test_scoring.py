"""Scores, shares and calibration."""

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from roadgeo.evaluation.scoring import (
    Score,
    break_down,
    calibrate_scores,
    calibrate_sigma,
    evaluate,
    score,
    share,
    summarize,
)
from roadgeo.evaluation.truth import Truth
from roadgeo.location import ERROR_RATES

MATRIX = np.array([[1.0, 0.0, 330000.0], [0.0, -1.0, 4690000.0], [0.0, 0.0, 1.0]])
TRUTH = Truth("a.png", "clean", MATRIX, "EPSG:32619", (1000, 800), True, {"n_intersections": 40, "tilt_deg": 5})


def answer(east=0.0, **changes):
    """A result like `Location.to_dict` whose place is `east` metres beside the truth."""
    shifted = MATRIX.copy()
    shifted[0, 2] += east
    return {
        "status": "located",
        "crs": "EPSG:32619",
        "size": [1000, 800],
        "homography": shifted.tolist(),
        "corner_sigma_m": [1.0] * 4,
        "log10_odds": 7.5,
        "error_rate": {"kind": "mask", "score": 5.0, "at_most": 0.154},
        "seconds": {"open": 1.0, "vectorize": 0.01, "match": 0.02, "refine": 0.03},
    } | changes


@pytest.mark.parametrize(
    ("location", "status", "right", "error"),
    [
        (answer(3.0), "located", True, 3.0),
        (answer(19.9), "located", True, 19.9),
        (answer(20.1), "located", False, 20.1),
        (answer(3.0, status="ambiguous"), "ambiguous", False, 3.0),
        (answer(status="not_located", homography=None, log10_odds=None), "not_located", False, math.nan),
        (None, "missing", False, math.nan),
    ],
)
def test_right_is_located_near_the_truth(location, status, right, error):
    got = score(TRUTH, location)
    assert (got.status, got.right) == (status, right)
    assert got.center_m == pytest.approx(error, nan_ok=True)
    assert got.corners_rms_m == pytest.approx(error, nan_ok=True)


def test_a_homography_counts_whatever_its_scale_and_sign():
    location = answer(3.0)
    location["homography"] = (-0.5 * np.array(location["homography"])).tolist()
    assert score(TRUTH, location).center_m == pytest.approx(3.0)


def test_results_in_another_crs_are_compared_on_the_ground():
    import pyproj

    to_state = pyproj.Transformer.from_crs("EPSG:32619", "EPSG:26986", always_xy=True)
    corners = np.column_stack(to_state.transform(*TRUTH.footprint.T))
    matrix = np.eye(3)
    matrix[:2] = np.linalg.lstsq(
        np.array([[0, 0, 1], [1000, 0, 1], [1000, 800, 1], [0, 800, 1]], float), corners, rcond=None
    )[0].T
    got = score(TRUTH, answer(crs="EPSG:26986", homography=matrix.tolist()))
    assert got.right
    assert got.center_m < 0.5


def test_masks_without_a_place_count_against_precision_only():
    absent = Truth("b.png", "absent", MATRIX, "EPSG:32619", (1000, 800), on_map=False)
    scores = [score(TRUTH, answer()), score(absent, answer()), score(absent, answer(status="not_located"))]
    total = summarize("all", scores)
    assert (total.precision.hits, total.precision.of) == (1, 2)
    assert (total.recall.hits, total.recall.of) == (1, 1)
    assert (total.refused.hits, total.refused.of) == (1, 2)


def test_seconds_are_those_of_the_work():
    assert score(TRUTH, answer()).compute_s == pytest.approx(0.06)
    assert summarize("all", [score(TRUTH, answer())]).compute_s.p95 == pytest.approx(0.06)


@pytest.mark.parametrize(
    ("hits", "of", "low", "high"),
    [(0, 10, 0.0, 0.2775), (5, 10, 0.2366, 0.7634), (10, 10, 0.7225, 1.0), (81, 263, 0.2553, 0.3662)],
)
def test_wilson_as_published(hits, of, low, high):
    got = share(hits, of)
    assert (got.low, got.high) == (pytest.approx(low, abs=1e-4), pytest.approx(high, abs=1e-4))


def test_a_share_of_nothing_is_unknown():
    assert math.isnan(share(0, 0).value)


@given(st.integers(1, 500).flatmap(lambda of: st.tuples(st.integers(0, of), st.just(of))))
def test_intervals_hold_their_value(trials):
    got = share(*trials)
    assert 0 <= got.low <= got.value + 1e-12
    assert got.value - 1e-12 <= got.high <= 1


def test_breakdowns_put_each_query_into_one_class():
    scores = [
        Score(f"{n}", "k", True, "located", True, properties={"n_intersections": n}) for n in (3, 12, 29, 30, 31, 999)
    ] + [Score("unknown", "k", True, "located", True)]
    table = break_down(scores, "n_intersections")
    assert [(s.name, s.queries) for s in table] == [("0 to 12", 1), ("12 to 30", 2), ("30 to 60", 2), (">= 240", 1)]
    assert [s.name for s in break_down(scores, "kind")] == ["k"]


def located(n_wrong, promise):
    return [Score("", "k", True, "located", k >= n_wrong, promise=promise) for k in range(200)]


@pytest.mark.parametrize(("kind", "rate"), [(kind, rate) for kind, rates in ERROR_RATES.items() for rate in rates])
def test_scores_that_promise_too_much_are_told(kind, rate):
    promise = kind, rate.score, rate.at_most
    honest, boastful = (min(round(200 * part * rate.at_most), 190) for part in (0.5, 2.0))
    unpromised = [*located(200, None), *located(0, ("another kind", 0.0, 0.5))]
    (other, band) = calibrate_scores([*unpromised, *located(honest, promise)])
    assert ((band.kind, band.score), (band.wrong.hits, band.wrong.of)) == ((kind, rate.score), (honest, 200))
    assert (other.wrong.hits, other.holds, band.holds) == (0, True, True)
    assert [band.holds for band in calibrate_scores(located(boastful + 4, promise))] == [False]


def test_a_promise_is_the_error_rate_that_an_answer_states():
    assert score(TRUTH, answer()).promise == ("mask", 5.0, 0.154)
    assert score(TRUTH, answer(error_rate=None)).promise is None


@pytest.mark.parametrize("scale", [0.5, 1.0, 2.0])
def test_sigmas_are_measured_by_the_errors(scale):
    rng = np.random.default_rng(5)
    errors = np.hypot(*rng.normal(0.0, scale * 1.5 / math.sqrt(2), (2, 4000, 4)))
    scores = [Score("", "k", True, "located", True, 1.0, tuple(row), (1.5,) * 4) for row in errors.tolist()]
    got = calibrate_sigma(scores)
    assert got.rms == pytest.approx(scale, rel=0.02)
    assert got.robust == pytest.approx(scale, rel=0.03)
    if scale == 1.0:
        assert got.within_1.value == pytest.approx(0.632, abs=0.01)
        assert got.within_2.value == pytest.approx(0.982, abs=0.005)


def test_no_results_are_no_calibration():
    assert math.isnan(calibrate_sigma([]).rms)
    assert all(band.holds for band in calibrate_scores([]))


def test_an_evaluation_is_plain_json():
    table = evaluate([TRUTH, TRUTH], [answer(), None], {"seed": 1}).to_dict()
    assert json.loads(json.dumps(table, allow_nan=False)) == table
    assert table["schema"] == "roadgeo.evaluation/1"
    assert table["total"]["recall"]["value"] == 0.5
    assert table["settings"] == {"radius_m": 20.0, "seed": 1}
    assert list(table["breakdowns"]) == ["kind"]
