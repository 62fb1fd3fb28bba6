"""`roadgeo simulate` and `roadgeo evaluate` on a made-up town."""

import json

import numpy as np
import pytest
from towns import lattice_town

from roadgeo.cli import main
from roadgeo.intersections import find_intersections
from roadgeo.io_network import as_stored, write_network
from roadgeo.network import RoadNetwork
from roadgeo.truth import read_truth

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


def figures(text):
    """The figures but for times."""
    table = json.loads(text)
    for group in [table["total"], *(g for groups in table["breakdowns"].values() for g in groups)]:
        del group["compute_s"]
    return table


def test_evaluate_gives_the_same_figures_however_it_is_run(town, tmp_path, capsys):
    options = ["-n", 4, "--noise", "clean", "--mirrored", 2, *SMALL, "--json"]
    assert run("evaluate", town, *options, "-o", tmp_path / "out") == 0
    once = figures(capsys.readouterr().out)
    assert once["total"]["queries"] == 6
    assert once["total"]["recall"]["hits"] == 4
    assert once["total"]["refused"]["hits"] == 2
    assert (tmp_path / "out" / "report.html").is_file()
    assert len((tmp_path / "out" / "trials.jsonl").read_text().splitlines()) == 7
    assert run("evaluate", town, *options, "-j", 2) == 0
    assert figures(capsys.readouterr().out) == once
    assert run("evaluate", town, *options, "-o", tmp_path / "out") == 0  # from the record
    assert figures(capsys.readouterr().out) == once


def test_evaluate_reads_query_sets(town, tmp_path, capsys):
    run("simulate", town, "-o", tmp_path, "-n", 2, "--noise", "clean", *SMALL)
    assert run("evaluate", town, "--queries", tmp_path) == 0
    printed = capsys.readouterr().out
    assert "Kind of mask" in printed
    assert "100 (34-100)" in printed


def test_a_map_is_written_styled(town, tmp_path, capsys):
    options = ["--map", "-n", 6, "--check", 2, "--noise", "clean", "--height", 400, "--size", 400]
    assert run("evaluate", town, *options, "-o", tmp_path) == 0
    assert {path.suffix for path in tmp_path.glob("town_localizability.*")} == {".tif", ".qml", ".png", ".json"}
    summary = json.loads((tmp_path / "town_localizability.json").read_text())
    assert sum(entry["area_share"] for entry in summary["classes"]) == pytest.approx(1.0)
    assert "would be located" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        (["--gsd", "3:1"], 2, "LO:HI"),
        (["--noise", "awful"], 2, "segmented"),
        (["--intersections", "5000:6000"], 1, "ask for fewer"),
        (["--queries", "nowhere"], 2, "does not exist"),
    ],
)
def test_what_is_wrong_is_said(town, arguments, status, words, capsys, monkeypatch):
    monkeypatch.setattr("roadgeo.simulation.MAX_TRIES", 20)
    assert run("evaluate", town, "-n", 1, *arguments) == status
    assert words in capsys.readouterr().err


def test_an_unknown_table_is_refused(town, tmp_path, capsys):
    (tmp_path / "truth.csv").write_text("a,b\n1,2\n")
    assert run("evaluate", town, "--queries", tmp_path / "truth.csv") == 1
    assert "no table of truths" in capsys.readouterr().err


def test_seeds_matter(town, tmp_path):
    for seed in (0, 1):
        run("simulate", town, "-o", tmp_path / str(seed), "-n", 1, "--noise", "clean", *SMALL, "--seed", seed, "-q")
    masks = [(tmp_path / str(seed) / "clean" / "q_0000.png").read_bytes() for seed in (0, 1)]
    assert masks[0] != masks[1]
    assert not np.array_equal(*(read_truth(tmp_path / str(seed) / "truth.csv")[0].homography for seed in (0, 1)))


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
