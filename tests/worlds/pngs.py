"""PNGs byte by byte: of any size that they claim, with chunks that no program writes."""

import struct
import zlib


def chunk(kind: bytes, data: bytes) -> bytes:
    """A part of a PNG, with its checksum."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width: int, height: int, depth: int = 8) -> bytes:
    """A grey PNG of zeros, whole or, if it were large, merely said to be."""
    rows = zlib.compress(bytes(1 << 16 if width * height > 1 << 24 else (width + 1) * height))
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", rows) + chunk(b"IEND", b"")
