"""Proposals from roads: a query intersection and the roads around it, compared with every intersection of the map.

Triples of intersections need three intact neighbours. Where roads are missing, false or few, a single intact
intersection and the roads around it still fix their place. Turned so that two branches agree, at each of many scales,
most road points fall on roads of the map at the right place, and few elsewhere. The number expected by chance depends
on the scale and on the density of the map's roads at the place. Without this correction, scales at which the query
shrinks to a few blocks would crowd out the rest.

The map's roads are drawn for that as a raster of direction bits, and as rings around its intersections, which are kept
while they are in use.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice
from typing import NamedTuple
from weakref import WeakValueDictionary

import numpy as np

from roadgeo._arrays import AnyArray, BoolArray, Float32Array, FloatArray, IntArray
from roadgeo.geometry.camera import CameraOptions
from roadgeo.kernels.road_growth import Stages, grow_by_roads
from roadgeo.kernels.road_raster import DIRECTIONS, TILE, Raster, mark_tiles, measure_tiles, paint_roads
from roadgeo.kernels.road_rings import RINGS, WORDS, draw_rings, mark_rings
from roadgeo.kernels.road_votes import WHOLE_TURN, Places, RoadPoints, VoteRates, improve_votes, vote
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.place import Place
from roadgeo.matching.refinement import RefineOptions, denormalise
from roadgeo.matching.scene import (
    AGREE_DEG,
    FEWEST,
    LARGE_PIXEL_M,
    LEAST_SHARE,
    MIN_COS,
    N_ROUGHLY,
    ROAD_TURN,
    Scene,
    and_pixels,
)
from roadgeo.matching.search import ALONE, Ahead
from roadgeo.matching.triples import farthest_first
from roadgeo.roads.intersections import unpack_branches

__all__ = [
    "COARSE_PIXEL_M",
    "N_VOTING",
    "RADIUS_M",
    "RING_STEP",
    "RoadGrower",
    "RoadRaster",
    "RoadRound",
    "RoadSearch",
    "Voter",
    "Votes",
    "make_raster",
    "ring_of",
    "scales",
]


#: Ratio of a ring around an intersection to the next.
RING_STEP = 1.08
#: Side of a raster's cells; how far from a road the middles of its cells lie, for at 200 m from an intersection half a
#: step of scale moves a road by 8 m; and where the rings around intersections end, less than 63 cells away. Metres; a
#: coarse map multiplies all lengths by its coarseness.
_CELL_M, _REACH_M, RADIUS_M = 6.0, 8.0, 220.0


def ring_of(metres: FloatArray) -> IntArray:
    """Return the rings of distances on a map of coarseness 1: 0 to RINGS - 1, or a number outside."""
    inner_m = RADIUS_M / RING_STEP**RINGS
    return np.floor(np.log(np.maximum(metres, 1e-9) / inner_m) / math.log(RING_STEP)).astype(np.int64)


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
        Around each intersection of the reference, as far as `has_rings` (N,) is set (see `draw_rings_of`).
    radii : (RINGS,) float64
        Radii of the rings' middles, cells.
    """

    origin: tuple[float, float]
    raster: Raster
    density: Float32Array
    rings: AnyArray
    has_rings: BoolArray
    radii: FloatArray

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


#: Rasters in use anywhere; and rasters kept for later, the last used at the end, up to a number of bytes together: as
#: many as a search of thirty cities has in use at once.
_in_use: WeakValueDictionary[ReferenceIndex, RoadRaster] = WeakValueDictionary()
_kept: OrderedDict[ReferenceIndex, RoadRaster] = OrderedDict()
_MOST_BYTES = 1_200_000_000


def make_raster(index: ReferenceIndex) -> RoadRaster:
    """Return the raster of a reference, drawn anew unless it is in use or kept from before.

    Drawing takes some hundredths of a second, and 9 MB, for a city of 400 km2. The rasters used last are kept, up to a
    size: many masks are searched on the same maps, one after the other.
    """
    drawn = _in_use.get(index) or _draw(index)
    _in_use[index] = _kept[index] = drawn
    _kept.move_to_end(index)
    while len(_kept) > 1 and sum(raster.nbytes for raster in _kept.values()) > _MOST_BYTES:
        _kept.popitem(last=False)
    return drawn


