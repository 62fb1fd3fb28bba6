"""Where machine code is kept: never in the package, and somewhere in every installation."""

import ctypes
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


def drop_override() -> None:
    """Let permission bits hold for root, too: on Linux, drop CAP_DAC_OVERRIDE from what a child may have."""
    ctypes.CDLL(None).prctl(24, 1, 0, 0, 0)


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


def compute(site: Path, home: Path, **more: str) -> list[str]:
    """Run a kernel of the copy in a process of its own, and return the two paths it prints."""
    environment = {
        "PATH": os.environ["PATH"],
        "HOME": str(home),
        "PYTHONPATH": str(site),
        "PYTHONDONTWRITEBYTECODE": "1",
        **more,
    }
    done = subprocess.run(
        [sys.executable, "-c", COMPUTE],
        env=environment,
        cwd=site,
        capture_output=True,
        text=True,
        preexec_fn=drop_override if sys.platform == "linux" else None,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert Path(lines[0]).is_relative_to(site)
    return lines


@pytest.mark.slow
def test_nothing_is_left_in_the_package(installed: Path, tmp_path: Path) -> None:
    before = sorted(installed.rglob("*"))
    home = tmp_path / "home"
    home.mkdir()
    folder = Path(compute(installed, home)[1])
    assert sorted(installed.rglob("*")) == before
    assert folder.is_relative_to(home)
    assert any(p.is_file() for p in folder.rglob("*"))


@pytest.mark.slow
def test_a_read_only_installation_without_a_home_computes(installed: Path, tmp_path: Path) -> None:
    home, temporary = tmp_path / "home", tmp_path / "temporary"
    home.mkdir()
    temporary.mkdir()
    for path in [home, installed, *installed.rglob("*")]:
        path.chmod(0o555 if path.is_dir() else 0o444)
    folder = Path(compute(installed, home, TMPDIR=str(temporary))[1])
    assert folder.is_relative_to(temporary)
    assert folder.stat().st_uid == os.getuid()
    for path in [home, installed, *installed.rglob("*")]:  # so that it can be removed
        path.chmod(0o755 if path.is_dir() else 0o644)
