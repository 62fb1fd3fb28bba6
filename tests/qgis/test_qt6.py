"""The plugin with PyQt6, as QGIS 4 has it: its modules, parameters and widgets, in a Python that has PyQt6."""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from roadgeo.qgis.installation import install_plugin

CHILD = Path(__file__).parents[1] / "support" / "plugin_on_qt6.py"


@pytest.fixture(scope="module")
def python() -> str:
    """A Python that has PyQt6 and NumPy: the one that ROADGEO_QT6_PYTHON names, or this one."""
    named = os.environ.get("ROADGEO_QT6_PYTHON")
    if named is None and importlib.util.find_spec("PyQt6") is None:
        pytest.skip("ROADGEO_QT6_PYTHON names no Python with PyQt6 (pip install PyQt6)")
    return named or sys.executable


@pytest.fixture(scope="module")
def plugin(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The plugin as it is installed."""
    return install_plugin(tmp_path_factory.mktemp("profile"))


def run(python: str, plugin: Path) -> subprocess.CompletedProcess[str]:
    environ = {**os.environ, "QT_QPA_PLATFORM": "offscreen"}
    command = [python, str(CHILD), str(plugin)]
    return subprocess.run(command, capture_output=True, text=True, check=False, env=environ, timeout=60)


def test_all_of_it_loads_and_its_widgets_open(python: str, plugin: Path) -> None:
    done = run(python, plugin)
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout)
    assert len(answer["algorithms"]) == 8
    assert answer["status"].startswith("Open a picture")
    assert answer["rows"] == 1


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
    done = run(python, Path(plugin))
    assert done.returncode == 0, done.stderr
    algorithms = json.loads(done.stdout)["algorithms"]
    for name in ("locatemask", "locatemasks", "georeferenceimage"):
        assert algorithms[name]["CLOUD"] == "QgsProcessingParameterNumber"
        assert algorithms[name]["EFFORT"] == "QgsProcessingParameterEnum"
