"""`examples/company`: each of its sets on the roads of the demonstration, and its counts."""

import csv
import subprocess
import sys
from pathlib import Path

import pytest

from roadgeo.evaluation.demo import ROADS

COMPANY = Path(__file__).parents[2] / "examples" / "company" / "company.py"


def run(what: str, folder: Path) -> str:
    command = [sys.executable, "-W", "error", COMPANY, what, "-n", 1, "--cities", ROADS, "--atlas", ROADS]
    command += ["--maps", folder / "maps", "--out", folder]
    return subprocess.run(list(map(str, command)), capture_output=True, text=True, check=True).stdout


@pytest.mark.parametrize(("what", "searches"), [("shards", 2), ("told", 4), ("twice", 3), ("soft", 4)])
def test_a_set_is_searched_once_and_counted(what: str, searches: int, tmp_path: Path) -> None:
    counted = run(what, tmp_path)
    with (tmp_path / f"{what}.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == searches
    assert not [row for row in rows if row["status"] == "located" and row["right"] == "0"]
    assert run(what, tmp_path) == counted  # nothing is searched again


def test_counts_of_the_kept_results_are_printed(tmp_path: Path) -> None:
    (tmp_path / "told.csv").write_text(
        "city,kind,k,seed,status,right,code,score,off_m,cpu_s,commit\n"
        'porto,"frame512, false",0,1,not_located,0,fits_elsewhere,1.0,nan,0.50,a\n'
        'porto,"frame512, false",1,1,located,0,located,4.0,nan,0.25,a\n'
    )
    assert "| frame512, false | 0 of 2 (0 to 84 %) | 1 | 0 | 1 | 0.25, 0.25 | 0.5, 0.5 |" in run("table", tmp_path)
