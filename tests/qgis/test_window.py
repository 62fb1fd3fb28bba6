"""The plugin in QGIS's own window, on a virtual screen: a newcomer's tour, with pictures of every dialog."""

import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from support.real_qgis import Qgis
from worlds.demo import DRONE, MASKS

from roadgeo.evaluation.demo import ROADS
from roadgeo.qgis.plugin.refit import TiePoint, fit, read_points

FOOTPRINT, ROAD = "#1f6fb4", "#e4572e"


def count_color(picture: np.ndarray, color: str) -> int:
    """Number of pixels of a colour, as they are at the middle of a line."""
    blue, green, red = (int(color[i : i + 2], 16) for i in (5, 3, 1))
    return int((np.abs(picture.astype(int) - (blue, green, red)).max(axis=2) < 12).sum())


@pytest.fixture(scope="module")
def folder(qgis: Qgis) -> Path:
    """Where the pictures go; ROADGEO_SCREENS names another folder, to look at them and for the documentation."""
    folder = Path(os.environ.get("ROADGEO_SCREENS", qgis.folder / "pictures"))
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture(scope="module")
def seen(qgis: Qgis, folder: Path) -> dict:
    if not (shutil.which("xvfb-run") and shutil.which("qgis")):
        if os.environ.get("ROADGEO_REQUIRE_QGIS"):
            pytest.fail("ROADGEO_REQUIRE_QGIS is set, and xvfb-run or qgis is not installed")
        pytest.skip("QGIS's window needs qgis and xvfb-run (Debian: qgis xvfb xauth)")
    masks = {"picture": str(DRONE), "refused": str(MASKS["elsewhere"].path)}
    answer = qgis.tour(roads=str(ROADS), pictures=str(folder), mended=str(qgis.folder / "mended"), **masks)
    assert "error" not in answer, answer["error"]
    for path in (qgis.folder / "library").glob("porto-streets*"):  # other tests search all maps of the library
        path.unlink()
    return {**answer, "mended": str(qgis.folder / "mended")}


def test_menu_and_button_offer_everything(seen: dict) -> None:
    assert {"roadgeo_qgis", "processing"} <= set(seen["plugins"])
    assert seen["in_menu"]
    assert seen["on_toolbar"]
    assert [text.split()[0] for text in seen["menu"]] == ["Build", "Locate", "Locate", "Locate", "Mend", "Set", "Help"]


def test_what_is_switched_off_is_gone(seen: dict) -> None:
    assert seen["left"] == [False, False]


def test_a_newcomer_without_the_program_is_led_to_its_set_up(seen: dict) -> None:
    assert seen["first"].startswith("roadgeo: The program")
    assert seen["first_buttons"] == ["Set up roadgeo..."]


def test_setting_up_finds_the_program_and_calls_it(seen: dict) -> None:
    assert seen["setup"]["successful"]
    assert Path(seen["setup"]["results"]["FOUND"]).stem == "roadgeo"
    version = seen["setup"]["results"]["VERSION"]
    assert version[0].isdigit()
    # What asked for it is gone; what comes next is offered.
    assert seen["ready"] == f"roadgeo: Version {version} is set up."
    assert seen["ready_buttons"] == ["Build road reference..."]
    assert not [text for text in seen["messages"] if "not on this computer" in text]


def test_what_was_built_is_in_the_library_and_in_the_list_of_the_next_dialog(seen: dict) -> None:
    assert seen["build"]["title"] == "Build road reference"
    assert Path(seen["build"]["results"]["OUTPUT"]).name == "porto-streets.gpkg"
    assert seen["references"][0] == "All that there are"
    assert "porto-streets" in seen["references"]


def test_the_current_layer_is_located_near_what_the_map_shows(seen: dict) -> None:
    assert seen["asked"]["MASK"]
    west, east, south, north = (float(text) for text in seen["asked"]["AREA"].split(" ")[0].split(","))
    assert west < -8.608 < east
    assert south < 41.1525 < north
    results = seen["locate"]["results"]
    assert results["STATUS"] == "located"
    assert abs(float(results["LATITUDE"]) - 41.1525) < 1e-3
    assert seen["pages"] == [results["REPORT_PAGE"]]


def test_the_message_tells_it_and_zooms_there(seen: dict) -> None:
    assert seen["message"].startswith("drone: located")
    assert seen["buttons"] == ["Zoom to it", "Mend by hand", "Report"]
    width, lon, lat = seen["shown"]
    assert width < 0.1
    assert abs(lon + 8.608) < 0.01
    assert abs(lat - 41.1525) < 0.01


def test_the_results_lie_in_a_group_over_the_roads_of_the_reference(seen: dict) -> None:
    names = ["drone residuals × 20", "drone roads", "drone matches", "drone footprint", "drone"]
    assert list(seen["layers"]["drone"]) == names
    assert "porto-streets roads" in seen["layers"]


def test_the_window_shows_footprint_and_roads(seen: dict, folder: Path) -> None:
    window = cv2.imread(str(folder / "window.png"))
    assert count_color(window, FOOTPRINT) > 500
    assert count_color(window, ROAD) > 1000
    for name in ("setup", "build", "locate", "locate_log", "places", "place", "menu", "taken"):
        assert cv2.imread(str(folder / f"{name}.png")).std() > 15  # not an empty box


def test_of_places_that_fit_alike_any_is_looked_at_and_chosen(seen: dict) -> None:
    assert seen["ambiguous"].startswith("drone: two places fit almost equally")
    assert seen["ambiguous_buttons"] == ["Choose the place...", "Mend by hand"]
    assert seen["button_within"]
    assert seen["places"] == [["0.8", "porto-streets", "0.0 km"], ["-0.8", "porto-streets", "1.4 km"]]
    assert seen["looked_at"] == pytest.approx(-8.618, abs=5e-3)
    lon, lat = (float(text) for text in seen["chosen"]["NEAR"].split(" ")[0].split(","))
    assert (lon, lat) == (pytest.approx(-8.618, abs=1e-3), pytest.approx(41.1625, abs=1e-3))
    assert float(seen["chosen"]["NEAR_RADIUS"]) < 500


