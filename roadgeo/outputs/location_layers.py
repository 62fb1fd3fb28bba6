"""The GeoPackage of a result: footprint, the mask's roads, matched intersections with their residuals."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.mask import plane_to_pixel
from roadgeo.location import Evidence
from roadgeo.outputs.columns import attributes
from roadgeo.outputs.paths import Placement
from roadgeo.outputs.subject import Subject
from roadgeo.storage.geopackage import Layer, dump_layers
from roadgeo.storage.qml import draw_fill, draw_line, draw_marker

__all__ = ["write_geopackage"]

_FOOTPRINT_STYLE = draw_fill("31,111,180,20", "31,111,180", 0.7)
_ROADS_STYLE = draw_line("228,87,46", 0.5)
_MATCHES_STYLE = draw_marker("27,38,59", 2.2)


def write_geopackage(path: Path, subject: Subject) -> None:
    """Write the layers `footprint`, `query_roads` and `matches`, styled for QGIS."""
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
        layers += [_road_layer(place, evidence), _match_layer(place, evidence)]
    return layers


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
    offset = evidence.reference_xy - Homography(place.homography)(pixels)
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
