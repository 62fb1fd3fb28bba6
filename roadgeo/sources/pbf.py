"""OpenStreetMap's PBF files cut between their blobs, so that it is known how much of one is read."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

__all__ = ["osm_parts"]

#: PBF files are read in parts of about this size; what may stand in them at most, as their specification says.
_PART, _MAX_BLOB, _MAX_BLOB_HEADER = 1 << 20, 32 << 20, 64 << 10
_NUMBER_BITS = 70


def osm_parts(path: Path) -> Iterator[tuple[Any, float]]:
    """Yield what osmium is to read one after another, and the share of the file that is read then.

    A PBF file is a row of blobs, the first of them a header, each with a header of its own. It is cut between them,
    for osmium does not tell how far it is. Other files are left whole.
    """
    import osmium

    if not path.name.lower().endswith(".pbf"):
        yield str(path), 1.0
        return
    size = path.stat().st_size
    with path.open("rb") as file:
        header = _read_blob(file)
        while file.tell() < size:
            part = bytearray()
            while len(part) < _PART and file.tell() < size:
                part += _read_blob(file)
            yield osmium.io.FileBuffer(header + part, "pbf"), file.tell() / size


def _read_blob(file: BinaryIO) -> bytes:
    """Read one blob of a PBF file, the header before it, and the size of that before both.

    Raises
    ------
    RuntimeError
        As osmium does: it is cut off, or there is none.
    """
    prefix = file.read(4)
    header = file.read(min(int.from_bytes(prefix, "big"), _MAX_BLOB_HEADER))
    size = _blob_size(header)
    blob = file.read(min(size, _MAX_BLOB))
    if len(prefix) < 4 or len(header) != int.from_bytes(prefix, "big") or len(blob) != size:
        raise RuntimeError("it is cut off, damaged or no PBF file")
    return prefix + header + blob


def _blob_size(header: bytes) -> int:
    """Find the size of a blob in its header: field 3, a number, of a Protocol Buffers message; -1 where it is not."""
    at = 0

    def number() -> int:
        nonlocal at
        value = shift = 0
        while at < len(header):
            byte = header[at]
            value |= (byte & 127) << shift
            at, shift = at + 1, shift + 7
            if byte < 128 or shift == _NUMBER_BITS:
                break
        return value

    while at < len(header):
        field, kind = divmod(number(), 8)
        value = number()
        if field == 3 and kind == 0:
            return value
        at += value if kind == 2 else 0  # text, or an index that nobody needs
    return -1
