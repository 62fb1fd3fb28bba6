"""The tags of TIFF and EXIF by which a picture describes itself; and its orientation, by the tag of that name.

Viewers, browsers, PIL's `exif_transpose` and `cv2.imread` show a picture upright; GDAL and QGIS show it as stored.
Here pictures are upright, from `storage.rasters` on; outputs for programs that ignore the tag use the stored order.
https://www.cipa.jp/std/documents/e/DC-008-Translation-2019-E.pdf, 4.6.4, and TIFF 6.0, section 8.
"""

from __future__ import annotations

import math
import os
import struct
from collections.abc import Iterator
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from roadgeo._arrays import AnyArray, FloatArray

__all__ = [
    *("UPRIGHT", "read_orientation", "read_resolution", "read_tag", "stored_from_upright", "tiff_pages", "tiff_values"),
    "turn_upright",
]

UPRIGHT = 1

_TAG, _RESOLUTION = 274, (282, 283)
_TEXT, _RAW, _NUMBERS = 2, 7, {1: "B", 3: "H", 4: "I", 5: "2I", 9: "i", 10: "2i", 11: "f", 12: "d", 13: "I"}
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
    tag = read_tag(path, _TAG)
    return tag[0] if isinstance(tag, tuple) and tag[0] in _STEPS else UPRIGHT


def read_tag(path: str | os.PathLike[str], tag: int, *within: int) -> tuple[Any, ...] | str | None:
    """Return the numbers or the text of a tag of a TIFF, or of another picture's EXIF; None without it.

    Parameters
    ----------
    within : int
        Tags of the directories to go down to, such as EXIF's and GPS's.
    """
    try:
        with open(path, "rb") as file:  # noqa: PTH123 (names may hold what Path refuses)
            starts = (_exif_start(*part) for part in _parts(file))
            start = next((at for at in starts if at is not None), None)
            kind, value, order = next(tiff_values(file, start or 0, tag, *within), (0, b"", ""))
            if start is None or kind not in (_TEXT, _RAW, *_NUMBERS):
                return None
    except (OSError, ValueError, struct.error):
        return None
    if kind in (_TEXT, _RAW):
        return value.split(b"\0")[0].decode(errors="replace").strip()
    numbers = [one[0] for one in struct.iter_unpack(order + _NUMBERS[kind][-1], value)] if value else []
    if len(_NUMBERS[kind]) > 1:
        numbers = [
            top / bottom if bottom else math.nan for top, bottom in zip(numbers[::2], numbers[1::2], strict=True)
        ]
    return tuple(numbers) or None


def read_resolution(path: str | os.PathLike[str]) -> tuple[float, float]:
    """Return the pixels in a unit of length along rows and along columns, where such a file gives it; else (0, 0)."""
    across, down = (next(iter(read_tag(path, tag) or ()), 0.0) for tag in _RESOLUTION)
    per_metre = float(across), float(down)
    try:
        with open(path, "rb") as file:  # noqa: PTH123
            stated = (_density(*part) for part in _parts(file))
            return next((density for density in stated if density), per_metre)
    except (OSError, ValueError, struct.error):
        return per_metre


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


