"""Drawing an image on the map: the north-up grid that holds a footprint, and the image resampled onto it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, FloatArray
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.lens import Lens

__all__ = ["MapGrid", "Transform", "choose_grid", "cover", "source_pixels", "warp"]

#: Takes positions (..., 2) of one CRS to another; None where the two are one.
Transform: TypeAlias = Callable[[FloatArray], FloatArray] | None

#: OpenCV addresses pixels with 16-bit integers while warping, so an image is drawn in blocks of this size.
BLOCK = 8192
_NODE_STEP = 64  # CRS transformations are computed at every 64th pixel and interpolated between
_PER_SIDE = 33  # points on each side of an image's outline


@dataclass(frozen=True)
class MapGrid:
    """A north-up grid of square pixels on the map.

    Attributes
    ----------
    west, north : float
        CRS position of the top-left pixel's outer corner.
    resolution : float
        Side of a pixel, CRS units.
    width, height : int
        Size in pixels.
    """

    west: float
    north: float
    resolution: float
    width: int
    height: int

    def to_crs_matrix(self, column: int = 0, row: int = 0) -> FloatArray:
        """(3, 3) homography from pixels (column, row; corner convention) counted from `column`, `row` to the CRS."""
        size = self.resolution
        return np.array(
            [[size, 0.0, self.west + column * size], [0.0, -size, self.north - row * size], [0.0, 0.0, 1.0]]
        )


def choose_grid(outline: FloatArray, resolution: float, max_pixels: int) -> MapGrid:
    """Lay the smallest grid over points (K, 2), its lines at multiples of its resolution.

    Where it would hold more than `max_pixels`, the resolution is made coarser.
    """
    low, high = outline.min(axis=0), outline.max(axis=0)
    resolution = max(resolution, float(np.sqrt(np.prod(high - low) / max_pixels)))
    first, last = np.floor(low / resolution), np.ceil(high / resolution)
    width, height = np.maximum(last - first, 1).astype(int).tolist()
    return MapGrid(float(first[0] * resolution), float(last[1] * resolution), resolution, width, height)


def cover(
    size: tuple[int, int],
    pixel_to_crs: FloatArray,
    resolution: float | None,
    max_pixels: int,
    to_target: Transform = None,
) -> MapGrid:
    """Lay a grid over an image of `size` (width, height), by default with the image's own resolution at its centre.

    The grid may have NaN bounds where the image lies outside what the target CRS is made for.
    """
    corners = Frame(*size).corners
    sides = zip(corners, np.roll(corners, -1, axis=0), strict=True)
    outline = np.concatenate([np.linspace(a, b, _PER_SIDE)[:-1] for a, b in sides])
    cross = corners.mean(axis=0) + np.array([[-0.5, 0], [0.5, 0], [0, -0.5], [0, 0.5]])
    outline, cross = (Homography(pixel_to_crs)(points) for points in (outline, cross))
    if to_target is not None:
        outline, cross = to_target(outline), to_target(cross)
    if not np.isfinite(outline).all():
        return MapGrid(np.nan, np.nan, np.nan, 0, 0)
    across, along = np.hypot(*(cross[1] - cross[0])), np.hypot(*(cross[3] - cross[2]))
    return choose_grid(outline, resolution or float(np.sqrt(across * along)), max_pixels)


def warp(
    image: AnyArray,
    pixel_to_crs: FloatArray,
    grid: MapGrid,
    to_place: Transform = None,
    interpolation: int = cv2.INTER_NEAREST,
    lens: Lens | None = None,
) -> AnyArray:
    """Resample an image (H, W) or (H, W, bands) onto a grid; 0 outside the image.

    Parameters
    ----------
    pixel_to_crs : (3, 3) float64
        Homography from pixels (column, row; GDAL corner convention). Each point of the map has one source in the image
        plane, so nothing beyond the horizon is drawn twice.
    to_place : callable or None
        Takes the grid's CRS to that of `pixel_to_crs`.
    lens : Lens, optional
        Behind it the image is that of a pinhole, of which the homography speaks.
    """
    drawn = np.zeros((grid.height, grid.width, *image.shape[2:]), image.dtype)
    to_corner, to_center = np.eye(3), np.eye(3)  # OpenCV counts from the centre of the first pixel
    to_corner[:2, 2], to_center[:2, 2] = 0.5, -0.5
    crs_to_pixel = np.linalg.inv(pixel_to_crs)
    for row in range(0, grid.height, BLOCK):
        for column in range(0, grid.width, BLOCK):
            block = drawn[row : row + BLOCK, column : column + BLOCK]
            size = block.shape[1::-1]
            if to_place is None and lens is None:
                source = to_center @ crs_to_pixel @ grid.to_crs_matrix(column, row) @ to_corner
                block[...] = cv2.warpPerspective(image, source, size, flags=interpolation | cv2.WARP_INVERSE_MAP)
            else:
                pixels = source_pixels(pixel_to_crs, grid, column, row, size, to_place)
                seen = pixels if lens is None else lens.bend(pixels)
                maps = np.nan_to_num(seen - 0.5, nan=-9.0).astype(np.float32)
                block[...] = cv2.remap(image, maps[..., 0], maps[..., 1], interpolation)
    return drawn


def source_pixels(
    pixel_to_crs: FloatArray, grid: MapGrid, column: int, row: int, size: tuple[int, int], to_place: Transform = None
) -> FloatArray:
    """Image pixels (rows, columns, 2; corner convention) that lie at the centres of a block of a grid; NaN if nowhere.

    The block begins at `column`, `row` and has `size` (width, height).
    """
    width, height = size
    to_pixel = Homography(pixel_to_crs).inverse()
    to_crs = Homography(grid.to_crs_matrix(column, row))
    if to_place is None:
        columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        return (to_pixel @ to_crs)(np.stack([columns, rows], axis=2))
    # Between nodes that reach to the block's outer edges, a CRS transformation is as good as bilinear.
    columns, rows = (np.linspace(0, side, side // _NODE_STEP + 2) for side in size)
    nodes = to_place(to_crs(np.stack(np.meshgrid(columns, rows), axis=2)))
    origin = nodes[0, 0]
    fine = []
    for values in np.moveaxis(nodes - origin, 2, 0):
        lines = np.array([np.interp(np.arange(width) + 0.5, columns, line) for line in values])
        fine.append(np.array([np.interp(np.arange(height) + 0.5, rows, line) for line in lines.T]).T)
    return to_pixel(np.stack(fine, axis=2) + origin)
