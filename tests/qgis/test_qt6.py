"""The plugin with PyQt6, as QGIS 4 has it: its modules, parameters and one run, in a Python that has PyQt6."""

import importlib.util
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from roadgeo.qgis.installation import install_plugin

CHILD = Path(__file__).parents[1] / "support" / "plugin_on_qt6.py"
LOCATION = {
    "status": "located",
    "reason": "well",
    "center": {"lon": -8.6, "lat": 41.15},
    "gsd_m": 1.0,
    "rotation_deg": 3.0,
    "log10_odds": 30.0,
    "reference": "town",
}


@pytest.fixture(scope="module")
def python() -> str:
    """A Python that has PyQt6: the one that ROADGEO_QT6_PYTHON names, or this one."""
    named = os.environ.get("ROADGEO_QT6_PYTHON")
    if named is None and importlib.util.find_spec("PyQt6") is None:
        pytest.skip("ROADGEO_QT6_PYTHON names no Python with PyQt6 (pip install PyQt6)")
    return named or sys.executable


@pytest.fixture(scope="module")
def plugin(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The plugin as it is installed."""
    return install_plugin(tmp_path_factory.mktemp("profile"))


def run(python: str, plugin: Path, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run it with a program that says what roadgeo would of a mask that was located."""
    found = folder / "found"
    found.mkdir()
    (found / "mask_report.html").touch()
    (folder / "mask.png").touch()
    program = folder / "roadgeo"
    program.write_text(f"#!{sys.executable}\nprint({json.dumps(json.dumps(LOCATION))})\n", "utf-8")
    program.chmod(0o755)
    environ = {**os.environ, "ROADGEO_EXECUTABLE": str(program), "QT_QPA_PLATFORM": "offscreen"}
    command = [python, str(CHILD), str(plugin), str(folder / "mask.png"), str(found)]
    return subprocess.run(command, capture_output=True, text=True, check=False, env=environ, timeout=60)


def test_it_loads_runs_and_unloads(python: str, plugin: Path, tmp_path: Path) -> None:
    done = run(python, plugin, tmp_path)
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout)
    assert len(answer["algorithms"]) == 8
    for name, (help_page, parameters, outputs, folded, _) in answer["algorithms"].items():
        assert help_page.startswith("file:///")
        assert help_page.endswith(f"help.html#{name}")
        assert parameters > 2
        assert outputs or name == "buildreference"
        assert folded
    assert answer["results"]["STATUS"] == "located"
    assert answer["layers"] == ["mask matches", "mask residuals × 20", "mask roads", "mask footprint", "mask"]
    assert answer["told"] == ["locatemask", "mask", "located"]
    assert answer["pages"] == [str(tmp_path / "found" / "mask_report.html")]


#: A program that adds a row to the table of hints, installs the plugin, and lists what the other faces make of it.
ANOTHER_ROW = """
import json, sys
from pathlib import Path
from roadgeo.matching.hints import HINTS, Hint
schema = {"type": "number", "minimum": 0, "maximum": 1}
HINTS["cloud"] = Hint("cloud", "cloud_share", "SHARE", "Clouds", "How much they hide.", float, schema, 0.1)
import roadgeo
from roadgeo.cli.locate import locate_command
from roadgeo.qgis.installation import install_plugin
from roadgeo.serving.requests import read_query_string
options = {name: one.help for one in locate_command.params for name in one.opts}
print(json.dumps([options.get("--cloud"), read_query_string("cloud=0.5"), str(install_plugin(Path(sys.argv[1])))]))
"""


def test_a_new_row_of_the_table_is_an_option_everywhere(python: str, tmp_path: Path) -> None:
    """On the command line, over HTTP and in QGIS by itself; `test_options` asks for the keyword of Python."""
    command = [sys.executable, "-c", ANOTHER_ROW, str(tmp_path)]
    made = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert made.returncode == 0, made.stderr
    typed, read, plugin = json.loads(made.stdout)
    assert typed == "How much they hide. Default: 0.1."
    assert read == {"cloud_share": 0.5}
    done = run(python, Path(plugin), tmp_path)
    assert done.returncode == 0, done.stderr
    algorithms = json.loads(done.stdout)["algorithms"]
    for name in ("locatemask", "locatemasks", "georeferenceimage"):
        assert algorithms[name][-1]["CLOUD"] == "Number"
        assert algorithms[name][-1]["EFFORT"] == "Enum"


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        ("parameters.py", "QgsProcessingParameterNumber.Type.Double", "QgsProcessingParameterNumber.Double"),
        ("session.py", "from qgis.PyQt import sip", "import sip"),
        ("dock.py", "QDockWidget,", "QDockWidget, QDesktopWidget,"),
        ("places.py", "QHeaderView.ResizeMode.Stretch", "QHeaderView.Stretch"),
    ],
)
def test_what_only_pyqt5_knows_is_found(
    python: str, plugin: Path, tmp_path: Path, file: str, old: str, new: str
) -> None:
    other = tmp_path / "other_plugin"
    shutil.copytree(plugin, other, ignore=shutil.ignore_patterns("__pycache__"))
    text = (other / file).read_text("utf-8")
    assert old in text
    (other / file).write_text(text.replace(old, new), "utf-8")
    done = run(python, other, tmp_path)
    assert done.returncode == 1
    assert "Error" in done.stderr
