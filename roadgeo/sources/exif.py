"""What a photograph says of its own camera."""

from __future__ import annotations

import os

from roadgeo.errors import MaskError
from roadgeo.storage.rasters import open_raster

__all__ = ["read_focal_length"]

#: Width of a 35 mm film frame, which "FocalLengthIn35mmFilm" refers to.
FILM_WIDTH_MM = 36.0


def read_focal_length(path: str | os.PathLike[str]) -> float:
    """Return a photograph's focal length as a multiple of its longer side, from EXIF "FocalLengthIn35mmFilm".

    Raises
    ------
    MaskError
        The file cannot be read, or says nothing of its focal length.
    """
    with open_raster(path) as source:
        tags = {**source.tags(), **source.tags(ns="EXIF")}
    stated = tags.get("EXIF_FocalLengthIn35mmFilm", "").strip("() ")
    try:
        focal = float(stated)
    except ValueError:
        focal = 0.0
    if not 1.0 <= focal <= 5000.0:
        raise MaskError(
            f"{path}: EXIF names no focal length (FocalLengthIn35mmFilm is {stated or 'missing'}); "
            "give it in pixels: --camera PIXELS"
        )
    return focal / FILM_WIDTH_MM
