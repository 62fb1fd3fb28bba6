"""The panel of matches in QGIS's own window: opened, a match switched off, two dragged, the fit exported."""

import json
import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.real_qgis import Qgis

from roadgeo.cli import main
from roadgeo.evaluation.demo import demo_masks
from roadgeo.qgis.plugin.refit import fit, read_points


@pytest.fixture(scope="module")
def used(qgis: Qgis, porto: Path) -> dict:
    if not (shutil.which("xvfb-run") and shutil.which("qgis")):
        if os.environ.get("ROADGEO_REQUIRE_QGIS"):
            pytest.fail("ROADGEO_REQUIRE_QGIS is set, and xvfb-run or qgis is not installed")
        pytest.skip("QGIS's window needs qgis and xvfb-run (Debian: qgis xvfb xauth)")
    mask = next(mask.path for mask in demo_masks() if mask.path.stem == "drone")
    folder = qgis.folder / "dock"
    folder.mkdir()
    assert main(["locate", str(mask), "-r", str(porto), "-o", str(folder), "--also", "match-points", "-q"]) == 0
    files = {"exported": str(folder / "mended.points"), "geotiff": str(folder / "mended.tif")}
    points = str(folder / "drone.png_matches.points")
    answer = qgis.use_dock(picture=str(mask), points=points, roads=f"{porto}|layername=roads", **files)
    assert "error" not in answer, answer["error"]
    return {**answer, **files, "points": points, "location": str(folder / "drone_location.json")}


def numbers(texts: list[str]) -> np.ndarray:
    return np.array([float(text) for text in texts])


def test_it_is_shown_when_asked_for_and_tells_what_is_no_file_of_matches(used: dict) -> None:
    assert used["hidden"]
    assert not used["refused"]
    assert used["opened"]
    _, matches = read_points(used["points"])
    assert f"{len(matches)} of {len(matches)} matches" in used["said"]
    assert np.allclose(numbers(used["before"]), fit(matches).residuals, atol=0.006)


def test_a_match_that_is_switched_off_counts_no_more(used: dict) -> None:
    before, off = numbers(used["before"]), numbers(used["off"])
    assert off[0] > before[0]
    assert off[1:].mean() <= before[1:].mean() + 0.02
    assert f"{len(before) - 1} of {len(before)} matches" in used["said_off"]


def test_a_match_is_dragged_on_the_map_and_on_the_picture(used: dict) -> None:
    assert used["moved_m"] == pytest.approx(30 * used["pixel_m"], rel=0.05)
    assert numbers(used["dragged"])[1] > numbers(used["before"])[1] + 5.0
    assert used["moved_px"] > 5.0


def test_what_is_exported_is_the_mended_fit(used: dict) -> None:
    import rasterio

    crs, matches = read_points(used["exported"])
    _, before = read_points(used["points"])
    assert "UTM" in crs
    moved = [k for k, (a, b) in enumerate(zip(matches, before, strict=True)) if a != b]
    assert moved == [1, 2]
    with rasterio.open(used["geotiff"]) as picture:
        points, _ = picture.gcps
    assert len(points) == len(matches)
    location = json.loads(Path(used["location"]).read_text())
    gaps = np.array(used["footprint"]) - np.array(location["footprint"])
    assert np.hypot(*gaps.T).max() < 60.0


def test_picture_and_map_stand_side_by_side(used: dict) -> None:
    dock = cv2.imread(used["dock"])
    height, width = dock.shape[:2]
    assert width > 900
    assert height > 350
    blue = np.abs(dock.astype(int) - (0xB4, 0x6F, 0x1F)).max(axis=2) < 12
    assert blue[:, : width // 3].sum() > 100  # dots on the picture
    assert blue[:, width // 3 : 3 * width // 4].sum() > 100  # markers on the map
