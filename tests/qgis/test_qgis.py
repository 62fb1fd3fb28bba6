"""The QGIS plugin: its parts without QGIS, then all of it in the real QGIS, in child processes with a time limit."""

import json
import re
import shutil
import sys
from pathlib import Path

import cv2
import geopandas
import numpy as np
import pytest
import rasterio
from support.real_qgis import Qgis, is_running, make_program
from worlds.demo import MASKS

from roadgeo.cli import main
from roadgeo.evaluation.demo import PHOTO, ROADS
from roadgeo.geometry.homography import Homography
from roadgeo.matching.hints import HINTS
from roadgeo.outputs.registry import ALSO
from roadgeo.qgis import installation

PLUGIN = Path(installation.__file__).parent / "plugin"
ROAD, FOOTPRINT, MAP_ROAD = "#e4572e", "#1f6fb4", "#546e7a"


# --- in QGIS ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def located(qgis: Qgis, porto: Path) -> Path:
    """The folder with what *Locate mask* makes of a mask."""
    folder = qgis.folder / "located"
    mask = MASKS["drone"].path
    done = qgis.tool("run", "roadgeo:locatemask", "--", f"MASK={mask}", f"REFERENCE={porto}", f"OUTPUT_FOLDER={folder}")
    assert done.returncode == 0, done.stderr
    assert "STATUS:\tlocated" in done.stdout
    assert f"LOCATION:\t{folder / 'drone_location.gpkg'}|layername=footprint" in done.stdout
    return folder


def read_location(path: Path) -> tuple[Homography, dict]:
    document = json.loads(path.read_text("utf-8"))
    return Homography(np.array(document["homography"])), document


def test_the_provider_loads_and_explains_itself(qgis: Qgis) -> None:
    listed = qgis.tool("list").stdout
    names = ["buildreference", "locatemask", "locatemasks", "vectorizemask", "georeferenceimage", "maplocalizability"]
    names += ["placebypoints", "setup"]
    assert [name for name in names if f"roadgeo:{name}\t" in listed] == names
    explained = qgis.tool("help", "roadgeo:georeferenceimage").stdout
    assert "Cloud Optimized GeoTIFF" in explained
    assert all(f"\n{name.upper()}: {hint.label}\n" in explained for name, hint in HINTS.items())
    assert "--" not in re.sub(r"-{4,}", "", explained)


def test_a_located_mask_lies_where_the_truth_says(located: Path) -> None:
    _, document = read_location(located / "drone_location.json")
    middle = np.array(document["size"]) / 2
    x, y = Homography(MASKS["drone"].homography)(middle)
    assert np.hypot(document["center"]["x"] - x, document["center"]["y"] - y) < 2


def test_a_photograph_is_located(qgis: Qgis, porto: Path) -> None:
    """The option finds its roads; told never to, it is taken for a mask, and no mask looks like that."""
    pytest.importorskip("onnxruntime")
    folder = qgis.folder / "photograph"
    wanted = {"MASK": PHOTO, "REFERENCE": porto, "OUTPUT_FOLDER": folder}
    results = qgis.run("locatemask", **wanted, GSD="1", SEGMENT="auto")["results"]
    assert results["STATUS"] == "located"
    assert results["FOOTPRINT"] == str(folder / "drone_photo_footprint.tif")
    with rasterio.open(folder / "drone_photo_footprint.tif") as warped:  # the photograph itself, not its roads
        assert warped.count >= 3
    assert (folder / "drone_photo_mask.tif").exists()
    _, document = read_location(folder / "drone_photo_location.json")
    truth = Homography(MASKS["drone"].homography)(np.array(document["size"]) / 2)  # the mask was made of it
    assert np.hypot(document["center"]["x"] - truth[0], document["center"]["y"] - truth[1]) < 5
    assert qgis.run("locatemask", **wanted, SEGMENT="never")["failed"]


def test_a_refused_mask_is_a_warning_with_the_reason(qgis: Qgis, porto: Path) -> None:
    mask, folder = MASKS["elsewhere"].path, qgis.folder / "no"
    refused = qgis.run("locatemask", MASK=mask, REFERENCE=porto, OUTPUT_FOLDER=folder)
    assert refused["results"]["STATUS"] == "not_located"
    assert set(refused["layers"]) == {"porto roads"}  # on which its best places are
    assert f"warning: elsewhere: {refused['results']['REASON']}" in refused["said"]


