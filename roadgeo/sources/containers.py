"""Tables out of road files of every kind, part by part, so that a file of any size is read in a bounded memory.

The file's name determines its format: OpenStreetMap data through osmium, answers of Overpass, osmnx's `.graphml`,
(Geo)Parquet, and everything else that GDAL reads (GeoPackage, Shapefile, GeoJSON, FlatGeobuf, GPX, KML, DXF ...).
"""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from roadgeo._arrays import AnyArray
from roadgeo._text import listed
from roadgeo.errors import NoRoadsError, RoadSourceError
from roadgeo.sources.lines import OSM_ATTRIBUTION, RoadTable, line_through, objects
from roadgeo.sources.osm_files import ASK_LESS, GAVE_UP, OSM_ENDINGS, stream_ways
from roadgeo.sources.schemas import is_filled, is_known_column, names_kinds
from roadgeo.storage.memory import each_bounded
from roadgeo.storage.unpacking import read_chunks
from roadgeo.storage.vectors import (
    Description,
    beside,
    describe_layer,
    few_drivers,
    first_line,
    list_layers,
    read_layer,
)

__all__ = ["ENDINGS", "held_table", "overpass_table", "stream_tables", "what_is_missing"]

_PARQUET = (".parquet", ".geoparquet", ".pq")
_PARQUET_MAGIC = b"PAR1"
_GRAPHS = (".graphml",)
_GDAL = (
    ".gpkg", ".shp", ".geojson", ".geojsonl", ".geojsons", ".geojsonseq", ".ndjson", ".jsonl", ".topojson", ".fgb",
    ".gml", ".kml", ".kmz", ".gpx", ".sqlite", ".tab", ".mif", ".shz", ".dxf", ".gdb",
)  # fmt: skip
#: Names of road files.
ENDINGS = OSM_ENDINGS + _PARQUET + _GRAPHS + _GDAL

#: Layers to prefer where a file has several with lines, and files whose layers are parts of one drawing.
_LAYERS = ("roads", "edges", "lines", "entities", "elements")
_ONE_DRAWING = (".gpx", ".kml", ".kmz")
#: Drawings, whose layers GDAL gives as a column of one layer; and its names, in tables made of drawings too.
_DRAWINGS, _LEVELS = (".dxf", ".dgn", ".dwg"), ("layer", "level", "layername", "layer_name")
#: Names of columns that hold shapes in a table that declares none.
_SHAPES = ("geometry", "geom", "wkb_geometry", "wkb", "the_geom", "shape", "wkt")
_SRID, _HEX = re.compile(r"\s*SRID\s*=\s*(\d{1,9})\s*;", re.IGNORECASE), re.compile(r"[0-9A-Fa-f]{18,}")
_INIT = re.compile(r"\{'init': '(epsg:\d{1,9})'.*\}", re.IGNORECASE)  # a CRS as osmnx wrote it before 0.12
_PEEK = 1000
#: Notes that services write into an answer that is a part of the request: ArcGIS, WFS, OGC API - Features.
_MATCHED = re.compile(rb"\b(?:numberMatched|totalFeatures)\"?\s*[:=]\s*[\"']?(\d{1,12})")
_LIMITED = re.compile(
    rb"\"(exceededTransferLimit)\"\s*:\s*true|\"rel\"\s*:\s*\"next\"|<[\w:]*FeatureCollection\b[^<>]*\bnext\s*=\s*[\"']\w"
)
#: Formats of JSON, which may have a feature a line, and bytes before it; the name of an XML file's outermost element.
_BEFORE_JSON = b"\xef\xbb\xbf\x1e \t\r\n"
_JSON = (".geojsonl", ".geojsons", ".geojsonseq", ".ndjson", ".jsonl", ".json", ".geojson", ".topojson")
_ROOT, _HEAD_BYTES = re.compile(rb"(?s)(?:\xef\xbb\xbf)?\s*+(?:<[?!].*?>\s*+)*+<([\w:.-]+)"), 1 << 12
#: What servers and checkouts put in a file's place.
_IN_PLACE = re.compile(rb"(?i)\s*(?:(<!doctype html|<html\b)|version https://git-lfs)")
_ENDS_BYTES = 1 << 16  # of a file, where such a note stands
_TILES = "vector tiles, which cut roads at their borders and simplify them; give the data that they were made of"
#: Formats that are not read, and the way out for their users.
_ELSEWHERE = {
    **dict.fromkeys((".mbtiles", ".pmtiles", ".mvt"), _TILES),
    ".osc": "holds changes alone; apply them to their map (osmium apply-changes), and give that",
    **dict.fromkeys((".dwg", ".dgn"), "a drawing in a format that is not read; save it as DXF"),
    **dict.fromkeys((".xlsx", ".xls", ".ods"), "a spreadsheet; save it as CSV with a column of WKT, or as GeoPackage"),
    **dict.fromkeys((".xz", ".7z", ".rar", ".tar", ".tgz", ".zst"), "packed in a way that is not read; unpack it"),
}
_CURVES = "a column holds curves; expected lines: make some of them (ogr2ogr -nlt CONVERT_TO_LINEAR, ST_CurveToLine)"
_EXPECTED = (
    "expected a path, a GeoDataFrame, a GeoSeries, a table of pandas, polars or pyarrow with a column of WKB or WKT, "
    "a graph of osmnx or momepy, shapely lines, or arrays of coordinates of shape (N, 2)"
)


