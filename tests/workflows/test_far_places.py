"""The whole way, from road lines to every output, where degrees are awkward: at 180°, at a pole, far and wide."""

import json
import math
import re
import zipfile
from pathlib import Path

import numpy as np
import pyproj
import pytest
import rasterio
import shapely
from rasterio.warp import transform_bounds
from support.ogc import validate
from worlds.fenway import write_vector

from roadgeo.cli import main
from roadgeo.evaluation import simulation


def made_up_town(lon: float, lat: float, n: int = 15, spacing: float = 110.0) -> list[shapely.LineString]:
    """A lattice whose crossings are shifted and some of whose roads are missing, around a place; degrees.

    Its roads are cut at 180 degrees, as OpenStreetMap's are.
    """
    rng = np.random.default_rng(int(abs(lat)))
    plane = pyproj.CRS.from_proj4(f"+proj=aeqd +lat_0={lat} +lon_0={lon} +datum=WGS84")
    to_degrees = pyproj.Transformer.from_crs(plane, "EPSG:4326", always_xy=True)
    column, row = np.meshgrid(np.arange(n), np.arange(n))
    xy = spacing * (np.column_stack((column.ravel(), row.ravel())) - n / 2) + rng.uniform(-28, 28, (n * n, 2))
    lonlat = np.stack(to_degrees.transform(*xy.T), axis=1)
    number = np.arange(n * n).reshape(n, n)
    across = np.column_stack((number[:, :-1].ravel(), number[:, 1:].ravel()))
    along = np.column_stack((number[:-1].ravel(), number[1:].ravel()))
    edges = np.vstack((across, along))
    return [part for edge in edges[rng.random(len(edges)) > 0.15] for part in cut_at_180(lonlat[edge])]


def cut_at_180(ends: np.ndarray) -> list[shapely.LineString]:
    a, b = ends
    if abs(a[0] - b[0]) < 180 or max(abs(ends[:, 1])) > 89.5:  # at a pole every road is short, whatever its degrees
        return [shapely.LineString(ends)]
    share = (180 - abs(a[0])) / (360 - abs(a[0]) - abs(b[0]))
    lat = a[1] + share * (b[1] - a[1])
    return [shapely.LineString([end, (math.copysign(180, end[0]), lat)]) for end in (a, b) if abs(end[0]) < 180 - 1e-9]


PLACES = {
    "taveuni": ([(180.0, -16.85)], "EPSG:32760", "MultiPolygon"),
    "arctic": ([(20.0, 89.0)], "EPSG:5041", "Polygon"),
    "antarctic": ([(120.0, -89.999)], "EPSG:5042", None),
    "far and wide": ([(10.0, 48.0), (19.0, 50.0)], "Oblique stereographic, 49 N, 14.5 E", "Polygon"),
}


