"""The references that QGIS knows, in roadgeo's library and beside it, and the places of a picture on them."""

from __future__ import annotations

import json
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qgis.core import QgsCoordinateReferenceSystem, QgsCoordinateTransform, QgsPointXY, QgsProject, QgsVectorLayer

from .runner import run
from .settings import locate_command, remembered_references

__all__ = ["LONLAT", "ListedPlace", "ListedReference", "find_reference", "list_places", "list_references", "parse"]

LONLAT = "EPSG:4326"

#: How long an answer of the program is good: the dialog of a batch has many lists of references.
_FRESH_S = 5.0


@dataclass(frozen=True)
class ListedReference:
    """A reference.

    Attributes
    ----------
    name, value : str
        Its name, and how roadgeo is given it: by that name in the library, else by its file.
    file : str
        Its GeoPackage; "" where it is in shards.
    """

    name: str
    value: str
    file: str


@dataclass(frozen=True)
class ListedPlace:
    """A place of a picture.

    Attributes
    ----------
    lon, lat : float
        Its middle.
    less : float
        Decimal logarithm of how many times less likely it is than the best, at least; 0 for the best.
    map : str
        Name of the reference that holds it, "" if unknown.
    footprint : list of [float, float]
        Corners, longitude and latitude; empty where only the middle is known.
    """

    lon: float
    lat: float
    less: float
    map: str
    footprint: list[list[float]]


_SHELVED: list[ListedReference] = []
_ASKED = [-math.inf]


def list_references(fresh: bool = False) -> list[ListedReference]:
    """List the references of roadgeo's library, as its program knows them, then those that were built outside it."""
    command = locate_command()
    if command is not None and (fresh or time.monotonic() - _ASKED[0] > _FRESH_S):
        lines: list[str] = []
        run([*command, "reference", "list", "--json"], lambda _, line: lines.append(line), lambda: False)
        files_of = [list(document["files"]) for document in map(parse, lines) if document and document.get("files")]
        _SHELVED[:] = [
            ListedReference(Path(files[0]).stem, Path(files[0]).stem, _geopackage(files)) for files in files_of
        ]
        _ASKED[0] = time.monotonic()
    return [
        *_SHELVED,
        *(ListedReference(Path(file).stem, file, _geopackage([file])) for file in remembered_references()),
    ]


def _geopackage(files: list[str]) -> str:
    return next((file for file in files if file.endswith(".gpkg") and Path(file).is_file()), "")


def find_reference(value: str) -> ListedReference:
    """Return the reference that a name or a file stands for."""
    named = (reference for reference in list_references() if value in (reference.name, reference.value))
    return next(named, ListedReference(Path(value).stem, value, _geopackage([value])))


def list_places(location: dict[str, Any]) -> list[ListedPlace]:
    """List the places at which a picture may lie, the best first, with the maps that hold them."""
    lead = location["log10_odds"] or 0.0
    best = [{**location, "log10_odds": 0.0}] if location["center"] else []
    maps = sorted(list_references(), key=lambda reference: reference.name != location["reference"])
    boxes = [(reference.name, _box(reference.file)) for reference in maps if reference.file]
    places: list[ListedPlace] = []
    for listed in [*best, *location["alternatives"]]:
        lon, lat, odds = listed["center"]["lon"], listed["center"]["lat"], listed["log10_odds"] or 0.0
        on = (name for name, box in boxes if box.contains(QgsPointXY(lon, lat)))
        # On its own map a place has odds against the best; where it is itself the best there, the lead is the least.
        less = -odds if odds < 0.0 else max(lead, 0.0)
        footprint = listed.get("footprint_lonlat") or []
        places.append(ListedPlace(lon, lat, less if places else 0.0, next(on, ""), footprint))
    return places


def _box(file: str) -> Any:
    """Return the extent of a map in degrees."""
    roads = QgsVectorLayer(f"{file}|layername=roads", "roads", "ogr")
    to = QgsCoordinateTransform(roads.crs(), QgsCoordinateReferenceSystem(LONLAT), QgsProject.instance())
    return to.transformBoundingBox(roads.extent())


def parse(line: str) -> dict[str, Any] | None:
    """Return the JSON object that a line of the program holds, if it does."""
    try:
        document = json.loads(line) if line.startswith("{") else None
    except ValueError:
        return None
    return document if isinstance(document, dict) else None
