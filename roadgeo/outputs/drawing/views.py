"""The layers of a result: of its mask or photograph, of its place on the map, and of a whole map."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, BoolArray, FloatArray
from roadgeo.geometry.mask import RoadMask, plane_to_pixel
from roadgeo.matching.index import ReferenceIndex
from roadgeo.outputs.drawing.layers import (
    Arrows,
    Bitmap,
    Box,
    Circles,
    Color,
    Cross,
    Dots,
    Layer,
    Lines,
    Ring,
    rgb,
)
from roadgeo.outputs.drawing.svg import join_segments, thin_lines
from roadgeo.outputs.placing import warp_picture
from roadgeo.outputs.subject import Subject
from roadgeo.outputs.wording import write_sigma

__all__ = [
    "SIGMAS", "STILL", "Window", "draw_picture", "frame_layers", "map_layer", "mask_layer", "mask_picture",
    "place_layers", "probability_layer", "touching", "whole_map",
]  # fmt: skip

#: A circle that holds a corner's true position with 95 %, in rms distances.
SIGMAS = 1.73

#: Layers of a place that need no script and no scale of their own: as pictures show them.
STILL = ("ground", "map-roads", "query-roads", "footprint", "matches")

_GREY: Color = (150, 155, 163)
_PROBABLE: Color = (255, 210, 31)
_UNKNOWN = 255  # in a map of probabilities


@dataclass(frozen=True)
class Window:
    """A part of the map; its frame counts metres from its north-western corner, y down."""

    west: float
    north: float
    width: float
    height: float

    @classmethod
    def around(cls, ring: FloatArray, margin: float, other: FloatArray | None = None) -> Window:
        """Lay it around corners (K, 2), and around another point that is no farther off than twice their size.

        `margin` is left on each side, in lengths of the longer side.
        """
        ring = ring[np.isfinite(ring).all(axis=1)]
        low, high = ring.min(axis=0), ring.max(axis=0)
        size = float((high - low).max())
        if other is not None and (np.abs(other - (low + high) / 2) < 2 * size).all():
            low, high = np.minimum(low, other), np.maximum(high, other)
        west, north = math.floor(low[0] - margin * size), math.ceil(high[1] + margin * size)
        return cls(west, north, high[0] + margin * size - west, north - (low[1] - margin * size))

    def no_longer_than(self, ratio: float) -> Window:
        """Widen it to at most this ratio of its sides."""
        x, y = max(self.height / ratio - self.width, 0.0), max(self.width / ratio - self.height, 0.0)
        return Window(self.west - x / 2, self.north + y / 2, self.width + x, self.height + y)

    @property
    def box(self) -> Box:
        """All of it, in its frame."""
        return 0.0, 0.0, self.width, self.height

    def place(self, xy: FloatArray) -> FloatArray:
        """Take CRS positions (..., 2) to its frame."""
        return (np.asarray(xy, float) - (self.west, self.north)) * (1.0, -1.0)

    def matrix(self) -> FloatArray:
        """(3, 3) homography that does the same."""
        return np.array([[1.0, 0.0, -self.west], [0.0, -1.0, self.north], [0.0, 0.0, 1.0]])

    def holds(self, xy: FloatArray) -> BoolArray:
        """Whether CRS positions (..., 2) lie inside."""
        at = self.place(xy)
        return np.asarray(((at >= 0) & (at <= (self.width, self.height))).all(axis=-1))

    def segments(self, index: ReferenceIndex) -> FloatArray:
        """(S, 2, 2) CRS positions of the ends of the map's road segments that may touch the window."""
        low = index.plane.from_crs(np.array([self.west, self.north - self.height]))
        high = index.plane.from_crs(np.array([self.west + self.width, self.north]))
        ends = index.segments.reshape(-1, 2, 2)
        near = touching(ends, low, high)
        return index.plane.to_crs(ends[near].astype(float))


