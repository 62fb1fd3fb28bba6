"""OGC GeoPackages, written and read with sqlite3 alone: no geopandas, no pyogrio, so that `locate` starts fast.

Version 1.3 (QGIS 3.22 warns about newer ones), with spatial indexes and QGIS styles. A file appears
whole or not at all.
"""

from __future__ import annotations

import os
import sqlite3
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from roadgeo._arrays import AnyArray, FloatArray
from roadgeo.errors import CrsError, IndexFormatError, OutputError
from roadgeo.storage.crs import known_crs
from roadgeo.storage.files import replacing
from roadgeo.storage.geopackage_sql import RTREE_TRIGGERS, SCHEMA, STYLES_SCHEMA
from roadgeo.storage.memory import bounded
from roadgeo.storage.sqlite import opened, table_problem

__all__ = [
    "PIXELS",
    "FeatureTable",
    "GeometryType",
    "add_layers",
    "dump_layers",
    "layer_names",
    "open_read_only",
    "read_layer",
    "require_tables",
    "write_layers",
]

GeometryType = Literal["POINT", "LINESTRING", "POLYGON", "MULTIPOLYGON"]

#: The `crs` of layers that lie nowhere on Earth: pixel coordinates. GeoPackage calls it undefined Cartesian, srs_id -1.
PIXELS = ""

_WKB_TYPES = {"POINT": 1, "LINESTRING": 2, "POLYGON": 3, "MULTIPOLYGON": 6}
_CUSTOM_SRS_ID = 100_000  # for a CRS without an EPSG code; one such CRS per layer is numbered upwards from here
_SQL_TYPES = {"b": "BOOLEAN", "i": "INTEGER", "u": "INTEGER", "f": "REAL"}  # by numpy's kinds
_HEADER = struct.Struct("<4si4d")  # magic, version and flags; srs_id; envelope min x, max x, min y, max y
_ENVELOPE_BYTES = {0: 0, 1: 32, 2: 48, 3: 48, 4: 64}


@dataclass(frozen=True)
class FeatureTable:
    """One table. Dimension: N features.

    Attributes
    ----------
    geometry_type : {"POINT", "LINESTRING", "POLYGON", "MULTIPOLYGON"} or None
        None: a table without geometry.
    geometries : sequence of N float64 arrays
        POINT: (N, 2) array. LINESTRING: (V, 2) vertices each. POLYGON: one ring (V, 2) each, closed here if it is open.
        MULTIPOLYGON: a sequence of such rings each.
    columns : mapping of name to N values
        Numpy arrays or lists; integers, floats (NaN becomes NULL), booleans, or text (None becomes NULL).
    crs : str
        Anything pyproj understands ("EPSG:32619", WKT2), or `PIXELS`.
    style : str
        QML: how QGIS draws the layer when it opens it. Empty: QGIS chooses.
    indexed : bool
        Whether the layer has a spatial index; the index takes about as long to write as the rows.
    """

    name: str
    geometry_type: GeometryType | None = None
    geometries: Sequence[Any] | FloatArray = ()
    columns: Mapping[str, Sequence[Any] | AnyArray] = field(default_factory=dict)
    crs: str = PIXELS
    style: str = ""
    description: str = ""
    indexed: bool = True


def write_layers(path: str | os.PathLike[str], layers: Sequence[FeatureTable]) -> None:
    """Write a new GeoPackage, replacing what stood there in one step.

    Raises
    ------
    CrsError
        A layer's CRS is unknown.
    OutputError
        The file cannot be written.
    """
    with replacing(path) as temporary:
        dump_layers(temporary, layers)


def dump_layers(path: Path, layers: Sequence[FeatureTable]) -> None:
    """Write a new GeoPackage as it comes: for files that are staged already.

    Raises
    ------
    CrsError
        A layer's CRS is unknown.
    OSError
        The file cannot be written.
    """
    try:
        # Made in memory and written at once: on disk, SQLite writes page by page, many of them several times.
        with closing(sqlite3.connect(":memory:")) as database:
            add_layers(database, layers)
            content = database.serialize()
    except sqlite3.Error as error:
        raise OutputError(f"cannot make a GeoPackage: {error}; please report it") from error
    path.write_bytes(content)