def test_a_picture_that_fits_on_two_maps_is_shown_both_and_located_where_it_is_known_to_be(
    qgis: Qgis, porto: Path
) -> None:
    moved = geopandas.read_file(ROADS).to_crs(32629)
    moved.set_geometry(moved.translate(20_000)).to_file(qgis.folder / "moved_roads.gpkg")
    qgis.run("buildreference", ROADS=qgis.folder / "moved_roads.gpkg", KINDS="all", OUTPUT=qgis.folder / "moved.gpkg")
    wanted = {"MASK": MASKS["drone"].path, "OUTPUT_FOLDER": qgis.folder / "twice"}
    done = qgis.run("locatemask", **wanted)
    assert done["results"]["STATUS"] == "ambiguous"
    assert set(done["layers"]) == {"porto roads", "moved roads"}
    near = qgis.run("locatemask", **wanted, NEAR="-8.608,41.1525 [EPSG:4326]", NEAR_RADIUS=1000)
    assert near["results"]["STATUS"] == "located"
    assert "porto roads" in near["layers"]


def test_errors_are_shown_in_the_words_of_qgis(qgis: Qgis, porto: Path) -> None:
    wanted = {"MASK": MASKS["drone"].path, "OUTPUT_FOLDER": qgis.folder / "errors", "REFERENCE": porto}
    absent = qgis.run("locatemask", **{**wanted, "REFERENCE": qgis.folder / "none.gpkg"})
    scales = qgis.run("locatemask", **wanted, GSD="90:12")
    twice = qgis.run("locatemask", **wanted, AREA="0,1,0,1 [EPSG:4326]", WITHIN="Portugal")
    nothing = qgis.run("buildreference", OUTPUT=qgis.folder / "x.gpkg")
    nameless = qgis.run("buildreference", EXTENT="0,1,0,1 [EPSG:4326]")
    assert "no reference '" in absent["failed"]
    assert "“Pixel size, metres”" in scales["failed"]
    assert "Name the country or state, or give a part of the map" in twice["failed"]
    assert "Give one source of roads" in nothing["failed"]
    assert "Give the reference a name" in nameless["failed"]
    assert "--" not in "".join(one["failed"] for one in (absent, scales, nothing))


def test_without_the_executable_nothing_runs_and_the_advice_is_there(qgis: Qgis) -> None:
    answers, _, _ = qgis.ask(("configure", {"executable": "/no/such/roadgeo"}), ("configure", {"executable": ""}))
    assert not answers[0][0]
    assert "Set up roadgeo" in answers[0][1]
    assert answers[1] == [True, ""]


def test_an_environment_is_made_and_roadgeo_installed_there(qgis: Qgis) -> None:
    """With a Python that plays venv and pip; one that is too old is passed over, a folder with other things refused."""
    body = """
import os, pathlib, shutil, sys
assert sys.argv[1] == "-I" and os.getcwd() != os.path.dirname(os.environ["QGIS_CUSTOM_CONFIG_PATH"])
if sys.argv[2:4] == ["-m", "venv"]:
    scripts = pathlib.Path(sys.argv[4], "bin")
    scripts.mkdir(parents=True)
    shutil.copy(sys.argv[0], scripts / "python")
if sys.argv[2:4] == ["-m", "pip"]:
    if sys.argv[-1] == "nonesuch":
        sys.exit("ERROR: No matching distribution found for nonesuch")
    program = pathlib.Path(sys.argv[0]).with_name("roadgeo")
    program.write_text("#!/bin/sh\\necho roadgeo, version 9.9 of " + sys.argv[-1])
    program.chmod(0o755)
"""
    python = make_program(qgis.folder / "pythons" / "python3", body)
    old = make_program(qgis.folder / "pythons" / "python3.11", "import sys\nsys.exit(1)")
    wanted = {"PROGRAM": python, "INSTALL": True, "SOURCE": "roadgeo", "FOLDER": qgis.folder / "environment"}
    done = qgis.run("setup", **wanted)
    full = qgis.run("setup", **{**wanted, "FOLDER": qgis.folder / "pythons"})
    unknown = qgis.run("setup", **{**wanted, "SOURCE": "nonesuch", "FOLDER": qgis.folder / "unknown"})
    aged = qgis.run("setup", **{**wanted, "PROGRAM": old, "FOLDER": "/no/such"})
    named = qgis.run("setup", PROGRAM=old)
    absent = qgis.run("setup", PROGRAM="no_such_program")
    qgis.ask(("forget_program", {}))
    assert "results" in done, done
    assert done["results"]["FOUND"] == str(qgis.folder / "environment" / "bin" / "roadgeo")
    assert done["results"]["VERSION"] == "roadgeo"
    assert "holds other things" in full["failed"]
    assert "nonesuch was not installed" in unknown["failed"]
    assert "No matching distribution" in unknown["failed"]
    assert "give under “What to install” a wheel" in unknown["failed"]
    assert "needs Python 3.11 or newer" in aged["failed"]
    assert "failed" in named["failed"]
    assert "give its full path" in absent["failed"]


