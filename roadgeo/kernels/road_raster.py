"""The roads of a map as a raster of direction bits: each cell holds the directions of the roads near it.

Cells of `cell` metres hold 16 bits, one for each of 16 ranges of direction modulo pi. A road sets the bits of its own
and the nearest directions in all cells near it, so that one look-up answers "does a road pass here that runs my way?".
Only tiles of 64 x 64 cells that meet roads are stored: `tile_of` (rows, columns) holds a tile's number; all others are
tile 0, which is empty.
"""

import math
from typing import NamedTuple

import numpy as np

from roadgeo.kernels.arrays import Int32s2, Singles2, Words3
from roadgeo.kernels.compilation import kernel

__all__ = ["DIRECTIONS", "TILE", "Raster", "mark_tiles", "measure_tiles", "paint_roads", "passes", "passing"]

#: Ranges of direction, and cells along a tile's side (a power of two).
DIRECTIONS = 16
TILE = 64
_SHIFT = 6


class Raster(NamedTuple):
    """The raster as kernels take it: (R, C) int32, (T + 1, TILE, TILE) uint16, and the side of a cell in metres."""

    tile_of: Int32s2
    bits: Words3
    cell: float


@kernel(writes=("tile_of",))
def mark_tiles(segments: Singles2, x0: float, y0: float, cell: float, reach: float, tile_of: Int32s2) -> int:
    """Give numbers to the tiles that roads of half width `reach` may touch; return how many there are.

    Parameters
    ----------
    segments : (S, 4) float32
        x1, y1, x2, y2 in metres; all lie inside the raster.
    x0, y0, cell, reach : float
        Corner of the raster, side of a cell and half a road's width, metres.
    tile_of : (rows, columns) int32
        Filled: tiles are numbered from 1, row by row, others become 0.
    """
    tile_of[:] = 0
    size = cell * TILE
    for s in range(segments.shape[0]):
        x1, y1, x2, y2 = segments[s, 0] - x0, segments[s, 1] - y0, segments[s, 2] - x0, segments[s, 3] - y0
        n = int(math.hypot(x2 - x1, y2 - y1) / (0.5 * size)) + 1
        for k in range(n):  # the boxes of its pieces: a long diagonal does not mark its whole box
            ax, bx = x1 + (x2 - x1) * k / n, x1 + (x2 - x1) * (k + 1) / n
            ay, by = y1 + (y2 - y1) * k / n, y1 + (y2 - y1) * (k + 1) / n
            for row in range(int((min(ay, by) - reach) / size), int((max(ay, by) + reach) / size) + 1):
                for column in range(int((min(ax, bx) - reach) / size), int((max(ax, bx) + reach) / size) + 1):
                    tile_of[row, column] = 1
    count = 0
    for row in range(tile_of.shape[0]):
        for column in range(tile_of.shape[1]):
            if tile_of[row, column] == 1:
                count += 1
                tile_of[row, column] = count
    return count


@kernel(writes=("bits",))
def paint_roads(
    segments: Singles2,
    x0: float,
    y0: float,
    cell: float,
    reach: float,
    turn: float,
    tile_of: Int32s2,
    bits: Words3,
) -> None:
    """Set the direction bits of all cells whose centres lie within `reach` metres of a road.

    Parameters
    ----------
    segments, x0, y0, cell, reach, tile_of
        As in `mark_tiles`, which filled `tile_of`.
    turn : float
        Directions whose range's middle differs by less than this number of radians are set.
    bits : (T + 1, TILE, TILE) uint16
        Zeros; filled.
    """
    width = math.pi / DIRECTIONS
    for s in range(segments.shape[0]):
        x1, y1, x2, y2 = segments[s, 0] - x0, segments[s, 1] - y0, segments[s, 2] - x0, segments[s, 3] - y0
        length = math.hypot(x2 - x1, y2 - y1)
        if length == 0.0:
            continue
        angle = math.atan2(y2 - y1, x2 - x1) % math.pi
        pattern = np.uint16(0)
        for d in range(DIRECTIONS):
            away = abs((d + 0.5) * width - angle)
            if min(away, math.pi - away) <= turn:
                pattern |= np.uint16(1 << d)
        ux, uy = (x2 - x1) / length, (y2 - y1) / length
        n = int(length / max(2.0 * reach, cell)) + 1
        for k in range(n):  # pieces about as long as a road is wide: the boxes around them hold few cells in vain
            ax, bx = x1 + (x2 - x1) * k / n, x1 + (x2 - x1) * (k + 1) / n
            ay, by = y1 + (y2 - y1) * k / n, y1 + (y2 - y1) * (k + 1) / n
            for row in range(int((min(ay, by) - reach) / cell), int((max(ay, by) + reach) / cell) + 1):
                for column in range(int((min(ax, bx) - reach) / cell), int((max(ax, bx) + reach) / cell) + 1):
                    px, py = (column + 0.5) * cell - x1, (row + 0.5) * cell - y1
                    t = min(max(px * ux + py * uy, 0.0), length)
                    if (px - t * ux) ** 2 + (py - t * uy) ** 2 <= reach * reach:
                        tile = tile_of[row >> _SHIFT, column >> _SHIFT]
                        bits[tile, row & (TILE - 1), column & (TILE - 1)] |= pattern


@kernel(writes=("out",))
def measure_tiles(raster: Raster, out: Singles2) -> None:
    """Find the share of (cell, direction) pairs that roads set, in each tile and its eight neighbours together.

    Parameters
    ----------
    out : (rows, columns) float32
        Filled: the chance that a point there, of any direction, meets a road.
    """
    tile_of, bits = raster.tile_of, raster.bits
    share = np.zeros(bits.shape[0])
    for tile in range(bits.shape[0]):
        count = 0
        for row in range(TILE):
            for column in range(TILE):
                word = bits[tile, row, column]
                while word != 0:
                    word &= word - np.uint16(1)
                    count += 1
        share[tile] = count / (TILE * TILE * DIRECTIONS)
    rows, columns = tile_of.shape
    for row in range(rows):
        for column in range(columns):
            total, n = 0.0, 0
            for r in range(max(row - 1, 0), min(row + 2, rows)):
                for c in range(max(column - 1, 0), min(column + 2, columns)):
                    n += 1
                    total += share[tile_of[r, c]]
            out[row, column] = total / n


@kernel(forceinline=True)
def passing(x: float, y: float, raster: Raster) -> np.uint32:
    """Return the direction bits of the roads that pass the place (x, y), in cells from the raster's corner.

    The place must lie inside the raster.
    """
    column, row = np.uint32(x), np.uint32(y)
    tile = np.uint32(raster.tile_of[row >> np.uint32(_SHIFT), column >> np.uint32(_SHIFT)])
    return np.uint32(raster.bits[tile, row & np.uint32(TILE - 1), column & np.uint32(TILE - 1)])


@kernel(forceinline=True)
def passes(x: float, y: float, direction: int, raster: Raster) -> int:
    """Return 1 if a road of direction range `direction` passes the place (x, y), as `passing`."""
    # signed, as the sums it goes into
    return int(np.int64((passing(x, y, raster) >> np.uint32(direction)) & np.uint32(1)))
