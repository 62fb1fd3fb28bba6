"""The writer of SVG: layers as groups, marks as paths whose size is bounded, and their looks as a style sheet."""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from urllib.parse import quote

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, FloatArray
from roadgeo._text import in_html
from roadgeo.outputs.drawing.layers import (
    PALETTE,
    STYLES,
    Arrows,
    Bitmap,
    Box,
    Circles,
    Cross,
    Dots,
    Layer,
    Lines,
    Mark,
    Ring,
    Style,
)
from roadgeo.outputs.drawing.raster import encode

__all__ = [
    "draw_dots", "draw_image", "draw_layer", "draw_lines", "draw_marks", "draw_sign", "encode_picture",
    "join_segments", "ring_data", "stylesheet", "thin_lines",
]  # fmt: skip

#: Paths are written in whole tenths of the unit they are drawn in.
_TENTHS = 10

#: WebP qualities; OpenCV takes what exceeds 100 for lossless.
_QUALITY, _LOSSLESS = 78, 101


# --- looks ------------------------------------------------------------------------------------------------------------


def stylesheet() -> str:
    """Return the colours, light and dark, and the style of every layer, as CSS."""
    light, dark = ("".join(f" --{name}: {colors[screen]};" for name, colors in PALETTE.items()) for screen in (0, 1))
    rules = [
        f":root {{ color-scheme: light dark;{light} }}",
        f"@media (prefers-color-scheme: dark) {{ :root {{{dark} }} }}",
        "svg * { vector-effect: non-scaling-stroke; fill: none; stroke-linejoin: round; stroke-linecap: round; }",
        *(_rule(name, style) for name, style in STYLES.items()),
        ".matches path.halo { stroke: var(--halo); stroke-width: 10px; }",
        ".unmatched path.core { stroke: var(--paper); stroke-width: 2.4px; }",
        ".footprint path.up, .edge path.up { fill: var(--frame); stroke: none; }",
        ".fixed { transform: scale(var(--u)); }",
        "svg text { fill: var(--ink); stroke: var(--halo); stroke-width: 4px; paint-order: stroke; }",
        "svg text { font: 600 13px system-ui, sans-serif; }",
    ]
    return "\n".join(rules) + "\n"


def _rule(name: str, style: Style) -> str:
    """Write the style of a layer: of its group in a view, and of its sign in a legend."""
    width = f"{style.width_px:g}px"
    if style.width_m:
        width = f"clamp(2px, calc({style.width_m:g}px / var(--u, 3)), 14px)"
    parts = [f"stroke: var(--{style.color})" if style.width_px else "stroke: none", f"stroke-width: {width}"]
    if style.fill:
        parts += [f"fill: var(--{style.color})", f"fill-opacity: {style.fill:g}"]
    if style.dash:
        parts.append(f"stroke-dasharray: {style.dash}")
    where = ", ".join(f"{group}{name} {shape}" for group in ("svg .", "svg.") for shape in ("path", "circle"))
    return f"{where} {{ {'; '.join(parts)}; }}"


# --- layers and marks -------------------------------------------------------------------------------------------------


def draw_layer(layer: Layer) -> str:
    """Draw a layer as a group that bears its name."""
    return f'<g class="{layer.name}{"" if layer.shown else " off"}">{draw_marks(layer.marks)}</g>'


def draw_marks(marks: Sequence[Mark]) -> str:
    """Draw marks; "" where there is nothing to see in them."""
    return "".join(map(_draw_mark, marks))


def _draw_mark(mark: Mark) -> str:
    match mark:
        case Lines(lines):
            return draw_lines(lines)
        case Dots(points, hollow):
            return draw_dots(points, ("", "core") if hollow else ("halo", ""))
        case Ring():
            return _draw_ring(mark)
        case Bitmap(image, box, max_bytes, lossless):
            return draw_image(image, box, max_bytes, lossless=lossless)
        case Arrows(at, steps):
            return _draw_arrows(at, steps)
        case Circles(centers, radii, texts):
            return _draw_circles(centers, radii, texts)
        case Cross(at, text):
            cross = '<path d="M-9-9L9 9M-9 9L9-9"/>'
            return _fixed(at, f'{cross}<text x="13" y="5">{in_html(text)}</text>')


