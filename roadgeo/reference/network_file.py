"""A road network as an OGC GeoPackage: `REF.gpkg`, styled for QGIS, and back.

Layers: `intersections` (the input of the index), `tangents` (short lines, to look at), `roads` (the noded
network), `coverage` (where the map knows roads at all), and the table `roadgeo_meta`: JSON values by key, the
program's own under `roadgeo.`. Angles are stored in degrees, counterclockwise from east.
"""

from __future__ import annotations

import errno
import json
import math
import os
import sqlite3
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from hashlib import blake2b
from pathlib import Path
from typing import Any, Literal

import numpy as np

from roadgeo._arrays import AnyArray, Float32Array, FloatArray
from roadgeo._progress import Say, say_nothing
from roadgeo._version import __version__
from roadgeo.errors import IndexFormatError
from roadgeo.geometry.frame import polygon_area
from roadgeo.geometry.projection import LocalPlane
from roadgeo.roads.graph import RoadGraph
from roadgeo.roads.intersections import MAX_BRANCHES, Intersections
from roadgeo.roads.network import RoadNetwork
from roadgeo.storage.geopackage import FeatureTable, add_layers, open_read_only, read_layer, require_tables
from roadgeo.storage.qml import draw_fill, draw_line, draw_marker, name_features, seen_from, widen_by

__all__ = [
    "computed_digest",
    "network_digest",
    "not_a_reference",
    "read_meta",
    "read_network",
    "stored_digest",
    "write_network",
]

SCHEMA = "roadgeo.reference/1"

_TANGENT_LINE_M = 30.0

#: Scales from which points and names are drawn in QGIS; before, they would hide the roads.
_INTERSECTIONS_FROM, _NAMES_FROM = 50_000, 12_000

#: Roads are drawn the wider the more they carry; unknown kinds are drawn like streets.
_WIDTHS_MM = {
    0.9: ("motorway", "trunk", "primary"),
    0.6: ("secondary", "tertiary", "motorway_link", "trunk_link", "primary_link"),
    0.2: ("service", "track", "footway", "path", "cycleway", "steps", "pedestrian"),
}
_ROADS_STYLE = name_features(
    widen_by(draw_line("84,110,122", 0.35), "highway", _WIDTHS_MM, 0.35), "name", "55,71,79", _NAMES_FROM
)
_RAYS = [f"ray{i}_deg" for i in range(1, MAX_BRANCHES + 1)]
_TANGENTS = [f"tangent{i}_deg" for i in range(1, MAX_BRANCHES + 1)]
_NO_NODE = -1

_ALIASES = {
    "intersections": {
        "branches": "Branches (N_B)",
        "tangents": "Distinct tangents (N_q)",
        "residual_m": "Fit residual (m)",
        "node": "Node of the road network",
        **{name: f"Branch {i}, degrees from east" for i, name in enumerate(_RAYS, 1)},
        **{name: f"Tangent {i}, degrees from east" for i, name in enumerate(_TANGENTS, 1)},
    },
    "tangents": {"intersection": "Intersection", "angle_deg": "Degrees from east"},
    "roads": {
        "from_node": "From node",
        "to_node": "To node",
        "length_m": "Length (m)",
        "name": "Name",
        "highway": "Kind (OpenStreetMap's highway)",
    },
    "coverage": {"area_km2": "Area (km²)"},
}

# Any edit of `intersections`, by whatever program, voids the stored digest: so a reader need not go through all rows to
# know that they are as they were written. Styles, and edits of other layers, leave it alone.
_TRIGGERS = {f"roadgeo_intersections_{event.lower()}": event for event in ("INSERT", "UPDATE", "DELETE")}
_TRIGGER = """
CREATE TRIGGER {name} AFTER {event} ON intersections
BEGIN
  UPDATE roadgeo_meta SET value = 'null' WHERE key = 'roadgeo.digest' AND value <> 'null';
END;
"""