@each_bounded
def stream_tables(
    path: Path,
    layer: str | Sequence[str] | None,
    most: int,
    advance: Callable[[float], None],
    folder: Path,
    *,
    areas: bool = False,
) -> Iterator[RoadTable]:
    """Yield the content of a file in parts, of a bounded number of features each.

    Parameters
    ----------
    layer : str or sequence of str, optional
        Layers of a file, or of the drawing that it was made of; by default the one with lines, of GPX and KML all.
    advance : callable
        Called with the share of the file that is read.
    folder : Path
        For temporary files of the reading.
    areas : bool
        Polygons will do where there are no lines.

    Raises
    ------
    RoadSourceError
        The file is unreadable, or which of its layers is meant is not known.
    """
    name = path.name.lower()
    if why := _ELSEWHERE.get(path.suffix.lower()) or _what_is_wrong(path):
        raise RoadSourceError(f"{path}: {why}")
    asked = [layer] if isinstance(layer, str) else [*(layer or ())]
    if name.endswith(OSM_ENDINGS):
        tables = stream_ways(path, most, advance, folder)
    elif name.endswith(_GRAPHS):
        tables = iter([_read_graphml(path)])
    elif name.endswith(_PARQUET) or (path.is_file() and _ends(path, 4) == (_PARQUET_MAGIC,) * 2):
        tables = _stream_parquet(path, most, advance)
    elif name.endswith(".json") and (elements := _overpass_elements(path)) is not None:
        tables = iter([overpass_table(elements)])
    else:
        yield from _stream_gdal(path, asked, most, advance, areas=areas)
        return
    yield from tables if not asked else (_of_levels(path, table, asked) for table in tables)


def _of_levels(path: Path, table: RoadTable, asked: Sequence[str]) -> RoadTable:
    """Return what of a table is in layers of the drawing that it was made of."""
    column = next((name for name in table.columns if name.lower() in _LEVELS), None)
    if column is None:
        raise RoadSourceError(f"{path}: has no layers: leave --layer out, or read it by itself")
    rows = np.isin(table.columns[column].astype(str), asked)
    columns = {name: values[rows] for name, values in table.columns.items()}
    return replace(table, shapes=table.shapes[rows], columns=columns)


# --- GDAL -------------------------------------------------------------------------------------------------------------


class _Part(NamedTuple):
    """A layer of a file, or the rows in it that are in layers of a drawing, which a column names."""

    layer: str
    column: str = ""
    levels: tuple[str, ...] = ()


