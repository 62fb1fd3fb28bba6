"""The reference index: everything `locate` needs of a road network, in flat arrays that can be memory-mapped.

Intersections are sorted by the bucket of a grid, which also lists the road segments. The table of triple codes
(`kernels.triple_codes`) points to intersections. Positions are metres from the plane's origin.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from roadgeo._arrays import AnyArray, Float32Array, FloatArray, Int32Array
from roadgeo._progress import Say, say_nothing
from roadgeo.errors import IndexFormatError
from roadgeo.geometry.projection import LocalPlane
from roadgeo.kernels.buckets import nearest_neighbours
from roadgeo.kernels.roads import bin_segments
from roadgeo.kernels.structs import PointBuckets, RoadBuckets, TripleMap
from roadgeo.kernels.triple_codes import MAX_ANCHORS, MAX_NEIGHBOURS, TABLE, fill_table, find_sides
from roadgeo.roads.graph import RoadGraph
from roadgeo.roads.intersections import MAX_BRANCHES
from roadgeo.roads.network import RoadNetwork
from roadgeo.roads.simplification import SimplifyOptions

__all__ = [
    "COARSENESS",
    "IndexOptions",
    "ReferenceIndex",
    "bucket_roads",
    "build_index",
    "crop",
    "neighbour_grid",
    "pack_tangents",
    "sort_by_bucket",
    "unpack_tangents",
]

#: Factor by which the roads' buckets are narrower than the intersections': roads are looked up within some 20 m.
_FINER = 2

#: Limits of an index from an unknown source: kernels sample segments every few metres, in each bucket that lists them.
_MAX_DISTANCE_M = 5e7
_MAX_SEGMENT_M, _MAX_MEAN_SEGMENT_M = 1e6, 1e4

#: Factor by which the merging distance of a coarse map exceeds the usual distance, for pixels of 2 to 12 m.
COARSENESS = 6.0
_LEAST_COARSE, _MOST_COARSE = 2.0, 50.0


@dataclass(frozen=True)
class IndexOptions:
    """How many triples an intersection anchors, and the grid.

    Attributes
    ----------
    n_neighbours : int
        Triples are formed with pairs of an intersection's nearest neighbours; at most 8.
    min_shape : float
        Triangles thinner than this (twice the area over the longest side squared) carry no stable code.
    codes_per_vertex : int
        Most pairs of tangents that are coded at a vertex with three tangents or more.
    min_bucket_m : float
        Least size of the grid's buckets.
    simplify_m : float
        Roads are straightened to this accuracy before they are cut into segments.
    """

    n_neighbours: int = 8
    min_shape: float = 0.06
    codes_per_vertex: int = 2
    min_bucket_m: float = 150.0
    simplify_m: float = 0.8


@dataclass(frozen=True, eq=False)
class ReferenceIndex:
    """A searchable reference; equal only to itself, so that values derived from it can be cached.

    Dimensions: N intersections, R ray columns, K neighbours, S segments, B buckets, T table entries.

    Attributes
    ----------
    meta : mapping
        Plain values: name, crs, origin, grid, shape, options, counts and the content of the network's own `meta`.
    xy : (N, 2) float64
        Intersections in plane metres, sorted by bucket.
    branches : (N, R, 2) int8
        As `Intersections.branches` gives them.
    tangents : (N, R) int16
        Directions of the tangent lines in units of pi / 32767, -1 behind the last.
    neighbours : (N, K) int32
        Nearest intersections, -1 where there are fewer.
    point_starts : (B + 1,) int32
        Bucket c owns the intersections `point_starts[c]:point_starts[c + 1]`.
    segments : (S, 4) float32
        Road segments x1, y1, x2, y2.
    segment_starts : (4 B + 1,) int32, segment_ids : int32
        Segments that touch each bucket of half the width; (B + 1,) of the same width in indexes of earlier versions.
    table_starts : (TABLE + 1,) int32, table_entries : (T,) uint64
        Codes of triples, see `kernels.triple_codes`.
    source : (N,) int32
        Row of each intersection in the network's `intersections`.
    """

    meta: Mapping[str, Any]
    xy: FloatArray
    branches: AnyArray
    tangents: AnyArray
    neighbours: Int32Array
    point_starts: Int32Array
    segments: Float32Array
    segment_starts: Int32Array
    segment_ids: Int32Array
    table_starts: Int32Array
    table_entries: AnyArray
    source: Int32Array
    path: str = ""

    def __len__(self) -> int:
        """N."""
        return len(self.xy)

    def __repr__(self) -> str:
        """Describe the index in one line."""
        return f"<ReferenceIndex {self.name!r}: {len(self):,} intersections>"

    @property
    def name(self) -> str:
        """The reference's name for the user."""
        return str(self.meta.get("name", ""))

    def is_of_map(self, other: ReferenceIndex) -> bool:
        """Return whether both are the same map, or were cut from it (see `crop`): they have one plane."""
        return self is other or self.meta is other.meta

    def is_shard_beside(self, other: ReferenceIndex) -> bool:
        """Return whether both are shards of one map: they agree where they overlap."""
        shard_of = self.meta.get("shard_of")
        return bool(shard_of) and shard_of == other.meta.get("shard_of")

    @property
    def plane(self) -> LocalPlane:
        """Where the index's plane lies on Earth."""
        x, y = self.meta["origin"]
        return LocalPlane(str(self.meta["crs"]), (float(x), float(y)))

    @cached_property
    def coarseness(self) -> float:
        """Ratio of the distance within which roads were merged to an ordinary map's: 1, or more for a coarse map."""
        merged_m: Any = self.meta
        for key in ("options", "simplify", "merge_radius"):
            merged_m = merged_m.get(key) if isinstance(merged_m, Mapping) else None
        ratio = merged_m / SimplifyOptions.merge_radius if type(merged_m) in {int, float} else 1.0
        return ratio if _LEAST_COARSE <= ratio <= _MOST_COARSE else 1.0

    @property
    def grid(self) -> tuple[float, float, float]:
        """(x0, y0, bucket size) in metres."""
        x0, y0, size = self.meta["grid"]
        return float(x0), float(y0), float(size)

    @property
    def shape(self) -> tuple[int, int]:
        """(columns, rows) of buckets."""
        columns, rows = self.meta["shape"]
        return int(columns), int(rows)

    @cached_property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Least and greatest coordinates of the intersections, (2,) each, plane metres."""
        return self.xy.min(axis=0), self.xy.max(axis=0)

    @cached_property
    def road_buckets(self) -> RoadBuckets:
        """The roads, as kernels take them."""
        (x0, y0, size), (columns, rows) = self.grid, self.shape
        finer = math.isqrt((len(self.segment_starts) - 1) // (columns * rows))
        grid = (x0, y0, size / finer), (finer * columns, finer * rows)
        return RoadBuckets(self.segments, self.segment_starts, self.segment_ids, *grid)

    @cached_property
    def point_buckets(self) -> PointBuckets:
        """The intersections, as kernels take them."""
        return PointBuckets(self.xy, self.branches, self.point_starts, self.grid, self.shape)

    @cached_property
    def triple_map(self) -> TripleMap:
        """The table of triples, as kernels take it."""
        return TripleMap(self.xy, self.branches, self.neighbours, self.table_starts, self.table_entries)

    def within(self, middle: FloatArray, reach_m: float) -> FloatArray:
        """Return (M, 2) the intersections less than `reach_m` from `middle`, (2,) plane metres, in both x and y.

        Only the buckets there are read: the cost does not grow with the map.
        """
        x0, y0, size = self.grid
        columns, rows = self.shape
        # Beyond the horizon nothing is near.
        ends = np.nan_to_num([middle - reach_m, middle + reach_m], nan=np.inf, posinf=np.inf, neginf=-np.inf)
        cells = np.floor((ends - (x0, y0)) / size)
        (left, low), (right, high) = np.clip(cells, 0, (columns - 1, rows - 1)).astype(int)
        starts = self.point_starts[columns * np.arange(low, high + 1) + left]
        stops = self.point_starts[columns * np.arange(low, high + 1) + right + 1]
        parts = [self.xy[start:stop] for start, stop in zip(starts, stops, strict=True)]
        near = np.concatenate(parts)
        return np.asarray(near[np.abs(near - middle).max(axis=1) < reach_m])

    def segments_within(self, low: FloatArray, high: FloatArray) -> Float32Array:
        """Return (M, 4) the segments of roads whose bounds touch a box of the plane; its buckets alone are read."""
        segments, starts, ids, (x0, y0, size), (columns, rows) = self.road_buckets
        ends = np.nan_to_num([low, high], nan=np.inf, posinf=np.inf, neginf=-np.inf)
        cells = np.clip(np.floor((ends - (x0, y0)) / size), 0, (columns - 1, rows - 1)).astype(int)
        (left, bottom), (right, top) = cells
        in_rows = columns * np.arange(bottom, top + 1)
        parts = [ids[a:b] for a, b in zip(starts[in_rows + left], starts[in_rows + right + 1], strict=True)]
        near = segments[np.unique(np.concatenate(parts))]
        a, b = near[:, :2], near[:, 2:]
        outside = (np.minimum(a, b) > high).any(axis=1) | (np.maximum(a, b) < low).any(axis=1)
        return np.asarray(near[~outside])

    def arrays(self) -> dict[str, AnyArray]:
        """All arrays by name, for writing."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name not in {"meta", "path"}}

    @classmethod
    def from_parts(cls, meta: Mapping[str, Any], arrays: Mapping[str, AnyArray], path: str = "") -> ReferenceIndex:
        """Rebuild from the content of a file, after checking every shape, type and integer reference.

        Raises
        ------
        IndexFormatError
            If anything could make a kernel read outside its arrays.
        """
        _check_parts(meta, arrays, path)
        return cls(meta=meta, path=path, **{name: arrays[name] for name in _SCHEMA})


