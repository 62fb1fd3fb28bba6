"""Memory of many small objects, and of mapped files, goes back to the system."""

import mmap
import platform
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from roadgeo.storage.memory import let_pages_go

CODE = """
import numpy, shapely
from roadgeo.storage.memory import give_back_memory

def resident_mb():
    with open("/proc/self/status") as file:
        return int(file.read().split("VmRSS:")[1].split()[0]) / 1024

give_back_memory()
before = resident_mb()
lines = shapely.linestrings(numpy.zeros((400_000, 2, 2)))
kept = lines[::5000].copy()
del lines
give_back_memory()
print(resident_mb() - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library")
def test_freed_geometries_leave_hardly_anything() -> None:
    output = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True).stdout
    assert float(output) < 50.0  # of 98
    assert float(output) > -5.0


def resident_mb() -> float:
    return int(Path("/proc/self/status").read_text().split("RssFile:")[1].split()[0]) / 1024


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="it asks Linux for what is resident")
def test_pages_of_a_mapped_file_are_let_go_and_come_back(tmp_path) -> None:
    values = np.arange(8_000_000, dtype=np.int64)
    values.tofile(tmp_path / "values")
    with (tmp_path / "values").open("rb") as file:
        mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    views = [np.ndarray((2_000_000, 4), np.int64, buffer=mapped)[k:, 1:] for k in range(2)]
    total = views[0].sum()
    before = resident_mb()
    let_pages_go([*views, values, values[3:].view(np.uint8), np.frombuffer(b"abcd", np.uint8)])
    assert before - resident_mb() > 55.0
    assert views[0].sum() == total


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="it asks Linux for what is resident")
def test_what_lies_beside_it_in_the_file_stays(tmp_path) -> None:
    np.arange(8_000_000, dtype=np.int64).tofile(tmp_path / "values")
    with (tmp_path / "values").open("rb") as file:
        mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    first, second = (np.frombuffer(mapped, np.int64, 4_000_000 - 7, start) for start in (0, 32_000_000))
    total = first.sum() + second.sum()
    before = resident_mb()
    let_pages_go([second, second[:0], second[5:6]])
    assert 25.0 < before - resident_mb() < 35.0
    assert first.sum() + second.sum() == total
