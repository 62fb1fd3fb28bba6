"""The map's roads as a raster of direction bits, and as rings around its intersections, kept while they are in use."""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass, replace
from weakref import WeakValueDictionary

import numpy as np

from roadgeo._arrays import AnyArray, BoolArray, Float32Array, FloatArray, IntArray
from roadgeo.kernels.road_raster import TILE, Raster, mark_tiles, measure_tiles, paint_roads
from roadgeo.kernels.road_rings import RINGS, WORDS, draw_rings
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
    radius_m, ring_step : float
        Where the rings around intersections end, less than 63 cells away, and the ratio of each to the next.
    """

    cell_m: float = 6.0
    reach_m: float = 8.0
    turn_deg: float = 20.0
    radius_m: float = 220.0
    ring_step: float = 1.08

    def __post_init__(self) -> None:
        if self.radius_m >= (TILE - 1) * self.cell_m:
            raise ValueError(f"radius_m is {self.radius_m:g}; expected less than {TILE - 1} cells of the raster")

    @property
    def inner_m(self) -> float:
        """Where the rings begin."""
        return self.radius_m / self.ring_step**RINGS

    def ring_of(self, metres: FloatArray | float) -> IntArray:
        """Return the rings that distances lie in, 0 to RINGS - 1; others are beyond."""
        return np.floor(np.log(np.maximum(metres, 1e-9) / self.inner_m) / math.log(self.ring_step)).astype(np.int64)

    def on(self, coarseness: float) -> RasterOptions:
        """Return them for a coarse map: all lengths are so many times as long."""
        lengths = {name: coarseness * getattr(self, name) for name in ("cell_m", "reach_m", "radius_m")}
        return replace(self, **lengths)


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
    rings : (N, WORDS) uint64
        Around each intersection of the reference, as far as `has_rings` (N,) says (see `draw_rings_of`).
    radii : (RINGS,) float64
        Of the middles of the rings, cells.
    """

    origin: tuple[float, float]
    raster: Raster
    density: Float32Array
    rings: AnyArray
    has_rings: BoolArray
    radii: FloatArray

    @property
    def rim_m(self) -> float:
        """Nothing that kernels look up may lie further than this from all roads and intersections."""
        return self.raster.cell * TILE

    @property
    def nbytes(self) -> int:
        """Size of its arrays."""
        return int(self.raster.tile_of.nbytes + self.raster.bits.nbytes + self.density.nbytes + self.rings.nbytes)

    def cells(self, xy: FloatArray) -> FloatArray:
        """Return (N, 2) plane metres as cells from the corner."""
        return np.asarray((xy - self.origin) / self.raster.cell)

    def density_at(self, xy: FloatArray) -> FloatArray:
        """Return the density at (N, 2) places inside the raster."""
        tiles = (self.cells(xy) / TILE).astype(np.int64)
        return np.asarray(self.density[tiles[:, 1], tiles[:, 0]], float)

    def draw_rings_of(self, cells: FloatArray, places: IntArray) -> None:
        """Draw the rings of intersections, (N, 2) cells of all and (M,) numbers, as far as they are not drawn yet."""
        missing = places[~self.has_rings[places]]
        draw_rings(cells, missing, self.radii, self.raster, self.rings)
        self.has_rings[missing] = True


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
    radii = np.asarray(options.inner_m * options.ring_step ** (np.arange(RINGS) + 0.5) / options.cell_m)
    n = len(index.xy)
    return RoadRaster((x0, y0), raster, density, np.empty((n, WORDS), np.uint64), np.zeros(n, bool), radii)