def _stream_gdal(
    path: Path, asked: Sequence[str], most: int, advance: Callable[[float], None], *, areas: bool
) -> Iterator[RoadTable]:
    import shapely

    with few_drivers():
        parts = _choose_parts(path, asked, areas=areas)
        held = [_describe(path, part.layer) for part in parts]
    for n, ((layer, column, levels), (said, columns, hint)) in enumerate(zip(parts, held, strict=True)):
        total = said.n_features
        part, more = what_is_missing(path, total), [column] * (column not in ("", *columns))
        layers, limit = ", ".join(levels or [one.layer for one in parts]), most if total > most else None
        for skip in range(0, max(total, 1), most):
            data = read_layer(path, layer, [*columns, *more], skip, limit)
            meta = {"format": said.driver, "layer": layers, **data.notes}
            if data.shapes is None or said.driver == "CSV":  # GDAL knows one name of a column of shapes
                yield _undeclared(path, layer, said, skip, limit, meta)
                continue
            if len(data.shapes) < min(most, total - skip):
                raise RoadSourceError(
                    f"{path}: is cut off: {skip + len(data.shapes):,} of {total:,} features are in it"
                )
            meta |= ({"part": part} if part else {}) | ({"levels": hint} if hint and not levels else {})
            shapes = np.asarray(shapely.from_wkb(data.shapes, on_invalid="ignore"))
            table = RoadTable(shapes, data.crs, dict(data.columns), meta)
            yield _of_levels(path, table, levels) if column else table
            advance((n + min((skip + most) / max(total, 1), 1.0)) / len(parts))


def _undeclared(
    path: Path, layer: str, said: Description, skip: int, most: int | None, meta: dict[str, Any]
) -> RoadTable:
    """Read a part of a layer without geometry, one of whose columns holds shapes."""
    data = read_layer(path, layer, said.columns, skip, most)
    columns = dict(data.columns)
    taken = _take_shapes(columns)
    if taken is None:
        raise NoRoadsError(f"{path}: layer {layer!r} has no geometry, nor a column of WKT or WKB; expected lines")
    if said.driver == "CSV" and len(taken[0]) and taken[0][-1] is None and _ends(path, 1)[1] not in b"\r\n":
        raise RoadSourceError(f"{path}: is cut off in its last line; copy or export it again")
    return RoadTable(taken[0], data.crs or taken[1] or None, columns, meta)


def _choose_parts(path: Path, asked: Sequence[str], *, areas: bool) -> list[_Part]:
    """Return what to read: the layers asked for, or those with lines (or with polygons, where they will do)."""
    layers = list_layers(path)
    names = [name for name, _ in layers]
    if asked and {*asked} <= {*names}:
        return [_Part(name) for name in asked]
    drawn = [name for name, kind in layers if kind in {"None", "Unknown"} or "Line" in kind or "Collection" in kind]
    if not drawn and areas:
        drawn = [name for name, kind in layers if "Polygon" in kind]
    if not drawn:
        kinds = sorted({kind for _, kind in layers}) or ["nothing"]
        raise NoRoadsError(f"{path}: holds {listed(kinds)}, expected lines: the centre lines of roads")
    if len(drawn) > 1:
        drawn = [name for name in drawn if _is_filled(path, name)] or drawn[:1]
    preferred = [name for name in _LAYERS if name in drawn]
    chosen = drawn if len(drawn) == 1 or path.name.lower().endswith(_ONE_DRAWING) else preferred[:1]
    is_drawing = path.name.lower().endswith(_DRAWINGS)
    column, levels = _levels(path, chosen[0], areas) if (asked or is_drawing) and len(chosen) == 1 else ("", [])
    if asked and {*asked} <= {*levels}:
        return [_Part(chosen[0], column, tuple(asked))]
    if asked:
        wrong = next(name for name in asked if name not in {*names, *levels})
        raise RoadSourceError(f"{path}: no layer {wrong!r}; it has {listed(names + levels)}: choose with --layer")
    if not chosen or len(levels) > 1:
        raise RoadSourceError(
            f"{path}: several layers hold lines, {listed(levels or drawn)}: choose with --layer, which is repeatable"
        )
    return [_Part(name) for name in chosen]


