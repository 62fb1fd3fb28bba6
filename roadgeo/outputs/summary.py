"""All footprints of many masks in one GeoPackage and one table (CSV)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from roadgeo.geometry.antimeridian import cut_ring
from roadgeo.outputs.columns import NUMBERS, WORDS, attributes
from roadgeo.outputs.drawing.layers import rgb
from roadgeo.outputs.names import bare_names, table_cell, table_text
from roadgeo.storage.files import write_text
from roadgeo.storage.geopackage import FeatureTable, GeometryType, write_layers
from roadgeo.storage.qml import draw_fill

__all__ = ["write_summary"]

_FRAME = ",".join(map(str, rgb("frame")))
#: Statuses of masks whose footprints are shown.
_ON_MAP = ("located", "chosen")
_STYLE = draw_fill(f"{_FRAME},40", _FRAME, 0.5)


def write_summary(folder: Path, documents: Sequence[Mapping[str, Any]]) -> list[Path]:
    """Write `roadgeo_summary.gpkg` and `roadgeo_summary.csv`; return their paths.

    The GeoPackage has a layer `footprints` of the located masks, in degrees as their references may lie in different
    zones, cut at 180 degrees where one lies astride (then all are multipolygons); and a table `others` of all that were
    not located, with the reasons. The CSV has all masks in their order, the footprints as well-known text.

    Parameters
    ----------
    documents : sequence of dict
        `Location.to_dict` of each mask; for a mask that failed what the command line prints.

    Raises
    ------
    OutputError
        A file cannot be written.
    """
    names = bare_names([str(document["query"]) for document in documents])
    documents = [
        {**document, "query": name, "reason": attributes(document)["reason"]}
        for document, name in zip(documents, names, strict=True)
    ]
    located = [document for document in documents if document["status"] in _ON_MAP]
    others = [document for document in documents if document["status"] not in _ON_MAP]
    parts = [cut_ring(np.array(document["footprint_lonlat"], float)) for document in located]
    shapes: tuple[GeometryType, list[Any]] = ("POLYGON", [rings[0] for rings in parts])
    if any(len(rings) > 1 for rings in parts):
        shapes = ("MULTIPOLYGON", parts)
    rows = [{**attributes(document), "query": document["query"]} for document in located]
    footprints = {name: [row[name] for row in rows] for name in (*WORDS, *NUMBERS)}
    geopackage, table = folder / "roadgeo_summary.gpkg", folder / "roadgeo_summary.csv"
    layers = [
        FeatureTable("footprints", *shapes, footprints, "EPSG:4326", _STYLE, "Ground that the located masks show"),
        FeatureTable("others", columns={name: [document.get(name) for document in others] for name in WORDS}),
    ]
    write_layers(geopackage, layers)
    write_text(table, _to_csv(documents))
    return [geopackage, table]


def _to_csv(documents: Sequence[Mapping[str, Any]]) -> str:
    rows: list[list[Any]] = [[*WORDS, "lon", "lat", "crs", "x", "y", *NUMBERS, "footprint_wkt"]]
    for document in documents:
        here = document if document["status"] in _ON_MAP else {}
        center = here.get("center") or {}
        position = [center.get("lon"), center.get("lat"), here.get("crs"), center.get("x"), center.get("y")]
        values = {**attributes(document), "query": document["query"]}
        words, numbers = ([values[name] for name in names] for names in (WORDS, NUMBERS))
        words = [table_cell(str(word or "")) for word in words]
        rows.append([*words, *position, *numbers, _to_wkt(here.get("footprint_lonlat"))])
    return table_text(rows)


def _to_wkt(corners: Sequence[Sequence[float]] | None) -> str:
    if corners is None:
        return ""
    rings = [", ".join(f"{lon:.7f} {lat:.7f}" for lon, lat in ring) for ring in cut_ring(np.array(corners, float))]
    return f"POLYGON (({rings[0]}))" if len(rings) == 1 else f"MULTIPOLYGON ((({')), (('.join(rings)})))"
