"""The views of a report: the mask, its place on the map, the whole map; what is drawn, in layers of SVG."""

from __future__ import annotations

import html
import json
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, BoolArray, FloatArray
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.mask import RoadMask, plane_to_pixel
from roadgeo.geometry.warping import cover, warp
from roadgeo.location import Evidence, Location, Seen
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.query import trace_query
from roadgeo.outputs.paths import Placement
from roadgeo.outputs.report.svg import draw_dots, draw_image, draw_lines, join_segments, thin_lines

__all__ = [
    "Layer",
    "ReportOptions",
    "Shown",
    "Window",
    "draw_mask",
    "draw_overview",
    "draw_place",
    "draw_viewer",
    "draw_whole_map",
    "ring_data",
]

#: A circle that holds a corner's true position with 95 %, in rms distances.
_SIGMAS = 1.73

#: Screen pixels that a large residual's arrow (the 90th percentile) and a corner's circle get at most.
_ARROW_PX, _CIRCLE_PX = 26.0, 60.0

#: Widths in pixels that views are scaled for until the page's script knows better.
_PLACE_PX, _MASK_PX, _OVERVIEW_PX = 900, 400, 380

_QUERY_COLOR, _GREY, _PROBABLE = (228, 87, 46), (150, 155, 163), (255, 210, 31)
_UNKNOWN = 255  # in a map of probabilities


@dataclass(frozen=True)
class ReportOptions:
    """What is drawn, and how large the file may become.

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
    """A result and what is drawn of it.

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
        """Take what was seen in the mask, or look at it anew, and read the picture."""
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
        """Position (2,) in the CRS of the middle of the best other place."""
        other = self.location.runner_up
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
        """Draw what a segmenter saw, the surer the denser: (h, w, 4) uint8, or None where there was none."""
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
        near = (ends.max(axis=1) >= low).all(axis=1) & (ends.min(axis=1) <= high).all(axis=1)
        return index.plane.to_crs(ends[near].astype(float))


# --- the place --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Layer:
    """Something that can be shown or not: `name` is its class in the style sheet, `sign` stands in the legend."""

    name: str
    label: str
    content: str
    sign: str = '<path d="M2 7h22"/>'
    shown: bool = True


_DOT_SIGN = '<path class="halo" d="M13 7h.1"/><path d="M13 7h.1"/>'
_RING_SIGN = '<path d="M13 7h.1"/><path class="core" d="M13 7h.1"/>'
_PICTURE_SIGN = '<rect x="3" y="2" width="20" height="10"/>'


