"""A picture of a result: photograph and mask, and their roads, matches and footprint on the map (PNG, by OpenCV)."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, FloatArray
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.mask import RoadMask, plane_to_pixel
from roadgeo.location import Location
from roadgeo.outputs.canvas import (
    FAINT_INK,
    FRAME,
    INK,
    LIT,
    MAP_ROAD,
    MATCH,
    PAPER,
    QUERY_ROAD,
    SHIFT,
    Color,
    draw_dots,
    draw_outline,
    draw_plate,
    fixed_point,
    touching,
    write_png,
    write_text,
)
from roadgeo.outputs.orthophoto import read_preview
from roadgeo.outputs.paths import Placement
from roadgeo.outputs.subject import Subject
from roadgeo.outputs.wording import format_lonlat

__all__ = ["PlotOptions", "draw_overlay", "write_overlay"]

_GAP = 24  # pixels between the two panels


@dataclass(frozen=True)
class PlotOptions:
    """Size of the picture.

    Attributes
    ----------
    map_px : int
        Longer side of the map.
    margin : float
        Ground shown around the footprint, in lengths of its longer side.
    mask_share : float
        Width of the panel that shows photograph and mask as they came, as a share of `map_px`.
    """

    map_px: int = 1400
    margin: float = 0.14
    mask_share: float = 0.6


@dataclass(frozen=True)
class _Canvas:
    """The picture and where it lies: pixel = (crs - (west, north)) * (scale, -scale) + (0, top)."""

    image: AnyArray
    west: float
    north: float
    scale: float
    top: int

    def pixels(self, xy: FloatArray) -> AnyArray:
        """Take CRS positions (..., 2) to the fixed-point pixels that OpenCV draws at."""
        at = (xy - (self.west, self.north)) * (self.scale, -self.scale) + (-0.5, self.top - 0.5)
        return fixed_point(np.clip(at, -20_000, 20_000))

    def draw_lines(self, lines: list[AnyArray], color: Color, width: int) -> None:
        """Draw polylines given in fixed-point pixels."""
        cv2.polylines(self.image, lines, False, color, width, cv2.LINE_AA, SHIFT)


def write_overlay(path: Path, subject: Subject) -> None:
    """Write `draw_overlay` as PNG."""
    photo = None if subject.photo is None else read_preview(subject.photo, PlotOptions.map_px)
    write_png(path, draw_overlay(subject.location, subject.mask, subject.roads, subject.attribution, photo=photo))


def draw_overlay(
    location: Location,
    mask: RoadMask,
    roads: FloatArray,
    attribution: str = "",
    options: PlotOptions | None = None,
    photo: AnyArray | None = None,
) -> AnyArray:
    """Draw a located mask on the map.

    Parameters
    ----------
    roads : (S, 4) float64
        Segments x1, y1, x2, y2 of the reference's roads in the location's CRS; those far away are skipped.
    attribution : str
        Whom the map's licence asks to name.
    photo : (h, w, 4) uint8, optional
        The photograph that the mask was made of, at any scale: red, green, blue, alpha.

    Returns
    -------
    (height, width, 3) uint8
        The mask as it came, below the photograph, on the left; where it lies on the right.
        Red, green, blue.

    Raises
    ------
    OutputError
        The location has no place.
    """
    options = options or PlotOptions()
    place = Placement.of(location)
    canvas = _lay_canvas(place, options)
    frame = canvas.pixels(place.footprint)
    cv2.fillPoly(canvas.image, [frame], LIT, cv2.LINE_AA, SHIFT)
    _draw_map(canvas, roads)
    _draw_query(canvas, location, place)
    draw_outline(canvas.image, frame)
    _draw_matches(canvas, location)
    _draw_scale_bar(canvas)
    _draw_north(canvas)
    _draw_legend(canvas)
    left = np.full((canvas.image.shape[0], round(options.map_px * options.mask_share), 3), LIT, np.uint8)
    _draw_frames(left[canvas.top : len(left) - canvas.top // 2], location, mask, photo)  # between title and legend
    gap = np.full((canvas.image.shape[0], _GAP, 3), LIT, np.uint8)
    picture = np.hstack([left, gap, canvas.image])
    _draw_title(picture, location, canvas.top)
    write_text(
        picture, attribution, (_GAP, len(picture) - round(canvas.top * 0.15)), round(canvas.top * 0.2), FAINT_INK
    )
    return picture


# --- the map ----------------------------------------------------------------------------------------------------------


def _lay_canvas(place: Placement, options: PlotOptions) -> _Canvas:
    low, high = place.footprint.min(axis=0), place.footprint.max(axis=0)
    margin = options.margin * float((high - low).max())
    low, high = low - margin, high + margin
    # At most 3 : 2 either way, so that captions fit and a long footprint still leaves room.
    width, height = (high - low).tolist()
    extra = np.maximum((height / 1.5 - width, width / 1.5 - height), 0) / 2
    low, high = low - extra, high + extra
    width, height = (high - low).tolist()
    scale = options.map_px / max(width, height)
    top = round(options.map_px * 0.075)
    image = np.full((round(height * scale) + top + top // 2, round(width * scale), 3), PAPER, np.uint8)
    return _Canvas(image, float(low[0]), float(high[1]), scale, top)


def _draw_map(canvas: _Canvas, roads: FloatArray) -> None:
    """Draw the roads of the map about as wide as a street, where that can be seen."""
    height, width = canvas.image.shape[:2]
    low = np.array([canvas.west, canvas.north - height / canvas.scale])
    high = np.array([canvas.west + width / canvas.scale, canvas.north + canvas.top / canvas.scale])
    ends = roads.reshape(-1, 2, 2)
    street = int(np.clip(round(9.0 * canvas.scale), 2, 12))
    canvas.draw_lines(list(canvas.pixels(ends[touching(ends, low, high)])), MAP_ROAD, street)


def _draw_query(canvas: _Canvas, location: Location, place: Placement) -> None:
    if location.evidence is None:
        return
    lines = place.map_roads(location.evidence.query_graph)
    canvas.draw_lines([canvas.pixels(line) for line in lines], QUERY_ROAD, 2)


def _draw_matches(canvas: _Canvas, location: Location) -> None:
    if location.evidence is not None:
        draw_dots(canvas.image, canvas.pixels(location.evidence.reference_xy), 4.4 if location.n_matched < 200 else 3.4)


# --- what stands around it --------------------------------------------------------------------------------------------


def _draw_scale_bar(canvas: _Canvas) -> None:
    height, width = canvas.image.shape[:2]
    room = 0.22 * width / canvas.scale
    power = 10.0 ** math.floor(math.log10(room))
    length = next(step * power for step in (5.0, 2.0, 1.0) if step * power <= room)
    text = f"{length:g} m" if length < 1000 else f"{length / 1000:g} km"
    size = canvas.top // 4
    left, bar = round(width * 0.025), round(length * canvas.scale)
    y = height - canvas.top // 2 - round(canvas.top * 0.3)
    draw_plate(canvas.image, (left - 14, y - 2 * size - 6), (left + bar + 14, y + 16))
    cv2.rectangle(canvas.image, (left, y), (left + bar, y + 5), INK, -1)
    cv2.rectangle(canvas.image, (left + bar // 2, y + 1), (left + bar - 1, y + 4), LIT, -1)
    write_text(canvas.image, text, (left, y - size // 2), size, INK)


def _draw_north(canvas: _Canvas) -> None:
    width = canvas.image.shape[1]
    size = canvas.top // 4
    x, y = width - 2 * size, canvas.top + round(2.2 * size)
    draw_plate(canvas.image, (x - round(1.3 * size), y - round(1.8 * size)), (width - size // 2, y + round(2.6 * size)))
    arrow = np.array([[x, y - 1.4 * size], [x + 0.8 * size, y + size], [x, y + 0.5 * size], [x - 0.8 * size, y + size]])
    cv2.fillPoly(canvas.image, [fixed_point(arrow)], INK, cv2.LINE_AA, SHIFT)
    write_text(canvas.image, "N", (x - round(0.36 * size), y + round(2.2 * size)), size, INK, bold=True)


def _draw_title(image: AnyArray, location: Location, top: int) -> None:
    left = _GAP
    write_text(image, _title(location), (left, round(top * 0.44)), round(top * 0.32), INK, bold=True)
    write_text(image, _summary(location), (left, round(top * 0.82)), round(top * 0.23), FAINT_INK)


def _title(location: Location) -> str:
    name = os.path.basename(location.query)  # noqa: PTH119 (a name, not a file)
    if location.center is None:
        return name
    return f"{name}: {format_lonlat(location.center.lon, location.center.lat)}"


def _summary(location: Location) -> str:
    parts = [f"{location.n_matched} of {location.n_intersections} intersections matched"]
    if location.corner_sigma_m is not None:
        parts.append(f"corners ± {float(location.corner_sigma_m.max()):.1f} m")
    if location.gsd_m is not None:
        parts.append(f"{location.gsd_m:.2f} m per pixel")
    if location.rotation_deg is not None:
        parts.append(f"up is {location.rotation_deg % 360:.0f}°")
    if location.log10_odds is not None:
        parts.append(f"odds 10^{location.log10_odds:.0f} : 1")
    return "   ·   ".join(parts)


def _draw_legend(canvas: _Canvas) -> None:
    image, top = canvas.image, canvas.top
    height = image.shape[0]
    image[:top] = LIT
    image[height - top // 2 :] = LIT
    x, baseline, size = 0, height - round(top * 0.15), round(top * 0.22)
    middle = baseline - round(size * 0.35)
    lines = (("roads of the map", MAP_ROAD, 6), ("roads of the mask", QUERY_ROAD, 3), ("footprint", FRAME, 4))
    for label, color, width in lines:
        cv2.line(image, (x + 4, middle), (x + 2 * size, middle), color, width, cv2.LINE_AA)
        x = write_text(image, label, (x + round(2.5 * size), baseline), size, INK) + round(1.4 * size)
    cv2.circle(image, (x, middle), 6, MATCH, -1, cv2.LINE_AA)
    write_text(image, "matched intersections", (x + size, baseline), size, INK)


# --- the photograph and the mask --------------------------------------------------------------------------------------


def _draw_frames(panel: AnyArray, location: Location, mask: RoadMask, photo: AnyArray | None) -> None:
    """Draw the photograph, if there is one, above the mask, in the middle of a panel (h, w, 3)."""
    height, width = panel.shape[:2]
    rows, columns = mask.shape
    n = 1 if photo is None else 2
    room = np.array([width - 2 * _GAP, (height - 2 * n * _GAP) / n])
    scale = float((room / (columns, rows)).min())
    size = (max(round(columns * scale), 1), max(round(rows * scale), 1))
    left, top = (width - size[0]) // 2 + _GAP // 4, (height - n * size[1] - (n - 1) * 2 * _GAP) // 2
    if photo is not None:
        _draw_frame(panel, _over_paper(cv2.resize(photo, size, interpolation=cv2.INTER_AREA)), left, top)
        top += size[1] + 2 * _GAP
    gray = np.where(mask.roads, np.uint8(60), np.uint8(236))
    if mask.observed is not None:
        gray[~mask.observed] = 200
    small = cv2.resize(gray, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST)
    _draw_frame(panel, small[..., None], left, top)
    if location.evidence is not None:
        at = plane_to_pixel(location.evidence.query_xy) * scale + (left - 0.5, top - 0.5)
        draw_dots(panel, fixed_point(at), 3.6 if location.n_matched < 200 else 2.4)


def _draw_frame(panel: AnyArray, picture: AnyArray, left: int, top: int) -> None:
    """Draw a picture (h, w, 1 or 3) into a panel, and its outline, with a triangle where its up is."""
    height, width = picture.shape[:2]
    panel[top : top + height, left : left + width] = picture
    draw_outline(panel, fixed_point(np.add(Frame(width, height).corners, (left, top))))


def _over_paper(picture: AnyArray) -> AnyArray:
    """Return a picture (h, w, 4), red, green, blue, alpha, without what is transparent in it: (h, w, 3)."""
    opacity = picture[..., 3:] / 255.0
    return np.asarray(np.rint(opacity * picture[..., :3] + (1.0 - opacity) * np.array(PAPER)), np.uint8)
