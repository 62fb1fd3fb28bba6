"""`roadgeo simulate` and `roadgeo evaluate` on a made-up town."""

import json

import cv2
import jsonschema
import numpy as np
import pytest
from worlds.towns import lattice_town

from roadgeo.cli import main
from roadgeo.evaluation.truth import read_truth
from roadgeo.outputs.schemas import read_schema
from roadgeo.reference.network_file import write_network
from roadgeo.roads.intersections import find_intersections
from roadgeo.roads.network import RoadNetwork, as_stored

SMALL = ["--size", "500", "--gsd", "1:1", "--tilt", "0:20", "--intersections", "10:99"]


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    path = tmp_path_factory.mktemp("town") / "town.gpkg"
    landscape = lattice_town(16)
    graph = landscape.graph
    network = RoadNetwork(graph, find_intersections(graph), landscape.plane, (), {"name": "town"})
    write_network(path, as_stored(network))
    return str(path)


def run(*arguments):
    return main([str(argument) for argument in arguments])


def test_simulate_writes_masks_and_truth(town, tmp_path):
    assert run("simulate", town, "-o", tmp_path / "a", "-n", 2, *SMALL, "--mirrored", 1, "-q") == 0
    assert run("simulate", town, "-o", tmp_path / "b", "-n", 2, *SMALL, "--mirrored", 1, "-q") == 0
    truths = read_truth(tmp_path / "a" / "truth.csv")
    assert [truth.kind for truth in truths] == ["clean"] * 2 + ["segmented"] * 2 + ["poor"] * 2 + ["mirrored"]
    for truth in truths:
        assert (tmp_path / "a" / truth.file).read_bytes() == (tmp_path / "b" / truth.file).read_bytes()
    assert (tmp_path / "a" / "truth.csv").read_text() == (tmp_path / "b" / "truth.csv").read_text()
    assert (tmp_path / "a" / "footprints.gpkg").is_file()
    jsonschema.validate(json.loads((tmp_path / "a" / "truth.json").read_text()), read_schema("truth"))


def figures(value):
    """All figures but times, mask by mask too."""
    if isinstance(value, dict):
        left_out = ("compute_s", "seconds", "command")
        return {name: figures(part) for name, part in value.items() if name not in left_out}
    return [figures(part) for part in value] if isinstance(value, list) else value


def answers(folder):
    """What was recorded of each mask, but for times."""
    return [figures(json.loads(line)) for line in (folder / "trials.jsonl").read_text().splitlines()]


def test_evaluate_gives_the_same_figures_however_it_is_run(town, tmp_path, capsys):
    options = ["-n", 2, "--noise", "clean", "--noise", "poor", "--mirrored", 1, *SMALL, "-q"]
    for name, jobs in {"once": [], "by two": ["-j", 2]}.items():
        assert run("evaluate", town, *options, *jobs, "-o", tmp_path / name) == 0
    once = json.loads((tmp_path / "once" / "evaluation.json").read_text())
    assert once["total"]["queries"] == len(once["scores"]) == 5
    assert once["breakdowns"]["kind"][0]["recall"]["hits"] == 2
    assert once["total"]["refused"]["hits"] == 1
    assert once["total"]["compute_s"]["median"] > 0
    assert len(answers(tmp_path / "once")) == 6
    assert figures(json.loads((tmp_path / "by two" / "evaluation.json").read_text())) == figures(once)
    assert answers(tmp_path / "by two") == answers(tmp_path / "once")
    assert (tmp_path / "once" / "report.html").is_file()

    assert run("evaluate", town, *options, "--json", "-o", tmp_path / "once") == 0  # from the record
    printed = json.loads(capsys.readouterr().out)
    for document in (once, printed):
        jsonschema.validate(document, read_schema("evaluation"))
    assert printed | {"command": ""} == {name: part for name, part in once.items() if name != "scores"} | {
        "command": ""
    }
    assert f"-o {tmp_path / 'once'}" in once["command"]


def test_an_interrupted_run_says_that_it_can_go_on(town, tmp_path, capsys, monkeypatch):
    from roadgeo.evaluation import trials

    options = ["evaluate", town, "-n", 3, "--noise", "clean", *SMALL, "-o", tmp_path]
    draw = trials.simulate_query

    def interrupted(landscape, options, k, center):
        if k == 2:
            raise KeyboardInterrupt
        return draw(landscape, options, k, center)

    monkeypatch.setattr(trials, "simulate_query", interrupted)
    assert run(*options) == 130
    assert "2 of 3 masks are kept; the same command goes on" in capsys.readouterr().err
    monkeypatch.undo()
    record = tmp_path / "trials.jsonl"
    kept = record.read_text()
    assert run(*options, "--seed", 1) == 1
    assert "another run" in capsys.readouterr().err
    assert record.read_text() == kept
    record.write_text(f'{kept}{{"truth": {{"fi')  # as if the power had gone
    assert run(*options) == 0
    assert "3 masks (2 of them recorded before) in" in capsys.readouterr().err
    first, *lines = record.read_text().splitlines()
    assert (first, *lines[:2]) == tuple(kept.splitlines())
    assert [json.loads(line)["truth"]["file"] for line in lines] == [f"clean/q_000{k}.png" for k in range(3)]