def draw_place(subject: Shown, place: Placement) -> str:
    """Draw the map around a footprint, with what lies on it: an HTML figure."""
    location = subject.location
    window = Window.around(subject, place, subject.options.margin)
    wide = Window.around(subject, place, subject.options.reach)
    roads = join_segments(window.to_svg(wide.segments(subject.index)))
    crossings = subject.index.plane.to_crs(subject.index.xy)
    crossings = window.to_svg(crossings[wide.holds(crossings)][: subject.options.max_map_vertices // 4])
    corners = window.to_svg(place.footprint)
    to_svg = Homography(window.to_svg_matrix() @ place.homography)
    query = [line for line in (window.to_svg(place.to_crs(one)) for one in subject.lines) if np.isfinite(line).all()]
    layers = [
        _picture_on_map(subject, place, window),
        Layer("map-roads", "roads of the map", draw_lines(thin_lines(roads, subject.options.max_map_vertices))),
        Layer("unmatched", "intersections of the map", _draw_rings(crossings), _RING_SIGN, shown=False),
        Layer("query-roads", "roads of the mask", draw_lines(query)),
        Layer("footprint", "footprint", _draw_footprint(corners), '<path d="M3 2h20v10h-20z"/>'),
    ]
    matches = subject.matches()
    if matches is not None:
        at, found = window.to_svg(matches.reference_xy), window.to_svg(place.to_crs(plane_to_pixel(matches.query_xy)))
        layers += [
            Layer("residuals", "residuals", _draw_arrows(at, found - at), '<path d="M3 7h18m-5-4l5 4l-5 4"/>'),
            Layer("matches", "matched intersections", draw_dots(at, ("halo", "")), _DOT_SIGN),
        ]
    if location.corner_sigma_m is not None:
        circles = _draw_circles(corners, location.corner_sigma_m)
        layers.append(Layer("sigma", "corners, 95 %", circles, '<circle cx="13" cy="7" r="5"/>'))
    other = subject.runner_up()
    if other is not None and window.holds(other):
        cross = pin(window.to_svg(other), '<path d="M-9-9L9 9M-9 9L9-9"/>', "runner-up")
        layers.append(Layer("runner-up", "runner-up", cross, '<path d="M8 2l10 10m0-10l-10 10"/>'))
    arrows, per_px = _arrow_scale(location), window.width / _PLACE_PX
    attributes = {
        "data-frame": "map",
        "data-west": f"{window.west:.3f}",
        "data-north": f"{window.north:.3f}",
        "data-homography": json.dumps(to_svg.matrix.tolist()),
        "data-arrows": f"{arrows:.4g}",
        "style": f"--u:{per_px:.4g};--k:{max(1.0, arrows * per_px):.4g}",
    }
    said = f"Map, north up: the footprint of {location.query} over the roads of {location.reference}"
    return draw_viewer(said, window.box, layers, attributes, scale=True, enlarged=True, credit=subject.attribution)


def _picture_on_map(subject: Shown, place: Placement, window: Window) -> Layer:
    image = subject.draw_picture(_QUERY_COLOR)
    size = image.shape[1], image.shape[0]
    to_crs = place.homography @ np.diag([subject.size[0] / size[0], subject.size[1] / size[1], 1.0])
    grid = cover(size, to_crs, None, subject.options.picture_px**2)
    is_photograph = subject.photograph is not None
    if grid.width == 0:
        return Layer("picture", "", "")
    interpolation = cv2.INTER_LINEAR if is_photograph else cv2.INTER_NEAREST
    warped = warp(image, to_crs, grid, interpolation=interpolation, lens=place.lens(size))
    x, y = window.to_svg(np.array([grid.west, grid.north]))
    box = (x, y, grid.width * grid.resolution, grid.height * grid.resolution)
    picture = draw_image(warped, box, subject.options.picture_bytes, lossless=not is_photograph)
    return Layer("picture", "photograph" if is_photograph else "mask", picture, _PICTURE_SIGN, shown=is_photograph)


def _draw_footprint(corners: FloatArray) -> str:
    """Outline a frame, (4, 2) from its top left; a triangle outside its top side shows which way is up in the image."""
    left, right = corners[:2]
    x, y = (left + right) / 2
    turn = math.degrees(math.atan2(right[1] - left[1], right[0] - left[0]))
    up = f'<g transform="rotate({turn:.1f})"><path class="up" d="M-11 0L0-14L11 0z"/></g>'
    return f'<path d="{ring_data(corners)}"/><g transform="translate({x:.1f} {y:.1f})"><g class="fixed">{up}</g></g>'


def _draw_rings(points: FloatArray) -> str:
    return draw_dots(points, ("", "core"))


def _draw_arrows(at: FloatArray, steps: FloatArray) -> str:
    """Draw arrows from the map's intersections towards the mask's; the style sheet enlarges them about their feet."""
    parts = []
    for (x, y), (dx, dy) in zip(at.tolist(), steps.tolist(), strict=True):
        if not math.hypot(dx, dy) > 0.005:  # too short to be seen, or beyond the horizon
            continue
        barbs = ((-0.3 * dx - 0.2 * dy, -0.3 * dy + 0.2 * dx), (-0.3 * dx + 0.2 * dy, -0.3 * dy - 0.2 * dx))
        head = "".join(f"M{dx:.3g} {dy:.3g}l{bx:.3g} {by:.3g}" for bx, by in barbs)
        parts.append(f'<g transform="translate({x:.2f} {y:.2f})"><path d="M0 0L{dx:.3g} {dy:.3g}{head}"/></g>')
    return "".join(parts)


def _draw_circles(corners: FloatArray, sigma: FloatArray) -> str:
    """Draw circles that hold the corners with 95 %; the style sheet enlarges them like the arrows."""
    return "".join(
        f'<g transform="translate({x:.2f} {y:.2f})"><circle r="{_SIGMAS * s:.3g}"/>'
        f'<g class="fixed"><text x="8" y="-8">± {s:.1f} m</text></g></g>'
        for (x, y), s in zip(corners.tolist(), sigma.tolist(), strict=True)
        if math.isfinite(x + y + s)
    )


def _arrow_scale(location: Location) -> float:
    """Screen pixels for a metre of residual, or of a corner's circle."""
    evidence, sigma = location.evidence, location.corner_sigma_m
    scales = [1000.0]
    if evidence is not None and len(evidence.residual_m):
        scales.append(_ARROW_PX / max(float(np.percentile(evidence.residual_m, 90)), 1e-3))
    if sigma is not None and np.isfinite(sigma).any():
        scales.append(_CIRCLE_PX / max(_SIGMAS * float(np.nanmax(sigma)), 1e-3))
    return min(scales)


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
        Layer("picture", "photograph" if is_photograph else "mask", picture, _PICTURE_SIGN),
        Layer("probability", "probability of road", probable, _PICTURE_SIGN, shown=False),
        Layer("query-roads", "its roads", draw_lines(subject.lines)),
        Layer(
            "unmatched", "other intersections" if len(matched) else "its intersections", _draw_rings(others), _RING_SIGN
        ),
        Layer("matches", "matched", draw_dots(matched, ("halo", "")), _DOT_SIGN),
        Layer("edge", "", f'<path d="{ring_data(subject.mask.corners)}"/>'),
    ]
    said = f"The mask {subject.location.query}, with the roads and intersections seen in it"
    attributes = {"data-frame": "mask", "style": f"--u:{max(width, height) / _MASK_PX:.4g}"}
    return draw_viewer(said, box, layers, attributes)


def draw_probability(subject: Shown) -> str:
    """Draw what a segmenter saw, on its own: an SVG, or nothing. The layer of `draw_mask` shows the same picture."""
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
        cross = pin(window.to_svg(other), '<path d="M-6-6L6 6M-6 6L6-6"/>', "runner-up")
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
    """Draw all roads of a reference as an SVG image of at most `limit` bytes, and say which window it fills."""
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


# --- what they share --------------------------------------------------------------------------------------------------

_BUTTONS = (
    '<div class="buttons"><button type="button" data-act="in" aria-label="Zoom in">+</button>'
    '<button type="button" data-act="out" aria-label="Zoom out">−</button>'
    '<button type="button" data-act="fit" aria-label="Show all">⤢</button></div>'
)
_MARKS = (
    '<g class="ring off"><g class="fixed"><circle r="11"/></g></g>'
    '<g class="cursor off"><path class="fixed" d="M-14 0h10m8 0h10M0-14v10m0 8v10"/></g>'
)


def draw_viewer(
    said: str,
    box: tuple[float, float, float, float],
    layers: Sequence[Layer],
    attributes: dict[str, str],
    *,
    scale: bool = False,
    enlarged: bool = False,
    credit: str = "",
) -> str:
    """Draw layers that can be zoomed into, with a legend that switches those that have a label: an HTML figure.

    Parameters
    ----------
    scale : bool
        Show a scale bar: the units are metres.
    enlarged : bool
        Say how much residuals and circles are enlarged.
    credit : str
        Stands in a corner.
    """
    notes = '<span>residuals, corners <span class="times">enlarged</span></span>' if enlarged else ""
    notes += '<span class="scale"></span>' if scale else ""
    named = f'<span class="credit">{html.escape(credit)}</span>' if credit else ""
    pad = 0.02 * max(box[2:])
    view = f"{box[0] - pad:.1f} {box[1] - pad:.1f} {box[2] + 2 * pad:.1f} {box[3] + 2 * pad:.1f}"
    given = "".join(f' {name}="{html.escape(value)}"' for name, value in attributes.items())
    groups = "".join(f'<g class="{one.name}{"" if one.shown else " off"}">{one.content}</g>' for one in layers)
    legend = "".join(
        f'<label><input type="checkbox" data-toggles="{one.name}"{" checked" if one.shown else ""}>'
        f'<svg viewBox="0 0 26 14" aria-hidden="true" class="{one.name}">{one.sign}</svg>'
        f"{html.escape(one.label)}</label>"
        for one in layers
        if one.content and one.label
    )
    return (
        '<figure class="viewer"><div class="stage" tabindex="0" role="group" '
        'aria-label="Zoom with + and −, move with the arrow keys, 0 shows all">'
        f'<svg class="view" viewBox="{view}" role="img" aria-label="{html.escape(said)}"{given}>{groups}{_MARKS}</svg>'
        f'{_BUTTONS}<div class="notes">{notes}<span class="position"></span></div>{named}</div>'
        f'<fieldset class="legend" aria-label="Layers">{legend}</fieldset></figure>'
    )


def pin(at: FloatArray, content: str, text: str) -> str:
    """Put something that keeps its size on the screen at an SVG position."""
    said = f'<text x="13" y="5">{html.escape(text)}</text>'
    return f'<g transform="translate({at[0]:.2f} {at[1]:.2f})"><g class="fixed">{content}{said}</g></g>'


def ring_data(corners: FloatArray) -> str:
    """Path data of a closed ring (K, 2)."""
    return "M" + " ".join(f"{x:.1f},{y:.1f}" for x, y in corners.tolist()) + "z"
