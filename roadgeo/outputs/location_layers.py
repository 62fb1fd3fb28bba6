"""The GeoPackage of a result: footprint, the mask's roads, matched intersections with their residuals."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo.geometry.mask import plane_to_pixel
from roadgeo.location import Evidence, Location
from roadgeo.outputs.columns import attributes
from roadgeo.outputs.paths import Placement
from roadgeo.outputs.subject import Subject
from roadgeo.storage.geopackage import Layer, dump_layers
from roadgeo.storage.qml import draw_arrow, draw_fill, draw_line, draw_marker

__all__ = ["write_geopackage"]

_FOOTPRINT_STYLE = draw_fill("31,111,180,20", "31,111,180", 0.7)
_ROADS_STYLE = draw_line("228,87,46", 0.5)
_MATCHES_STYLE = draw_marker("27,38,59", 2.2)
_RESIDUALS_STYLE = draw_arrow("27,38,59", 0.4)
_CORNERS_STYLE = draw_marker("31,111,180", 1.8)
_ALTERNATIVES_STYLE = draw_marker("240,180,41", 3.0)

_CORNERS = ("top left", "top right", "bottom right", "bottom left")
#: Factor by which residuals are enlarged: metres cannot be seen on a footprint of a kilometre.
_EXAGGERATION = 20.0


def write_geopackage(path: Path, subject: Subject) -> None:
    """Write the layers `footprint`, `query_roads`, `residuals`, `matches`, `corners` and `alternatives`, styled."""
    dump_layers(path, _layers(subject))


def _layers(subject: Subject) -> list[Layer]:
    place, evidence = subject.place, subject.location.evidence
    layers = [
        Layer(
            "footprint",
            "POLYGON",
            [place.footprint],
            {name: [value] for name, value in attributes(subject.location.to_dict()).items()},
            place.crs,
            _FOOTPRINT_STYLE,
            "Ground that the image shows",
        )
    ]
    if evidence is not None:
        layers += [_road_layer(place, evidence), _residual_layer(place, evidence), _match_layer(place, evidence)]
    return [*layers, _corner_layer(place, subject.location), _alternative_layer(place, subject.location)]


def _road_layer(place: Placement, evidence: Evidence) -> Layer:
    """Draw the mask's roads on the map."""
    lines = place.map_roads(evidence.query_graph)
    return Layer(
        "query_roads",
        "LINESTRING",
        lines,
        {"length_m": _lengths(lines)},
        place.crs,
        _ROADS_STYLE,
        "Roads of the mask, as vectorized",
    )


def _lengths(lines: Sequence[FloatArray]) -> FloatArray:
    """Lengths of (V, 2) lines, all at once: calls for single ones would cost more than all else here."""
    if not lines:
        return np.empty(0)
    starts = np.cumsum([0, *map(len, lines)])
    steps = np.hypot(*np.diff(np.concatenate(lines), axis=0).T)
    steps[starts[1:-1] - 1] = 0.0  # from one line to the next
    return np.asarray(np.add.reduceat(steps, starts[:-1]))


def _match_layer(place: Placement, evidence: Evidence) -> Layer:
    """Show matched intersections where the map has them, with the way from the mask's to the map's."""
    pixels = plane_to_pixel(evidence.query_xy)
    offset = evidence.reference_xy - place.to_crs(pixels)
    columns = {
        "column": pixels[:, 0],
        "row": pixels[:, 1],
        "residual_m": evidence.residual_m,
        "dx_m": offset[:, 0],
        "dy_m": offset[:, 1],
    }
    return Layer(
        "matches",
        "POINT",
        evidence.reference_xy,
        columns,
        place.crs,
        _MATCHES_STYLE,
        "Intersections found both in the mask and on the map",
    )


def _residual_layer(place: Placement, evidence: Evidence) -> Layer:
    """Draw from each of the mask's matched intersections towards the map's, exaggerated."""
    start = place.to_crs(plane_to_pixel(evidence.query_xy))
    offset = evidence.reference_xy - start
    return Layer(
        "residuals",
        "LINESTRING",
        list(np.stack([start, start + _EXAGGERATION * offset], axis=1)),
        {"residual_m": evidence.residual_m, "dx_m": offset[:, 0], "dy_m": offset[:, 1]},
        place.crs,
        _RESIDUALS_STYLE,
        f"From the mask's intersections towards the map's, {_EXAGGERATION:g} times as long as the residuals are",
    )


def _corner_layer(place: Placement, location: Location) -> Layer:
    """Show the corners of the frame, each with the covariance of its position."""
    sigma, covariance = location.corner_sigma_m, location.corner_covariance_m2
    unknown = np.full(4, np.nan)
    blocks = np.full((4, 2, 2), np.nan)
    if covariance is not None:
        blocks = np.stack([covariance[i : i + 2, i : i + 2] for i in range(0, 8, 2)])
    columns = {
        "corner": list(_CORNERS),
        "sigma_m": unknown if sigma is None else sigma,
        "var_x_m2": blocks[:, 0, 0],
        "cov_xy_m2": blocks[:, 0, 1],
        "var_y_m2": blocks[:, 1, 1],
    }
    summary = "Corners of the frame; how far each may be off, and the covariance of its x and y"
    return Layer("corners", "POINT", place.footprint, columns, place.crs, _CORNERS_STYLE, summary)


def _alternative_layer(place: Placement, location: Location) -> Layer:
    """Show where else the mask might lie."""
    others = location.alternatives
    return Layer(
        "alternatives",
        "POINT",
        np.array([(other.x, other.y) for other in others], float).reshape(-1, 2),
        {
            "rank": np.arange(2, 2 + len(others)),
            "log10_odds": np.array([other.log10_odds for other in others], float),
            "lon": np.array([other.lon for other in others], float),
            "lat": np.array([other.lat for other in others], float),
        },
        place.crs,
        _ALTERNATIVES_STYLE,
        "Middles of the best other places, with their odds",
    )