#: Types of the arrays, and their shapes: a letter is a dimension, with the same size wherever it occurs.
_SCHEMA: dict[str, tuple[str, str]] = {
    "xy": ("<f8", "N 2"),
    "branches": ("|i1", "N R 2"),
    "tangents": ("<i2", "N R"),
    "neighbours": ("<i4", "N K"),
    "point_starts": ("<i4", "B"),
    "segments": ("<f4", "S 4"),
    "segment_starts": ("<i4", "C"),
    "segment_ids": ("<i4", "I"),
    "table_starts": ("<i4", "D"),
    "table_entries": ("<u8", "T"),
    "source": ("<i4", "N"),
}


def _check_parts(meta: Mapping[str, Any], arrays: Mapping[str, AnyArray], path: str) -> None:
    def require(condition: bool, what: str) -> None:
        if not condition:
            raise IndexFormatError(f"{path or 'index'}: {what}; rebuild it with `roadgeo index`")

    def are_numbers(values: object, n: int) -> bool:
        numbers = values if isinstance(values, (list, tuple)) and len(values) == n else [None]
        return all(isinstance(value, (int, float)) and -1e15 < value < 1e15 for value in numbers)

    # Types and shapes.
    sizes = {str(n): n for n in (2, 4)}
    for name, (dtype, dimensions) in _SCHEMA.items():
        require(name in arrays, f"array {name!r} is missing")
        array, letters = arrays[name], dimensions.split()
        as_expected = array.dtype == np.dtype(dtype) and array.ndim == len(letters)
        require(as_expected, f"array {name!r} has the wrong type or shape")
        for letter, n in zip(letters, array.shape, strict=True):
            require(sizes.setdefault(letter, n) == n, f"bad {name}")
    n = sizes["N"]
    require(2 <= sizes["R"] <= MAX_BRANCHES, "bad tangents")
    require(1 <= sizes["K"] <= MAX_NEIGHBOURS, "bad neighbours")
    # The plane and its grid.
    grid, shape = meta.get("grid"), meta.get("shape")
    require(are_numbers(grid, 3) and grid[2] > 0, "bad grid")  # type: ignore[index]
    require(are_numbers(meta.get("origin"), 2), "bad origin")
    columns, rows = shape if are_numbers(shape, 2) else (0, 0)  # type: ignore[misc]
    require(type(columns) is type(rows) is int and min(columns, rows) > 0 and columns * rows < 2**31, "bad shape")
    require(isinstance(meta.get("crs"), str), "no CRS")
    require(n < 2**31 and _lie_on_earth(arrays["xy"]), "bad positions")
    # Arrays of starts must cover the arrays that they divide, and numbers must point into their arrays.
    n_buckets = columns * rows
    n_road_buckets = n_buckets if sizes["C"] == n_buckets + 1 else _FINER**2 * n_buckets
    for starts, total, size in (
        ("point_starts", n, n_buckets),
        ("segment_starts", sizes["I"], n_road_buckets),
        ("table_starts", sizes["T"], TABLE),
    ):
        array = arrays[starts]
        require(array.shape == (size + 1,), f"{starts} has the wrong length")
        require(int(array[0]) == 0 and int(array[-1]) == total, f"{starts} does not cover its array")
        require(bool((array[1:] >= array[:-1]).all()), f"{starts} is not ascending")
    for name, least, most, what in (("neighbours", -1, n, "neighbour"), ("segment_ids", 0, sizes["S"], "segment id")):
        array = arrays[name]
        within = array.size == 0 or (int(array.min()) >= least and int(array.max()) < most)
        require(within, f"a {what} is out of range")
    require(_are_short(arrays["segments"], arrays["segment_ids"]), "bad segments")


