"""The georeference of a raster: a geotransform, control points, or a world file or `.aux.xml` beside it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo.errors import CrsError, MaskError
from roadgeo.geometry.georeference import Georeference, fit_place, stretch_of
from roadgeo.sources.exif import read_position
from roadgeo.storage.crs import crs_name, name_crs
from roadgeo.storage.orientation import read_orientation, read_resolution, stored_from_upright
from roadgeo.storage.rasters import open_raster, raster_size, read_beside, read_sidecar, sidecar_attributes

if TYPE_CHECKING:
    from rasterio import DatasetReader

__all__ = ["Stated", "read_georeference", "read_stated"]

_STEPS_ASIDE = 4  # orientations beyond this make rows of columns


def read_georeference(path: str | os.PathLike[str], crs: str | None = None) -> Georeference | None:
    """Read a raster's georeference; None where it has none.

    Parameters
    ----------
    crs : str, optional
        CRS of a world file, as pyproj takes it; it replaces the raster's own, and the one in files beside it.

    Raises
    ------
    MaskError
        It is no raster, or its georeference is degenerate.
    CrsError
        It has coordinates, but names no CRS.
    """
    with open_raster(path, upright=False) as raster:
        own = _crs_of(raster) if crs is None else name_crs(crs)
        source, matrix = _of_raster(raster) or _of_files_beside(Path(path))
    if matrix is None:
        return None
    size = raster_size(path)
    matrix = matrix @ stored_from_upright(read_orientation(path), size)
    own = own or _crs_beside(Path(path))
    if own is None:
        raise CrsError(
            f"{os.fspath(path)}: its {source} names no CRS; give it with --crs EPSG:n, or in a .prj beside it"
        )
    if not np.isfinite(matrix).all() or abs(np.linalg.det(matrix[:2, :2])) < 1e-20:
        raise MaskError(f"{os.fspath(path)}: its {source} maps all pixels to a line; expected a place with an area")
    return Georeference(matrix, own, size, source)


class Stated(NamedTuple):
    """The shape of its pixels and the place that a picture states.

    Attributes
    ----------
    aspect, mirrored
        As of `Georeference.pixel_shape`. Without a georeference the resolution counts, as scanners and facsimiles state
        it; (None, False) without that, too.
    middle : (float, float) or None
        Longitude and latitude of the middle by its georeference, or of the camera by EXIF.
    """

    aspect: float | None = None
    mirrored: bool = False
    middle: tuple[float, float] | None = None


def read_stated(path: str | os.PathLike[str]) -> Stated:
    """Read the statements of a raster, or of a file beside it."""
    georeference = _stated(path)
    middle = (np.nan, np.nan) if georeference is None else georeference.middle()
    place = middle if np.isfinite(middle).all() else read_position(path)
    if georeference is not None:
        return Stated(
            *((None, False) if georeference.source == "control points" else georeference.pixel_shape()), place
        )
    across, down = read_resolution(path)
    aspect = stretch_of(down, across)
    turned = read_orientation(path) > _STEPS_ASIDE
    return Stated(1.0 / aspect if aspect and turned else aspect, False, place)


def _stated(path: str | os.PathLike[str]) -> Georeference | None:
    """Return a raster's own georeference, or one of files beside it, where it has one."""
    with suppress(MaskError, CrsError, OSError, ValueError):
        return read_georeference(path)
    return None


def _crs_of(raster: DatasetReader) -> str | None:
    """Name the CRS of a raster or of its control points."""
    crs = raster.crs or raster.gcps[1]
    return crs_name(crs.to_wkt()) if crs else None


def _crs_beside(path: Path) -> str | None:
    """Read the CRS in the `.prj` beside a picture, or in its `.aux.xml`."""
    for suffix in (".prj", ".PRJ"):
        beside = path.with_suffix(suffix)
        if stated := read_beside(path, beside).strip():
            try:
                return name_crs(stated)
            except CrsError as error:
                raise CrsError(f"{beside}: {error}") from error
    points = sidecar_attributes(path, "GCPList")
    stated = read_sidecar(path, "SRS") or read_sidecar(path, "WKT")  # of GDAL, of ArcGIS
    stated = stated or (points[0].get("Projection", "") if points else "")
    return name_crs(stated) if stated else None


def _of_raster(raster: DatasetReader) -> tuple[str, FloatArray] | None:
    if not raster.transform.is_identity:
        return "geotransform", np.array(raster.transform, float).reshape(3, 3)
    return _of_points([(point.col, point.row, point.x, point.y) for point in raster.gcps[0]])


def _of_points(points: Sequence[Sequence[float]]) -> tuple[str, FloatArray] | None:
    """Fit a place to control points: column, row, x, y each; None to fewer than three."""
    pixels, there = np.hsplit(np.array(points, float).reshape(-1, 4), 2)
    return ("control points", fit_place(pixels, there, len(points) >= 5)) if len(points) >= 3 else None


def _of_files_beside(path: Path) -> tuple[str, FloatArray | None]:
    """Read what a world file says, or a picture's `.aux.xml`."""
    placed, stated = _of_world_file(path), read_sidecar(path, "GeoTransform")
    if placed is not None:
        return "world file", placed
    try:
        if not stated:
            points = sidecar_attributes(path, "GCP")
            keys = ("Pixel", "Line", "X", "Y")
            return _of_points([[float(point[key]) for key in keys] for point in points]) or ("world file", None)
        x, a, b, y, d, e = (float(word) for word in stated.split(","))
    except (ValueError, KeyError) as error:
        raise MaskError(f"{path}.aux.xml: no geotransform or control points; expected numbers") from error
    return "geotransform", np.array([[a, b, x], [d, e, y], [0.0, 0.0, 1.0]])


def _of_world_file(path: Path) -> FloatArray | None:
    """Read the six numbers beside a picture: `.tfw`, `.pgw`, `.tifw`, `.wld`, `.tfwx`, `.TFW` ..."""
    suffix = path.suffix.lower()
    short = f".{suffix[1:2]}{suffix[-1:]}w" if len(suffix) > 2 else ".wld"
    names = [name + more for name in (short, f"{suffix}w", ".wld") for more in ("", "x")]
    for candidate in (*names, *map(str.upper, names)):
        beside = path.with_suffix(candidate)
        if not (stated := read_beside(path, beside)):
            continue
        try:
            a, d, b, e, c, f = (float(word.replace(",", ".")) for word in stated.split(None, 6)[:6])
        except ValueError as error:
            raise MaskError(f"{beside}: no world file; expected six numbers, one per line") from error
        # A world file speaks of the first pixel's centre.
        return np.array([[a, b, c - (a + b) / 2], [d, e, f - (d + e) / 2], [0.0, 0.0, 1.0]])
    return None
