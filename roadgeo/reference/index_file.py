"""The index file: a JSON manifest, a small pickle of plain values, and arrays that are memory-mapped.

Layout, all numbers little-endian::

    64 bytes      magic, format version, manifest size, digest of those and the manifest
    manifest      JSON: kind of file and all offsets; enough for `info`, which unpickles nothing
    data section  (starts at the next multiple of 64, offsets count from here)
        pickle    protocol 5, plain dict/list/str/int/float/bool/None only
        arrays    one after another, each at a multiple of 64

Trust: none. A file is refused (`IndexFormatError`) unless its sizes agree, every range lies inside it,
nothing overlaps, types are known, and the digests of header and pickle and the checksums of all arrays agree. That
finds damage. A forger can make digests agree, so against hostility the unpickler knows no names and is shown only
opcodes that can neither call nor refer back, and the owner of the arrays checks their integer references before a
kernel follows them.

Upgrades: none. The GeoPackage beside an index lasts: its schema ("roadgeo.reference/1") is read by
every later roadgeo, and holds the roads, the intersections and the options that the index is built from, in seconds. So
`FORMAT_VERSION` goes up whenever the file or the arrays in it change, and a reader refuses every version but its own:

- an older index beside its GeoPackage is built again, unasked, when the reference is next opened;
- an older index alone is refused: the reference has to be made again from its roads, or by whoever handed it on;
- a newer index is refused and left alone, for a newer roadgeo may be in use beside this one: either that is used, or
  `roadgeo index --rebuild REF.gpkg` replaces the index by one of this version.
"""

from __future__ import annotations

import errno
import json
import math
import mmap
import os
import shlex
import struct
from collections.abc import Mapping
from hashlib import blake2b
from pathlib import Path
from typing import Any, NoReturn, TypeGuard

import numpy as np

from roadgeo._arrays import AnyArray
from roadgeo._version import __version__
from roadgeo.errors import IndexFormatError, RoadgeoError
from roadgeo.reference.plain_values import dump_plain, load_plain, require_plain
from roadgeo.storage.memory import bounded

__all__ = [
    "FORMAT_VERSION",
    "check_index",
    "read_format_version",
    "read_index",
    "read_manifest",
    "remedy",
    "write_index",
]

#: See the module's docstring for when it goes up, and how other versions are handled.
FORMAT_VERSION = 4

_MAGIC = b"\x89roadgeo index\r\n"
_PREAMBLE = struct.Struct("<16sII32s8x")
_ALIGNMENT = 64

_DTYPES = {
    code: np.dtype(code) for code in ("<f8", "<f4", "<i8", "<i4", "<i2", "|i1", "<u8", "<u4", "<u2", "|u1", "|b1")
}

_MAX_DIMENSIONS = 4


def write_index(
    path: Path, meta: Mapping[str, Any], arrays: Mapping[str, AnyArray], about: Mapping[str, Any] | None = None
) -> None:
    """Write an index file in place, for callers that stage it (see `storage.files.replacing`).

    Parameters
    ----------
    meta : dict
        Plain values (dict with str keys, list, str, 64-bit int, float, bool, None) that the arrays' owner needs back.
    arrays : mapping of str to ndarray
        Numeric or boolean arrays of up to four dimensions.
    about : dict, optional
        Plain values for people, readable without unpickling: name, counts, network digest, options.

    Raises
    ------
    OSError
        The disk is full, the folder is missing or not writable.
    TypeError
        A value or array is of a kind that the format does not store.
    """
    chunks: list[bytes | memoryview] = [dump_plain(dict(meta))]
    entries = []
    offset = _aligned(len(chunks[0]))
    for name, array in arrays.items():
        data = _stored_array(name, array)
        entry = {"name": name, "dtype": _code(data.dtype), "shape": list(data.shape), "offset": offset}
        entries.append(entry | {"checksum": _checksum(entry, data), "digest": _digest(_bytes(data))})
        chunks.append(_bytes(data))
        offset = _aligned(offset + data.nbytes)
    manifest = {
        "format": FORMAT_VERSION,
        "roadgeo": __version__,
        "about": dict(about or {}),
        "size": offset,
        "pickle": {"size": len(chunks[0]), "digest": _digest(chunks[0])},
        "arrays": entries,
    }
    require_plain(manifest)
    header = _header(json.dumps(manifest, allow_nan=False).encode())
    with path.open("wb") as file:
        for chunk in (header, *chunks):
            file.write(chunk)
            file.write(bytes(-len(chunk) % _ALIGNMENT))