def _lie_on_earth(metres: AnyArray) -> bool:
    """Whether positions on a plane are finite, and not farther from its origin than it is around the Earth."""
    return metres.size == 0 or bool(-_MAX_DISTANCE_M <= metres.min() <= metres.max() <= _MAX_DISTANCE_M)


def _are_short(segments: AnyArray, ids: AnyArray) -> bool:
    """Whether (S, 4) segments can be walked along in a bounded time, wherever they are listed."""
    if not _lie_on_earth(segments):
        return False
    lengths = np.hypot(segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1])
    listed = float(lengths[ids].sum(dtype=np.float64))
    longest = float(lengths.max(initial=0.0))
    return longest <= _MAX_SEGMENT_M and listed <= _MAX_SEGMENT_M * 10 + _MAX_MEAN_SEGMENT_M * len(ids)


def check_table(index: ReferenceIndex) -> None:
    """Check that every table entry points to intersections that exist, and is in the cell of its code.

    `from_parts` leaves that to the kernels, which check every entry: here it would read the whole table.
    """
    entries = index.table_entries
    anchors = (entries >> np.uint64(40)).astype(np.int64)
    slots = ((entries >> np.array([[37], [34]], np.uint64)) & np.uint64(7)).astype(np.int64)
    exist = (anchors < len(index)).all() and (slots < index.neighbours.shape[1]).all()
    if not exist or (index.neighbours[anchors, slots] < 0).any():
        raise IndexFormatError("a table entry is out of range; rebuild the index with `roadgeo index`")
    if len(anchors) == 0:
        return
    places = _place_in_table(np.repeat(np.arange(TABLE, dtype=np.int32), np.diff(index.table_starts)), entries)
    if (places[1:] < places[:-1]).any():
        raise IndexFormatError("the table's entries are not in order; rebuild the index with `roadgeo index`")


