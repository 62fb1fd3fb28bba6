"""`examples/company`: each of its sets on the roads of the demonstration, and its counts."""

import csv
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

from roadgeo.evaluation.demo import ROADS

COMPANY = Path(__file__).parents[2] / "examples" / "company" / "company.py"


@pytest.fixture
def company(monkeypatch: pytest.MonkeyPatch):
    """The program, in this process, for it starts once for all its sets."""
    monkeypatch.syspath_prepend(str(COMPANY.parent))
    return importlib.import_module("company")


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the maps, which several sets search."""
    return tmp_path_factory.mktemp("maps")


@pytest.mark.parametrize(("what", "searches"), [("shards", 2), ("told", 4), ("twice", 3), ("soft", 4)])
def test_a_set_is_searched_once_and_counted(
    what: str, searches: int, company, maps: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = [what, "-n", 1, "--cities", ROADS, "--atlas", ROADS, "--maps", maps, "--out", tmp_path]
    company.main(list(map(str, command)))
    counted = capsys.readouterr().out
    with (tmp_path / f"{what}.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == searches
    assert not [row for row in rows if row["status"] == "located" and row["right"] == "0"]
    company.main(list(map(str, command)))
    assert capsys.readouterr().out == counted  # nothing is searched again


def test_counts_of_the_kept_results_are_printed(tmp_path: Path) -> None:
    (tmp_path / "told.csv").write_text(
        "city,kind,k,seed,status,right,code,score,off_m,cpu_s,commit\n"
        'porto,"frame512, false",0,1,not_located,0,fits_elsewhere,1.0,nan,0.50,a\n'
        'porto,"frame512, false",1,1,located,0,located,4.0,nan,0.25,a\n'
    )
    command = [sys.executable, "-W", "error", str(COMPANY), "table", "--out", str(tmp_path)]
    counted = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert "| frame512, false | 0 of 2 (0 to 84 %) | 1 | 0 | 1 | 0.25, 0.25 | 0.5, 0.5 |" in counted
