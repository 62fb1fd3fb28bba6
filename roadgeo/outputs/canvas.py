"""Drawing shared by all pictures: colours, dots, outlines of footprints, text, PNG (by OpenCV, red green blue)."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, BoolArray, FloatArray
from roadgeo.errors import OutputError

__all__ = [
    "FAINT_INK",
    "FRAME",
    "INK",
    "LIT",
    "MAP_ROAD",
    "MATCH",
    "PAPER",
    "QUERY_ROAD",
    "SHIFT",
    "Color",
    "draw_dots",
    "draw_outline",
    "draw_plate",
    "fixed_point",
    "touching",
    "write_png",
    "write_text",
]

Color = tuple[int, int, int]

# Red, green, blue; drawn in this order and turned for OpenCV at the end.
PAPER: Color = (243, 241, 236)
LIT: Color = (255, 255, 255)
MAP_ROAD: Color = (186, 188, 190)
QUERY_ROAD: Color = (228, 87, 46)
MATCH: Color = (27, 38, 59)
FRAME: Color = (31, 111, 180)
INK: Color = (38, 42, 48)
FAINT_INK: Color = (110, 114, 120)

SHIFT = 4  # fractional bits of the coordinates that OpenCV draws at


def write_png(path: Path, image: AnyArray) -> None:
    """Write a picture (H, W, 3).

    Raises
    ------
    OutputError
        It is too large for the format.
    """
    done, encoded = cv2.imencode(".png", image[:, :, ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])
    if not done:
        raise OutputError(f"cannot write {path}: OpenCV did not encode the picture; use a smaller one")
    path.write_bytes(encoded.tobytes())


def fixed_point(pixels: AnyArray) -> AnyArray:
    """Turn pixels into the fixed-point ones that OpenCV draws at."""
    return np.asarray(np.rint(pixels * (1 << SHIFT)).astype(np.int32))


def touching(ends: AnyArray, low: FloatArray, high: FloatArray) -> BoolArray:
    """Return which segments, given by their ends (S, 2, 2), may touch the box between two of its corners."""
    return np.asarray((ends.max(axis=1) >= low).all(axis=1) & (ends.min(axis=1) <= high).all(axis=1))


def draw_dots(image: AnyArray, centers: AnyArray, radius: float) -> None:
    """Draw ringed dots at (N, 2) fixed-point pixels."""
    for x, y in centers.tolist():
        cv2.circle(image, (x, y), round((radius + 1.6) * (1 << SHIFT)), LIT, -1, cv2.LINE_AA, SHIFT)
        cv2.circle(image, (x, y), round(radius * (1 << SHIFT)), MATCH, -1, cv2.LINE_AA, SHIFT)


def draw_outline(image: AnyArray, frame: AnyArray) -> None:
    """Outline a footprint, (4, 2) from its top left; a triangle outside it shows which way is up in the image."""
    cv2.polylines(image, [frame], True, LIT, 7, cv2.LINE_AA, SHIFT)
    cv2.polylines(image, [frame], True, FRAME, 4, cv2.LINE_AA, SHIFT)
    left, right = frame[0].astype(float), frame[1].astype(float)
    along = (right - left) / max(float(np.hypot(*(right - left))), 1.0)
    out = np.array([along[1], -along[0]])
    middle, size = (left + right) / 2, 16 * (1 << SHIFT)
    tip = np.array([middle - along * size, middle + along * size, middle + out * 1.3 * size])
    cv2.fillPoly(image, [np.rint(tip).astype(np.int32)], FRAME, cv2.LINE_AA, SHIFT)


def draw_plate(image: AnyArray, first: tuple[int, int], last: tuple[int, int]) -> None:
    """Lighten a rectangle, so that what is written there stands out from the roads."""
    part = image[max(first[1], 0) : last[1], max(first[0], 0) : last[0]]
    part[...] = (part * 0.15 + np.array(LIT) * 0.85).astype(np.uint8)


def write_text(image: AnyArray, text: str, origin: tuple[int, int], size: int, color: Color, bold: bool = False) -> int:
    """Write text with its baseline's left end at `origin`; return the x where it ends."""
    if hasattr(cv2, "FontFace"):
        (end, _), _ = cv2.putText(image, text, origin, color, cv2.FontFace("sans"), size, 700 if bold else 400)
        return int(end)
    # OpenCV 4 brings only stroked letters, and only ASCII ones.
    for sign, plain in (("°", " deg"), ("±", "+-"), ("·", "|"), ("©", "(c)")):
        text = text.replace(sign, plain)
    scale, thickness = size / 26, 2 if bold else 1
    cv2.putText(image, text, origin, cv2.FONT_HERSHEY_DUPLEX, scale, color, thickness, cv2.LINE_AA)
    (width, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_DUPLEX, scale, thickness)
    return origin[0] + int(width)
