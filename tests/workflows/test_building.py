"""Roads to a reference: one builder for the command line and for Python, from whatever holds the roads."""

import geopandas
import numpy as np
import pandas as pd
import pytest
import shapely
from worlds.fenway import streets

import roadgeo
from roadgeo.cli import main
from roadgeo.errors import CrsError, RoadSourceError
from roadgeo.reference.opening import open_reference


@pytest.fixture(scope="module")
def roads():
    lines, highway, tunnel = streets()
    columns = {"highway": list(highway), "tunnel": list(tunnel)}
    return geopandas.GeoDataFrame(columns, geometry=list(lines), crs="EPSG:4326")


def test_a_table_is_filtered_as_the_command_filters_a_file(roads, tmp_path, monkeypatch):
    """Footways and tunnels of a GeoDataFrame used to be taken for roads."""
    monkeypatch.chdir(tmp_path)
    roads.to_file("fenway.gpkg")
    more = geopandas.GeoDataFrame({"highway": ["footway"] * len(roads)}, geometry=roads.geometry.translate(2e-4, 1e-4))
    mixed = pd.concat([roads, more], ignore_index=True)
    mixed.to_file("mixed.gpkg")
    assert main(["index", "--roads", "mixed.gpkg", "--out", "cli.gpkg", "-q"]) == 0
    by_command = open_reference("cli.gpkg").index
    for given in (mixed, "mixed.gpkg"):
        by_call = roadgeo.index(given, "cli", path="api.gpkg").index
        np.testing.assert_array_equal(by_call.xy, by_command.xy)
        np.testing.assert_array_equal(by_call.table_entries, by_command.table_entries)
    assert len(roadgeo.index(mixed, kinds="all").index) > len(by_command)


def test_whom_to_name_is_kept(roads, tmp_path):
    built = roadgeo.index(roads, "fenway", path=tmp_path / "fenway.gpkg", attribution="© somebody")
    assert built.index.meta["attribution"] == "© somebody"
    assert open_reference(tmp_path / "fenway.gpkg").name == "fenway"


def held(kind, roads):
    """The same roads as a program may hold them, and what else it then says."""
    lines, coordinates = list(roads.geometry), [np.array(line.coords) for line in roads.geometry]
    if kind == "one array":
        return np.concatenate([np.vstack([part, [np.nan, np.nan]]) for part in coordinates]), {"crs": 4326}
    crs = {"crs": "EPSG:4326"}
    return {
        "GeoSeries": (roads.geometry, {}),
        "table without a CRS": (roads.set_crs(None, allow_override=True), crs),
        "shapely lines": (lines, crs),
        "array of shapely lines": (np.array(lines, object), crs),
        "one shapely geometry": (shapely.MultiLineString(lines), crs),
        "arrays": (coordinates, crs),
        "lists of points": ([points.tolist() for points in coordinates], crs),
        "arrays with heights": ([np.column_stack([points, points[:, 0]]) for points in coordinates], crs),
    }[kind]


@pytest.mark.parametrize(
    "kind",
    [
        "GeoSeries",
        "table without a CRS",
        "shapely lines",
        "array of shapely lines",
        "one shapely geometry",
        "arrays",
        "one array",
        "lists of points",
        "arrays with heights",
    ],
)
def test_roads_are_taken_however_they_are_held(kind, roads):
    drivable = roads[roads.highway.isin(["residential", "primary", "secondary", "tertiary"]) & roads.tunnel.isna()]
    given, more = held(kind, drivable)
    expected = roadgeo.index(drivable, "fenway", kinds="all")
    found = roadgeo.index(given, "fenway", kinds="all", **more)
    np.testing.assert_allclose(found.index.xy, expected.index.xy, atol=1e-6)


@pytest.mark.parametrize(
    ("given", "error", "match"),
    [
        ([np.zeros((2, 2))], CrsError, "has no CRS; name it"),
        ([np.zeros((2, 5))], RoadSourceError, r"list cannot be read: coordinates of shape \(2, 5\); expected a path"),
        (7, RoadSourceError, "of type int cannot be read"),
        ([], CrsError, "has no CRS"),
    ],
)
def test_what_holds_no_roads_is_named(given, error, match):
    with pytest.raises(error, match=match):
        roadgeo.index(given)


def test_a_crs_that_is_none_is_named():
    with pytest.raises(CrsError, match="'here' is no CRS"):
        roadgeo.index([np.zeros((2, 2))], crs="here")
