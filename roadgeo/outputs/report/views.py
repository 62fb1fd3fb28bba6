"""Contents of a report: the views of the mask and of the whole map (for the view of the place see `place_view`)."""

from __future__ import annotations

import html
import math
import os
from dataclasses import dataclass

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, BoolArray, FloatArray
from roadgeo.geometry.mask import RoadMask, plane_to_pixel
from roadgeo.location import Evidence, Location, Seen
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.scene import trace_query
from roadgeo.outputs.canvas import touching
from roadgeo.outputs.names import bare_name
from roadgeo.outputs.paths import Placement
from roadgeo.outputs.report.svg import draw_dots, draw_image, draw_lines, thin_lines
from roadgeo.outputs.report.viewer import (
    DOT_SIGN,
    PICTURE_SIGN,
    RING_SIGN,
    Layer,
    draw_rings,
    draw_viewer,
    pin,
    ring_data,
)

__all__ = [
    "ReportOptions",
    "Shown",
    "Window",
    "draw_mask",
    "draw_overview",
    "draw_whole_map",
]

#: Widths in pixels that views are scaled for until the page's script knows better.
_MASK_PX, _OVERVIEW_PX = 400, 380

_GREY, _PROBABLE = (150, 155, 163), (255, 210, 31)
_UNKNOWN = 255  # in a map of probabilities


@dataclass(frozen=True)
class ReportOptions:
    """Layers of a report, and the largest size of its file.

    Attributes
    ----------
    margin, reach : float
        Ground shown around the footprint at first, and ground whose roads are there to be moved to, in lengths of the
        footprint's longer side.
    max_map_vertices, max_query_vertices : int
        Of the roads of the map and of the mask.
    max_matches : int
        Those with the largest residuals are listed and drawn.
    picture_px, picture_bytes : int
        Longer side of the photograph or mask, and size of each of its two copies: in its frame and on the map.
    overview_bytes : int
        Size of the picture of the whole map.
    """

    margin: float = 0.12
    reach: float = 0.7
    max_map_vertices: int = 80_000
    max_query_vertices: int = 25_000
    max_matches: int = 1500
    picture_px: int = 1400
    picture_bytes: int = 300_000
    overview_bytes: int = 150_000


@dataclass(frozen=True)
class Shown:
    """A result and its pictures.

    Attributes
    ----------
    place : Placement or None
        Where the mask lies, if anywhere.
    lines : list of (V, 2)
        The mask's roads, pixels.
    seen : (N, 2) float64
        Its intersections, pixels.
    photograph : (h, w, 4) uint8 or None
        Reduced.
    """

    location: Location
    mask: RoadMask
    index: ReferenceIndex
    options: ReportOptions
    place: Placement | None
    lines: list[FloatArray]
    seen: FloatArray
    photograph: AnyArray | None
    attribution: str

    @classmethod
    def of(
        cls,
        location: Location,
        mask: RoadMask,
        index: ReferenceIndex,
        picture: str | os.PathLike[str] | None,
        options: ReportOptions,
        attribution: str,
    ) -> Shown:
        """Take the roads of the mask, or trace them again, and read the picture."""
        seen = location.seen
        if seen is None:
            scene, graph = trace_query(mask)
            seen = Seen(graph, scene.intersections.xy)
        lines = thin_lines([plane_to_pixel(line) for line in seen.graph.polylines()], options.max_query_vertices, 0.4)
        photograph = None
        if picture is not None:
            from roadgeo.outputs.orthophoto import read_preview

            photograph = read_preview(picture, options.picture_px)
        place = None if location.homography is None else Placement.of(location)
        crossings = plane_to_pixel(seen.xy)
        return cls(location, mask, index, options, place, lines, crossings, photograph, attribution)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the mask."""
        return self.mask.shape[1], self.mask.shape[0]

    def matches(self) -> Evidence | None:
        """Those with the largest residuals, in falling order."""
        evidence = self.location.evidence
        if evidence is None:
            return None
        first = np.argsort(-evidence.residual_m, kind="stable")[: self.options.max_matches]
        picked = (evidence.query_xy[first], evidence.reference_xy[first], evidence.residual_m[first])
        return Evidence(evidence.query_graph, *picked)

    def runner_up(self) -> FloatArray | None:
        """Position (2,) in the CRS of the middle of the best other place; of a refusal, of the best that it had."""
        other = self.location.runner_up if self.place else next(iter(self.location.alternatives), None)
        return None if other is None else np.array([other.x, other.y])

    def draw_picture(self, color: tuple[int, int, int]) -> AnyArray:
        """Draw the photograph, or else the mask's roads in a colour: (h, w, 4) uint8."""
        if self.photograph is not None:
            return self.photograph
        factor = min(1.0, self.options.picture_px / max(self.size))
        size = [max(round(side * factor), 1) for side in self.size]
        roads = cv2.resize(self.mask.roads.view(np.uint8) * np.uint8(10), size, interpolation=cv2.INTER_AREA)
        image = np.empty((*roads.shape, 4), np.uint8)
        image[..., :3], image[..., 3] = color, 24 * roads  # few levels of opacity are coded in few bytes
        if self.mask.observed is not None:
            unseen = cv2.resize((~self.mask.observed).view(np.uint8), size, interpolation=cv2.INTER_NEAREST)
            image[unseen > 0] = (*_GREY, 60)
        return image

    def draw_probability(self) -> AnyArray | None:
        """Draw a segmenter's probability, darker where higher: (h, w, 4) uint8, or None without one."""
        seen = self.mask.probability
        if seen is None:
            return None
        factor = min(1.0, self.options.picture_px / max(self.size))
        size = [max(round(side * factor), 1) for side in self.size]
        reduced = cv2.resize(np.where(seen == _UNKNOWN, 0, seen), size, interpolation=cv2.INTER_AREA)
        image = np.empty((*reduced.shape, 4), np.uint8)
        image[..., :3], image[..., 3] = (
            _PROBABLE,
            np.bitwise_and(reduced, 0xF0),
        )  # few levels of opacity are coded in few bytes
        return image


