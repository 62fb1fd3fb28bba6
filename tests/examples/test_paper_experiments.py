"""The commands of `examples/paper` run on a made-up town, and their tables hold what the paper's do."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from worlds.demo import MASKS
from worlds.towns import lattice_town

from roadgeo.matching import methods
from roadgeo.matching.options import LocateOptions
from roadgeo.reference.network_file import write_network
from roadgeo.reference.opening import open_reference
from roadgeo.roads.intersections import find_intersections
from roadgeo.roads.network import RoadNetwork, as_stored
from roadgeo.workflows import locate

PAPER = Path(__file__).parents[2] / "examples" / "paper"

pytest.importorskip("matplotlib")


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    path = tmp_path_factory.mktemp("town") / "town.gpkg"
    landscape = lattice_town(28)
    found = find_intersections(landscape.graph)
    network = RoadNetwork(landscape.graph, found, landscape.plane, (), {"name": "town"})
    write_network(path, as_stored(network))
    return path


def run(*arguments):
    command = [sys.executable, str(PAPER / "run.py"), *map(str, arguments)]
    environment = {**os.environ, "PYTHONPATH": str(PAPER.parent.parent)}
    return subprocess.run(command, capture_output=True, text=True, env=environment, check=False)


@pytest.mark.parametrize("name", ["figure5", "figure6", "figure7", "figure8"])
def test_an_experiment_runs(name, town, tmp_path):
    done = run(town, "-o", tmp_path, "--queries", 1, "--work-limit", 0.2, "--only", name)
    assert done.returncode == 0, done.stderr
    assert "precision" in done.stdout
    assert json.loads((tmp_path / f"{name}.json").read_text())["queries"] == 1
    assert (tmp_path / f"{name}.png").is_file()


def test_the_experiments_form_the_tuples_of_the_product(porto, tmp_path, monkeypatch):
    """Of Porto: those that Figure 7 counts are those that `--method pair` searches."""
    done = run(porto, "-o", tmp_path, "--queries", 1, "--work-limit", 0.1, "--only", "figure7")
    assert done.returncode == 0, done.stderr
    counted = sum(of_type["tuples"] for of_type in json.loads((tmp_path / "figure7.json").read_text())["types"])
    match, searched = methods.match_pairs, []
    monkeypatch.setattr(methods, "match_pairs", lambda *given: (searched.append(len(given[1])), match(*given))[1])
    area = open_reference(tmp_path / "work" / "porto-10km.gpkg")
    locate(str(MASKS["drone"].path), area, LocateOptions(method="pair"))
    assert searched == [counted]


def test_the_tables_are_made_of_all_tiles(town, data_dir, tmp_path):
    """One tile of each kind; Figures 9 and 10 show the photograph, which `pair` locates."""
    dataset = tmp_path / "dataset"
    for name, tile in (("tiles.csv", ""), ("segmentation/tiles.csv", "24928900")):
        (dataset / name).parent.mkdir(parents=True, exist_ok=True)
        head, *rows = (data_dir / "massachusetts" / name).read_text().splitlines()
        (dataset / name).write_text(f"{head}\n{next(row for row in rows if tile in row)}\n")
    for name in ("masks", "segmentation/images", "roads_from_labels.parquet"):
        (dataset / name).symlink_to(data_dir / "massachusetts" / name)
    more = ("--work-limit", 1, "--perspectives", 1, "--only", "tables")
    done = run(town, "--dataset", dataset, "-o", tmp_path, *more)
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
