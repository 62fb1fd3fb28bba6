"""What stands beside the package agrees with it."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from worlds.demo import DRONE

import roadgeo
from roadgeo.errors import how_to_install, name_package
from roadgeo.evaluation.demo import ROADS

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]

#: Packages that an onboard computer has.
ON_BOARD = {line for line in (ROOT / "onboard.txt").read_text("utf-8").splitlines() if not line.startswith("#")}

#: Packages that conda-forge calls otherwise.
ON_CONDA = {"opencv-python-headless": "py-opencv", "osmium": "pyosmium"}


def _name_of(requirement: str) -> str:
    return re.match(r"[\w-]+", requirement)[0]


def test_the_citation_is_of_this_version() -> None:
    citation = (ROOT / "CITATION.cff").read_text()
    assert f"\nversion: {roadgeo.__version__}\n" in citation
    assert f'\nurl: "{PROJECT["urls"]["Homepage"]}"\n' in citation
    assert f'\nrepository-code: "{PROJECT["urls"]["Repository"]}"\n' in citation


def test_the_conda_recipe_is_of_this_version_and_needs_the_same() -> None:
    recipe = (ROOT / "conda" / "recipe.yaml").read_text("utf-8")
    assert f'version: "{roadgeo.__version__}"' in recipe
    assert f"homepage: {PROJECT['urls']['Homepage']}" in recipe
    needed = recipe.split("  run:\n")[1].split("\n\n")[0]
    listed = re.findall(r"- ([\w-]+) (>=[\d.]+)", needed)
    every = set(PROJECT["dependencies"])
    asked = [re.fullmatch(r"([\w-]+)(>=[\d.]+)", item).groups() for item in every]
    expected = {(ON_CONDA.get(name, name), version) for name, version in asked}
    assert set(listed) == {("python", PROJECT["requires-python"]), *expected}


def test_a_missing_package_is_named_with_what_brings_it() -> None:
    extras = PROJECT["optional-dependencies"]
    left_out = [name for name in map(_name_of, PROJECT["dependencies"]) if name not in ON_BOARD | {"protobuf"}]
    for brings, package in [
        *((package, package) for package in left_out),
        *((extra, _name_of(item)) for extra in ("mavlink", "parquet") for item in extras[extra]),
    ]:
        module = package.replace("-", "_")
        reported = str(name_package(ModuleNotFoundError(name=f"{module}.part")))
        assert reported == f"this needs {module}, which is not installed: {how_to_install(brings)}"
        assert package in reported
    assert name_package(ModuleNotFoundError(name="another")) is None


def test_an_onboard_computer_needs_what_is_pinned() -> None:
    pinned = {line.split("==")[0] for line in (ROOT / "constraints.txt").read_text("utf-8").splitlines()}
    assert pinned > ON_BOARD


def test_the_constraints_pin_every_package_within_its_bounds() -> None:
    lines = (ROOT / "constraints.txt").read_text("utf-8").splitlines()
    pinned = [re.match(r"([\w-]+)==([\d.]+)", line).groups() for line in lines if not line.startswith("#")]
    extras = PROJECT["optional-dependencies"]
    asked = [
        *PROJECT["dependencies"],
        *(item for name in extras if name != "dev" for item in extras[name]),
    ]
    for name, least in (re.fullmatch(r"([\w-]+)(?:\[\w+\])?>=([\d.]+)", query).groups() for query in asked):
        versions = [tuple(map(int, version.split("."))) for package, version in pinned if package == name]
        assert versions, name
        assert min(versions) >= tuple(map(int, least.split("."))), name


ON_BOARD_ALONE = """
import sys
for name in ("onnxruntime", "requests",
             "scipy", "geopandas", "pandas", "pyogrio", "pyarrow", "shapely", "osmnx", "networkx", "osmium",
             "starlette", "uvicorn", "mapbox_vector_tile", "python_multipart", "dask"):
    sys.modules[name] = None
from roadgeo.cli import main
sys.exit(main(sys.argv[1:]))
"""


def test_an_onboard_computer_locates_and_names_what_is_missing(porto: Path, tmp_path: Path) -> None:
    """A reference that was built elsewhere is all it needs."""

    def run(*arguments: object) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-c", ON_BOARD_ALONE, *map(str, arguments)]
        return subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)

    for arguments in (
        ["locate", DRONE, "-r", porto, "--out-dir", tmp_path / "out", "--report", "--plot", "--also", "stac"],
        ["locate", DRONE, "-r", porto, "--out-dir", tmp_path / "told", "--heading", "128+-5", "--gsd", "0.8:1.25"],
        ["vectorize", DRONE],
        ["reference", "info", porto],
    ):
        done = run(*arguments)
        assert done.returncode == 0, done.stderr
    for package, arguments in (
        ("shapely", ["index", "--roads", ROADS, "--out", "a.gpkg"]),
        ("starlette", ["serve", "-r", porto]),
    ):
        done = run(*arguments)
        assert done.returncode == 1
        assert f"{package}, which is not installed: " in done.stderr.splitlines()[-1], done.stderr


def test_placeholder_addresses_stand_in_one_place() -> None:
    """Whoever publishes roadgeo changes pyproject.toml; two files that cannot read it are held against it above."""
    held = {"pyproject.toml", "CITATION.cff", "recipe.yaml"}
    files = [path for path in ROOT.rglob("*") if path.suffix in {".py", ".md", ".toml", ".cff", ".yaml", ".txt"}]
    ours = [
        path for path in files if not {".venv", ".lowest", ".uv", "build", "tests"} & {*path.relative_to(ROOT).parts}
    ]
    assert {path.name for path in ours if "roadgeo.example.org" in path.read_text("utf-8")} == held


@pytest.mark.parametrize(
    ("prefix", "begins"),
    [
        ("/home/a/.local/share/pipx/venvs/roadgeo", "pipx inject roadgeo onnxruntime"),
        ("/home/a/.local/share/uv/tools/roadgeo", "uv pip install --python /x/python onnxruntime"),
        ("/home/a/project/.venv", "/x/python -m pip install onnxruntime"),
    ],
)
def test_what_is_missing_is_installed_where_roadgeo_is(
    prefix: str, begins: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nobody need know where roadgeo itself came from: there may be no such package anywhere."""
    monkeypatch.setattr(sys, "prefix", prefix)
    monkeypatch.setattr(sys, "executable", "/x/python")
    assert how_to_install("onnxruntime").startswith(begins)
    monkeypatch.setattr(sys, "executable", "/my programs/python")
    assert "pipx" in prefix or '"/my programs/python"' in how_to_install("onnxruntime")
