"""Pieces of inline SVG whose size is bounded: paths of many lines, dots, pictures as data."""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, FloatArray

__all__ = ["draw_dots", "draw_image", "draw_lines", "join_segments", "thin_lines"]

#: Paths are written in whole tenths of the unit they are drawn in.
_TENTHS = 10

#: WebP qualities; OpenCV takes what exceeds 100 for lossless.
_QUALITY, _LOSSLESS = 78, 101


def join_segments(segments: FloatArray) -> list[FloatArray]:
    """Join segments (S, 2, 2), each of which may begin where the one before it ends, into polylines."""
    if len(segments) == 0:
        return []
    breaks = 1 + np.flatnonzero((segments[1:, 0] != segments[:-1, 1]).any(axis=1))
    return [np.vstack([run[:1, 0], run[:, 1]]) for run in np.split(segments, breaks)]


def thin_lines(lines: Sequence[FloatArray], limit: int, tolerance: float = 0.0) -> list[FloatArray]:
    """Drop vertices until at most `limit` are left: straighten ever more, then leave out the shortest lines.

    Parameters
    ----------
    tolerance : float
        How far lines may be moved at first, in their units.
    """
    kept = list(lines)
    if tolerance > 0:
        kept = [_straighten(line, tolerance) for line in kept]
    step = max(tolerance, 0.5)
    for _ in range(4):
        if sum(map(len, kept)) <= limit:
            return kept
        kept = [_straighten(line, step) for line in kept]
        step *= 3
    lengths = [float(np.hypot(*(line[1:] - line[:-1]).T).sum()) for line in kept]
    longest = np.argsort(-np.array(lengths), kind="stable")
    fitting = int(np.searchsorted(np.cumsum([len(kept[i]) for i in longest]), limit, side="right"))
    return [kept[i] for i in np.sort(longest[:fitting])]


def draw_lines(lines: Sequence[FloatArray]) -> str:
    """Draw polylines (V, 2), in SVG units with y down, as one path."""
    parts, last = [], np.zeros(2, np.int64)
    for line in lines:
        points = np.rint(np.asarray(line) * _TENTHS).astype(np.int64)
        steps = np.diff(points, axis=0)
        steps = steps[steps.any(axis=1)]
        if len(steps) == 0:
            continue
        dx, dy = points[0] - last
        last = points[-1]
        parts.append(f"m{dx} {dy}l" + " ".join(map(str, steps.ravel().tolist())).replace(" -", "-"))
    return _path("".join(parts))


def draw_dots(points: FloatArray, classes: Sequence[str] = ("",)) -> str:
    """Draw points (K, 2) as dots of a stroke's width: one path for each class, over one another."""
    ends = np.rint(np.asarray(points) * _TENTHS).astype(np.int64)
    d = "".join(f"M{x} {y}h.1" for x, y in ends.tolist())
    return "".join(_path(d, name) for name in classes)


def draw_image(image: AnyArray, box: tuple[float, float, float, float], limit: int, *, lossless: bool = False) -> str:
    """Draw a picture (H, W, 4) uint8, red, green, blue, alpha, stretched to a box (x, y, width, height).

    Parameters
    ----------
    limit : int
        Bytes of the encoded picture (a third more in the text); it is reduced until it fits.
    lossless : bool
        For drawings, which become smaller and sharper than when they are coded like photographs.
    """
    options = [cv2.IMWRITE_WEBP_QUALITY, _LOSSLESS if lossless else _QUALITY]
    picture = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGBA2BGRA)
    encoded = cv2.imencode(".webp", picture, options)[1]
    while len(encoded) > limit and min(picture.shape[:2]) > 1:
        factor = 0.9 * math.sqrt(limit / len(encoded))
        size = [max(round(side * factor), 1) for side in picture.shape[1::-1]]
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        encoded = cv2.imencode(".webp", picture, options)[1]
    x, y, width, height = (f"{value:.2f}" for value in box)
    return (
        f'<image href="data:image/webp;base64,{base64.b64encode(encoded.tobytes()).decode()}" '
        f'x="{x}" y="{y}" width="{width}" height="{height}" preserveAspectRatio="none"/>'
    )


def _straighten(line: FloatArray, tolerance: float) -> FloatArray:
    if len(line) < 3:
        return line
    if (line[0] == line[-1]).all():  # Douglas and Peucker start from a line between two different ends
        k = int(np.argmax(np.hypot(*(line - line[0]).T)))
        if k == 0:
            return line[:2]
        return np.concatenate([_straighten(line[: k + 1], tolerance), _straighten(line[k:], tolerance)[1:]])
    origin = line[0]  # 32-bit numbers are fine near it
    kept = cv2.approxPolyDP((line - origin).astype(np.float32), tolerance, False)[:, 0]
    return np.asarray(kept + origin, np.float64)


def _path(d: str, name: str = "") -> str:
    """Write a path given in tenths."""
    named = f' class="{name}"' if name else ""
    return f'<path{named} transform="scale({1 / _TENTHS:g})" d="{d}"/>' if d else ""
