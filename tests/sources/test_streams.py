"""Road files are read part by part as they are read whole."""

import gzip
import json
import re
import zipfile

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import shapely
from worlds.fenway import streets, write_streets, write_vector

from roadgeo.errors import RoadSourceError
from roadgeo.geometry.projection import transformer
from roadgeo.sources import osm_files
from roadgeo.sources.roads import read_roads
from roadgeo.sources.streams import list_sources, read_lines, stream_lines

FORMATS = ["streets.gpkg", "streets.shp", "streets.geojson", "streets.parquet", "streets.osm.gz", "streets.osm.pbf"]


@pytest.mark.parametrize("name", FORMATS)
def test_parts_together_are_the_whole(tmp_path, name):
    path = write_streets(tmp_path / name)
    whole, shares = read_lines(path), []
    most = len(streets()[0]) // 2 - 1
    parts = list(stream_lines(path, most=most, advance=shares.append))
    assert len(parts) == 3
    assert max(part.meta["features"] for part in parts) <= most
    assert sum(part.meta["features"] for part in parts) == whole.meta["features"] == len(streets()[0])
    assert {part.crs for part in parts} == {whole.crs}
    assert shapely.equals_exact(np.concatenate([part.lines for part in parts]), whole.lines, 0.0).all()
    assert np.concatenate([part.highway for part in parts]).tolist() == whole.highway.tolist()
    assert np.concatenate([part.tunnel for part in parts]).tolist() == whole.tunnel.tolist()
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


def test_nodes_of_a_large_file_are_kept_on_disk(tmp_path, monkeypatch):
    path = write_streets(tmp_path / "streets.osm.pbf")
    monkeypatch.setattr(osm_files, "_NODES_IN_MEMORY", 0)
    lines = np.concatenate([part.lines for part in stream_lines(path, most=4)])
    assert shapely.equals_exact(lines, read_lines(path).lines, 0.0).all()