@dataclass(frozen=True)
class Window:
    """A part of the map; SVG positions are metres from its north-western corner, y down."""

    west: float
    north: float
    width: float
    height: float

    @classmethod
    def around(cls, subject: Shown, place: Placement, margin: float) -> Window:
        """Lay it around the footprint, and around the runner-up where that is no farther off than twice its size."""
        ring = place.footprint[np.isfinite(place.footprint).all(axis=1)]
        other = subject.runner_up()
        low, high = ring.min(axis=0), ring.max(axis=0)
        size = float((high - low).max())
        if other is not None and (np.abs(other - (low + high) / 2) < 2 * size).all():
            low, high = np.minimum(low, other), np.maximum(high, other)
        west, north = math.floor(low[0] - margin * size), math.ceil(high[1] + margin * size)
        return cls(west, north, high[0] + margin * size - west, north - (low[1] - margin * size))

    @property
    def box(self) -> tuple[float, float, float, float]:
        """The view box (x, y, width, height) that shows it."""
        return 0.0, 0.0, self.width, self.height

    def to_svg(self, xy: FloatArray) -> FloatArray:
        """Take CRS positions (..., 2) there."""
        return (np.asarray(xy, float) - (self.west, self.north)) * (1.0, -1.0)

    def to_svg_matrix(self) -> FloatArray:
        """(3, 3) homography that does the same."""
        return np.array([[1.0, 0.0, -self.west], [0.0, -1.0, self.north], [0.0, 0.0, 1.0]])

    def holds(self, xy: FloatArray) -> BoolArray:
        """Whether CRS positions (..., 2) lie inside."""
        at = self.to_svg(xy)
        return np.asarray(((at >= 0) & (at <= (self.width, self.height))).all(axis=-1))

    def segments(self, index: ReferenceIndex) -> FloatArray:
        """(S, 2, 2) CRS positions of the ends of the map's road segments that may touch the window."""
        low = index.plane.from_crs(np.array([self.west, self.north - self.height]))
        high = index.plane.from_crs(np.array([self.west + self.width, self.north]))
        ends = index.segments.reshape(-1, 2, 2)
        near = touching(ends, low, high)
        return index.plane.to_crs(ends[near].astype(float))


# --- the mask ---------------------------------------------------------------------------------------------------------


