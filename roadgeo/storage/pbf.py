"""PBF files of OpenStreetMap, cut between their blobs and checked before osmium reads them.

https://github.com/openstreetmap/OSM-binary
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from roadgeo.storage.protobuf import message_types

__all__ = ["read_blob", "read_parts"]

#: Files are read in parts of about this size; the other two are limits of the specification.
_PART, _MAX_BLOB, _MAX_BLOB_HEADER = 1 << 20, 32 << 20, 64 << 10

#: The checked parts of a file.
_PBF = """
    BlobHeader size:3:int64
    Blob raw:1 zlib:3 lzma:4 bzip2:5 lz4:6 zstd:7
    Block texts:1
    Texts text:1
"""


def read_parts(path: Path) -> Iterator[tuple[bytes, float]]:
    """Yield one or more parts of a file, each with the header of the whole, and the share that is read then.

    Raises
    ------
    RuntimeError
        It is cut off, damaged, or no PBF file.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        header, is_first = read_blob(file), True
        while is_first or file.tell() < size:
            part, is_first = bytearray(), False
            while len(part) < _PART and file.tell() < size:
                part += read_blob(file)
            yield header + bytes(part), file.tell() / size


def read_blob(file: BinaryIO) -> bytes:
    """Read one blob of a PBF file, the header before it, and the size of that before both.

    Raises
    ------
    RuntimeError
        As osmium does: it is cut off, or missing.
    """
    from google.protobuf.message import DecodeError

    prefix = file.read(4)
    header = file.read(min(int.from_bytes(prefix, "big"), _MAX_BLOB_HEADER))
    try:
        (size,) = message_types(_PBF)["BlobHeader"].FromString(header).size
        blob = file.read(size) if 0 <= size <= _MAX_BLOB else b""
        if len(prefix) < 4 or len(header) != int.from_bytes(prefix, "big") or size != len(blob):
            raise RuntimeError("it is cut off, damaged or no PBF file")
        _require_text(blob)
    except (DecodeError, ValueError, zlib.error) as error:
        raise RuntimeError("it is cut off, damaged or no PBF file") from error
    return prefix + header + blob


def _require_text(blob: bytes) -> None:
    """Refuse a blob with a zero byte in a text: osmium takes it for the end of that, and reads on beyond all texts.

    Or one that is compressed in another way than with zlib, so that it cannot be looked at.
    """
    messages = message_types(_PBF)
    stored = messages["Blob"].FromString(blob)
    if len(stored.raw) + len(stored.zlib) != 1 or stored.lzma or stored.lz4 or stored.zstd or stored.bzip2:
        raise RuntimeError("a part of it is not compressed by zlib; write it with that, as osmium does by default")
    content = stored.raw[0] if stored.raw else zlib.decompressobj().decompress(stored.zlib[0], _MAX_BLOB + 1)
    for table in messages["Block"].FromString(content).texts:
        # Zero bytes are rare, but for the length of the empty text that every table begins with.
        if table[2:].count(0) and any(0 in text for text in messages["Texts"].FromString(table).text):
            raise RuntimeError("it is damaged: a text in it holds a zero byte")
