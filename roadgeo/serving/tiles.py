"""The roads of references as vector tiles (Mapbox Vector Tile 2), made when they are asked for."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from roadgeo._arrays import AnyArray, FloatArray
from roadgeo.errors import RoadSourceError
from roadgeo.geometry.areas import Box
from roadgeo.geometry.projection import from_lonlat, to_lonlat, transform
from roadgeo.matching.index import ReferenceIndex
from roadgeo.outputs.drawing.svg import join_segments
from roadgeo.reference.opening import AnyReference
from roadgeo.reference.shards import ShardedReference
from roadgeo.storage.vectors import read_layer

if TYPE_CHECKING:
    from shapely import STRtree

__all__ = ["MAX_ZOOM", "Tiles", "street_at"]

#: Beyond this zoom maps enlarge its tiles: a pixel is then 0.6 m at the equator.
MAX_ZOOM = 15
_EXTENT = 4096
_WORLD_M = 2 * 20037508.342789244
#: Shards that one tile is made of, and segments that it holds: the roads of a whole country are a grey field anyway.
_MOST_SHARDS, _MOST_SEGMENTS = 16, 60_000
#: Streets of a map whose names are shown.
_MOST_STREETS = 200_000
#: A street farther from a place lends it no name, metres of web maps.
_NAMED_WITHIN_M = 500.0
#: Steps of a tile's side to which its roads are rounded where it shows more than a town.
_COARSE = 512


class Tiles:
    """The tiles of all references."""

    def __init__(self, references: Sequence[AnyReference]) -> None:
        self._references = list(references)
        self.tile = lru_cache(maxsize=512)(self._tile)

    def describe(self) -> list[dict[str, Any]]:
        """Return each reference's name, its bounds in degrees, and whom its licence asks to name."""
        return [
            {"name": reference.name, "bounds": list(_bounds(reference)), "attribution": _attribution(reference)}
            for reference in self._references
        ]

    def _tile(self, number: int, zoom: int, column: int, row: int) -> bytes:
        """Return one tile of the reference of a number; empty where there is no road.

        Raises
        ------
        KeyError
            There is no such reference, or no such tile.
        """
        inside = 0 <= zoom <= MAX_ZOOM and 0 <= column < 2**zoom and 0 <= row < 2**zoom
        if not (inside and 0 <= number < len(self._references)):
            raise KeyError(f"{number}/{zoom}/{column}/{row}")
        reference = self._references[number]
        side = _WORLD_M / 2**zoom
        west, north = column * side - _WORLD_M / 2, _WORLD_M / 2 - row * side
        corners = np.array([(west - side / 32, north - side * 33 / 32), (west + side * 33 / 32, north + side / 32)])
        box = to_lonlat("EPSG:3857", corners)
        (box_west, box_south), (box_east, box_north) = box.tolist()
        indexes = _indexes(reference, (box_west, box_south, box_east, box_north), zoom)
        ends = np.concatenate([np.empty((0, 2, 2)), *map(partial(_on_web, box=box), indexes)])
        to_tile = _EXTENT / side * np.array([1.0, -1.0])
        streets = [] if zoom < MAX_ZOOM else [street for index in indexes for street in _named(index.path, corners)]
        named = [((line - (west, north)) * to_tile, name) for line, name in streets]
        return _encode(_draw((ends - (west, north)) * to_tile, zoom), named)


def _indexes(reference: AnyReference, box: Box, zoom: int) -> list[ReferenceIndex]:
    """Return the maps that show a box; from afar the coarse one, where there is one."""
    if not isinstance(reference, ShardedReference):
        return [reference.index]
    if zoom < 11 and reference.coarse is not None:
        return [reference.coarse.open()]
    here = [shard for shard in reference.shards if shard.touches(box)]
    return [shard.open() for shard in here[:_MOST_SHARDS]]


def _segments(index: ReferenceIndex, box: FloatArray) -> AnyArray:
    """Return the segments (S, 4) in the buckets that a box of degrees touches."""
    roads = index.road_buckets
    (x0, y0, size), (columns, rows) = roads.grid, roads.shape
    (west, south), (east, north) = box
    across, along = np.linspace(west, east, 5), np.linspace(south, north, 5)
    around = from_lonlat(index.plane, np.stack(np.meshgrid(across, along), axis=-1).reshape(-1, 2))
    around = around[np.isfinite(around).all(axis=1)]
    if len(around) == 0:
        return index.segments[:0]
    low, high = (np.floor((edge - (x0, y0)) / size) for edge in (around.min(axis=0), around.max(axis=0)))
    if (high < 0).any() or (low >= (columns, rows)).any():
        return index.segments[:0]
    left, bottom = np.clip(low, 0, (columns - 1, rows - 1)).astype(int)
    right, top = np.clip(high, 0, (columns - 1, rows - 1)).astype(int)
    if (right - left + 1) * (top - bottom + 1) > 0.5 * columns * rows:
        return index.segments
    starts, ids = index.segment_starts, index.segment_ids
    lines = columns * np.arange(bottom, top + 1)
    parts = [ids[starts[line + left] : starts[line + right + 1]] for line in lines]
    return np.asarray(index.segments[np.unique(np.concatenate(parts))])