def test_setting_up_runs_nothing_of_the_current_folder(qgis: Qgis) -> None:
    """Modules lie there that venv, pip and the trial of a Python would import, and programs of the names asked for."""
    stolen = qgis.folder / "stolen"
    planted = [qgis.folder / f"{name}.py" for name in ("ensurepip", "venv", "pip", "json", "multiprocessing")]
    for path in planted:
        path.write_text(f"open({str(stolen)!r}, 'a').write({path.name!r})", "utf-8")
    planted += [make_program(qgis.folder / name, planted[0].read_text("utf-8")) for name in ("roadgeo", "python3")]
    done = qgis.run("setup", PROGRAM=sys.executable, INSTALL=True, SOURCE="/no/such.whl", FOLDER=qgis.folder / "made")
    qgis.run("setup")
    qgis.ask(("forget_program", {}))
    for path in planted:
        path.unlink()
    assert "failed" in done
    assert (qgis.folder / "made" / "pyvenv.cfg").exists()
    assert not stolen.exists(), stolen.read_text("utf-8")


def test_cancelling_stops_the_executable(qgis: Qgis, porto: Path) -> None:
    body = """
import os, sys, time
folder = os.path.dirname(__file__)
open(folder + "/started", "w").write(str(os.getpid()))
try:
    time.sleep(600)
except KeyboardInterrupt:
    open(folder + "/cleaned", "w").close()
"""
    program = make_program(qgis.folder / "slow" / "roadgeo", body)
    arguments = {
        "MASK": str(MASKS["drone"].path),
        "REFERENCE": str(porto),
        "OUTPUT_FOLDER": str(qgis.folder / "cancelled"),
    }
    task = {"algorithm": "roadgeo:locatemask", "parameters": arguments, "executable": str(program), "seconds": 1.5}
    qgis.ask(("cancel", task))
    assert not is_running(int((qgis.folder / "slow" / "started").read_text()))
    assert (qgis.folder / "slow" / "cleaned").exists()


def test_a_folder_of_masks_is_located_whatever_is_wrong_with_some(qgis: Qgis, porto: Path) -> None:
    masks, folder = qgis.folder / "masks", qgis.folder / "batch"
    masks.mkdir()
    for name in ("map_sheet", "high_flight", "elsewhere"):
        shutil.copy(MASKS[name].path, masks)
    (masks / "broken.png").write_text("no picture")
    done = qgis.run("locatemasks", MASKS=masks, REFERENCE=porto, OUTPUT_FOLDER=folder, JOBS=2)
    results = done["results"]
    assert [results[name] for name in ("LOCATED", "NOT_LOCATED", "FAILED")] == [2, 1, 1]
    assert done["layers"]["Footprints"]["features"] == 2
    assert done["layers"]["Footprints"]["colors"] == [FOOTPRINT]
    assert "progress: 2 located, 1 not located, 1 failed" in done["said"]
    assert any(line.startswith("error: ") and "broken.png" in line for line in done["said"])


def test_a_mask_is_vectorized_and_each_run_has_its_own_group(qgis: Qgis) -> None:
    parameters = {"MASK": str(MASKS["segmenter"].path)}
    tasks = [{**parameters, "OUTPUT_FOLDER": str(qgis.folder / name)} for name in ("seen", "seen again")]
    runs, _, _ = qgis.ask(*(("run", {"algorithm": "roadgeo:vectorizemask", "parameters": task}) for task in tasks))
    for run, group in zip(runs, ("segmenter", "segmenter (2)"), strict=True):
        assert set(run["layers"]) == {"Roads as seen", "Intersections as seen"}
        for layer in run["layers"].values():
            assert layer["valid"]
            assert layer["features"] > 50
            assert layer["group"] == group
        assert run["layers"]["Roads as seen"]["colors"] == ["#ffbe28"]