def _draw(index: ReferenceIndex) -> RoadRaster:
    segments, cell, reach = index.segments, index.coarseness * _CELL_M, index.coarseness * _REACH_M
    ends = segments.reshape(-1, 2)
    low = np.minimum(ends.min(axis=0), index.xy.min(axis=0)) - cell * TILE  # nothing that is looked up lies beyond
    high = np.maximum(ends.max(axis=0), index.xy.max(axis=0)) + cell * TILE
    columns, rows = (math.ceil(side / (cell * TILE)) + 1 for side in high - low)
    tile_of = np.empty((rows, columns), np.int32)
    x0, y0 = float(low[0]), float(low[1])
    n = mark_tiles(segments, x0, y0, cell, reach, tile_of)
    bits = np.zeros((n + 1, TILE, TILE), np.uint16)
    paint_roads(segments, x0, y0, cell, reach, ROAD_TURN, tile_of, bits)
    raster = Raster(tile_of, bits, cell)
    density = np.empty((rows, columns), np.float32)
    measure_tiles(raster, density)
    radii = np.asarray(RADIUS_M * RING_STEP ** (np.arange(RINGS) + 0.5 - RINGS) / _CELL_M)
    n = len(index.xy)
    return RoadRaster((x0, y0), raster, density, np.empty((n, WORDS), np.uint64), np.zeros(n, bool), radii)


_PER_RADIAN = WHOLE_TURN / math.tau
_TURN_STEPS = np.radians(3.0 * np.arange(-2, 3))
_SCALE_STEPS = np.array([0.96, 1.04])

#: Roads nearer than this, metres, that run straight away from the intersection are left out: they are its own branches,
#: which agree by construction. The right place then stands out more.
_OWN_M = 150.0
#: Number of query intersections that vote. 94 of 96 masks with 40 % of the roads gone and 40 % false that were located
#: on the map of their city were from the first 20. A search of 33 cities without a result takes a third longer with 30.
N_VOTING = 20
#: Number of the best proposals that are judged anew.
_KEPT = 400
#: Share of road points that meet roads at the right place; and by chance, in units of the density of roads, which crowd
#: around intersections.
_TRIAL = VoteRates(0.55, 1.5)


@dataclass(frozen=True)
class Votes:
    """Proposals of a query intersection. Dimension: M proposals, the best first.

    Attributes
    ----------
    anchor : int
        The query intersection.
    reference : (M,) int64
        Map intersections it may be.
    affine : (M, 4) float64
        The 2 x 2 map (row-major) from query to reference around it.
    ratio : (M,) float64
        Log-likelihood ratio of the road points against chance, nats.
    n_tried : int
        Places and turns tried.
    """

    anchor: int
    reference: IntArray
    affine: FloatArray
    ratio: FloatArray
    n_tried: int


class _Around(NamedTuple):
    """The roads of the query as seen from one of its intersections, at each of S scales.

    `rays` (R,) are its branches (see `kernels.road_votes.WHOLE_TURN`), `rings` (S, WORDS) the roads in rings around it,
    and `points` those that judge proposals anew, evenly by distance.
    """

    rays: IntArray
    rings: AnyArray
    points: RoadPoints


def _steps(scale: tuple[float, float]) -> FloatArray:
    """Return (S,) scales between two limits, half a step from them at most."""
    n = int(math.log(scale[1] / scale[0]) / math.log(RING_STEP)) + 1
    return np.asarray(math.sqrt(scale[0] * scale[1]) * RING_STEP ** (np.arange(n) - (n - 1) / 2))


@lru_cache(maxsize=N_VOTING)
def _look_around(scene: Scene, anchor: int, scale: tuple[float, float], coarseness: float) -> _Around:
    """Return the roads around an intersection: the same for all maps of a coarseness, and for all parts of a map."""
    scales, rays = _steps(scale), scene.intersections.rays[anchor]
    offsets = scene.dense_points - scene.intersections.xy[anchor]
    away = np.hypot(*offsets.T)
    (near,) = np.nonzero(away < RADIUS_M * coarseness / scales[0])
    order = near[np.argsort(away[near], kind="stable")]
    offsets, away, directions = offsets[order], away[order], scene.dense_directions[order]
    angles = np.arctan2(directions[:, 1], directions[:, 0]) * (DIRECTIONS / math.pi) + DIRECTIONS

    bearings = np.arctan2(offsets[:, 1], offsets[:, 0])
    along = np.abs(np.sin(angles * (math.pi / DIRECTIONS) - bearings)) <= math.sqrt(0.5)
    own = np.abs((offsets * directions).sum(axis=1)) > math.cos(ROAD_TURN) * away  # it runs straight away
    words = np.zeros((len(scales), WORDS), np.uint64)
    rings, first_own = ring_of(away * scales[0] / coarseness), int(ring_of(np.asarray(_OWN_M)))
    mark_rings(rings, bearings, along.astype(np.int64), own.astype(np.int64), first_own, words)

    usable = np.searchsorted(away, RADIUS_M * coarseness / scales)
    n = np.minimum(usable, N_ROUGHLY)
    starts = np.concatenate(([0], np.cumsum(n)))
    at = np.repeat(np.arange(len(n)), n)
    taken = (np.arange(len(at)) - starts[at]) * (usable[at] - 1) // np.maximum(n[at] - 1, 1)
    points = RoadPoints(scales, starts, offsets[taken], angles[taken])
    return _Around(_whole(rays[np.isfinite(rays)]), words, points)


