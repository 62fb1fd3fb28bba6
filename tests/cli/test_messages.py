"""What new users meet first: files that are almost right, and what they are told."""

import json
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from worlds.demo import DRONE
from worlds.fenway import write_streets
from worlds.pngs import chunk
from worlds.rasters import write_raster

from roadgeo.cli import main


def locate(mask: str, porto: Path, *more: str) -> int:
    return main(["locate", mask, "-r", str(porto), "--effort", "quick", *more])


def drone() -> np.ndarray:
    return cv2.imread(str(DRONE), cv2.IMREAD_GRAYSCALE)


def test_a_crs_against_the_files_own_is_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_streets(tmp_path / "a.gpkg")
    index = ["index", "--roads", "a.gpkg", "--out", "b.gpkg", "--replace", "--crs"]
    assert main([*index, "EPSG:4258"]) == 0
    assert "a.gpkg: says that its CRS is EPSG:4326; read as EPSG:4258, as --crs asks" in caplog.text
    caplog.clear()
    assert main([*index, "OGC:CRS84"]) == 0  # the same by another name
    assert not caplog.text
    assert main([*index, "EPSG:26986"]) == 1  # degrees cannot be its metres
    assert "says that its CRS is EPSG:4326" in caplog.text
    caplog.clear()
    assert main([*index, "EPSG:4258", "-q"]) == 0
    assert not caplog.text


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_black_roads_on_transparent_ground_are_roads(suffix: str, porto: Path) -> None:
    black = np.dstack([np.zeros((*drone().shape, 3), np.uint8), drone()])
    if suffix == "png":
        cv2.imwrite("black.png", black)
    else:
        of_alpha = {"photometric": "RGB", "alpha": "YES", "transform": rasterio.Affine.scale(2)}
        write_raster("black.tif", black.transpose(2, 0, 1), **of_alpha)
    assert locate(f"black.{suffix}", porto) == 0


