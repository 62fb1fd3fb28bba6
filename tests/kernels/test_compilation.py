"""Where machine code is kept: never in the package, and somewhere in every installation."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import roadgeo

COMPUTE = """
import numpy as np, roadgeo
from roadgeo.kernels.adjustment import cholesky
assert cholesky(np.eye(2), np.empty((2, 2)))
from roadgeo.kernels.compilation import kernel_folder
print(roadgeo.__file__, kernel_folder(), sep="\\n")
"""


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """A copy of the package, as an installation has it."""
    site = tmp_path / "site"
    shutil.copytree(
        Path(roadgeo.__file__).parent,
        site / "roadgeo",
        ignore=shutil.ignore_patterns("__pycache__", "data"),
    )
    return site


def compute(site: Path, home: Path) -> list[str]:
    """Run a kernel of the copy in a process of its own, and return the two paths it prints."""
    environment = {
        "PATH": os.environ["PATH"],
        "HOME": str(home),
        "PYTHONPATH": str(site),
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    done = subprocess.run(
        [sys.executable, "-c", COMPUTE],
        env=environment,
        cwd=site,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert Path(lines[0]).is_relative_to(site)
    return lines


def test_nothing_is_left_in_the_package(installed: Path, tmp_path: Path) -> None:
    before = sorted(installed.rglob("*"))
    home = tmp_path / "home"
    home.mkdir()
    folder = Path(compute(installed, home)[1])
    assert sorted(installed.rglob("*")) == before
    assert folder.is_relative_to(home)
    assert any(p.is_file() for p in folder.rglob("*"))
