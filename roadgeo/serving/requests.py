"""Requests to the server: an image and hints; all of it may be hostile."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any
from urllib.parse import parse_qsl

from starlette.exceptions import HTTPException

from roadgeo.matching.hints import HINTS, read_numbers, read_taken

__all__ = ["LIMIT", "OF_ANSWERS", "ending_of", "read_hints", "read_query_string"]

#: First bytes of the files that are read. Files that refer to others, as a VRT does, are not among them.
_MAGIC = {
    b"\x89PNG\r\n\x1a\n": ".png",
    b"II*\0": ".tif",
    b"MM\0*": ".tif",
    b"II+\0": ".tif",
    b"MM\0+": ".tif",
    b"\xff\xd8\xff": ".jpg",
    b"BM": ".bmp",
    b"GIF8": ".gif",
    **dict.fromkeys((b"P1", b"P2", b"P3", b"P4", b"P5", b"P6", b"P7"), ".pnm"),
    b"\0\0\0\x0cjP  ": ".jp2",
}

#: Hints by their names over HTTP, and the most letters of a value.
_NAMES = {hint.parameter: hint for hint in HINTS.values()}
_MOST_LETTERS = 200
#: Most points by which an image is placed; each has column, row, longitude and latitude.
_MOST_POINTS, _LARGEST = 5, (1e6, 1e6, 180.0, 90.0)
#: Under this name a time limit stands among the hints.
LIMIT = HINTS["time_limit"].goes_to


def _read_points(text: str) -> tuple[tuple[float, ...], ...]:
    form = "COLUMN,ROW,LON,LAT of three to five points"
    numbers = read_numbers(text, form, range(12, 4 * _MOST_POINTS + 1, 4), ",")
    points = tuple(numbers[k : k + 4] for k in range(0, len(numbers), 4))
    if any(abs(value) > most for point in points for value, most in zip(point, _LARGEST, strict=True)):
        raise ValueError(f"got {text!r}, expected {form}")
    return points


#: What is done with an answer: one of its places is taken, or points place its image; by their names.
OF_ANSWERS: dict[str, Callable[[str], Any]] = {"take": read_taken, "points": _read_points}


def ending_of(head: bytes) -> str:
    """Return the suffix of an image by its first bytes.

    Raises
    ------
    HTTPException
        It is no image that is read.
    """
    if head[:4] == b"RIFF" and head[8:12] == b"WEBP":
        return ".webp"
    for magic, ending in _MAGIC.items():
        if head.startswith(magic):
            return ending
    is_still = head[4:8] == b"ftyp"
    what = "in HEIC or AVIF, or a video, which are not read: save a picture as JPEG" if is_still else "no image"
    raise HTTPException(415, f"it is {what}; expected PNG, TIFF, JPEG, WebP, JPEG 2000, BMP, GIF or PNM")


def read_query_string(text: str) -> dict[str, Any]:
    """Read hints from a URL.

    Raises
    ------
    HTTPException
        A name is not known, or a value makes no sense.
    """
    try:
        return read_hints(parse_qsl(text, True, strict_parsing=bool(text), max_num_fields=20))
    except ValueError as error:
        raise HTTPException(400, f"the query of the URL cannot be read: {error}") from error


def read_hints(values: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    """Check hints, and give them the names that the search has for them.

    Raises
    ------
    HTTPException
        A name is not known or given twice, or a value makes no sense.
    """
    hints: dict[str, Any] = {}
    for name, value in values:
        if name not in _NAMES and name not in OF_ANSWERS:
            raise HTTPException(400, f"got {str(name)[:40]!r}, expected one of {', '.join([*_NAMES, *OF_ANSWERS])}")
        if isinstance(value, str) and len(value) > _MOST_LETTERS:
            raise HTTPException(400, f"{name}: a text of {len(value)} characters, expected at most {_MOST_LETTERS}")
        own = OF_ANSWERS.get(name)
        goes_to, read = (name, own) if own else (_NAMES[name].goes_to, _NAMES[name].read)
        if goes_to in hints:
            raise HTTPException(400, f"{name} is given twice: give it once")
        try:
            hints[goes_to] = read(value)
        except ValueError as error:
            raise HTTPException(400, f"{name}: {error}") from error
    return hints