def _levels(path: Path, layer: str, areas: bool) -> tuple[str, list[str]]:
    """Return the column that names layers of a drawing, and those that hold lines (or polygons); "" without one."""
    import shapely

    column = next((name for name in describe_layer(path, layer).columns if name.lower() in _LEVELS), "")
    layer_read = read_layer(path, layer, [column]) if column else None
    if layer_read is None or layer_read.shapes is None:
        return "", []
    kinds = shapely.get_type_id(shapely.from_wkb(layer_read.shapes, on_invalid="ignore"))
    lines = np.isin(kinds, (1, 2, 5, 7, *((3, 6) if areas else ())))
    return column, _names_of(layer_read.columns[column.lower()][lines], path)


def _names_of(values: AnyArray, path: Path) -> list[str]:
    """Return the names of layers in a column; of other files than drawings no numbers: they give the drawing order."""
    named = {str(value) for value in values if value is not None}
    is_drawing = path.name.lower().endswith(_DRAWINGS)
    return sorted(name for name in named if is_drawing or not re.fullmatch(r"[-+]?[\d.]+|nan", name))


def _is_filled(path: Path, layer: str) -> bool:
    try:
        return describe_layer(path, layer).n_features > 0
    except RoadSourceError:  # a view, which is refused only if it is the one to read
        return True


def _describe(path: Path, layer: str) -> tuple[Description, list[str], str]:
    """Describe a layer, and choose its columns that may describe a road: by their names, else by their values.

    The third is which layers of a drawing its rows come from, for people; "" where this is unknown, or from one.
    """
    said = describe_layer(path, layer)
    fields = said.columns
    chosen = [name for name in fields if is_known_column(name)]
    if not fields or {"highway", "fclass"} & {name.lower() for name in chosen}:
        return said, chosen, ""
    head = read_layer(path, layer, fields, 0, _PEEK).columns
    column = next((name for name in fields if name.lower() in _LEVELS), "")
    levels = _names_of(head.get(column.lower(), np.empty(0, object)), path)
    hint = f"{column}: {listed(levels)}" if len(levels) > 1 else ""
    return said, chosen + [name for name in fields if name not in chosen and names_kinds(head[name.lower()])], hint


def _what_is_wrong(path: Path) -> str:
    """Return why a file is none: nothing, or another thing, came in its place, or it ends too early; "" of others."""
    if not path.is_file():
        return ""
    ending, size, (head, tail) = path.suffix.lower(), path.stat().st_size, _ends(path, _HEAD_BYTES)
    last = tail.rstrip()
    has_open_text = ending == ".csv" and sum(chunk.count(b'"') for chunk in read_chunks(path)) % 2 > 0
    if not head.strip():
        return "is empty; copy or export it again"
    if came := _IN_PLACE.match(head):
        return "is a web page; fetch the file itself" if came[1] else "is a pointer of Git LFS; fetch it (git lfs pull)"
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "is text in UTF-16; save it in UTF-8"
    if ending == ".shp" and _has_cut_table(path):
        return "its .dbf is cut off; copy or export it again"
    root = _ROOT.match(head) if ending in (".gml", ".gpx", ".kml") else None
    is_cut = (
        has_open_text
        or (ending == ".shp" and len(head) >= 28 and 2 * int.from_bytes(head[24:28], "big") > size)
        or (ending in _JSON and head.lstrip(_BEFORE_JSON)[:1] in (b"{", b"[") and not last.endswith((b"}", b"]")))
        or (ending == ".dxf" and not last.rstrip(b"\0").endswith(b"EOF"))
        or (root is not None and not last.endswith((b"</" + root[1] + b">", b"-->", b"/>")))
    )
    return f"is cut off after {size:,} bytes; copy or export it again" if is_cut else ""


def _has_cut_table(path: Path) -> bool:
    """Whether the .dbf beside a shapefile is shorter than its rows."""
    table = next((file for file in beside(path) if file.suffix.lower() == ".dbf"), None)
    if table is None:
        return False
    rows, start, wide = struct.unpack("<IHH", _ends(table, 12)[0][4:].ljust(8, b"\xff"))
    return bool(table.stat().st_size < start + rows * wide)


def _ends(path: Path, n: int) -> tuple[bytes, bytes]:
    """Return how a file begins and how it ends, n bytes each."""
    with path.open("rb") as file:
        first = file.read(n)
        file.seek(max(path.stat().st_size - n, 0))
        return first, file.read()