# The standard's metadata extension (clause 2.4): GDAL and QGIS show it as the file's provenance.
_METADATA_SCHEMA = """
CREATE TABLE gpkg_metadata (
    id INTEGER CONSTRAINT m_pk PRIMARY KEY ASC NOT NULL, md_scope TEXT NOT NULL DEFAULT 'dataset',
    md_standard_uri TEXT NOT NULL, mime_type TEXT NOT NULL DEFAULT 'text/xml', metadata TEXT NOT NULL DEFAULT '');
CREATE TABLE gpkg_metadata_reference (
    reference_scope TEXT NOT NULL, table_name TEXT, column_name TEXT, row_id_value INTEGER,
    timestamp DATETIME NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')), md_file_id INTEGER NOT NULL,
    md_parent_id INTEGER, CONSTRAINT crmr_mfi_fk FOREIGN KEY (md_file_id) REFERENCES gpkg_metadata(id),
    CONSTRAINT crmr_mpi_fk FOREIGN KEY (md_parent_id) REFERENCES gpkg_metadata(id));
INSERT INTO gpkg_extensions VALUES
    ('gpkg_metadata', NULL, 'gpkg_metadata', 'http://www.geopackage.org/spec121/#extension_metadata', 'read-write'),
    ('gpkg_metadata_reference', NULL, 'gpkg_metadata', 'http://www.geopackage.org/spec121/#extension_metadata',
     'read-write');
"""


def write_network(path: Path, network: RoadNetwork, say: Say = say_nothing) -> None:
    """Write a network to a new file in place, for callers that stage it (see `storage.files.replacing`).

    Raises
    ------
    OSError
        The disk is full, the folder is missing or not writable.
    CrsError
        The plane's CRS is unknown.
    """
    meta = _stored_meta(network)
    layers = []
    for layer in _map_layers(network):
        aliases = {name: alias for name, alias in _ALIASES[layer.name].items() if name in layer.columns}
        layers.append(replace(layer, style=_with_aliases(layer.style, aliases)))
    layers.append(
        FeatureTable(
            "roadgeo_meta",
            columns={"key": list(meta), "value": [_to_json(value) for value in meta.values()]},
            description="What roadgeo knows about this reference, JSON by key",
        )
    )
    try:
        with closing(sqlite3.connect(path)) as database:
            add_layers(database, layers, lambda share: say(f"writing {path.name}", share))
            database.executescript(
                "".join(_TRIGGER.format(name=name, event=event) for name, event in _TRIGGERS.items())
            )
            _add_metadata(database, network.meta)
            database.commit()
    except sqlite3.Error as error:
        full = error.sqlite_errorcode == sqlite3.SQLITE_FULL
        raise OSError(errno.ENOSPC if full else errno.EIO, str(error)) from error


def read_network(path: str | os.PathLike[str]) -> RoadNetwork:
    """Read what `write_network` wrote, possibly edited since: a node that has lost all its roads has no place (NaN).

    Raises
    ------
    IndexFormatError
        When the file is missing, is no reference, or its layers contradict each other.
    """
    meta = read_meta(path)
    plane = _plane(path, meta)
    rings, _ = _read_shapes(path, "coverage", "ring")
    graph, table = _read_graph(path, plane, meta.get("roadgeo.nodes"))
    return RoadNetwork(
        graph=graph,
        intersections=_read_intersections(path, plane),
        plane=plane,
        coverage=tuple(plane.from_crs(ring) for ring in rings),
        meta={key: value for key, value in meta.items() if not key.startswith("roadgeo.")},
        names=_texts(table, "name"),
        kinds=_texts(table, "highway"),
    )


def not_a_reference(path: str | os.PathLike[str]) -> IndexFormatError:
    """Return the error for another kind of file, roads perhaps: it explains how to build a reference of them."""
    reference = Path(path).with_name(f"{Path(path).name.split('.')[0]}_reference.gpkg")
    return IndexFormatError(
        f"{os.fspath(path)} is no reference; if it holds roads, build one: "
        f"`roadgeo index --roads {os.fspath(path)} --out {reference}`, then locate with `-r {reference}`"
    )


