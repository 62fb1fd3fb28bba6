"""The writer of pixels: layers on a canvas, text, legends and PNG files (by OpenCV; red, green, blue)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, FloatArray
from roadgeo.errors import OutputError
from roadgeo.outputs.drawing.layers import STYLES, Bitmap, Box, Color, Dots, Layer, Lines, Ring, Style, rgb

__all__ = [
    "FAINT", "INK", "LIT", "SHIFT", "Canvas", "below", "beside", "blank", "draw_legend", "draw_plate", "draw_scale_bar",
    "encode", "fixed_point", "framed", "line", "write_png", "write_text",
]  # fmt: skip

LIT, INK, FAINT = (255, 255, 255), rgb("ink"), rgb("faint")

SHIFT = 4  # fractional bits of the coordinates that OpenCV draws at

#: Pictures are looked at from farther away than screens: their strokes are this much wider.
_WEIGHT = 1.3

#: Rows that are blended at once, lest numbers of a large picture's whole take gigabytes.
_STRIP = 256


def blank(height: int, width: int, color: Color = LIT) -> AnyArray:
    """Return an empty picture (height, width, 3) uint8."""
    return np.full((height, width, 3), color, np.uint8)


def fixed_point(pixels: AnyArray) -> AnyArray:
    """Turn pixels into the fixed-point ones that OpenCV draws at."""
    return np.asarray(np.rint(np.clip(pixels, -20_000, 20_000) * (1 << SHIFT)).astype(np.int32))


@dataclass(frozen=True)
class Canvas:
    """A picture (h, w, 3) uint8 of a part of a frame: pixel = (position - corner) * scale."""

    image: AnyArray
    corner: tuple[float, float]
    scale: float

    @classmethod
    def of(cls, box: Box, width: int, height: int, scale: float | None = None) -> Canvas:
        """Lay paper under a box, as large as fits into (width, height) pixels, or at a scale."""
        scale = min(width / box[2], height / box[3]) if scale is None else scale
        size = (max(round(box[3] * scale), 1), max(round(box[2] * scale), 1))
        return cls(blank(*size, rgb("paper")), box[:2], scale)

    def pixels(self, xy: FloatArray) -> AnyArray:
        """Take positions (..., 2) to fixed-point pixels."""
        return fixed_point((xy - np.array(self.corner)) * self.scale - 0.5)

    def draw(self, layers: Sequence[Layer]) -> None:
        """Draw the layers that are shown, from the lowest up."""
        for layer in layers:
            if not layer.shown:
                continue
            for mark in layer.marks:
                self._draw_mark(mark, STYLES.get(layer.name))

    def _draw_mark(self, mark: object, style: Style | None) -> None:
        match mark, style:
            case Bitmap(image, box, _, _), _:
                self._blend(image, box)
            case Lines(lines), Style():
                drawn = [self.pixels(line) for line in lines]
                cv2.polylines(self.image, drawn, False, rgb(style.color), self._width(style), cv2.LINE_AA, SHIFT)
            case Dots(points, hollow), Style():
                self._draw_dots(self.pixels(points), style, hollow)
            case Ring(corners, up), Style():
                self._draw_ring(self.pixels(corners), style, up)

    def _width(self, style: Style) -> int:
        if style.width_m:
            return int(np.clip(round(style.width_m * self.scale), 2, 12))
        return max(round(style.width_px * _WEIGHT), 1)

    def _draw_dots(self, centers: AnyArray, style: Style, hollow: bool) -> None:
        crowd = 1.0 if len(centers) < 200 else 0.7 if len(centers) < 1000 else 0.3
        radius = style.width_px * _WEIGHT * crowd / 2
        outer, inner = (style.color, "paper") if hollow else ("halo", style.color)
        radii = (radius, radius / 2) if hollow else (radius + 1.6, radius)
        for x, y in centers.reshape(-1, 2).tolist():
            for color, size in zip((outer, inner), radii, strict=True):
                cv2.circle(self.image, (x, y), round(size * (1 << SHIFT)), rgb(color), -1, cv2.LINE_AA, SHIFT)

    def _draw_ring(self, ring: AnyArray, style: Style, up: bool) -> None:
        color = rgb(style.color)
        if style.fill:
            filled = self.image if style.fill == 1.0 else self.image.copy()
            cv2.fillPoly(filled, [ring], color, cv2.LINE_AA, SHIFT)
            self.image[...] = cv2.addWeighted(filled, style.fill, self.image, 1.0 - style.fill, 0.0)
        if style.width_px:
            width = self._width(style)
            cv2.polylines(self.image, [ring], True, LIT, width + 3, cv2.LINE_AA, SHIFT)
            cv2.polylines(self.image, [ring], True, color, width, cv2.LINE_AA, SHIFT)
        if up:
            left, right = ring[0].astype(float), ring[1].astype(float)
            along = (right - left) / max(float(np.hypot(*(right - left))), 1.0)
            out = np.array([along[1], -along[0]])
            middle, size = (left + right) / 2, 16 * (1 << SHIFT)
            tip = np.array([middle - along * size, middle + along * size, middle + out * 1.3 * size])
            cv2.fillPoly(self.image, [np.rint(tip).astype(np.int32)], color, cv2.LINE_AA, SHIFT)

    def _blend(self, picture: AnyArray, box: Box) -> None:
        """Lay a picture over a part of the canvas; pixels beyond it are cut off."""
        first = np.rint((np.array(box[:2]) - self.corner) * self.scale).astype(int)
        size = np.maximum(np.rint(np.array(box[2:]) * self.scale).astype(int), 1)
        way = cv2.INTER_AREA if size[0] < picture.shape[1] else cv2.INTER_NEAREST
        drawn = (
            picture if tuple(size) == picture.shape[1::-1] else cv2.resize(picture, size.tolist(), interpolation=way)
        )
        height, width = self.image.shape[:2]
        left, right = max(first[0], 0), min(first[0] + size[0], width)
        for top in range(max(first[1], 0), min(first[1] + size[1], height), _STRIP):
            bottom = min(top + _STRIP, first[1] + size[1], height)
            over = drawn[top - first[1] : bottom - first[1], left - first[0] : right - first[0]]
            below = self.image[top:bottom, left:right]
            opacity = over[..., 3:].astype(np.uint16)
            mixed = opacity * over[..., :3] + (255 - opacity) * below
            below[...] = (mixed + 127) // 255


# --- around the canvas ------------------------------------------------------------------------------------------------


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


def line(text: str, size: int, color: Color = INK, *, bold: bool = False) -> AnyArray:
    """Return a picture of a line of text, as wide as that is."""
    picture = blank(round(1.45 * size), size * (len(text) + 1))
    return picture[:, : write_text(picture, text, (0, round(1.1 * size)), size, color, bold)]


def below(*pictures: AnyArray, gap: int = 0, width: int = 0) -> AnyArray:
    """Put pictures below one another, at the left of white paper of a width, by default of the widest."""
    width = width or max(picture.shape[1] for picture in pictures)
    paper = blank(sum(map(len, pictures)) + gap * (len(pictures) - 1), width)
    top = 0
    for picture in pictures:
        paper[top : top + len(picture), : picture.shape[1]] = picture[:, :width]
        top += len(picture) + gap
    return paper


def beside(*pictures: AnyArray, gap: int = 0) -> AnyArray:
    """Put pictures beside one another, at the top of white paper."""
    return np.swapaxes(below(*(np.swapaxes(picture, 0, 1) for picture in pictures), gap=gap), 0, 1)


def framed(picture: AnyArray, margin: int) -> AnyArray:
    """Leave room around a picture."""
    return np.pad(picture, ((margin, margin), (margin, margin), (0, 0)), constant_values=255)


def draw_legend(image: AnyArray, layers: Sequence[Layer], x: int, baseline: int, size: int) -> int:
    """Write the labels of the layers that are shown, each with its sign, from (x, baseline) on; return the end."""
    middle = baseline - round(size * 0.35)
    for layer in layers:
        style = STYLES.get(layer.name)
        if style is None or not (layer.shown and layer.label and layer.marks):
            continue
        if isinstance(layer.marks[0], Dots):
            cv2.circle(image, (x + size // 2, middle), 6, rgb(style.color), -1, cv2.LINE_AA)
            end = x + round(1.3 * size)
        else:
            width = 6 if style.width_m else max(round(style.width_px * _WEIGHT), 3)
            end = x + round(2.5 * size)
            cv2.line(image, (x + 4, middle), (end - size // 2, middle), rgb(style.color), width, cv2.LINE_AA)
        x = write_text(image, layer.label, (end, baseline), size, INK) + round(1.4 * size)
    return x


def draw_scale_bar(canvas: Canvas, size: int) -> None:
    """Draw a scale bar, its letters `size` pixels high, in the lower left corner of a canvas whose unit is a metre."""
    image = canvas.image
    height, width = image.shape[:2]
    room = 0.22 * width / canvas.scale
    power = 10.0 ** math.floor(math.log10(room))
    length = next(step * power for step in (5.0, 2.0, 1.0) if step * power <= room)
    text = f"{length:g} m" if length < 1000 else f"{length / 1000:g} km"
    left, bar, y = round(width * 0.025), round(length * canvas.scale), height - round(1.2 * size)
    draw_plate(image, (left - 14, y - 2 * size - 6), (left + bar + 14, y + 16))
    cv2.rectangle(image, (left, y), (left + bar, y + 5), INK, -1)
    cv2.rectangle(image, (left + bar // 2, y + 1), (left + bar - 1, y + 4), LIT, -1)
    write_text(image, text, (left, y - size // 2), size, INK)


def draw_plate(image: AnyArray, first: tuple[int, int], last: tuple[int, int]) -> None:
    """Lighten a rectangle, so that what is written there stands out from the roads."""
    part = image[max(first[1], 0) : last[1], max(first[0], 0) : last[0]]
    part[...] = (part * 0.15 + np.array(LIT) * 0.85).astype(np.uint8)


def write_png(path: Path, image: AnyArray) -> None:
    """Write a picture (H, W, 3) as `encode` does; at 9 it would take four times as long, for 2 % fewer bytes."""
    path.write_bytes(encode(image, ".png", cv2.IMWRITE_PNG_COMPRESSION, 6))


def encode(image: AnyArray, suffix: str, *settings: int) -> bytes:
    """Return the file of a picture (H, W, 3), or with opacity (H, W, 4), in the format of a suffix.

    Raises
    ------
    OutputError
        It is too large for the format.
    """
    turned = cv2.COLOR_RGBA2BGRA if image.shape[2] == 4 else cv2.COLOR_RGB2BGR
    done, encoded = cv2.imencode(suffix, cv2.cvtColor(np.ascontiguousarray(image), turned), settings)
    if not done:
        raise OutputError("OpenCV did not encode the picture; use a smaller one")
    return encoded.tobytes()