def test_where_masks_would_be_located_is_mapped(qgis: Qgis, porto: Path) -> None:
    folder = qgis.folder / "where"
    done = qgis.run("maplocalizability", REFERENCE=porto, OUTPUT_FOLDER=folder, COUNT=4, NOISE="clean")
    assert set(done["layers"]) == {"porto: where it would work"}
    assert done["layers"]["porto: where it would work"]["renderer"] == "paletted"


def test_results_are_loaded_with_their_styles(qgis: Qgis, porto: Path) -> None:
    mask, folder = MASKS["drone"].path, qgis.folder / "loaded"
    built = qgis.run("buildreference", ROADS=ROADS, KINDS="all", OUTPUT="again.gpkg")  # in the folder that it runs in
    (remembered,), _, _ = qgis.ask(("remembered", {}))
    done = qgis.run("locatemask", MASK=mask, REFERENCE=porto, OUTPUT_FOLDER=folder, REPORT=True)
    assert built["layers"]["again roads"]["colors"] == [MAP_ROAD]
    assert set(built["layers"]) == {"again roads", "again coverage", "again intersections"}
    assert str(qgis.folder / "again.gpkg") in remembered
    layers = done["layers"]
    names = {"drone", "drone footprint", "drone matches", "drone residuals × 20", "drone roads"}
    assert set(layers) == {*names, "porto roads"}  # the map that lies below
    assert {layers[name]["group"] for name in names} == {"drone"}
    assert layers["porto roads"]["group"] == ""
    assert Path(done["results"]["REPORT_PAGE"]).name == "drone_report.html"
    assert Path(done["results"]["REPORT_PAGE"]).exists()
    assert all(layer["valid"] and layer["crs"] == "EPSG:32629" for layer in layers.values())
    residuals = geopandas.read_file(folder / "drone_location.gpkg", layer="residuals")
    assert np.allclose(residuals.length, 20 * residuals["residual_m"], rtol=0.01)  # as the layer's name has it
    assert layers["drone"]["renderer"] == "paletted"
    assert layers["drone footprint"]["colors"] == [FOOTPRINT]
    assert layers["drone roads"]["colors"] == [ROAD]


def test_every_output_opens_without_a_word(qgis: Qgis, porto: Path, located: Path) -> None:
    package = located / "drone_location.gpkg"
    files = [(str(porto), layer) for layer in ("coverage", "roads", "tangents", "intersections")]
    files += [(str(package), layer) for layer in ("footprint", "residuals", "corners", "matches", "query_roads")]
    files += [(str(located / "drone_footprint.tif"), "")]
    layers, warnings, printed = qgis.ask(*(("load", {"path": path, "layer": layer}) for path, layer in files))
    assert all(layer["valid"] for layer in layers)
    assert all(layer["features"] for layer in layers[:-1])
    assert warnings == []
    assert printed == ""
    assert (
        main(["reference", "check", str(porto)]) == 0
    )  # QGIS changes a GeoPackage's bytes; the reference is sound all the same


# --- what QGIS makes of it --------------------------------------------------------------------------------------------


