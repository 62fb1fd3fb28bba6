"""One row for each frame of a flight: plain values that all outputs share."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo.flights.pose import FramePose
from roadgeo.flights.tracker import Tracked
from roadgeo.geometry.pose import find_pose
from roadgeo.geometry.projection import LocalPlane, grid_north, to_lonlat
from roadgeo.geometry.transformation import LONLAT, exactness

__all__ = ["CameraPlace", "Row", "make_rows"]


@dataclass(frozen=True)
class CameraPlace:
    """Where the camera was: degrees, and metres above the ground; `sigma_m` is of its horizontal place."""

    lon: float
    lat: float
    height_m: float
    sigma_m: float


@dataclass(frozen=True)
class Row:
    """A frame's row, for people and files.

    Attributes
    ----------
    time : datetime or None
        UTC; None where the start of the flight is unknown.
    center : (lon, lat) or None
    footprint : (4, 2) float64 or None
        Corners TL, TR, BR, BL as longitude and latitude.
    sigma_m : float
        Standard deviation of the centre's longitude and latitude.
    heading_deg : float
        Direction of the image's up, clockwise from true north.
    homography : (3, 3) float64 or None
        Pixel (column, row) of the file to `crs`.
    camera : CameraPlace or None
        Where the camera was; None unless its focal length was given.
    """

    number: int
    name: str
    time_s: float
    time: datetime | None
    status: str
    reason: str
    known_at: int
    reference: str = ""
    center: tuple[float, float] | None = None
    footprint: FloatArray | None = None
    sigma_m: float = math.nan
    gsd_m: float = math.nan
    heading_deg: float = math.nan
    log10_odds: float = math.nan
    crs: str = ""
    homography: FloatArray | None = None
    camera: CameraPlace | None = None

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for `json.dumps`."""

        def number(value: float) -> float | None:
            return None if math.isnan(value) else value

        return {
            "schema": "roadgeo.frame/1",
            "frame": self.number,
            "name": self.name,
            "time_s": self.time_s,
            "time": None if self.time is None else self.time.isoformat().replace("+00:00", "Z"),
            "status": self.status,
            "reason": self.reason,
            "known_at": self.known_at,
            "reference": self.reference or None,
            "center": None if self.center is None else {"lon": self.center[0], "lat": self.center[1]},
            "footprint_lonlat": None if self.footprint is None else self.footprint.tolist(),
            "sigma_m": number(self.sigma_m),
            "gsd_m": number(self.gsd_m),
            "heading_deg": number(self.heading_deg),
            "log10_odds": number(self.log10_odds),
            "camera": None if self.camera is None else asdict(self.camera),
            "crs": self.crs or None,
            "homography": None if self.homography is None else self.homography.tolist(),
        }


def make_rows(tracked: Sequence[Tracked], begun: datetime | None = None, focal_px: float | None = None) -> list[Row]:
    """Describe frames; `begun` is the time of the first one, `focal_px` the camera's focal length."""
    return [_row(frame, begun, focal_px) for frame in tracked]


def _row(tracked: Tracked, begun: datetime | None, focal_px: float | None) -> Row:
    frame = tracked.frame
    when = None if begun is None else begun.astimezone(UTC) + timedelta(seconds=frame.time_s)
    bare = (frame.number, frame.name, frame.time_s, when, tracked.status, tracked.reason, tracked.known_at)
    if tracked.pose is None or tracked.reference is None:
        return Row(*bare)
    plane, pose = tracked.reference.index.plane, tracked.pose
    ground = plane.to_crs(np.vstack([pose.corners, pose.center]))
    lonlat = to_lonlat(plane.crs, ground)
    up = pose.homography.jacobian(pose.frame.center) @ (0.0, -1.0)
    heading = math.degrees(math.atan2(up[0], up[1])) + grid_north(plane, ground[4])
    inexact = exactness(plane.crs, LONLAT, lonlat[4].tolist()).sigma_m
    matrix = plane.to_crs_matrix() @ pose.homography.matrix @ np.diag([*frame.stretch, 1.0])
    return Row(
        *bare,
        tracked.reference.name,
        (float(lonlat[4, 0]), float(lonlat[4, 1])),
        lonlat[:4],
        math.hypot(pose.sigma_m, inexact),
        pose.gsd_m,
        heading % 360.0,
        tracked.log10_odds,
        plane.crs,
        matrix / matrix[2, 2],
        None if focal_px is None else _camera(pose, plane, focal_px),
    )


def _camera(pose: FramePose, plane: LocalPlane, focal_px: float) -> CameraPlace | None:
    """Find the camera of a focal length behind a frame; None where it would lie below the ground."""
    size = round(pose.frame.width), round(pose.frame.height)
    camera = find_pose(pose.homography.matrix, size, pose.covariance[:8, :8], focal_px)
    if camera is None:
        return None
    lon, lat = to_lonlat(plane.crs, plane.to_crs(camera.position[None, :2]))[0]
    inexact = exactness(plane.crs, LONLAT, (lon, lat)).sigma_m
    sigma = math.hypot(math.sqrt(float(np.trace(camera.covariance[:2, :2]))), inexact)
    return CameraPlace(float(lon), float(lat), float(camera.position[2]), sigma)
