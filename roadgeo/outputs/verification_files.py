"""Outputs of `roadgeo verify`: corrected copies, control points, one table of all."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from roadgeo.errors import OutputError
from roadgeo.outputs.names import bare_names, table_cell, table_text, without_folders
from roadgeo.storage.files import replacing, write_text
from roadgeo.storage.orientation import read_orientation

if TYPE_CHECKING:
    from roadgeo.geometry.georeference import Georeference

__all__ = ["write_fixed", "write_in_place", "write_points", "write_table"]

_COLUMNS = (
    "image", "verdict", "reason", "reference", "east_m", "north_m", "turn_deg", "scale", "sigma_m", "off_m",
    "residual_m", "log10_lead", "agreeing", "agreeing_as_given", "lon", "lat",
)  # fmt: skip


def write_table(path: Path, documents: Sequence[Mapping[str, Any]]) -> None:
    """Write one row for each image as CSV."""
    rows: list[Sequence[Any]] = [_COLUMNS]
    names = bare_names([str(document["image"]) for document in documents])
    for document, image in zip(documents, names, strict=True):
        reason = without_folders(str(document.get("reason") or ""), str(document["image"]))
        rows.append([_cell({**document, "image": image, "reason": reason}, name) for name in _COLUMNS])
    write_text(path, table_text(rows))


def _cell(document: Mapping[str, Any], name: str) -> Any:
    parts = (document, document.get("displacement") or {}, document.get("center") or {})
    value = next((part[name] for part in parts if part.get(name) is not None), "")
    return table_cell(value) if isinstance(value, str) else value


def write_points(path: Path, place: Georeference) -> None:
    """Write 25 control points of a corrected place, for the QGIS Georeferencer."""
    from roadgeo.outputs.control_points import georeferencer_points

    write_text(path, georeferencer_points(place.crs, np.hstack(place.control_points()).tolist()))


def write_fixed(image: Path, path: Path, place: Georeference) -> None:
    """Write a copy of a raster, its pixels untouched, with a corrected georeference: GeoTIFF.

    Raises
    ------
    OutputError
        It would overwrite the image itself, or cannot be written.
    """
    import rasterio.shutil

    from roadgeo.storage.rasters import open_raster

    if path.resolve() == image.resolve():
        raise OutputError(f"{path}: is the image itself; choose another --out-dir, or --in-place to overwrite it")
    with replacing(path) as temporary:
        with open_raster(image, upright=False) as source:
            rasterio.shutil.copy(source, temporary, driver="GTiff", compress="DEFLATE", tiled=True, bigtiff="IF_SAFER")
        _set_place(temporary, place.of_stored(read_orientation(image)))


def write_in_place(image: Path, place: Georeference) -> None:
    """Overwrite the georeference of a GeoTIFF.

    Raises
    ------
    OutputError
        It is of another format, or not writable.
    """
    from roadgeo.storage.rasters import open_raster

    with open_raster(image, upright=False) as source:
        driver = source.driver
    if driver != "GTiff":
        raise OutputError(f"{image}: only GeoTIFFs can be corrected in place; use --fix, which writes one")
    _set_place(image, place.of_stored(read_orientation(image)))


def _set_place(path: Path, place: Georeference) -> None:
    """Replace the georeference of a GeoTIFF."""
    import rasterio
    from rasterio.control import GroundControlPoint
    from rasterio.errors import NotGeoreferencedWarning, RasterioError

    try:
        with warnings.catch_warnings(), ExitStack() as files:
            warnings.simplefilter("ignore", NotGeoreferencedWarning)  # it is about to be
            raster = files.enter_context(rasterio.open(path, "r+", driver="GTiff"))
            if np.allclose(place.matrix[2], (0, 0, 1), atol=1e-15):
                raster.crs, raster.transform = place.crs, rasterio.Affine(*place.matrix[:2].ravel())
            else:
                points = zip(*(array.tolist() for array in place.control_points()), strict=True)
                raster.gcps = [GroundControlPoint(p[1], p[0], q[0], q[1]) for p, q in points], place.crs
    except RasterioError as error:
        raise OutputError(f"cannot write {path}: {error}") from error
