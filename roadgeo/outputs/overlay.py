"""A picture of a result: photograph and mask, and their roads, matches and footprint on the map (PNG)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from roadgeo._arrays import AnyArray
from roadgeo.location import Location
from roadgeo.outputs.drawing.layers import Layer
from roadgeo.outputs.drawing.raster import (
    FAINT,
    INK,
    LIT,
    SHIFT,
    Canvas,
    blank,
    draw_legend,
    draw_plate,
    draw_scale_bar,
    fixed_point,
    write_png,
    write_text,
)
from roadgeo.outputs.drawing.views import STILL, Window, frame_layers, mask_layer, place_layers
from roadgeo.outputs.names import bare_name
from roadgeo.outputs.subject import Subject, ViewLimits
from roadgeo.outputs.wording import format_lonlat, write_sigma

__all__ = ["MAP_PX", "MASK_SHARE", "draw_overlay", "write_overlay"]

_GAP = 24  # pixels between the panels

_LONGEST = 1.5  # ratio of the map's sides, so that captions fit and a long footprint still leaves room


#: Longer side of the map, pixels; the ground around the footprint, in lengths of its longer side; and the width of the
#: panel that shows photograph and mask as they came, as a share of the map's side.
MAP_PX, _MARGIN, MASK_SHARE = 1400, 0.14, 0.6


def write_overlay(path: Path, subject: Subject) -> None:
    """Write `draw_overlay` as PNG."""
    write_png(path, draw_overlay(replace(subject, views=ViewLimits(picture_px=MAP_PX))))


def draw_overlay(subject: Subject, map_px: int = MAP_PX) -> AnyArray:
    """Draw a located mask on the map.

    Returns
    -------
    (height, width, 3) uint8
        The mask, below the photograph, on the left; where it lies on the right. Red, green, blue.

    Raises
    ------
    OutputError
        The location has no place.
    """
    # The map.
    window = Window.around(subject.place.footprint, _MARGIN).no_longer_than(_LONGEST)
    canvas = Canvas.of(window.box, map_px, map_px)
    layers = [layer for layer in place_layers(subject, window) if layer.name in STILL]
    canvas.draw(layers)
    top = round(map_px * 0.075)
    draw_scale_bar(canvas, top // 4)
    _draw_north(canvas.image, top)
    # The frame beside it, title and legend around both.
    height, width = canvas.image.shape[:2]
    left = blank(height, round(map_px * MASK_SHARE))
    _draw_frames(left, subject)
    panels = np.hstack([left, blank(height, _GAP), canvas.image])
    picture = np.vstack([blank(top, panels.shape[1]), panels, blank(top // 2, panels.shape[1])])
    baseline, size = len(picture) - round(top * 0.15), round(top * 0.22)
    wide = draw_legend(blank(top, width), layers, 0, top // 2, size)
    size = min(size, size * width // max(wide, 1))  # a map of a portrait is narrow
    draw_legend(picture, layers, picture.shape[1] - width, baseline, size)
    write_text(picture, subject.attribution, (_GAP, baseline), round(top * 0.2), FAINT)
    location = subject.location
    write_text(picture, _title(location), (_GAP, round(top * 0.44)), round(top * 0.32), INK, bold=True)
    write_text(picture, _summary(location), (_GAP, round(top * 0.82)), round(top * 0.23), FAINT)
    return picture


def _title(location: Location) -> str:
    name = bare_name(location.query)
    return name if location.center is None else f"{name}: {format_lonlat(location.center.lon, location.center.lat)}"


def _summary(location: Location) -> str:
    parts = [f"{location.n_matched} of {location.n_intersections} intersections matched"]
    if location.corner_sigma_m is not None:
        parts.append(f"corners {write_sigma(float(location.corner_sigma_m.max()))}")
    if location.gsd_m is not None:
        parts.append(f"{location.gsd_m:.2f} m per pixel")
    if location.rotation_deg is not None:
        parts.append(f"up is {round(location.rotation_deg) % 360}°")
    if location.log10_odds is not None:
        parts.append(f"score {location.log10_odds:z.1f}")
    return "   ·   ".join(parts)


def _draw_frames(panel: AnyArray, subject: Subject) -> None:
    """Draw the photograph, if there is one, above the mask with its roads, in the middle of a panel (h, w, 3)."""
    height, width = panel.shape[:2]
    picture, *marks = frame_layers(subject)
    views = [[mask_layer(subject), *(layer for layer in marks if layer.name != "unmatched")]]
    if subject.photo is not None:
        views.insert(0, [picture, marks[-1]])
    n = len(views)
    room = width - 2 * _GAP, (height - 2 * n * _GAP) / n
    scale = min(room[0] / subject.box[2], room[1] / subject.box[3])
    drawn = [_draw_view(subject, view, scale) for view in views]
    top = (height - sum(map(len, drawn))) // 2
    for image in drawn:
        left = max((width - image.shape[1]) // 2, 0)
        panel[top : top + len(image), left : left + image.shape[1]] = image
        top += len(image)


def _draw_view(subject: Subject, layers: list[Layer], scale: float) -> AnyArray:
    """Draw layers of the frame with room around them for its outline."""
    pad = (_GAP - 1) / scale
    x, y, width, height = subject.box
    canvas = Canvas.of((x - pad, y - pad, width + 2 * pad, height + 2 * pad), 0, 0, scale)
    canvas.image[...] = LIT
    canvas.draw(layers)
    return canvas.image


# --- on the map -------------------------------------------------------------------------------------------------------


def _draw_north(image: AnyArray, top: int) -> None:
    width, size = image.shape[1], top // 4
    x, y = width - 2 * size, round(2.2 * size)
    draw_plate(image, (x - round(1.3 * size), y - round(1.8 * size)), (width - size // 2, y + round(2.6 * size)))
    arrow = np.array([[x, y - 1.4 * size], [x + 0.8 * size, y + size], [x, y + 0.5 * size], [x - 0.8 * size, y + size]])
    cv2.fillPoly(image, [fixed_point(arrow)], INK, cv2.LINE_AA, SHIFT)
    write_text(image, "N", (x - round(0.36 * size), y + round(2.2 * size)), size, INK, bold=True)
