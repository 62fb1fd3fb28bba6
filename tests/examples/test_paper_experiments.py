"""The commands of `examples/paper` run on a made-up town, and their tables hold what the paper's do."""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from worlds.towns import lattice_town

from roadgeo.reference.network_file import as_stored, read_network, write_network
from roadgeo.roads.intersections import find_intersections
from roadgeo.roads.network import RoadNetwork

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


@pytest.fixture(scope="module")
def experiments():
    return load("experiments")


def load(name):
    sys.path.insert(0, str(PAPER))
    try:
        spec = importlib.util.spec_from_file_location(name, PAPER / f"{name}.py")
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module
        spec.loader.exec_module(module)
        return module
    finally:
        sys.path.remove(str(PAPER))


def test_the_search_area_is_a_square_of_the_reference(experiments, town):
    part = experiments.cut_network(read_network(town), 1000.0)
    low, high = part.graph.coords.min(axis=0), part.graph.coords.max(axis=0)
    assert (high - low <= 1000.0).all()
    assert len(part.intersections) > 50
    assert (part.graph.degree() > 0).all()


def test_a_subset_is_always_the_same(experiments, town):
    found = read_network(town).intersections
    first, again = experiments.subset(found, 30), experiments.subset(found, 30)
    assert len(first) == 30
    assert np.array_equal(first.xy, again.xy)


def test_the_middle_of_a_mask_holds_the_intersections_asked_for(experiments):
    from roadgeo.evaluation.noise import NoiseModel, draw_mask
    from roadgeo.geometry.pinhole import make_view
    from roadgeo.matching.scene import trace_query

    view = make_view((1350.0, 1350.0), (900, 900), 1.0)
    mask, _ = draw_mask(lattice_town(28), view, NoiseModel(), (8.0, 9.0), np.random.default_rng(0))
    part = experiments.middle(experiments.as_mask(mask), 20)
    scene, _ = trace_query(part)
    assert 20 <= len(scene.intersections) <= 26
    assert not part.roads[~part.observed].any()


def test_tables_sort_masks_into_the_papers_areas(experiments):
    from roadgeo.evaluation.truth import Truth

    tables = load("tables")
    matrix = np.array([[1.0, 0.0, 235250.0], [0.0, -1.0, 901750.0], [0.0, 0.0, 1.0]])
    assert tables.area_of(Truth("a", "mask", matrix, "EPSG:26986", (1500, 1500))) == 12
    assert tables.area_of(Truth("a", "mask", matrix, "EPSG:32619", (1500, 1500))) == 0
    assert len(tables.PAPER) == 17
    recalls = [row[3] for row in tables.PAPER.values()]
    assert np.mean(recalls) == pytest.approx(68.5, abs=0.5)
