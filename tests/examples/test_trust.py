"""`examples/trust`: its counts, bounds and blocks; and that a run is made and goes on."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from roadgeo.evaluation.truth import Truth

TRUST = Path(__file__).parents[2] / "examples" / "trust" / "trust.py"


@pytest.fixture(scope="module")
def trust():
    spec = importlib.util.spec_from_file_location("trust", TRUST)
    module = importlib.util.module_from_spec(spec)
    sys.modules["trust"] = module
    spec.loader.exec_module(module)
    return module


def test_bounds_are_those_of_clopper_and_pearson(trust):
    # Of none in n the upper bound is 1 - (rest / 2)^(1 / n); 5 of 20: tables of the binomial distribution.
    assert trust.bounds(0, 100) == pytest.approx((0.0, 1 - 0.025 ** (1 / 100)))
    assert trust.bounds(100, 100) == pytest.approx((0.025 ** (1 / 100), 1.0))
    assert trust.bounds(5, 20) == pytest.approx((0.0866, 0.4910), abs=1e-4)


def test_rows_are_counted_by_threshold_band_and_kind(trust):
    rows = [
        trust.Row("porto", 1, "there", "mild", 20.0, True, 0.1),
        trust.Row("porto", 1, "there", "few", -np.inf, False, 0.1),  # ambiguous
        trust.Row("porto", 1, "there", "noisy", 4.2, False, 0.1),
        trust.Row("porto", 1, "elsewhere", "mild", 3.7, False, 0.1),
        trust.Row("porto", 1, "mirrored", "torn", 2.1, False, 0.1),
    ]
    reported = {row[0]: row[1:] for row in trust.threshold_table(rows, 3.5)}
    assert reported["2"][:2] == ["-", "-"]
    assert reported["2"][2].startswith("2 of 2")
    assert [cell.split(":")[0] for cell in reported["3.5"]] == ["1 of 3", "1 of 3", "1 of 2"]
    assert [cell.split(":")[0] for cell in reported["5"]] == ["1 of 3", "0 of 3", "0 of 2"]
    bands = {row[0]: row[1:] for row in trust.band_table(rows, 3.5)}
    assert bands["3.5 to 5"][0] == "2"
    assert bands["3.5 to 5"][1].startswith("2 of 2")
    assert bands["5 to 8"][0] == "0"
    kinds = {row[0]: row for row in trust.kind_table(rows, 3.5)}
    assert kinds["elsewhere"][-2] == "3.7"


@pytest.mark.parametrize(("status", "score"), [("located", 5.5), ("ambiguous", -np.inf)])
def test_half_a_place_is_reported_at_no_threshold(trust, status, score):
    truth = Truth("a.png", "there_few", np.eye(3), None, (100, 100))
    answer = {"status": status, "log10_odds": 5.5}
    assert trust.row_of("porto", 1, "there", trust.Trial(truth, answer)).score == score


def test_rows_come_back_from_their_file(trust, tmp_path):
    rows = [
        trust.Row("porto", 1, "there", "mild", 20.25, True, 0.5),
        trust.Row("chicago", 2, "mirrored", "torn", -np.inf, False, 1.25),
    ]
    trust.write_rows(tmp_path / "quick.csv", rows)
    assert trust.read_rows(tmp_path / "quick.csv") == rows


def test_shuffled_masks_keep_their_roads_but_not_their_places(trust):
    mask = (np.random.default_rng(1).random((120, 126)) > 0.9).astype(np.uint8) * 255
    mixed = trust.shuffled(mask, 3)
    assert mixed.shape == (120, 120)
    assert (mixed > 0).sum() == (mask[:, :120] > 0).sum()
    assert (mixed != mask[:, :120]).mean() > 0.1
