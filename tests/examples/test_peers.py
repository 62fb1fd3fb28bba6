"""`examples/peers`: our searches on a query like the programs', their answers as text, and the joined counts."""

import csv
import importlib
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import geopandas as gpd
import numpy as np
import pytest

from roadgeo.evaluation.demo import ROADS
from roadgeo.evaluation.landscape import Landscape
from roadgeo.evaluation.simulation import SimulationOptions, ViewOptions, simulate_query
from roadgeo.evaluation.truth import write_truth
from roadgeo.sources.roads import read_roads

PEERS = Path(__file__).parents[2] / "examples" / "peers"


@pytest.fixture
def example(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(str(PEERS))
    monkeypatch.syspath_prepend(str(PEERS.parent))
    return importlib.import_module


@pytest.mark.slow
def test_the_queries_of_the_programs_are_located_by_ours(tmp_path: Path) -> None:
    city = tmp_path / "liege"
    (city / "clean").mkdir(parents=True)
    roads = read_roads(ROADS)
    options = SimulationOptions(ViewOptions((1500, 1500)), seed=3)
    query = simulate_query(Landscape.from_lines(roads.lines, roads.plane), options, 0)
    cv2.imwrite(str(city / "clean" / "q_000.png"), query.mask)
    write_truth(city, [replace(query.truth, file="clean/q_000.png")])
    gpd.read_file(ROADS).to_crs(query.truth.crs).to_file(city / "ref_10km.gpkg", layer="roads")
    command = [sys.executable, "-W", "error", PEERS / "ours.py", "--queries", tmp_path, "--most", 1, "--areas", 10]
    command += ["--methods", "roadgeo", "correlation", "--out", tmp_path / "ours.csv"]
    for _ in range(2):  # the second time nothing is searched
        subprocess.run(list(map(str, command)), check=True, capture_output=True)
    with (tmp_path / "ours.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["peer"], row["kind"], row["query"]) for row in rows] == [
        ("roadgeo", "clean", "q_000"),
        ("correlation", "clean", "q_000"),
    ]
    assert all(float(row["centre_err_m"]) < 10.0 for row in rows)


def test_answers_of_the_programs_are_read(example, tmp_path: Path) -> None:
    programs = example("programs")
    (tmp_path / "pairs").write_text("0    1    250    1 0 5  0 1 220  0 0 1  0.75\n1 -1 40 0 0 0 0 0 0 0 0 0 0\n")
    first, second = programs.read_answers(tmp_path / "pairs", 213.0)
    assert (first[0], first[1], first[3]) == (True, 0.25, 0.75)
    assert np.array_equal(first[2], [[1, 0, 5], [0, 1, 7], [0, 0, 1]])
    assert (second[0], second[2]) == (False, None)
    (tmp_path / "votes").write_text("\n0  2.5  2\n0.4 1 0 1 0 1 1 0 0 1\n0.6 1 0 2 0 1 2 0 0 1\n\n1  3.5  0\n")
    first, second = programs.read_hashing(tmp_path / "votes")
    assert (first[0], first[1], first[2][0, 2], first[3]) == (True, 2.5, 2.0, 0.6)
    assert second == (False, 3.5, None, 0.0)


@pytest.mark.parametrize("patch", sorted((PEERS / "patches").glob("*.patch")), ids=lambda path: path.stem)
def test_a_patch_holds_nothing_but_changed_lines(patch: Path) -> None:
    assert not [line for line in patch.read_text().splitlines() if line.startswith(" ")]


def test_all_in_a_row_are_counted_on_the_same_queries(example) -> None:
    join = example("join")
    query = {"city": "liege", "area_km": "10", "kind": "clean"}
    found = {"found": "1", "centre_err_m": "3.0"}
    programs = [{"peer": "v1", "params": "def", **query, "query": f"q_{k}", **found} for k in range(3)]
    programs[1] |= {"centre_err_m": "60.0"}
    ours = [
        {"peer": peer, **query, "query": f"q_{k}", **found} for k in range(2) for peer in ("roadgeo", "correlation")
    ]
    ours[2] |= {"found": "0"}
    rows = list(join.joined(programs, ours))
    assert len(rows) == 2  # the third query was not searched for
    assert list(join.table(rows, "10")) == [["version 1", "clean", "2", "1, 1 wrong", "1", "2"]]


def test_the_kept_rows_are_joined(example) -> None:
    join, results = example("join"), example("results")
    rows = list(join.joined(results.read(join.FOLDER / "programs.csv"), results.read(join.FOLDER / "ours.csv")))
    assert rows == results.read(join.FOLDER / "joined.csv")