@pytest.mark.parametrize("name", PLACES)
def test_from_road_lines_to_every_output(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    towns, crs, geometry_type = PLACES[name]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(simulation, "MAX_TRIES", 400)  # not 4,000: between towns far apart it is in vain in any case
    roads = write_vector(tmp_path / "roads.gpkg", [line for town in towns for line in made_up_town(*town)])
    assert main(["index", "--roads", str(roads), "-o", "map.gpkg", "-q"]) == 0
    assert main(["reference", "check", "map.gpkg"]) == 0
    capsys.readouterr()
    assert main(["reference", "info", "map.gpkg"]) == 0
    assert re.search(r"^CRS +(.*)$", capsys.readouterr().out, re.MULTILINE)[1] == crs

    draw = ["--noise", "clean", "--size", "800", "--gsd", "0.9:1.1", "--intersections", "15:1000", "-n", "3", "-q"]
    assert main(["simulate", "map.gpkg", "-o", "queries", *draw]) == 0
    masks = sorted(str(path) for path in (tmp_path / "queries" / "clean").iterdir())
    products = ["geojson", "stac", "points", "odm", *(["kmz"] if name != "antarctic" else [])]
    also = [word for product in products for word in ("--also", product)]
    assert main(["locate", *masks, "-r", "map.gpkg", "-o", "out", *also, "--report", "-q"]) == 0

    truths = {
        truth["file"]: truth for truth in json.loads((tmp_path / "queries" / "truth.json").read_text())["queries"]
    }
    for mask in masks:
        stem = Path(mask).stem
        location = json.loads((tmp_path / "out" / f"{stem}_location.json").read_text())
        check_place(location, truths[f"clean/{stem}.png"])
        check_outputs(tmp_path / "out", stem, location, geometry_type)
        if "kmz" in products:
            check_kmz(tmp_path / "out" / f"{stem}_overlay.kmz", location)
    check_summary(tmp_path / "out", len(masks))
    written = sorted(path for path in tmp_path.rglob("*.gpkg") if path != roads)
    assert len(written) == 3 + len(masks)  # the map, what was drawn, the summary, and one for each mask
    assert validate(*written) == ""
    if name == "antarctic":
        capsys.readouterr()
        assert main(["locate", *masks, "-r", "map.gpkg", "-o", "more", "--also", "kmz", "-q"]) == 1
        assert "so near a pole there is no picture in degrees; leave out --also kmz" in capsys.readouterr().err


def check_place(location: dict, truth: dict) -> None:
    """It lies where it was drawn, in the plane and in degrees, and up points where it should."""
    center = location["center"]
    assert math.dist((center["x"], center["y"]), (truth["center_x"], truth["center_y"])) < 1
    to_degrees = pyproj.Transformer.from_crs(location["crs"], "EPSG:4326", always_xy=True)
    assert (center["lon"], center["lat"]) == pytest.approx(to_degrees.transform(center["x"], center["y"]), abs=1e-9)
    width, height = location["size"]
    pixels = np.array([(width / 2, height / 2, 1), (width / 2, height / 2 - 1, 1)]) @ np.array(location["homography"]).T
    (lon, lat), (lon_up, lat_up) = np.stack(to_degrees.transform(*(pixels[:, :2] / pixels[:, 2:]).T), axis=1)
    up, _, length = pyproj.Geod(ellps="WGS84").inv(lon, lat, lon_up, lat_up)
    assert (location["rotation_deg"] - up + 180) % 360 - 180 == pytest.approx(0, abs=0.05)
    assert length == pytest.approx(location["gsd_m"], rel=0.25)


def check_outputs(folder: Path, stem: str, location: dict, geometry_type: str | None) -> None:
    center = shapely.Point(location["center"]["lon"], location["center"]["lat"])
    for name in (f"{stem}_footprint.geojson", f"{stem}_stac.json"):
        feature = json.loads((folder / name).read_text())
        footprint = shapely.from_geojson(json.dumps(feature["geometry"]))
        assert footprint.is_valid
        assert all(part.exterior.is_ccw for part in shapely.get_parts(footprint))
        assert np.abs(shapely.get_coordinates(footprint)).max(axis=0).tolist() <= [180, 90]
        assert footprint.covers(center)
        west, south, east, north = feature["bbox"]
        assert shapely.union_all(boxes(west, south, east, north)).buffer(1e-6).covers(footprint)
        assert geometry_type is None or abs(center.x) < 179.99 or footprint.geom_type == geometry_type
    with rasterio.open(folder / f"{stem}_footprint.tif") as raster:
        assert pyproj.CRS(raster.crs).equals(pyproj.CRS(location["crs"]), ignore_axis_order=True)
        assert raster.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        row, column = raster.index(location["center"]["x"], location["center"]["y"])
        assert raster.read(1)[row, column] != raster.nodata
        transform_bounds(raster.crs, "EPSG:4326", *raster.bounds)  # GDAL knows the plane
    points = (folder / f"{stem}.png.points").read_text().splitlines()
    assert pyproj.CRS(points[0].removeprefix("#CRS: ")).equals(pyproj.CRS(location["crs"]))
    plane = pyproj.CRS((folder / f"{stem}_gcp_list.txt").read_text().splitlines()[0])
    assert pyproj.Transformer.from_crs(plane, location["crs"], always_xy=True).transform(1e3, 2e3) == pytest.approx(
        (1e3, 2e3), abs=1e-6
    )
    assert f"{stem}" in (folder / f"{stem}_report.html").read_text()


def boxes(west: float, south: float, east: float, north: float) -> list[shapely.Polygon]:
    """A bounding box as RFC 7946 has it."""
    if west <= east:
        return [shapely.box(west, south, east, north)]
    return [shapely.box(west, south, 180, north), shapely.box(-180, south, east, north)]


def check_kmz(path: Path, location: dict) -> None:
    """The picture is as wide as the ground it shows, whatever meridian runs through it."""
    with zipfile.ZipFile(path) as archive:
        text = archive.read("doc.kml").decode()
    north, south, east, west = (
        float(re.search(f"<{side}>(.*)</{side}>", text)[1]) for side in ("north", "south", "east", "west")
    )
    lon, lat = location["center"]["lon"], location["center"]["lat"]
    assert -180 <= west < west + (lon - west) % 360 < east
    assert south < lat < north
    assert (east - west) * 111_320 * math.cos(math.radians(lat)) < 3000


def check_summary(folder: Path, n: int) -> None:
    """Footprints are small, also in degrees, but for those that hold a pole."""
    import pyogrio

    found = pyogrio.read_dataframe(folder / "roadgeo_summary.gpkg", layer="footprints")
    assert len(found) == n
    assert found.geometry.is_valid.all()
    geod = pyproj.Geod(ellps="WGS84")
    areas = [
        sum(abs(geod.geometry_area_perimeter(part)[0]) for part in shapely.get_parts(shape)) for shape in found.geometry
    ]
    assert max(areas) < 5e6
    assert shapely.from_wkt(
        [line.split('"')[-2] for line in (folder / "roadgeo_summary.csv").read_text().splitlines()[1:]]
    ).shape == (n,)