def what_is_missing(path: Path, n_features: int) -> str:
    """Return the note of a service's answer on features that it left out: "" where it is whole, or has no note."""
    ending = path.suffix.lower()
    if ending not in (".json", ".geojson", ".gml"):
        return ""
    first, last = _ends(path, _ENDS_BYTES)
    text = first if ending == ".gml" else first + last
    matched = max((int(match[1]) for match in _MATCHED.finditer(text)), default=0)
    limited = _LIMITED.search(text)
    if matched > n_features:
        return f"says that it is not whole: {n_features:,} of {matched:,} features; fetch the rest"
    if limited and not matched:
        word = (limited[1] or b"next").decode()
        return f"says that it is not whole ({word}): {n_features:,} features, and there are more; fetch the rest"
    return ""


# --- Parquet ----------------------------------------------------------------------------------------------------------


def _stream_parquet(path: Path, most: int, advance: Callable[[float], None]) -> Iterator[RoadTable]:
    """Stream Parquet by batches of its row groups, with or without the metadata of GeoParquet."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    with pq.ParquetFile(path) as file:
        _require_rows(file.metadata.num_rows, path.stat().st_size)
        own, names = _declared(file.schema_arrow), file.schema_arrow.names
        leaves = [file.schema.column(n) for n in range(len(file.schema.names))]
    if own and any(map(is_known_column, names)):
        names = [name for name in names if name == own[0] or is_known_column(name) or name.lower() in _LEVELS]
    text = [leaf.path for leaf in leaves if leaf.physical_type == "BYTE_ARRAY"]
    done = 0
    with pq.ParquetFile(path, read_dictionary=text) as file:
        for batch in file.iter_batches(most, columns=names):
            yield replace(_arrow_table(pa.Table.from_batches([batch])), meta={"format": "Parquet"})
            done += len(batch)
            advance(done / file.metadata.num_rows)


def _require_rows(rows: int, size: int) -> None:
    """Raise `ValueError` where a file claims more rows than bytes: each would be looked at."""
    if rows > size:
        raise ValueError(f"its {size:,} bytes claim to hold {rows:,} rows")


def _declared(schema: Any) -> tuple[str, Any, str] | None:
    """Return the geometry column that a table of Arrow's or of Parquet declares, its CRS and its encoding; or None."""
    stored = schema.metadata or {}
    if b"geo" in stored:
        geo = json.loads(stored[b"geo"])
        column = geo["columns"][geo["primary_column"]]
        return geo["primary_column"], column.get("crs", "EPSG:4326"), str(column.get("encoding"))
    for field in schema:
        extension = field.metadata or {}
        named = extension.get(b"ARROW:extension:name", b"").decode() or getattr(field.type, "extension_name", "")
        if named.startswith(("geoarrow.", "ogc.")):
            about = json.loads(extension.get(b"ARROW:extension:metadata") or "{}")
            return field.name, about.get("crs"), named.split(".")[1]
    return None


def _read_shapes(values: Sequence[Any]) -> tuple[AnyArray, int]:
    """Return shapes of WKB, also in hexadecimal digits, or WKT, of PostGIS too, and the number of their CRS, or 0."""
    import shapely

    first = next((value for value in values if value is not None), b"")
    is_text = isinstance(first, str) and not _HEX.fullmatch(first[:64])
    stated = _SRID.match(str(first)) if is_text else None
    try:
        if is_text:
            texts = [value and _SRID.sub("", value) for value in values]
            return np.asarray(shapely.from_wkt(texts, on_invalid="ignore")), int(stated[1]) if stated else 0
        packed = [bytes(value) if isinstance(value, bytearray | memoryview) else value for value in values]
        shapes = np.asarray(shapely.from_wkb(packed, on_invalid="ignore"))
    except NotImplementedError as error:
        raise RoadSourceError(_CURVES) from error
    return shapes, max(0, *shapely.get_srid(shapes).tolist()) if len(shapes) else 0


