"""Which masks are located, under which names, and what one bad mask costs."""

import json
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path

import cv2
import numpy as np
import pytest
from rasterio._err import CPLE_AppDefinedError
from sources.test_exif import jpeg_with_exif

from roadgeo import plugins
from roadgeo._progress import say_nothing
from roadgeo.geometry.mask import RoadMask
from roadgeo.outputs.registry import REGISTRY, Output
from roadgeo.plugins import OUTPUTS
from roadgeo.running.locating import Locating, Outcome, Question
from roadgeo.running.options import BatchOptions
from roadgeo.running.tasks import SUFFIXES, VIDEOS, Task, find_masks, name_tasks


def test_folders_and_patterns_are_expanded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "masks"
    folder.mkdir()
    for name in ("b.png", "a.tif", "a_footprint.tif", "b_overlay.png", ".c.png", "notes.txt", "odd[1].png"):
        (folder / name).touch()
    assert find_masks(["masks"]) == [str(Path("masks", name)) for name in ("a.tif", "b.png", "odd[1].png")]
    assert find_masks([str(Path("masks", "?.png")), "missing.png"]) == [str(Path("masks", "b.png")), "missing.png"]
    assert find_masks([str(Path("masks", "odd[1].png"))]) == [str(Path("masks", "odd[1].png"))]
    assert find_masks(["none*.png"]) == ["none*.png"]


def test_folders_within_folders_are_taken_where_asked_for_and_told_of_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("DCIM/100/b.jpg", "DCIM/101/a.png", "DCIM/.trash/c.jpg", "DCIM/101/notes.txt", "flat/d.png"):
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).touch()
    assert find_masks(["flat"]) == [str(Path("flat", "d.png"))]
    assert not caplog.records
    assert find_masks(["DCIM"]) == []
    reported = "DCIM: images in folders within it, such as {}, are passed over; --recursive takes them too"
    assert [record.getMessage() for record in caplog.records] == [reported.format(Path("100", "b.jpg"))]
    assert find_masks(["DCIM"], recursive=True) == [
        str(Path("DCIM", *item)) for item in (("100", "b.jpg"), ("101", "a.png"))
    ]


def test_numbers_in_names_count_as_numbers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names = [
        *("flight2/frame_2.png", "flight2/frame_10.png", "flight10/frame_1.png"),
        *("seen (2).jpg", "seen (10).jpg", "seen_9999.jpg", "seen_10000.jpg"),
    ]
    for name in reversed(names):
        Path("all", name).parent.mkdir(parents=True, exist_ok=True)
        Path("all", name).touch()
    assert find_masks(["all"], recursive=True) == [str(Path("all", name)) for name in names]
    assert find_masks(["all/seen_*"]) == [str(Path("all", name)) for name in names[-2:]]