def touching(ends: AnyArray, low: FloatArray, high: FloatArray) -> BoolArray:
    """Return which segments, given by their ends (S, 2, 2), may touch the box between two of its corners."""
    return np.asarray((ends.max(axis=1) >= low).all(axis=1) & (ends.min(axis=1) <= high).all(axis=1))


def draw_picture(subject: Subject, color: Color) -> AnyArray:
    """Draw the photograph, or else the mask's roads in a colour: (h, w, 4) uint8."""
    reduced = subject.reduced
    return mask_picture(subject.mask, color, subject.views.picture_px) if reduced is None else reduced


def mask_picture(mask: RoadMask, color: Color, side: int) -> AnyArray:
    """Draw a mask's roads in a colour, and unobserved ground in grey: (h, w, 4) uint8, at most `side` pixels."""
    image = _tinted(mask.roads.view(np.uint8) * np.uint8(255), color, side)
    if mask.observed is not None:
        unseen = cv2.resize((~mask.observed).view(np.uint8), image.shape[1::-1], interpolation=cv2.INTER_NEAREST)
        image[unseen > 0] = (*_GREY, 60)
    return image


def mask_layer(subject: Subject) -> Layer:
    """Return the mask alone, whatever photograph it was made of."""
    return Layer("picture", "", [Bitmap(mask_picture(subject.mask, _GREY, subject.views.picture_px), subject.box)])


def _tinted(opacity: AnyArray, color: Color, side: int) -> AnyArray:
    """Draw a colour at opacities (H, W), reduced to a side; few levels of opacity are coded in few bytes."""
    factor = min(1.0, side / max(opacity.shape))
    size = [max(round(length * factor), 1) for length in opacity.shape[::-1]]
    image = np.empty((size[1], size[0], 4), np.uint8)
    image[..., :3] = color
    level = np.right_shift(cv2.resize(opacity, size, interpolation=cv2.INTER_AREA), 4)
    image[..., 3] = 17 * level
    return image


# --- the frame --------------------------------------------------------------------------------------------------------


