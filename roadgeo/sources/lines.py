"""Lines out of road files of every kind, as they stand in the file.

Formats are told by the file's name: OpenStreetMap data (`.osm.pbf`, `.osm`, `.osm.gz`, `.osm.bz2`) through osmium,
osmnx's `.graphml`, GeoParquet, and everything else that GDAL reads (GeoPackage, Shapefile, GeoJSON, FlatGeobuf, ...).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from roadgeo._arrays import AnyArray, BoolArray
from roadgeo.errors import RoadSourceError
from roadgeo.roads.kinds import in_tunnel, names_highways
from roadgeo.sources.crs_guard import refuse_named_files
from roadgeo.sources.pbf import osm_head, osm_parts
from roadgeo.sources.vectors import first_line, list_layers, read_layer, require_file
from roadgeo.storage.crs import known_crs

__all__ = [
    "COLUMNS",
    "GRAPH_ENDINGS",
    "OSM_ATTRIBUTION",
    "OSM_ENDINGS",
    "PARQUET_ENDINGS",
    "RoadLines",
    "choose_layer",
    "crs_name",
    "from_columns",
    "from_frame",
    "geometry_columns",
    "join_lines",
    "list_sources",
    "read_lines",
    "reading",
    "require_rows",
    "simple_lines",
    "stream_osm",
    "table_lines",
]

OSM_ATTRIBUTION = "© OpenStreetMap contributors, ODbL 1.0"

OSM_ENDINGS = (".osm.pbf", ".pbf", ".osm", ".osm.gz", ".osm.bz2", ".osm.xml")
PARQUET_ENDINGS = (".parquet", ".geoparquet")
GRAPH_ENDINGS = (".graphml",)
_OTHER = (".gpkg", ".shp", ".geojson", ".geojsonl", ".fgb", ".gml", ".kml", ".sqlite", ".tab", ".mif", ".shz")

#: A compressed file may unpack to so many bytes, and beyond them to so many times its size.
_UNPACKED_FREE, _UNPACKED_TIMES = 64 << 20, 100

#: Columns that may say what kind of road a line is: OpenStreetMap's, Geofabrik's, Overture's.
KIND_COLUMNS = ("highway", "fclass", "class")
TUNNEL_COLUMNS = ("tunnel", "road_flags")
#: What a street is called: OpenStreetMap's and Geofabrik's, those of two American makers of maps.
_NAME_COLUMNS = ("name", "street_name", "fullname")
COLUMNS = KIND_COLUMNS + TUNNEL_COLUMNS + _NAME_COLUMNS

#: Layers to prefer where a file has several with lines.
_LAYERS = ("roads", "edges", "lines")


@dataclass(frozen=True)
class RoadLines:
    """Lines of one source. Dimension: L lines.

    Attributes
    ----------
    lines : (L,) object
        Shapely LineStrings, 2-D, finite, not empty, in the source's CRS.
    crs : str or None
        "EPSG:n" or WKT; None where the source does not say.
    highway : (L,) object or None
        Values of `highway` or the like; None where the source has no such column.
    tunnel : (L,) bool or None
        Runs in a tunnel.
    meta : dict
        Provenance: plain values.
    name : (L,) object or None
        What the streets are called, text or None; to look at.
    """

    lines: AnyArray
    crs: str | None
    highway: AnyArray | None = None
    tunnel: BoolArray | None = None
    meta: dict[str, Any] = field(default_factory=dict)
    name: AnyArray | None = None


def list_sources(path: Path) -> list[Path]:
    """Return the road files of a folder (not of folders in it), by name, or the path itself.

    Raises
    ------
    RoadSourceError
        Nothing is there, or a folder holds no road file.
    """
    if not path.exists():
        raise RoadSourceError(f"{path}: no such file or folder")
    if not path.is_dir() or path.suffix.lower() == ".gdb":
        return [path]
    found = sorted(
        file
        for file in path.iterdir()
        if file.name.lower().endswith(OSM_ENDINGS + PARQUET_ENDINGS + GRAPH_ENDINGS + _OTHER)
    )
    if not found:
        raise RoadSourceError(f"{path}: no road file in this folder; expected names like *.gpkg, *.shp or *.osm.pbf")
    return found


def read_lines(path: Path, layer: str | None = None, advance: Callable[[float], None] = lambda _: None) -> RoadLines:
    """Read all lines of a road file.

    Parameters
    ----------
    path : Path
    layer : str, optional
        Of a file with several; the one with lines by default.
    advance : callable, optional
        Told which share of a PBF file is read.

    Raises
    ------
    RoadSourceError
        The file is missing, unreadable, empty or holds no lines.
    """
    with reading(path):
        read = _read(path, layer, advance)
    if len(read.lines) == 0:
        raise RoadSourceError(f"{path}: no lines in it, expected the centre lines of roads")
    return read


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn what goes wrong with a road file into a `RoadSourceError`."""
    from pyproj.exceptions import ProjError
    from shapely.errors import ShapelyError

    require_file(path)
    try:
        yield
    except (ProjError, ShapelyError, RuntimeError, ValueError, LookupError, ArithmeticError, OSError) as error:
        # Many libraries read such files, and what a damaged one makes them raise is theirs to know.
        raise RoadSourceError(f"{path}: damaged, or not what its name says: {first_line(error)}") from error


