import csv
import json
import xml.etree.ElementTree as ET
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pyproj
import pytest
import rasterio
from outputs.test_location_files import located, road_mask
from worlds.answers import with_place
from worlds.turned import save_turned

from roadgeo.geometry.homography import Homography
from roadgeo.geometry.projection import LocalPlane
from roadgeo.location import Location
from roadgeo.outputs.kmz import write_kmz
from roadgeo.outputs.location_files import OutputOptions, write_location
from roadgeo.outputs.outlines import write_geojson
from roadgeo.outputs.paths import OutputPaths, output_paths
from roadgeo.outputs.registry import ALSO
from roadgeo.outputs.subject import Subject
from roadgeo.storage.rasters import open_raster


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> OutputPaths:
    """All products of a photograph of twice the mask's size."""
    tmp_path = tmp_path_factory.mktemp("products")
    photo = np.random.default_rng(1).integers(0, 255, (600, 800, 3)).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "photo.png"), photo)
    paths = output_paths(tmp_path / "out", "mask")
    paths.folder.mkdir()
    options = OutputOptions(products=tuple(ALSO))
    _, files, *_ = write_location(located(), road_mask(), paths, options, tmp_path / "photo.png")
    assert sorted(files) == sorted(paths.folder.iterdir())
    return paths


def photo_homography() -> Homography:
    return Homography(located().homography @ np.diag([0.5, 0.5, 1.0]))