def _shapes(batch: Any, column: str, encoding: str) -> tuple[AnyArray, int]:
    """Return the shapes of a table of Arrow's, and the number of their CRS, or 0."""
    import geopandas as gpd
    import pyarrow as pa

    if encoding.upper() in ("WKB", "WKT"):
        return _read_shapes(batch[column].to_pylist())
    named = pa.field(column, batch.schema.field(column).type, metadata={"ARROW:extension:name": f"geoarrow.{encoding}"})
    table = pa.Table.from_arrays([batch[column]], schema=pa.schema([named]))
    return np.asarray(gpd.GeoDataFrame.from_arrow(table, geometry=column).geometry.to_numpy()), 0


# --- graphs, and answers of Overpass ----------------------------------------------------------------------------------


def _read_graphml(path: Path) -> RoadTable:
    """Read a street network that osmnx saved."""
    import networkx as nx

    table = _graph_table(nx.read_graphml(path))
    return RoadTable(table.shapes, table.crs, table.columns, {"format": "GraphML", "attribution": OSM_ATTRIBUTION})


def held_table(roads: Any) -> RoadTable:
    """Return a program's object as a table: of geopandas, pandas or Arrow, a graph, shapely lines, arrays.

    Raises
    ------
    RoadSourceError
        It is something else.
    """
    try:
        return _held(roads)
    except (TypeError, ValueError, LookupError, RuntimeError) as error:
        raise RoadSourceError(
            f"roads of type {type(roads).__name__} cannot be read: {first_line(error)}; {_EXPECTED}"
        ) from error


def _held(roads: Any) -> RoadTable:
    import shapely

    if hasattr(roads, "edges") and hasattr(roads, "graph"):  # networkx
        return _graph_table(roads)
    if hasattr(roads, "__arrow_c_stream__") and not hasattr(roads, "iloc"):  # polars, pyarrow, DuckDB ...
        return _arrow_table(roads)
    if hasattr(roads, "columns") and hasattr(roads, "iloc"):  # pandas
        return _held_columns(roads)
    is_single = isinstance(roads, shapely.Geometry) or (isinstance(roads, np.ndarray) and roads.ndim == 2)
    listed = [roads] if is_single else list(roads)
    shapes = [shape if shape is None or isinstance(shape, shapely.Geometry) else _line(shape) for shape in listed]
    return RoadTable(objects(shapes), getattr(roads, "crs", None))


def _arrow_table(roads: Any) -> RoadTable:
    """Return what any library hands over as Arrow does."""
    import pyarrow as pa

    table = pa.table(roads)
    own, crs, encoding = _declared(table.schema) or ("", None, "")
    shapes, srid = _shapes(table, own, encoding) if own else (np.empty(0, object), 0)
    columns = {name: objects(table[name].to_pylist()) for name in table.column_names if name != own}
    return RoadTable(shapes, crs or srid or None, columns) if own else _of_values(columns)


def _held_columns(roads: Any) -> RoadTable:
    """Return a table of geopandas, or of pandas with a column of shapes, as `pd.merge` gives it, or of WKB or WKT."""
    import shapely

    columns = {str(name): roads[name].to_numpy(object) for name in roads.columns}
    held = [name for name, values in columns.items() if shapely.is_geometry(values).any()]
    active = getattr(getattr(roads, "geometry", None), "name", None)
    name = active if active in held or (active and not len(roads)) else next(iter(held), None)
    if name is not None:
        shapes = objects(shape if isinstance(shape, shapely.Geometry) else None for shape in columns.pop(name))
        return RoadTable(shapes, getattr(roads, "crs", None), columns)
    return _of_values(columns)


def _of_values(columns: dict[str, AnyArray]) -> RoadTable:
    """Return a table of which a column, by its values, holds WKB or WKT."""
    taken = _take_shapes(columns)
    if taken is None:
        raise ValueError("it declares no geometry column, and none holds WKB or WKT")
    return RoadTable(taken[0], taken[1] or None, columns)


def _take_shapes(columns: dict[str, AnyArray]) -> tuple[AnyArray, int] | None:
    """Take the column that holds WKB or WKT out of others: its shapes, and the number of their CRS, or 0; else None."""
    for name in sorted(columns, key=lambda name: name.lower() not in _SHAPES):
        first = next((value for value in columns[name] if is_filled(value)), None)
        if isinstance(first, bytes | bytearray | memoryview | str) and _read_shapes([first])[0][0] is not None:
            return _read_shapes([value if is_filled(value) else None for value in columns.pop(name)])
    return None