@pytest.mark.parametrize("name", ["a.parquet", "a.osm.pbf", "a.gpkg"])
def test_what_cannot_be_read_says_so(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(b"PAR1 nothing of the kind")
    with pytest.raises(RoadSourceError, match=name):
        list(stream_lines(path))


def drawing(path, *layers):
    """Write a drawing of lines in layers, as DXF."""
    lines = [shapely.LineString([(k, 0), (k, 100)]) for k in range(len(layers))]
    return write_vector(path, lines, "EPSG:32629", Layer=list(layers))


@pytest.mark.parametrize(("asked", "n"), [("ROAD-CL", 2), (["ROAD-CL"], 2), (["ROAD-CL", "LANE"], 3), (("LANE",), 1)])
@pytest.mark.parametrize("name", ["plan.dxf", "plan.shp", "plan.gpkg", "plan.geojson", "plan.tab", "plan.fgb"])
def test_layers_of_a_drawing_are_chosen(tmp_path, name, asked, n):
    path = drawing(tmp_path / name, "ROAD-CL", "CONTOUR", "ROAD-CL", "LANE", "PARCEL")
    assert len(read_lines(path, asked).lines) == n
    assert len(list(stream_lines(path, asked, most=2))) >= 1
    assert sum(len(part.lines) for part in stream_lines(path, asked, most=2)) == n
    with pytest.raises(RoadSourceError, match=r"no layer 'road'; it has .*CONTOUR, LANE, PARCEL, ROAD-CL: choose"):
        read_lines(path, "road")


@pytest.mark.parametrize(("asked", "n"), [("ROAD-CL", 2), (["ROAD-CL", "LANE"], 3), (None, 5)])
def test_layers_of_a_drawing_are_chosen_in_parquet_too(tmp_path, asked, n):
    layers = ["ROAD-CL", "CONTOUR", "ROAD-CL", "LANE", "PARCEL"]
    lines = [shapely.LineString([(k, 0), (k, 100)]) for k in range(5)]
    gpd.GeoDataFrame({"Layer": layers}, geometry=lines, crs="EPSG:32629").to_parquet(tmp_path / "plan.parquet")
    assert len(read_lines(tmp_path / "plan.parquet", asked).lines) == n


@pytest.mark.parametrize("name", ["a.parquet", "a.osm.pbf", "a.osm.gz"])
def test_a_layer_is_not_passed_over_where_there_are_none(tmp_path, name):
    with pytest.raises(RoadSourceError, match="has no layers: leave --layer out"):
        read_lines(write_streets(tmp_path / name), "roads")


def test_layers_of_a_drawing_are_listed(tmp_path, caplog):
    with pytest.raises(RoadSourceError, match="several layers hold lines, CONTOUR, ROAD-CL: choose with --layer"):
        read_lines(drawing(tmp_path / "a.dxf", "ROAD-CL", "CONTOUR"))
    assert len(read_lines(drawing(tmp_path / "b.dxf", "ROAD-CL", "ROAD-CL")).lines) == 2
    read_roads(drawing(tmp_path / "a.shp", "ROAD-CL", "CONTOUR"), crs="EPSG:32629")
    assert "--layer chooses by Layer: CONTOUR, ROAD-CL" in caplog.text
    caplog.clear()
    read_roads(drawing(tmp_path / "osm.shp", "0", "1"), crs="EPSG:32629")  # above one another
    assert "--layer" not in caplog.text


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:3857", "EPSG:32619"])
def test_several_layers_are_read_together(tmp_path, crs):
    """A layer for each class, of another CRS and of other columns each."""
    lines, highway, _ = streets()
    path, there = tmp_path / "a.gpkg", transformer("EPSG:4326", crs).transform
    write_vector(path, lines[:3], layer="main", highway=highway[:3])
    moved = [shapely.transform(line, lambda xy: np.c_[there(*xy.T)]) for line in lines[3:]]
    write_vector(path, moved, crs=crs, layer="local", append=True, kind=["yes"] * len(moved))
    found = read_lines(path, ["main", "local"])
    assert len(found.lines) == len(lines)
    assert shapely.hausdorff_distance(found.lines, np.array(lines)).max() < 1e-7
    assert found.highway.tolist() == highway[:3] + [""] * len(moved)
    assert len(read_lines(path, "local").lines) == len(moved)


@pytest.mark.parametrize("more", ["geojsonl", "ndjson", "topojson", "json", "geojson.gz", "fgb", "parquet", "osm.pbf"])
@pytest.mark.parametrize("first", ["gpkg", "geojson"])
def test_a_folder_is_read_whole_or_says_what_it_passes_over(tmp_path, more, first, caplog):
    folder = tmp_path / "roads"
    folder.mkdir()
    lines, highway, _ = streets()
    write_vector(folder / f"a.{first}", lines[:3], highway=highway[:3])
    if more == "topojson":
        arcs = [[list(xy) for xy in line.coords] for line in lines]
        objects = [
            {"type": "LineString", "arcs": [k], "properties": {"highway": kind}} for k, kind in enumerate(highway)
        ]
        topology = {
            "type": "Topology",
            "arcs": arcs,
            "objects": {"r": {"type": "GeometryCollection", "geometries": objects}},
        }
        (folder / "b.topojson").write_text(json.dumps(topology))
    elif more in ("parquet", "osm.pbf"):
        write_streets(folder / f"b.{more}")
    else:
        name = {"ndjson": "geojsonl", "json": "geojson", "geojson.gz": "geojson"}.get(more, more)
        written = write_vector(tmp_path / f"b.{name}", lines, highway=highway)
        content = written.read_bytes()
        (folder / f"b.{more}").write_bytes(gzip.compress(content) if more.endswith("gz") else content)
    for name in ("c.dwg", "d.xlsx", "e.osc", "f.mbtiles", "g.geojson.xz", "notes.txt", "a.prj", ".hidden", "._a.gpkg"):
        (folder / name).write_bytes(b"x")
    (folder / "older").mkdir()
    assert len(list_sources(folder)) == 2
    assert "passed over: 1 .dwg, 1 .mbtiles, 1 .osc, 1 .xlsx, 1 .xz, 1 folder: not read" in caplog.text


def test_a_json_that_is_something_else_is_passed_over(tmp_path, caplog):
    lines, highway, _ = streets()
    write_vector(tmp_path / "a.gpkg", lines, highway=highway)
    (tmp_path / "settings.json").write_text('{"colour": "red"}')
    assert list_sources(tmp_path) == [tmp_path / "a.gpkg"]
    assert "settings.json: passed over" in caplog.text


@pytest.mark.parametrize("share", [0.5, 0.9, 0.999])
@pytest.mark.parametrize(
    "name",
    [
        *("a.shp", "a.geojsonl", "a.ndjson", "a.geojson", "a.gpkg", "a.fgb", "a.gml", "a.kml", "a.parquet"),
        *("a.osm.pbf", "a.csv", "a.dxf", "a.mif", "a.gpx", "a.json"),
    ],
)
def test_a_file_that_is_cut_off_is_refused(tmp_path, name, share):
    lines, highway, _ = streets()
    path = tmp_path / name
    if name in ("a.parquet", "a.osm.pbf"):
        write_streets(path)
    elif name == "a.csv":
        pd.DataFrame({"highway": highway, "WKT": shapely.to_wkt(lines)}).to_csv(path, index=False)
    else:
        table = gpd.GeoDataFrame({"highway": highway}, geometry=lines, crs=4326)
        table = table[["geometry"]] if name in ("a.dxf", "a.gpx") else table
        drivers = {"ndjson": "GeoJSONSeq", "geojsonl": "GeoJSONSeq", "gml": "GML", "kml": "KML", "fgb": "FlatGeobuf"}
        drivers |= {"dxf": "DXF", "mif": "MapInfo File", "gpx": "GPX", "json": "GeoJSONSeq"}
        table.to_file(path, engine="pyogrio", driver=drivers.get(path.suffix[1:]))
    assert len(read_lines(path).lines) > 3
    whole = path.read_bytes()
    path.write_bytes(whole[: min(int(share * len(whole)), len(whole) - 2)])
    with pytest.raises(RoadSourceError, match=r"cut off|damaged|not readable") as raised:
        read_lines(path)
    assert ".cpp" not in str(raised.value)
    assert "of a format that is not read" not in str(raised.value)


@pytest.mark.parametrize("name", ["a.gpkg", "a.shp", "a.geojson", "a.csv", "a.osm.pbf", "a.osm", "a.parquet", "a.kml"])
@pytest.mark.parametrize(
    ("content", "word"),
    [
        (b"", "is empty"),
        (b"\n<!DOCTYPE html><html><body>404</body></html>", "is a web page"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "Git LFS"),
    ],
)
def test_what_came_in_place_of_a_file_is_named(tmp_path, name, content, word):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(RoadSourceError, match=word):
        read_lines(tmp_path / name)


def test_an_archive_of_a_macintosh_is_read_and_errors_name_it(tmp_path):
    lines, highway, _ = streets()
    whole = write_vector(tmp_path / "a.gpkg", lines, highway=highway).read_bytes()
    for name, content in (("whole.zip", whole), ("cut.zip", whole[:-9000])):
        with zipfile.ZipFile(tmp_path / name, "w") as archive:
            archive.writestr("a.gpkg", content)
            archive.writestr("__MACOSX/._a.gpkg", b"\0\5\x16\7")
    assert len(read_lines(tmp_path / "whole.zip").lines) == len(lines)
    with pytest.raises(RoadSourceError, match=re.escape(str(tmp_path / "cut.zip" / "a.gpkg"))):
        read_lines(tmp_path / "cut.zip")
