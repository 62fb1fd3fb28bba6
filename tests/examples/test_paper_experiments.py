"""The commands of `examples/paper` run on small maps, and their tables hold what the paper's do."""

import json
import os
import subprocess
import sys
from pathlib import Path

import geopandas as gpd
import pytest
from worlds.demo import MASKS

from roadgeo.matching import methods
from roadgeo.matching.options import LocateOptions
from roadgeo.reference.opening import open_reference
from roadgeo.workflows import locate

PAPER = Path(__file__).parents[2] / "examples" / "paper"

pytest.importorskip("matplotlib")


def run(*arguments):
    command = [sys.executable, str(PAPER / "run.py"), *map(str, arguments)]
    environment = {**os.environ, "PYTHONPATH": str(PAPER.parent.parent)}
    return subprocess.run(command, capture_output=True, text=True, env=environment, check=False)


FIGURES = ("figure5", "figure6", "figure7", "figure8")


@pytest.fixture(scope="module")
def drawn(porto, tmp_path_factory):
    """The folder of all figures, which one run draws, and what it printed."""
    folder = tmp_path_factory.mktemp("drawn")
    done = run(porto, "-o", folder, "--queries", 1, "--work-limit", 0.02, "--only", *FIGURES)
    assert done.returncode == 0, done.stderr
    return folder, done.stdout


@pytest.mark.parametrize("name", FIGURES)
def test_an_experiment_runs(name, drawn):
    folder, printed = drawn
    assert "precision" in printed
    assert json.loads((folder / f"{name}.json").read_text())["queries"] == 1
    assert (folder / f"{name}.png").is_file()


def test_the_experiments_form_the_tuples_of_the_product(drawn, monkeypatch):
    """Those that Figure 7 counts are those that `--method pair` searches."""
    folder, _ = drawn
    counted = sum(of_type["tuples"] for of_type in json.loads((folder / "figure7.json").read_text())["types"])
    match, searched = methods.match_pairs, []
    monkeypatch.setattr(methods, "match_pairs", lambda *given: (searched.append(len(given[1])), match(*given))[1])
    area = open_reference(folder / "work" / "porto-10km.gpkg")
    locate(str(MASKS["drone"].path), area, LocateOptions(method="pair"))
    assert searched == [counted]


def test_the_tables_are_made_of_all_tiles(porto, data_dir, tmp_path):
    """One tile of each kind; Figures 9 and 10 show the photograph, which `pair` locates on the roads around it."""
    dataset = tmp_path / "dataset"
    for name, tile in (("tiles.csv", ""), ("segmentation/tiles.csv", "24928900")):
        (dataset / name).parent.mkdir(parents=True, exist_ok=True)
        head, *rows = (data_dir / "massachusetts" / name).read_text().splitlines()
        row = next(row for row in rows if tile in row)
        (dataset / name).write_text(f"{head}\n{row}\n")
    for name in ("masks", "segmentation/images"):
        (dataset / name).symlink_to(data_dir / "massachusetts" / name)
    truth = dict(zip(head.split(","), row.split(","), strict=True))
    x, y = float(truth["easting"]), float(truth["northing"])
    roads = gpd.read_parquet(data_dir / "massachusetts" / "roads_from_labels.parquet")
    roads.cx[x - 3000 : x + 3000, y - 3000 : y + 3000].to_parquet(dataset / "roads_from_labels.parquet")
    more = ("--work-limit", 0.1, "--perspectives", 1, "--only", "tables")
    done = run(porto, "--dataset", dataset, "-o", tmp_path, *more)
    assert done.returncode == 0, done.stderr
    assert {(row["method"], row["of"]) for row in json.loads((tmp_path / "table3.json").read_text())["rows"]} == {
        (method, of) for method in ("paper", "pair", "auto") for of in ("labels", "photographs")
    }
    assert "## Table 3" in (tmp_path / "tables.md").read_text()
    assert all((tmp_path / f"figure{number}.png").is_file() for number in (9, 10))


def test_what_is_missing_is_said_first(tmp_path):
    done = run("nowhere", "--dataset", tmp_path / "none", "-o", tmp_path / "out")
    assert done.returncode == 2
    assert "no reference 'nowhere'" in done.stderr
    assert "tiles.csv, of the Massachusetts Roads Dataset" in done.stderr
    assert not (tmp_path / "out").exists()
