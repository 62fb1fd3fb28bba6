"""The height of the ground: a terrain model that the user gives."""

from __future__ import annotations

import os

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo.errors import CrsError, MaskError
from roadgeo.geometry.projection import transform
from roadgeo.storage.crs import crs_name
from roadgeo.storage.rasters import open_raster

__all__ = ["ground_heights"]


def ground_heights(dem: str | os.PathLike[str], xy: FloatArray, crs: str) -> FloatArray:
    """Return the heights, metres, of a terrain model at points (N, 2) of a CRS; NaN where it knows none.

    Each point takes the pixel that it lies in.

    Raises
    ------
    MaskError
        It cannot be read.
    CrsError
        It names no CRS.
    """
    with open_raster(dem) as raster:
        if raster.crs is None or raster.transform.is_identity:
            raise CrsError(
                f"{os.fspath(dem)}: has no georeference; expected a terrain model such as a GeoTIFF with a CRS"
            )
        if not abs(raster.transform.determinant) > 0.0:
            raise CrsError(f"{os.fspath(dem)}: its pixels cover no ground; georeference it again")
        if raster.dtypes[0].startswith("complex"):
            raise MaskError(f"{os.fspath(dem)}: holds complex values; expected heights in metres")
        own = crs_name(raster.crs.to_wkt())
        if own is None:
            raise CrsError(f"{os.fspath(dem)}: its CRS does not describe places on Earth; assign the right one")
        there = transform(crs, own, xy)
        inside = np.isfinite(there).all(axis=1)
        values = np.full(len(there), np.nan)
        for i, height in zip(np.flatnonzero(inside), raster.sample(there[inside], indexes=1, masked=True), strict=True):
            values[i] = np.ma.filled(height.astype(float), np.nan)[0]
        return values