def _parts(file: BinaryIO) -> Iterator[tuple[bytes, int, bytes]]:
    """Yield the segments of a JPEG or the chunks of a PNG or WebP: kind, where it begins, and how; a TIFF as one."""
    head = file.read(12)
    if head[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        yield b"TIFF", 0, head
    is_jpeg, is_png = head.startswith(b"\xff\xd8"), head.startswith(b"\x89PNG")
    if not (is_jpeg or is_png or (head.startswith(b"RIFF") and head[8:] == b"WEBP")):
        return
    at = 2 if is_jpeg else 8 if is_png else 12
    for _ in range(_MAX_PARTS):
        file.seek(at)
        if is_jpeg:
            fill, kind, size = struct.unpack(">BcH", file.read(4))
            if fill != 0xFF or kind in b"\xd9\xda":
                return
            at, start = at + 2 + size, at + 4
        else:
            size, kind = struct.unpack(">I4s" if is_png else "<4sI", file.read(8))[:: 1 if is_png else -1]
            at, start = at + 8 + size + (4 if is_png else size % 2), at + 8
        yield kind, start, file.read(16)


def _exif_start(kind: bytes, at: int, head: bytes) -> int | None:
    """Return where the TIFF begins that is a part of a picture, or the picture."""
    starts_late = head.startswith(b"Exif\0\0")
    if kind in (b"TIFF", b"eXIf", b"EXIF") or (kind == b"\xe1" and starts_late):
        return at + 6 * starts_late
    return None


def _density(kind: bytes, at: int, head: bytes) -> tuple[float, float] | None:  # noqa: ARG001
    """Return the pixels in a unit of length, of JFIF or of PNG."""
    if kind == b"\xe0" and head.startswith(b"JFIF\0"):
        return struct.unpack(">HH", head[8:12])
    return struct.unpack(">II", head[:8]) if kind == b"pHYs" else None


def tiff_values(file: BinaryIO, start: int, wanted: int, *within: int) -> Iterator[tuple[int, bytes, str]]:
    """Yield the values of a tag in the first directory of a TIFF, or BigTIFF, that begins at `start`.

    Each with its type, cut off where the file ends, and with the order of its bytes, "<" or ">". `within` are tags of
    directories in it to go down to.

    Raises
    ------
    struct.error
        The directory is cut off.
    """
    layout = _Layout.of(file, start)
    at = layout.first
    for tag in within:
        _, value, order = next(layout.values(file, at, tag), (0, b"", ""))
        if not value:
            return
        (at,) = struct.unpack(order + ("Q" if len(value) == 8 else "I"), value)
    yield from layout.values(file, at, wanted)


def tiff_pages(file: BinaryIO, wanted: int) -> Iterator[int]:
    """Yield the number in a tag of each directory of a TIFF, 0 where it has none; errors as of `tiff_values`."""
    layout = _Layout.of(file, 0)
    at, visited = layout.first, set[int]()
    while at and at not in visited and len(visited) < _MAX_PARTS:
        visited.add(at)
        value = next(layout.values(file, at, wanted), (0, b"", ""))[1]
        yield int.from_bytes(value[:4], "little" if layout.order == "<" else "big")
        at = layout.next(file, at)


class _Layout(NamedTuple):
    """The layout of the directories of a TIFF."""

    start: int
    order: str
    number: str  # of positions in the file
    entry_count: str
    length: int  # of an entry
    first: int

    @classmethod
    def of(cls, file: BinaryIO, start: int) -> _Layout:
        file.seek(start)
        head = file.read(16)
        order = "<" if head.startswith(b"II") else ">"
        is_big = struct.unpack(order + "H", head[2:4])[0] == 43
        number, count, length = ("Q", "Q", 20) if is_big else ("I", "H", 12)
        (first,) = struct.unpack(order + number, head[8:16] if is_big else head[4:8])
        return cls(start, order, number, count, length, first)

    def entries(self, file: BinaryIO, at: int) -> tuple[int, int]:
        """Return where the entries of a directory begin, and how many they are."""
        file.seek(self.start + at)
        width = struct.calcsize(self.order + self.entry_count)
        return self.start + at + width, struct.unpack(self.order + self.entry_count, file.read(width))[0]

    def next(self, file: BinaryIO, at: int) -> int:
        """Return where the next directory begins; 0: there is none."""
        begin, n_entries = self.entries(file, at)
        file.seek(begin + n_entries * self.length)
        return int(struct.unpack(self.order + self.number, file.read(struct.calcsize(self.order + self.number)))[0])

    def values(self, file: BinaryIO, at: int, wanted: int) -> Iterator[tuple[int, bytes, str]]:
        begin, n_entries = self.entries(file, at)
        size = struct.calcsize(self.order + self.number)
        for n in range(min(n_entries, _MAX_ENTRIES)):
            file.seek(begin + n * self.length)
            entry = file.read(self.length)
            tag, kind, n_values = struct.unpack(self.order + "HH" + self.number, entry[: 4 + size])
            if tag != wanted:
                continue
            n_bytes = min(n_values * _BYTES.get(kind, 8), _MAX_VALUE)
            if n_bytes > size:
                file.seek(self.start + struct.unpack(self.order + self.number, entry[4 + size :])[0])
            yield kind, entry[4 + size :][:n_bytes] if n_bytes <= size else file.read(n_bytes), self.order
