"""The same input gives the same result bit for bit: in any order, with any number of processes and threads."""

import json
import os
import subprocess
import sys
from pathlib import Path

import cv2
from worlds.demo import MASKS

from roadgeo.evaluation.demo import PHOTO

PATHS = [MASKS[name].path for name in ("drone", "elsewhere", "map_sheet")]
#: The number of processors, for as many threads does the network take, and then a command.
CODE = """
import os, sys
os.cpu_count = lambda: int(sys.argv[1])
from roadgeo.cli import main
sys.exit(main(sys.argv[2:]) == 1)
"""


def answers(porto: Path, out: Path, masks: list[Path], *more: str, threads: int = 1) -> dict[str, object]:
    """Locate masks in a process of its own; return all that is told of each, but for seconds and the command."""
    names = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
    environment = {**os.environ, **dict.fromkeys(names, str(threads)), "PYTHONHASHSEED": str(threads)}
    more = more if "--effort" in more else ("--effort", "quick", *more)
    command = ["locate", *map(str, masks), "-r", str(porto), "-o", str(out), "--json", "-q", *more]
    done = subprocess.run(
        [sys.executable, "-c", CODE, str(threads), *command],
        env=environment,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    output = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(output) == len(masks)
    for entry in output:
        del entry["seconds"], entry["command"]
    return {item["query"]: item for item in output}


def test_order_processes_and_threads_change_nothing(porto: Path, tmp_path: Path) -> None:
    once = answers(porto, tmp_path / "a", PATHS)
    assert {item["status"] for item in once.values()} == {"located", "not_located"}
    assert answers(porto, tmp_path / "b", PATHS[::-1], "--jobs", "3", threads=4) == once


def test_threads_search_for_one_mask_as_one_does(porto: Path, tmp_path: Path) -> None:
    """With all that is tried for a mask that has no place."""
    elsewhere = [mask for mask in PATHS if mask.stem == "elsewhere"]
    once = answers(porto, tmp_path / "a", elsewhere, "--effort", "full")
    assert answers(porto, tmp_path / "b", elsewhere, "--effort", "full", "--jobs", "3") == once


def test_photographs_too(porto: Path, tmp_path: Path) -> None:
    """One is met twice, and onnxruntime has one thread or three."""
    whole = cv2.imread(str(PHOTO))
    photos = [tmp_path / name for name in ("left.png", "right.png", "left_again.png")]
    for path, part in zip(photos, (whole[:608, :768], whole[-608:, -768:], whole[:608, :768]), strict=True):
        cv2.imwrite(str(path), part)
    hints = ("--gsd", "0.9:1.1")
    once = answers(porto, tmp_path / "a", photos[:2], *hints)
    left, right = (once[str(path)] for path in photos[:2])
    assert left["n_intersections"] > 10
    again = answers(porto, tmp_path / "b", photos[:0:-1], *hints, "--jobs", "2", threads=3)
    assert again == {str(photos[2]): {**left, "query": str(photos[2])}, str(photos[1]): right}
