"""Roads that come as lines: in pixels of a picture, in metres of nowhere, and in degrees that are off."""

import json
from pathlib import Path

import geopandas as gpd
import numpy as np
import pytest
import shapely
from worlds.demo import DRONE, MASKS

from roadgeo.cli import main
from roadgeo.evaluation.demo import ROADS
from roadgeo.geometry.homography import Homography


@pytest.fixture(scope="module")
def piece() -> gpd.GeoSeries:
    """Roads within 1200 x 1000 m of the map, in its metres."""
    roads = gpd.read_file(ROADS).to_crs("EPSG:32629").geometry
    x, y = np.mean(roads.total_bounds[[0, 2]]), np.mean(roads.total_bounds[[1, 3]])
    return roads.clip(shapely.box(x - 600, y - 500, x + 600, y + 500)).explode()


def located(name: str, porto: Path, capfd: pytest.CaptureFixture[str], *more: str) -> dict:
    status = main(["locate", name, "-r", str(porto), "--effort", "quick", "--json", "-q", *more])
    out, err = capfd.readouterr()
    assert status == 0, err + out
    return json.loads(out)


def test_lines_traced_on_a_picture_lie_where_the_picture_does(porto: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["vectorize", str(DRONE)]) == 0
    capfd.readouterr()
    found = located("drone_vectorized.gpkg", porto, capfd)
    to_crs = Homography(np.array(found["homography"])) @ Homography(np.array(found["query_to_pixel"]))
    pixels = np.array([[300.0, 200.0], [900.0, 700.0]])
    truth = Homography(MASKS["drone"].homography)(pixels)
    assert to_crs(pixels * (1, -1)) == pytest.approx(truth, abs=2.0)
    assert Path("drone_vectorized_footprint.tif").exists()


@pytest.mark.filterwarnings("ignore:'crs' was not provided")
def test_metres_of_nowhere_are_found_with_their_scale(
    porto: Path, piece: gpd.GeoSeries, capfd: pytest.CaptureFixture[str]
) -> None:
    middle = np.array(piece.total_bounds).reshape(2, 2).mean(axis=0)
    turned = piece.rotate(35, origin=tuple(middle)).translate(-middle[0] + 90, -middle[1] - 40)
    gpd.GeoSeries(turned.to_numpy()).to_file("survey.fgb", engine="pyogrio")
    assert main(["locate", "survey.fgb", "-r", str(porto), "-q"]) == 1
    assert "give --units pixels or --units metres" in capfd.readouterr().err
    found = located("survey.fgb", porto, capfd, "--units", "metres")
    to_crs = Homography(np.array(found["homography"])) @ Homography(np.array(found["query_to_pixel"]))
    assert to_crs(np.array([90.0, -40.0])) == pytest.approx(middle, abs=1.5)


def test_degrees_that_are_off_are_put_right(
    porto: Path, piece: gpd.GeoSeries, capfd: pytest.CaptureFixture[str]
) -> None:
    off = piece.translate(700, -300)
    off.to_crs("EPSG:4326").to_file("tracks.geojson", engine="pyogrio")
    found = located("tracks.geojson", porto, capfd)
    lon, lat = (
        np.mean(piece.to_crs("EPSG:4326").total_bounds[[0, 2]]),
        np.mean(piece.to_crs("EPSG:4326").total_bounds[[1, 3]]),
    )
    assert (found["center"]["lon"], found["center"]["lat"]) == pytest.approx((lon, lat), abs=3e-4)
    assert abs(found["rotation_deg"]) < 1
    assert found["query_to_pixel"] is None


def test_a_file_without_lines_is_refused(porto: Path, capfd: pytest.CaptureFixture[str]) -> None:
    gpd.GeoSeries([shapely.Point(1, 2)], crs="EPSG:4326").to_file("points.geojson", engine="pyogrio")
    assert main(["locate", "points.geojson", "-r", str(porto), "-q"]) == 1
    assert "expected lines: the centre lines of roads" in capfd.readouterr().err
    assert not Path("points_location.json").exists()