def _read(path: Path, layer: str | None, advance: Callable[[float], None]) -> RoadLines:
    name = path.name.lower()
    if name.endswith(OSM_ENDINGS):
        return _read_osm(path, advance)
    if name.endswith(GRAPH_ENDINGS):
        return _read_graphml(path)
    return _read_parquet(path) if name.endswith(PARQUET_ENDINGS) else _read_gdal(path, layer)


def _read_osm(path: Path, advance: Callable[[float], None]) -> RoadLines:
    """Read the ways with a `highway` tag of an OpenStreetMap file."""
    return join_lines(list(stream_osm(path, None, advance)))


def stream_osm(
    path: Path, most: int | None, advance: Callable[[float], None], places: str = "flex_mem"
) -> Iterator[RoadLines]:
    """Yield the ways with a `highway` tag, at most so many at a time; `places` is osmium's index of the nodes."""
    import osmium

    factory = osmium.geom.WKBFactory()
    ways: list[tuple[str, str, str | None, str | None]] = []
    broken = 0
    try:
        _refuse_bomb(path)
        with osmium.io.Reader(osm_head(path), osmium.osm.NOTHING) as reader:
            header = reader.header()
            timestamp = header.get("osmosis_replication_timestamp") or header.get("timestamp") or None
        for way in _highways(path, advance, places):
            tags = way.tags
            if tags.get("area") == "yes":
                continue
            shape = _way_shape(way, factory)
            if shape is None:
                broken += 1
                continue
            ways.append((shape, tags["highway"], tags.get("tunnel"), tags.get("name") or tags.get("ref")))
            if len(ways) == most:
                yield _from_ways(ways, broken, timestamp)
                ways, broken = [], 0
    except (RuntimeError, OSError, ValueError, osmium.InvalidLocationError) as error:
        raise RoadSourceError(f"{path}: not readable as OpenStreetMap data: {first_line(error)}") from error
    yield _from_ways(ways, broken, timestamp)


def _from_ways(
    ways: Sequence[tuple[str, str, str | None, str | None]], broken: int, timestamp: str | None
) -> RoadLines:
    """Make lines of ways (hexadecimal WKB, `highway`, `tunnel`, name)."""
    import shapely

    shapes, highway, tunnel, called = np.array(ways, object).reshape(-1, 4).T
    lines, place = simple_lines(shapely.from_wkb(shapes))
    meta = {"format": "OpenStreetMap", "features": len(ways) + broken, "attribution": OSM_ATTRIBUTION}
    if timestamp:
        meta["osm_timestamp"] = timestamp
    return RoadLines(lines, "EPSG:4326", highway[place], in_tunnel(tunnel)[place], meta, called[place])


def join_lines(parts: Sequence[RoadLines]) -> RoadLines:
    """Put parts of one source together."""
    if len(parts) == 1:
        return parts[0]
    first = parts[0]
    highway = None if first.highway is None else np.concatenate([one.highway for one in parts])
    tunnel = None if first.tunnel is None else np.concatenate([one.tunnel for one in parts])
    called = None if first.name is None else np.concatenate([one.name for one in parts])
    meta = {**first.meta, "features": sum(one.meta["features"] for one in parts)}
    return RoadLines(np.concatenate([one.lines for one in parts]), first.crs, highway, tunnel, meta, called)


def _refuse_bomb(path: Path) -> None:
    """Refuse a compressed file that unpacks to far more than any map: XML shrinks to a tenth, hardly to a fiftieth."""
    import bz2
    import gzip
    import zlib

    suffix = path.name.lower()[-4:]
    opener: Any = gzip.open if suffix.endswith(".gz") else bz2.open if suffix == ".bz2" else None
    if opener is None:
        return
    left = _UNPACKED_FREE + _UNPACKED_TIMES * path.stat().st_size
    try:
        with opener(path) as file:
            while left >= 0 and (part := file.read(1 << 20)):
                left -= len(part)
    except (EOFError, zlib.error) as error:
        raise RuntimeError("it is cut off or damaged") from error
    if left < 0:
        times = f"{_UNPACKED_TIMES} times its size"
        raise RoadSourceError(f"{path}: unpacks to more than {times}; unpack it yourself if you trust it")