def neighbour_grid(xy: FloatArray, min_bucket: float) -> tuple[tuple[float, float, float], tuple[int, int]]:
    """Return a grid (x0, y0, bucket size) over the box around (N, 2) points, and its (columns, rows).

    It has at most 16 N + 1 buckets.
    """
    low, high = xy.min(axis=0), xy.max(axis=0)
    width, height = (float(side) for side in high - low)
    size = max(min_bucket, math.sqrt(width * height / (4 * len(xy))), max(width, height) / (4 * len(xy)))
    return (float(low[0]), float(low[1]), size), (int(width / size) + 1, int(height / size) + 1)


def sort_by_bucket(
    xy: FloatArray, grid: tuple[float, float, float], shape: tuple[int, int]
) -> tuple[Int32Array, Int32Array]:
    """Return the order that sorts points by bucket, and the (B + 1,) starts of the buckets in that order."""
    cells = np.clip(np.floor((xy - grid[:2]) / grid[2]).astype(np.int64), 0, (shape[0] - 1, shape[1] - 1))
    bucket = cells @ (1, shape[0])
    counts = np.bincount(bucket, minlength=shape[0] * shape[1])
    starts = np.concatenate(([0], np.cumsum(counts))).astype(np.int32)
    return np.argsort(bucket, kind="stable").astype(np.int32), starts


