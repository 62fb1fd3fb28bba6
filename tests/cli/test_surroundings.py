"""What is wrong with the machine: PROJ's data missing, a clock that jumps, no fonts."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import rasterio
from worlds.demo import DRONE

from roadgeo.cli import main
from roadgeo.errors import OutputError
from roadgeo.storage.gdal import forget_missing_proj_data
from roadgeo.storage.rasters import writing_raster
from roadgeo.workflows import locate


def test_proj_data_that_are_not_where_the_environment_says_are_looked_for_elsewhere(
    porto: Path, tmp_path: Path
) -> None:
    environment = {**os.environ, "PROJ_DATA": str(tmp_path), "PROJ_LIB": "/nowhere"}
    command = [sys.executable, "-m", "roadgeo", "locate", str(DRONE), "-r", str(porto), "-o", str(tmp_path), "--json"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    with rasterio.open(tmp_path / "drone_footprint.tif") as footprint:
        assert footprint.crs.to_string() == json.loads(done.stdout)["crs"]


def test_proj_data_that_are_there_are_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "proj.db").touch()
    monkeypatch.setenv("PROJ_DATA", f"/nowhere{os.pathsep}{tmp_path}")
    monkeypatch.setenv("PROJ_LIB", "")
    forget_missing_proj_data()
    assert os.environ["PROJ_DATA"].endswith(str(tmp_path))
    assert "PROJ_LIB" not in os.environ


def test_without_any_proj_data_the_remedy_is_told() -> None:
    said = r"cannot write a\.tif: .*; PROJ's data are missing: unset PROJ_DATA"
    with pytest.raises(OutputError, match=said), writing_raster("a.tif"):
        raise rasterio.errors.CRSError("The EPSG code is unknown. PROJ: Cannot find proj.db")


@pytest.mark.parametrize("jump_s", [-1e9, 1e9])
def test_a_clock_that_jumps_changes_nothing(
    porto: Path, tmp_path: Path, jump_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    from roadgeo import open_reference

    kept = locate(DRONE, open_reference(porto))
    jumps = iter(range(1, 1_000_000))
    real = time.time
    monkeypatch.setattr(time, "time", lambda: real() + jump_s * next(jumps))
    found = locate(DRONE, open_reference(porto))
    np.testing.assert_array_equal(found.homography, kept.homography)
    assert found.reason == kept.reason


def test_no_font_is_needed_but_those_that_come_along(
    porto: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FONTCONFIG_FILE", "/nowhere")
    monkeypatch.setenv("FONTCONFIG_PATH", "/nowhere")
    command = ["locate", str(DRONE), "-r", str(porto), "-o", str(tmp_path), "--plot", "--explain"]
    assert main(command) == 0
    for name in ("drone_overlay.png", "drone_explain.png"):
        assert (tmp_path / name).stat().st_size > 1000


def test_further_processes_import_nothing_from_the_current_folder(porto: Path, tmp_path: Path) -> None:
    here, program = tmp_path / "here", tmp_path / "bin" / "roadgeo"
    for folder in (here, program.parent):
        folder.mkdir()
    program.write_text("if __name__ == '__main__':\n    from roadgeo.cli import main\n\n    raise SystemExit(main())\n")
    for module in ("multiprocessing", "numba", "signal"):
        (here / f"{module}.py").write_text("open('ran', 'w').close()\nraise SystemExit(3)\n")
    masks = [str(DRONE), str(DRONE.with_name("segmenter.png"))]
    command = [sys.executable, program, "locate", *masks, "-r", str(porto), "--jobs", "2", "-o", "out", "--json"]
    done = subprocess.run(command, cwd=here, capture_output=True, text=True, timeout=300)
    assert not (here / "ran").exists()
    assert len(done.stdout.splitlines()) == 2, done.stderr
