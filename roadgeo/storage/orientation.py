"""Orientation of a stored picture: the tag of that name in EXIF and TIFF.

Viewers, browsers, PIL's `exif_transpose` and `cv2.imread` show a picture upright; GDAL and QGIS show it as stored.
Here pictures are upright, from `storage.rasters` on; outputs for programs that ignore the tag use the stored order.
https://www.cipa.jp/std/documents/e/DC-008-Translation-2019-E.pdf, 4.6.4, and TIFF 6.0, section 8.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from typing import BinaryIO

import numpy as np

from roadgeo._arrays import AnyArray, FloatArray

__all__ = ["UPRIGHT", "read_orientation", "stored_from_upright", "tiff_values", "turn_upright"]

UPRIGHT = 1

_TAG, _SHORT = 274, 3
_MAX_ENTRIES, _MAX_VALUE = 1 << 16, 1 << 24  # of an IFD; bytes of a value
_BYTES = {1: 1, 2: 1, 3: 2, 4: 4, 6: 1, 7: 1, 8: 2, 9: 4, 11: 4, 13: 4}  # of the types of TIFF; of others 8
_MAX_PARTS = 1 << 12  # segments or chunks before the one that holds EXIF

#: Steps that make a stored picture upright: rows become columns, rows are taken from the bottom, columns from
#: the right.
_STEPS = {
    1: (False, False, False),
    2: (False, False, True),
    3: (False, True, True),
    4: (False, True, False),
    5: (True, False, False),
    6: (True, False, True),
    7: (True, True, True),
    8: (True, True, False),
}


def read_orientation(path: str | os.PathLike[str]) -> int:
    """Return the orientation of a JPEG, TIFF, PNG or WebP, 1 to 8; 1, upright, without the tag."""
    try:
        with open(path, "rb") as file:  # noqa: PTH123 (names may hold what Path refuses)
            found = _read(file, file.read(12))
    except (OSError, ValueError, struct.error):
        return UPRIGHT
    return found if found in _STEPS else UPRIGHT


def turn_upright(array: AnyArray, orientation: int) -> AnyArray:
    """Return a stored (H, W) or (H, W, bands) array as an upright picture shows it; a view."""
    transposed, from_bottom, from_right = _STEPS[orientation]
    turned = np.swapaxes(array, 0, 1) if transposed else array
    return turned[:: -1 if from_bottom else 1, :: -1 if from_right else 1]


def stored_from_upright(orientation: int, size: tuple[int, int]) -> FloatArray:
    """Return the (3, 3) matrix from pixels of an upright picture of (width, height) to those that are stored.

    Pixel = (column, row), the corner of the first pixel is (0, 0) in both.
    """
    transposed, from_bottom, from_right = _STEPS[orientation]
    width, height = size
    flipped = np.array(
        [
            [-1.0 if from_right else 1.0, 0.0, width if from_right else 0.0],
            [0.0, -1.0 if from_bottom else 1.0, height if from_bottom else 0.0],
            [0.0, 0.0, 1.0],
        ]
    )
    return flipped[[1, 0, 2]] if transposed else flipped


def _read(file: BinaryIO, head: bytes) -> int:
    """Find the IFD of TIFF or EXIF in a file of known first bytes, and read its entry."""
    if head[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        return _of_tiff(file, 0)
    if head.startswith(b"\xff\xd8"):
        return _of_jpeg(file)
    if head.startswith(b"\x89PNG"):
        return _of_chunks(file, 8, ">I4s", b"eXIf")
    if head.startswith(b"RIFF") and head[8:] == b"WEBP":
        return _of_chunks(file, 12, "<4sI", b"EXIF")
    return UPRIGHT


def _of_jpeg(file: BinaryIO) -> int:
    """Walk the segments of a JPEG to the one that holds EXIF (APP1)."""
    at = 2
    for _ in range(_MAX_PARTS):
        file.seek(at)
        fill, marker, size = struct.unpack(">BBH", file.read(4))
        if fill != 0xFF or marker in (0xD9, 0xDA):
            break
        if marker == 0xE1 and file.read(6) == b"Exif\0\0":
            return _of_tiff(file, at + 10)
        at += 2 + size
    return UPRIGHT


def _of_chunks(file: BinaryIO, at: int, layout: str, wanted: bytes) -> int:
    """Walk the chunks of a PNG or WebP to the one that holds EXIF."""
    is_png = layout.startswith(">")
    for _ in range(_MAX_PARTS):
        file.seek(at)
        size, kind = struct.unpack(layout, file.read(8))[:: 1 if is_png else -1]
        if kind == wanted:
            starts_late = file.read(6) == b"Exif\0\0"
            return _of_tiff(file, at + (14 if starts_late else 8))
        at += 8 + size + (4 if is_png else size % 2)
    return UPRIGHT


def _of_tiff(file: BinaryIO, start: int) -> int:
    kind, value, order = next(tiff_values(file, start, _TAG), (0, b"", ""))
    return int(struct.unpack(order + "H", value[:2])[0]) if kind == _SHORT else UPRIGHT


def tiff_values(file: BinaryIO, start: int, wanted: int) -> Iterator[tuple[int, bytes, str]]:
    """Yield the values of a tag in the first directory of a TIFF, or BigTIFF, that begins at `start`.

    Each with its type, cut off where the file ends, and with the order of its bytes, "<" or ">".

    Raises
    ------
    struct.error
        The directory is cut off.
    """
    file.seek(start)
    head = file.read(16)
    order = "<" if head.startswith(b"II") else ">"
    is_big = struct.unpack(order + "H", head[2:4])[0] == 43
    number, count, length = ("Q", "Q", 20) if is_big else ("I", "H", 12)
    size = struct.calcsize(order + number)
    (offset,) = struct.unpack(order + number, head[8:16] if is_big else head[4:8])
    file.seek(start + offset)
    (n_entries,) = struct.unpack(order + count, file.read(struct.calcsize(order + count)))
    for n in range(min(n_entries, _MAX_ENTRIES)):
        file.seek(start + offset + struct.calcsize(order + count) + n * length)
        entry = file.read(length)
        tag, kind, n_values = struct.unpack(order + "HH" + number, entry[: 4 + size])
        if tag != wanted:
            continue
        n_bytes = min(n_values * _BYTES.get(kind, 8), _MAX_VALUE)
        if n_bytes > size:
            file.seek(start + struct.unpack(order + number, entry[4 + size :])[0])
        yield kind, entry[4 + size :][:n_bytes] if n_bytes <= size else file.read(n_bytes), order