def test_the_matches_are_told_with_their_residuals(written: OutputPaths) -> None:
    with (written.folder / "mask_matches.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    evidence = located().place.matches
    assert len(rows) == len(evidence.query_xy)
    pixels = np.array([(row["column"], row["row"]) for row in rows], float)
    np.testing.assert_allclose(pixels, 2 * evidence.query_xy * (1, -1), atol=1e-6)  # the photograph's, not the mask's
    on_map = np.array([(row["x"], row["y"]) for row in rows], float)
    np.testing.assert_allclose(on_map, evidence.reference_xy)
    offset = np.array([(row["dx_m"], row["dy_m"]) for row in rows], float)
    np.testing.assert_allclose(photo_homography()(pixels) + offset, on_map, atol=1e-6)
    np.testing.assert_allclose([float(row["residual_m"]) for row in rows], evidence.residual_m, atol=1e-6)
    _, _, *lines = (written.folder / "photo.png_matches.points").read_text().splitlines()
    points = np.array([line.split(",") for line in lines], float)
    np.testing.assert_allclose(points[:, :2], on_map)
    np.testing.assert_allclose(points[:, 2:4], pixels * (1, -1))
    fitted = points[:, 2:4] + points[:, 5:7]  # in QGIS's pixels, y up
    np.testing.assert_allclose(photo_homography()(fitted * (1, -1)), on_map, atol=1e-6)


#: From (column, row) of the pixels of a file of (width, height) to those of the upright picture.
UPRIGHT = {
    1: lambda pixel, size: pixel,
    3: lambda pixel, size: size - pixel,
    5: lambda pixel, size: pixel[:, ::-1],
    6: lambda pixel, size: np.stack([size[1] - pixel[:, 1], pixel[:, 0]], 1),
}


@pytest.mark.parametrize("orientation", UPRIGHT)
def test_programs_get_points_of_the_stored_pixels(tmp_path: Path, orientation: int) -> None:
    """They do not turn pictures."""
    picture = np.random.default_rng(1).integers(0, 255, (600, 800, 3)).astype(np.uint8)
    photo = save_turned(tmp_path / "photo.png", picture, orientation)
    stored = cv2.imread(str(photo), cv2.IMREAD_UNCHANGED)[..., ::-1]
    size = np.array(stored.shape[1::-1])
    paths = output_paths(tmp_path, "mask")
    products = ("gcps", "vrt", "points", "match-points", "odm", "matches")
    write_location(located(), road_mask(), paths, OutputOptions(products=products), photo)

    def right(column_row: np.ndarray, xy: np.ndarray, atol: float = 1e-6) -> None:
        upright = UPRIGHT[orientation](column_row, size)
        np.testing.assert_allclose(photo_homography()(upright), xy, atol=atol)

    for name in ("mask_gcps.tif", "mask_gcps.vrt"):
        with open_raster(tmp_path / name, is_ours=True) as raster:
            points, crs = raster.gcps
            assert (len(points), crs.to_epsg()) == (25, 32629)
            np.testing.assert_array_equal(np.moveaxis(raster.read(), 0, 2), stored)
        right(np.array([(p.col, p.row) for p in points]), np.array([(p.x, p.y) for p in points]))
    first, *lines = (tmp_path / "mask_gcp_list.txt").read_text().splitlines()
    assert (first, {line.split()[5] for line in lines}) == ("EPSG:32629", {"photo.png"})
    rows = np.array([line.split()[:5] for line in lines], float)
    right(rows[:, 3:5], rows[:, :2])
    assert (rows[:, 2] == 0).all()
    for name in ("photo.png.points", "photo.png_matches.points"):
        first, header, *lines = (tmp_path / name).read_text().splitlines()
        assert pyproj.CRS.from_user_input(first.removeprefix("#CRS: ")).to_epsg() == 32629
        assert header == "mapX,mapY,sourceX,sourceY,enable,dX,dY,residual"
        rows = np.array([line.split(",") for line in lines], float)
        fitted = rows[:, 2:4] + rows[:, 5:7]
        right(fitted * (1, -1), rows[:, :2])
    with (tmp_path / "mask_matches.csv").open(encoding="utf-8") as file:
        pixels = [(float(row["column"]), float(row["row"])) for row in csv.DictReader(file)]
    np.testing.assert_allclose(pixels, 2 * located().place.matches.query_xy * (1, -1), atol=1e-6)


def test_names_that_opendronemap_does_not_take_are_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    photo = tmp_path / "My Photo 1.png"
    cv2.imwrite(str(photo), np.zeros((300, 400, 3), np.uint8))
    write_location(located(), road_mask(), output_paths(tmp_path, "a"), OutputOptions(products=("odm",)), photo)
    reported = "{}: OpenDroneMap takes no names with spaces: rename the picture, and in what is written"
    assert [record.getMessage() for record in caplog.records] == [reported.format("My Photo 1.png")]
    assert "My Photo 1.png" in (tmp_path / "a_gcp_list.txt").read_text()


def test_the_world_file_is_that_of_the_drawn_raster(written: OutputPaths) -> None:
    a, d, b, e, c, f = map(float, (written.folder / "mask_footprint.tfw").read_text().split())
    with rasterio.open(written.footprint) as raster:
        transform = raster.transform
    center = (transform.c + transform.a / 2, transform.f + transform.e / 2)
    np.testing.assert_allclose((a, b, d, e, c, f), (transform.a, 0, 0, transform.e, *center))


def signed_area(ring: list) -> float:
    x, y = np.array(ring).T
    return float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum() / 2)


def check_rfc7946(feature: dict) -> None:
    """What section 3.1.6, 3.1.9, 4 and 5 of RFC 7946 ask of a polygon."""
    assert feature["type"] == "Feature"
    assert "crs" not in feature
    geometry = feature["geometry"]
    polygons = [geometry["coordinates"]] if geometry["type"] == "Polygon" else geometry["coordinates"]
    for (ring,) in polygons:
        assert ring[0] == ring[-1]
        assert len(ring) >= 4
        assert signed_area(ring) > 0  # counterclockwise
        assert np.abs(np.array(ring)).max(axis=0)[0] <= 180
        assert np.ptp(np.array(ring)[:, 0]) < 180
    west, south, east, north = feature["bbox"]
    assert south < north
    assert (west < east) == (len(polygons) == 1)


