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
