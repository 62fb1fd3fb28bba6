"""The metric plane of a reference: which CRS, the local origin that keeps numbers small, and the way to degrees.

Longitude comes before latitude everywhere. pyproj is imported on first use.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo.errors import CrsError

if TYPE_CHECKING:
    from pyproj import Transformer

__all__ = ["LocalPlane", "choose_plane", "from_lonlat", "grid_north", "to_lonlat", "transformer"]

#: UTM reaches from 80 S to 84 N; the polar stereographic planes (UPS) lie beyond.
_UPS_NORTH, _UPS_SOUTH = 84.0, -80.0

#: A UTM zone is used this far from its central meridian (its own half width is 3 degrees); scale is off by < 0.3 %.
_UTM_HALF_WIDTH_DEG = 4.5


@dataclass(frozen=True)
class LocalPlane:
    """A metric CRS and an origin in it: plane (x, y) = CRS (easting, northing) - origin, metres, y up.

    Attributes
    ----------
    crs : str
        "EPSG:n" where there is a code, else WKT2.
    origin : (float, float)
        Easting and northing of the plane's (0, 0): UTM northings of 4.7e6 squared would ruin a linear solve.
    """

    crs: str
    origin: tuple[float, float]

    def to_crs(self, xy: FloatArray) -> FloatArray:
        """Plane metres (..., 2) to CRS coordinates."""
        return np.asarray(xy, float) + self.origin

    def from_crs(self, en: FloatArray) -> FloatArray:
        """CRS coordinates (..., 2) to plane metres."""
        return np.asarray(en, float) - self.origin

    def to_crs_matrix(self) -> FloatArray:
        """(3, 3) homography from the plane to the CRS."""
        return np.array([[1.0, 0.0, self.origin[0]], [0.0, 1.0, self.origin[1]], [0.0, 0.0, 1.0]])


def choose_plane(lonlat: FloatArray) -> LocalPlane:
    """Choose the metric plane of data by its own longitudes.

    UTM where the data fits a zone, UPS in the polar zones, else an oblique stereographic plane around the data's
    middle: conformal like the others, so that angles between roads are those on the ground.

    Parameters
    ----------
    lonlat : (N, 2) float64
        Points spread over the data, degrees; longitudes may lie on both sides of 180 degrees.

    Raises
    ------
    CrsError
        No points, not degrees, or half the globe.
    """
    points = np.asarray(lonlat, float).reshape(-1, 2)
    if len(points) == 0:
        raise CrsError("no coordinates to choose a metric CRS for")
    reach = float(np.abs(points).max()) if np.isfinite(points).all() else np.inf
    if not reach <= 360.0 or np.abs(points[:, 1]).max() > 90.0:
        raise CrsError(
            f"coordinates reach {reach:.6g}, expected degrees of longitude and latitude; "
            "the data's CRS is not what it says: give the right one with --crs"
        )
    west, east = _longitudes(points[:, 0])
    south, north = points[:, 1].min(), points[:, 1].max()
    lon, lat = (west + east) / 2, float(south + north) / 2
    zone = int((lon + 180.0) % 360.0 // 6.0) + 1
    meridian = 6.0 * zone - 183.0
    middle = lon - meridian - 360.0 * np.round((lon - meridian) / 360.0)
    if lat > _UPS_NORTH or lat < _UPS_SOUTH:
        crs = "EPSG:5041" if lat > 0 else "EPSG:5042"
    elif abs(middle) + (east - west) / 2 <= _UTM_HALF_WIDTH_DEG:
        crs = f"EPSG:{32600 + zone if lat >= 0 else 32700 + zone}"
    else:
        crs = _stereographic(round((lon + 180.0) % 360.0 - 180.0, 2), round(lat, 2))
    en = np.stack(transformer("EPSG:4326", crs).transform(points[:, 0], points[:, 1]), axis=1)
    if not np.isfinite(en).all():
        raise CrsError(
            f"the data spans {east - west:.0f} x {north - south:.0f} degrees, too much for one plane; "
            "build one reference for each region"
        )
    center = (en.min(axis=0) + en.max(axis=0)) / 2
    return LocalPlane(crs, (float(round(center[0], -3)), float(round(center[1], -3))))


def to_lonlat(crs: str, en: FloatArray) -> FloatArray:
    """Take (N, 2) coordinates of a CRS to longitude and latitude (WGS 84), degrees."""
    points = np.asarray(en, float)
    return np.stack(transformer(crs, "EPSG:4326").transform(points[:, 0], points[:, 1]), axis=1)


def from_lonlat(plane: LocalPlane, lonlat: FloatArray) -> FloatArray:
    """Take (N, 2) longitudes and latitudes (WGS 84), degrees, to plane metres."""
    points = np.asarray(lonlat, float)
    en = transformer("EPSG:4326", plane.crs).transform(points[:, 0], points[:, 1])
    return plane.from_crs(np.stack(en, axis=1))


def grid_north(plane: LocalPlane, en: FloatArray) -> float:
    """Return the direction of a plane's y axis at a place (2,) of its CRS, degrees clockwise from true north.

    A few degrees on a UTM zone, anything on a polar plane.
    """
    from pyproj import Geod

    (lon, lat), (lon_up, lat_up) = to_lonlat(plane.crs, np.add(en, [[0.0, 0.0], [0.0, 10.0]])).tolist()
    return float(Geod(ellps="WGS84").inv(lon, lat, lon_up, lat_up)[0])


@lru_cache(maxsize=16)
def transformer(source: str, target: str) -> Transformer:
    """Return the pyproj transformer between two CRS, x before y.

    Raises
    ------
    CrsError
        A CRS is unknown, or there is no way between them.
    """
    from pyproj import Transformer
    from pyproj.exceptions import ProjError

    try:
        return Transformer.from_crs(source, target, always_xy=True)
    except ProjError as error:
        raise CrsError(f"no way from {_short(source)} to {_short(target)}: {error}") from error


def _longitudes(lon: FloatArray) -> tuple[float, float]:
    """Return the western and eastern end of longitudes, unwrapped: the widest empty stretch lies outside."""
    around = np.unique(np.round(lon % 360.0, 6))
    gaps = np.diff(np.append(around, around[0] + 360.0))
    k = int(np.argmax(gaps))
    west = float(around[(k + 1) % len(around)])
    east = float(around[k])
    return (west, east) if west <= east else (west - 360.0, east)


def _stereographic(lon: float, lat: float) -> str:
    """Return the WKT2 of an oblique stereographic plane around a point."""
    from pyproj import CRS

    crs = CRS.from_proj4(f"+proj=sterea +lat_0={lat} +lon_0={lon} +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m +type=crs")
    parts = crs.to_json_dict()
    parts["name"] = f"Oblique stereographic, {abs(lat):g} {'NS'[lat < 0]}, {abs(lon):g} {'EW'[lon < 0]}"
    parts["conversion"]["name"] = parts["name"]
    parts["base_crs"]["name"] = "WGS 84"
    return CRS.from_json_dict(parts).to_wkt("WKT2_2019")


def _short(crs: str) -> str:
    return crs if len(crs) <= 40 else crs[:37] + "..."