def add_layers(
    database: sqlite3.Connection, layers: Sequence[FeatureTable], advance: Callable[[float], None] = lambda _: None
) -> None:
    """Make a GeoPackage of an empty database: for writers that add tables of their own to it.

    `advance` receives the share of the rows that is written.

    Raises
    ------
    CrsError
        A layer's CRS is unknown.
    sqlite3.Error
        The file cannot be written.
    """
    srs_ids, n_rows = _srs_ids(layers), [max(map(len, layer.columns.values()), default=0) for layer in layers]
    database.executescript(f"PRAGMA journal_mode = OFF; PRAGMA synchronous = OFF; {SCHEMA}")
    for crs, srs_id in srs_ids.items():
        if crs != PIXELS:
            name, code, definition = _describe_crs(crs)
            organization = "NONE" if code is None else "EPSG"
            entry = (name, srs_id, organization, srs_id, definition)
            database.execute("INSERT OR IGNORE INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, '')", entry)
    for n, layer in enumerate(layers):
        advance(sum(n_rows[:n]) / max(sum(n_rows), 1))
        _add_layer(database, layer, srs_ids.get(layer.crs, 0))
    if styled := [(layer.name, layer.name, layer.style) for layer in layers if layer.style]:
        database.executescript(STYLES_SCHEMA)
        database.executemany(
            "INSERT INTO layer_styles (f_table_catalog, f_table_schema, f_table_name, f_geometry_column, styleName,"
            " styleQML, styleSLD, useAsDefault, description, owner) VALUES ('', '', ?, 'geom', ?, ?, '', 1, '', '')",
            styled,
        )
    database.commit()


def layer_names(path: str | os.PathLike[str]) -> list[str]:
    """Names of the tables in a GeoPackage, features and attributes.

    Raises
    ------
    IndexFormatError
        No such file, or no GeoPackage.
    """
    with open_read_only(path) as database:
        require_tables(database, path, "gpkg_contents")
        return [name for (name,) in database.execute("SELECT table_name FROM gpkg_contents ORDER BY rowid")]


def read_layer(path: str | os.PathLike[str], name: str) -> tuple[list[FloatArray], dict[str, list[Any]]]:
    """Read the geometries ((2,) points, (V, 2) lines or outer rings) and columns of one table, in the order of its ids.

    The first column is the table's primary key. A table without geometry gives an empty list.

    Raises
    ------
    IndexFormatError
        No such file or table, or a geometry that `write_layers` would not write.
    """
    with open_read_only(path) as database:
        require_tables(database, path, name, "gpkg_geometry_columns")
        columns = database.execute("SELECT name, pk FROM pragma_table_info(?)", (name,)).fetchall()
        key = next((column for column, primary in columns if primary), "rowid")
        rows = database.execute(f"SELECT * FROM {_quoted(name)} ORDER BY {_quoted(key)}").fetchall()
        geometry_column = database.execute(
            "SELECT column_name FROM gpkg_geometry_columns WHERE table_name = ?", (name,)
        ).fetchall()
    table = {column: [row[i] for row in rows] for i, (column, _) in enumerate(columns)}
    if not geometry_column:
        return [], table
    if geometry_column[0][0] not in table:
        raise IndexFormatError(f"{path}: layer '{name}' lacks its column of geometries; make the file again")
    return [_decode(blob, path, name) for blob in table.pop(geometry_column[0][0])], table


def require_tables(database: sqlite3.Connection, path: str | os.PathLike[str], *names: str) -> None:
    """Raise `IndexFormatError` unless all names are tables that hold what they give."""
    for name in names:
        problem = table_problem(database, name)
        if problem:
            raise IndexFormatError(
                f"{path} cannot be used: {problem}; it is no complete file of roadgeo: make it again"
            )


@contextmanager
def open_read_only(path: str | os.PathLike[str]) -> Iterator[sqlite3.Connection]:
    """Open a GeoPackage for queries; whatever SQLite finds wrong in the block is an `IndexFormatError`.

    Raises
    ------
    IndexFormatError
        No such file, or no GeoPackage.
    """
    source = Path(path)
    if not source.is_file():
        raise IndexFormatError(f"no such file: {source}; give the path of a .gpkg file")
    try:
        with bounded(source, IndexFormatError), opened(source) as database:
            yield database
    except sqlite3.Error as error:
        raise IndexFormatError(f"{source} is no readable GeoPackage ({error}); make it again") from error


