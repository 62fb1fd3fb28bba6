"""GDAL's own validator of GeoPackages, in the system's Python."""

import os
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

VALIDATOR = "osgeo_utils.samples.validate_gpkg"
PROGRAM = f"""
import sys
from {VALIDATOR} import main
sys.exit(max(main([sys.argv[0], "-k", "--extra", "--warning-as-error", path]) for path in sys.argv[1:]))
"""


@cache
def find_python() -> str:
    """A Python that has GDAL's: as a rule the system's."""
    for python in (sys.executable, "/usr/bin/python3"):
        if (
            shutil.which(python)
            and not subprocess.run([python, "-c", f"import {VALIDATOR}"], capture_output=True).returncode
        ):
            return python
    if os.environ.get("ROADGEO_REQUIRE_GDAL"):
        pytest.fail("ROADGEO_REQUIRE_GDAL is set, and python3-gdal is not installed")
    pytest.skip("no Python has GDAL's validator of GeoPackages: install python3-gdal")


def validate(*paths: Path) -> str:
    """What is wrong with GeoPackages, warnings included; "" where nothing is."""
    command = [find_python(), "-c", PROGRAM, *map(str, paths)]
    done = subprocess.run(command, capture_output=True, text=True, env={"PATH": os.environ["PATH"]})
    output = "".join(f"{line}\n" for line in (done.stdout + done.stderr).splitlines())
    assert bool(done.returncode) == bool(output)
    return output
