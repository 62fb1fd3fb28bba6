"""`roadgeo index` from its command line to its files, on loopback servers that give real answers."""

import json
import time

import pytest
from fake_osm import EMPTY, fake_osm
from fenway import write_streets

from roadgeo.cli import main


@pytest.fixture
def osm(tmp_path, monkeypatch):
    monkeypatch.setenv("ROADGEO_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("ROADGEO_LIBRARY", str(tmp_path / "library"))
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
    assert main(["info", "fenway-boston", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert "OpenStreetMap contributors" in json.dumps(told, ensure_ascii=False)
    assert "2022-05-04T19:30:42Z" in json.dumps(told)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--osm", "Atlantis"), "OpenStreetMap knows no such place"),
        (("--osm", "Gas Lamp"), "is a point on OpenStreetMap, not an area"),
    ],
)
def test_places_that_cannot_be_indexed(osm, tmp_path, capsys, arguments, message):
    assert index(*arguments, osm=osm) == 1
    assert message in capsys.readouterr().err
    assert not list(tmp_path.rglob("*.gpkg"))


def test_a_busy_server_is_waited_for_and_said(osm, capsys):
    osm.overpass.append((429, {"Retry-After": "3"}, b"busy"))
    assert index("--bbox=-71.0925,42.3445,-71.08,42.3525", osm=osm) == 0
    assert "is busy (429), trying again in 3 s" in capsys.readouterr().err


@pytest.mark.parametrize("answer", ["cut", (200, {}, EMPTY), (500, {}, b"<html>")], ids=["cut", "empty", "broken"])
def test_answers_of_no_use_are_an_error_on_one_line(osm, tmp_path, capsys, answer):
    osm.overpass.append(answer)
    assert index("--bbox=-71.0925,42.3445,-71.08,42.3525", osm=osm, quiet=True) == 1
    told = capsys.readouterr().err
    assert told.startswith("Error: ")
    assert told.count("\n") == 1
    assert "fault of roadgeo" not in told
    assert not list(tmp_path.rglob("*.gpkg"))


def test_files_become_a_reference(tmp_path, capsys):
    folder = tmp_path / "maps"
    folder.mkdir()
    write_streets(folder / "a.osm.pbf")
    write_streets(folder / "b.shp")
    assert index("--roads", folder, "--out", tmp_path / "fenway.gpkg") == 0
    assert "reading a.osm.pbf" in capsys.readouterr().err
    assert (tmp_path / "fenway.index").exists()


def test_roads_without_a_crs_are_an_error(tmp_path, capsys):
    file = write_streets(tmp_path / "a.shp")
    file.with_suffix(".prj").unlink()
    assert index("--roads", file, "--out", tmp_path / "a.gpkg") == 1
    assert "name it, for example --crs EPSG:26986" in capsys.readouterr().err
    assert index("--roads", file, "--crs", "EPSG:4326", "--out", tmp_path / "a.gpkg") == 0
