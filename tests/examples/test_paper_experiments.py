"""The commands of `examples/paper` run on a made-up town, and their tables hold what the paper's do."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from worlds.towns import lattice_town

from roadgeo.reference.network_file import write_network
from roadgeo.roads.intersections import find_intersections
from roadgeo.roads.network import RoadNetwork, as_stored

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


def run(script, town, out, *arguments):
    command = [
        sys.executable,
        str(PAPER / script),
        str(town),
        "--out",
        str(out),
        "--queries",
        "1",
        "--time-limit",
        "0.5",
    ]
    environment = {**os.environ, "PYTHONPATH": str(PAPER.parent.parent)}
    done = subprocess.run([*command, *arguments], capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize(
    ("script", "arguments", "result"),
    [
        ("figure5.py", ["--n-r", "20", "--methods", "pair"], "figure5"),
        ("figure6.py", ["--methods", "auto"], "figure6"),
        ("figure7.py", [], "figure7"),
        ("figure8.py", [], "figure8"),
        ("tables.py", [], "table2"),
    ],
)
def test_an_experiment_runs(script, arguments, result, town, tmp_path):
    printed = run(script, town, tmp_path, *arguments)
    assert "precision" in printed
    assert json.loads((tmp_path / f"{result}.json").read_text())
    assert (tmp_path / f"{result}.png").is_file() or result.startswith("table")
