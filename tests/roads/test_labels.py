"""Streets keep their names and kinds, from the file to the map in QGIS."""

import json
import sqlite3
from contextlib import closing
from pathlib import Path

import geopandas as gpd
import numpy as np
import shapely

import roadgeo
from roadgeo.reference.network_file import _texts, read_network
from roadgeo.sources.roads import read_roads

AT = 100.0 * np.arange(6)
STREETS = [[(x, 0), (x, 500)] for x in AT] + [[(0, y), (500, y)] for y in AT]
NAMES = [f"{n}. Straße" for n in range(6)] + ["Main St", None, "O'Brien <&> Co", "d", "e", "f"]
KINDS = ["residential"] * 6 + ["primary", "residential", ["tertiary", "residential"], *["residential"] * 3]


def streets(names: list[str | None] = NAMES) -> gpd.GeoDataFrame:
    lines = [shapely.LineString(np.add(street, (530000, 4556000))) for street in STREETS]
    return gpd.GeoDataFrame({"name": names, "highway": KINDS}, geometry=lines, crs="EPSG:32629")


def roads_of(path: Path) -> list[tuple]:
    """Name, kind and middle of each road."""
    network = read_network(path)
    middles = [line.mean(axis=0) + network.plane.origin for line in network.graph.polylines()]
    return list(zip(network.names, network.kinds, middles, strict=True))


def test_roads_keep_names_and_kinds(tmp_path: Path) -> None:
    roadgeo.index(streets(), path=tmp_path / "a.gpkg")
    roads = roads_of(tmp_path / "a.gpkg")
    assert len(roads) == 56
    for name, kind, (x, y) in roads:
        column, row = (x - 530000) / 100, (y - 4556000) / 100
        if min(abs(column - round(column)), abs(row - round(row))) > 0.1:
            continue  # around a corner of the town: two streets in one
        street = round(column) if abs(column - round(column)) < 0.1 else 6 + round(row)
        expected = KINDS[street]
        assert name == (NAMES[street] or "")
        assert kind == (";".join(expected) if isinstance(expected, list) else expected)
    with closing(sqlite3.connect(tmp_path / "a.gpkg")) as database:
        (style,) = database.execute("SELECT styleQML FROM layer_styles WHERE f_table_name = 'roads'").fetchone()
        (points,) = database.execute(
            "SELECT styleQML FROM layer_styles WHERE f_table_name = 'intersections'"
        ).fetchone()
    assert 'fieldName="name"' in style
    assert "motorway" in style
    assert 'minScale="50000"' in points


def test_files_and_cut_files_keep_them_too(tmp_path: Path) -> None:
    table = streets().to_crs("EPSG:4326")
    table["highway"] = [kind if isinstance(kind, str) else "tertiary" for kind in KINDS]
    table.to_file(tmp_path / "a.geojson")
    west, south, east, north = table.total_bounds
    whole = read_roads(tmp_path / "a.geojson")
    cut = read_roads(tmp_path / "a.geojson", bbox=(west - 0.01, south - 0.01, (west + east) / 2, north + 0.01))
    assert list(whole.names) == [name or "" for name in NAMES]
    assert len(cut) == len(cut.names) == 9
    assert set(cut.names) == {*(name or "" for name in NAMES)} - {"3. Straße", "4. Straße", "5. Straße"}


def test_references_without_names_are_as_before(tmp_path: Path) -> None:
    roadgeo.index(streets()[["geometry"]], path=tmp_path / "a.gpkg")
    network = read_network(tmp_path / "a.gpkg")
    assert network.names is None
    assert roadgeo.open_reference(tmp_path / "a.gpkg").index is not None
    with closing(sqlite3.connect(tmp_path / "a.gpkg")) as database:
        assert json.loads(database.execute("SELECT value FROM roadgeo_meta WHERE key = 'roadgeo.nodes'").fetchone()[0])


def test_names_that_are_no_text_are_none() -> None:
    assert list(_texts({"name": [b"\xff", 3, None, "a"]}, "name")) == ["", "", "", "a"]
    assert _texts({}, "name") is None
