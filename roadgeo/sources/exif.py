"""A photograph's metadata on its own camera."""

from __future__ import annotations

import os
import re
from datetime import datetime

from roadgeo.errors import MaskError
from roadgeo.storage.orientation import read_tag
from roadgeo.storage.rasters import open_raster

__all__ = ["number_of", "read_focal_length", "read_metadata", "read_position", "read_time"]

#: Width of a 35 mm film frame, which "FocalLengthIn35mmFilm" refers to.
FILM_WIDTH_MM = 36.0
_FOCAL = "EXIF_FocalLengthIn35mmFilm"
_GPS = 0x8825
_EXIF, _TAKEN, _PART_OF_SECOND, _ZONE = 0x8769, 0x9003, 0x9291, 0x9011


def read_focal_length(path: str | os.PathLike[str]) -> float:
    """Return a photograph's focal length as a multiple of its longer side, from EXIF "FocalLengthIn35mmFilm".

    Raises
    ------
    MaskError
        The file cannot be read, or has no focal length.
    """
    stated = read_metadata(path)[0].get(_FOCAL, "").strip("() ")
    focal = number_of(stated)
    if not 1.0 <= focal <= 5000.0:
        raise MaskError(
            f"{path}: EXIF names no focal length (FocalLengthIn35mmFilm is {stated or 'missing'}); give it in pixels"
        )
    return focal / FILM_WIDTH_MM


def read_time(path: str | os.PathLike[str]) -> float | None:
    """Return when a photograph was taken, seconds since 1970; None where EXIF does not give it.

    A clock without a zone counts as UTC.
    """
    taken, part, zone = (read_tag(path, tag, _EXIF) for tag in (_TAKEN, _PART_OF_SECOND, _ZONE))
    zone = zone if isinstance(zone, str) and re.fullmatch(r"[-+]\d\d:\d\d", zone) else "+00:00"
    try:
        moment = datetime.strptime(f"{taken}{zone}", "%Y:%m:%d %H:%M:%S%z")
    except ValueError:
        return None
    return moment.timestamp() + number_of(f"0.{part or 0}")


def read_position(path: str | os.PathLike[str]) -> tuple[float, float] | None:
    """Return longitude and latitude of the camera, as EXIF states them; None where it does not, or has zeros."""
    south, lats, west, lons = (read_tag(path, tag, _GPS) for tag in (1, 2, 3, 4))
    if not (isinstance(lats, tuple) and isinstance(lons, tuple)):
        return None
    lat, lon = (sum(part / 60.0**k for k, part in enumerate(angle)) for angle in (lats, lons))
    if not (0.0 <= lat <= 90.0 and 0.0 <= lon <= 180.0 and lat + lon > 0.0):
        return None
    return -lon if west == "W" else lon, -lat if south == "S" else lat


def read_metadata(path: str | os.PathLike[str]) -> tuple[dict[str, str], str]:
    """Return a photograph's tags, with EXIF's, and its XMP."""
    with open_raster(path, upright=False) as source:
        return {**source.tags(), **source.tags(ns="EXIF")}, "".join(source.tags(ns="xml:XMP").values())


def number_of(text: str) -> float:
    """Return the number in an EXIF value such as "(24)"; 0 without a number."""
    try:
        return float(text.strip("() "))
    except ValueError:
        return 0.0
