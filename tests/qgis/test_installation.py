"""The plugin in a profile, in the place of what was there, and as a package; and what holds for its files."""

import ast
import configparser
import json
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import roadgeo
from roadgeo.cli import main
from roadgeo.errors import OutputError
from roadgeo.matching.hints import HINTS
from roadgeo.outputs.registry import ALSO
from roadgeo.qgis.installation import NAME, TABLE, find_profiles, install_plugin, write_package
from roadgeo.qgis.plugin import runner

PACKAGE = Path(roadgeo.__file__).parent
PLUGIN = PACKAGE / "qgis" / "plugin"
PUBLISHER = {"email": "a@example.org", "repository": "https://example.org/r", "tracker": "https://example.org/t"}


# --- in a profile -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("leads", [True, False])
def test_a_link_in_its_place_is_replaced_and_what_it_leads_to_stays(leads: bool, tmp_path: Path) -> None:
    """Who develops the plugin links it there."""
    own, plugins = tmp_path / "own", tmp_path / "profile" / "python" / "plugins"
    own.mkdir()
    (own / "mine.py").touch()
    plugins.mkdir(parents=True)
    (plugins / NAME).symlink_to(own if leads else tmp_path / "gone")
    folder = install_plugin(tmp_path / "profile")
    assert not folder.is_symlink()
    assert (folder / "metadata.txt").is_file()
    assert [path.name for path in own.iterdir()] == ["mine.py"]


def test_installing_replaces_enables_and_remembers(tmp_path: Path) -> None:
    settings = tmp_path / "QGIS" / "QGIS3.ini"
    settings.parent.mkdir()
    settings.write_bytes(
        b"[General]\r\nname=%C3%A9\r\n[PythonPlugins]\r\nother=true\r\nroadgeo_qgis=false\r\n[Z]\r\na=1"
    )
    (tmp_path / "python" / "plugins" / NAME).mkdir(parents=True)
    (tmp_path / "python" / "plugins" / NAME / "outdated.py").touch()
    for _ in range(2):
        folder = install_plugin(tmp_path)
        installed = {path.name for path in folder.rglob("*")}
        assert {"__init__.py", "metadata.txt", "icon.svg", "LICENSE", "algorithms.py"} <= installed
        assert not {"outdated.py", "__pycache__"} & installed
        table = json.loads((folder / TABLE).read_text("utf-8"))
        assert table["outputs"] == {name: output.summary for name, output in ALSO.items()}
        hints = [name for name, row in table["options"]["locate"].items() if row["is_hint"]]
        assert hints == [hint.option for hint in HINTS.values()]
        assert settings.read_bytes() == (
            b"[General]\r\nname=%C3%A9\r\n[PythonPlugins]\r\nroadgeo_qgis=true\nother=true\r\n[Z]\r\na=1"
        )
        executable = Path((folder / runner.REMEMBERED).read_text("utf-8").strip())
        assert executable.is_file()
        assert executable.stem == "roadgeo"