def read_meta(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read the table `roadgeo_meta`: values by key, the program's own under `roadgeo.`.

    Raises
    ------
    IndexFormatError
        When the file is missing or is no reference.
    """
    with open_read_only(path) as database:
        if not database.execute("SELECT 1 FROM sqlite_master WHERE name = 'roadgeo_meta'").fetchall():
            raise not_a_reference(path)
        require_tables(database, path, "roadgeo_meta")
        rows = database.execute("SELECT key, value FROM roadgeo_meta").fetchall()
    try:
        meta = {str(key): json.loads(value) for key, value in rows}
    except (TypeError, ValueError, RecursionError) as error:
        raise IndexFormatError(
            f"{path}: its table roadgeo_meta holds a value that is no JSON; make the file again"
        ) from error
    if meta.get("roadgeo.schema") != SCHEMA:
        raise IndexFormatError(
            f"{path} has schema {meta.get('roadgeo.schema')!r}, expected {SCHEMA!r}: make it again with `roadgeo index`"
        )
    return meta


def network_digest(network: RoadNetwork) -> str:
    """Digest of the content of `intersections`: equal for a network and its GeoPackage, whatever their bytes."""
    detected = network.intersections
    hasher = blake2b(digest_size=16)
    for array in (network.plane.to_crs(detected.xy), detected.rays, detected.tangents, detected.residual):
        # Two NaNs, and two zeros, may differ in their bits.
        hasher.update(np.ascontiguousarray(np.where(np.isnan(array), np.nan, array) + 0.0, "<f8").data)
    return hasher.hexdigest()


def stored_digest(path: str | os.PathLike[str]) -> str:
    """Digest of a GeoPackage's intersections: the stored one while it holds, else computed.

    Raises
    ------
    IndexFormatError
        When the file is missing or is no reference.
    """
    with open_read_only(path) as database:
        guards = database.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall()
    meta = read_meta(path)
    digest = meta.get("roadgeo.digest")
    if isinstance(digest, str) and {name for (name,) in guards} >= _TRIGGERS.keys():
        return digest
    return computed_digest(path)


def computed_digest(path: str | os.PathLike[str]) -> str:
    """Digest of a GeoPackage's intersections as they are now.

    Raises
    ------
    IndexFormatError
        When the file is missing or is no reference.
    """
    plane = _plane(path, read_meta(path))
    empty = RoadGraph.from_polylines(np.empty((0, 2)), np.empty((0, 2), np.int32), [])
    return network_digest(RoadNetwork(empty, _read_intersections(path, plane), plane))


# --- writing ----------------------------------------------------------------------------------------------------------


def _map_layers(network: RoadNetwork) -> list[FeatureTable]:
    """Layers in the order in which they are drawn, the lowest first."""
    graph, detected, plane = network.graph, network.intersections, network.plane
    # Each: name, kind of geometry, geometries, columns, CRS, style, description.
    return [
        FeatureTable(
            "coverage",
            "POLYGON",
            [plane.to_crs(ring) for ring in network.coverage],
            {"area_km2": [polygon_area(ring) / 1e6 for ring in network.coverage]},
            plane.crs,
            draw_fill("120,144,156,18", "120,144,156", 0.4),
            "Where the map knows roads at all",
        ),
        FeatureTable(
            "roads",
            "LINESTRING",
            np.split(plane.to_crs(graph.coords), graph.offsets[1:-1]) if graph.n_edges else [],
            {
                "from_node": graph.edges[:, 0],
                "to_node": graph.edges[:, 1],
                "length_m": graph.edge_lengths(),
                **_labels(network),
            },
            plane.crs,
            _ROADS_STYLE,
            "Roads noded at every crossing, as a mask shows them",
        ),
        _tangent_layer(detected, plane),
        FeatureTable(
            "intersections",
            "POINT",
            plane.to_crs(detected.xy),
            {
                "branches": detected.n_branches,
                "tangents": detected.n_tangents,
                "residual_m": detected.residual.astype(float),
                "node": detected.node,
                **dict(zip(_RAYS, np.degrees(detected.rays.astype(float)).T, strict=True)),
                **dict(zip(_TANGENTS, np.degrees(detected.tangents.astype(float)).T, strict=True)),
            },
            plane.crs,
            seen_from(draw_marker("228,87,46", 1.6), _INTERSECTIONS_FROM),
            "Road intersections with their branches and tangents: what the index is built from",
        ),
    ]


def _labels(network: RoadNetwork) -> dict[str, list[str | None]]:
    """Columns of names and kinds of the streets as far as any are known; text, or NULL."""
    columns = {"name": network.names, "highway": network.kinds}
    return {
        key: [text or None for text in column.tolist()]
        for key, column in columns.items()
        if column is not None and any(column)
    }


def _tangent_layer(intersections: Intersections, plane: LocalPlane) -> FeatureTable:
    """Draw each tangent as a short line through its intersection."""
    row, column = np.nonzero(np.isfinite(intersections.tangents))
    angle = intersections.tangents[row, column].astype(float)
    half = 0.5 * _TANGENT_LINE_M * np.column_stack([np.cos(angle), np.sin(angle)])
    centre = plane.to_crs(intersections.xy[row])
    return FeatureTable(
        "tangents",
        "LINESTRING",
        list(np.stack([centre - half, centre + half], axis=1)),
        {"intersection": row + 1, "angle_deg": np.degrees(angle)},
        plane.crs,
        draw_line("242,166,90", 0.25),
        f"Tangents of the intersections, {_TANGENT_LINE_M:.0f} m of each",
        indexed=False,  # to look at, at a few intersections
    )


def _stored_meta(network: RoadNetwork) -> dict[str, Any]:
    return {
        **network.meta,
        "roadgeo.schema": SCHEMA,
        "roadgeo.version": __version__,
        "roadgeo.crs": network.plane.crs,
        "roadgeo.origin": [float(value) for value in network.plane.origin],
        "roadgeo.nodes": network.graph.n_nodes,
        "roadgeo.digest": network_digest(network),
    }


def _to_json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False)


def _add_metadata(database: sqlite3.Connection, meta: Mapping[str, Any]) -> None:
    """Store the provenance where any GeoPackage program looks for it."""
    database.executescript(_METADATA_SCHEMA)
    texts = [("text/plain", str(meta["attribution"]))] if meta.get("attribution") else []
    texts.append(("application/json", _to_json({"program": f"roadgeo {__version__}", **meta})))
    for number, (mime_type, text) in enumerate(texts, 1):
        database.execute(
            "INSERT INTO gpkg_metadata VALUES (?, 'dataset', 'http://www.geopackage.org', ?, ?)",
            (number, mime_type, text),
        )
        database.execute(
            "INSERT INTO gpkg_metadata_reference (reference_scope, md_file_id) VALUES ('geopackage', ?)", (number,)
        )


def _with_aliases(style: str, aliases: Mapping[str, str]) -> str:
    """Add the columns' names for people to a QML document."""
    rows = "".join(
        f'<alias field="{field}" name="{name}" index="{i}"/>' for i, (field, name) in enumerate(aliases.items(), 1)
    )
    return style.replace("Symbology", "Symbology|Fields").replace("</qgis>", f"<aliases>{rows}</aliases></qgis>")


# --- reading ----------------------------------------------------------------------------------------------------------


def _plane(path: str | os.PathLike[str], meta: Mapping[str, Any]) -> LocalPlane:
    crs, origin = meta.get("roadgeo.crs"), meta.get("roadgeo.origin")
    if isinstance(crs, str) and isinstance(origin, list) and [type(o) for o in origin] == [float, float]:
        x, y = origin
        if math.isfinite(x) and math.isfinite(y):
            return LocalPlane(crs, (x, y))
    raise IndexFormatError(f"{path}: its table roadgeo_meta lacks the CRS or the origin; make the file again")


def _texts(table: Mapping[str, Sequence[Any]], name: str) -> AnyArray | None:
    """One column of text, "" for any other value; None where there is no such column."""
    if name not in table:
        return None
    return np.array([value if isinstance(value, str) else "" for value in table[name]], object)


def _read_shapes(
    path: str | os.PathLike[str], layer: str, kind: Literal["point", "line", "ring"]
) -> tuple[list[FloatArray], Mapping[str, Sequence[Any]]]:
    """Geometries and columns of a layer; each of its rows has a geometry of that kind."""
    shapes, table = read_layer(path, layer)
    n_rows = max(map(len, table.values()), default=0)
    if len(shapes) != n_rows or any(one.ndim != (1 if kind == "point" else 2) for one in shapes):
        raise IndexFormatError(f"{path}: its layer '{layer}' holds a geometry that is no {kind}; make the file again")
    return shapes, table


def _read_graph(
    path: str | os.PathLike[str], plane: LocalPlane, n_nodes: Any
) -> tuple[RoadGraph, Mapping[str, Sequence[Any]]]:
    """Roads with their nodes, and their columns; a node takes its position from the roads that end in it."""
    lines, table = _read_shapes(path, "roads", "line")
    edges = np.array([_column(path, table, name, -1) for name in ("from_node", "to_node")], np.int64).T.reshape(-1, 2)
    if type(n_nodes) is not int or n_nodes > 2 * len(edges) or (edges < 0).any() or (edges >= n_nodes).any():
        raise IndexFormatError(f"{path}: its layer 'roads' names nodes that do not exist; make the file again")
    graph = RoadGraph.from_polylines(np.full((n_nodes, 2), np.nan), edges.astype(np.int32), lines)
    if (np.diff(graph.offsets) < 2).any():
        raise IndexFormatError(f"{path}: its layer 'roads' holds a road of less than two vertices; make the file again")
    coords = plane.from_crs(graph.coords)
    graph.xy[graph.edges[:, 0]] = coords[graph.offsets[:-1]]
    graph.xy[graph.edges[:, 1]] = coords[graph.offsets[1:] - 1]
    return replace(graph, coords=coords), table


def _read_intersections(path: str | os.PathLike[str], plane: LocalPlane) -> Intersections:
    points, table = _read_shapes(path, "intersections", "point")
    xy = plane.from_crs(np.array(points, float).reshape(-1, 2))
    rays, tangents = _angles(path, table, _RAYS), _angles(path, table, _TANGENTS)
    residual = np.array(_column(path, table, "residual_m", np.nan), np.float32)
    lacking = ~(np.isfinite(rays).any(axis=1) & np.isfinite(tangents).any(axis=1) & np.isfinite(xy).all(axis=1))
    if lacking.any():
        raise IndexFormatError(
            f"{path}: intersection {table['fid'][int(np.argmax(lacking))]} has no place, no ray or no tangent; "
            f"give it {_RAYS[0]} and {_TANGENTS[0]}, or delete it"
        )
    return Intersections(xy, rays, tangents, residual, np.array(_column(path, table, "node", _NO_NODE), np.int64))


def _angles(path: str | os.PathLike[str], table: Mapping[str, Sequence[Any]], names: Sequence[str]) -> Float32Array:
    """(N, R) float32 radians of R columns of degrees."""
    columns = [_column(path, table, name, np.nan) for name in names]
    return np.ascontiguousarray(np.radians(np.array(columns, float).T.reshape(-1, len(names))).astype(np.float32))


def _column(path: str | os.PathLike[str], table: Mapping[str, Sequence[Any]], name: str, null: float) -> AnyArray:
    """One column of numbers, NULL as `null`."""
    try:
        return np.array([null if value is None else value for value in table[name]], float)
    except (KeyError, ValueError, TypeError) as error:
        raise IndexFormatError(
            f"{path}: its column {name!r} is missing or holds no numbers; make the file again"
        ) from error
