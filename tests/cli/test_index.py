"""`roadgeo index` from its command line to its files, on loopback servers that give real answers."""

import json
import os
import shlex
import sqlite3
import time
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pytest
import shapely
from worlds.fake_osm import EMPTY, fake_osm
from worlds.fenway import write_streets, write_vector
from worlds.scenes import random_lines

from roadgeo.cli import main
from roadgeo.reference.opening import open_reference


@pytest.fixture
def osm(tmp_path, monkeypatch):
    monkeypatch.setenv("ROADGEO_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(time, "sleep", lambda _: None)
    with fake_osm() as state:
        yield state


def index(*arguments, osm=None, quiet=False):
    servers = [] if osm is None else ["--overpass-url", f"{osm.url}/api", "--nominatim-url", osm.url]
    arguments += ("--quiet",) if quiet else ()
    return main(["index", *map(str, arguments), *servers])


def test_a_place_becomes_a_reference_in_the_library(osm, tmp_path, capsys):
    assert index("--osm", "Fenway, Boston", osm=osm) == 0
    capsys.readouterr()
    assert {file.name for file in (tmp_path / "library").iterdir()} == {"fenway-boston.gpkg", "fenway-boston.index"}
    assert main(["reference", "info", "fenway-boston", "--json"]) == 0
    output = json.loads(capsys.readouterr().out)
    assert "OpenStreetMap contributors" in json.dumps(output, ensure_ascii=False)
    assert "2022-05-04T19:30:42Z" in json.dumps(output)


@pytest.mark.parametrize("answer", ["cut", (200, {}, EMPTY), (500, {}, b"<html>")], ids=["cut", "empty", "broken"])
def test_answers_of_no_use_are_an_error_on_one_line(osm, tmp_path, capsys, answer):
    osm.overpass.append(answer)
    assert index("--bbox=-71.0925,42.3445,-71.08,42.3525", osm=osm, quiet=True) == 1
    output = capsys.readouterr().err
    assert output.startswith("Error: ")
    assert output.count("\n") == 1
    assert "fault of roadgeo" not in output
    assert not list(tmp_path.rglob("*.gpkg"))


def test_a_coarse_map_holds_main_roads_merged_farther(tmp_path, capsys):
    lines = [shapely.LineString(np.array(line.coords)) for line in random_lines(8, 30_000.0, 1200.0)]
    streets = [shapely.LineString(np.array(line.coords)) for line in random_lines(5, 3000.0)]
    kinds = ["primary"] * len(lines) + ["residential"] * len(streets)
    roads = write_vector(tmp_path / "region.gpkg", [*lines, *streets], crs="EPSG:32629", highway=kinds)
    assert index("--roads", roads, "--coarse", "--out", tmp_path / "coarse.gpkg", quiet=True) == 0
    coarse = open_reference(tmp_path / "coarse.gpkg").index
    assert coarse.coarseness == 6.0
    assert coarse.meta["roads"] == "main"
    assert index("--roads", roads, "--coarse", "--kinds", "drivable", "--out", tmp_path / "b.gpkg", quiet=True) == 0
    assert len(open_reference(tmp_path / "b.gpkg").index) > len(coarse)


@pytest.mark.parametrize(
    ("given", "name"),
    [(["--out", "My b.gpkg"], "my-b"), (["--out", "b.index"], "b"), (["--name", "C", "--out", "b"], "c")],
)
def test_a_reference_is_called_after_its_own_file(tmp_path, capsys, given, name):
    assert index("--roads", write_streets(tmp_path / "a.geojson"), *given, quiet=True) == 0
    (reference,) = tmp_path.glob("*.index")
    assert main(["reference", "info", str(reference)]) == 0
    assert capsys.readouterr().out.splitlines()[0].split() == ["name", name]
    assert main(["reference", "info", str(reference), "--json"]) == 0
    assert "a.geojson" in json.dumps(json.loads(capsys.readouterr().out)["meta"]["sources"])


def counts(reference, capsys):
    capsys.readouterr()
    assert main(["reference", "check", str(reference)]) == 0
    assert main(["reference", "info", str(reference), "--json"]) == 0
    output = json.loads(capsys.readouterr().out.partition("\n")[2])
    return output["counts"]["intersections"], output["road_km"], output["meta"]


def test_an_index_is_built_again_from_the_geopackage_alone(tmp_path, capsys):
    """After an edit, as in QGIS, every command says what to type, and that helps."""
    assert index("--roads", write_streets(tmp_path / "a.geojson"), "--out", "my map.gpkg", quiet=True) == 0
    n, *_ = counts("my map.gpkg", capsys)
    with closing(sqlite3.connect("my map.gpkg")) as database:
        database.execute("DELETE FROM intersections WHERE fid = 1")
        database.commit()
    cv2.imwrite("mask.png", np.zeros((200, 200), np.uint8))
    assert main(["locate", "mask.png", "-r", "my map.gpkg"]) == 1
    advice = capsys.readouterr().err.strip().rpartition(": ")[2]
    assert advice == "roadgeo index --rebuild 'my map.gpkg'"
    assert main(shlex.split(advice)[1:]) == 0
    assert "building the index of my map again ..." in capsys.readouterr().err
    assert counts("my map.gpkg", capsys)[0] == n - 1
    assert index("--rebuild", "my map.gpkg", "--osm", "Fenway, Boston") == 2
    assert index("--rebuild", "none.gpkg", quiet=True) == 1
    Path("my map.index").unlink()
    assert main(["locate", "mask.png", "-r", "my map.gpkg"]) == 1  # it shows no roads
    assert "building the index of my map again ..." in capsys.readouterr().err


def test_a_folder_one_may_not_write_to_is_named_before_the_long_part(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(os, "access", lambda _, mode: not mode & os.W_OK)  # root may write everywhere
    assert index("--roads", write_streets(tmp_path / "a.geojson"), "--out", tmp_path / "shelf" / "a.gpkg") == 1
    output = capsys.readouterr().err
    assert output.endswith("permission denied; choose a folder you may write to\n")
    assert output.count("\n") == 1


def test_a_reference_is_a_geopackage(tmp_path, capsys):
    write_streets(tmp_path / "a.geojson")
    assert main(["index", "--roads", "a.geojson", "--out", "maps/b.shp"]) == 2
    assert f"did you mean {Path('maps', 'b.gpkg')}?" in capsys.readouterr().err
    assert not (tmp_path / "maps").exists()


def test_the_next_command_is_named(tmp_path, capsys):
    write_streets(tmp_path / "a.geojson")
    assert main(["index", "--roads", "a.geojson", "--out", "maps/b.gpkg"]) == 0
    assert "search it with `roadgeo locate photo.jpg -r maps/b.gpkg`" in capsys.readouterr().out
    assert main(["index", "--roads", "a.geojson", "--name", "Fenway, MA"]) == 0
    assert "search it with `roadgeo locate photo.jpg -r fenway-ma`" in capsys.readouterr().out
