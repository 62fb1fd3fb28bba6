"""Where query masks really lie: written and read as CSV or JSON, and drawn as footprints.

`truth.csv` has one row per mask with the columns

=================  ===================================================================================================
file               path of the mask, relative to the table
kind               what sort of query it is ("clean", "poor", ...); may be missing
on_map             True, or False where the mask must be refused; may be missing
crs                "EPSG:n" or WKT2, of everything below
width, height      of the mask, pixels
center_x/_y        CRS position of the middle of the frame; to look at, it is not read
h00 ... h22        homography, pixel (column, row) to CRS, row by row; the centre of the top-left pixel is (0.5, 0.5)
others             properties: numbers such as gsd_m, tilt_deg, heading_deg, n_intersections, density_km2
=================  ===================================================================================================

`truth.json` holds the same as {"schema": "roadgeo.truth/1", "queries": [...]}, with the homography as 3 x 3 lists.
Foreign tables are understood by their columns: query sets with `centre_e`, `centre_n` and a homography to local metres
whose integers are pixel centres, and lists of north-up tiles with `easting`, `northing` (1500 px, 1 m).
"""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo.errors import RoadSourceError
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.homography import Homography, shift
from roadgeo.geometry.projection import transform
from roadgeo.outputs.names import table_text
from roadgeo.storage.files import write_text
from roadgeo.storage.geopackage import FeatureTable, write_layers
from roadgeo.storage.tables import read_rows, read_text

__all__ = ["SCHEMA", "Truth", "read_truth", "truth_from_record", "truth_to_record", "write_truth"]

SCHEMA = "roadgeo.truth/1"

_MATRIX_COLUMNS = [f"h{i}{j}" for i in range(3) for j in range(3)]
_REQUIRED = ["file", "crs", "width", "height"]
_OWN_COLUMNS = ["file", "kind", "on_map", "crs", "width", "height", "center_x", "center_y", *_MATRIX_COLUMNS]


@dataclass(frozen=True)
class Truth:
    """Where one mask lies.

    Attributes
    ----------
    file : str
        The mask's path relative to the table, with forward slashes.
    homography : (3, 3) float64
        Pixel (column, row; GDAL's corner convention) to `crs`.
    crs : str or None
        None: the CRS of whatever reference it is scored against.
    size : (int, int)
        Width and height, pixels.
    on_map : bool
        False: the mask has no place on the map, and must be refused.
    properties : dict
        Numbers that tables are broken down by.
    """

    file: str
    kind: str
    homography: FloatArray
    crs: str | None
    size: tuple[int, int]
    on_map: bool = True
    properties: dict[str, float] = field(default_factory=dict)

    @property
    def footprint(self) -> FloatArray:
        """(4, 2) corners TL, TR, BR, BL in the CRS."""
        return self.places(Frame(*self.size).corners)

    @property
    def center(self) -> FloatArray:
        """(2,) CRS position of the middle of the frame."""
        return self.places(Frame(*self.size).center)

    def places(self, pixels: FloatArray, crs: str | None = None) -> FloatArray:
        """Return where (..., 2) pixels lie in a CRS, by default its own."""
        own = Homography(self.homography).facing(Frame(*self.size).center)(pixels)
        return own if self.crs is None or crs is None or self.crs == crs else transform(self.crs, crs, own)


def write_truth(
    folder: str | os.PathLike[str], truths: Sequence[Truth], further: Mapping[str, Any] | None = None
) -> None:
    """Write `truth.csv`, `truth.json` and `footprints.gpkg` into a folder; `further` holds values for the JSON.

    Raises
    ------
    OutputError
        The folder is missing or not writable.
    """
    target = Path(folder)
    write_text(target / "truth.csv", _to_csv(truths))
    write_text(target / "truth.json", _to_json(truths, further or {}))
    if truths:
        write_layers(target / "footprints.gpkg", [_to_layer(truths)])


def read_truth(path: str | os.PathLike[str], crs: str | None = None) -> list[Truth]:
    """Read a table of ours, CSV or JSON, or one of the foreign ones that the module's text names.

    Parameters
    ----------
    crs : str, optional
        CRS of a table that names none.

    Raises
    ------
    RoadSourceError
        No such file, or not such a table.
    """
    source = Path(path)
    text = read_text(source, "a table of truths, CSV or JSON, as `roadgeo simulate` writes it")
    try:
        if text.lstrip().startswith("{"):
            return [truth_from_record(record, crs) for record in json.loads(text)["queries"]]
        rows = read_rows(text)
        columns = set(rows[0]) if rows else set()
        if "tile" in columns:
            return [_from_tile(row, crs) for row in rows]
        if "centre_e" in columns:
            return [_from_local(row, crs or _crs_beside(source)) for row in rows]
        return [_from_row(row, crs) for row in rows]
    except (KeyError, ValueError, TypeError, AttributeError, RecursionError, csv.Error) as error:
        raise RoadSourceError(
            f"{source} is no table of truths ({type(error).__name__}: {error}); expected the columns"
            f" {', '.join(_REQUIRED)}, h00 ... h22, or schema {SCHEMA}"
        ) from error


