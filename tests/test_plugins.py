"""Plugins: found by entry points like our own; the example is installed and used as a user would."""

import json
import os
import shutil
import subprocess
import sys
import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path

import cv2
import numpy as np
import pytest
import shapely
from outputs.test_location_files import located, road_mask
from scipy.spatial.transform import Rotation
from worlds.demo import MASKS

from roadgeo import plugins
from roadgeo.cli import main
from roadgeo.errors import MaskError, PluginError
from roadgeo.evaluation.demo import ROADS
from roadgeo.geometry.mask import RoadMask
from roadgeo.geometry.projection import to_lonlat
from roadgeo.outputs import registry
from roadgeo.outputs.location_files import OutputOptions, write_location
from roadgeo.outputs.paths import output_paths
from roadgeo.outputs.registry import ALSO, Output
from roadgeo.plugins import GROUPS, OUTPUTS, SEGMENTERS, SOURCES, call_plugin, find_plugins, load_plugin, package_of
from roadgeo.sources.masks import read_mask
from roadgeo.sources.roads import fetch_roads, read_roads

ROOT = Path(__file__).parent.parent
SHEET = MASKS["map_sheet"].path


@pytest.fixture
def offer(monkeypatch: pytest.MonkeyPatch):
    """Offer objects of this module as if packages were installed that do."""

    def offered(**objects: str) -> None:
        points = {group: [] for group in GROUPS}
        for name, value in objects.items():
            kind, _, short = name.partition("_")
            group = next(group for group in GROUPS if group.startswith(f"roadgeo.{kind}"))
            points[group].append(EntryPoint(short, value, group))
        monkeypatch.setattr(plugins, "entry_points", lambda group: points[group])

    return offered


def see_nothing(picture: str) -> RoadMask:
    raise MaskError(f"{picture}: clouds")


def stumble(*_: object, **__: object) -> None:
    raise ZeroDivisionError("by zero")


def give_nothing(*_: object, **__: object) -> None:
    return None


def see_mask(picture: str) -> RoadMask:
    return read_mask(picture, name="something else")


def see_array(picture: str) -> np.ndarray:
    return cv2.imread(picture, cv2.IMREAD_GRAYSCALE)


NOT_CALLABLE = 7


def test_our_own_are_registered_like_all_others() -> None:
    """Beside them, the environment may hold plugins of its user."""
    ours = {
        group: {name: point for name, point in find_plugins(group).items() if package_of(point) == "roadgeo"}
        for group in GROUPS
    }
    assert {name: point.load() for name, point in ours[OUTPUTS].items()} == ALSO
    assert {point.load() for point in ours[SOURCES].values()} == {read_roads, fetch_roads}
    assert load_plugin(SEGMENTERS, "mask") is read_mask
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["entry-points"]
    assert declared == {group: {name: point.value for name, point in points.items()} for group, points in ours.items()}


def test_ours_come_first_where_names_clash(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plugins, "package_of", lambda point: point.value.split(":")[0])
    points = [EntryPoint("x", f"{package}:x", SOURCES) for package in ("zebra", "roadgeo", "aardvark")]
    monkeypatch.setattr(plugins, "entry_points", lambda group: points)
    assert find_plugins(SOURCES)["x"].value == "roadgeo:x"
    points.pop(1)
    assert find_plugins(SOURCES)["x"].value == "aardvark:x"


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (
            f"{__name__}:stumble",
            "'broken' of roadgeo.segmenters from an unknown package failed: ZeroDivisionError: by zero",
        ),
        (f"{__name__}:absent", "'broken' of .* cannot be loaded: AttributeError"),
        ("no_such_module_at_all:x", "'broken' of .* cannot be loaded: ModuleNotFoundError"),
        (f"{__name__}:NOT_CALLABLE", "failed: TypeError: 'int' object is not callable"),
    ],
)
def test_what_a_plugin_does_wrong_is_said_to_be_its_own(offer, value: str, message: str) -> None:
    offer(segmenters_broken=value)
    with pytest.raises(PluginError, match=message):
        call_plugin(SEGMENTERS, "broken", "a.png")


def test_what_a_plugin_refuses_is_said_as_it_says_it(offer) -> None:
    offer(segmenters_clouds=f"{__name__}:see_nothing")
    with pytest.raises(MaskError, match=r"a\.png: clouds"):
        call_plugin(SEGMENTERS, "clouds", "a.png")
    with pytest.raises(PluginError, match=r"no 'sun' among the roadgeo\.segmenters, expected one of clouds"):
        load_plugin(SEGMENTERS, "sun")


@pytest.mark.parametrize("kind", ["mask", "array"])
def test_a_segmenter_may_return_a_mask_or_an_array(offer, kind: str) -> None:
    from roadgeo.running.photographs import call_segmenter

    offer(segmenters_mask=f"{__name__}:see_mask", segmenters_array=f"{__name__}:see_array")
    mask = call_segmenter(kind, str(SHEET), None)
    assert mask.name == str(SHEET)
    assert np.array_equal(mask.roads, read_mask(SHEET).roads)


