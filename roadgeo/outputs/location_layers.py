"""The GeoPackage of a result: footprint, the mask's roads, matched intersections with their residuals."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo.geometry.mask import plane_to_pixel
from roadgeo.geometry.placement import Matches, Placement
from roadgeo.geometry.transformation import LONLAT
from roadgeo.location import Location
from roadgeo.outputs.columns import attributes
from roadgeo.outputs.drawing.layers import rgb
from roadgeo.outputs.placing import map_roads
from roadgeo.outputs.subject import Subject
from roadgeo.roads.graph import RoadGraph
from roadgeo.storage.geopackage import FeatureTable, dump_layers
from roadgeo.storage.qml import draw_arrow, draw_fill, draw_line, draw_marker

__all__ = ["write_geopackage"]

#: Colours of pages and pictures, as QGIS writes them.
_FRAME, _QUERY, _MATCH = (",".join(map(str, rgb(name))) for name in ("frame", "query", "match"))
_FOOTPRINT_STYLE = draw_fill(f"{_FRAME},20", _FRAME, 0.7)
_ROADS_STYLE = draw_line(_QUERY, 0.5)
_MATCHES_STYLE = draw_marker(_MATCH, 2.2)
_RESIDUALS_STYLE = draw_arrow(_MATCH, 0.4)
_CORNERS_STYLE = draw_marker(_FRAME, 1.8)
_ALTERNATIVES_STYLE = draw_marker("240,180,41", 3.0)

_CORNERS = ("top left", "top right", "bottom right", "bottom left")
#: Factor by which residuals are enlarged: metres cannot be seen on a footprint of a kilometre.
_EXAGGERATION = 20.0


def write_geopackage(path: Path, subject: Subject) -> None:
    """Write the layers `footprint`, `query_roads`, `residuals`, `matches`, `corners` and `alternatives`, styled."""
    dump_layers(path, _layers(subject))


def _layers(subject: Subject) -> list[FeatureTable]:
    place, matches = subject.place, subject.place.matches
    columns = {name: [value] for name, value in attributes(subject.location.to_dict()).items()}
    text = "Ground that the image shows"
    return [
        FeatureTable("footprint", "POLYGON", [place.footprint], columns, place.crs, _FOOTPRINT_STYLE, text),
        *([] if matches is None else _match_layers(place, subject.graph, matches)),
        _corner_layer(place),
        _alternative_layer(subject.location),
    ]


def _match_layers(place: Placement, graph: RoadGraph, matches: Matches) -> list[FeatureTable]:
    """Draw the mask's roads on the map, its matched intersections where the map has them, and the way between both."""
    lines, pixels = map_roads(place, graph), plane_to_pixel(matches.query_xy)
    start, end = place.to_crs(pixels), matches.reference_xy
    arrows = list(np.stack([start, start + _EXAGGERATION * (end - start)], axis=1))
    apart = {"residual_m": matches.residual_m, "dx_m": end[:, 0] - start[:, 0], "dy_m": end[:, 1] - start[:, 1]}
    where = {"column": pixels[:, 0], "row": pixels[:, 1]}
    texts = (
        "Roads of the mask, as vectorized",
        f"From the mask's intersections towards the map's, {_EXAGGERATION:g} times as long as the residuals are",
        "Intersections found both in the mask and on the map",
    )
    length = {"length_m": _lengths(lines)}
    return [
        FeatureTable("query_roads", "LINESTRING", lines, length, place.crs, _ROADS_STYLE, texts[0]),
        FeatureTable("residuals", "LINESTRING", arrows, apart, place.crs, _RESIDUALS_STYLE, texts[1]),
        FeatureTable("matches", "POINT", end, {**where, **apart}, place.crs, _MATCHES_STYLE, texts[2]),
    ]


def _lengths(lines: Sequence[FloatArray]) -> FloatArray:
    """Lengths of (V, 2) lines, all at once: calls for single ones would cost more than all else here."""
    if not lines:
        return np.empty(0)
    starts = np.cumsum([0, *map(len, lines)])
    steps = np.hypot(*np.diff(np.concatenate(lines), axis=0).T)
    steps[starts[1:-1] - 1] = 0.0  # from one line to the next
    return np.asarray(np.add.reduceat(steps, starts[:-1]))


def _corner_layer(place: Placement) -> FeatureTable:
    """Show the corners of the frame, each with the covariance of its position."""
    sigma, covariance = place.corner_sigma_m, place.corner_covariance_m2
    covariance = np.full((8, 8), np.nan) if covariance is None else covariance
    columns = {
        "corner": list(_CORNERS),
        "sigma_m": np.full(4, np.nan) if sigma is None else sigma,
        "var_x_m2": covariance.diagonal()[::2],
        "cov_xy_m2": covariance.diagonal(1)[::2],
        "var_y_m2": covariance.diagonal()[1::2],
    }
    summary = "Corners of the frame; how far each may be off, and the covariance of its x and y"
    return FeatureTable("corners", "POINT", place.footprint, columns, place.crs, _CORNERS_STYLE, summary)


def _alternative_layer(location: Location) -> FeatureTable:
    """Show where else the mask might lie."""
    others = location.alternatives
    values = np.array([(*other.center[2:], other.score) for other in others], float).reshape(-1, 3)
    columns = dict(zip(("lon", "lat", "log10_odds"), values.T, strict=True))
    columns = {"rank": np.arange(2, 2 + len(others)), **columns}
    text = "Middles of the best other places, with their scores"
    # In degrees, for they may lie on other maps.
    return FeatureTable("alternatives", "POINT", values[:, :2], columns, LONLAT, _ALTERNATIVES_STYLE, text)
