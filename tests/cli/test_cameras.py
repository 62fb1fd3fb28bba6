"""The camera in the JSON of `locate`: where it was, and that it sees the ground where the homography puts it."""

import json
from pathlib import Path

import numpy as np
import pytest
from worlds.demo import DRONE
from worlds.rasters import write_raster

from roadgeo.cli import main
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.pose import turned
from roadgeo.geometry.projection import LocalPlane, grid_north


@pytest.fixture(scope="module")
def folder(porto: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demonstration's drone mask, located, over ground that lies 90 m high."""
    import rasterio

    folder = tmp_path_factory.mktemp("cameras")
    place = {"crs": "EPSG:4326", "transform": rasterio.Affine(0.001, 0, -8.7, 0, -0.001, 41.2), "nodata": -9999}
    write_raster(folder / "dem.tif", np.full((200, 200), 90.0, np.float32), **place)
    given = ["-r", str(porto), "--dem", str(folder / "dem.tif"), "--effort", "quick", "-q"]
    assert main(["locate", str(DRONE), "-o", str(folder), *given]) == 0
    return folder


def location(folder: Path) -> dict:
    return json.loads((folder / "drone_location.json").read_text())


def test_the_json_says_where_the_camera_was(folder: Path) -> None:
    camera = location(folder)["camera"]
    assert camera["source"] == "homography"  # tilted by 30 degrees: that tells the focal length
    assert camera["focal_px"] == pytest.approx(1280, rel=0.02)
    assert camera["pitch_deg"] == pytest.approx(30, abs=0.5)
    assert camera["altitude_m"] == pytest.approx(camera["height_m"] + 90.0)
    assert (camera["ground_m"], camera["ground_spread_m"]) == (90.0, 0.0)
    assert 0 < camera["sigma"]["height_m"] < 20
    assert location(folder)["tilt_deg"] == pytest.approx(30, abs=0.5)


def seen(camera: dict, rotation: np.ndarray, position: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Pixels in which a pinhole with x right, y up, z backwards sees points of the ground."""
    rays = (np.append(xy, 0.0) - position) @ rotation
    return np.array([640.0, 480.0]) + camera["focal_px"] * rays[:2] / -rays[2] * (1.0, -1.0)


def test_the_camera_and_the_homography_see_the_same(folder: Path) -> None:
    found, camera = location(folder), location(folder)["camera"]
    position = np.array([camera["x"], camera["y"], camera["height_m"]])
    north = grid_north(LocalPlane(found["crs"], (0.0, 0.0)), position[:2])
    axes = turned(np.array(camera["rotation"]), north)
    for pixel in ([0.0, 0.0], [1280.0, 0.0], [300.0, 900.0]):
        ground = Homography(np.array(found["homography"]))(np.array(pixel))
        assert seen(camera, axes, position, ground) == pytest.approx(pixel, abs=1.5)


def test_a_terrain_model_without_a_place_is_refused(
    porto: Path, folder: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    given = ["-r", str(porto), "--dem", str(DRONE), "-o", str(folder / "out"), "-q"]
    assert main(["locate", str(DRONE), *given]) == 1
    assert "expected a terrain model" in capfd.readouterr().err
