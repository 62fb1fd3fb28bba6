"""The GeoPackage of a result: footprint, the mask's roads, matched intersections with their residuals."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from roadgeo.geometry.homography import Homography
from roadgeo.geometry.mask import PIXEL_TO_PLANE, plane_to_pixel
from roadgeo.location import Evidence
from roadgeo.outputs.columns import attributes
from roadgeo.outputs.paths import Placement
from roadgeo.outputs.subject import Subject
from roadgeo.storage.geopackage import Layer, write_layers
from roadgeo.storage.qml import draw_fill, draw_line, draw_marker

__all__ = ["write_geopackage"]

_FOOTPRINT_STYLE = draw_fill("31,111,180,20", "31,111,180", 0.7)
_ROADS_STYLE = draw_line("228,87,46", 0.5)
_MATCHES_STYLE = draw_marker("27,38,59", 2.2)


def write_geopackage(path: Path, subject: Subject) -> None:
    """Write the layers `footprint`, `query_roads` and `matches`, styled for QGIS."""
    write_layers(path, _layers(subject))


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
    """Draw the mask's roads on the map. A homography keeps lines straight, so mapping their vertices is exact."""
    to_crs = Homography(place.homography @ PIXEL_TO_PLANE)
    lines = [line for line in map(to_crs, evidence.query_graph.polylines()) if np.isfinite(line).all()]
    lengths = [float(np.hypot(*np.diff(line, axis=0).T).sum()) for line in lines]
    return Layer(
        "query_roads",
        "LINESTRING",
        lines,
        {"length_m": lengths},
        place.crs,
        _ROADS_STYLE,
        "Roads of the mask, as vectorized",
    )


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
