"""Where the camera was, in the forms of other programs: OGC GeoPose, Orthority, OpenDroneMap."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo.errors import OutputError
from roadgeo.geometry.pose import omega_phi_kappa, quaternion, turned
from roadgeo.location import Camera
from roadgeo.outputs.names import name_for_odm
from roadgeo.outputs.subject import Subject
from roadgeo.storage.files import write_text

__all__ = ["write_geopose", "write_odm_geo", "write_odm_geos", "write_orthority"]


def _camera(subject: Subject) -> Camera:
    if subject.location.camera is None:
        raise OutputError(f"{subject.location.query}: no camera above the ground sees the frame so")
    return subject.location.camera


def write_geopose(path: Path, subject: Subject) -> None:
    """Write an OGC GeoPose 1.0, Basic-Quaternion (OGC 21-056r11).

    Without a terrain model h is the height above the ground. The quaternion takes the camera's axes (x right, y to the
    image's top, z backwards) to east, north and up.
    """
    camera = _camera(subject)
    height = camera.height_m if camera.altitude_m is None else camera.altitude_m
    x, y, z, w = quaternion(camera.rotation)
    pose = {
        "position": {"lat": camera.lat, "lon": camera.lon, "h": height},
        "quaternion": {"x": x, "y": y, "z": z, "w": w},
    }
    path.write_text(json.dumps(pose, indent=2) + "\n", encoding="utf-8")


def write_orthority(path: Path, subject: Subject) -> None:
    """Write exterior parameters as Orthority reads them (GeoJSON); its axes are those of the CRS, not of true north.

    Orthority reads pixels in their stored order, even if EXIF gives another orientation.

    Its interior parameters stand among the properties: `focal_len` in longer sides of the picture.
    """
    from roadgeo.geometry.projection import LocalPlane, grid_north

    camera, place = _camera(subject), subject.place
    at = np.array([camera.x, camera.y])
    grid = turned(camera.rotation, grid_north(LocalPlane(place.crs, (0.0, 0.0)), at)) @ _stored_axes(subject)
    height = camera.height_m if camera.altitude_m is None else camera.altitude_m
    longer_side = max(subject.size)
    focal = camera.focal_px * subject.size[0] / subject.mask.shape[1]
    properties = {
        "filename": subject.picture.name,
        "camera": None,
        "xyz": [camera.x, camera.y, height],
        "opk": list(omega_phi_kappa(grid)),
        "type": "pinhole",
        "im_size": [abs(round(side)) for side in (subject.stored.matrix[:2, :2] @ subject.size).tolist()],
        "focal_len": focal / longer_side,
    }
    point = {"type": "Point", "coordinates": [camera.lon, camera.lat, height]}
    collection = {
        "type": "FeatureCollection",
        "world_crs": place.crs,
        "features": [{"type": "Feature", "properties": properties, "geometry": point}],
    }
    path.write_text(json.dumps(collection, indent=2) + "\n", encoding="utf-8")


def _stored_axes(subject: Subject) -> FloatArray:
    """Return (3, 3) the axes of a camera that took a picture as it is stored, in those of one that took it upright."""
    across = subject.stored.matrix[:2, :2].T * np.array([[1.0, -1.0], [-1.0, 1.0]])  # rows count downwards
    if np.linalg.det(across) < 0:
        raise OutputError(f"{subject.picture}: is stored mirrored, as no camera takes it; save it upright")
    axes = np.eye(3)
    axes[:2, :2] = across
    return axes


def write_odm_geo(path: Path, subject: Subject) -> None:
    """Write the camera's position as OpenDroneMap's image geolocation file (`geo.txt`)."""
    document = {**subject.location.to_dict(), "query": subject.picture.name}
    path.write_text(_odm_lines([document]), encoding="utf-8")


def write_odm_geos(path: Path, documents: Sequence[Mapping[str, Any]]) -> None:
    """Write the positions of all located masks of a batch as one `geo.txt`.

    Raises
    ------
    OutputError
        It cannot be written.
    """
    write_text(path, _odm_lines(documents))


def _odm_lines(documents: Sequence[Mapping[str, Any]]) -> str:
    """Return the lines: longitude, latitude, height, no angles (0, as its manual asks), and accuracies."""
    lines = ["EPSG:4326"]
    for document in documents:
        camera = document.get("camera")
        if document["status"] != "located" or camera is None:
            continue
        sigma, altitude = camera["sigma"], camera["altitude_m"]
        height = camera["height_m"] if altitude is None else altitude
        flat = math.hypot(sigma["x_m"], sigma["y_m"], document.get("lonlat_accuracy_m") or 0.0)
        position = f"{camera['lon']:.9f} {camera['lat']:.9f} {height:.3f}"
        lines.append(
            f"{name_for_odm(Path(document['query']).name)} {position} 0 0 0 {flat:.3f} {sigma['height_m']:.3f}"
        )
    return "\n".join(lines) + "\n"