def draw_sign(layer: Layer) -> str:
    """Draw the sign of a layer in a legend, 26 by 14."""
    mark = next(iter(layer.marks), None)
    match mark:
        case Dots(_, hollow):
            first, second = ("", ' class="core"') if hollow else (' class="halo"', "")
            return f'<path{first} d="M13 7h.1"/><path{second} d="M13 7h.1"/>'
        case Bitmap():
            return '<rect x="3" y="2" width="20" height="10"/>'
        case Ring():
            return '<path d="M3 2h20v10h-20z"/>'
        case Arrows():
            return '<path d="M3 7h18m-5-4l5 4l-5 4"/>'
        case Circles():
            return '<circle cx="13" cy="7" r="5"/>'
        case Cross():
            return '<path d="M8 2l10 10m0-10l-10 10"/>'
    return '<path d="M2 7h22"/>'


def ring_data(corners: FloatArray) -> str:
    """Return the path data of a closed ring (K, 2)."""
    return "M" + " ".join(f"{x:.1f},{y:.1f}" for x, y in corners.tolist()) + "z"


def _fixed(at: FloatArray, content: str) -> str:
    """Put something that keeps its size on the screen at a position."""
    return f'<g transform="translate({at[0]:.2f} {at[1]:.2f})"><g class="fixed">{content}</g></g>'


def _draw_ring(ring: Ring) -> str:
    if not np.isfinite(ring.corners).all():
        return ""
    number = "" if ring.number is None else f' data-number="{ring.number}"'
    title = f"<title>{in_html(ring.title)}</title>" if ring.title else ""
    drawn = f'<path d="{ring_data(ring.corners)}"{number}>{title}</path>'
    if ring.up:
        left, right = ring.corners[:2]
        turn = math.degrees(math.atan2(right[1] - left[1], right[0] - left[0]))
        up = f'<g transform="rotate({turn:.1f})"><path class="up" d="M-11 0L0-14L11 0z"/></g>'
        drawn += _fixed((left + right) / 2, up)
    return f'<a href="{in_html(quote(ring.link))}">{drawn}</a>' if ring.link else drawn


def _draw_arrows(at: FloatArray, steps: FloatArray) -> str:
    """Draw arrows that the style sheet enlarges about their feet."""
    parts = []
    for (x, y), (dx, dy) in zip(at.tolist(), steps.tolist(), strict=True):
        if not math.hypot(dx, dy) > 0.005:  # too short to be seen, or beyond the horizon
            continue
        barbs = ((-0.3 * dx - 0.2 * dy, -0.3 * dy + 0.2 * dx), (-0.3 * dx + 0.2 * dy, -0.3 * dy - 0.2 * dx))
        head = "".join(f"M{dx:.3g} {dy:.3g}l{bx:.3g} {by:.3g}" for bx, by in barbs)
        parts.append(f'<g transform="translate({x:.2f} {y:.2f})"><path d="M0 0L{dx:.3g} {dy:.3g}{head}"/></g>')
    return "".join(parts)


def _draw_circles(centers: FloatArray, radii: FloatArray, texts: Sequence[str]) -> str:
    """Draw circles that the style sheet enlarges like the arrows."""
    return "".join(
        f'<g transform="translate({x:.2f} {y:.2f})"><circle r="{radius:.3g}"/>'
        f'<g class="fixed"><text x="8" y="-8">{in_html(text)}</text></g></g>'
        for (x, y), radius, text in zip(centers.tolist(), radii.tolist(), texts, strict=True)
        if math.isfinite(x + y + radius)
    )


# --- paths and pictures -----------------------------------------------------------------------------------------------


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


def draw_image(image: AnyArray, box: Box, limit: int, *, lossless: bool = False) -> str:
    """Draw a picture (H, W, 4) uint8, red, green, blue, alpha, stretched to a box (x, y, width, height).

    See `encode_picture` for `limit` and `lossless`.
    """
    x, y, width, height = (f"{value:.2f}" for value in box)
    return (
        f'<image href="{encode_picture(image, limit, lossless=lossless)}" '
        f'x="{x}" y="{y}" width="{width}" height="{height}" preserveAspectRatio="none"/>'
    )


def encode_picture(image: AnyArray, limit: int, *, lossless: bool = False) -> str:
    """Return a picture (H, W, 4) uint8, red, green, blue, alpha, as an address that holds it (data:image/webp).

    Parameters
    ----------
    limit : int
        Bytes of the encoded picture (a third more in the text); it is reduced until it fits.
    lossless : bool
        For drawings, which become smaller and sharper than when they are coded like photographs.
    """
    settings = cv2.IMWRITE_WEBP_QUALITY, _LOSSLESS if lossless else _QUALITY
    while len(encoded := encode(image, ".webp", *settings)) > limit and min(image.shape[:2]) > 1:
        factor = 0.9 * math.sqrt(limit / len(encoded))
        size = [max(round(side * factor), 1) for side in image.shape[1::-1]]
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return f"data:image/webp;base64,{base64.b64encode(encoded).decode()}"


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
