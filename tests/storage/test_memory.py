"""Memory: readers of strangers' files take a bounded amount; that of small objects, and of mapped files, goes back."""

import gzip
import json
import mmap
import platform
import subprocess
import sys
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path

import geopandas as gpd
import numpy as np
import pytest
import rasterio
import shapely
from worlds.osm_files import varint
from worlds.turned import mark_turned

from roadgeo.errors import RoadSourceError
from roadgeo.storage.fence import abi_version
from roadgeo.storage.memory import _allowance, bounded, let_pages_go

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


# --- bombs ------------------------------------------------------------------------------------------------------------

READ = """
import re, sys
from pathlib import Path
import roadgeo
from roadgeo.errors import RoadgeoError
from roadgeo.sources.masks import read_mask
from roadgeo.sources.roads import read_roads
from roadgeo.sources.segmentation.onnx_file import open_onnx
assert roadgeo.fence(sys.argv[1])
reads = {".parquet": lambda path: read_roads(path, which="all"), ".gz": open_onnx}
try:
    reads.get(Path(sys.argv[1]).suffix, read_mask)(sys.argv[1])
except RoadgeoError as error:
    print(error)
print(int(re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]) // 1024)
"""


def bomb(path: Path, which: str) -> None:
    """Write a Parquet file of some kB: with millions of rows of nothing, or the same MB again and again."""
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    rows, groups = (1_000_000, 5) if which == "null" else (100, 40)
    line = pa.array([shapely.to_wkb(shapely.LineString([(0, 0), (1, 1)]))] * rows, pa.binary())
    long = pa.array([b"x" * 1_000_000], {"fixed": pa.binary(1_000_000)}.get(which, pa.binary()))
    columns = {
        "geometry": pa.nulls(rows, pa.binary()) if which == "null" else line,
        "name": pa.nulls(rows, pa.string()) if which == "null" else long.take(pa.array(np.zeros(rows, np.int32))),
    }
    geo = {"version": "1.0.0", "primary_column": "geometry", "columns": {"geometry": {"encoding": "WKB"}}}
    table = pa.table(columns).replace_schema_metadata({b"geo": json.dumps(geo).encode()})
    with pq.ParquetWriter(path, table.schema, compression="zstd") as file:
        for _ in range(groups):
            file.write_table(table)


def in_one_block(path: Path) -> None:
    """Write a raster that is decoded whole."""
    how = {"width": 20_000, "height": 20_000, "count": 1, "dtype": "float64", "transform": rasterio.Affine.scale(2)}
    with rasterio.open(path, "w", "GTiff", **how, blockysize=20_000, compress="deflate", sparse_ok=True):
        pass


def to_be_turned(path: Path) -> None:
    """Write a raster that is kept in memory, for its orientation."""
    how = {"width": 60_000, "height": 60_000, "count": 1, "dtype": "uint8", "transform": rasterio.Affine.scale(2)}
    with rasterio.open(path, "w", "GTiff", **how, tiled=True, compress="deflate", sparse_ok=True):
        pass
    mark_turned(path, 8)


def of_nothing(path: Path) -> None:
    """Write a model of millions of operators of two bytes each."""
    path.write_bytes(gzip.compress(tagged(7, tagged(1, b"") * 40_000_000)))


def tagged(field: int, content: bytes) -> bytes:
    return varint(8 * field + 2) + varint(len(content)) + content


BOMBS: dict[str, tuple[str, Callable[[Path], None], str]] = {
    "null": ("roads.parquet", partial(bomb, which="null"), "bytes claim to hold 5,000,000 rows"),
    "fixed": ("roads.parquet", partial(bomb, which="fixed"), "takes more than"),
    "text": ("roads.parquet", partial(bomb, which="text"), "takes more than"),
    "block": ("mask.tif", in_one_block, "takes more than"),
    "turned": ("mask.tif", to_be_turned, "takes more than"),
    "model": ("model.onnx.gz", of_nothing, "unpacks to more than 4 times its size"),
}


@pytest.mark.skipif(not abi_version(), reason="only inside a fence, which this system has not")
@pytest.mark.parametrize("which", BOMBS)
def test_few_bytes_that_stand_for_many_end_in_a_line(which: str, tmp_path: Path) -> None:
    name, write, message = BOMBS[which]
    write(tmp_path / name)
    assert (tmp_path / name).stat().st_size < 1_000_000
    command = [sys.executable, "-c", READ, str(tmp_path / name)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    said, megabytes = done.stdout.strip().splitlines()
    assert message in said
    assert int(megabytes) < 1500


@pytest.mark.skipif(not abi_version(), reason="only inside a fence, which this system has not")
def test_a_small_file_is_read_within_its_bound(tmp_path: Path) -> None:
    """Arrow's usual allocator reserves 1 GB, as much as a small file may take."""
    lines = shapely.linestrings(np.random.default_rng(1).uniform(0.0, 1.0, (20_000, 2, 2)))
    columns = {"highway": ["residential"] * len(lines)}
    gpd.GeoDataFrame(columns, geometry=lines, crs=4326).to_parquet(tmp_path / "roads.parquet")
    command = [sys.executable, "-c", READ, str(tmp_path / "roads.parquet")]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    assert int(done.stdout) < 1500


def test_readers_in_several_threads_leave_the_limit_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever begins first ends first."""
    resource = pytest.importorskip("resource")
    monkeypatch.setenv("ROADGEO_MEMORY", "50")
    before, both = resource.getrlimit(resource.RLIMIT_DATA), threading.Barrier(2, timeout=60)

    def read() -> None:
        with bounded("b.osm"):
            both.wait()
            both.wait()
        both.wait()

    with bounded("a.osm"):
        other = threading.Thread(target=read)
        other.start()
        both.wait()
    assert resource.getrlimit(resource.RLIMIT_DATA) != before
    both.wait()
    both.wait()
    other.join()
    assert resource.getrlimit(resource.RLIMIT_DATA) == before


def test_the_bound_goes_with_the_file_and_is_the_users(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "small").write_bytes(bytes(1_000_000))
    monkeypatch.setattr("roadgeo.storage.memory._available_bytes", lambda: 1 << 40)
    assert _allowance(tmp_path / "small") == (1 << 30) + 100_000_000
    monkeypatch.setattr("roadgeo.storage.memory._available_bytes", lambda: 1 << 30)
    assert _allowance(tmp_path / "small") == 1 << 29
    monkeypatch.setenv("ROADGEO_MEMORY", "2.5")
    assert _allowance(tmp_path / "small") == 2_500_000_000


@pytest.mark.parametrize(
    "error", [MemoryError(), RuntimeError("std::bad_alloc"), RoadSourceError("a.osm: Out of memory")]
)
def test_whoever_reads_may_say_in_its_own_words_that_memory_is_short(
    monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    monkeypatch.setenv("ROADGEO_MEMORY", "8")
    with (
        pytest.raises(RoadSourceError, match=r"a\.osm: takes more than 8\.0 GB of memory to read; .*--memory"),
        bounded("a.osm"),
    ):
        raise error
    with pytest.raises(RoadSourceError, match="damaged"), bounded("a.osm"):
        raise RoadSourceError("a.osm: damaged")
