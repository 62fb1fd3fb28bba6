import importlib
import json
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import geopandas as gpd
import pytest

from roadgeo.evaluation.demo import ROADS
from roadgeo.location import ERROR_RATES, Kind

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("locate_a_mask.py", ["located: ", "in EPSG:32629"]),
        ("locate_many.py", ["map_sheet.png: located", "elsewhere.png: not_located", "4 footprints"]),
    ],
)
def test_an_example_runs_as_it_stands(name: str, expected: list[str], tmp_path: Path) -> None:
    command = [sys.executable, "-W", "error", str(EXAMPLES / name)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=True)
    assert done.stderr == ""
    for text in expected:
        assert text in done.stdout


def test_correlation_with_heading_and_scale_finds_clean_masks(tmp_path: Path) -> None:
    command = [sys.executable, "-W", "error", str(EXAMPLES / "correlate.py"), "-n", "1"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=True)
    assert "| clean, level | 1 of 1 | 1 of 1 | 0 |" in done.stdout


def test_the_tables_of_how_well_are_those_of_the_code(tmp_path: Path) -> None:
    """The table of error rates; and a bench's output becomes a table."""
    subprocess.run([sys.executable, str(EXAMPLES / "tables.py"), "--check"], cwd=tmp_path, check=True)
    kind = {"masks": 8, "right": 7, "wrong": 0, "cpu_s": [0.1]}
    kind |= {"corners_m": [0.5, 1.25], "error_over_claim": [0.9, 1.1]}
    absent = {**kind, "right": 0}
    tables = runpy.run_path(str(EXAMPLES / "tables.py"))  # another folder of examples has a module of that name
    lines = list(tables["bench_table"]({"this": {"clean": kind, "turned over": absent}}))
    assert lines[2].endswith("| 7 of 8 | 0 | 0.5 m / 1.2 m | 0.90, 1.10 | 0.1 |")
    assert lines[3] == "| mirrored: no place |  | 0 of 8 |  |  | 0.1 |"


@pytest.mark.parametrize("kind", ERROR_RATES)
def test_the_error_rates_that_results_state_are_those_counted(kind: Kind) -> None:
    counted = runpy.run_path(str(EXAMPLES / "tables.py"))["counted"](kind)
    assert [rate[:3] for rate in counted] == [rate[:3] for rate in ERROR_RATES[kind]]
    assert [rate.at_most for rate in counted] == pytest.approx([rate.at_most for rate in ERROR_RATES[kind]], abs=5e-4)


def test_the_bench_compares_two_checkouts_and_goes_on_where_it_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(EXAMPLES.parent / "roadgeo", tmp_path / "other" / "roadgeo")
    small = tmp_path / "small.gpkg"  # a piece of Porto
    gpd.read_file(ROADS, bbox=(-8.64, 41.145, -8.605, 41.17)).to_file(small)
    options = ["--cities", str(small), "-n", "1", "-j", "1", "--out", "out", "--kinds", "base", "clean", "--against"]
    command = [sys.executable, str(EXAMPLES / "bench.py"), *options, "other"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=True)
    for text in ("base", "turned over", "highest log10 odds", "the same to the last bit, times aside: 3 of 3"):
        assert text in done.stdout
    assert (tmp_path / "out" / "bench.txt").read_text() == done.stdout
    run, _ = json.loads((tmp_path / "out" / "bench.json").read_text()).values()
    assert run["all"]["masks"] == 2
    assert run["all"]["wrong"] == run["turned over"]["wrong"] == 0
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(EXAMPLES))
    bench = importlib.import_module("bench")
    with monkeypatch.context() as patch:
        patch.setattr(bench, "subprocess", None)  # nothing is located again
        bench.main([*options, "other"])
    assert capsys.readouterr().out == done.stdout
    with pytest.raises(SystemExit, match="neither a folder nor a commit"):
        bench.main([*options, "no such"])