def _line(coordinates: Any) -> Any:
    points = np.asarray(coordinates, np.float64)
    if points.ndim != 2 or points.shape[1] not in (2, 3):
        raise ValueError(f"coordinates of shape {points.shape}")
    return line_through(points)


def _graph_table(graph: Any) -> RoadTable:
    """Return the edges of a networkx graph as a table: of osmnx, momepy, or with `geometry` or nodes that have x and y.

    Raises
    ------
    RoadSourceError
        Its edges and nodes have no coordinates.
    """
    import shapely

    shapes, rows = [], []
    for start, end, data in graph.edges(data=True):
        shape = data.get("geometry")
        if isinstance(shape, str):
            shape = shapely.from_wkt(shape, on_invalid="ignore")
        if not isinstance(shape, shapely.Geometry):
            ends = [_node_place(graph, node) for node in (start, end)]
            if None in ends:
                raise RoadSourceError(
                    "the edges of the graph have no place: expected `geometry`, or nodes with `x` and "
                    "`y`, as osmnx and momepy have them; of a skeleton of pixels locate the mask that it was drawn from"
                )
            shape = shapely.LineString(ends)
        shapes.append(shape)
        rows.append(data)
    crs = graph.graph.get("crs")
    old = _INIT.fullmatch(crs) if isinstance(crs, str) else None
    return RoadTable(objects(shapes), old[1] if old else crs, _columns(rows))


def _columns(rows: Sequence[Mapping[Any, Any]]) -> dict[str, AnyArray]:
    """Return the columns of rows of attributes that may describe a road."""
    names = [name for name in dict.fromkeys(name for row in rows for name in row) if is_known_column(str(name))]
    return {str(name): objects(row.get(name) for row in rows) for name in names}


def _node_place(graph: Any, node: Any) -> tuple[float, float] | None:
    data = graph.nodes[node]
    place = (data["x"], data["y"]) if {"x", "y"} <= data.keys() else node
    try:
        x, y = map(float, place if isinstance(place, tuple) else ())
    except (TypeError, ValueError):
        return None
    return x, y


def _overpass_elements(path: Path) -> list[Any] | None:
    """Return the elements of an answer of Overpass as JSON; None: it is another file."""
    if b'"elements"' not in _ends(path, _ENDS_BYTES)[0]:
        return None
    answer = json.loads(path.read_bytes())
    elements = answer.get("elements") if isinstance(answer, dict) else None
    if elements is not None and answer.get("remark"):
        raise RoadSourceError(f"{path}: {GAVE_UP}: {str(answer['remark'])[:200].strip(' .')}; {ASK_LESS}")
    return elements if isinstance(elements, list) else None


def overpass_table(elements: Sequence[Any]) -> RoadTable:
    """Return the ways with a `highway` tag, whose places stand in them or in nodes anywhere; some may be missing."""
    mappings = [element for element in elements if isinstance(element, Mapping)]
    nodes = {node["id"]: node for node in mappings if node.get("type") == "node" and isinstance(node.get("id"), int)}
    shapes: list[Any] = []
    tags: list[Mapping[str, Any]] = []
    for way in mappings:
        own = way.get("tags")
        if way.get("type") != "way" or not isinstance(own, Mapping) or "highway" not in own:
            continue
        try:
            ends = way.get("geometry") or [nodes.get(node) for node in way.get("nodes") or ()]
            places = [(float(end["lon"]), float(end["lat"])) if end else (np.nan, np.nan) for end in ends]
        except (LookupError, TypeError, ValueError, OverflowError):
            places = []
        shapes.append(line_through(np.reshape(places, (-1, 2))))
        tags.append(own)
    lost = {"without_places": shapes.count(None)} if None in shapes else {}
    meta = {"format": "OpenStreetMap", "attribution": OSM_ATTRIBUTION}
    return RoadTable(objects(shapes), "EPSG:4326", _columns(tags), meta | lost)
