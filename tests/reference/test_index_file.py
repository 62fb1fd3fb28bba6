"""The index file: round trip, and every way in which one can be damaged or hostile."""

import errno
import io
import json
import os
import pickle
import struct
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from roadgeo.errors import IndexFormatError, RoadgeoError
from roadgeo.reference import index_file, plain_values
from roadgeo.reference.index_file import FORMAT_VERSION, check_index, read_index, read_manifest, write_index

META = {"name": "Böston", "origin": [330000.0, 4690000], "flags": [True, None, -1, 2**40], "options": {"n": 8}}
ARRAYS = {
    "xy": np.arange(300.0).reshape(150, 2),
    "empty": np.empty((0, 3), np.float32),
    "scalar": np.array(7, np.int16),
    "ids": np.arange(100_000, dtype=np.int32),
    "flags": np.array([True, False, True]),
    "codes": np.arange(2000, dtype=np.uint64).reshape(10, 20, 10)[::2],
    "big_endian": np.arange(5, dtype=">f4"),
}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    write_index(tmp_path / "town.index", META, ARRAYS, {"name": "Böston", "n": 150})
    return tmp_path / "town.index"


def sections(path: Path) -> tuple[dict[str, Any], bytes]:
    """Manifest and data section of a file."""
    raw = path.read_bytes()
    size = struct.unpack_from("<I", raw, 20)[0]
    return json.loads(raw[64 : 64 + size]), raw[index_file._aligned(64 + size) :]


def forge(path: Path, manifest: Any, data: bytes) -> None:
    """Write a file whose header digest is right, whatever the manifest says."""
    header = index_file._header(manifest if isinstance(manifest, bytes) else json.dumps(manifest).encode())
    path.write_bytes(header + bytes(-len(header) % 64) + data)


def forge_pickle(path: Path, pickled: bytes) -> None:
    """Replace the pickle by another one with the right digest, and drop the arrays."""
    manifest, _ = sections(path)
    manifest |= {
        "arrays": [],
        "size": index_file._aligned(len(pickled)),
        "pickle": {"size": len(pickled), "digest": index_file._digest(pickled)},
    }
    forge(path, manifest, pickled + bytes(-len(pickled) % 64))


# --- what is written comes back ---------------------------------------------------------------------------------------


def test_round_trip(path: Path) -> None:
    meta, arrays = read_index(path)
    assert meta == META
    assert list(arrays) == list(ARRAYS)
    for name, array in ARRAYS.items():
        assert arrays[name].dtype == array.dtype.newbyteorder("<")
        np.testing.assert_array_equal(arrays[name], array)
        assert not arrays[name].flags.writeable
        assert arrays[name].ctypes.data % 64 == 0
    assert check_index(path) == []


def test_manifest_is_read_without_unpickling(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plain_values, "PlainUnpickler", None)
    manifest = read_manifest(path)
    assert manifest["about"] == {"name": "Böston", "n": 150}
    assert [entry["name"] for entry in manifest["arrays"]] == list(ARRAYS)


plain = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=30,
)


@given(
    meta=st.dictionaries(st.text(), plain, max_size=5),
    array=hnp.arrays(st.sampled_from(list(index_file._DTYPES.values())), hnp.array_shapes(min_dims=0, min_side=0)),
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_plain_values_and_arrays_come_back(tmp_path: Path, meta: dict[str, Any], array: np.ndarray) -> None:
    if array.ndim > 4:
        return
    write_index(tmp_path / "any.index", meta, {"a": array})
    got, arrays = read_index(tmp_path / "any.index")
    assert got == meta
    np.testing.assert_array_equal(arrays["a"], array)


def test_many_values_come_back(tmp_path: Path) -> None:
    meta = {"many": list(range(5000)), "long": "x" * 70000, "keys": {str(i): i for i in range(3000)}}
    write_index(tmp_path / "many.index", meta, {})
    assert read_index(tmp_path / "many.index") == (meta, {})


@pytest.mark.parametrize(
    ("meta", "arrays"),
    [
        ({"a": (1, 2)}, {}),
        ({"a": {1: 2}}, {}),
        ({"a": np.float64(1)}, {}),
        ({"a": 2**64}, {}),
        ({}, {"a": np.array([object()])}),
        ({}, {"a": np.array(["text"])}),
        ({}, {"a": np.zeros((1, 1, 1, 1, 1))}),
        ({}, {"a": np.zeros(1, np.complex128)}),
    ],
)
def test_what_the_format_does_not_store_is_refused_in_writing(tmp_path: Path, meta: Any, arrays: Any) -> None:
    with pytest.raises(TypeError):
        write_index(tmp_path / "bad.index", meta, arrays)
    assert list(tmp_path.iterdir()) == []


def test_deep_values_are_refused_in_writing(tmp_path: Path) -> None:
    deep: list[Any] = []
    for _ in range(100_000):
        deep = [deep]
    with pytest.raises(TypeError, match="nest"):
        write_index(tmp_path / "deep.index", {"a": deep}, {})


# --- files that are no index ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("content", [b"", b"x", b"x" * 64, b"SQLite format 3\0" * 100])
def test_other_files_are_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "other.index").write_bytes(content)
    with pytest.raises(IndexFormatError, match="index"):
        read_index(tmp_path / "other.index")


