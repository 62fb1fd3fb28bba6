"""A result on the map: the mask or its photograph warped to where it lies, with its style and its world file."""

from __future__ import annotations

import json
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from roadgeo._arrays import AnyArray
from roadgeo._version import __version__
from roadgeo.geometry.mask import RoadMask
from roadgeo.geometry.warping import warp
from roadgeo.outputs.drawing.layers import rgb
from roadgeo.outputs.names import bare_name
from roadgeo.outputs.orthophoto import COMPRESSION, warp_image
from roadgeo.outputs.subject import Subject
from roadgeo.storage.qml import draw_palette

__all__ = ["GROUND", "OUTSIDE", "ROAD", "write_footprint", "write_style", "write_world_file"]

#: Values of the warped mask, and how they are drawn: colour, alpha, label. Outside the footprint is nodata.
OUTSIDE, GROUND, ROAD = 0, 1, 2
PALETTE = {GROUND: ("#fdf6ec", 0, "no road"), ROAD: ("#e4572e", 255, "road")}

_BLOCK = 512  # side of a tile of the warped mask, pixels


def write_footprint(path: Path, subject: Subject) -> None:
    """Write the photograph, or without one the mask, on the map: a Cloud Optimized GeoTIFF.

    Raises
    ------
    CrsError
        The target CRS is unknown or not made for this place.
    MaskError
        The photograph cannot be read or shows another frame than the mask.
    """
    if subject.photo is None:
        _write_mask(path, subject)
    else:
        warp_image(subject.photo, path, subject.place, subject.homography, _tags(subject), subject.image)


def write_style(path: Path, subject: Subject) -> None:  # noqa: ARG001 (it is the same for every mask)
    """Write how QGIS draws a warped mask."""
    path.write_text(draw_palette(PALETTE), encoding="utf-8")


def write_world_file(path: Path, subject: Subject) -> None:
    """Write the world file of the warped raster: a homography does not fit into one, so the picture itself has none."""
    grid, half = subject.grid, subject.grid.resolution / 2
    values = (grid.resolution, 0.0, 0.0, -grid.resolution, grid.west + half, grid.north - half)
    path.write_text("".join(f"{value!r}\n" for value in values), encoding="ascii")


def warp_mask(subject: Subject) -> AnyArray:
    """Draw the mask on the rows and columns of `subject.grid`: OUTSIDE the footprint, GROUND or ROAD in it."""
    labels, place = _labels(subject.mask), subject.place
    lens = place.lens((labels.shape[1], labels.shape[0]))
    return warp(labels, place.homography, subject.grid, subject.target.to_place, lens=lens)


def _write_mask(path: Path, subject: Subject) -> None:
    """Draw the mask on the map, with a colour table, nodata outside the footprint."""
    import rasterio
    import rasterio.shutil
    from rasterio.enums import Resampling

    from roadgeo.storage.rasters import writing_raster

    grid = subject.grid
    kind = {"driver": "MEM", "width": grid.width, "height": grid.height, "count": 1, "dtype": "uint8"}
    place = {"crs": subject.crs, "transform": rasterio.Affine(*grid.to_crs_matrix()[:2].ravel().tolist())}
    with ExitStack() as stack:
        stack.enter_context(writing_raster(path))
        optimized = stack.enter_context(rasterio.MemoryFile(ext="tif"))
        plain = stack.enter_context(rasterio.open("", "w", **kind, **place, nodata=OUTSIDE))
        plain.write(warp_mask(subject)[None])
        plain.write_colormap(1, {value: (*rgb(color), 255) for value, (color, _, _) in PALETTE.items()})
        plain.update_tags(**_tags(subject))
        # Reduced in memory: left to the COG driver, they are written, compressed and read again on the way.
        plain.build_overviews(_reductions(max(grid.width, grid.height)), Resampling.nearest)
        rasterio.shutil.copy(plain, optimized.name, driver="COG", blocksize=_BLOCK, **_compression(subject))
        path.write_bytes(optimized.read())  # written by Python: a full disk raises an OSError


def _compression(subject: Subject) -> dict[str, Any]:
    """Return how a mask is compressed: as asked for, or by DEFLATE where that would lose something."""
    name = subject.image.compression
    asked = COMPRESSION[name if name in ("deflate", "zstd") else "deflate"]
    return {key: value for key, value in asked.items() if key != "predictor"}


def _reductions(side: int) -> list[int]:
    """Factors of the overviews that a COG of that longer side has: halved until it fits into one tile."""
    return [2**k for k in range(1, 32) if side > _BLOCK * 2 ** (k - 1)]


def _labels(mask: RoadMask) -> AnyArray:
    """(H, W) uint8: OUTSIDE where nothing was observed, GROUND or ROAD elsewhere."""
    labels = mask.roads.astype(np.uint8) * np.uint8(ROAD - GROUND) + np.uint8(GROUND)
    if mask.observed is not None:
        labels[~mask.observed] = OUTSIDE
    return labels


def _tags(subject: Subject) -> dict[str, str]:
    """Add the source as metadata, for `gdalinfo`; the homography belongs to the drawn image."""
    location = subject.location
    return {
        "TIFFTAG_SOFTWARE": f"roadgeo {__version__}",
        "ROADGEO_QUERY": bare_name(location.query),
        "ROADGEO_REFERENCE": location.reference,
        "ROADGEO_HOMOGRAPHY": json.dumps(subject.homography.tolist()),
        "ROADGEO_LOG10_ODDS": f"{location.log10_odds}",
        "ROADGEO_ATTRIBUTION": location.attribution,
    }