def frame_layers(subject: Subject) -> list[Layer]:
    """Return the mask, or its photograph, with the roads and intersections seen in it; in its pixels."""
    matches = subject.largest_residuals()
    matched = np.empty((0, 2)) if matches is None else plane_to_pixel(matches.query_xy)
    taken = set(map(tuple, matched.tolist()))
    others = np.array([xy for xy in subject.crossings.tolist() if tuple(xy) not in taken]).reshape(-1, 2)
    others = others[: subject.views.max_query_vertices // 4]
    called = "other intersections" if len(matched) else "its intersections"
    return [
        _picture_layer(subject, draw_picture(subject, _GREY), subject.box),
        Layer("query-roads", "its roads", [Lines(subject.lines)]),
        Layer("unmatched", called, [Dots(others, hollow=True)]),
        Layer("matches", "matched", [Dots(matched)]),
        Layer("edge", "", [Ring(subject.mask.corners, up=True)]),
    ]


def _picture_layer(subject: Subject, image: AnyArray, box: Box) -> Layer:
    """Return the photograph, or the mask, inside a box."""
    is_photograph = subject.photo is not None
    picture = Bitmap(image, box, subject.views.picture_bytes, lossless=not is_photograph)
    return Layer("picture", "photograph" if is_photograph else "mask", [picture])


def probability_layer(subject: Subject) -> list[Layer]:
    """Return a segmenter's probability, lighter where higher; nothing without one."""
    values, views = subject.mask.probability, subject.views
    if values is None:
        return []
    image = _tinted(np.where(values == _UNKNOWN, 0, values).astype(np.uint8), _PROBABLE, views.picture_px)
    picture = Bitmap(image, subject.box, views.picture_bytes, lossless=True)
    return [Layer("probability", "probability of road", [picture], shown=False)]


# --- the place --------------------------------------------------------------------------------------------------------


def place_layers(subject: Subject, window: Window) -> list[Layer]:
    """Return the map around a footprint, and the footprint on it; in the frame of a window."""
    place, views = subject.place, subject.views
    wide = Window.around(place.footprint, views.reach, subject.runner_up())
    crossings = subject.index.plane.to_crs(subject.index.xy)
    crossings = window.place(crossings[wide.holds(crossings)][: views.max_map_vertices // 4])
    corners = window.place(place.footprint)
    lines = [line for line in (window.place(place.to_crs(road)) for road in subject.lines) if np.isfinite(line).all()]
    layers = [
        Layer("ground", "", [Ring(corners)]),
        *_picture_on_map(subject, window),
        map_layer(subject.index, window, wide, views.max_map_vertices),
        Layer("unmatched", "intersections of the map", [Dots(crossings, hollow=True)], shown=False),
        Layer("query-roads", f"roads of the {subject.kind}", [Lines(lines)]),
        Layer("footprint", "footprint", [Ring(corners, up=True)]),
    ]
    matches = subject.largest_residuals()
    if matches is not None:
        at, placed = window.place(matches.reference_xy), window.place(place.to_crs(plane_to_pixel(matches.query_xy)))
        layers.append(Layer("residuals", "residuals", [Arrows(at, placed - at)]))
        layers.append(Layer("matches", "matched intersections", [Dots(at)]))
    sigma = subject.location.corner_sigma_m
    if sigma is not None:
        texts = list(map(write_sigma, sigma.tolist()))
        layers.append(Layer("sigma", "corners, 95 %", [Circles(corners, SIGMAS * sigma, texts)]))
    other = subject.runner_up()
    if other is not None and window.holds(other):
        layers.append(Layer("runner-up", "runner-up", [Cross(window.place(other), "runner-up")]))
    return layers


def map_layer(index: ReferenceIndex, window: Window, wide: Window, max_vertices: int) -> Layer:
    """Return the roads of a map in a wide window, in the frame of another."""
    roads = join_segments(window.place(wide.segments(index)))
    return Layer("map-roads", "roads of the map", [Lines(thin_lines(roads, max_vertices))])


def _picture_on_map(subject: Subject, window: Window) -> list[Layer]:
    """Return the photograph, or the mask's roads, warped to where it lies; nothing where that cannot be drawn."""
    image, is_photograph = draw_picture(subject, rgb("query")), subject.photo is not None
    max_pixels = subject.views.picture_px**2
    warped, grid = warp_picture(subject.place, image, subject.mask_size, max_pixels, smooth=is_photograph)
    if grid.width == 0:
        return []
    x, y = window.place(np.array([grid.west, grid.north])).tolist()
    box = (x, y, grid.width * grid.resolution, grid.height * grid.resolution)
    return [replace(_picture_layer(subject, warped, box), shown=is_photograph)]


# --- the whole map ----------------------------------------------------------------------------------------------------


def whole_map(index: ReferenceIndex, max_bytes: int, width_px: int) -> tuple[Layer, Window]:
    """Return all roads of a reference as a picture, and its window."""
    x0, y0, size = index.grid
    columns, rows = index.shape
    west, south = index.plane.to_crs(np.array([x0, y0])).tolist()
    window = Window(west, south + rows * size, columns * size, rows * size)
    scale = min(width_px / window.width, 2 * width_px / window.height)
    alpha = np.zeros((max(round(window.height * scale), 1), max(round(window.width * scale), 1)), np.uint8)
    ends = (index.segments.reshape(-1, 2, 2) - (x0, y0 + rows * size)) * (scale, -scale)
    cv2.polylines(alpha, list(np.rint(ends * 16).astype(np.int32)), False, 160, 1, cv2.LINE_AA, 4)
    image = _tinted(alpha, _GREY, max(alpha.shape))
    return Layer("picture", "", [Bitmap(image, window.box, max_bytes, lossless=True)]), window
