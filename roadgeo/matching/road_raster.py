"""The map's roads as a raster of direction bits, made once for a reference and kept while it is in use."""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass
from weakref import WeakValueDictionary

import numpy as np

from roadgeo._arrays import Float32Array, FloatArray
from roadgeo.kernels.road_raster import TILE, Raster, mark_tiles, measure_tiles, paint_roads
from roadgeo.matching.index import ReferenceIndex

__all__ = ["RasterOptions", "RoadRaster", "make_raster"]


@dataclass(frozen=True)
class RasterOptions:
    """How roads are drawn.

    Attributes
    ----------
    cell_m : float
        Side of a cell.
    reach_m : float
        Cells whose centres lie within this distance of a road belong to it: at 200 m from an intersection, half a step
        of scale (4 %) moves a road by 8 m.
    turn_deg : float
        Directions that differ by less from a road's belong to it.
    """

    cell_m: float = 6.0
    reach_m: float = 8.0
    turn_deg: float = 20.0


@dataclass(frozen=True, eq=False)
class RoadRaster:
    """A raster over the whole reference (see `kernels.road_raster`), with a rim of empty tiles.

    Attributes
    ----------
    origin : (x, y)
        Its corner in plane metres.
    raster : Raster
    density : (R, C) float32
        Chance of a point of any direction to meet a road in a tile or those beside it.
    """

    origin: tuple[float, float]
    raster: Raster
    density: Float32Array

    @property
    def rim_m(self) -> float:
        """Nothing that kernels look up may lie further than this from all roads and intersections."""
        return self.raster.cell * TILE

    @property
    def nbytes(self) -> int:
        """Size of its arrays."""
        return int(self.raster.tile_of.nbytes + self.raster.bits.nbytes + self.density.nbytes)

    def cells(self, xy: FloatArray) -> FloatArray:
        """Return (N, 2) plane metres as cells from the corner."""
        return np.asarray((xy - self.origin) / self.raster.cell)

    def density_at(self, xy: FloatArray) -> FloatArray:
        """Return the density at (N, 2) places inside the raster."""
        tiles = (self.cells(xy) / TILE).astype(np.int64)
        return np.asarray(self.density[tiles[:, 1], tiles[:, 0]], float)


#: Rasters in use anywhere; and those that are kept, the one used last at the end, up to so many bytes together.
_in_use: WeakValueDictionary[tuple[ReferenceIndex, RasterOptions], RoadRaster] = WeakValueDictionary()
_kept: OrderedDict[tuple[ReferenceIndex, RasterOptions], RoadRaster] = OrderedDict()
_MOST_BYTES = 500_000_000


def make_raster(index: ReferenceIndex, options: RasterOptions) -> RoadRaster:
    """Return the raster of a reference, drawn anew unless it is in use or kept from before.

    Drawing takes some hundredths of a second, and 9 MB, for a city of 400 km2. Those used last are kept, up to a size:
    many masks are looked for on the same maps, one after the other.
    """
    key = (index, options)
    drawn = _in_use.get(key) or _draw(index, options)
    _in_use[key] = _kept[key] = drawn
    _kept.move_to_end(key)
    while len(_kept) > 1 and sum(one.nbytes for one in _kept.values()) > _MOST_BYTES:
        _kept.popitem(last=False)
    return drawn


def _draw(index: ReferenceIndex, options: RasterOptions) -> RoadRaster:
    segments, size = index.segments, options.cell_m * TILE
    ends = segments.reshape(-1, 2)
    low = np.minimum(ends.min(axis=0), index.xy.min(axis=0)) - size
    high = np.maximum(ends.max(axis=0), index.xy.max(axis=0)) + size
    columns, rows = (math.ceil(side / size) + 1 for side in high - low)
    tile_of = np.empty((rows, columns), np.int32)
    x0, y0 = float(low[0]), float(low[1])
    n = mark_tiles(segments, x0, y0, options.cell_m, options.reach_m, tile_of)
    bits = np.zeros((n + 1, TILE, TILE), np.uint16)
    turn = math.radians(options.turn_deg)
    paint_roads(segments, x0, y0, options.cell_m, options.reach_m, turn, tile_of, bits)
    raster = Raster(tile_of, bits, options.cell_m)
    density = np.empty((rows, columns), np.float32)
    measure_tiles(raster, density)
    return RoadRaster((x0, y0), raster, density)