def test_missing_file_and_folder_are_refused(tmp_path: Path) -> None:
    with pytest.raises(IndexFormatError, match="no such file"):
        read_index(tmp_path / "none.index")
    with pytest.raises(IndexFormatError, match="not a file"):
        read_manifest(tmp_path)
    assert "no such file" in check_index(tmp_path / "none.index")[0]


@pytest.mark.parametrize(
    ("number", "message", "is_the_file"),
    [
        (errno.ENOMEM, "too little memory to open it; end other programs", False),
        (errno.EIO, "input/output error", True),
    ],
)
def test_too_little_memory_is_no_fault_of_the_file(
    path: Path, monkeypatch: pytest.MonkeyPatch, number: int, message: str, is_the_file: bool
) -> None:
    """It said: build it again."""

    def refuse(*_: object, **__: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(index_file.mmap, "mmap", refuse)
    with pytest.raises(RoadgeoError, match=message) as raised:
        read_index(path)
    assert isinstance(raised.value, IndexFormatError) == is_the_file


# --- damage -----------------------------------------------------------------------------------------------------------


def refused_or_equal(path: Path) -> bool:
    """Whether the file is refused; if not, it must read as written."""
    try:
        meta, arrays = read_index(path)
    except IndexFormatError:
        return True
    assert meta == META
    assert list(arrays) == list(ARRAYS)
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(arrays[name], array)
    return False


def test_every_flipped_bit_is_refused_or_harmless(path: Path) -> None:
    raw = path.read_bytes()
    rng = np.random.default_rng(1)
    n_refused = 0
    for position in [*range(0, 1600, 3), *rng.integers(0, len(raw), 400).tolist()]:  # to the pickle; all
        mutated = bytearray(raw)
        mutated[position] ^= 1 << int(rng.integers(8))
        path.write_bytes(mutated)
        n_refused += refused_or_equal(path)
    assert n_refused > 850  # harmless are only paddings


def test_every_truncation_and_extension_is_refused(path: Path) -> None:
    raw = path.read_bytes()
    for size in [*range(0, 4000, 37), *range(len(raw) - 200, len(raw)), *range(4000, len(raw), 4001)]:
        path.write_bytes(raw[:size])
        assert refused_or_equal(path), size
    path.write_bytes(raw + b"\0")
    assert refused_or_equal(path)


def test_checksum_sees_swapped_words_rows_and_pages() -> None:
    entry = {"name": "a", "dtype": "<u8", "shape": [1 << 18]}
    words = np.random.default_rng(0).integers(0, 2**63, 1 << 18, dtype=np.uint64)
    whole = index_file._checksum(entry, words)
    for width in (1, 8, 511, 512, 513, 4096, 1 << 15, 1 << 17):
        swapped = words.copy()
        swapped[:width], swapped[width : 2 * width] = words[width : 2 * width], words[:width]
        assert index_file._checksum(entry, swapped) != whole
    assert index_file._checksum(entry, words.view(np.uint8)[:-1]) != whole


# --- hostility --------------------------------------------------------------------------------------------------------


MANIFESTS = {
    "format": [FORMAT_VERSION + 1, "1", True],
    "arrays": [None, [{}], [[]], [{"name": "a"}] * 300],
    "size": [-1, 1 << 80, 0],
    "pickle": [{}, *({"size": size, "digest": ""} for size in (1 << 40, -5, True))],
    "about": [[]],
}
ENTRIES = {
    "offset": [0, -64, 1, 1 << 70, 64.0, None],
    "shape": [[1 << 61], [1 << 31, 1 << 31], [-1], [1] * 5, [1.5], [True], "12", None, [2, 150]],
    "dtype": ["|O", "O", "<U9", ">f8", "V8", ["<f8"], {"a": "<f8"}, "|b1", "<i2", "<f4", "<u8"],
    "name": ["flags", 3, "other"],
    "checksum": [3],
    "digest": [None],
}


def changes(table: dict[str, list]) -> list[dict[str, Any]]:
    return [{key: value} for key, values in table.items() for value in values]


@pytest.mark.parametrize("change", changes(MANIFESTS))
def test_forged_manifests_are_refused(path: Path, change: dict[str, Any]) -> None:
    manifest, data = sections(path)
    forge(path, manifest | change, data)
    with pytest.raises(IndexFormatError):
        read_index(path)


@pytest.mark.parametrize("change", changes(ENTRIES))
@pytest.mark.parametrize("which", [0, 3])
def test_forged_array_entries_are_refused(path: Path, change: dict[str, Any], which: int) -> None:
    manifest, data = sections(path)
    manifest["arrays"][which] |= change
    forge(path, manifest, data)
    with pytest.raises(IndexFormatError):
        read_index(path)


def test_booleans_that_are_neither_are_refused(tmp_path: Path) -> None:
    neither = np.array([1, 2], np.uint8).view(bool)
    write_index(tmp_path / "b.index", {}, {"b": neither})
    with pytest.raises(IndexFormatError, match="neither true nor false"):
        read_index(tmp_path / "b.index")


def test_swapped_entries_are_refused(path: Path) -> None:
    manifest, data = sections(path)
    manifest["arrays"][0], manifest["arrays"][3] = manifest["arrays"][3], manifest["arrays"][0]
    forge(path, manifest, data)
    with pytest.raises(IndexFormatError, match="overlaps"):
        read_index(path)


@pytest.mark.parametrize(
    "manifest", [b"[" * 500_000, b'{"a":' * 100_000, b"9" * 100_000, b"\xff\xfe", b"null", b"[]", b"{}", b'"text"']
)
def test_manifests_that_are_no_manifest_are_refused(path: Path, manifest: bytes) -> None:
    forge(path, manifest, sections(path)[1])
    with pytest.raises(IndexFormatError):
        read_manifest(path)


class Reduce:
    """Runs a command where it is unpickled carelessly."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self.marker),)


def test_a_pickle_that_calls_is_refused_and_calls_nothing(path: Path, tmp_path: Path) -> None:
    marker = tmp_path / "called"
    for protocol in range(6):
        forge_pickle(path, pickle.dumps({"a": Reduce(marker)}, protocol))
        with pytest.raises(IndexFormatError, match="not allowed"):
            read_index(path)
        assert not marker.exists()


HEAD = b"\x80\x05"
HOSTILE = {
    "builtins": HEAD + b"c__builtin__\neval\n(V1+1\ntR.",
    "stack global": HEAD + b"\x8c\x08builtins\x8c\x04eval\x93.",
    "instance": HEAD + b"(i__main__\nC\n.",
    "persistent id": HEAD + b"Pname\n.",
    "extension": HEAD + b"\x82\x01.",
    "bytes of 4 EiB": HEAD + b"\x8e" + b"\xff" * 7 + b"\x3f.",
    "bytearray of 1 TiB": HEAD + b"\x96" + struct.pack("<Q", 1 << 40) + b".",
    "text of 1 TiB": HEAD + b"\x8d" + struct.pack("<Q", 1 << 40) + b".",
    "text of 4 GiB": HEAD + b"}X\xff\xff\xff\xff.",
    "negative long": HEAD + b"\x8b\xff\xff\xff\xff.",
    "memo of 2 Gi entries": HEAD + b"}r\xff\xff\xff\x7f.",
    "endless frame": HEAD + b"\x95" + b"\xff" * 8 + b"}.",
    "shared without bound": HEAD + b"]\x94" + b"(h\x00h\x00e" * 50 + b".",
    "duplicate": HEAD + b"]2a.",
    "buffers": HEAD + b"\x97.",
    "deep lists": HEAD + b"]" * 300_000 + b"a" * 299_999 + b".",
    "deep dicts": HEAD + b"}" + b"\x8c\x01a}" * 100_000 + b"s" * 100_000 + b".",
    "marks": HEAD + b"(" * 900_000 + b".",
    "empty": b"",
    "stop alone": b".",
    "no stop": HEAD + b"}",
    "after its stop": HEAD + b"}.}.",
    "wrong protocol": b"\x80\x09}.",
    "text protocol": b"(dp0\n.",
    "list": HEAD + b"].",
    "items into nothing": HEAD + b"u.",
    "items into a number": HEAD + b"K\x01(K\x01K\x02u.",
    "odd items": HEAD + b"}(K\x01u.",
    "append to a dict": HEAD + b"}K\x01a.",
    "append to text": HEAD + b"\x8c\x01aK\x01a.",
    "list as a key": HEAD + b"}]K\x01s.",
    "number as a key": HEAD + b"}K\x01K\x01s.",
    "huge number": HEAD + b"}\x8c\x01a\x8a\xff" + b"\x7f" * 255 + b"s.",
    "no utf-8": HEAD + b"}\x8c\x01\xffNs.",
}


@pytest.mark.parametrize("pickled", HOSTILE.values(), ids=HOSTILE)
def test_hand_made_pickles_are_refused_and_cost_little_memory(path: Path, pickled: bytes) -> None:
    forge_pickle(path, pickled)
    tracemalloc.start()
    with pytest.raises(IndexFormatError, match="pickle"):
        read_index(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 100e6


@given(pickled=st.binary(max_size=60))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_random_pickles_are_refused_or_plain(path: Path, pickled: bytes) -> None:
    forge_pickle(path, HEAD + b"}" + pickled + b".")
    try:
        meta, _ = read_index(path)
    except IndexFormatError:
        return
    plain_values.require_plain(meta)


# --- the disk ---------------------------------------------------------------------------------------------------------


def test_the_unpickler_knows_no_names(tmp_path: Path) -> None:
    with pytest.raises(pickle.UnpicklingError, match=r"mkdir"):
        plain_values.PlainUnpickler(io.BytesIO(pickle.dumps(Reduce(tmp_path / "called")))).load()
    assert not (tmp_path / "called").exists()
