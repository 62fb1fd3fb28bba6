"""The view of a place: the map around a footprint, and the footprint on it."""

from __future__ import annotations

import json
import math

import cv2
import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.mask import plane_to_pixel
from roadgeo.geometry.warping import cover, warp
from roadgeo.location import Location
from roadgeo.outputs.names import bare_name
from roadgeo.outputs.paths import Placement
from roadgeo.outputs.report.svg import draw_dots, draw_image, draw_lines, join_segments, thin_lines
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
from roadgeo.outputs.report.views import Shown, Window

__all__ = ["draw_place"]

#: A circle that holds a corner's true position with 95 %, in rms distances.
_SIGMAS = 1.73

#: Screen pixels that a large residual's arrow (the 90th percentile) and a corner's circle get at most.
_ARROW_PX, _CIRCLE_PX = 26.0, 60.0

#: Width in pixels that it is scaled for until the page's script knows better.
_PLACE_PX = 900

_QUERY_COLOR = (228, 87, 46)


def draw_place(subject: Shown, place: Placement) -> str:
    """Draw the map around a footprint, and the footprint on it: an HTML figure."""
    # Geometries in metres from the window's corner.
    location = subject.location
    window = Window.around(subject, place, subject.options.margin)
    wide = Window.around(subject, place, subject.options.reach)
    roads = join_segments(window.to_svg(wide.segments(subject.index)))
    crossings = subject.index.plane.to_crs(subject.index.xy)
    crossings = window.to_svg(crossings[wide.holds(crossings)][: subject.options.max_map_vertices // 4])
    corners = window.to_svg(place.footprint)
    to_svg = Homography(window.to_svg_matrix() @ place.homography)
    query = [line for line in (window.to_svg(place.to_crs(one)) for one in subject.lines) if np.isfinite(line).all()]
    # Layers from the lowest up.
    layers = [
        _picture_on_map(subject, place, window),
        Layer("map-roads", "roads of the map", draw_lines(thin_lines(roads, subject.options.max_map_vertices))),
        Layer("unmatched", "intersections of the map", draw_rings(crossings), RING_SIGN, shown=False),
        Layer("query-roads", "roads of the mask", draw_lines(query)),
        Layer("footprint", "footprint", _draw_footprint(corners), '<path d="M3 2h20v10h-20z"/>'),
    ]
    matches = subject.matches()
    if matches is not None:
        at, found = window.to_svg(matches.reference_xy), window.to_svg(place.to_crs(plane_to_pixel(matches.query_xy)))
        layers += [
            Layer("residuals", "residuals", _draw_arrows(at, found - at), '<path d="M3 7h18m-5-4l5 4l-5 4"/>'),
            Layer("matches", "matched intersections", draw_dots(at, ("halo", "")), DOT_SIGN),
        ]
    if location.corner_sigma_m is not None:
        circles = _draw_circles(corners, location.corner_sigma_m)
        layers.append(Layer("sigma", "corners, 95 %", circles, '<circle cx="13" cy="7" r="5"/>'))
    other = subject.runner_up()
    if other is not None and window.holds(other):
        cross = pin(window.to_svg(other), '<path d="M-9-9L9 9M-9 9L9-9"/>', "runner-up")
        layers.append(Layer("runner-up", "runner-up", cross, '<path d="M8 2l10 10m0-10l-10 10"/>'))
    # Values for the page's script, which keeps widths and arrows legible at every scale.
    arrows, per_px = _arrow_scale(location), window.width / _PLACE_PX
    attributes = {
        "data-frame": "map",
        "data-west": f"{window.west:.3f}",
        "data-north": f"{window.north:.3f}",
        "data-homography": json.dumps(to_svg.matrix.tolist()),
        "data-arrows": f"{arrows:.4g}",
        "style": f"--u:{per_px:.4g};--k:{max(1.0, arrows * per_px):.4g}",
    }
    said = f"Map, north up: the footprint of {bare_name(location.query)} over the roads of {location.reference}"
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
    return Layer("picture", "photograph" if is_photograph else "mask", picture, PICTURE_SIGN, shown=is_photograph)


def _draw_footprint(corners: FloatArray) -> str:
    """Outline a frame, (4, 2) from its top left; a triangle outside its top side shows which way is up in the image."""
    left, right = corners[:2]
    x, y = (left + right) / 2
    turn = math.degrees(math.atan2(right[1] - left[1], right[0] - left[0]))
    up = f'<g transform="rotate({turn:.1f})"><path class="up" d="M-11 0L0-14L11 0z"/></g>'
    return f'<path d="{ring_data(corners)}"/><g transform="translate({x:.1f} {y:.1f})"><g class="fixed">{up}</g></g>'


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