def test_what_is_not_sure_at_the_chosen_place_either_is_mended_from_there(seen: dict) -> None:
    assert seen["again"].startswith("drone: not sure near the chosen place either: two places")
    residuals, footprint, expected = seen["corners"]
    assert residuals == pytest.approx([0.0] * 4, abs=0.01)
    assert np.allclose(footprint, expected, atol=0.01)
    assert seen["refused"] == "drone: no"
    assert seen["refused_buttons"] == []


def test_a_place_of_a_refused_picture_is_taken_and_the_result_says_so(seen: dict) -> None:
    taken = seen["taken"]
    assert taken["STATUS"] == "chosen"
    assert taken["REASON"].startswith(f"chosen by you: place 2 of {taken['listed']}; ")
    assert [float(taken["LONGITUDE"]), float(taken["LATITUDE"])] == pytest.approx(taken["place"], abs=1e-4)
    assert Path(taken["FOOTPRINT"]).exists()
    assert taken["message"].startswith("elsewhere: chosen by you: place 2 of ")
    assert taken["alone"] == 1  # that of the refusal is gone
    assert taken["shown"] == pytest.approx(taken["place"], abs=0.005)  # and the dialogs are closed
    assert len(taken["open"]) == 1


def test_the_panel_opens_with_the_points_of_what_was_located(seen: dict) -> None:
    dock = seen["dock"]
    assert dock["shown"]
    assert seen["opened"] == [dock["picture"], dock["matches"]]  # from the menu as well
    assert dock["head"] == "Residual (m)"
    given = [TiePoint(*point) for point in dock["points"]]
    assert dock["said"].startswith(f"{len(given)} of {len(given)} points")
    assert dock["said"].endswith(" m root mean square")
    assert np.allclose(dock["before"], fit(given).residuals, rtol=2e-3, atol=0.006)  # on the ellipsoid, not the plane


def test_a_point_that_is_switched_off_counts_no_more(seen: dict) -> None:
    before, off = np.array(seen["dock"]["before"]), np.array(seen["dock"]["off"])
    assert off[0] > before[0]
    assert off[1:].mean() <= before[1:].mean() + 0.02
    assert seen["dock"]["said_off"].startswith(f"{len(before) - 1} of {len(before)} points")


def test_points_are_moved_on_both_sides_deleted_and_added(seen: dict) -> None:
    dock = seen["dock"]
    assert dock["moved_m"] == pytest.approx(30 * dock["pixel_m"], rel=0.05)
    assert dock["dragged"][1] > dock["before"][1] + 5.0
    assert dock["moved_px"] > 5.0
    assert dock["deleted"] == dock["matches"] - 2
    assert dock["added"] == [dock["matches"] - 1, pytest.approx(0.0, abs=0.01)]


def test_the_list_is_sorted_and_a_change_is_taken_back(seen: dict) -> None:
    numbers, residuals = seen["dock"]["sorted"]
    assert residuals == sorted(residuals, reverse=True)
    assert numbers[0] == 2  # which was dragged
    assert residuals == [seen["dock"]["dragged"][number - 1] for number in numbers]
    assert seen["dock"]["undone"] == [True, seen["dock"]["before"]]


def test_what_is_written_is_the_mended_fit(seen: dict) -> None:
    crs, matches = read_points(f"{seen['mended']}.points")
    assert "UTM" in crs
    assert len(matches) == seen["dock"]["matches"] - 1
    with rasterio.open(f"{seen['mended']}.tif") as picture:
        points, _ = picture.gcps
    assert len(points) == len(matches)


def test_the_picture_is_drawn_where_the_fit_has_it(seen: dict) -> None:
    assert seen["dock"]["layer"]
    with rasterio.open(seen["dock"]["drawn"]["FOOTPRINT"]) as drawn:
        shown, transform = drawn.read(1), drawn.transform
    mask = cv2.imread(seen["dock"]["picture"], cv2.IMREAD_GRAYSCALE)
    half = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])  # centres of pixels, in OpenCV's frame
    to_map = np.array([[*transform[:3]], [*transform[3:6]], [0.0, 0.0, 1.0]])
    exact = np.linalg.inv(half) @ np.linalg.inv(to_map) @ np.array(seen["dock"]["matrix"]) @ half
    expected = cv2.warpPerspective(mask, exact, shown.shape[::-1], flags=cv2.INTER_CUBIC)
    assert np.mean((shown > 127) != (expected > 127)) < 0.002


def test_a_picture_without_points_is_placed_by_four_that_are_clicked(seen: dict) -> None:
    dock = seen["dock"]
    assert not dock["refused"]
    assert "no file of control points" in dock["refused_said"] or "cannot be read" in dock["refused_said"]
    assert dock["empty"].startswith("0 of 0 points")
    assert dock["then"] == "Now click the same spot on the map."
    assert dock["own"] == pytest.approx([0.0] * 4, abs=0.01)


def test_picture_and_map_stand_side_by_side(seen: dict, folder: Path) -> None:
    dock = cv2.imread(str(folder / "mend.png"))
    height, width = dock.shape[:2]
    assert width > 900
    assert height > 350
    blue = np.abs(dock.astype(int) - (0xB4, 0x6F, 0x1F)).max(axis=2) < 12
    assert blue[:, : width // 3].sum() > 100  # dots on the picture
    assert blue[:, width // 3 : 3 * width // 4].sum() > 100  # markers on the map
