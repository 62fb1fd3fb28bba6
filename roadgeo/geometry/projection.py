"""The metric plane of a reference: which CRS, the local origin that keeps numbers small, and the way to degrees.

Longitude comes before latitude everywhere. pyproj is imported on first use.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo._text import log_of
from roadgeo.errors import CrsError
from roadgeo.geometry.homography import shift
from roadgeo.geometry.transformation import exactness
from roadgeo.storage.crs import known_crs

if TYPE_CHECKING:
    from pyproj import Transformer

__all__ = [
    "LocalPlane",
    "choose_plane",
    "from_lonlat",
    "grid_north",
    "metres_apart",
    "serves_as_plane",
    "to_lonlat",
    "to_plane",
    "transform",
    "transformer",
]

_LOG = log_of(__name__)

_EARTH_RADIUS_M = 6.371e6

#: UTM reaches from 80 S to 84 N; the polar stereographic planes (UPS) lie beyond.
_UPS_NORTH, _UPS_SOUTH = 84.0, -80.0

#: A UTM zone is used this far from its central meridian (its own half width is 3 degrees); scale is off by < 0.3 %.
_UTM_HALF_WIDTH_DEG = 4.5

#: A source's own CRS is kept up to these: UTM at 4.5 degrees reaches 0.27 %, national grids 0.1-0.4 %. A degree of
#: Angular distortion as small as the best tangents measure; half of it goes unnoticed.
_MOST_SCALE_ERROR, _MOST_ANGLE_DEG = 0.004, 0.5


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
        return shift(*self.origin)


def choose_plane(lonlat: FloatArray, own_crs: str | None = None) -> LocalPlane:
    """Choose the metric plane of data: its own CRS where that serves, else one chosen by its longitudes.

    Else means UTM where the data fits a zone, UPS in the polar zones, and elsewhere an oblique stereographic plane
    around the data's middle: conformal like the others, so that angles between roads are those on the ground.

    Parameters
    ----------
    lonlat : (N, 2) float64
        Points spread over the data, degrees; longitudes may lie on both sides of 180 degrees.
    own_crs : str, optional
        The CRS that the data came in, where it all came in one: people expect answers in it. See `serves_as_plane`.

    Raises
    ------
    CrsError
        No points, not degrees, or half the globe.
    """
    points = np.asarray(lonlat, float).reshape(-1, 2)
    if len(points) == 0:
        raise CrsError("no coordinates to choose a metric CRS for")
    if np.isnan(points).any():
        raise CrsError(f"{int(np.isnan(points).any(axis=1).sum())} of {len(points)} coordinates are NaN; mend them")
    reach = float(np.abs(points).max())
    if not reach <= 360.0 or np.abs(points[:, 1]).max() > 90.0:
        raise CrsError(
            f"coordinates reach {reach:.6g}, expected degrees of longitude and latitude; "
            "the data's CRS is wrong: give the right one with --crs"
        )
    crs = own_crs if own_crs and serves_as_plane(own_crs, points) else _conformal_crs(points)
    if own_crs and crs != own_crs:
        way = exactness(own_crs, crs, points.mean(axis=0).tolist())
        if way.grids:
            _LOG.warning("%s", way.told(f"places of {_short(own_crs)} in {_short(crs)}"))
    en = np.stack(transformer("EPSG:4326", crs).transform(points[:, 0], points[:, 1]), axis=1)
    if not np.isfinite(en).all():
        west, east = _longitudes(points[:, 0])
        raise CrsError(
            f"the data spans {east - west:.0f} x {np.ptp(points[:, 1]):.0f} degrees, too much for one plane; "
            "build one reference for each region"
        )
    center = (en.min(axis=0) + en.max(axis=0)) / 2
    return LocalPlane(crs, (float(round(center[0], -3)), float(round(center[1], -3))))


def serves_as_plane(crs: str, lonlat: FloatArray) -> bool:
    """Whether a CRS measures metres east and north, true enough to scale and angle at all of (N, 2) degrees.

    Web Mercator fails by its scale, an equal-area CRS away from its middle by its angles, a CRS in feet by its unit.
    """
    from pyproj import Geod

    resolved = known_crs(crs)
    axes = {(axis.direction, axis.unit_name) for axis in resolved.axis_info[:2]}
    if not resolved.is_projected or axes != {("east", "metre"), ("north", "metre")}:
        return False
    # Steps of 100 m on the ellipsoid, measured in the CRS: independent of the metadata of the projection.
    some = lonlat[:: max(len(lonlat) // 200, 1)]
    lon, lat = np.concatenate((some, lonlat[lonlat.argmin(axis=0)], lonlat[lonlat.argmax(axis=0)])).T
    steps = []
    for azimuth in (0.0, 90.0):
        ahead = Geod(ellps="WGS84").fwd(lon, lat, np.full(len(lon), azimuth), np.full(len(lon), 100.0))[:2]
        ends = [transform("EPSG:4326", crs, np.stack(points, axis=1)) for points in ((lon, lat), ahead)]
        steps.append((ends[1] - ends[0]) / 100.0)
    scales = np.hypot(*np.moveaxis(np.stack(steps), -1, 0))
    skew = np.sum(steps[0] * steps[1], axis=1) / scales.prod(axis=0)
    most_skew = np.sin(np.radians(_MOST_ANGLE_DEG))
    return bool((np.abs(scales - 1.0) <= _MOST_SCALE_ERROR).all() and (np.abs(skew) <= most_skew).all())


def _conformal_crs(points: FloatArray) -> str:
    """Return the UTM, UPS or oblique stereographic CRS that fits (N, 2) degrees."""
    west, east = _longitudes(points[:, 0])
    south, north = points[:, 1].min(), points[:, 1].max()
    lon, lat = (west + east) / 2, float(south + north) / 2
    zone = int((lon + 180.0) % 360.0 // 6.0) + 1
    meridian = 6.0 * zone - 183.0
    middle = lon - meridian - 360.0 * np.round((lon - meridian) / 360.0)
    if lat > _UPS_NORTH or lat < _UPS_SOUTH:
        return "EPSG:5041" if lat > 0 else "EPSG:5042"
    if abs(middle) + (east - west) / 2 <= _UTM_HALF_WIDTH_DEG:
        return f"EPSG:{32600 + zone if lat >= 0 else 32700 + zone}"
    return _stereographic(round((lon + 180.0) % 360.0 - 180.0, 2), round(lat, 2))


def to_lonlat(crs: str, en: FloatArray) -> FloatArray:
    """Take (..., 2) coordinates of a CRS to longitude and latitude (WGS 84), degrees."""
    return transform(crs, "EPSG:4326", en)


def from_lonlat(plane: LocalPlane, lonlat: FloatArray) -> FloatArray:
    """Take (N, 2) longitudes and latitudes (WGS 84), degrees, to plane metres."""
    return to_plane("EPSG:4326", plane, lonlat)


def to_plane(crs: str, plane: LocalPlane, xy: FloatArray) -> FloatArray:
    """Take (N, 2) coordinates of a CRS to plane metres."""
    return plane.from_crs(transform(crs, plane.crs, xy))


def transform(source: str, target: str, xy: FloatArray) -> FloatArray:
    """Take (..., 2) coordinates of a CRS to another, which is no number where that has no such place."""
    xy = np.asarray(xy, float)
    return np.stack(transformer(source, target).transform(xy[..., 0], xy[..., 1]), axis=-1)


def metres_apart(a: FloatArray, b: FloatArray) -> float:
    """Return about how far two places, (2,) longitude and latitude, lie apart; exact for near ones."""
    turn = (float(a[0] - b[0]) + 180.0) % 360.0 - 180.0
    east = math.radians(turn) * math.cos(math.radians(float(a[1] + b[1]) / 2.0))
    return _EARTH_RADIUS_M * math.hypot(east, math.radians(float(a[1] - b[1])))


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
        return Transformer.from_crs(known_crs(source), known_crs(target), always_xy=True)
    except ProjError as error:
        raise CrsError(f"no transformation from {_short(source)} to {_short(target)}: {error}") from error


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
