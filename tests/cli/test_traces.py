"""What a command leaves behind, as the system sees it: no connection, and no file but its outputs and our cache."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from support.read_all import BEGIN
from worlds.demo import DRONE

from roadgeo.evaluation.demo import ROADS
from roadgeo.outputs.registry import ALSO
from roadgeo.storage.folders import cache_dir

#: System calls that make, change or move a file.
_CHANGES = (
    *("creat", "mkdir", "mkdirat", "mknod", "mknodat", "rename", "renameat", "renameat2"),
    *("link", "linkat", "symlink", "symlinkat", "truncate"),
)
#: What the system and Python look at at any time.
_SYSTEM = ("/proc", "/sys", "/dev/null", "/dev/urandom", "/etc", "/usr/share", "/usr/lib", "/lib")
_TRACE = ["strace", "-f", "-qq", "-y", "--seccomp-bpf", "-s", "4096"]


@pytest.fixture(scope="module", autouse=True)
def tracer() -> None:
    traced = shutil.which("strace") and subprocess.run([*_TRACE, "true"], capture_output=True, check=False)
    if not traced or traced.returncode:
        assert not os.environ.get("ROADGEO_REQUIRE_STRACE"), "strace is missing, or must not trace"
        pytest.skip("strace is missing, or must not trace")


def traced(folder: Path, *command: str) -> tuple[list[str], list[Path]]:
    """Run a command whose home and temporary folder lie apart.

    Returns the system calls that have to do with a network, and the paths of all files made, changed or moved.
    """
    for name in ("home", "temporary"):
        (folder / name).mkdir()
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("XDG_", "ORT_", "MPL"))}
    environment |= {"HOME": str(folder / "home"), "TMPDIR": str(folder / "temporary"), "PYTHONDONTWRITEBYTECODE": "1"}
    environment |= {"ROADGEO_CACHE": str(cache_dir())}  # kernels are there
    calls = ",".join(["%network", "openat", "open", "chdir", *_CHANGES])
    program = [*_TRACE, "-o", "trace.txt", "-e", f"trace={calls}", sys.executable, "-m", "roadgeo", *command]
    done = subprocess.run(program, cwd=folder, env=environment, capture_output=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr.decode()
    lines = [line.split(maxsplit=1)[1] for line in (folder / "trace.txt").read_text("utf-8", "replace").splitlines()]
    made = [line for line in lines if " = -1 " not in line]
    opened = [line for line in made if re.search(r"^open.*\bO_(WRONLY|RDWR|CREAT)\b", line)]
    changed = [line for line in made if line.partition("(")[0] in _CHANGES]
    assert not [line for line in made if line.startswith("chdir")]  # else relative paths lie elsewhere
    paths = [path for line in (*opened, *changed) for path in _paths(line, folder)]
    others = ("open", "chdir", "+++", "---", "<...", *_CHANGES)
    return [line for line in lines if not line.startswith(others)], paths


def _paths(line: str, folder: Path) -> list[Path]:
    """Return the paths in a call; those given below an open folder are below that."""
    parts = re.findall(r'(?:(?:AT_FDCWD|\d+)<([^>]*)>, )?"((?:[^"\\]|\\.)*)"', line)
    return [folder / base / name for base, name in parts]


def strays(paths: list[Path], folder: Path) -> list[Path]:
    """Return the paths that are neither of the outputs nor of the cache, nor temporary and gone."""
    assert not [*(folder / "temporary").iterdir()]
    allowed = (folder / "out", folder / "temporary", cache_dir(), Path("/dev/null"))
    return [path for path in paths if not any(path.is_relative_to(item) for item in allowed)]


def test_a_photograph_reaches_nobody_and_leaves_only_its_outputs(porto: Path, tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    photo = str(DRONE.with_name("drone_photo.jpg"))
    asked, paths = traced(tmp_path, "locate", photo, "-r", str(porto), "-o", "out", "-q")
    assert any(path.name.endswith(".json") for path in paths)
    assert not strays(paths, tmp_path)
    assert not asked


def test_a_map_is_built_offline(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    asked, paths = traced(tmp_path, "index", "--roads", str(ROADS), "--out", "out/porto.gpkg", "-q")
    assert not strays(paths, tmp_path)
    assert not asked


def test_no_output_leaves_more_than_itself(porto: Path, tmp_path: Path) -> None:
    also = [word for name in ALSO for word in ("--also", name)]
    asked, paths = traced(
        tmp_path, "locate", str(DRONE), "-r", str(porto), "-o", "out", "-q", "--plot", "--report", "--explain", *also
    )
    assert any(path.name.endswith(".kmz") for path in paths)
    assert not strays(paths, tmp_path)
    assert not asked


def test_readers_open_nothing_but_their_files(tmp_path: Path) -> None:
    """Maps, rasters, models, references and locations of the corpus: many of them name files, pipes and servers."""
    program = Path(__file__).parents[1] / "support" / "read_all.py"
    environment = os.environ | {"TMPDIR": str(tmp_path), "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    environment |= {"HOME": str(tmp_path), "ROADGEO_CACHE": str(cache_dir()), "GDAL_DRIVER_PATH": "disable"}
    (tmp_path / "files").mkdir()
    command = [*_TRACE, "-o", str(tmp_path / "trace.txt"), "-e", "trace=%network,open,openat,stat,newfstatat"]
    read = [sys.executable, str(program), str(tmp_path / "files")]
    subprocess.run([*command, *read], cwd=tmp_path, env=environment, timeout=900, check=True)
    lines = (tmp_path / "trace.txt").read_text("utf-8", "replace").splitlines()
    start = next(n for n, line in enumerate(lines) if BEGIN in line)
    calls = [line.split(maxsplit=1)[1] for line in lines[start + 1 :]]
    done = [line for line in calls if " = -1 " not in line]
    opened = [path for line in done if line.startswith("open") for path in _paths(line, tmp_path)]
    folders = (sys.prefix, sys.base_prefix, *filter(None, sys.path), tmp_path, Path(__file__).parents[2])
    own = [Path(path) for path in (*folders, cache_dir(), *_SYSTEM)]
    assert any(path.name == "roads.shp" for path in opened)
    assert not {str(path) for path in opened if not any(path.is_relative_to(item) for item in own)}
    assert not [line for line in calls if not line.startswith(("open", "stat", "newfstatat", "+++", "---", "<..."))]
    assert not [line for line in done if "/nowhere" in line]