def _cut_segments(graph: RoadGraph, tolerance_m: float) -> Float32Array:
    """Straighten the edges and cut them into (S, 4) segments."""
    import shapely

    if graph.n_edges == 0:
        return np.empty((0, 4), np.float32)
    owner = np.repeat(np.arange(graph.n_edges), np.diff(graph.offsets))
    lines = shapely.simplify(shapely.linestrings(graph.coords, indices=owner), tolerance_m, preserve_topology=False)
    coords, owner = shapely.get_coordinates(lines, return_index=True)
    inside = owner[1:] == owner[:-1]
    segments = np.hstack([coords[:-1], coords[1:]])[inside]
    return np.asarray(segments, np.float32)


def pack_tangents(tangents: Float32Array) -> AnyArray:
    """Return tangent directions as stored: (N, R) int16, units of pi / 32767, -1 for NaN."""
    return np.where(np.isnan(tangents), -1, np.round(np.nan_to_num(tangents) * (32767 / math.pi))).astype(np.int16)


def unpack_tangents(packed: AnyArray) -> Float32Array:
    """Undo `pack_tangents`: (N, R) float32 radians, NaN for -1."""
    return np.asarray(np.where(packed >= 0, packed * np.float32(math.pi / 32767), np.nan), np.float32)


def _tabulate(
    xy: FloatArray, tangents: Float32Array, branches: AnyArray, neighbours: Int32Array, options: IndexOptions
) -> tuple[Int32Array, AnyArray]:
    """Return starts and entries of the table of triples (see `kernels.triple_codes`).

    Within a cell the entries are sorted by their sides, so that a look-up skips entries with other sides. Entries with
    equal sides are in a fixed random order: a look-up that ends before the cell does has seen all parts of the map.
    """
    sides = np.empty(tangents.shape, np.int8)
    find_sides(tangents, branches, sides)
    counts = np.zeros(TABLE + 1, np.int64)
    shape_limit = (options.min_shape, options.codes_per_vertex)
    total = fill_table(xy, tangents, sides, neighbours, *shape_limit, counts, np.empty(0, np.uint64))
    starts = np.cumsum(counts)
    entries = np.empty(total, np.uint64)
    fill_table(xy, tangents, sides, neighbours, *shape_limit, starts.copy(), entries)
    order = np.random.default_rng(7).permutation(total)
    entries = entries[order]
    cells = np.repeat(np.arange(TABLE, dtype=np.int32), np.diff(starts))[order]
    entries = entries[np.argsort(_place_in_table(cells, entries), kind="stable")]
    return starts.astype(np.int32), entries


def _place_in_table(cells: Int32Array, entries: AnyArray) -> Int32Array:
    """Return the sort key of entries: their cells, and within those their sides (see `kernels.triple_codes`)."""
    sides = ((entries >> np.uint64(24)) & np.uint64(1023)).astype(np.int32)
    return np.asarray(cells * np.int32(1024) + sides, np.int32)


