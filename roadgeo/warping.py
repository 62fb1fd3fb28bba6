"""Drawing an image on the map: the north-up grid that holds a footprint, and the image resampled onto it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from roadgeo.typing import AnyArray, FloatArray

__all__ = ["MapGrid", "choose_grid", "warp"]

#: OpenCV addresses pixels with 16-bit integers while warping, so the image is drawn in blocks of this size.
BLOCK = 8192


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


def choose_grid(footprint: FloatArray, resolution: float, max_pixels: int) -> MapGrid:
    """Lay the smallest grid over the corners of a footprint (K, 2), its lines at multiples of its resolution.

    Where it would hold more than `max_pixels`, the resolution is made coarser.
    """
    low, high = footprint.min(axis=0), footprint.max(axis=0)
    resolution = max(resolution, float(np.sqrt(np.prod(high - low) / max_pixels)))
    first, last = np.floor(low / resolution), np.ceil(high / resolution)
    width, height = np.maximum(last - first, 1).astype(int).tolist()
    return MapGrid(float(first[0] * resolution), float(last[1] * resolution), resolution, width, height)


def warp(image: AnyArray, pixel_to_crs: FloatArray, grid: MapGrid, interpolation: int = cv2.INTER_NEAREST) -> AnyArray:
    """Resample an image (H, W) or (H, W, bands) onto a grid; 0 outside the image.

    `pixel_to_crs` is a (3, 3) homography from pixels (column, row) in GDAL's corner convention. Each point of the map
    has one source in the image plane, so nothing beyond the horizon is drawn twice.
    """
    drawn = np.zeros((grid.height, grid.width, *image.shape[2:]), image.dtype)
    crs_to_pixel = np.linalg.inv(pixel_to_crs)
    to_corner, to_center = np.eye(3), np.eye(3)  # OpenCV counts from the centre of the first pixel
    to_corner[:2, 2], to_center[:2, 2] = 0.5, -0.5
    for row in range(0, grid.height, BLOCK):
        for column in range(0, grid.width, BLOCK):
            block = drawn[row : row + BLOCK, column : column + BLOCK]
            source = to_center @ crs_to_pixel @ grid.to_crs_matrix(column, row) @ to_corner
            block[...] = cv2.warpPerspective(
                image, source, block.shape[1::-1], flags=interpolation | cv2.WARP_INVERSE_MAP
            )
    return drawn