class Voter:
    """Compares the roads around intersections of one scene with one map, within limits on scale and turn."""

    def __init__(
        self,
        scene: Scene,
        index: ReferenceIndex,
        scale: tuple[float, float],
        heading: tuple[float, float],
        candidates: IntArray,
    ) -> None:
        """`scale` in metres per pixel; `heading` of the image's up, and how far off, radians; map's `candidates`."""
        self.scene, self.index = scene, index
        self.scale, self.heading, self.candidates = scale, heading, candidates
        self.drawn: RoadRaster = make_raster(index)
        cells, rays = self.drawn.cells(index.xy), unpack_branches(index.branches)
        self.drawn.draw_rings_of(cells, candidates)
        counts = np.isfinite(rays).sum(axis=1)
        density, rings = self.drawn.density_at(index.xy), self.drawn.rings
        self.places = Places(cells, _whole(rays).astype(np.int32), counts, density, rings)

    def votes(self, anchor: int) -> Votes:
        """Return the best proposals of a query intersection."""
        around = _look_around(self.scene, anchor, self.scale, self.index.coarseness)
        turn, max_off = -round(self.heading[0] * _PER_RADIAN), round(self.heading[1] * _PER_RADIAN)
        found = np.empty((_KEPT, 4))
        kept, tried = vote(
            self.candidates, around.rays, round(ROAD_TURN * _PER_RADIAN), turn, max_off, around.points.scales,
            around.rings, FEWEST, self.places, found,
        )  # fmt: skip
        found = found[:kept]
        improve_votes(found, _TURN_STEPS, _SCALE_STEPS, around.points, self.places, self.drawn.raster, _TRIAL)
        best = found[np.argsort(-found[:, 3], kind="stable")]
        c, s = np.cos(best[:, 1]) * best[:, 2], np.sin(best[:, 1]) * best[:, 2]
        return Votes(anchor, best[:, 0].astype(np.int64), np.stack([c, -s, s, c], axis=1), best[:, 3], tried)


