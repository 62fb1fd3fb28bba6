"""Drawing an image on the map: the north-up grid that holds a footprint, and the image resampled onto it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, FloatArray
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.homography import Homography, shift
from roadgeo.geometry.lens import Lens

__all__ = ["MapGrid", "Transform", "choose_grid", "cover", "source_pixels", "warp"]

#: Takes positions (..., 2) of one CRS to another; None where the two are one.
Transform: TypeAlias = Callable[[FloatArray], FloatArray] | None

#: OpenCV addresses pixels with 16-bit integers while warping, so an image is drawn in blocks of this size.
BLOCK = 8192
#: Step in pixels between exact positions of an image: the largest whose interpolation is as good as exact.
_NODE_STEPS, _NODE_ERROR_PX = (64, 16, 4), 0.005
_PER_SIDE = 32  # points on each side of an image's outline
_ROUNDING = 1e-6  # of a pixel


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


def choose_grid(outline: FloatArray, resolution: float, max_pixels: int, on_multiples: bool = True) -> MapGrid:
    """Lay the smallest grid over points (K, 2), its lines at multiples of its resolution, or from their top left.

    Where it would hold more than `max_pixels`, the resolution is made coarser.
    """
    low, high = outline.min(axis=0), outline.max(axis=0)
    resolution = max(resolution, float(np.sqrt(np.prod(high - low) / max_pixels)))
    if not on_multiples:
        width, height = np.maximum(np.ceil((high - low) / resolution - _ROUNDING), 1).astype(int).tolist()
        return MapGrid(float(low[0]), float(high[1]), resolution, width, height)
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

    An image that lies north up then keeps its pixels; a resolution that is given puts all grids on the same lines.
    The grid may have NaN bounds where the image lies outside what the target CRS is made for.
    """
    frame = Frame(*size)
    outline, cross = frame.outline(_PER_SIDE), frame.center + np.array([[-0.5, 0], [0.5, 0], [0, -0.5], [0, 0.5]])
    outline, cross = (Homography(pixel_to_crs)(points) for points in (outline, cross))
    if to_target is not None:
        outline, cross = to_target(outline), to_target(cross)
    if not np.isfinite(outline).all():
        return MapGrid(np.nan, np.nan, np.nan, 0, 0)
    across, along = np.hypot(*(cross[1] - cross[0])), np.hypot(*(cross[3] - cross[2]))
    own = float(np.sqrt(across * along))
    return choose_grid(outline, resolution or own, max_pixels, on_multiples=resolution is not None)


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
        Takes the grid's CRS to the one of `pixel_to_crs`.
    lens : Lens, optional
        Behind it the image is a pinhole's, which the homography describes.
    """
    drawn = np.zeros((grid.height, grid.width, *image.shape[2:]), image.dtype)
    # OpenCV counts from the centre of the first pixel.
    to_corner, crs_to_center = shift(0.5, 0.5), shift(-0.5, -0.5) @ np.linalg.inv(pixel_to_crs)
    for row in range(0, grid.height, BLOCK):
        for column in range(0, grid.width, BLOCK):
            block = drawn[row : row + BLOCK, column : column + BLOCK]
            size = block.shape[1::-1]
            if to_place is None and lens is None:
                source = crs_to_center @ grid.to_crs_matrix(column, row) @ to_corner
                cv2.warpPerspective(image, source, size, block, flags=interpolation | cv2.WARP_INVERSE_MAP)
            else:
                picture = image.shape[1], image.shape[0]
                source_xy = source_pixels(pixel_to_crs, grid, column, row, size, picture, to_place, lens)
                columns, rows = cv2.split(np.nan_to_num(source_xy - 0.5, nan=-9.0).astype(np.float32))
                block[...] = cv2.remap(image, columns, rows, interpolation)
    return drawn


def source_pixels(
    pixel_to_crs: FloatArray,
    grid: MapGrid,
    column: int,
    row: int,
    size: tuple[int, int],
    picture: tuple[int, int],
    to_place: Transform = None,
    lens: Lens | None = None,
) -> FloatArray:
    """Image pixels (rows, columns, 2; corner convention) that lie at the centres of a block of a grid; NaN if nowhere.

    The block begins at `column`, `row` and has `size` (width, height); the image has `picture` (width, height) pixels.
    They are exact at some nodes and bilinear between, nowhere further off than `_NODE_ERROR_PX` in the image.
    """
    to_pixel, to_crs = Homography(pixel_to_crs).inverse(), Homography(grid.to_crs_matrix(column, row))

    def put(across: FloatArray, along: FloatArray) -> FloatArray:
        points = to_crs(np.stack(np.meshgrid(across, along), axis=2))
        return points if to_place is None else to_place(points)

    def see(points: FloatArray) -> FloatArray:
        pixels = to_pixel(points)
        return pixels if lens is None else lens.bend(pixels)

    # A camera bends a plane more than a change of the CRS does.
    for step in _NODE_STEPS:
        if 4 * step > min(size):
            continue
        cells = [math.ceil(side / step) for side in size]
        nodes = put(*(_every(step, n + 2) - 0.5 * step for n in cells))
        middles = see(put(*(_every(step, n + 1) for n in cells)))
        near = np.asarray((np.abs(middles / picture - 0.5) < 0.75).all(axis=2))
        if _is_near(_between(see(nodes)), middles, near):
            return _resize(see(nodes), step, size)
        if _is_near(see(_between(nodes)), middles, near):
            return see(_resize(nodes, step, size))
    return see(put(*(_every(1, side) + 0.5 for side in size)))


def _between(nodes: FloatArray) -> FloatArray:
    return (nodes[1:, 1:] + nodes[1:, :-1] + nodes[:-1, 1:] + nodes[:-1, :-1]) / 4.0


def _is_near(estimate: FloatArray, exact: FloatArray, near: AnyArray) -> bool:
    return bool(np.abs(estimate - exact)[near].max(initial=0.0) < _NODE_ERROR_PX)


def _resize(nodes: FloatArray, step: int, size: tuple[int, int]) -> FloatArray:
    """Return positions at all pixels of a block, bilinear between those at its nodes."""
    fine = np.asarray(cv2.resize(nodes, None, fx=step, fy=step, interpolation=cv2.INTER_LINEAR), np.float64)
    return fine[step : step + size[1], step : step + size[0]]


def _every(step: int, n: int) -> FloatArray:
    """Return the first n multiples of a step."""
    return np.arange(n, dtype=np.float64) * step
