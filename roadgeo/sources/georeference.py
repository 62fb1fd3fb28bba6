"""The georeference of a raster: a geotransform, control points, or a world file beside it."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo.errors import CrsError, MaskError
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.projection import LocalPlane, to_lonlat, transformer
from roadgeo.storage.crs import name_crs
from roadgeo.storage.orientation import read_orientation, stored_from_upright
from roadgeo.storage.rasters import open_raster

if TYPE_CHECKING:
    from rasterio import DatasetReader

__all__ = ["Georeference", "read_georeference", "read_stated_middle"]

_WORLD_FILE_BYTES, _PRJ_BYTES = 4096, 1 << 16
#: Formats that hold a place, by the first bytes of a file: TIFF, and the others that GDAL reads one from.
_HOLD_A_PLACE = (b"II", b"MM", b"EHFA", b"\0\0\0\x0cjP", b"\xff\x4f\xff\x51")
#: Side of the grid of points that a georeference is taken to another CRS by.
_GRID = 5


@dataclass(frozen=True)
class Georeference:
    """The place of a raster by its own georeference.

    Attributes
    ----------
    matrix : (3, 3) float64
        Pixel (column, row; GDAL corner convention) to CRS: affine, or a homography fitted to control points.
    crs : str
        "EPSG:n" where there is a code, else WKT2.
    size : (int, int)
        Width and height, pixels.
    source : str
        "geotransform", "control points" or "world file".
    """

    matrix: FloatArray
    crs: str
    size: tuple[int, int]
    source: str

    def on_plane(self, plane: LocalPlane) -> FloatArray:
        """Return the homography (3, 3) from pixels to a reference's plane, metres.

        Between two CRS it is fitted to a grid of points, for frames are small: to some millimetres over kilometres.

        Raises
        ------
        CrsError
            It lies outside what the plane's CRS, or its own, is made for.
        """
        pixels = self._grid()
        there = Homography(self.matrix).facing(Frame(*self.size).center)(pixels)
        xy = plane.from_crs(np.stack(transformer(self.crs, plane.crs).transform(*there.T), axis=1))
        if not np.isfinite(xy).all():
            raise CrsError(f"its corners lie outside what {self.crs[:40]} or {plane.crs[:40]} is made for")
        return _fit(pixels, xy, projective=True)

    def middle(self) -> tuple[float, float]:
        """Return longitude and latitude of the middle of the frame."""
        center = Frame(*self.size).center
        lon, lat = to_lonlat(self.crs, Homography(self.matrix).facing(center)(np.array([center])))[0].tolist()
        return lon, lat

    def moved(self, on_plane: FloatArray, plane: LocalPlane) -> Georeference:
        """Return the georeference that puts the raster where `on_plane` (3, 3), pixels to a plane, does.

        An affine one stays affine: it is fitted to the grid of points.
        """
        pixels = self._grid()
        there = plane.to_crs(Homography(on_plane).facing(Frame(*self.size).center)(pixels))
        xy = np.stack(transformer(plane.crs, self.crs).transform(*there.T), axis=1)
        matrix = _fit(pixels, xy, projective=self.source == "control points")
        return Georeference(matrix, self.crs, self.size, self.source)

    def of_stored(self, path: str | os.PathLike[str]) -> Georeference:
        """Return the same for the pixels of the raster's file as they are stored (see `storage.orientation`)."""
        turned = stored_from_upright(read_orientation(path), self.size)
        size = self.size if abs(turned[0, 0]) > 0.5 else self.size[::-1]
        return Georeference(self.matrix @ np.linalg.inv(turned), self.crs, size, self.source)

    def control_points(self) -> tuple[FloatArray, FloatArray]:
        """Return (25, 2) pixel positions all over the raster and where they lie in its CRS."""
        pixels = self._grid()
        return pixels, Homography(self.matrix).facing(Frame(*self.size).center)(pixels)

    def _grid(self) -> FloatArray:
        """(25, 2) pixel positions all over the raster."""
        width, height = self.size
        columns, rows = np.meshgrid(np.linspace(0, width, _GRID), np.linspace(0, height, _GRID))
        return np.stack([columns.ravel(), rows.ravel()], axis=1)


