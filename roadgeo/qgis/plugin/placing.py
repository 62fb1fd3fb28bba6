"""A location of a picture by control points, as roadgeo draws pictures by it. Needs NumPy."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from qgis.core import (
    QgsCoordinateReferenceSystem,
    QgsCoordinateTransform,
    QgsGeometry,
    QgsPointXY,
    QgsProcessingException,
    QgsProject,
    QgsRasterLayer,
)

from .refit import FEWEST, corners, fit, place, read_points, rms

__all__ = ["make_location"]


def make_location(picture: str, points: str) -> tuple[dict[str, Any], float]:
    """Return where points put a picture, as `roadgeo apply` reads it, and the root mean square of their residuals.

    Raises
    ------
    QgsProcessingException
        The file holds no control points, too few or on a line, or names no CRS.
    """
    try:
        wkt, matches = read_points(points)
    except ValueError as error:
        raise QgsProcessingException(str(error)) from error
    crs, fitted, layer = QgsCoordinateReferenceSystem.fromWkt(wkt), fit(matches), QgsRasterLayer(picture, "picture")
    if fitted.matrix is None:
        raise QgsProcessingException(f"{points}: needs {FEWEST} points that are on, not on one line")
    if not crs.isValid():
        raise QgsProcessingException(f"{points}: does not say in which CRS its points are")
    width, height = layer.width(), layer.height()
    frame = np.array([*corners(width, height), (width / 2, height / 2), (width / 2, 0.0)])
    there = place(fitted.matrix, frame).tolist()
    spots = [QgsPointXY(*spot) for spot in there]
    transform = QgsCoordinateTransform(crs, QgsCoordinateReferenceSystem("EPSG:4326"), QgsProject.instance())
    lonlat = [[spot.x(), spot.y()] for spot in map(transform.transform, spots)]
    used = [apart for match, apart in zip(matches, fitted.residuals) if match.on]  # noqa: B905 (as long as each other)
    location = {
        "schema": "roadgeo.location/1",
        "query": picture,
        "status": "located",
        "reason": f"placed by {len(used)} control points",
        "crs": wkt,
        "size": [width, height],
        "homography": fitted.matrix.tolist(),
        "footprint": there[:4],
        "footprint_lonlat": lonlat[:4],
        "center": dict(zip(("x", "y", "lon", "lat"), (*there[4], *lonlat[4]))),  # noqa: B905
        "gsd_m": math.sqrt(QgsGeometry.fromPolygonXY([spots[:4]]).area() / (width * height)),
        "rotation_deg": spots[4].azimuth(spots[5]),
    }
    return location, rms(used)
