"""Where the camera was, as other programs read it; and a Georeference Annotation."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from worlds.turned import save_turned

from roadgeo.cli import main
from roadgeo.errors import OutputError
from roadgeo.evaluation.demo import ATTRIBUTION, ROADS, demo_masks
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.projection import LocalPlane, from_lonlat
from roadgeo.running.applying import apply_location, read_location
from roadgeo.sources.roads import read_roads
from roadgeo.workflows import build_reference

DRONE = next(mask for mask in demo_masks() if mask.path.stem == "drone")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demonstration's drone mask and its map sheet, located, with all that cameras are written as."""
    import rasterio

    folder = tmp_path_factory.mktemp("cameras")
    build_reference(read_roads(ROADS, attribution=ATTRIBUTION), "porto", path=folder / "porto.gpkg")
    place = rasterio.Affine(0.001, 0, -8.7, 0, -0.001, 41.2)
    profile = {"driver": "GTiff", "width": 200, "height": 200, "count": 1, "dtype": "float32", "nodata": -9999}
    with rasterio.open(folder / "dem.tif", "w", crs="EPSG:4326", transform=place, **profile) as dem:
        dem.write(np.full((200, 200), 90.0, np.float32), 1)
    masks = [str(DRONE.path), str(DRONE.path.with_name("map_sheet.png"))]
    also = [word for name in ("geopose", "orthority", "odm-geo", "iiif") for word in ("--also", name)]
    given = ["-r", str(folder / "porto.gpkg"), "--dem", str(folder / "dem.tif"), "--effort", "quick", "-q"]
    assert main(["locate", *masks, "-o", str(folder), *given, *also]) == 0
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


def test_orthority_and_the_homography_see_the_same(folder: Path) -> None:
    found, camera = location(folder), location(folder)["camera"]
    written = json.loads((folder / "drone_ext_param.geojson").read_text())
    assert written["world_crs"] == found["crs"]
    properties = written["features"][0]["properties"]
    assert properties["filename"] == "drone.png"
    rotation = Rotation.from_euler("XYZ", properties["opk"]).as_matrix()
    position = np.array(properties["xyz"]) - (0, 0, 90.0)
    for pixel in ([0.0, 0.0], [1280.0, 0.0], [300.0, 900.0]):
        ground = Homography(np.array(found["homography"]))(np.array(pixel))
        assert seen(camera, rotation, position, ground) == pytest.approx(pixel, abs=1.5)
    assert properties["focal_len"] == pytest.approx(camera["focal_px"] / 1280)


@pytest.mark.parametrize("orientation", [3, 6, 8])
def test_orthority_takes_a_picture_as_it_is_stored(folder: Path, tmp_path: Path, orientation: int) -> None:
    photo = save_turned(tmp_path / "photo.jpg", np.zeros((960, 1280, 3), np.uint8), orientation)
    apply_location(read_location(folder / "drone_location.json"), [str(photo)], tmp_path, products=("orthority",))
    properties = json.loads((tmp_path / "photo_ext_param.geojson").read_text())["features"][0]["properties"]
    size = (1280, 960) if orientation == 3 else (960, 1280)
    assert tuple(properties["im_size"]) == size
    rotation = Rotation.from_euler("XYZ", properties["opk"]).as_matrix()
    found, camera = location(folder), location(folder)["camera"]
    for column, row in ([0.0, 0.0], [1280.0, 0.0], [300.0, 900.0]):
        xy = Homography(np.array(found["homography"]))(np.array([column, row]))
        stored = {3: (1280 - column, 960 - row), 6: (row, 1280 - column), 8: (960 - row, column)}[orientation]
        position = np.array(properties["xyz"]) - (0, 0, camera["altitude_m"] - camera["height_m"])
        pixel = seen(camera, rotation, position, xy) - (640.0, 480.0) + np.array(size) / 2
        assert pixel == pytest.approx(stored, abs=1.5)


def test_no_camera_takes_a_mirrored_picture(folder: Path, tmp_path: Path) -> None:
    photo = save_turned(tmp_path / "photo.jpg", np.zeros((960, 1280, 3), np.uint8), 2)
    with pytest.raises(OutputError, match="stored mirrored"):
        apply_location(read_location(folder / "drone_location.json"), [str(photo)], tmp_path, products=("orthority",))
    assert [path.name for path in tmp_path.iterdir()] == ["photo.jpg"]


def test_the_geopose_is_about_true_north(folder: Path) -> None:
    found, camera = location(folder), location(folder)["camera"]
    pose = json.loads((folder / "drone_geopose.json").read_text())
    assert (pose["position"]["lat"], pose["position"]["h"]) == (camera["lat"], camera["altitude_m"])
    rotation = Rotation.from_quat([pose["quaternion"][axis] for axis in "xyzw"]).as_matrix()
    plane = LocalPlane(found["crs"], (camera["x"], camera["y"]))
    middle = found["center"]
    axis = rotation @ (0.0, 0.0, -1.0)
    there = from_lonlat(plane, np.array([[middle["lon"], middle["lat"]]]))[0]
    from roadgeo.geometry.projection import grid_north

    grid = np.degrees(np.arctan2(*there)) + grid_north(plane, np.array([camera["x"], camera["y"]]))
    assert np.degrees(np.arctan2(axis[0], axis[1])) == pytest.approx(grid, abs=0.2)


def test_opendronemap_gets_one_line_for_each_picture_and_one_file_for_all(folder: Path) -> None:
    lines = (folder / "geo.txt").read_text().splitlines()
    assert lines[0] == "EPSG:4326"
    assert [line.split()[0] for line in lines[1:]] == ["drone.png", "map_sheet.png"]
    assert (folder / "drone_geo.txt").read_text().splitlines() == lines[:2]
    _, lon, lat, height, *rest = lines[1].split()
    camera = location(folder)["camera"]
    assert (float(lon), float(lat)) == pytest.approx((camera["lon"], camera["lat"]), abs=1e-8)
    assert float(height) == pytest.approx(camera["altitude_m"], abs=1e-3)
    assert rest[:3] == ["0", "0", "0"]
    assert len(rest) == 5


def test_the_annotation_puts_pixels_where_the_homography_does(folder: Path) -> None:
    found = location(folder)
    annotation = json.loads((folder / "drone_iiif.json").read_text())
    assert annotation["motivation"] == "georeferencing"
    assert (annotation["target"]["source"]["width"], annotation["target"]["source"]["height"]) == (1280, 960)
    features = annotation["body"]["features"]
    assert len(features) == 25
    plane = LocalPlane(found["crs"], (0.0, 0.0))
    for feature in features[::6]:
        xy = Homography(np.array(found["homography"]))(np.array(feature["properties"]["resourceCoords"]))
        lonlat = np.array([feature["geometry"]["coordinates"]])
        assert from_lonlat(plane, lonlat)[0] == pytest.approx(xy, abs=1e-3)


def test_a_terrain_model_without_a_place_is_refused(folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    given = ["-r", str(folder / "porto.gpkg"), "--dem", str(DRONE.path), "-o", str(folder / "out"), "-q"]
    assert main(["locate", str(DRONE.path), *given]) == 1
    assert "expected a terrain model" in capfd.readouterr().err
