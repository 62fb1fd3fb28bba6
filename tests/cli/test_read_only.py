"""A read-only installation, without a home that can be written: masks are located all the same."""

import ctypes
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from worlds.demo import DRONE

import roadgeo
from roadgeo.kernels.compilation import compiled, kernel_folder
from roadgeo.kernels.warmup import warm_up

CODE = "import sys, roadgeo.cli; print(roadgeo.__file__); sys.exit(roadgeo.cli.main())"


def drop_override() -> None:
    """Let permission bits hold for root, too: drop CAP_DAC_OVERRIDE from what a child may have."""
    ctypes.CDLL(None).prctl(24, 1, 0, 0, 0)


@pytest.mark.skipif(sys.platform != "linux", reason="permission bits do not hold for root elsewhere")
def test_a_mask_is_located(porto: Path, tmp_path: Path) -> None:
    maps, site, temporary, home, out = (tmp_path / name for name in ("maps", "site", "temporary", "home", "out"))
    shutil.copytree(Path(roadgeo.__file__).parent, site / "roadgeo", ignore=shutil.ignore_patterns("__pycache__"))
    for folder in (maps, temporary, home, out):
        folder.mkdir()
    for part in (porto, porto.with_suffix(".index")):
        shutil.copy(part, maps)
    # What an earlier run has compiled; to compile it here would take a minute.
    warm_up()
    assert compiled()
    kept = temporary / f"roadgeo-{os.getuid()}"
    kept.mkdir(mode=0o700)
    shutil.copytree(kernel_folder(), kept / kernel_folder().name)
    locked = [site, home, maps, *site.rglob("*"), *maps.iterdir()]
    for path in locked:
        path.chmod(0o555 if path.is_dir() else 0o444)
    command = ["locate", str(DRONE), "-r", str(maps / "porto.gpkg"), "-o", str(out), "--json", "--report"]
    environment = {"PATH": os.environ["PATH"], "HOME": str(home), "PYTHONPATH": str(site), "TMPDIR": str(temporary)}
    try:
        done = subprocess.run(
            [sys.executable, "-c", CODE, *command],
            env=environment, cwd=out, capture_output=True, text=True, preexec_fn=drop_override, timeout=300,
        )  # fmt: skip
    finally:  # so that it can be removed
        for path in locked:
            path.chmod(0o755 if path.is_dir() else 0o644)
    assert done.returncode == 0, done.stderr
    where, answer = done.stdout.splitlines()
    assert Path(where).is_relative_to(site)
    assert json.loads(answer)["status"] == "located"
    assert (out / "drone_report.html").stat().st_size
    assert not list(home.iterdir())
    assert "warning" not in done.stderr.lower()