def crop(index: ReferenceIndex, center: tuple[float, float], radius_m: float) -> ReferenceIndex:
    """Return a reference with the intersections within a circle only; all roads stay.

    Neighbours and triples are built anew from the remaining intersections, so a small part of a large map is searched
    as quickly and as thoroughly as a small map.
    """
    (kept,) = np.nonzero(np.hypot(*(index.xy - center).T) <= radius_m)
    n_buckets = len(index.point_starts) - 1
    buckets = np.repeat(np.arange(n_buckets), np.diff(index.point_starts))[kept]
    starts = np.concatenate(([0], np.cumsum(np.bincount(buckets, minlength=n_buckets)))).astype(np.int32)
    stored = {"n_neighbours": index.neighbours.shape[1], **index.meta.get("index_options", {})}
    options = IndexOptions(**{f.name: stored[f.name] for f in fields(IndexOptions) if f.name in stored})
    points = index.xy[kept], index.branches[kept], unpack_tangents(index.tangents[kept])
    return replace(index, source=index.source[kept], **_of_points(*points, starts, index.grid, index.shape, options))


def _of_points(
    xy: FloatArray,
    branches: AnyArray,
    tangents: Float32Array,
    starts: Int32Array,
    grid: tuple[float, float, float],
    shape: tuple[int, int],
    options: IndexOptions,
) -> dict[str, Any]:
    """Return the arrays of an index that are made of its intersections, sorted by bucket."""
    xy, branches, tangents = map(np.ascontiguousarray, (xy, branches, tangents))
    neighbours = nearest_neighbours(xy, starts, grid, shape, options.n_neighbours)
    table_starts, entries = _tabulate(xy, tangents, branches, neighbours, options)
    return {
        "xy": xy,
        "branches": branches,
        "tangents": pack_tangents(tangents),
        "neighbours": neighbours,
        "point_starts": starts,
        "table_starts": table_starts,
        "table_entries": entries,
    }


def bucket_roads(segments: Float32Array, grid: tuple[float, float, float], shape: tuple[int, int]) -> RoadBuckets:
    """List segments (S, 4) by the buckets of a grid."""
    counts = np.zeros(shape[0] * shape[1] + 1, np.int64)
    total = bin_segments(segments, grid, shape, counts, np.empty(0, np.int32))
    starts, ids = np.cumsum(counts), np.empty(total, np.int32)
    bin_segments(segments, grid, shape, starts.copy(), ids)
    return RoadBuckets(segments, starts.astype(np.int32), ids, grid, shape)


def build_index(network: RoadNetwork, options: IndexOptions | None = None, say: Say = say_nothing) -> ReferenceIndex:
    """Index a road network.

    Raises
    ------
    RoadSourceError
        If there are fewer than three intersections.
    """
    from roadgeo.errors import RoadSourceError

    options = options or IndexOptions()
    detected = network.intersections
    if len(detected) < 3:
        raise RoadSourceError(
            f"the roads have {len(detected)} intersections, at least 3 are needed: take a larger area"
        )
    if len(detected) > MAX_ANCHORS:
        raise RoadSourceError(
            f"the roads have {len(detected):,} intersections, at most {MAX_ANCHORS:,} are indexed in one piece:"
            " cut them up with `roadgeo index --shards auto`"
        )
    what = f"indexing {len(detected):,} intersections"
    say(what, 0.0)
    grid, shape = neighbour_grid(detected.xy, options.min_bucket_m)
    segments = _cut_segments(network.graph, options.simplify_m)
    finer = (*grid[:2], grid[2] / _FINER), (_FINER * shape[0], _FINER * shape[1])
    roads = bucket_roads(segments, *finer)
    say(what, 0.3)
    order, point_starts = sort_by_bucket(detected.xy, grid, shape)
    points = detected.xy[order], detected.branches()[order], detected.tangents[order]
    of_points = _of_points(*points, point_starts, grid, shape, options)

    meta = {
        **network.meta,
        "crs": network.plane.crs,
        "origin": list(network.plane.origin),
        "grid": list(grid),
        "shape": list(shape),
        "index_options": asdict(options),
        "n_intersections": len(detected),
        "n_segments": len(segments),
    }
    index = ReferenceIndex(
        meta=meta,
        segments=segments,
        segment_starts=roads.starts,
        segment_ids=roads.ids,
        source=order,
        **of_points,
    )
    for array in index.arrays().values():
        array.setflags(write=False)  # as in an index opened from a file: kernels are compiled once for both
    return index
