"""The command line on real roads: the demonstration's map and masks."""

import importlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import click
import cv2
import numpy as np
import pyproj
import pytest
import rasterio
from support.groups import is_gone
from worlds.demo import MASKS
from worlds.fenway import write_streets

from roadgeo import __version__
from roadgeo.cli import main
from roadgeo.cli.locate import pair_images
from roadgeo.evaluation.demo import ATTRIBUTION, ROADS, DemoMask
from roadgeo.geometry.homography import Homography
from roadgeo.reference.files import reference_digest


def center_error(found: dict, mask: DemoMask) -> float:
    middle = np.array(found["size"]) / 2
    x, y = pyproj.Transformer.from_crs(mask.crs, found["crs"], always_xy=True).transform(
        *Homography(mask.homography)(middle)
    )
    return float(np.hypot(found["center"]["x"] - x, found["center"]["y"] - y))


def test_a_mask_is_located_and_everything_is_written(
    porto: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert main(["locate", str(MASKS["drone"].path), "-r", str(porto), "--plot"]) == 0
    out, err = capfd.readouterr()
    assert "drone.png: located at 41.1525" in out
    assert err == ""
    written = {path.name for path in tmp_path.iterdir()}
    assert written == {
        "drone_footprint.tif",
        "drone_footprint.qml",
        "drone_location.gpkg",
        "drone_location.json",
        "drone_overlay.png",
    }
    assert center_error(json.loads((tmp_path / "drone_location.json").read_text()), MASKS["drone"]) < 2


def test_json_lines_stand_in_input_order_and_alone_on_standard_output(
    porto: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    shutil.copy(MASKS["elsewhere"].path, "a.png")
    Path("b.png").write_text("no picture")
    shutil.copy(MASKS["map_sheet"].path, "c.png")
    status = main(["locate", "a.png", "missing.png", "b.png", "c.png", "-r", str(porto), "--json", "-o", "out"])
    out, err = capfd.readouterr()
    found = [json.loads(line) for line in out.splitlines()]
    assert [result["query"] for result in found] == ["a.png", "missing.png", "b.png", "c.png"]
    assert [result["status"] for result in found] == ["not_located", "error", "error", "located"]
    assert all(result["schema"] == "roadgeo.location/1" and result["reason"] for result in found)
    assert [result["attribution"] for result in found] == [ATTRIBUTION, "", "", ATTRIBUTION]
    assert status == 1
    assert err.count("Error: ") == 2
    assert "1 located, 1 not located, 2 failed" in err
    assert not (tmp_path / "out" / "a_footprint.tif").exists()


def test_what_was_cut_short_goes_on_where_it_was(
    porto: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    for name in ("drone", "elsewhere", "map_sheet"):
        shutil.copy(MASKS[name].path, f"{name}.png")
    locate = ["locate", "drone.png", "elsewhere.png", "map_sheet.png", "-r", str(porto), "-o", "out", "--json", "-q"]
    assert main([*locate[:3], *locate[4:]]) == 3  # as if it had been interrupted
    first = capfd.readouterr().out.splitlines()
    marked = {**json.loads(first[0]), "reason": "found before"}
    Path("out/drone_location.json").write_text(json.dumps(marked))
    Path("out/elsewhere_location.json").write_text("half a fi")
    assert main([*locate, "--skip-existing"]) == 3
    again = [json.loads(line) for line in capfd.readouterr().out.splitlines()]
    assert [result["status"] for result in again] == ["located", "not_located", "located"]
    assert again[0] == marked
    assert Path("out/roadgeo_summary.csv").read_text().count("\n") == 4
    os.utime("drone.png", (2e9, 2e9))  # the mask was made anew
    assert main([*locate, "--skip-existing"]) == 3
    assert json.loads(capfd.readouterr().out.splitlines()[0])["reason"] != "found before"


def test_a_batch_that_was_killed_goes_on_where_it_was(porto: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """What was written is whole, and what was not is done."""
    names = [f"drone_{n}" for n in range(6)]
    for name in names:
        shutil.copy(MASKS["drone"].path, f"{name}.png")
    given = [*(f"{name}.png" for name in names), "-r", str(porto), "-o", "out", "--json", "-q", "--effort", "quick"]
    batch = subprocess.Popen([sys.executable, "-m", "roadgeo", "locate", *given], stdout=subprocess.DEVNULL)
    while not Path("out/drone_1_location.json").exists():
        assert batch.poll() is None
        time.sleep(0.001)
    batch.kill()
    assert batch.wait() == -signal.SIGKILL
    written = {path: path.stat().st_mtime_ns for path in Path("out").glob("*_location.json")}
    assert 2 <= len(written) < 6
    assert main(["locate", *given, "--skip-existing"]) == 0
    assert len(capfd.readouterr().out.splitlines()) == 6
    found = [json.loads(Path(f"out/{name}_location.json").read_text()) for name in names]
    assert [result["homography"] for result in found] == [found[0]["homography"]] * 6
    assert all(path.stat().st_mtime_ns == at for path, at in written.items() if "drone_0" in path.name)
    assert {path.name for path in Path("out").iterdir() if path.name.startswith((".", "tmp"))} == set()


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
def test_a_batch_that_is_told_to_end_cleans_up(porto: Path) -> None:
    """As at Ctrl-C: a supervisor sends SIGTERM, to the command alone."""
    for n in range(8):
        shutil.copy(MASKS["drone"].path, f"drone_{n}.png")
    given = [*(f"drone_{n}.png" for n in range(8)), "-r", str(porto), "-o", "out", "-q", "-j", "2"]
    pipe = subprocess.PIPE
    with subprocess.Popen(
        [sys.executable, "-m", "roadgeo", "locate", *given], stdout=pipe, stderr=pipe, text=True, start_new_session=True
    ) as batch:
        while not Path("out/drone_1_location.json").exists():
            assert batch.poll() is None
            time.sleep(0.001)
        batch.terminate()
        _, said = batch.communicate(timeout=60)
        assert (batch.returncode, said.strip()) == (128 + signal.SIGTERM, "Interrupted.")
        assert is_gone(batch.pid)
    assert {path.name for path in Path("out").iterdir() if path.name.startswith((".", "tmp"))} == set()


def test_the_photograph_is_drawn_in_the_crs_asked_for(
    porto: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    shutil.copy(MASKS["drone"].path, "drone_mask.png")
    Path("photos").mkdir()
    photo = cv2.cvtColor(cv2.resize(cv2.imread("drone_mask.png", 0), None, fx=2, fy=2), cv2.COLOR_GRAY2BGR)
    cv2.imwrite("photos/drone.png", photo)
    arguments = ["--crs", "EPSG:3857", "--resolution", "2", "--also", "gcps", "--also", "geojson", "-r", str(porto)]
    assert main(["locate", "drone_mask.png", "--image", "photos", *arguments]) == 0
    assert f"drew {Path('photos', 'drone.png')}, 2 times the mask's size" in capfd.readouterr().out
    with rasterio.open("drone_mask_footprint.tif") as raster:
        assert (raster.crs.to_epsg(), raster.res, raster.count) == (3857, (2.0, 2.0), 4)
    assert Path("drone_mask_gcps.tif").exists()
    assert Path("drone_mask_footprint.geojson").exists()


@pytest.mark.parametrize(
    ("masks", "images", "paired"),
    [
        (["x/a_mask.png", "x/b_mask.png"], ["."], ["a.jpg", "b_mask.tif"]),
        (["drone.png"], ["."], ["drone.jpg"]),  # beside labels, logs and the mask itself
        (["two_mask.png"], ["."], ["two.tif"]),
        (["a.png", "b.png"], ["1.tif", "2.tif"], ["1.tif", "2.tif"]),
        (["a.png"], [], []),
        (["a.png", "b.png"], ["1.tif"], "Got 2 masks and 1 times --image"),
        (["c.png"], ["."], "No photograph in . has the name of c.png"),
        (["104_mask.png"], ["."], "No photograph in . has the name of 104_mask.png"),
    ],
)
def test_photographs_go_with_their_masks(
    masks: list[str], images: list[str], paired: list[str] | str, caplog: pytest.LogCaptureFixture
) -> None:
    drone = [f"drone{suffix}" for suffix in (".json", ".jpg", ".SRT", ".txt", ".xml", ".png")]
    for name in (*drone, "a.jpg", "b_mask.tif", "104_sat.jpg", "104_mask.png", "two.tif", "two.png"):
        Path(name).touch()
    if isinstance(paired, str):
        with pytest.raises(click.UsageError, match=re.escape(paired)):
            pair_images(masks, images)
    else:
        assert pair_images(masks, images) == dict(zip(masks, paired, strict=False))
    assert ("two.tif is drawn, though" in caplog.text) == (masks == ["two_mask.png"])


def test_options_narrow_the_search(porto: Path, capfd: pytest.CaptureFixture[str]) -> None:
    mask = str(MASKS["map_sheet"].path)
    reference = ["-r", str(porto), "-q"]
    hints = ["--north-up", "--gsd", "0.8:1.2", "--near=-8.629,41.1625,500", "--within", "Portugal"]
    assert main(["locate", mask, *reference, *hints]) == 0
    assert main(["locate", mask, *reference, "--gsd", "2:3"]) == 3
    assert capfd.readouterr().out == ""
    for limits, reported in [
        (["--near=-8.60,41.15,500"], "the roads fit better 2.8 km away, outside the circle given: leave --near out"),
        (["--within", "Italy"], "no map has an intersection in the area given by within; searched within longitudes"),
        (
            ["--near=2.35,48.85,2000", "--gsd", "0.8:1.2"],
            "searched within 2 km of 2.35,48.85, at 0.8 to 1.2 m per pixel",
        ),
    ]:
        assert main(["locate", mask, "-r", str(porto), "--effort", "quick", *limits]) == 3
        assert reported in capfd.readouterr().out


@pytest.mark.parametrize("more", [[], ["--paper", "--pair", "orders=++", "--pair", "one_to_one=yes"]])
def test_the_papers_matcher_says_once_what_it_found(
    more: list[str], porto: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert main(["locate", str(MASKS["drone"].path), "-r", str(porto), "--method", "pair", *more]) == 0
    out = capfd.readouterr().out
    assert re.search(r"located at 41\.152.* on porto: \d+ of \d+ intersections", out)
    assert out.count("located") == 1


def test_the_library_is_searched_by_default(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["index", "--roads", str(ROADS), "--name", "Porto, Portugal", "-q"]) == 0
    assert main(["reference", "list"]) == 0
    assert "porto-portugal" in capfd.readouterr().out
    assert main(["locate", str(MASKS["high_flight"].path)]) == 0
    assert "on porto-portugal" in capfd.readouterr().out
    assert main(["reference", "info", "porto-portugal"]) == 0
    assert "intersections" in capfd.readouterr().out
    assert main(["reference", "check", "porto-portugal"]) == 0
    assert main(["reference", "remove", "porto-portugal", "--yes"]) == 0
    capfd.readouterr()
    assert main(["locate", str(MASKS["high_flight"].path)]) == 1
    assert "is empty and no --reference was given" in capfd.readouterr().err


# --- input that is wrong ----------------------------------------------------------------------------------------------


def bad_mask(name: str) -> Path:
    path = Path(name)
    photo = np.random.default_rng(1).integers(0, 256, (300, 300, 3)).astype(np.uint8)
    content = {"black.png": np.zeros((300, 300), np.uint8), "photo.png": cv2.GaussianBlur(photo, (0, 0), 2)}
    if name in content:
        cv2.imwrite(name, content[name])
    elif name == "empty.png":
        path.touch()
    return path


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("missing.png", "no such file"),
        ("empty.png", "is empty"),
        ("black.png", "shows no road"),
        ("photo.png", "looks like a photograph"),
    ],
)
def test_a_bad_mask_is_one_line_and_status_1(
    name: str, message: str, porto: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert main(["locate", str(bad_mask(name)), "-r", str(porto), "--segment", "never"]) == 1
    out, err = capfd.readouterr()
    assert out == ""
    assert err.startswith(f"Error: {name}")
    assert message in err
    assert err.count("\n") == 1


@pytest.mark.parametrize("known", [["--north-up"], ["--gsd", "0.5:1"], ["--near=-8.6,41.1,500"], ["--max-tilt", "0"]])
def test_the_papers_method_knows_no_hints(known: list[str], porto: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["locate", str(MASKS["drone"].path), "-r", str(porto), "--method", "pair", *known]) == 2
    assert f"--method pair takes no {known[0].partition('=')[0]}" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["--paper"], "--paper and --pair go with --method pair"),
        (["--method", "pair", "--pair", "gamma=1"], "--pair 'gamma=1', expected NAME=VALUE, NAME one of d_max_m, "),
        (["--method", "pair", "--pair", "delta=30"], "--pair 'delta=30', expected 0.015 to 0.985"),
    ],
)
def test_the_papers_thresholds_are_its_own(
    given: list[str], message: str, porto: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert main(["locate", str(MASKS["drone"].path), "-r", str(porto), *given]) == 2
    assert message in " ".join(capfd.readouterr().err.split())


def last_line(capfd: pytest.CaptureFixture[str]) -> str:
    out, err = capfd.readouterr()
    assert out == ""
    assert "Traceback" not in err
    assert err.count("Error: ") == 1
    return err.splitlines()[-1]


@pytest.mark.parametrize("command", ["locate", "index"])
def test_a_folder_that_cannot_be_written_to_is_named(
    command: str, porto: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    Path("file").touch()  # a file where a folder should be stands in the way even of root
    arguments = {
        "locate": [str(MASKS["drone"].path), "-r", str(porto), "-o", "file/out"],
        "index": ["--roads", str(ROADS), "-o", "file/porto.gpkg"],
    }
    assert main([command, *arguments[command]]) == 1
    assert "cannot write file" in last_line(capfd)


@pytest.mark.parametrize(
    "arguments",
    [
        ["locate"],
        ["locate", "a.png", "--gsd", "3:1"],
        ["locate", "a.png", "--near", "1,2"],
        ["locate", "a.png", "--within", "1,2,3"],
        ["locate", "a.png", "--within", "Atlantis"],
        ["locate", "a.png", "--jobs", "0"],
        ["locate", "a.png", "--method", "magic"],
        ["index"],
        ["index", "--osm", "Porto", "--roads", "a.shp"],
        ["index", "--osm", "Porto", "--crs", "EPSG:4326"],
        ["index", "--roads", "a.shp", "--date", "2020-01-01"],
    ],
)
def test_usage_is_one_line_and_status_2(arguments: list[str], capfd: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 2
    out, err = capfd.readouterr()
    assert out == ""
    assert err.startswith("Error: ")
    assert err.endswith(f"Try 'roadgeo {arguments[0]} --help'.\n")
    assert err.count("\n") == 1


# --- the whole --------------------------------------------------------------------------------------------------------


def test_locate_needs_no_heavy_library(porto: Path, tmp_path: Path) -> None:
    program = (
        "import sys; from roadgeo.cli import main; status = main(sys.argv[1:]); print(*sys.modules); sys.exit(status)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, "locate", str(MASKS["drone"].path), "-r", str(porto), "-q"],
        capture_output=True,
        text=True,
        check=True,
    )
    heavy = {"geopandas", "pyogrio", "osmnx", "networkx", "pandas", "matplotlib", "shapely", "rich"}
    assert not heavy & set(done.stdout.split())


# --- messages that ask what is meant ----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["streets.geojson", "streets.gpkg"])
def test_raw_roads_are_no_reference_and_how_to_build_one_is_said(
    name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    write_streets(Path(name))
    assert main(["locate", str(MASKS["drone"].path), "-r", name]) == 1
    said = last_line(capfd)
    assert f"{name} is no reference; if it holds roads, build one: `roadgeo index --roads {name}" in said
    assert "-r streets_reference.gpkg" in said


def test_longitude_and_latitude_that_were_exchanged_are_asked_about(
    porto: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    locate = ["locate", str(MASKS["drone"].path), "-r", str(porto), "-q"]
    assert main([*locate, "--near=41.15,-8.6,3000"]) == 2
    assert "lies on none of the maps" in (said := capfd.readouterr().err)
    assert "did you mean --near=-8.6,41.15,3000?" in said
    assert main([*locate, "--near=-8.6,41.15,3000"]) == 0
    assert main([*locate, "--near=2.35,48.85,2000"]) == 3  # elsewhere, either way: no question
    assert main([*locate, "--near=41.15,-108.6,3000"]) == 2  # no latitude
    assert "did you mean -108.6,41.15,3000?" in capfd.readouterr().err


def test_a_refusal_says_what_it_removed(porto: Path, capfd: pytest.CaptureFixture[str]) -> None:
    shutil.copy(MASKS["drone"].path, "a.png")
    assert main(["locate", "a.png", "-r", str(porto), "--plot", "--also", "points", "-q"]) == 0
    assert main(["locate", "a.png", "-r", str(porto), "--near", "0,0,10"]) == 3
    removed = capfd.readouterr().out.splitlines()[1].removeprefix("  removed what an earlier run had found: ")
    assert set(removed.split(", ")) == {
        *("a_footprint.tif", "a_footprint.qml", "a_location.gpkg", "a_overlay.png", "a.png.points"),
    }
    assert sorted(path.name for path in Path().glob("a*")) == ["a.png", "a_location.json"]
    assert main(["locate", "a.png", "-r", str(porto), "--near", "0,0,10"]) == 3
    assert "removed" not in capfd.readouterr().out


def test_the_style_of_a_mask_does_not_colour_the_photograph(porto: Path) -> None:
    shutil.copy(MASKS["drone"].path, "a.png")
    cv2.imwrite("photo.png", np.full((960, 1280, 3), 90, np.uint8))
    assert main(["locate", "a.png", "-r", str(porto), "-q"]) == 0
    assert main(["locate", "a.png", "-r", str(porto), "--image", "photo.png", "-q"]) == 0
    assert not Path("a_footprint.qml").exists()


def test_what_is_missing_of_an_earlier_result_is_made_anew(porto: Path, capfd: pytest.CaptureFixture[str]) -> None:
    shutil.copy(MASKS["drone"].path, "a.png")
    locate = ["locate", "a.png", "-r", str(porto), "--effort", "quick", "--plot", "--skip-existing"]
    assert main(locate[:-1]) == 0
    capfd.readouterr()
    for lost in ("a_overlay.png", "a_location.gpkg"):
        Path(lost).unlink()
        assert main(locate) == 0
        assert "before" not in capfd.readouterr().out
        assert Path(lost).stat().st_size
    Path("a_overlay.png").write_bytes(b"")  # as after a power cut
    assert main(locate) == 0
    assert Path("a_overlay.png").stat().st_size
    capfd.readouterr()
    assert main(locate) == 0
    assert capfd.readouterr().out == "a.png: located before\n"
    assert main([*locate, "--max-tilt", "50"]) == 0  # another question
    assert "before" not in capfd.readouterr().out


def test_the_json_says_how_it_was_made(porto: Path, capfd: pytest.CaptureFixture[str]) -> None:
    shutil.copy(MASKS["drone"].path, "a.png")
    assert main(["locate", "a.png", "-r", str(porto), "--json", "-q", "--max-tilt", "50", "--threshold", "99"]) == 0
    found = json.loads(capfd.readouterr().out)
    assert found["version"] == __version__
    assert found["options"] == {"match": {"camera": {"max_tilt_deg": 50.0}}, "threshold": 99.0}
    assert main(["reference", "info", str(porto), "--json"]) == 0
    assert found["reference_digest"] == reference_digest(porto)
    assert 0 < found["rmse_m"] < 3
    assert found["rmse_px"] == pytest.approx(found["rmse_m"] / found["gsd_m"], rel=0.5)


@pytest.mark.parametrize(("jobs", "threads"), [([], 3), (["--jobs", "1"], 1), (["--jobs", "2"], 2)])
def test_an_image_alone_gets_the_processors_unless_jobs_are_given(
    jobs: list[str], threads: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    locate, asked = importlib.import_module("roadgeo.cli.locate"), list[int]()
    monkeypatch.setattr(os, "cpu_count", lambda: 3)
    monkeypatch.setattr(locate, "open_maps", lambda *_: [])
    monkeypatch.setattr(locate, "locate_masks", lambda *given, **_: asked.append(given[3].search.threads) or iter(()))
    mask = tmp_path / "mask.png"
    mask.write_bytes(b"")
    main(["locate", str(mask), "--reference", "none", "--out-dir", str(tmp_path), *jobs])
    assert asked == [threads]
