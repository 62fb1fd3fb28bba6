"""A location of a picture by control points, as roadgeo draws pictures by it. Needs NumPy."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from qgis.core import (
    QgsCoordinateReferenceSystem,
    QgsCoordinateTransform,
    QgsPointXY,
    QgsProcessingException,
    QgsProject,
    QgsRasterLayer,
)

from .refit import FEWEST, fit, place, read_points

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
    crs, found, layer = QgsCoordinateReferenceSystem.fromWkt(wkt), fit(matches), QgsRasterLayer(picture, "picture")
    if found.matrix is None:
        raise QgsProcessingException(f"{points}: needs {FEWEST} points that are on, not on one line")
    if not crs.isValid():
        raise QgsProcessingException(f"{points}: does not say in which CRS its points are")
    width, height = layer.width(), layer.height()
    frame = np.array(
        [[0.0, 0.0], [width, 0.0], [width, height], [0.0, height], [width / 2, height / 2], [width / 2, 0.0]]
    )
    there = place(found.matrix, frame)
    transform = QgsCoordinateTransform(crs, QgsCoordinateReferenceSystem("EPSG:4326"), QgsProject.instance())
    lonlat = [[one.x(), one.y()] for one in (transform.transform(QgsPointXY(*spot)) for spot in there.tolist())]
    (x, y), up = there[4].tolist(), there[5] - there[4]
    diagonals = there[2] - there[0], there[3] - there[1]
    area = 0.5 * abs(float(diagonals[0][0] * diagonals[1][1] - diagonals[0][1] * diagonals[1][0]))
    used = [apart for one, apart in zip(matches, found.residuals) if one.on]  # noqa: B905 (as long as each other)
    location = {
        "schema": "roadgeo.location/1",
        "query": picture,
        "status": "located",
        "reason": f"placed by {len(used)} control points",
        "crs": wkt,
        "size": [width, height],
        "homography": found.matrix.tolist(),
        "footprint": there[:4].tolist(),
        "footprint_lonlat": lonlat[:4],
        "center": {"x": x, "y": y, "lon": lonlat[4][0], "lat": lonlat[4][1]},
        "gsd_m": math.sqrt(area / (width * height)),
        "rotation_deg": math.degrees(math.atan2(up[0], up[1])),
    }
    return location, math.sqrt(sum(apart * apart for apart in used) / len(used))