# --- ours -------------------------------------------------------------------------------------------------------------


def truth_to_record(truth: Truth) -> dict[str, Any]:
    """Give a truth as plain values, ready for `json.dumps`, as `truth.json` holds it."""
    center = truth.center
    return {
        "file": truth.file,
        "kind": truth.kind,
        "on_map": truth.on_map,
        "crs": truth.crs,
        "width": truth.size[0],
        "height": truth.size[1],
        "center_x": float(center[0]),
        "center_y": float(center[1]),
        "homography": np.asarray(truth.homography, float).tolist(),
        "properties": truth.properties,
    }


def truth_from_record(record: dict[str, Any], crs: str | None = None) -> Truth:
    """Read what `truth_to_record` wrote; `crs` stands in where the record names none."""
    return Truth(
        str(record["file"]),
        str(record["kind"]),
        np.array(record["homography"], float).reshape(3, 3),
        record["crs"] or crs,
        (int(record["width"]), int(record["height"])),
        bool(record["on_map"]),
        {name: float(value) for name, value in record["properties"].items()},
    )


def _to_json(truths: Sequence[Truth], further: Mapping[str, Any]) -> str:
    return (
        json.dumps({"schema": SCHEMA, **further, "queries": [truth_to_record(truth) for truth in truths]}, indent=1)
        + "\n"
    )


def _to_csv(truths: Sequence[Truth]) -> str:
    names = list(dict.fromkeys(name for truth in truths for name in truth.properties))
    rows: list[list[object]] = [[*_OWN_COLUMNS, *names]]
    for truth in truths:
        record = truth_to_record(truth)
        # repr keeps every digit of a float, so that reading gives the same numbers.
        matrix = [repr(value) for row in record["homography"] for value in row]
        rows.append(
            [*(record[name] for name in _OWN_COLUMNS[:8]), *matrix, *(truth.properties.get(name, "") for name in names)]
        )
    return table_text(rows)


def _from_row(row: dict[str, str], crs: str | None) -> Truth:
    properties = {name: float(value) for name, value in row.items() if name not in _OWN_COLUMNS and value != ""}
    return Truth(
        row["file"],
        row.get("kind") or "mask",
        _matrix(row),
        row["crs"] or crs,
        (int(row["width"]), int(row["height"])),
        row.get("on_map", "True").strip().lower() not in ("false", "0", "no"),
        properties,
    )


def _to_layer(truths: Sequence[Truth]) -> FeatureTable:
    """Footprints as one layer, in the CRS of the first query."""
    names = list(dict.fromkeys(name for truth in truths for name in truth.properties))
    return FeatureTable(
        "footprints",
        "POLYGON",
        [truth.footprint for truth in truths],
        {
            "file": [truth.file for truth in truths],
            "kind": [truth.kind for truth in truths],
            "on_map": [truth.on_map for truth in truths],
            **{name: [truth.properties.get(name, float("nan")) for truth in truths] for name in names},
        },
        crs=truths[0].crs or "",
    )


# --- foreign ----------------------------------------------------------------------------------------------------------


def _matrix(row: dict[str, str]) -> FloatArray:
    return np.array([float(row[name]) for name in _MATRIX_COLUMNS]).reshape(3, 3)


def _from_local(row: dict[str, str], crs: str | None) -> Truth:
    """Read a row whose homography takes pixel centres at integers to metres from a local origin."""
    origin = [float(row[f"centre_{to}"]) - float(row[f"centre_{of}"]) for to, of in ("ex", "ny")]
    names = {
        "n_intersections": "n_intersections",
        "gsd": "gsd_m",
        "tilt_deg": "tilt_deg",
        "removed_frac": "missing",
        "spurious_frac": "false_roads",
    }
    properties = {ours: float(row[theirs]) for theirs, ours in names.items() if row.get(theirs)}
    matrix = shift(*origin) @ _matrix(row) @ shift(-0.5, -0.5)
    return Truth(row["file"], row["kind"], matrix, crs, (1500, 1500), True, properties)


def _crs_beside(table: Path) -> str | None:
    """CRS in the `meta.json` beside a table, if there is one."""
    meta = table.with_name("meta.json")
    return json.loads(meta.read_text()).get("crs") if meta.is_file() else None


def _from_tile(row: dict[str, str], crs: str | None) -> Truth:
    """Read a row of the Massachusetts Roads tiles: 1500 x 1500 px of 1 m, north up, given by their centres."""
    east, north = float(row["easting"]), float(row["northing"])
    matrix = np.array([[1.0, 0.0, east - 750.0], [0.0, -1.0, north + 750.0], [0.0, 0.0, 1.0]])
    on_map = row["in_map"] == "True"
    kind = "mask" if on_map else "off the map"
    return Truth(f"masks/{row['tile']}.png", kind, matrix, crs or "EPSG:26986", (1500, 1500), on_map, {"gsd_m": 1.0})
