"""The place that a raster says of itself that it shows."""

from __future__ import annotations

import os

import numpy as np

from roadgeo.errors import MaskError
from roadgeo.storage.rasters import open_raster

__all__ = ["read_stated_middle"]

#: Formats that hold a place, by the first bytes of a file: TIFF, and the others that GDAL reads one from.
_HOLD_A_PLACE = (b"II", b"MM", b"EHFA", b"\0\0\0\x0cjP", b"\xff\x4f\xff\x51")


def read_stated_middle(path: str | os.PathLike[str]) -> tuple[float, float] | None:
    """Return longitude and latitude of the middle of a raster by its own georeference; None where it has none."""
    from roadgeo.geometry.projection import to_lonlat
    from roadgeo.sources.lines import crs_name

    try:
        with open(path, "rb") as file:  # noqa: PTH123 (names may hold what Path refuses)
            if not file.read(8).startswith(_HOLD_A_PLACE):
                return None
        with open_raster(path) as dataset:
            crs = None if dataset.crs is None else crs_name(dataset.crs.to_wkt())
            if crs is None or dataset.transform.is_identity:
                return None
            x, y = dataset.xy(dataset.height / 2 - 0.5, dataset.width / 2 - 0.5)  # counts from pixels' middles
    except (MaskError, OSError, ValueError):
        return None
    lon, lat = to_lonlat(crs, np.array([[x, y]]))[0].tolist()
    return (lon, lat) if np.isfinite([lon, lat]).all() else None