def test_the_map_shows_the_mask_over_the_roads(qgis: Qgis, porto: Path, located: Path) -> None:
    """Two metres to a pixel: the mask's roads have their area, lie on the map's roads, and would not elsewhere."""
    with rasterio.open(located / "drone_footprint.tif") as raster:
        bounds, road_area = raster.bounds, np.count_nonzero(raster.read(1) == 2) * raster.res[0] ** 2
    west, south = bounds.left // 2 * 2, bounds.bottom // 2 * 2
    size = [int((bounds.right - west) / 2) + 1, int((bounds.top - south) / 2) + 1]
    extent = [west, south, west + 2 * size[0], south + 2 * size[1]]
    mask, roads, outline = "drone_footprint.tif", "porto.gpkg roads", "drone_location.gpkg footprint"
    loads = [(str(located / mask), ""), (str(porto), "roads"), (str(located / "drone_location.gpkg"), "footprint")]
    pictures = {"all": [outline, mask, roads], "mask": [mask], "roads": [roads], "outline": [outline]}
    shots = [
        ("render", {"layers": layers, "extent": extent, "size": size, "path": str(qgis.folder / f"{name}.png")})
        for name, layers in pictures.items()
    ]
    qgis.ask(*(("load", {"path": path, "layer": layer}) for path, layer in loads), *shots)
    shown = {name: cv2.imread(str(qgis.folder / f"{name}.png")) for name in pictures}
    drawn = has_color(shown["mask"], ROAD)
    assert np.count_nonzero(drawn) * 4 == pytest.approx(road_area, rel=0.03)
    on_map = cv2.dilate(has_color(shown["roads"], MAP_ROAD, 90).view(np.uint8), np.ones((13, 13), np.uint8)) > 0
    aside = np.roll(on_map, (37, 23), axis=(0, 1))
    assert on_map[drawn].mean() > 0.95
    assert aside[drawn].mean() < 0.7
    _, document = read_location(located / "drone_location.json")
    corners = (np.array(document["footprint"]) - (west, south + 2 * size[1])) / (2, -2)
    expected = cv2.polylines(np.zeros(drawn.shape, np.uint8), [np.rint(corners).astype(np.int32)], True, 1, 3) > 0
    line = has_color(shown["outline"], FOOTPRINT, 40)
    assert (expected & line).sum() > 0.9 * line.sum()
    together = shown["all"]
    assert has_color(together, ROAD)[drawn].mean() > 0.7  # under the footprint's light fill
    assert has_color(together, MAP_ROAD, 90).sum() > 500


def has_color(picture: np.ndarray, color: str, tolerance: int = 60) -> np.ndarray:
    """(H, W) bool: pixels whose three values differ from a colour by less than the tolerance, together."""
    wanted = np.array(list(bytes.fromhex(color[1:]))[::-1])
    return np.abs(picture.astype(int) - wanted).sum(axis=2) < tolerance


def coordinate_picture(path: Path, size: tuple[int, int]) -> Path:
    """Write a picture whose red and green tell where its pixels are: sixteenths of column and row, at their centres."""
    rows, columns = np.mgrid[: size[1], : size[0]] + 0.5
    cv2.imwrite(str(path), np.dstack([np.ones(rows.shape), rows * 16, columns * 16]).astype(np.uint16))
    return path


def test_a_georeferenced_image_agrees_with_the_homography_everywhere(qgis: Qgis, porto: Path) -> None:
    """A tilted camera, and a picture of another size than its mask: as QGIS shows it, and by its control points."""
    mask, folder = MASKS["drone"].path, qgis.folder / "image"
    height, width = cv2.imread(str(mask), cv2.IMREAD_GRAYSCALE).shape
    picture = coordinate_picture(qgis.folder / "photo.tif", (width // 2, height // 2))
    inputs = {"IMAGE": picture, "MASK": mask, "REFERENCE": porto, "OUTPUT_FOLDER": folder}
    done = qgis.run("georeferenceimage", **inputs, PRODUCTS=list(ALSO), RESAMPLING="bilinear")
    assert done["results"]["STATUS"] == "located"
    assert all(product.path(folder, "drone", "photo.tif").exists() for product in ALSO.values())
    _, document = read_location(folder / "drone_location.json")
    homography = Homography(np.array(document["homography"]) @ np.diag([2, 2, 1]))
    columns, rows = (np.linspace(8, side - 8, 12) for side in (width // 2, height // 2))
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    with rasterio.open(folder / "drone_footprint.tif") as raster:
        resolution, corner = raster.res[0], (raster.bounds.left, raster.bounds.top)
    steps = np.array((resolution, -resolution))
    places = corner + (np.floor((homography(pixels) - corner) / steps) + 0.5) * steps  # centres of the raster's pixels
    (sampled, projected), _, _ = qgis.ask(
        ("sample", {"path": str(folder / "drone_footprint.tif"), "points": places.tolist(), "bands": [1, 2]}),
        ("project", {"points": str(folder / "photo.tif.points"), "pixels": pixels.tolist()}),
    )
    assert np.hypot(*(homography(np.array(sampled, float) / 16) - places).T).max() < 0.6 * resolution
    assert np.hypot(*(np.array(projected) - homography(pixels)).T).max() < 0.01