def test_evaluate_reads_query_sets(town, tmp_path, capsys):
    run("simulate", town, "-o", tmp_path, "-n", 2, "--noise", "clean", *SMALL)
    assert run("evaluate", town, "--queries", tmp_path) == 0
    printed = capsys.readouterr().out
    assert "Kind of mask" in printed
    assert "100 (34-100)" in printed


def test_simulate_asks_where_to_write(town, capsys):
    assert run("simulate", town, "-n", 1) == 2
    assert "'--out-dir'" in capsys.readouterr().err


def test_a_map_is_written_styled(town, tmp_path, capsys, monkeypatch):
    options = ["--map", "-n", 6, "--check", 2, "--noise", "clean", "--height", 400, "--size", 400]
    assert run("evaluate", town, *options, "-o", tmp_path) == 0
    assert {path.suffix for path in tmp_path.glob("town_localizability.*")} == {".tif", ".qml", ".png", ".json"}
    summary = json.loads((tmp_path / "town_localizability.json").read_text())
    jsonschema.validate(summary, read_schema("localizability"))
    assert sum(entry["area_share"] for entry in summary["classes"]) == pytest.approx(1.0)
    assert "would be located" in capsys.readouterr().out
    pictures = [(tmp_path / f"town_localizability.{kind}").read_bytes() for kind in ("tif", "png")]
    monkeypatch.setattr("roadgeo.evaluation.trials.simulate_query", None)  # from the record
    assert run("evaluate", town, *options, "-j", 2, "-o", tmp_path) == 0
    assert [(tmp_path / f"town_localizability.{kind}").read_bytes() for kind in ("tif", "png")] == pictures
    assert figures(json.loads((tmp_path / "town_localizability.json").read_text())) == figures(summary)
    capsys.readouterr()
    assert run("evaluate", town, *options, "--seed", 1, "-o", tmp_path) == 1
    assert "another run" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        (["--gsd", "3:1"], 2, "LO:HI"),
        (["--noise", "awful"], 2, "segmented"),
        (["--intersections", "5000:6000"], 1, "ask for fewer"),
        (["--queries", "nowhere"], 2, "does not exist"),
        (["--check", "9"], 2, "--check needs --map"),
        (["--queries", ".", "--gsd", "1:1"], 2, "--count, --gsd does nothing with --queries"),
        (["--map", "--radius", "9"], 2, "--radius does nothing with --map"),
        (["--tilt", "80:85"], 1, "allow less tilt"),
    ],
)
def test_what_is_wrong_is_said(town, arguments, status, words, capsys, monkeypatch):
    monkeypatch.setattr("roadgeo.evaluation.simulation.MAX_TRIES", 20)
    assert run("evaluate", town, "-n", 1, *arguments) == status
    assert words in capsys.readouterr().err


def test_masks_of_another_place_are_told(town, tmp_path, capsys):
    matrix = "1,0,9e5,0,-1,9e6,0,0,1"
    names = "file,crs,width,height," + ",".join(f"h{i}{j}" for i in range(3) for j in range(3))
    (tmp_path / "truth.csv").write_text(f"{names}\nq.png,EPSG:32619,64,64,{matrix}\n")
    cv2.imwrite(str(tmp_path / "q.png"), np.zeros((64, 64), np.uint8))
    assert run("evaluate", town, "--queries", tmp_path) == 0
    assert "the places of 1 of 1 masks are not on town" in capsys.readouterr().err


def test_another_map_of_the_place_can_be_drawn(town, tmp_path, capsys):
    import geopandas as gpd
    from shapely.geometry import LineString

    landscape = lattice_town(16)
    lines = [LineString(landscape.plane.to_crs(line)) for line in landscape.graph.polylines()]
    roads = gpd.GeoDataFrame(geometry=lines, crs=landscape.plane.crs).to_crs("EPSG:4326")
    roads.to_file(tmp_path / "other.geojson")
    options = ["-n", 2, "--noise", "clean", *SMALL, "--json"]
    assert run("evaluate", town, "--roads", tmp_path / "other.geojson", *options) == 0
    table = json.loads(capsys.readouterr().out)
    assert table["total"]["recall"]["hits"] == 2
    assert table["total"]["center_m"]["max"] < 2.0
    assert run("evaluate", town, "--map", "--roads", tmp_path / "other.geojson") == 2