def test_formats_that_are_read_by_name_are_taken_from_folders_and_others_are_mentioned(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for name in ("a.gif", "b.ppm", "c.JFIF", "d.heic", "e.HEIC", "f.dng", "g.txt", ".h.avif", "in/i.jxl"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    assert find_masks([str(tmp_path)]) == [str(tmp_path / name) for name in ("a.gif", "b.ppm", "c.JFIF")]
    passed = "passed over: 1 .dng, 2 .heic: formats that are not read from a folder; convert them, or give them by name"
    assert [record.getMessage() for record in caplog.records] == [f"{tmp_path}: {passed}"]


@pytest.mark.parametrize("suffix", [".MTS", ".m2ts", ".3gp", ".flv", ".h264", ".LRV", ".mp4", ".265", ".insv", ".vob"])
def test_videos_are_taken_where_they_are_wanted_and_mentioned_elsewhere(
    suffix: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for name in (f"a{suffix}", "a.SRT", "b.zip", "c", "d.png", "d.pgw", "d_location.gpkg"):
        (tmp_path / name).touch()
    assert find_masks([str(tmp_path)], suffixes=SUFFIXES + VIDEOS) == [
        str(tmp_path / f"a{suffix}"),
        str(tmp_path / "d.png"),
    ]
    assert caplog.records[0].getMessage().startswith(f"{tmp_path}: passed over: 1 .zip, 1 without a suffix: formats")
    assert find_masks([str(tmp_path)]) == [str(tmp_path / "d.png")]
    assert f"1 {suffix.lower()}, 1 .zip" in caplog.text or f"1 .zip, 1 {suffix.lower()}" in caplog.text
    assert "roadgeo track" in caplog.text


@pytest.mark.parametrize(
    ("names", "is_doubtful"),
    [
        (["1403636570.0", "1403636570.25", "1403636570.5", "1403636570.75", "1403636571.0"], True),
        (["at_9.25m", "at_9.5m", "at_10.0m", "at_10.125m"], True),
        (["1403636570.000", "1403636570.250", "1403636571.000"], False),
        (["v1.2.9", "v1.2.10"], False),
        (["2024.5.1", "2024.5.12", "2024.10.1"], False),
        (["f.9", "f.10"], False),
    ],
)
def test_decimals_in_names_count_as_decimals(
    names: list[str], is_doubtful: bool, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for name in names:
        (tmp_path / f"{name}.png").touch()
    right = [str(tmp_path / f"{name}.png") for name in names]
    assert find_masks([str(tmp_path)]) == find_masks([str(tmp_path / "*.png")]) == right
    assert ("are read as decimals" in caplog.text) == is_doubtful


def test_results_never_share_a_name() -> None:
    tasks = name_tasks(["x/q.png", "y/q.png", "y/q.tif", "y/r.png"])
    assert [task.stem for task in tasks] == ["x_q", "y_q_png", "y_q_tif", "r"]


@pytest.mark.parametrize(
    "masks",
    [
        ["p/x.png", "p/x.tif", "q/p_x_2.png"],
        ["p/x.png", "p/x.tif", "q/p_x_tif.png"],
        ["a/q.png", "a/Q.png", "b/Q.PNG"],
        ["q.png", "q.png", "./q.png", "a/../q.png"],
        ["1/a/x.png", "2/a/x.png"],
    ],
)
def test_no_two_results_have_one_name(masks: list[str]) -> None:
    for order in (masks, masks[::-1]):
        stems = [task.stem.casefold() for task in name_tasks(order)]
        assert len(set(stems)) == len(masks)


def test_results_of_another_picture_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "x_location.json").write_text(json.dumps({"query": "a/x.png"}))

    def stem(mask: str) -> str:
        return name_tasks([mask], tmp_path)[0].stem

    assert [stem(mask) for mask in ("a/x.png", "/data/a/x.png", "../a/x.png", "x.png", "b/y.png")] == [*"xxxxy"]
    assert [stem(mask) for mask in ("b/x.png", "/data/b/x.png", "a/x.tif")] == ["b_x", "b_x", "a_x"]
    (tmp_path / "b_x_location.json").write_text(json.dumps({"query": "b/x.png"}))
    assert stem("b/x.png") == "b_x"
    (tmp_path / "x_location.json").write_text("nonsense")
    assert stem("b/x.png") == "x"


def test_pages_have_results_of_their_own() -> None:
    assert [task.stem for task in name_tasks(["a.tif", "GTIFF_DIR:2:/x/a.tif"])] == ["a", "a_page2"]


def test_a_name_does_not_depend_on_the_order() -> None:
    masks = ["p/x.png", "p/x.tif", "q/x.png", "r/x.png"]
    names = {task.mask: task.stem for task in name_tasks(masks)}
    assert {task.mask: task.stem for task in name_tasks(masks[::-1])} == names


def test_results_of_an_earlier_run_are_no_masks(tmp_path: Path) -> None:
    """Whatever outputs there are, also those of plugins, of `vectorize` and of `evaluate --map`."""
    names = [output.path(tmp_path, "a", "photo.tif").name for output in REGISTRY.values()]
    names += ["a_vectorized.png", "porto_localizability.tif", "porto_localizability.png", "a_seen.tif"]
    for name in ("a.png", *names):
        (tmp_path / name).touch()
    with pytest.MonkeyPatch.context() as patch:
        points = [EntryPoint("seen", f"{__name__}:SEEN", OUTPUTS), EntryPoint("broken", "no_such_module:x", OUTPUTS)]
        patch.setattr(plugins, "entry_points", lambda group: points)
        assert find_masks([str(tmp_path)]) == [str(tmp_path / "a.png")]


SEEN = Output("seen", "_seen.tif", lambda path, subject: None, "what was seen")


class Hazard:
    """Raises what libraries raise, by the name of the mask."""

    ERRORS = {  # noqa: RUF012
        "cv2": (cv2.error("too large"), "fault", "please report it"),
        "gdal": (CPLE_AppDefinedError(3, 1, "odd"), "fault", "please report it"),
        "deep": (RecursionError(), "fault", "please report it"),
        "large": (MemoryError(), "memory", "reduce it or cut it up"),
        "name": (UnicodeEncodeError("utf-8", "\udce9", 0, 1, "surrogate"), "invalid", "rename it"),
    }

    def __call__(self, path: str, **_: object) -> RoadMask:
        raise self.ERRORS[Path(path).stem][0]


def hazardous(kind: str, folder: Path, patch: pytest.MonkeyPatch) -> Outcome:
    patch.setattr("roadgeo.running.queries.open_mask", Hazard())
    work = Locating((), str(folder), BatchOptions(), say_nothing)
    return work.do(Task(f"{kind}.png", kind), Question([], 0.0, {}))


@pytest.mark.parametrize("kind", Hazard.ERRORS)
def test_whatever_one_mask_raises_the_others_go_on(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _, code, remedy = Hazard.ERRORS[kind]
    outcome = hazardous(kind, tmp_path, monkeypatch)
    assert outcome.status == "error"
    assert outcome.document["query"] == f"{kind}.png"
    assert outcome.document["reason_code"] == code
    assert remedy in outcome.document["reason"]


def test_who_looks_for_a_fault_is_shown_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROADGEO_TRACEBACK", "1")
    with pytest.raises(RecursionError):
        hazardous("deep", tmp_path, monkeypatch)


def test_the_focal_length_of_exif_is_in_pixels_of_the_mask(tmp_path: Path) -> None:
    """24 mm on film 36 mm wide; the photograph, which says so, is smaller than the mask."""
    photo, mask = jpeg_with_exif(tmp_path / "photo.jpg", 24), tmp_path / "mask.png"
    cv2.imwrite(str(mask), np.zeros((400, 600), np.uint8))
    task = Task(str(mask), "mask")
    options = BatchOptions(images={str(mask): str(photo)}, exif=("focal_px",))
    work = Locating((), str(tmp_path), options, say_nothing)
    assert work.search_options(task).match.camera.focal_px == pytest.approx(400.0)
    plain = replace(work, options=replace(options, exif=()))
    assert plain.search_options(task).match.camera.focal_px is None