# --- writing ----------------------------------------------------------------------------------------------------------


def _srs_ids(layers: Sequence[FeatureTable]) -> dict[str, int]:
    """Return a number for each CRS: its EPSG code, else upwards from `_CUSTOM_SRS_ID`."""
    used = dict.fromkeys(["EPSG:4326", *(layer.crs for layer in layers if layer.geometry_type)])
    codes = {crs: -1 if crs == PIXELS else _describe_crs(crs)[1] for crs in used}
    return {crs: _CUSTOM_SRS_ID + n if code is None else code for n, (crs, code) in enumerate(codes.items())}


@lru_cache(maxsize=32)
def _describe_crs(crs: str) -> tuple[str, int | None, str]:
    """Name, EPSG code and WKT 1 (the dialect that the standard asks for)."""
    import pyproj

    try:
        parsed = known_crs(crs)
        return parsed.name, parsed.to_epsg(min_confidence=100), parsed.to_wkt("WKT1_GDAL")
    except pyproj.exceptions.CRSError as error:
        raise CrsError(f"unknown CRS {crs[:60]!r}; give an EPSG code such as EPSG:32619") from error


def _add_layer(database: sqlite3.Connection, layer: FeatureTable, srs_id: int) -> None:
    """Make the table of a layer with its rows, and with its spatial index."""
    kind, types = layer.geometry_type, {name: _sql_type(values) for name, values in layer.columns.items()}
    declared = ["fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL"]
    declared += [f"geom {kind}"] if kind else []
    declared += [f"{_quoted(name)} {sql_type}" for name, sql_type in types.items()]
    database.execute(f"CREATE TABLE {_quoted(layer.name)} ({', '.join(declared)})")
    values: list[Sequence[Any]] = [_sql_values(column, types[name]) for name, column in layer.columns.items()]
    extent: list[float | None] = [None] * 4
    bounds = np.empty((0, 4))
    if kind:
        blobs, bounds = _encode(kind, layer.geometries, srs_id)
        values.insert(0, blobs)
    if len(bounds):
        extent = [*bounds[:, [0, 2]].min(axis=0).tolist(), *bounds[:, [1, 3]].max(axis=0).tolist()]
    if values:
        marks = ", ".join("?" * (len(values) + 1))
        rows = zip(range(1, len(values[0]) + 1), *values, strict=True)
        database.executemany(f"INSERT INTO {_quoted(layer.name)} VALUES ({marks})", rows)
    database.execute(
        "INSERT INTO gpkg_contents (table_name, data_type, identifier, description, srs_id, min_x, min_y, max_x, max_y)"
        " VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
        (layer.name, "features" if kind else "attributes", layer.name, layer.description, srs_id, *extent),
    )
    if kind:
        entry = (layer.name, kind, srs_id)
        database.execute("INSERT INTO gpkg_geometry_columns VALUES (?, 'geom', ?, ?, 0, 0)", entry)
    if kind and layer.indexed:
        _add_index(database, layer.name, bounds)


def _add_index(database: sqlite3.Connection, name: str, bounds: FloatArray) -> None:
    """Index the rows of a layer by their (N, 4) bounds."""
    try:
        database.execute(f'CREATE VIRTUAL TABLE "rtree_{name}_geom" USING rtree(id, minx, maxx, miny, maxy)')
    except sqlite3.OperationalError:
        return  # without SQLite's rtree module the file is as valid, only slower to pan over
    database.execute(
        "INSERT INTO gpkg_extensions VALUES (?, 'geom', 'gpkg_rtree_index',"
        " 'http://www.geopackage.org/spec120/#extension_rtree', 'write-only')",
        (name,),
    )
    boxes = zip(range(1, len(bounds) + 1), *bounds.T.tolist(), strict=True)
    database.executemany(f'INSERT INTO "rtree_{name}_geom" VALUES (?, ?, ?, ?, ?)', boxes)
    database.executescript(RTREE_TRIGGERS.format(t=name))