def _whole(angles: AnyArray) -> IntArray:
    """Return radians as whole numbers (see `kernels.road_votes.WHOLE_TURN`); NaN becomes 0."""
    turns = np.nan_to_num(np.asarray(angles, float)) * _PER_RADIAN
    whole: IntArray = np.round(turns).astype(np.int64)
    return whole.clip(-WHOLE_TURN // 2, WHOLE_TURN // 2 - 1)


#: The part of half the frame's diagonal up to which an affine map will do.
_AFFINE_UNTIL = 0.45
#: Points within the sum of metres and pixels of a road lie on it.
_TOLERANCE_M, _TOLERANCE_PX = and_pixels(7.0)
#: Proposals of an intersection that are kept after each of the first stages because they are closest to roads, besides
#: `_MAX_KEPT` with most votes. With all 40 kept, 396 intersections led to the place of a broken mask; now 395 do, in
#: half the time. In lattices 255 of 266 do, in a quarter.
_GO_ON = (16, 6, 3)


class RoadGrower:
    """Grows proposals of a scene on a map."""

    def __init__(self, scene: Scene, index: ReferenceIndex, camera: CameraOptions) -> None:
        self.scene, self.index = scene, index
        perspective = camera.perspective_sigma(RefineOptions.perspective_sigma)
        self._stages = Stages(_AFFINE_UNTIL, LEAST_SHARE, perspective, MIN_COS, _GO_ON, _MAX_KEPT)

    def grow(self, anchor: int, references: IntArray, affines: FloatArray) -> list[Place]:
        """Grow proposals of query intersection `anchor`; return those that were not given up, in their order.

        They are supported by how close to roads their road points lie, 0 to 1.

        `references` (M,) are the map intersections that it is laid on, `affines` (M, 4) how: 2 x 2, row-major.
        """
        half_size = self.scene.half_size
        at = self.scene.intersections.xy[anchor]
        away = self.scene.points - at
        outwards = np.argsort(np.hypot(*away.T), kind="stable")
        points, directions = away[outwards] / half_size, self.scene.directions[outwards]
        j00, j01, j10, j11 = np.asarray(affines, float).T
        gsd = np.sqrt(j00 * j11 - j01 * j10)
        zero = np.zeros_like(gsd)
        ps = np.stack([j00 / gsd, j01 / gsd, zero, j10 / gsd, j11 / gsd, zero, zero, zero], axis=1)
        units, origins = half_size * gsd, self.index.xy[references]
        tolerances = _TOLERANCE_M + _TOLERANCE_PX * gsd
        closeness = np.empty(len(gsd))
        roads = self.index.road_buckets
        grow_by_roads(ps, units, origins, tolerances, points, directions, self._stages, roads, closeness)
        grown = []
        for k in np.flatnonzero(closeness >= 0.0):
            matrix = denormalise(ps[k], at, half_size, origins[k], float(units[k]))
            grown.append(Place(self.scene, self.index, matrix / matrix[2, 2], float(closeness[k])))
        return grown


#: The smallest pixels that are tried on a map of coarseness 1; a coarse map multiplies them by its coarseness.
COARSE_PIXEL_M = 0.35

#: Number of an anchor's proposals that grow, if they are at least so likely as a part of the best; and number of grown
#: places that are compared with the map.
_MAX_GROWN, _LIKELY, _MAX_KEPT = 80, 0.5, 2
#: Greatest width of roads, metres: no scales are tried at which they would be wider.
_ROAD_WIDTH_M = 75.0


def scales(camera: CameraOptions, road_width_px: float, coarseness: float = 1.0) -> tuple[float, float]:
    """Return the least and greatest ground sampling around an intersection to try.

    Small pixels show more than a coarse map.
    """
    low, high = camera.gsd_m
    if coarseness != 1.0:
        low = max(low, coarseness * COARSE_PIXEL_M)
    high = max(high, low)
    most = _ROAD_WIDTH_M / road_width_px  # NaN: not known
    return low, most if low < most < high else high


class RoadRound(NamedTuple):
    """The results of a query intersection: places and turns tried, proposals to grow, and places that grew."""

    anchor: int
    n_tried: int
    n_proposed: int
    grown: list[Place]


class RoadSearch:
    """Proposes places for a scene on a map by roads alone."""

    def __init__(
        self,
        scene: Scene,
        index: ReferenceIndex,
        camera: CameraOptions,
        near: tuple[float, float, float] | None = None,
        ahead: Ahead = ALONE,
        among: IntArray | None = None,
    ) -> None:
        """`near` = (x, y, radius) in plane metres restricts where the middle of the frame may lie.

        `among` (M,): the map's intersections that are compared.
        """
        coarseness = index.coarseness
        self.scene, self.ahead = scene, ahead
        scale = scales(camera, scene.road_width_px, coarseness)
        center, off = camera.heading or (0.0, 180.0)
        heading = math.radians(center), math.radians(min(off + AGREE_DEG, 180.0))
        candidates = _within(index, near, scene.half_size * min(scale[1], max(coarseness * LARGE_PIXEL_M, scale[0])))
        candidates = candidates if among is None else np.intersect1d(candidates, among, assume_unique=True)
        self.voter = Voter(scene, index, scale, heading, candidates)
        self.grower = RoadGrower(scene, index, camera)

    def rounds(self) -> Iterator[RoadRound]:
        """Yield the places that grew from each anchor's proposals."""
        xy = self.scene.intersections.xy
        anchors = islice(farthest_first(xy, np.arange(len(xy))), N_VOTING)
        for votes in self.ahead.map(self.voter.votes, anchors):
            best = slice(min(int((votes.ratio >= _LIKELY * votes.ratio[:1]).sum()), _MAX_GROWN))
            grown = self.grower.grow(votes.anchor, votes.reference[best], votes.affine[best])
            some = sorted(grown, key=lambda place: -place.support)
            yield RoadRound(votes.anchor, votes.n_tried, len(votes.reference[best]), some[:_MAX_KEPT])


def _within(index: ReferenceIndex, near: tuple[float, float, float] | None, reach_m: float) -> IntArray:
    """Return the map's intersections that a frame around a place in the circle may show."""
    if near is None:
        return np.arange(len(index))
    return np.flatnonzero(np.hypot(*(index.xy - near[:2]).T) < near[2] + reach_m)
