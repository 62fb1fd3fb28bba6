"""`roadgeo verify` on real roads: a mask of the demonstration, where it belongs and elsewhere."""

import csv
import json
from pathlib import Path

import cv2
import jsonschema
import numpy as np
import pyproj
import pytest
import rasterio
from worlds.demo import MASKS
from worlds.rasters import write_raster
from worlds.turned import mark_turned

import roadgeo
from roadgeo.cli import main
from roadgeo.geometry.georeference import Georeference
from roadgeo.geometry.homography import Homography
from roadgeo.outputs.schemas import read_schema
from roadgeo.outputs.verification_files import write_fixed

SHEET = MASKS["map_sheet"]


def georeferenced(name: str, east: float, north: float) -> Path:
    """The map sheet on its own pixels, its place moved."""
    values = cv2.imread(str(SHEET.path), cv2.IMREAD_GRAYSCALE)
    height, width = values.shape
    linear = Homography(SHEET.homography).jacobian(np.array([width / 2, height / 2]))
    x, y = Homography(SHEET.homography)(np.array([width / 2, height / 2]))
    corner = np.array([x + east, y + north]) - linear @ (width / 2, height / 2)
    place = rasterio.Affine(*linear[0], corner[0], *linear[1], corner[1])
    return write_raster(name, values, crs=SHEET.crs, transform=place)