def _on_web(index: ReferenceIndex, box: FloatArray) -> FloatArray:
    """Return the ends (S, 2, 2) of a map's segments near a box, in the CRS of web maps."""
    ends = _segments(index, box).reshape(-1, 2, 2)
    return transform(index.plane.crs, "EPSG:3857", index.plane.to_crs(ends))


def _draw(ends: FloatArray, zoom: int) -> list[FloatArray]:
    """Return segments (S, 2, 2) of a tile as lines of whole numbers, as many as it can hold."""
    margin = _EXTENT / 32
    high, low = ends.max(axis=1), ends.min(axis=1)
    ends = ends[
        np.isfinite(ends).all(axis=(1, 2)) & (high > -margin).all(axis=1) & (low < _EXTENT + margin).all(axis=1)
    ]
    step = 1 if zoom > 12 else _EXTENT // _COARSE
    drawn = np.rint(ends / step) * step
    drawn = drawn[(drawn[:, 0] != drawn[:, 1]).any(axis=1)]
    if step > 1 and len(drawn):  # coinciding points are drawn once
        turned = (drawn[:, 0] > drawn[:, 1]).any(axis=1) & (drawn[:, 0, 0] >= drawn[:, 1, 0])
        alike = np.where(turned[:, None, None], drawn[:, ::-1], drawn).reshape(-1, 4)
        _, first = np.unique(alike @ (1.0, 1e4, 1e8, 1e12), return_index=True)
        drawn = drawn[np.sort(first)]
    if len(drawn) > _MOST_SEGMENTS:
        longest = np.argsort(-np.abs(drawn[:, 1] - drawn[:, 0]).sum(axis=1), kind="stable")[:_MOST_SEGMENTS]
        drawn = drawn[np.sort(longest)]
    return join_segments(drawn)


def _named(path: str, box: FloatArray) -> list[tuple[FloatArray, str]]:
    """Return the lines (V, 2) of the streets that a box touches, in the CRS of web maps, each with its name."""
    import shapely

    tree, names = _streets(path)
    inside = tree.query(shapely.box(*box.ravel()))
    lines = shapely.clip_by_rect(tree.geometries[inside], *box.ravel())
    parts, owner = shapely.get_parts(lines, return_index=True)
    pairs = zip(parts, names[inside][owner], strict=True)
    return [(shapely.get_coordinates(line), str(name)) for line, name in pairs if not shapely.is_empty(line)]


def street_at(indexes: Sequence[ReferenceIndex], lonlat: tuple[float, float]) -> str:
    """Return the name of the street of some maps that is nearest to a place; "" where none is near."""
    import shapely

    spot = shapely.Point(transform("EPSG:4326", "EPSG:3857", np.array([lonlat]))[0])
    for tree, names in (_streets(index.path) for index in indexes):
        nearest = tree.query_nearest(spot, max_distance=_NAMED_WITHIN_M, all_matches=False)
        if len(nearest):
            return str(names[nearest[0]])
    return ""


@lru_cache(maxsize=_MOST_SHARDS)
def _streets(path: str) -> tuple[STRtree, AnyArray]:
    """Read the streets of a map that have a name, from the file beside its index; none where that is not there."""
    import shapely

    try:
        layer = read_layer(Path(path), "roads", ["name"], most=_MOST_STREETS)
    except RoadSourceError:  # shards from elsewhere come without
        return shapely.STRtree([]), np.empty(0, object)
    shapes = np.empty(0, object) if layer.shapes is None else layer.shapes
    names = layer.columns.get("name", np.empty(len(shapes), object))
    has_name = np.array([bool(name) for name in names], bool)
    lines = shapely.from_wkb(shapes[has_name])
    on_web = shapely.transform(lines, partial(transform, str(layer.crs), "EPSG:3857"))
    return shapely.STRtree(on_web), names[has_name]


def _encode(lines: list[FloatArray], named: list[tuple[FloatArray, str]]) -> bytes:
    import shapely
    from mapbox_vector_tile import encode

    if not lines:
        return b""
    roads = shapely.multilinestrings([shapely.linestrings(line) for line in lines])
    streets = [{"geometry": shapely.linestrings(line), "properties": {"name": name}} for line, name in named]
    layers = [{"name": "roads", "features": [{"geometry": roads, "properties": {}}]}]
    if streets:
        layers.append({"name": "streets", "features": streets})
    tile: bytes = encode(layers, default_options={"extents": _EXTENT, "y_coord_down": True})
    return tile


def _bounds(reference: AnyReference) -> tuple[float, ...]:
    """West, south, east and north of a map, degrees."""
    if isinstance(reference, ShardedReference):
        grounds = np.array([shard.entry.ground for shard in reference.shards] or [(0.0, 0.0, 0.0, 0.0)])
        edges = [*grounds[:, :2].min(axis=0), *grounds[:, 2:].max(axis=0)]
    else:
        low, high = reference.index.bounds
        corners = np.array([(x, y) for x in (low[0], high[0]) for y in (low[1], high[1])])
        lonlat = to_lonlat(reference.index.plane.crs, reference.index.plane.to_crs(corners))
        edges = [*lonlat.min(axis=0), *lonlat.max(axis=0)]
    return tuple(float(edge) if math.isfinite(edge) else 0.0 for edge in edges)


def _attribution(reference: AnyReference) -> str:
    meta = reference.manifest.meta if isinstance(reference, ShardedReference) else reference.index.meta
    return str(meta.get("attribution") or "")
