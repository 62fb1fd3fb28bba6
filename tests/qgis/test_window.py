"""The plugin in QGIS's own window, on a virtual screen: what a person sees who opens a dialog and presses Run."""

import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.real_qgis import Qgis

from roadgeo.evaluation.demo import demo_masks

FOOTPRINT, ROAD = "#1f6fb4", "#e4572e"


def count_color(picture: np.ndarray, color: str) -> int:
    """Number of pixels of a colour, as they are at the middle of a line."""
    blue, green, red = (int(color[i : i + 2], 16) for i in (5, 3, 1))
    return int((np.abs(picture.astype(int) - (blue, green, red)).max(axis=2) < 12).sum())


@pytest.fixture(scope="module")
def seen(qgis: Qgis, porto: Path) -> dict:
    if not (shutil.which("xvfb-run") and shutil.which("qgis")):
        if os.environ.get("ROADGEO_REQUIRE_QGIS"):
            pytest.fail("ROADGEO_REQUIRE_QGIS is set, and xvfb-run or qgis is not installed")
        pytest.skip("QGIS's window needs qgis and xvfb-run (Debian: qgis xvfb xauth)")
    mask = next(mask.path for mask in demo_masks() if mask.path.stem == "drone")
    folder = str(qgis.folder / "window")
    parameters = {"MASK": str(mask), "REFERENCE": str(porto), "OUTPUT_FOLDER": folder, "REPORT": True}
    answer = qgis.press_run("roadgeo:locatemask", parameters)
    assert "error" not in answer, answer["error"]
    return answer


def test_the_plugin_is_there_once_the_window_is_open(seen: dict) -> None:
    assert {"roadgeo_qgis", "processing"} <= set(seen["plugins"])
    assert len(seen["algorithms"]) == 6
    assert seen["title"] == "Locate mask or photograph"


def test_pressing_run_locates_and_opens_the_report(seen: dict) -> None:
    assert seen["successful"]
    assert seen["results"]["STATUS"] == "located"
    assert abs(float(seen["results"]["LATITUDE"]) - 41.1525) < 1e-3
    assert seen["pages"] == [seen["results"]["REPORT_PAGE"]]


def test_the_results_lie_in_a_group_of_the_mask(seen: dict) -> None:
    names = ["drone residuals", "drone roads", "drone matches", "drone footprint", "drone"]
    assert {group: list(layers) for group, layers in seen["layers"].items()} == {"drone": names}


def test_the_window_shows_footprint_and_roads(seen: dict) -> None:
    window, dialog = cv2.imread(seen["window"]), cv2.imread(seen["dialog"])
    assert count_color(window, FOOTPRINT) > 500
    assert count_color(window, ROAD) > 2000
    assert dialog.std() > 20  # not an empty box
    assert cv2.imread(seen["log"]).shape == dialog.shape
