"""The place of a raster: the transforms from its pixels to a CRS, and to a plane."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import pyproj

from roadgeo._arrays import FloatArray
from roadgeo.errors import CrsError, MaskError
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.projection import LocalPlane, to_lonlat, to_plane, transform
from roadgeo.storage.orientation import stored_from_upright

__all__ = ["Georeference", "fit_place", "stretch_of"]

#: Side of the grid of points that a georeference is taken to another CRS by.
_GRID = 5
#: Logarithm of the shape of pixels that count as square, and the greatest that is believed.
_SQUARE, _MOST_STRETCH = 0.02, 8.0


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
        pixels, there = self.control_points()
        xy = to_plane(self.crs, plane, there)
        if not np.isfinite(xy).all():
            raise CrsError(f"its corners lie outside what {self.crs[:40]} or {plane.crs[:40]} is made for")
        return fit_place(pixels, xy, projective=True)

    def middle(self) -> tuple[float, float]:
        """Return longitude and latitude of the middle of the frame."""
        lon, lat = to_lonlat(self.crs, self._there(np.array([Frame(*self.size).center])))[0].tolist()
        return lon, lat

    def pixel_shape(self) -> tuple[float | None, bool]:
        """Return how many times a pixel in the middle is as wide as high, and whether rows run northwards.

        None for square ones.
        """
        spots = np.array([[0.25, 0.5], [0.75, 0.5], [0.5, 0.25], [0.5, 0.75]]) * self.size
        lon, lat = to_lonlat(self.crs, self._there(spots)).T
        if not np.isfinite([lon, lat]).all():
            return None, False
        azimuths, _, lengths = pyproj.Geod(ellps="WGS84").inv(lon[::2], lat[::2], lon[1::2], lat[1::2])
        (wide, high), (across, down) = lengths / np.array(self.size), np.radians(azimuths)
        return stretch_of(wide, high), bool(np.sin(down - across) < 0.0)

    def moved(self, on_plane: FloatArray, plane: LocalPlane) -> Georeference:
        """Return the georeference that puts the raster where `on_plane` (3, 3), pixels to a plane, does.

        An affine one stays affine: it is fitted to the grid of points.
        """
        pixels, _ = self.control_points()
        there = plane.to_crs(Homography(on_plane).facing(Frame(*self.size).center)(pixels))
        xy = transform(plane.crs, self.crs, there)
        matrix = fit_place(pixels, xy, projective=self.source == "control points")
        return Georeference(matrix, self.crs, self.size, self.source)

    def of_stored(self, orientation: int) -> Georeference:
        """Return the same for the pixels of the raster's file as they are stored (see `storage.orientation`)."""
        turned = stored_from_upright(orientation, self.size)
        size = self.size if abs(turned[0, 0]) > 0.5 else self.size[::-1]
        return Georeference(self.matrix @ np.linalg.inv(turned), self.crs, size, self.source)

    def control_points(self) -> tuple[FloatArray, FloatArray]:
        """Return (25, 2) pixel positions all over the raster and where they lie in its CRS."""
        pixels = Frame(*self.size).grid(_GRID)
        return pixels, self._there(pixels)

    def _there(self, pixels: FloatArray) -> FloatArray:
        """Take pixel positions (N, 2) to the CRS."""
        return Homography(self.matrix).facing(Frame(*self.size).center)(pixels)


def stretch_of(wide: float, high: float) -> float | None:
    """Return the width of a pixel in heights; None where it is almost square, or of no sensible shape."""
    with np.errstate(divide="ignore", invalid="ignore"):
        stretch = float(np.abs(np.divide(wide, high)))
    return stretch if 1.0 / _MOST_STRETCH < stretch < _MOST_STRETCH and abs(np.log(stretch)) > _SQUARE else None


def fit_place(pixels: FloatArray, xy: FloatArray, projective: bool) -> FloatArray:
    """Fit a homography or an affine map (3, 3) to points (N, 2) by least squares."""
    origin, unit = xy.mean(axis=0), max(float(np.ptp(xy, axis=0).max()), 1e-12)
    middle, side = pixels.mean(axis=0), max(float(np.ptp(pixels, axis=0).max()), 1e-12)
    a, b = (pixels - middle) / side, (xy - origin) / unit
    if projective:
        matrix, _ = cv2.findHomography(a, b, 0)
        if matrix is None:
            raise MaskError("its control points lie on a line; expected them all over the picture")
    else:
        solved = np.linalg.lstsq(np.c_[a, np.ones(len(a))], b, rcond=None)[0]
        matrix = np.vstack([solved.T, [0.0, 0.0, 1.0]])
    to_unit = np.array([[1 / side, 0, -middle[0] / side], [0, 1 / side, -middle[1] / side], [0, 0, 1.0]])
    from_unit = np.array([[unit, 0, origin[0]], [0, unit, origin[1]], [0, 0, 1.0]])
    result = from_unit @ matrix @ to_unit
    return np.asarray(result / result[2, 2])