def draw_mask(subject: Shown) -> str:
    """Draw the mask, or its photograph, with the roads and intersections seen in it: an HTML figure."""
    width, height = subject.size
    is_photograph = subject.photograph is not None
    box = (0.0, 0.0, float(width), float(height))
    picture = draw_image(subject.draw_picture(_GREY), box, subject.options.picture_bytes, lossless=not is_photograph)
    matches = subject.matches()
    matched = np.empty((0, 2)) if matches is None else plane_to_pixel(matches.query_xy)
    taken = set(map(tuple, matched.tolist()))
    others = np.array([xy for xy in subject.seen.tolist() if tuple(xy) not in taken]).reshape(-1, 2)
    others = others[: subject.options.max_query_vertices // 4]
    probable = "" if subject.mask.probability is None else '<use href="#probability"/>'
    layers = [
        Layer("picture", "photograph" if is_photograph else "mask", picture, PICTURE_SIGN),
        Layer("probability", "probability of road", probable, PICTURE_SIGN, shown=False),
        Layer("query-roads", "its roads", draw_lines(subject.lines)),
        Layer(
            "unmatched", "other intersections" if len(matched) else "its intersections", draw_rings(others), RING_SIGN
        ),
        Layer("matches", "matched", draw_dots(matched, ("halo", "")), DOT_SIGN),
        Layer("edge", "", f'<path d="{ring_data(subject.mask.corners)}"/>'),
    ]
    said = f"The mask {bare_name(subject.location.query)}, with the roads and intersections seen in it"
    attributes = {"data-frame": "mask", "style": f"--u:{max(width, height) / _MASK_PX:.4g}"}
    return draw_viewer(said, box, layers, attributes)


def draw_probability(subject: Shown) -> str:
    """Draw a segmenter's probability alone: an SVG, or nothing. The layer of `draw_mask` shows the same picture."""
    probable = subject.draw_probability()
    if probable is None:
        return ""
    box = (0.0, 0.0, float(subject.size[0]), float(subject.size[1]))
    picture = draw_image(probable, box, subject.options.picture_bytes, lossless=True)
    view = " ".join(f"{value:g}" for value in box)
    said = "Probability of road: light where it is high"
    drawn = f'<g id="probability">{picture}</g>'
    return f'<svg class="overview seen" viewBox="{view}" role="img" aria-label="{said}">{drawn}</svg>'


# --- the whole map ----------------------------------------------------------------------------------------------------


def draw_overview(subject: Shown) -> str:
    """Draw all of the map, and where on it the mask and the runner-up lie."""
    index, location = subject.index, subject.location
    if index.name != location.reference:  # several were searched
        return f"<p>Searched: {html.escape(location.reference)}.</p>"
    picture, window = draw_whole_map(index, subject.options.overview_bytes, 2 * _OVERVIEW_PX)
    marks = []
    if subject.place is not None:
        d = ring_data(window.to_svg(subject.place.footprint))
        marks.append(f'<g class="{location.status}"><path d="{d}"/></g>')
    other = subject.runner_up()
    if other is not None:
        called = "runner-up" if subject.place else "the best, not sure enough"
        cross = pin(window.to_svg(other), '<path d="M-6-6L6 6M-6 6L6-6"/>', called)
        marks.append(f'<g class="runner-up">{cross}</g>')
    said = f"All of the map {index.name}" + (", with the footprint" if subject.place else "")
    box = " ".join(f"{value:.0f}" for value in window.box)
    return (
        f'<svg class="overview" viewBox="{box}" role="img" aria-label="{html.escape(said)}" '
        f'style="--u:{window.width / _OVERVIEW_PX:.4g}">{picture}{"".join(marks)}</svg>'
        f'<p class="faint">{html.escape(index.name)}: {len(index):,} intersections, '
        f"{window.width / 1000:.0f} × {window.height / 1000:.0f} km</p>"
    )


def draw_whole_map(index: ReferenceIndex, limit: int, width_px: int) -> tuple[str, Window]:
    """Draw all roads of a reference as an SVG image of at most `limit` bytes, and return its window."""
    x0, y0, size = index.grid
    columns, rows = index.shape
    west, south = index.plane.to_crs(np.array([x0, y0])).tolist()
    window = Window(west, south + rows * size, columns * size, rows * size)
    scale = min(width_px / window.width, 2 * width_px / window.height)
    alpha = np.zeros((max(round(window.height * scale), 1), max(round(window.width * scale), 1)), np.uint8)
    ends = (index.segments.reshape(-1, 2, 2) - (x0, y0 + rows * size)) * (scale, -scale)
    cv2.polylines(alpha, list(np.rint(ends * 16).astype(np.int32)), False, 160, 1, cv2.LINE_AA, 4)
    image = np.empty((*alpha.shape, 4), np.uint8)
    image[..., :3], image[..., 3] = _GREY, alpha & 0xF0
    return draw_image(image, window.box, limit, lossless=True), window