@pytest.mark.parametrize(
    ("arguments", "status", "message"),
    [
        (["index", "--source", "osm"], 2, "got 'osm', expected one of files:WHERE, osm:WHERE"),
        (["index", "--source", "moon:Tycho"], 2, "got 'moon:Tycho', expected one of"),
        (["index", "--source", "files:a.gpkg", "--roads", "a.gpkg"], 2, "Give one source of roads"),
        (["index", "--source", "files:missing.gpkg"], 1, "missing.gpkg"),
        (["locate", "a.png", "--segmenter", "eyes"], 2, "got 'eyes', expected one of mask"),
        (["locate", "a.png", "--also", "bread"], 2, "got 'bread', expected one of "),
        (["reference", "info"], 2, "Missing argument 'REF'"),
    ],
)
def test_the_command_line_knows_what_is_installed(
    arguments: list[str],
    status: int,
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("ROADGEO_LIBRARY", str(tmp_path))
    assert main(arguments) == status
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("sources", "the source 'odd' returned a NoneType, expected roadgeo.sources.roads.Roads"),
        ("outputs", "the output 'odd' is a function, expected a roadgeo.outputs.registry.Output"),
        ("segmenters", "the segmenter 'odd' returned a NoneType, expected a RoadMask or an array"),
    ],
)
def test_what_is_of_the_wrong_kind_is_refused(
    offer, kind: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], porto: Path
) -> None:
    offer(**{f"{kind}_odd": f"{__name__}:give_nothing"})
    locate = ["locate", str(SHEET), "-r", str(porto), "-o", str(tmp_path)]
    arguments = {
        "sources": ["index", "--source", "odd:there", "--out", str(tmp_path / "odd.gpkg")],
        "outputs": [*locate, "--also", "odd"],
        "segmenters": [*locate, "--segmenter", "odd"],
    }
    assert main(arguments[kind]) == 1
    assert message in " ".join(capsys.readouterr().err.split())


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The example, installed beside everything else: the environment that has it."""
    folder = tmp_path_factory.mktemp("plugin")
    shutil.copytree(
        ROOT / "examples" / "plugin", folder / "plugin", ignore=shutil.ignore_patterns("build", "*.egg-info")
    )
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    options = ["--no-deps", "--no-build-isolation", "--target", str(folder / "site")]
    subprocess.run([*pip, *options, str(folder / "plugin")], check=True, capture_output=True)
    path = os.pathsep.join(filter(None, [str(folder / "site"), os.environ.get("PYTHONPATH")]))
    return {**os.environ, "PYTHONPATH": path}


def test_the_example_is_twenty_five_lines() -> None:
    lines = (ROOT / "examples" / "plugin" / "roadgeo_wkt.py").read_text(encoding="utf-8").splitlines()
    assert sum(bool(line.strip()) for line in lines) <= 25


def test_the_example_is_installed_and_used(installed: dict[str, str], tmp_path: Path) -> None:
    def roadgeo(*arguments: str) -> str:
        command = [sys.executable, "-m", "roadgeo", *arguments]
        done = subprocess.run(command, cwd=tmp_path, env=installed, capture_output=True, text=True, encoding="utf-8")
        assert done.returncode == 0, done.stderr
        return done.stdout

    listed = roadgeo("--plugins")
    assert {line.split()[0] for line in listed.splitlines() if "roadgeo-wkt 1.0" in line} == set(GROUPS)
    assert "roadgeo.segmenters  yellow" in listed

    roads = read_roads(ROADS)
    degrees = [
        shapely.transform(line, lambda xy: to_lonlat(roads.plane.crs, roads.plane.to_crs(xy))) for line in roads.lines
    ]
    (tmp_path / "roads.txt").write_text("\n".join(line.wkt for line in degrees), encoding="utf-8")
    roadgeo("index", "--source", "wkt:roads.txt", "--out", "porto.gpkg")

    mask = cv2.imread(str(SHEET), cv2.IMREAD_GRAYSCALE)
    sheet = np.full((*mask.shape, 3), 255, np.uint8)
    sheet[mask > 127] = (60, 210, 250)
    cv2.imwrite(str(tmp_path / "sheet.png"), sheet)
    found = json.loads(
        roadgeo(
            "locate", "sheet.png", "-r", "porto.gpkg", "--segmenter", "yellow", "--also", "geopose", "--json", "--quiet"
        )
    )
    assert found["status"] == "located"
    pose = json.loads((tmp_path / "sheet_geopose.json").read_text(encoding="utf-8"))
    camera = found["camera"]
    assert (pose["position"]["lon"], pose["position"]["lat"]) == (camera["lon"], camera["lat"])
    looks = Rotation.from_quat([pose["quaternion"][axis] for axis in "xyzw"]).apply([0.0, 0.0, -1.0])
    assert looks[2] == pytest.approx(-1.0, abs=0.02)  # a sheet lies level


def test_nothing_is_looked_up_before_a_plugin_is_named() -> None:
    script = (
        "import sys, roadgeo, roadgeo.cli; roadgeo.cli.main(['--help']); print('importlib.metadata' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "False"


@pytest.mark.parametrize("fails", ["raises", "writes nothing"])
def test_a_faulty_output_is_blamed_by_name_and_the_rest_is_kept(
    fails: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def write(path: Path, _: object) -> None:
        if fails == "raises":
            path.write_text("half")
            raise KeyError("x")

    monkeypatch.setattr(registry, "_load", lambda name: Output(name, "_broken.txt", write, "broken"))
    options = OutputOptions(products=("broken", "geojson"))
    written = write_location(located(), road_mask(), output_paths(tmp_path, "a"), options)
    (fault,) = written.faults
    assert f"the output 'broken' of {__name__} failed: " in fault
    assert "inform its makers; all else is written" in fault
    assert {path.name for path in written.files} == {path.name for path in tmp_path.iterdir()}
    assert {"a_location.json", "a_footprint.geojson"} <= {path.name for path in written.files}
