"""Roads as vector tiles: what the map has, where it has it."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from mapbox_vector_tile import decode

from roadgeo.geometry.projection import to_lonlat
from roadgeo.reference.opening import open_reference
from roadgeo.reference.reference import Reference
from roadgeo.serving.tiles import MAX_ZOOM, Tiles, street_at

WORLD_M = 2 * 20037508.342789244


def tile_of(lon, lat, zoom):
    n = 2**zoom
    return int((lon + 180) / 360 * n), int((1 - math.asinh(math.tan(math.radians(lat))) / math.pi) / 2 * n)


def points_of(tile, zoom, column, row):
    """The vertices of a tile's roads, in metres of the CRS of web maps."""
    side = WORLD_M / 2**zoom
    geometry = decode(tile, default_options={"y_coord_down": True})["roads"]["features"][0]["geometry"]
    points = np.vstack([np.array(line) for line in geometry["coordinates"]])
    return points / 4096 * side * (1, -1) + (column * side - WORLD_M / 2, WORLD_M / 2 - row * side)


@pytest.fixture(scope="module")
def tiles(town):
    network, index = town
    return Tiles([Reference(index, network)]), index


@pytest.mark.parametrize("zoom", [10, 13, 15])
def test_a_tile_holds_the_roads_where_they_lie(tiles, zoom):
    made, index = tiles
    ends = index.plane.to_crs(index.segments.reshape(-1, 2).astype(float))
    lon, lat = to_lonlat(index.plane.crs, ends.mean(axis=0, keepdims=True))[0]
    column, row = tile_of(lon, lat, zoom)
    found = to_lonlat("EPSG:3857", points_of(made.tile(0, zoom, column, row), zoom, column, row))
    known = to_lonlat(index.plane.crs, ends)
    step_m = WORLD_M / 2**zoom / (4096 if zoom > 12 else 512)
    scale = 111195 * np.array([math.cos(math.radians(lat)), 1.0])
    for point in found[:: max(len(found) // 50, 1)]:
        assert np.hypot(*((known - point) * scale).T).min() < 2 * step_m


def test_all_roads_lie_in_some_tile(tiles):
    made, index = tiles
    zoom, known = 14, to_lonlat(index.plane.crs, index.plane.to_crs(index.segments.reshape(-1, 2).astype(float)))
    for lon, lat in known[::500]:
        column, row = tile_of(lon, lat, zoom)
        found = to_lonlat("EPSG:3857", points_of(made.tile(0, zoom, column, row), zoom, column, row))
        assert np.hypot(*((found - (lon, lat)) * 111195).T).min() < 3.0


def test_near_by_streets_have_names(town, tmp_path):
    network, index = town
    names = np.array([f"Street {k}" if k % 2 else "" for k in range(network.graph.n_edges)], object)
    Reference(index, replace(network, names=names)).save(tmp_path / "town.gpkg")
    reference = open_reference(tmp_path / "town.gpkg")
    lon, lat = to_lonlat(index.plane.crs, index.plane.to_crs(index.xy[:1]))[0]
    column, row = tile_of(lon, lat, MAX_ZOOM)
    layers = decode(Tiles([reference]).tile(0, MAX_ZOOM, column, row), default_options={"y_coord_down": True})
    features = layers["streets"]["features"]
    assert all(re.fullmatch(r"Street \d+", feature["properties"]["name"]) for feature in features)
    # A street lies where the road of that number does.
    feature = features[0]
    number = int(feature["properties"]["name"].split()[1])
    known = to_lonlat(
        index.plane.crs, index.plane.to_crs(network.graph.coords[slice(*network.graph.offsets[number : number + 2])])
    )
    side = WORLD_M / 2**MAX_ZOOM
    corner = np.array([column * side - WORLD_M / 2, WORLD_M / 2 - row * side])
    place = to_lonlat("EPSG:3857", np.array(feature["geometry"]["coordinates"]) / 4096 * side * (1, -1) + corner)
    assert (place >= known.min(axis=0) - 1e-4).all()
    assert (place <= known.max(axis=0) + 1e-4).all()
    # The nearest one lends a place its name.
    there = known.mean(axis=0) if len(known) == 2 else known[len(known) // 2]
    assert street_at([reference.index], tuple(there.tolist())) == f"Street {number}"
    assert street_at([reference.index], (lon + 1.0, lat)) == ""
    assert "streets" not in decode(Tiles([reference]).tile(0, 14, column // 2, row // 2))


def test_where_nothing_is_there_is_nothing(tiles):
    made, _ = tiles
    assert made.tile(0, 12, 0, 0) == b""
    (reported,) = made.describe()
    west, south, east, north = reported["bounds"]
    assert west < east
    assert south < north


@pytest.mark.parametrize("asked", [(1, 0, 0, 0), (-1, 0, 0, 0), (0, MAX_ZOOM + 1, 0, 0), (0, 2, 4, 0), (0, 2, 0, -1)])
def test_there_are_no_others(tiles, asked):
    with pytest.raises(KeyError):
        tiles[0].tile(*asked)
