"""What is asked of the server: an image in the body, or in JSON, and hints; all of it may be hostile."""

from __future__ import annotations

import base64
import binascii
import json
import math
from collections.abc import Mapping
from typing import Any
from urllib.parse import parse_qsl

from roadgeo.geometry.areas import is_box

__all__ = ["LIMIT", "Refused", "ending_of", "read_execution", "read_hints", "read_query_string", "read_texts"]

#: How files begin that are read. What refers to other files, as a VRT does, is none of them.
_MAGIC = {
    b"\x89PNG\r\n\x1a\n": ".png",
    b"II*\0": ".tif",
    b"MM\0*": ".tif",
    b"II+\0": ".tif",
    b"MM\0+": ".tif",
    b"\xff\xd8\xff": ".jpg",
    b"BM": ".bmp",
    b"P5": ".pgm",
    b"P4": ".pgm",
    b"\0\0\0\x0cjP  ": ".jp2",
}

_NAMES = ("near", "within", "gsd", "maxTilt", "focal", "heading", "northUp", "timeLimit")


class Refused(Exception):  # noqa: N818 (an answer, not a fault)
    """A request that cannot be served: an HTTP status, and what was wrong, expected, and to do."""

    def __init__(self, status: int, detail: str, retry_after_s: int | None = None) -> None:
        super().__init__(detail)
        self.status, self.detail, self.retry_after_s = status, detail, retry_after_s


def ending_of(head: bytes) -> str:
    """Return the suffix of an image by its first bytes.

    Raises
    ------
    Refused
        It is none that is read.
    """
    if head[:4] == b"RIFF" and head[8:12] == b"WEBP":
        return ".webp"
    for magic, ending in _MAGIC.items():
        if head.startswith(magic):
            return ending
    raise Refused(415, "the body is no image; expected PNG, TIFF, JPEG, WebP, JPEG 2000, BMP or PGM")


def read_query_string(text: str) -> dict[str, Any]:
    """Read hints from a URL: numbers are separated by commas.

    Raises
    ------
    Refused
        A name is not known, or a value is none.
    """
    try:
        return read_texts(dict(parse_qsl(text, True, strict_parsing=bool(text), max_num_fields=20)))
    except ValueError as error:
        raise Refused(400, f"the query of the URL cannot be read: {error}") from error


def read_texts(given: Mapping[str, str]) -> dict[str, Any]:
    """Read hints that are texts, of a URL or of a form.

    Raises
    ------
    Refused
        A name is not known, or a value is none.
    """
    values: dict[str, Any] = {}
    for name, text in given.items():
        if name == "northUp":
            values[name] = text.lower() in ("", "1", "true", "yes")
            continue
        try:
            numbers = [float(part) for part in text.split(",")]
        except ValueError as error:
            raise Refused(400, f"{name[:40]}: got {text[:40]!r}, expected numbers with commas between") from error
        values[name] = numbers if len(numbers) > 1 else numbers[0]
    return read_hints(values)


def read_hints(values: Mapping[str, Any]) -> dict[str, Any]:
    """Check hints and give them the names that the search has for them; `timeLimit` stays beside them.

    Raises
    ------
    Refused
        A name is not known, or a value makes no sense.
    """
    unknown = [name for name in values if name not in _NAMES]
    if unknown:
        raise Refused(400, f"got {str(unknown[0])[:40]!r}, expected one of {', '.join(_NAMES)}")
    hints: dict[str, Any] = {}
    if "near" in values:
        lon, lat, radius = _numbers(values, "near", 3)
        _require(-180 <= lon <= 180 and -90 <= lat <= 90 and 0 < radius < 2e7, "near", "LON,LAT,RADIUS in metres")
        hints["near"] = (lon, lat, radius)
    if "within" in values:
        west, south, east, north = _numbers(values, "within", 4)
        hints["within"] = (west, south, east, north)
        _require(is_box(hints["within"]), "within", "WEST,SOUTH,EAST,NORTH in degrees, south below north")
    if "gsd" in values:
        low, high = _numbers(values, "gsd", 2)
        _require(0 < low <= high < 1e4, "gsd", "LOW,HIGH in metres per pixel")
        hints["gsd_m"] = (low, high)
    for name, ours, most in (("maxTilt", "max_tilt_deg", 80.0), ("focal", "focal_px", 1e6), ("timeLimit", LIMIT, 1e6)):
        if name in values:
            (value,) = _numbers(values, name, 1)
            _require(0 < value <= most, name, f"a number above 0 and not above {most:g}")
            hints[ours] = value
    if "northUp" in values:
        _require(isinstance(values["northUp"], bool), "northUp", "true or false")
        hints["north_up"] = values["northUp"]
    if "heading" in values:
        center, off = _numbers(values, "heading", 2)
        _require(-360 <= center <= 360 and 0 < off <= 180, "heading", "DEG,DEG: clockwise from north, give or take")
        hints["heading_deg"] = (center, off)
    return hints


#: In JSON that asks for one image, which has a dozen of each.
_MOST_NESTED, _MOST_VALUES = 64, 256

#: Under this name a time limit stands among the hints.
LIMIT = "time_limit_s"


def read_execution(body: bytes) -> tuple[bytes, dict[str, Any]]:
    """Read the body of an execute request (OGC API - Processes, 7.11): the image, and hints.

    Raises
    ------
    Refused
        It is none.
    """
    # A byte of brackets takes thirty once it is parsed; base64 holds none of these signs.
    if sum(map(body.count, (b"[", b"{"))) > _MOST_NESTED or body.count(b",") > _MOST_VALUES:
        raise Refused(400, f"JSON of more than {_MOST_NESTED} brackets or {_MOST_VALUES} commas, expected few of both")
    try:
        asked = json.loads(body)
    except (ValueError, RecursionError) as error:
        raise Refused(400, f"the body is no JSON: {str(error)[:200]}") from error
    inputs = asked.get("inputs") if isinstance(asked, dict) else None
    if not isinstance(inputs, dict) or "image" not in inputs:
        raise Refused(400, 'expected {"inputs": {"image": {"value": BASE64, "mediaType": "image/png"}}}')
    image = inputs["image"]
    if isinstance(image, dict) and "href" in image:
        raise Refused(
            400, "image: got a link; this server fetches nothing: send the image itself, base64, as its value"
        )
    value = image.get("value") if isinstance(image, dict) else image
    if not isinstance(value, str):
        raise Refused(400, "image: expected its bytes, base64, in a text")
    try:
        content = base64.b64decode(value, validate=True)
    except (binascii.Error, ValueError) as error:
        raise Refused(400, f"image: no base64: {error}") from error
    return content, read_hints({name: given for name, given in inputs.items() if name != "image"})


def _numbers(values: Mapping[str, Any], name: str, count: int) -> list[float]:
    value = values[name]
    numbers = value if isinstance(value, list) else [value]
    good = len(numbers) == count and all(type(one) in (int, float) and abs(one) < 1e12 for one in numbers)
    _require(good and all(map(math.isfinite, numbers)), name, f"{count} number{'s' * (count > 1)}")
    return [float(one) for one in numbers]


def _require(good: bool, name: str, expected: str) -> None:
    if not good:
        raise Refused(400, f"{name}: expected {expected}")
