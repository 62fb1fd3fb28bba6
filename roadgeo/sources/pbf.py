"""OpenStreetMap's PBF files cut between their blobs, so that it is known how much of one is read."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

from roadgeo.sources.protobuf import WireError, fields

__all__ = ["osm_head", "osm_parts"]

#: PBF files are read in parts of about this size; what may stand in them at most, as their specification says.
_PART, _MAX_BLOB, _MAX_BLOB_HEADER = 1 << 20, 32 << 20, 64 << 10
_NUMBER_BITS = 70


def osm_head(path: Path) -> Any:
    """Return what osmium is to read for a file's header: of a damaged PBF file on disk it forgets to close it."""
    import osmium

    if not path.name.lower().endswith(".pbf"):
        return str(path)
    with path.open("rb") as file:
        return osmium.io.FileBuffer(_read_blob(file), "pbf")


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
    _require_text(blob)
    return prefix + header + blob


def _require_text(blob: bytes) -> None:
    """Refuse a blob with a zero byte in a text: osmium takes it for the end of that, and reads on beyond all texts.

    Raises
    ------
    RuntimeError
        There is one; or the blob is compressed in another way than with zlib, so that it cannot be looked at.
    """
    try:
        for field, table in fields(memoryview(_unpacked(blob))):
            # Zero bytes are rare, but for the length of the empty text that every table begins with.
            if field == 1 and not isinstance(table, int) and table[2:].tobytes().count(0):
                _require_no_zero(table)
    except WireError as error:
        raise RuntimeError("it is cut off, damaged or no PBF file") from error


def _require_no_zero(table: memoryview) -> None:
    for _, text in fields(table):
        if not isinstance(text, int) and text.tobytes().count(0):
            raise RuntimeError("it is damaged: a text in it holds a zero byte")


def _unpacked(blob: bytes) -> bytes:
    """Return what is in a blob: of its fields 1 is that as it is, 3 what zlib made of it; there is but one."""
    contents = [(field, content) for field, content in fields(memoryview(blob)) if not isinstance(content, int)]
    if len(contents) != 1 or contents[0][0] not in {1, 3}:
        raise RuntimeError("a part of it is not compressed by zlib; write it with that, as osmium does by default")
    ((field, content),) = contents
    try:
        return content.tobytes() if field == 1 else zlib.decompressobj().decompress(content, _MAX_BLOB + 1)
    except zlib.error as error:
        raise RuntimeError("it is damaged: a part of it cannot be unpacked") from error


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
