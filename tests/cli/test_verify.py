"""`roadgeo verify` on real roads: a mask of the demonstration, where it belongs and elsewhere."""

import csv
import json
import xml.etree.ElementTree as ET
from pathlib import Path

import cv2
import jsonschema
import numpy as np
import pytest
import rasterio

from roadgeo.cli import main
from roadgeo.evaluation.demo import ATTRIBUTION, ROADS, demo_masks
from roadgeo.geometry.homography import Homography
from roadgeo.outputs.schemas import read_schema
from roadgeo.sources.roads import read_roads
from roadgeo.workflows import build_reference

SHEET = next(mask for mask in demo_masks() if mask.path.stem == "map_sheet")


@pytest.fixture(scope="module")
def porto(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("reference") / "porto.gpkg"
    build_reference(read_roads(ROADS, attribution=ATTRIBUTION), "porto", path=path)
    return path


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def georeferenced(name: str, east: float, north: float) -> Path:
    """The map sheet on its own pixels, its place moved."""
    values = cv2.imread(str(SHEET.path), cv2.IMREAD_GRAYSCALE)
    height, width = values.shape
    linear = Homography(SHEET.homography).jacobian(np.array([width / 2, height / 2]))
    x, y = Homography(SHEET.homography)(np.array([width / 2, height / 2]))
    corner = np.array([x + east, y + north]) - linear @ (width / 2, height / 2)
    place = rasterio.Affine(*linear[0], corner[0], *linear[1], corner[1])
    profile = {"driver": "GTiff", "width": width, "height": height, "count": 1, "dtype": "uint8"}
    with rasterio.open(name, "w", crs=SHEET.crs, transform=place, **profile) as file:
        file.write(values, 1)
    return Path(name)


def test_right_wrong_and_unknown_are_told_and_the_wrong_one_is_corrected(
    porto: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    georeferenced("right.tif", 0, 0)
    georeferenced("wrong.tif", 60, -35)
    georeferenced("far.tif", 90_000, 0)
    names = ["right.tif", "wrong.tif", "far.tif"]
    status = main(["verify", *names, "-r", str(porto), "--fix", "--josm", "--json", "-o", "out"])
    out, err = capfd.readouterr()
    assert status == 4, err
    right, wrong, far = map(json.loads, out.splitlines())
    for one in (right, wrong, far):
        jsonschema.validate(one, read_schema("verification"))
    assert [one["verdict"] for one in (right, wrong, far)] == ["agrees", "off", "unknown"]
    assert "lies on none of the maps" in far["reason"]
    shift = wrong["displacement"]
    assert np.hypot(shift["east_m"] + 60, shift["north_m"] - 35) < 3  # grid north is not north: 0.3 degrees here
    stretch = 1 / np.cos(np.radians(wrong["center"]["lat"]))
    assert wrong["editors"]["mercator_east"] == pytest.approx(shift["east_m"] * stretch)
    assert wrong["editors"]["id"].endswith(f"&offset={shift['east_m'] * stretch:.2f},{shift['north_m'] * stretch:.2f}")
    rows = list(csv.DictReader(Path("out/roadgeo_verify.csv").read_text().splitlines()))
    assert [row["verdict"] for row in rows] == ["agrees", "off", "unknown"]
    tags = {tag.attrib["key"]: tag.attrib["value"] for tag in ET.parse("out/roadgeo_offsets.xml").getroot()[0][0]}
    assert float(tags["dx"]) == pytest.approx(wrong["editors"]["mercator_east"], abs=1e-3)
    written = {path.name for path in Path("out").iterdir()}
    assert written == {"roadgeo_verify.csv", "roadgeo_offsets.xml", "wrong_fixed.tif", "wrong_fixed.points"}
    assert main(["verify", "out/wrong_fixed.tif", "-r", str(porto)]) == 0
    with rasterio.open("out/wrong_fixed.tif") as fixed, rasterio.open("wrong.tif") as given:
        assert (fixed.read() == given.read()).all()
        assert fixed.crs == given.crs


def test_an_image_is_overwritten_only_where_that_is_asked_for(porto: Path, capfd: pytest.CaptureFixture[str]) -> None:
    before = georeferenced("a.tif", 40, 10).read_bytes()
    assert main(["verify", "a.tif", "-r", str(porto)]) == 4
    assert Path("a.tif").read_bytes() == before
    assert {path.name for path in Path().iterdir()} == {"a.tif"}
    assert main(["verify", "a.tif", "-r", str(porto), "--in-place", "-q"]) == 4
    assert main(["verify", "a.tif", "-r", str(porto)]) == 0
    assert "a.tif: agrees" in capfd.readouterr().out


def test_what_has_no_place_or_is_no_image_is_told_in_a_line(porto: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["verify", str(SHEET.path), "-r", str(porto)]) == 3
    assert "it has no georeference: use `roadgeo locate`" in capfd.readouterr().out
    Path("b.tif").write_text("no picture")
    assert main(["verify", "b.tif", "missing.tif", "-r", str(porto)]) == 1
    assert capfd.readouterr().err.count("Error:") == 2