def _highways(path: Path, advance: Callable[[float], None], index: str) -> Iterator[Any]:
    """Yield the ways with a `highway` tag, which know where their nodes are."""
    import osmium

    pool = osmium.io.ThreadPool()
    places = osmium.NodeLocationsForWays(osmium.index.create_map(index))
    places.ignore_errors()
    wanted = osmium.filter.EntityFilter(osmium.osm.WAY), osmium.filter.KeyFilter("highway")
    for part, share in osm_parts(path):
        with osmium.io.Reader(part, osmium.osm.NODE | osmium.osm.WAY, thread_pool=pool) as reader:
            yield from osmium.OsmFileIterator(reader, places, *wanted)
        advance(share)


def _way_shape(way: Any, factory: Any) -> str | None:
    """Return a way as hexadecimal WKB; of a way cut off by an extract, the part whose nodes are there."""
    import osmium
    import shapely

    try:
        return str(factory.create_linestring(way))
    except (RuntimeError, osmium.InvalidLocationError):  # fewer than two different nodes, or nodes outside
        known = [(node.lon, node.lat) for node in way.nodes if node.location.valid()]
        return shapely.to_wkb(shapely.LineString(known), hex=True) if len(set(known)) > 1 else None


def _read_graphml(path: Path) -> RoadLines:
    """Read a street network that osmnx saved."""
    import xml.etree.ElementTree as ET

    import networkx as nx
    import osmnx as ox

    refuse_named_files(path)
    try:
        graph = ox.load_graphml(path)
        edges = ox.graph_to_gdfs(graph, nodes=False, fill_edge_geometry=True)
    except (ET.ParseError, nx.NetworkXError, KeyError, ValueError, TypeError, AttributeError) as error:
        raise RoadSourceError(f"{path}: not a street network saved by osmnx: {first_line(error)}") from error
    columns = {name: edges[name].to_numpy(object) for name in edges.columns if name in COLUMNS}
    meta = {"format": "GraphML", "attribution": OSM_ATTRIBUTION}
    return from_columns(edges.geometry.to_numpy(), crs_name(edges.crs), columns, meta)


def _read_parquet(path: Path) -> RoadLines:
    """Read GeoParquet, Overture's transportation segments included."""
    import geopandas as gpd
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        names = pq.read_schema(path).names
        refuse_named_files(path)
        require_rows(path)
        wanted = [name for name in (*COLUMNS, "subtype") if name in names]
        geometry = geometry_columns(path)
        return from_frame(gpd.read_parquet(path, columns=geometry[:1] + wanted), wanted)
    except (ValueError, TypeError, pa.ArrowException, OSError) as error:  # of its text, only when that is looked at
        raise RoadSourceError(f"{path}: not readable as GeoParquet: {first_line(error)}") from error


def from_frame(frame: Any, wanted: Sequence[str]) -> RoadLines:
    """Make lines of a table of GeoParquet."""
    meta = {"format": "GeoParquet"}
    if "subtype" in frame:  # Overture keeps railways and waterways among its segments
        frame = frame[frame["subtype"] == "road"]
        meta["attribution"] = "© OpenStreetMap contributors, Overture Maps Foundation, ODbL 1.0"
    columns = {name: frame[name].to_numpy(object) for name in wanted if name != "subtype"}
    if "road_flags" in columns:
        columns["road_flags"] = _overture_flags(columns["road_flags"])
    return from_columns(frame.geometry.to_numpy(), crs_name(frame.crs), columns, meta)


def require_rows(path: Path) -> None:
    """Refuse what says to hold more rows than bytes: a few bytes may stand for billions of equal rows."""
    import pyarrow.parquet as pq

    meta = pq.read_metadata(path)
    unpacked = sum(meta.row_group(i).total_byte_size for i in range(meta.num_row_groups))
    size = path.stat().st_size
    if meta.num_rows > size or unpacked > _UNPACKED_FREE + _UNPACKED_TIMES * size:
        raise ValueError(f"its {size:,} bytes say to hold {meta.num_rows:,} rows and {unpacked:,} bytes")


def geometry_columns(path: Path) -> list[str]:
    """Return the geometry columns of a GeoParquet file, the primary one first."""
    import json

    import pyarrow.parquet as pq

    stored = pq.read_schema(path).metadata or {}
    if b"geo" not in stored:
        raise ValueError("it says nothing of a geometry column")
    return [json.loads(stored[b"geo"])["primary_column"]]