def test_profiles_are_found_by_name_in_every_qgis_of_the_user(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("QGIS_CUSTOM_CONFIG_PATH", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.setattr(sys, "platform", "linux")
    three, four = (tmp_path / "data" / "QGIS" / version / "profiles" for version in ("QGIS3", "QGIS4"))
    assert find_profiles("default") == [three / "default"]
    for profile in (three / "default", four / "default", four / "work"):
        profile.mkdir(parents=True)
    assert find_profiles("default") == [three / "default", four / "default"]
    assert find_profiles("work") == [four / "work"]
    assert find_profiles(str(four / "work")) == [four / "work"]
    with pytest.raises(OutputError, match="no profile 'works'; it has default, work"):
        find_profiles("works")
    monkeypatch.setenv("QGIS_CUSTOM_CONFIG_PATH", str(tmp_path / "own"))
    assert find_profiles("default") == [tmp_path / "own" / "profiles" / "default"]


def test_a_profile_that_cannot_be_written_is_one_line(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "python").touch()
    assert main(["qgis", "install", "--profile", str(tmp_path)]) == 1
    assert capfd.readouterr().err.startswith("Error: cannot write ")


@pytest.mark.parametrize("active", [True, False])
def test_whoever_is_in_an_environment_is_asked_to_leave_it(
    active: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """QGIS takes the Python of an environment that is active where it is started, which has none of its modules."""
    monkeypatch.delenv("VIRTUAL_ENV", raising=False)
    if active:
        monkeypatch.setenv("VIRTUAL_ENV", "/some/venv")
    assert main(["qgis", "install", "--profile", str(tmp_path)]) == 0
    assert ("deactivate" in capfd.readouterr().err) == active


# --- as a package -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The package, and its files beside it."""
    path = tmp_path_factory.mktemp("package") / "plugin.zip"
    assert main(["qgis", "package", f"--out={path}", *(f"--{key}={value}" for key, value in PUBLISHER.items())]) == 0
    with zipfile.ZipFile(path) as archive:
        archive.extractall(path.parent)
    return path


def test_the_package_keeps_to_the_rules_of_the_plugin_repository(package: Path) -> None:
    """Those that plugins.qgis.org checks when a package is handed in, and those that its reviewers ask for."""
    assert package.stat().st_size < 20e6
    with zipfile.ZipFile(package) as archive:
        names = archive.namelist()
    assert {name.split("/")[0] for name in names} == {NAME}  # one folder, of a name that Python can import
    assert re.fullmatch(r"[a-z][a-z0-9_]*", NAME)
    assert {f"{NAME}/{name}" for name in ("__init__.py", "metadata.txt", "help.html")} <= set(names)
    forbidden = rf"(^|/)(\.|__MACOSX|__pycache__|ui_)|\.(pyc|so|dll|exe)$|{runner.REMEMBERED}$"
    assert not [name for name in names if re.search(forbidden, name)]
    parser = configparser.ConfigParser(interpolation=None)
    parser.read_string((package.parent / NAME / "metadata.txt").read_text("utf-8"))
    general = parser["general"]
    assert all(general.get(key) for key in ("name", "description", "about", "author", "homepage"))
    assert (general["email"], general["tracker"]) == ("a@example.org", "https://example.org/t")
    assert all(general[key].startswith("https://") for key in ("homepage", "repository", "tracker"))
    assert general["version"] == roadgeo.__version__
    assert general["version"] in general["changelog"]
    assert not re.search(r"<\w+>", general["description"] + general["about"])
    flags = ("experimental", "deprecated", "hasProcessingProvider", "qgisMinimumVersion", "qgisMaximumVersion")
    assert [general[key] for key in flags] == ["False", "False", "yes", "3.22", "4.99"]
    assert general["category"] in {"Raster", "Vector", "Database", "Mesh", "Web"}
    assert (package.parent / NAME / general["icon"]).read_bytes().startswith(b"\x89PNG")
    assert (package.parent / NAME / "LICENSE").read_text() == (PACKAGE.parent / "LICENSE").read_text()


def test_the_same_plugin_is_the_same_package(package: Path, tmp_path: Path) -> None:
    write_package(tmp_path / "again.zip", PUBLISHER)
    assert (tmp_path / "again.zip").read_bytes() == package.read_bytes()


def test_the_package_brings_roadgeo_for_an_environment_of_its_own(package: Path, tmp_path: Path) -> None:
    """pip finds roadgeo at no index, and takes the wheel that lies in the plugin."""
    (wheel,), site = (package.parent / NAME).glob("*.whl"), tmp_path / "site"
    pip = [sys.executable, "-I", "-m", "pip"]  # a checkout that another test builds is none of its packages
    install = [*pip, "install", "-q", "--no-deps", "--no-index", f"--target={site}", str(wheel)]
    assert subprocess.run(install, cwd=tmp_path, check=False).returncode == 0
    here = {path.relative_to(PACKAGE.parent) for path in PACKAGE.rglob("*.*") if path.suffix != ".pyc"}
    assert here <= {path.relative_to(site) for path in site.rglob("*.*")}
    assert (site / "bin" / "roadgeo").is_file()


@pytest.mark.parametrize("command", ["flake8 --max-line-length=120 .", "bandit -q -r ."])
def test_the_scanner_of_the_plugin_repository_finds_nothing(command: str, package: Path) -> None:
    """It unpacks the package and runs these; bandit here with all of its tests, there with those of its choice."""
    arguments = [sys.executable, "-m", *command.split()]
    done = subprocess.run(arguments, cwd=package.parent / NAME, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "")


# --- its files --------------------------------------------------------------------------------------------------------


def test_every_algorithm_has_its_place_in_the_help_page() -> None:
    names = re.findall(r'NAME = "(\w+)"', (PLUGIN / "algorithms.py").read_text("utf-8"))
    page = (PLUGIN / "help.html").read_text("utf-8")
    assert len(names) == 8
    assert set(re.findall(r'<h2 id="(\w+)"', page)) == {*names, "mend"}
    assert not re.search("(src|href)=", page)  # it needs no network


@pytest.mark.parametrize("path", sorted(PLUGIN.glob("*.py")), ids=lambda path: path.name)
def test_the_plugin_is_written_for_every_qgis_from_3_22_to_qt_6(path: Path) -> None:
    """Python 3.9 is what QGIS 3.22 has on Windows; PyQt 6 knows enumerations by their scope only.

    The algorithms load without NumPy; only the panel needs it, which loads in a window: every QGIS has it there.
    """
    source = path.read_text("utf-8")
    tree = ast.parse(source, feature_version=(3, 9))
    imported = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    imported |= {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    in_a_window = path.name in ("dock.py", "placing.py", "refit.py")
    foreign = ("PyQt", "PySide", "roadgeo", *(() if in_a_window else ("numpy",)))
    assert not [name for name in imported if name and name.startswith(foreign)]
    assert not re.findall(r"\b(?:Qt|Qgis|Qgs\w+)\.(?:Type|Flag|[A-Z]\w*)\b(?![.(])", source)
