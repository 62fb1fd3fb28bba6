"""The files of a flight: a GeoPackage, GeoJSON, GPX, a CSV with the names of MISB ST 0601, and a report."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from roadgeo._text import in_html
from roadgeo._version import __version__
from roadgeo.flights.rows import Row
from roadgeo.outputs.names import table_cell, table_text
from roadgeo.storage.files import write_text
from roadgeo.storage.geopackage import FeatureTable, write_layers
from roadgeo.storage.qml import draw_fill, draw_line, draw_marker

__all__ = ["WRITERS", "to_csv", "to_geojson", "to_gpx", "write_geopackage"]

#: Radius within which a place lies with 90 %, in standard deviations of its distance (both axes alike).
_CE90 = math.sqrt(-math.log(0.1))


#: Columns of a frame in layers: keys of `Row.to_dict`.
_COLUMNS = (
    *("frame", "name", "time", "time_s", "status", "sigma_m", "gsd_m", "heading_deg", "log10_odds"),
    *("reference", "reason"),
)


def to_csv(rows: Sequence[Row]) -> str:
    """Return a table, one row a frame; columns that MISB ST 0601 knows have its names and units."""
    corners = [f"Corner {what} Point {k} (Full)" for k in range(1, 5) for what in ("Latitude", "Longitude")]
    first = ["Frame", "Name", "Time s", "Precision Time Stamp", "Status"]
    center = ["Frame Center Latitude", "Frame Center Longitude"]
    numbers = ["Target Error Estimate - CE90", "Sigma m", "Ground Sampling m", "Image Heading", "Log10 Odds"]
    sensor = ["Sensor Latitude", "Sensor Longitude", "Sensor Height Above Ground m", "Sensor Sigma m"]
    cells: list[list[object]] = [[*first, *center, *corners, *numbers, *sensor, "Known At Frame", "Reason"]]
    for row in rows:
        stamp = "" if row.time is None else str(round(row.time.timestamp() * 1e6))
        at = ["", ""] if row.center is None else [f"{row.center[1]:.8f}", f"{row.center[0]:.8f}"]
        ring = [""] * 8 if row.footprint is None else [f"{v:.8f}" for lon, lat in row.footprint for v in (lat, lon)]
        values = [_CE90 * row.sigma_m, row.sigma_m, row.gsd_m, row.heading_deg, row.log10_odds]
        measured = ["" if math.isnan(value) else f"{value:.4f}" for value in values]
        head = [row.number, table_cell(row.name), f"{row.time_s:.3f}", stamp, row.status]
        cells.append([*head, *at, *ring, *measured, *_sensor(row), row.known_at, table_cell(row.reason)])
    return table_text(cells)


def _sensor(row: Row) -> list[str]:
    if row.camera is None:
        return [""] * 4
    camera = row.camera
    return [f"{camera.lat:.8f}", f"{camera.lon:.8f}", f"{camera.height_m:.2f}", f"{camera.sigma_m:.2f}"]


def to_geojson(rows: Sequence[Row]) -> str:
    """Return footprints and the track (RFC 7946), with times as `coordTimes` has them."""
    placed = [row for row in rows if row.center is not None and row.footprint is not None]
    features = [
        {
            "type": "Feature",
            "geometry": {"type": "Polygon", "coordinates": [_ring(row)]},
            "properties": {key: row.to_dict()[key] for key in (*_COLUMNS, "known_at", "crs")},
        }
        for row in placed
    ]
    if len(placed) > 1:
        line = {"type": "LineString", "coordinates": [list(row.center or ()) for row in placed]}
        times = [row.to_dict()["time"] or row.time_s for row in placed]
        features.append({"type": "Feature", "geometry": line, "properties": {"name": "track", "coordTimes": times}})
    return json.dumps({"type": "FeatureCollection", "features": features}) + "\n"


def _ring(row: Row) -> list[list[float]]:
    """Return a closed ring, counterclockwise as RFC 7946 asks."""
    corners = np.asarray(row.footprint)[::-1].tolist()
    return [*corners, corners[0]]


def to_gpx(rows: Sequence[Row]) -> str:
    """Return the track (GPX 1.1); it is broken where the flight was lost."""

    def point(row: Row) -> str:
        lon, lat = row.center or (math.nan, math.nan)
        when = "" if row.time is None else f"<time>{row.to_dict()['time']}</time>"
        about = f"{when}<name>{in_html(row.name)}</name><type>{row.status}</type>"
        return f'<trkpt lat="{lat:.8f}" lon="{lon:.8f}">{about}</trkpt>'

    body = "".join(f"<trkseg>{''.join(map(point, run))}</trkseg>" for run in _runs(rows, 1))
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<gpx version="1.1" creator="roadgeo {__version__}" '
        f'xmlns="http://www.topografix.com/GPX/1/1"><trk><name>flight</name>{body}</trk></gpx>\n'
    )


def write_geopackage(path: Path, rows: Sequence[Row]) -> None:
    """Write layers `footprints`, `centers` and `track`, in longitude and latitude; nothing where no frame has a place.

    Raises
    ------
    OutputError
        It cannot be written.
    """
    placed = [row for row in rows if row.center is not None]
    if not placed:
        return
    columns: dict[str, list[Any]] = {key: [getattr(row, key) for row in placed] for key in _COLUMNS[1:]}
    columns = {"frame": [row.number for row in placed], **columns, "time": [row.to_dict()["time"] for row in placed]}
    centers = np.array([row.center for row in placed])
    layers = [
        FeatureTable("footprints", "POLYGON", [row.footprint for row in placed], columns, "EPSG:4326",
              draw_fill("228,87,46,25", "228,87,46", 0.3)),
        FeatureTable("centers", "POINT", centers, columns, "EPSG:4326", draw_marker("228,87,46", 2.0)),
    ]  # fmt: skip
    runs = _runs(rows, 2)
    if runs:
        ends = {"first": [run[0].number for run in runs], "last": [run[-1].number for run in runs]}
        lines = [np.array([row.center for row in run]) for run in runs]
        layers.insert(1, FeatureTable("track", "LINESTRING", lines, ends, "EPSG:4326", draw_line("40,40,40", 0.6)))
    write_layers(path, layers)


def _runs(rows: Sequence[Row], least: int) -> list[list[Row]]:
    """Return runs of frames that have places, of at least this number."""
    runs = [list(run) for is_placed, run in groupby(rows, lambda row: row.center is not None) if is_placed]
    return [run for run in runs if len(run) >= least]


def _text(make: Callable[[Sequence[Row]], str]) -> Callable[[Path, Sequence[Row]], None]:
    return lambda path, rows: write_text(path, make(rows))


#: Ending of each file, its writer, and its purpose.
WRITERS: dict[str, tuple[Callable[[Path, Sequence[Row]], None], str]] = {
    ".gpkg": (write_geopackage, "footprints, centres and the track, styled for QGIS"),
    ".geojson": (_text(to_geojson), "the same for the web, with times"),
    ".gpx": (_text(to_gpx), "the track, for GPS programs"),
    ".csv": (_text(to_csv), "one row a frame, columns named as in MISB ST 0601"),
}