def _overture_flags(values: AnyArray) -> AnyArray:
    """Keep the flags that hold for a whole segment, as text."""
    flags = np.empty(len(values), object)
    for i, rules in enumerate(values):
        whole = [rule for rule in (rules if rules is not None else ()) if rule.get("between") is None]
        flags[i] = ";".join(str(flag) for rule in whole for flag in rule.get("values") or ()) or None
    return flags


def _read_gdal(path: Path, layer: str | None) -> RoadLines:
    """Read what GDAL reads as lines."""
    import shapely

    layer = choose_layer(path, layer)
    found = read_layer(path, layer, COLUMNS)
    if found.shapes is None:
        raise RoadSourceError(f"{path}: layer {layer!r} has no geometry, expected lines")
    shapes = shapely.from_wkb(found.shapes, on_invalid="ignore")
    return from_columns(shapes, crs_name(found.crs), found.columns, {"format": found.driver, "layer": layer})


def choose_layer(path: Path, layer: str | None) -> str:
    """Return the layer to read: the one asked for, or the one with lines."""
    layers = list_layers(path)
    names = [name for name, _ in layers]
    if layer is not None:
        if layer not in names:
            raise RoadSourceError(f"{path}: no layer {layer!r}; it has {_listed(names)}: choose with --layer")
        return layer
    drawn = [name for name, kind in layers if kind in {"None", "Unknown"} or "Line" in kind or "Collection" in kind]
    if not drawn:
        kinds = sorted({kind for _, kind in layers}) or ["nothing"]
        raise RoadSourceError(f"{path}: holds {_listed(kinds)}, expected lines: the centre lines of roads")
    chosen = [name for name in _LAYERS if name in drawn] or drawn
    if len(drawn) > 1 and chosen == drawn:
        raise RoadSourceError(f"{path}: several layers hold lines, {_listed(drawn)}: choose one with --layer")
    return chosen[0]


def table_lines(table: Any, name: str) -> RoadLines:
    """Return the lines of a GeoDataFrame."""
    known = [column for column in table.columns if str(column).lower() in COLUMNS]
    columns = {str(column).lower(): table[column].to_numpy(object) for column in known}
    return from_columns(table.geometry.to_numpy(), crs_name(table.crs), columns, {"name": name})


def from_columns(shapes: AnyArray, crs: str | None, columns: dict[str, AnyArray], meta: dict[str, Any]) -> RoadLines:
    """Keep the lines and what is known about each."""
    lines, place = simple_lines(shapes)
    kinds = [columns[name] for name in KIND_COLUMNS if name in columns and names_highways(columns[name])]
    tunnels = [in_tunnel(columns[name])[place] for name in TUNNEL_COLUMNS if name in columns]
    called = [columns[name][place] for name in _NAME_COLUMNS if name in columns]
    return RoadLines(
        lines,
        crs,
        kinds[0][place] if kinds else None,
        np.logical_or.reduce(tunnels) if tunnels else None,
        {"features": len(shapes), **meta},
        called[0] if called else None,
    )


def simple_lines(shapes: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Return the 2-D LineStrings in any shapes, and the shape that each came from.

    Missing, empty and infinite ones are left out, and so is what is no line.
    """
    import shapely

    parts, place = shapely.get_parts(np.asarray(shapes, object), return_index=True)
    while np.isin(shapely.get_type_id(parts), (5, 7)).any():  # collections may hold collections
        parts, inner = shapely.get_parts(parts, return_index=True)
        place = place[inner]
    kept = np.isin(shapely.get_type_id(parts), (1, 2)) & ~shapely.is_empty(parts)
    lines = shapely.force_2d(parts[kept])
    bounds = shapely.bounds(lines)
    finite = np.isfinite(bounds).all(axis=1)
    return lines[finite], place[kept][finite]


def crs_name(crs: Any) -> str | None:
    """Return a CRS as "EPSG:n" or WKT2; None where there is none, or one that is bound to no place on Earth."""
    if crs is None:
        return None
    from pyproj.exceptions import CRSError

    try:
        known = known_crs(crs)
    except CRSError:
        return None
    known = known.to_2d() if len(known.axis_info) == 3 else known
    if not (known.is_geographic or known.is_projected):
        return None
    code = known.to_epsg(min_confidence=100)
    return f"EPSG:{code}" if code else known.to_wkt("WKT2_2019")


def _listed(names: Sequence[str]) -> str:
    """Join names for a message, at most eight."""
    shown = ", ".join(names[:8])
    return shown if len(names) <= 8 else f"{shown} and {len(names) - 8} more"
