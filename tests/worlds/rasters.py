"""Rasters as GDAL writes them, from arrays."""

import warnings
from pathlib import Path

import numpy as np
import rasterio

__all__ = ["write_raster"]


def write_raster(
    path: Path | str,
    bands: np.ndarray,
    driver: str = "GTiff",
    colors: dict[int, tuple[int, ...]] | None = None,
    names: tuple[str, ...] = (),
    **options: object,
) -> Path:
    """Write (B, H, W) or (H, W) values, with a palette or names of bands; the options are GDAL's."""
    values = bands if bands.ndim == 3 else bands[None]
    count, height, width = values.shape
    shape = {"count": count, "height": height, "width": width, "dtype": values.dtype}
    with warnings.catch_warnings(action="ignore"), rasterio.open(path, "w", driver, **shape, **options) as sink:
        sink.write(values)
        if colors:
            sink.write_colormap(1, colors)
        if names:
            sink.descriptions = names
    return Path(path)