def read_georeference(path: str | os.PathLike[str], crs: str | None = None) -> Georeference | None:
    """Read a raster's georeference; None where it has none.

    Parameters
    ----------
    crs : str, optional
        Of a world file, as pyproj takes it, or in place of that of the raster, or of a `.prj` beside it.

    Raises
    ------
    MaskError
        It is no raster, or its georeference is degenerate.
    CrsError
        It has coordinates, but names no CRS.
    """
    with open_raster(path) as raster:
        size = (raster.width, raster.height)
        own = _crs_of(raster) if crs is None else name_crs(crs)
        found = _of_raster(raster)
    source, matrix = found or ("world file", _of_world_file(Path(path)))
    if matrix is None:
        return None
    if found is None:  # a world file speaks of pixels as they are stored
        matrix = matrix @ stored_from_upright(read_orientation(path), size)
    own = own or _crs_beside(Path(path))
    if own is None:
        raise CrsError(
            f"{os.fspath(path)}: its {source} names no CRS; give it with --crs EPSG:n, or in a .prj beside it"
        )
    if not np.isfinite(matrix).all() or abs(np.linalg.det(matrix[:2, :2])) < 1e-20:
        raise MaskError(f"{os.fspath(path)}: its {source} maps all pixels to a line; expected a place with an area")
    return Georeference(matrix, own, size, source)


def read_stated_middle(path: str | os.PathLike[str]) -> tuple[float, float] | None:
    """Return longitude and latitude of the middle of a raster by its own georeference; None where it has none."""
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


def _crs_of(raster: DatasetReader) -> str | None:
    """Name the CRS of a raster or of its control points."""
    crs = raster.crs or raster.gcps[1]
    if not crs:
        return None
    code = crs.to_epsg()
    return f"EPSG:{code}" if code else str(crs.to_wkt())


def _crs_beside(path: Path) -> str | None:
    """Read the CRS in the `.prj` beside a picture."""
    for suffix in (".prj", ".PRJ"):
        beside = path.with_suffix(suffix)
        if beside.is_file() and beside.stat().st_size <= _PRJ_BYTES:
            try:
                return name_crs(beside.read_text("utf-8", "replace").strip())
            except CrsError as error:
                raise CrsError(f"{beside}: {error}") from error
    return None


def _of_raster(raster: DatasetReader) -> tuple[str, FloatArray] | None:
    points = raster.gcps[0]
    if not raster.transform.is_identity:
        return "geotransform", np.array(raster.transform, float).reshape(3, 3)
    if len(points) < 3:
        return None
    pixels = np.array([[point.col, point.row] for point in points], float)
    return "control points", _fit(pixels, np.array([[p.x, p.y] for p in points], float), len(points) >= 5)


def _of_world_file(path: Path) -> FloatArray | None:
    """Read the six numbers beside a picture: `.tfw`, `.pgw`, `.tifw`, `.wld` ..."""
    suffix = path.suffix.lower()
    short = f".{suffix[1:2]}{suffix[-1:]}w" if len(suffix) > 2 else ".wld"
    for candidate in (short, f"{suffix}w", ".wld", short.upper()):
        beside = path.with_suffix(candidate)
        if not beside.is_file() or beside.stat().st_size > _WORLD_FILE_BYTES:
            continue
        try:
            a, d, b, e, c, f = (float(word.replace(",", ".")) for word in beside.read_text("ascii").split()[:6])
        except ValueError as error:
            raise MaskError(f"{beside}: no world file; expected six numbers, one per line") from error
        # A world file speaks of the first pixel's centre.
        return np.array([[a, b, c - (a + b) / 2], [d, e, f - (d + e) / 2], [0.0, 0.0, 1.0]])
    return None


def _fit(pixels: FloatArray, xy: FloatArray, projective: bool) -> FloatArray:
    """Fit a homography or an affine map (3, 3) to points (N, 2) by least squares."""
    origin, unit = xy.mean(axis=0), max(float(np.ptp(xy, axis=0).max()), 1e-12)
    middle, side = pixels.mean(axis=0), max(float(np.ptp(pixels, axis=0).max()), 1e-12)
    a, b = (pixels - middle) / side, (xy - origin) / unit
    if projective:
        matrix, _ = cv2.findHomography(a, b, 0)
        if matrix is None:
            raise MaskError("its control points lie on a line; expected some all over the picture")
    else:
        solved = np.linalg.lstsq(np.c_[a, np.ones(len(a))], b, rcond=None)[0]
        matrix = np.vstack([solved.T, [0.0, 0.0, 1.0]])
    to_unit = np.array([[1 / side, 0, -middle[0] / side], [0, 1 / side, -middle[1] / side], [0, 0, 1.0]])
    from_unit = np.array([[unit, 0, origin[0]], [0, unit, origin[1]], [0, 0, 1.0]])
    result = from_unit @ matrix @ to_unit
    return np.asarray(result / result[2, 2])