def test_what_libraries_print_is_swallowed(porto: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """libpng and libjpeg print their warnings themselves; of libtiff's errors the reason is told."""
    rows = drone()
    whole, profile = cv2.imencode(".png", rows)[1].tobytes(), b"bad\0\0" + zlib.compress(b"no profile")
    Path("profile.png").write_bytes(whole[:33] + chunk(b"iCCP", profile) + whole[33:])
    assert locate("profile.png", porto, "-q") == 0
    cv2.imwrite("whole.jpg", rows)
    damaged = bytearray(Path("whole.jpg").read_bytes())
    damaged[5000:5050] = bytes(50)
    Path("damaged.jpg").write_bytes(damaged)
    locate("damaged.jpg", porto, "-q")
    assert capfd.readouterr().err == ""
    cv2.imwrite("whole.tif", rows)
    Path("cut.tif").write_bytes(Path("whole.tif").read_bytes()[:-4000])
    assert locate("cut.tif", porto, "-q") == 1
    said = capfd.readouterr().err
    assert said.startswith("Error: cut.tif: ")
    assert said.count("\n") == 1
    assert "previous exception" not in said


@pytest.mark.parametrize("most", [40, 0.2])
def test_maps_of_low_probabilities_are_located(most: float, porto: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """A network that is never sure: its largest value is 40 of 255, or 0.2."""
    soft = cv2.GaussianBlur(drone(), (0, 0), 2).astype(np.float32) * (most / 255)
    if most > 1:
        cv2.imwrite("soft.png", soft.astype(np.uint8))
    else:
        cv2.imwrite("soft.tif", soft)
    assert locate("soft.png" if most > 1 else "soft.tif", porto) == 0
    assert "located at 41.15" in capfd.readouterr().out


def test_several_thresholds_are_tried_before_a_refusal(porto: Path, capfd: pytest.CaptureFixture[str]) -> None:
    soft = np.zeros((400, 400), np.uint8)
    cv2.line(soft, (100, 0), (140, 400), 255, 9)
    cv2.line(soft, (0, 200), (400, 200), 255, 9)
    cv2.imwrite("soft.png", cv2.GaussianBlur(soft, (0, 0), 6))
    assert locate("soft.png", porto) == 3
    assert "; its roads were traced in " in capfd.readouterr().out


def test_a_mirrored_mask_is_located_by_hand(porto: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """What is drawn of it is what is drawn of the mask the right way round."""
    cv2.imwrite("mirrored.png", drone()[:, ::-1])
    more = ["--plot", "--report", "--also", "gcps"]
    assert locate("mirrored.png", porto, "--json", "-q") == 3
    assert "mirror" not in json.loads(capfd.readouterr().out)["reason"]
    assert locate("mirrored.png", porto, "--mirror", "--json", "-q", *more) == 0
    found = json.loads(capfd.readouterr().out)
    assert locate(str(DRONE), porto, "--json", "-q") == 0
    straight = json.loads(capfd.readouterr().out)
    assert (found["mirrored"], straight["mirrored"]) == (True, False)
    assert "mirror" not in found["reason"]
    assert found["camera"] is None
    assert np.linalg.det(found["homography"]) * np.linalg.det(straight["homography"]) < 0
    corners, others = np.array(found["footprint"]), np.array(straight["footprint"])[[1, 0, 3, 2]]
    assert corners == pytest.approx(others, abs=0.5)
    assert found["rmse_m"] == pytest.approx(straight["rmse_m"], abs=0.2)
    with rasterio.open("mirrored_footprint.tif") as ours, rasterio.open("drone_footprint.tif") as his:
        assert np.allclose(ours.bounds, his.bounds, atol=2)
        same = ours.read(1)[5:-5, 5:-5] == his.read(1)[5 : ours.height - 5, 5 : ours.width - 5]
        assert same.mean() > 0.98


@pytest.mark.parametrize(("wide", "high"), [(1.0, 1.0), (1.0, -1.6)])
def test_the_shape_of_pixels_is_as_the_file_states_it(
    porto: Path, capfd: pytest.CaptureFixture[str], wide: float, high: float
) -> None:
    """A mask whose rows run northwards, and one that is stretched, both at another place than they state."""
    mask = drone()[::-1] if high > 0 else drone()
    mask = cv2.resize(mask, (mask.shape[1], round(mask.shape[0] / abs(high))), interpolation=cv2.INTER_AREA)
    place = {"crs": "EPSG:32629", "transform": rasterio.Affine(wide, 0, 5e5, 0, high, 4.5e6)}
    profile = {"driver": "GTiff", "width": mask.shape[1], "height": mask.shape[0], "count": 1, "dtype": "uint8"}
    with rasterio.open("stated.tif", "w", **profile, **place) as dataset:
        dataset.write(mask, 1)
    assert locate("stated.tif", porto, "--json", "-q") == 0
    found = json.loads(capfd.readouterr().out)
    assert found["mirrored"] is (high > 0)
    assert ("the file mirrors it" in found["reason"]) is (high > 0)
    assert ("times as wide as high" in found["reason"]) is (high < 0)
    assert (found["center"]["lon"], found["center"]["lat"]) == pytest.approx((-8.61, 41.15), abs=0.05)
    assert locate("stated.tif", porto, "--no-mirror", "-q") == (3 if high > 0 else 0)


def test_the_place_that_a_mask_states_is_compared(porto: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """A mask that has a georeference, which is 120 m off in the east."""
    assert locate(str(DRONE), porto, "--json", "-q") == 0
    found = json.loads(capfd.readouterr().out)
    assert found["stated_offset_m"] is None
    height, width = drone().shape
    x, y = found["center"]["x"] + 120.0, found["center"]["y"]
    place = rasterio.Affine(1, 0, x - width / 2, 0, -1, y + height / 2)
    write_raster("stated.tif", drone(), crs=found["crs"], transform=place)
    assert locate("stated.tif", porto) == 0
    assert "puts the middle 120." in capfd.readouterr().out