def _sql_type(values: Sequence[Any] | AnyArray) -> str:
    if isinstance(values, np.ndarray) and values.dtype.kind in _SQL_TYPES:  # it knows its type even when empty
        return _SQL_TYPES[values.dtype.kind]
    kinds = {type(value) for value in values if value is not None}
    if kinds <= {bool} and kinds:
        return "BOOLEAN"
    if kinds <= {bool, int} and kinds:
        return "INTEGER"
    return "REAL" if kinds <= {bool, int, float} and kinds else "TEXT"


def _sql_values(values: Sequence[Any] | AnyArray, sql_type: str) -> list[Any]:
    """Return the plain Python values of one column."""
    plain = values.tolist() if isinstance(values, np.ndarray) else list(values)
    if sql_type == "REAL":
        return [None if value != value else value for value in plain]  # NaN differs from itself
    return plain


def _encode(kind: GeometryType, geometries: Sequence[Any] | FloatArray, srs_id: int) -> tuple[list[bytes], FloatArray]:
    """GeoPackage blobs, and (N, 4) bounds min x, max x, min y, max y."""
    if not len(geometries):
        return [], np.empty((0, 4))
    if kind == "MULTIPOLYGON":
        return _encode_multipolygons(geometries, srs_id)
    arrays = [xy.reshape(-1, 2) for xy in (np.asarray(vertices, "<f8") for vertices in geometries)]
    if kind == "POLYGON":
        arrays = [xy if np.array_equal(xy[0], xy[-1]) else np.vstack([xy, xy[:1]]) for xy in arrays]
    coords = np.concatenate(arrays)
    stops = np.cumsum([len(xy) for xy in arrays]).tolist()
    starts = [0, *stops[:-1]]
    bounds = np.stack([np.minimum.reduceat(coords, starts), np.maximum.reduceat(coords, starts)], axis=2).reshape(-1, 4)
    raw, n_counts = coords.tobytes(), ("POINT", "LINESTRING", "POLYGON").index(kind)  # rings, vertices
    head = struct.Struct("<BI" + n_counts * "I")
    blobs = [
        (_HEADER.pack(b"GP\0\3", srs_id, *box) if n_counts else struct.pack("<4si", b"GP\0\1", srs_id))
        + head.pack(1, _WKB_TYPES[kind], *(1, stop - start)[2 - n_counts :])
        + raw[16 * start : 16 * stop]
        for start, stop, box in zip(starts, stops, bounds.tolist(), strict=True)
    ]
    return blobs, bounds


def _encode_multipolygons(geometries: Sequence[Any] | FloatArray, srs_id: int) -> tuple[list[bytes], FloatArray]:
    """Do as `_encode`; a geometry is a sequence of outer rings."""
    header = _HEADER.size
    blobs, bounds = [], []
    for rings in geometries:
        parts, boxes = _encode("POLYGON", rings, srs_id)
        box = [*boxes[:, [0, 2]].min(axis=0), *boxes[:, [1, 3]].max(axis=0)]
        bounds.append([box[0], box[2], box[1], box[3]])
        count = struct.pack("<BII", 1, _WKB_TYPES["MULTIPOLYGON"], len(parts))
        blobs.append(
            b"".join([_HEADER.pack(b"GP\0\3", srs_id, *bounds[-1]), count, *(part[header:] for part in parts)])
        )
    return blobs, np.array(bounds)


# --- reading ----------------------------------------------------------------------------------------------------------


def _decode(blob: bytes, path: str | os.PathLike[str], layer: str) -> FloatArray:
    """Vertices of a point, line or outer ring, little-endian or big-endian, with or without an envelope."""
    try:
        flags = blob[3]
        start = 8 + _ENVELOPE_BYTES[(flags >> 1) & 7]
        order = "<" if blob[start] else ">"
        (kind,) = struct.unpack_from(f"{order}I", blob, start + 1)
        if kind == 1:
            return np.frombuffer(blob, f"{order}f8", 2, start + 5).astype(float)
        at = start + {2: 5, 3: 9}[kind]
        (count,) = struct.unpack_from(f"{order}I", blob, at)
        return np.frombuffer(blob, f"{order}f8", 2 * count, at + 4).astype(float).reshape(-1, 2)
    except (IndexError, KeyError, TypeError, ValueError, struct.error) as error:
        raise IndexFormatError(
            f"{path}: layer '{layer}' holds a geometry that is no point, line or polygon; make the file again"
        ) from error


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"'
