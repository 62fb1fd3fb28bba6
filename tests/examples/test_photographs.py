"""`examples/photographs`: the photograph of the demonstration in each mode, and the counts."""

import csv
import importlib
import shutil
import subprocess
import sys
from pathlib import Path

import geopandas as gpd
import pytest
from support.documents import said, value

import roadgeo
from roadgeo.evaluation.demo import ROADS, STREETS
from roadgeo.matching.options import LocateOptions

NEEDED = LocateOptions().min_log10_odds
PHOTOGRAPHS = Path(__file__).parents[2] / "examples" / "photographs" / "photographs.py"
TRUTH = """file,label,lon,lat,gsd_m,heading_deg,kind,roads
berkeley_photo.jpg,,-122.2593,37.8717,0.9426,0,NAIP,berkeley_streets.gpkg
unknown.jpg,,0,0,1,0,,
"""
KEPT = """mode,file,maps,status,right,code,off_m,score,cpu_s,commit
blind,a.jpg,m,located,1,located,1.0,9.00,2.00,c
blind,b.jpg,m,not_located,0,nothing_stands_out,,2.50,4.00,c
"""


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path):
    """The program, in this process, for it starts once for all modes; returns what it prints."""
    monkeypatch.syspath_prepend(str(PHOTOGRAPHS.parent))
    program = importlib.import_module("photographs")

    def call(*arguments: object) -> str:
        folders = ["--out", tmp_path / "results.csv", "--built", tmp_path / "built"]
        program.main(list(map(str, [*arguments, *folders])))
        return capsys.readouterr().out

    return call


@pytest.mark.slow
def test_a_photograph_is_searched_once_in_each_mode(run, tmp_path: Path) -> None:
    folder = tmp_path / "photographs"
    folder.mkdir()
    (folder / "truth.csv").write_text(TRUTH)
    for path in (STREETS, STREETS.with_name("berkeley_photo.jpg")):
        shutil.copy(path, tmp_path if path == STREETS else folder)
    other = tmp_path / "other.gpkg"  # a piece of Porto
    gpd.read_file(ROADS, bbox=(-8.62, 41.15, -8.61, 41.157)).to_file(other)
    run("blind", folder)
    run("told", folder)
    run("elsewhere", folder, "--maps", other, tmp_path / STREETS.name)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(roadgeo, "locate", None)  # nothing is searched again
        counted = run("told", folder)
    assert "| told | 1 of 1 (3 to 100 %) | 0 of 1 (0 to 98 %) |" in counted
    assert "| elsewhere | - | 0 of 1 (0 to 98 %) |" in counted
    with (tmp_path / "results.csv").open(newline="") as file:
        blind = next(row for row in csv.DictReader(file) if row["mode"] == "blind")
    assert (float(blind["score"]), NEEDED) == pytest.approx(
        [value(text) for text in said("README.md", r"\(here ([\d.]+); ([\d.]+) are needed\)")], abs=0.05
    )


def test_counts_of_the_kept_results_are_printed(tmp_path: Path) -> None:
    (tmp_path / "results.csv").write_text(KEPT)
    command = [sys.executable, "-W", "error", str(PHOTOGRAPHS), "table", "--out", str(tmp_path / "results.csv")]
    counted = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert "| blind | 1 of 2 (1 to 99 %) | 0 of 2 (0 to 84 %) | 2.5 | 2 | 4 |" in counted