def read_format_version(path: str | os.PathLike[str]) -> int:
    """Format version of an index file, which every version stores at the same place.

    Raises
    ------
    IndexFormatError
        When the file is missing or is no index.
    """
    return _parse_version(_map(path), path)


def read_manifest(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read the manifest of an index file; nothing is unpickled and no array is touched.

    Returns
    -------
    dict
        `format`, `roadgeo` (version that wrote it), `about`, `size`, `pickle`, `arrays`, all validated.

    Raises
    ------
    IndexFormatError
        When the file is missing, damaged, or of another format version.
    """
    return _parse_manifest(_map(path), path)[0]


def read_index(path: str | os.PathLike[str]) -> tuple[dict[str, Any], dict[str, AnyArray]]:
    """Open an index file.

    Returns
    -------
    meta : dict
        As written.
    arrays : dict of str to ndarray
        Read-only views of the memory-mapped file.

    Raises
    ------
    IndexFormatError
        When the file is missing, damaged, hostile, or of another format version.

    Notes
    -----
    Every byte that matters is verified here, since a flipped bit would otherwise become a wrong answer. That is cheap:
    the checksum runs nearly at the speed of memory, 25 ms for 160 MB in the page cache, where CRC-32 took 70, SHA-256
    104 and BLAKE2b 180 ms; and a first query would read most of the pages anyway.
    """
    data = _map(path)
    manifest, start = _parse_manifest(data, path)
    with bounded(path, IndexFormatError):
        meta = _parse_pickle(data[start : start + manifest["pickle"]["size"]], manifest["pickle"]["digest"], path)
    arrays = {}
    for entry in manifest["arrays"]:
        array = _view(data, start, entry)
        if _checksum(entry, array) != entry["checksum"]:
            _refuse(path, f"its array {entry['name']!r} is damaged (checksum differs)")
        if array.dtype == bool and array.size and array.view(np.uint8).max() > 1:
            _refuse(path, f"its boolean array {entry['name']!r} holds values that are neither true nor false")
        arrays[entry["name"]] = array
    return meta, arrays


def _parse_pickle(pickled: bytes, digest: str, path: str | os.PathLike[str]) -> dict[str, Any]:
    if _digest(pickled) != digest:
        _refuse(path, "its pickle is damaged (digest differs)")
    try:
        return load_plain(pickled)
    except ValueError as error:
        _refuse(path, str(error), error)


def check_index(path: str | os.PathLike[str]) -> list[str]:
    """Verify all digests of an index file.

    Returns
    -------
    list of str
        Problems, one sentence each; empty when the file is sound.
    """
    try:
        read_index(path)
        data = _map(path)
        manifest, start = _parse_manifest(data, path)
    except IndexFormatError as error:
        return [str(error)]
    return [
        f"array {entry['name']!r} differs from its digest"
        for entry in manifest["arrays"]
        if _digest(_bytes(_view(data, start, entry))) != entry["digest"]
    ]


# --- bytes ------------------------------------------------------------------------------------------------------------


def _refuse(path: str | os.PathLike[str], what: str, cause: Exception | None = None) -> NoReturn:
    raise IndexFormatError(f"{os.fspath(path)} cannot be used: {what}; {remedy(path)}") from cause


def remedy(path: str | os.PathLike[str]) -> str:
    """Return how to replace an index that cannot be used: the command, where its GeoPackage lies beside it."""
    geopackage = Path(path).with_suffix(".gpkg")
    if geopackage.is_file():
        return f"build it again from its GeoPackage: roadgeo index --rebuild {shlex.quote(os.fspath(geopackage))}"
    return f"put {geopackage.name} beside it, from which it is built again, or make both again with `roadgeo index`"


def _aligned(n: int) -> int:
    return n + -n % _ALIGNMENT


def _digest(data: Any) -> str:
    return blake2b(data, digest_size=16).hexdigest()


def _bytes(array: AnyArray) -> memoryview:
    """Bytes of a contiguous array."""
    return array.reshape(-1).view(np.uint8).data


def _checksum(entry: Mapping[str, Any], array: AnyArray) -> str:
    """Checksum of an array with its name, type and shape, nearly at the speed of memory.

    Row and column sums of every MiB are hashed. The bytes are laid out as 64-bit words in rows of 512: a changed word
    changes its column's sum and its row's, a moved word or page at least one of them, and the hash keeps the order of
    everything else.
    """
    width, height = 512, 256
    hasher = blake2b(json.dumps([entry["name"], entry["dtype"], entry["shape"]]).encode(), digest_size=16)
    data = array.reshape(-1).view(np.uint8)
    n_rows = data.size // (8 * width)
    words = data[: n_rows * 8 * width].view("<u8").reshape(n_rows, width)
    for first in range(0, n_rows, height):
        block = words[first : first + height]
        for axis in (0, 1):
            hasher.update(np.add.reduce(block, axis=axis).data)
    hasher.update(data[n_rows * 8 * width :].data)
    return hasher.hexdigest()


def _map(path: str | os.PathLike[str]) -> mmap.mmap:
    """Map a regular file of at least one preamble, read-only."""
    try:
        if not Path(path).is_file():
            kind = "it is not a file" if Path(path).exists() else "no such file"
            raise IndexFormatError(f"no index at {os.fspath(path)}: {kind}; make it with `roadgeo index`")
        with Path(path).open("rb") as file:
            if os.fstat(file.fileno()).st_size < _PREAMBLE.size:
                _refuse(path, f"it is not an index, or truncated: shorter than {_PREAMBLE.size} bytes")
            return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except OSError as error:
        if error.errno == errno.ENOMEM:  # the file is as good as it was
            raise RoadgeoError(f"{os.fspath(path)}: too little memory to open it; end other programs") from error
        _refuse(path, (error.strerror or str(error)).lower(), error)


def _header(manifest: bytes) -> bytes:
    """Preamble and manifest."""
    digest = blake2b(struct.pack("<II", FORMAT_VERSION, len(manifest)) + manifest, digest_size=32).digest()
    return _PREAMBLE.pack(_MAGIC, FORMAT_VERSION, len(manifest), digest) + manifest


def _parse_version(data: mmap.mmap, path: str | os.PathLike[str]) -> int:
    magic, version, _, _ = _PREAMBLE.unpack_from(data)
    if magic != _MAGIC:
        _refuse(path, "it is not a roadgeo index")
    return int(version)


def _parse_manifest(data: mmap.mmap, path: str | os.PathLike[str]) -> tuple[dict[str, Any], int]:
    """Validate the header and the manifest; return the manifest and the start of the data section."""
    version = _parse_version(data, path)
    _, _, size, digest = _PREAMBLE.unpack_from(data)
    if version != FORMAT_VERSION:
        versions = f"it has format version {version}, and this roadgeo {__version__} reads version {FORMAT_VERSION}"
        _refuse(path, versions + ("; use a later roadgeo, or else" if version > FORMAT_VERSION else ""))
    if _PREAMBLE.size + size > len(data):
        _refuse(path, "it is truncated, or its manifest's size is wrong")
    raw = data[_PREAMBLE.size : _PREAMBLE.size + size]
    if blake2b(struct.pack("<II", version, size) + raw, digest_size=32).digest() != digest:
        _refuse(path, "its manifest is damaged (digest differs)")
    try:
        with bounded(path, IndexFormatError):
            manifest = json.loads(raw)
    except (ValueError, RecursionError) as error:
        _refuse(path, "its manifest is no JSON", error)
    start = _aligned(_PREAMBLE.size + size)
    problem = _manifest_problem(manifest, len(data) - start)
    if problem:
        _refuse(path, f"its manifest is wrong: {problem}")
    return manifest, start


def _is_count(value: object) -> TypeGuard[int]:
    """Whether a parsed value is an integer that can be a size or an offset (JSON's true is no 1)."""
    return type(value) is int and 0 <= value < 1 << 62


def _manifest_problem(manifest: Any, size: int) -> str:
    """Return the fault of a parsed manifest of a file whose data section has `size` bytes, or ''."""
    expected = {"format": int, "roadgeo": str, "about": dict, "size": int, "pickle": dict, "arrays": list}
    if type(manifest) is not dict or any(type(manifest.get(key)) is not kind for key, kind in expected.items()):
        return f"expected an object with {', '.join(expected)}"
    if manifest["format"] != FORMAT_VERSION:
        return "its format version differs from the file's"
    if manifest["size"] != size:
        return f"expected {manifest['size']} bytes of data, got {size}; the file is truncated or was appended to"
    entry = manifest["pickle"]
    if not _is_count(entry.get("size")) or type(entry.get("digest")) is not str:
        return "its pickle's size or digest is missing"
    if entry["size"] > size:
        return "its pickle reaches beyond the end of the file"
    return _arrays_problem(manifest["arrays"], entry["size"], size)


def _arrays_problem(entries: list[Any], end: int, size: int) -> str:
    """Return the fault of the array entries, which must follow each other from `end` to `size`, or ''."""
    names = set()
    for entry in entries:
        if type(entry) is not dict or any(type(entry.get(key)) is not str for key in ("name", "checksum", "digest")):
            return "an array lacks its name, checksum or digest"
        name, shape, offset = entry["name"], entry.get("shape"), entry.get("offset")
        if name in names:
            return f"array {name!r} occurs twice"
        names.add(name)
        dtype = entry.get("dtype")
        if type(dtype) is not str or dtype not in _DTYPES:
            return f"array {name!r} has a type that is not stored in an index: {dtype!r}"
        if type(shape) is not list or len(shape) > _MAX_DIMENSIONS or not all(map(_is_count, shape)):
            return f"array {name!r} has an impossible shape"
        if not _is_count(offset) or offset % _ALIGNMENT or offset < end:
            return f"array {name!r} overlaps or is not aligned"
        end = offset + math.prod(shape) * _DTYPES[dtype].itemsize
        if end > size:
            return f"array {name!r} reaches beyond the end of the file"
    return ""


# --- arrays -----------------------------------------------------------------------------------------------------------


def _code(dtype: np.dtype[Any]) -> str:
    """Little-endian type code, as in the manifest."""
    return dtype.newbyteorder("<").str


def _stored_array(name: str, array: AnyArray) -> AnyArray:
    """Contiguous little-endian array, the same object where it is so already."""
    array = np.asarray(array)
    code = _code(array.dtype)
    if code not in _DTYPES or array.ndim > _MAX_DIMENSIONS:
        raise TypeError(
            f"array {name!r} cannot be stored in an index: got {array.dtype} with {array.ndim} dimensions, "
            f"expected one of {', '.join(_DTYPES)} with at most {_MAX_DIMENSIONS}"
        )
    return np.ascontiguousarray(array, dtype=code).reshape(array.shape)


def _view(data: mmap.mmap, start: int, entry: dict[str, Any]) -> AnyArray:
    """Read-only array over the mapped file, after `_manifest_problem` found none."""
    return np.ndarray(tuple(entry["shape"]), _DTYPES[entry["dtype"]], buffer=data, offset=start + entry["offset"])