def test_geojson_is_the_footprint(written: OutputPaths) -> None:
    feature = json.loads((written.folder / "mask_footprint.geojson").read_text())
    check_rfc7946(feature)
    assert feature["properties"]["query"] == "photo_mask.png"
    assert feature["properties"]["attribution"] == "© somebody"
    ring = np.array(feature["geometry"]["coordinates"][0])
    to_crs = pyproj.Transformer.from_crs(4326, 32629, always_xy=True)
    corners = np.stack(to_crs.transform(*ring[[0, 24, 16, 8]].T), 1)
    np.testing.assert_allclose(corners, located().footprint, atol=0.02)


def test_the_stac_item_describes_the_drawn_raster(written: OutputPaths) -> None:
    item = json.loads((written.folder / "mask_stac.json").read_text())
    check_rfc7946(item)
    assert item["stac_version"] == "1.0.0"
    assert {"id", "properties", "links", "assets"} <= set(item)
    properties = item["properties"]
    assert properties["datetime"] is None
    assert properties["start_datetime"] < properties["end_datetime"]
    with rasterio.open(written.footprint) as raster:
        assert properties["proj:code"] == f"EPSG:{raster.crs.to_epsg()}"
        assert properties["proj:shape"] == list(raster.shape)
        np.testing.assert_allclose(properties["proj:transform"], list(raster.transform))
    for asset in item["assets"].values():
        assert (written.folder / asset["href"]).exists()


def read_kmz(path: Path) -> tuple[list[float], np.ndarray]:
    with zipfile.ZipFile(path) as archive:
        root = ET.fromstring(archive.read("doc.kml"))
        picture = cv2.imdecode(np.frombuffer(archive.read("overlay.png"), np.uint8), cv2.IMREAD_UNCHANGED)
    space = {"k": "http://www.opengis.net/kml/2.2"}
    box = root.find(".//k:LatLonBox", space)
    return [float(box.find(f"k:{side}", space).text) for side in ("west", "south", "east", "north")], picture


def test_the_kmz_lies_where_the_picture_does(written: OutputPaths) -> None:
    (west, south, east, north), picture = read_kmz(written.folder / "mask_overlay.kmz")
    assert picture.shape[2] == 4
    rows, columns = np.nonzero(picture[..., 3])
    lon = west + (columns.mean() + 0.5) / picture.shape[1] * (east - west)
    lat = north - (rows.mean() + 0.5) / picture.shape[0] * (north - south)
    middle = pyproj.Transformer.from_crs(32629, 4326, always_xy=True).transform(*located().footprint.mean(axis=0))
    np.testing.assert_allclose((lon, lat), middle, atol=1e-4)


def astride(tmp_path: Path) -> Subject:
    """A mask on the 180th meridian, in Fiji."""
    x, y = pyproj.Transformer.from_crs(4326, 32701, always_xy=True).transform(180.0, -16.8)
    H = np.array([[1.0, 0.0, x - 200.0], [0.0, -1.0, y + 150.0], [0.0, 0.0, 1.0]])
    location: Location = with_place(located(H), plane=LocalPlane("EPSG:32701", located(H).place.plane.origin))
    return Subject(location, road_mask(), output_paths(tmp_path, "a"))


def test_a_footprint_astride_180_degrees_is_cut_there(tmp_path: Path) -> None:
    subject = astride(tmp_path)
    write_geojson(tmp_path / "a.geojson", subject)
    feature = json.loads((tmp_path / "a.geojson").read_text())
    check_rfc7946(feature)
    assert feature["geometry"]["type"] == "MultiPolygon"
    areas = [signed_area(ring) for (ring,) in feature["geometry"]["coordinates"]]
    np.testing.assert_allclose(areas[0], areas[1], rtol=0.02)
    write_kmz(tmp_path / "a.kmz", subject)
    (west, _, east, _), picture = read_kmz(tmp_path / "a.kmz")
    assert 179.9 < west < 180
    assert 180 < east < 180.1  # as KML wants it
    assert picture[..., 3].max() == 255
    assert max(picture.shape[:2]) < 1000
