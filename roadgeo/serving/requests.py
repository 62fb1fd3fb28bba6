"""Requests to the server: an image in the body, or in JSON, and hints; all of it may be hostile."""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Mapping
from typing import Any
from urllib.parse import parse_qsl

from roadgeo.matching.hints import HINTS

__all__ = ["LIMIT", "Refused", "ending_of", "read_execution", "read_hints", "read_query_string"]

#: First bytes of the files that are read. Files that refer to others, as a VRT does, are not among them.
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

#: Hints by their names over HTTP.
_NAMES = {hint.parameter: hint for hint in HINTS.values()}
#: Of a text among them.
_MOST_LETTERS = 200
#: Under this name a time limit stands among the hints.
LIMIT = HINTS["time_limit"].goes_to


class Refused(Exception):  # noqa: N818 (an answer, not a fault)
    """A request that cannot be served: an HTTP status, and the fault, the expectation and the remedy."""

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
    """Read hints from a URL.

    Raises
    ------
    Refused
        A name is not known, or a value is none.
    """
    try:
        return read_hints(dict(parse_qsl(text, True, strict_parsing=bool(text), max_num_fields=20)))
    except ValueError as error:
        raise Refused(400, f"the query of the URL cannot be read: {error}") from error


def read_hints(values: Mapping[str, Any]) -> dict[str, Any]:
    """Check hints, texts or JSON, and give them the names that the search has for them.

    Raises
    ------
    Refused
        A name is not known, or a value makes no sense.
    """
    hints: dict[str, Any] = {}
    for name, value in values.items():
        if name not in _NAMES:
            raise Refused(400, f"got {str(name)[:40]!r}, expected one of {', '.join(_NAMES)}")
        if isinstance(value, str) and len(value) > _MOST_LETTERS:
            raise Refused(400, f"{name}: a text of {len(value)} characters, expected at most {_MOST_LETTERS}")
        hint = _NAMES[name]
        try:
            hints[hint.goes_to] = hint.read(value)
        except ValueError as error:
            raise Refused(400, f"{name}: {error}") from error
    return hints


#: In JSON that asks for one image, which has a dozen of each.
_MOST_NESTED, _MOST_VALUES = 64, 256


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
