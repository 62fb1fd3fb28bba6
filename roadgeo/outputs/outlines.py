"""The outline of a result in the forms of the web: GeoJSON, STAC."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo.geometry.antimeridian import bounds_of, cut_ring
from roadgeo.outputs.columns import attributes
from roadgeo.outputs.subject import Subject

__all__ = ["write_geojson", "write_stac"]

#: Stands for an unknown date: no photograph from the air is older.
_FIRST_AERIAL_PHOTOGRAPH = "1858-01-01T00:00:00Z"


def write_geojson(path: Path, subject: Subject) -> None:
    """Write the footprint as GeoJSON as of RFC 7946: degrees, counterclockwise, cut at 180 degrees."""
    feature = {
        "type": "Feature",
        "bbox": _bounds(subject.outline()),
        "geometry": _geometry(subject.outline()),
        "properties": attributes(subject.location.to_dict()),
    }
    path.write_text(json.dumps(feature, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def write_stac(path: Path, subject: Subject) -> None:
    """Write a STAC 1.0 Item that describes the warped raster, with the projection extension."""
    location, grid, paths = subject.location, subject.grid, subject.paths
    taken = datetime.fromtimestamp(subject.picture.stat().st_mtime, UTC)
    own = {f"roadgeo:{key}": value for key, value in attributes(location.to_dict()).items() if value is not None}
    code = subject.crs if subject.crs.upper().startswith("EPSG:") else None
    projection = {"proj:code": code} if code else {"proj:code": None, "proj:wkt2": subject.crs}
    item = {
        "type": "Feature",
        "stac_version": "1.0.0",
        "stac_extensions": ["https://stac-extensions.github.io/projection/v2.0.0/schema.json"],
        "id": paths.stem,
        "bbox": _bounds(subject.outline()),
        "geometry": _geometry(subject.outline()),
        "properties": {
            # Without a date: some time before the file was last written.
            "datetime": None,
            "start_datetime": _FIRST_AERIAL_PHOTOGRAPH,
            "end_datetime": taken.strftime("%Y-%m-%dT%H:%M:%SZ"),
            "gsd": location.gsd_m,
            **projection,
            "proj:shape": [grid.height, grid.width],
            "proj:transform": grid.to_crs_matrix().ravel().tolist(),
            **own,
        },
        "links": [],
        "assets": {
            "footprint": _asset(paths.footprint, "image/tiff; application=geotiff; profile=cloud-optimized", "data"),
            "location": _asset(paths.json, "application/json", "metadata"),
            "matches": _asset(paths.geopackage, "application/geopackage+sqlite3", "metadata"),
        },
    }
    path.write_text(json.dumps(item, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _geometry(ring: FloatArray) -> dict[str, Any]:
    """Return a GeoJSON polygon, or where the ring lies astride 180 degrees two."""
    polygons = [[np.round(part, 7).tolist()] for part in cut_ring(ring)]
    if len(polygons) == 1:
        return {"type": "Polygon", "coordinates": polygons[0]}
    return {"type": "MultiPolygon", "coordinates": polygons}


def _bounds(ring: FloatArray) -> list[float]:
    """Return west, south, east, north as RFC 7946 wants them."""
    return [round(value, 7) for value in bounds_of(ring)]


def _asset(path: Path, media_type: str, role: str) -> dict[str, Any]:
    return {"href": f"./{path.name}", "type": media_type, "roles": [role]}
