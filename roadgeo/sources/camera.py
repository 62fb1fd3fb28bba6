"""What a camera states of its view, in EXIF and in the XMP of drones, as hints with the errors of such statements.

DJI, Autel and Parrot give the camera's angle above the horizon; senseFly and others that follow Pix4D the angle from
the vertical. A receiver with corrections, and senseFly, state how exact the position is.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from roadgeo.errors import MaskError
from roadgeo.sources.exif import number_of, read_focal_length, read_metadata, read_position
from roadgeo.storage.rasters import raster_size

__all__ = ["estimate_gsd", "read_stated"]

_HEIGHT = ("drone-dji:RelativeAltitude", "drone:RelativeAltitude", "Camera:AboveGroundAltitude")
_YAW = ("drone-dji:GimbalYawDegree", "drone:GimbalYawDegree", "drone-parrot:CameraYawDegree", "Camera:Yaw")
_ABOVE_HORIZON = ("drone-dji:GimbalPitchDegree", "drone:GimbalPitchDegree", "drone-parrot:CameraPitchDegree")
_FROM_VERTICAL = ("Camera:Pitch",)
_ROLL = ("drone-dji:GimbalRollDegree", "drone:GimbalRollDegree")
_SIGMA = ("drone-dji:RtkStdLat", "drone:RtkStdLat", "Camera:GPSXYAccuracy")

#: Metres by which a position without a stated accuracy may be off (GPS promises 8 m for 95 % of the time), and a height
#: beyond a tenth of it: it is taken by air pressure, and counts from the take-off, not from the ground in view.
_POSITION_M, _HEIGHT_M, _HEIGHT_SHARE = 15.0, 20.0, 0.1
#: Degrees by which a gimbal's angle from the vertical may be off, and a direction, which a compass gives.
_TILT_OFF_DEG, _YAW_OFF_DEG = 3.0, 15.0
_SIGMAS = 3.0
_UNKNOWN_TILT_DEG, _MOST_TILT_DEG = 45.0, 75.0  # beyond the second the middle of the view may be anywhere


def read_stated(names: Iterable[str], image: str, photo: str | None = None) -> dict[str, Any]:
    """Return hints that the camera of an image, or of the photograph that it was made of, states.

    Parameters
    ----------
    names : iterable of str
        By `matching.hints.Hint.goes_to`: near, gsd_m, heading_deg, focal_px.

    Raises
    ------
    MaskError
        It does not state one of them.
    """
    path, read = photo or image, dict[str, Any]()
    for name in names:
        if name == "near":
            read[name] = _View.of(path).near()
        elif name == "heading_deg":
            read[name] = _View.of(path).heading_deg()
        else:
            focal_px = read_focal_length(path) * max(raster_size(image))
            read[name] = focal_px if name == "focal_px" else _View.of(path).gsd_m(focal_px)
    return read


def estimate_gsd(path: str | os.PathLike[str]) -> float | None:
    """Estimate the size of a photograph's pixels on the ground, metres; None where height or focal length is missing.

    The height above the take-off is better than EXIF "GPSAltitude", which counts from the sea.
    """
    try:
        view, focal = _View.of(os.fspath(path)), read_focal_length(path)
    except (MaskError, UnicodeDecodeError):  # damaged
        return None
    height = view.height_m if math.isfinite(view.height_m) else view.altitude_m
    return height / focal / max(raster_size(path)) if 5.0 <= height <= 100_000.0 else None


@dataclass(frozen=True)
class _View:
    """Statements of a camera: metres, degrees from north and from the vertical; NaN where they are missing."""

    path: str
    height_m: float
    altitude_m: float
    yaw_deg: float
    tilt_deg: float
    sigma_m: float

    @classmethod
    def of(cls, path: str) -> _View:
        tags, xmp = read_metadata(path)
        height, yaw, pitch, tilt, roll, sigma = (
            _find(xmp, names) for names in (_HEIGHT, _YAW, _ABOVE_HORIZON, _FROM_VERTICAL, _ROLL, _SIGMA)
        )
        tilt = tilt if math.isnan(pitch) else 90.0 + pitch
        tilt = 90.0 + tilt if tilt < -_UNKNOWN_TILT_DEG else tilt  # some give the angle above the horizon for it
        turned = 180.0 if abs(roll) > 90.0 or tilt < 0.0 else 0.0  # upside down, or looking back
        altitude = number_of(tags.get("EXIF_GPSAltitude", "")) or math.nan
        return cls(path, height, altitude, yaw + (turned if abs(roll) > 90.0 else 0.0), abs(tilt), sigma)

    def heading_deg(self) -> tuple[float, float]:
        """Where the image's up points, and how far off that may be."""
        heading = self._stated(self.yaw_deg, "direction", "heading")
        return (heading + 180.0) % 360.0 - 180.0, _YAW_OFF_DEG

    def gsd_m(self, focal_px: float) -> tuple[float, float]:
        """Least and greatest size of a pixel in the middle of the view."""
        height = self._stated(self.height_m, "height above the ground", "gsd")
        off, (least, most) = self._height_off_m(), self._tilts_deg("gsd")
        low, high = max(height - off, height / 2) / _slant(least), (height + off) / _slant(most)
        return low / focal_px, high / focal_px

    def near(self) -> tuple[float, float, float]:
        """Longitude and latitude of the middle of the view, and how far off it may be."""
        from pyproj import Geod

        lon, lat = read_position(self.path) or (math.nan, math.nan)
        self._stated(lon, "position", "near")
        most = math.tan(math.radians(self._tilts_deg("near")[1]))
        off = _POSITION_M if math.isnan(self.sigma_m) else _SIGMAS * self.sigma_m
        ahead = self.height_m * math.tan(math.radians(self.tilt_deg))
        if math.isfinite(ahead) and math.isfinite(self.yaw_deg):
            lon, lat, _ = Geod(ellps="WGS84").fwd(lon, lat, self.yaw_deg, ahead)
            reach = (self.height_m + self._height_off_m()) * most - ahead
            return float(lon), float(lat), off + math.hypot(reach, ahead * math.radians(_YAW_OFF_DEG))
        highest = self.height_m + self._height_off_m() if math.isfinite(self.height_m) else self.altitude_m
        return lon, lat, off + self._stated(highest, "height", "near") * most

    def _height_off_m(self) -> float:
        return _HEIGHT_M + _HEIGHT_SHARE * self.height_m

    def _tilts_deg(self, hint: str) -> tuple[float, float]:
        """Return the least and the greatest angle from the vertical."""
        if math.isnan(self.tilt_deg):
            return 0.0, _UNKNOWN_TILT_DEG
        if self.tilt_deg > _MOST_TILT_DEG:
            raise MaskError(f"{self.path}: its camera looked at the horizon, as it states: leave out --{hint}")
        return max(self.tilt_deg - _TILT_OFF_DEG, 0.0), self.tilt_deg + _TILT_OFF_DEG

    def _stated(self, value: float, what: str, hint: str) -> float:
        if math.isnan(value):
            raise MaskError(
                f"{self.path}: EXIF and XMP state no {what} of its camera: give --{hint} as a value, or none"
            )
        return value


def _slant(tilt_deg: float) -> float:
    """Return by how much a pixel on the ground grows, looked at aslant: once by distance, once more along the view."""
    return float(math.cos(math.radians(tilt_deg)) ** 1.5)


def _find(xmp: str, names: Iterable[str]) -> float:
    """Return the number that the first of these names has in XMP, as an attribute or an element; NaN without one."""
    for name in names:
        match = re.search(rf"\b{name}(?:\s?=\s?[\"']|>)\s?([-+]?\d{{1,9}}(?:\.\d{{1,12}})?)(?:/(\d{{1,9}}))?", xmp)
        if match:
            return float(match[1]) / float(match[2] or 1) if float(match[2] or 1) else math.nan
    return math.nan
