"""Running locators over query sets."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from roadgeo.errors import OutputError
from roadgeo.evaluation.noise import NOISE_MODELS
from roadgeo.evaluation.simulation import SimulationOptions, ViewOptions
from roadgeo.evaluation.trials import DrawnMasks, MaskFiles, run_trials
from roadgeo.evaluation.truth import Truth


def truth(k):
    return Truth(f"q_{k}.png", "clean", np.eye(3) * (k + 1), "EPSG:32619", (10, 10), True, {"tilt_deg": float(k)})


@dataclass(frozen=True)
class Numbers:
    """Queries whose mask is their own number."""

    count: int

    def __len__(self):
        return self.count

    def open(self):
        return lambda k: (truth(k), np.full((2, 2), k))


@dataclass(frozen=True)
class Adder:
    """Answers with the mask's sum; says so in a file, to be counted."""

    log: Path | None = None
    breaks_at: int = -1

    def open(self):
        def locate(mask):
            if self.log:
                with self.log.open("a") as file:
                    file.write("x")
            if mask.sum() == self.breaks_at:
                raise KeyboardInterrupt
            return {"status": "located", "sum": int(mask.sum())}

        return locate


def sums(trials):
    return [trial.answer["sum"] for trial in trials]


@pytest.mark.parametrize("jobs", [1, 2])
def test_answers_come_in_order_whoever_works(jobs):
    seen = []
    trials = run_trials(Numbers(5), Adder(), jobs, progress=seen.append)
    assert sums(trials) == [0, 4, 8, 12, 16]
    assert seen == [trial.status for trial in trials]
    assert [trial.truth.file for trial in trials] == [truth(k).file for k in range(5)]


def test_an_interrupted_run_goes_on(tmp_path):
    record, log = tmp_path / "trials.jsonl", tmp_path / "log"
    with pytest.raises(KeyboardInterrupt):
        run_trials(Numbers(5), Adder(log, breaks_at=12), 1, record, {"seed": 1})
    with record.open("a") as file:
        file.write('{"truth": {"fi')  # as if the power had gone
    trials = run_trials(Numbers(5), Adder(log), 1, record, {"seed": 1})
    assert sums(trials) == [0, 4, 8, 12, 16]
    assert np.array_equal(trials[1].truth.homography, truth(1).homography)
    assert len(log.read_text()) == 4 + 2
    assert len(record.read_text().splitlines()) == 1 + 5
    again = run_trials(Numbers(5), Adder(log), 1, record, {"seed": 1})
    assert sums(again) == sums(trials)
    assert len(log.read_text()) == 6


def test_records_of_other_runs_are_left_alone(tmp_path):
    record = tmp_path / "trials.jsonl"
    run_trials(Numbers(1), Adder(), 1, record, {"seed": 1})
    before = record.read_text()
    with pytest.raises(OutputError, match="another run"):
        run_trials(Numbers(1), Adder(), 1, record, {"seed": 2})
    assert record.read_text() == before
    assert json.loads(before.splitlines()[0])["settings"] == {"seed": 1}


def test_a_record_needs_its_folder(tmp_path):
    with pytest.raises(OutputError):
        run_trials(Numbers(1), Adder(), 1, tmp_path / "nowhere" / "trials.jsonl")


def test_mask_files_are_named_by_their_folder():
    queries = MaskFiles(Path("set"), (truth(0), truth(1)))
    assert len(queries) == 2
    assert queries.open()(1)[1] == str(Path("set") / "q_1.png")


def test_masks_are_drawn_set_by_set(monkeypatch):
    from worlds.towns import lattice_town

    from roadgeo.evaluation import trials

    town = lattice_town()
    monkeypatch.setattr(trials, "read_landscape", lambda *_: town)
    clean = SimulationOptions(ViewOptions(size_px=(300, 300), intersections=(3, 99)), NOISE_MODELS["clean"], "clean")
    queries = DrawnMasks(Path("ref.gpkg"), ((clean, 2), (replace(clean, kind="again"), 1)))
    assert len(queries) == 3
    draw = queries.open()
    assert [draw(k)[0].file for k in range(3)] == ["clean/q_0000.png", "clean/q_0001.png", "again/q_0000.png"]
    assert draw(2)[1].shape == (300, 300)