def test_right_wrong_and_unknown_are_told_and_the_wrong_one_is_corrected(
    porto: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    georeferenced("right.tif", 0, 0)
    georeferenced("wrong.tif", 60, -35)
    georeferenced("far.tif", 90_000, 0)
    names = ["right.tif", "wrong.tif", "far.tif"]
    status = main(["verify", *names, "-r", str(porto), "--fix", "--report", "--json", "-o", "out"])
    out, err = capfd.readouterr()
    assert status == 4, err
    pages = [Path("out", f"{name.removesuffix('.tif')}_verify.html").read_text("utf-8") for name in names]
    assert ["corrected" in page for page in pages] == [False, True, False]
    assert ["query-roads" in page.partition("<body>")[2] for page in pages] == [True, True, False]
    right, wrong, far = map(json.loads, out.splitlines())
    for entry in (right, wrong, far):
        jsonschema.validate(entry, read_schema("verification"))
    assert [item["verdict"] for item in (right, wrong, far)] == ["agrees", "off", "unknown"]
    assert "lies on none of the maps" in far["reason"]
    shift = wrong["displacement"]
    assert np.hypot(shift["east_m"] + 60, shift["north_m"] - 35) < 3  # grid north is not north: 0.3 degrees here
    rows = list(csv.DictReader(Path("out/roadgeo_verify.csv").read_text().splitlines()))
    assert [row["verdict"] for row in rows] == ["agrees", "off", "unknown"]
    written = {path.name for path in Path("out").iterdir() if path.suffix != ".html"}
    assert written == {"roadgeo_verify.csv", "wrong_fixed.tif", "wrong_fixed.points"}
    assert main(["verify", "out/wrong_fixed.tif", "-r", str(porto)]) == 0
    with rasterio.open("out/wrong_fixed.tif") as fixed, rasterio.open("wrong.tif") as given:
        assert (fixed.read() == given.read()).all()
        assert fixed.crs == given.crs


@pytest.mark.parametrize("margins", [(0, 0, 0, 0), (90, 0, 160, 0), (0, 120, 0, 70), (50, 60, 70, 80)])
@pytest.mark.parametrize("over", [1, -1])
def test_margins_that_were_not_observed_move_nothing(margins: tuple[int, ...], over: int, porto: Path) -> None:
    with rasterio.open(georeferenced("plain.tif", 40, 10)) as source:
        values, transform, crs = source.read(1), source.transform, source.crs
    top, bottom, left, right = margins
    padded = np.pad(np.where(values > 127, 255, 1).astype(np.uint8), ((top, bottom), (left, right)))  # 0: nodata
    transform = transform @ rasterio.Affine.translation(-left, -top)
    if over < 0:  # stored from right to left
        transform = transform @ rasterio.Affine(-1, 0, padded.shape[1], 0, 1, 0)
    name = write_raster("padded.tif", padded[:, ::over], crs=crs, transform=transform, nodata=0)
    checked = roadgeo.verify(name, porto).document
    assert checked["verdict"] == "off"
    assert np.hypot(checked["displacement"]["east_m"] + 40, checked["displacement"]["north_m"] + 10) < 0.5


def test_an_image_is_overwritten_only_where_that_is_asked_for(porto: Path, capfd: pytest.CaptureFixture[str]) -> None:
    before = georeferenced("a.tif", 40, 10).read_bytes()
    assert main(["verify", "a.tif", "-r", str(porto)]) == 4
    assert Path("a.tif").read_bytes() == before
    assert {path.name for path in Path().iterdir()} == {"a.tif"}
    assert main(["verify", "a.tif", "-r", str(porto), "--in-place", "-q"]) == 4
    assert main(["verify", "a.tif", "-r", str(porto)]) == 0
    assert "a.tif: agrees" in capfd.readouterr().out


def test_a_raster_that_is_to_be_turned_lies_where_its_stored_pixels_do(porto: Path) -> None:
    with rasterio.open(georeferenced("a.tif", 40, 10)) as raster:
        before = np.array(raster.transform).reshape(3, 3)
    mark_turned(Path("a.tif"), 3)
    assert main(["verify", "a.tif", "-r", str(porto), "--fix", "--in-place", "-q", "-o", "."]) == 4
    for name in ("a.tif", "a_fixed.tif"):
        with rasterio.open(name) as raster:
            moved = np.array(raster.transform).reshape(3, 3) - before
        assert moved[:2, 2] == pytest.approx((-40.0, -10.0), abs=3.0)
        assert main(["verify", name, "-r", str(porto), "-q"]) == 0


@pytest.mark.parametrize(
    ("datum", "verdict"),
    [
        ("+ellps=intl", "unknown"),
        ("+ellps=bessel", "unknown"),
        ("+ellps=intl +towgs84=-87,-98,-121", "off"),
        ("+ellps=GRS80", "off"),
        ("+datum=WGS84", "off"),
    ],
)
@pytest.mark.parametrize("where", ["geotransform", "prj"])
def test_what_may_be_the_shift_of_a_datum_without_a_name_is_no_wrong_place(
    porto: Path, datum: str, verdict: str, where: str
) -> None:
    path = georeferenced("a.tif", 60, -35)
    with rasterio.open(path) as raster:
        values, place = raster.read(1), raster.transform
    crs = pyproj.CRS(f"+proj=utm +zone=29 {datum} +units=m")
    to_own = pyproj.Transformer.from_crs(SHEET.crs, crs, always_xy=True)
    corner = np.array(to_own.transform(place.c, place.f))
    place = rasterio.Affine(place.a, place.b, corner[0], place.d, place.e, corner[1])
    if where == "geotransform":
        path = write_raster("a.tif", values, crs=crs.to_wkt(), transform=place)
    else:
        path = Path("a.png")
        cv2.imwrite("a.png", values)
        Path("a.prj").write_text(crs.to_wkt("WKT1_GDAL"))
        x, y = place @ (0.5, 0.5)
        Path("a.pgw").write_text("\n".join(map(str, (place.a, place.d, place.b, place.e, x, y))))
    found = roadgeo.verify(path, porto)
    assert found.verdict == verdict
    assert ("PROJ does not know" in found.document["reason"]) == (verdict == "unknown")
    assert (found.corrected is None) == (verdict == "unknown")


def test_what_has_no_place_or_is_no_image_is_told_in_a_line(porto: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["verify", str(SHEET.path), "-r", str(porto)]) == 3
    assert "it has no georeference: use `roadgeo locate`" in capfd.readouterr().out
    Path("b.tif").write_text("no picture")
    assert main(["verify", "b.tif", "missing.tif", "-r", str(porto)]) == 1
    assert capfd.readouterr().err.count("Error:") == 2


def test_a_corrected_picture_that_had_a_world_file_is_written_without_a_warning(tmp_path: Path) -> None:
    """Warnings are errors in tests."""
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((40, 50), np.uint8))
    place = Georeference(np.array([[2.0, 0, 5e5], [0, -2.0, 4.5e6], [0, 0, 1]]), "EPSG:32629", (50, 40), "world file")
    write_fixed(tmp_path / "a.png", tmp_path / "fixed.tif", place)
    with rasterio.open(tmp_path / "fixed.tif") as fixed:
        assert fixed.crs == "EPSG:32629"
