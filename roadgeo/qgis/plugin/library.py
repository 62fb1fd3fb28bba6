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

__all__ = ["LONLAT", "Place", "Reference", "find_reference", "list_places", "list_references", "parse"]

LONLAT = "EPSG:4326"

#: How long an answer of the program is good: the dialog of a batch has many lists of references.
_FRESH_S = 5.0


@dataclass(frozen=True)
class Reference:
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
class Place:
    """A place of a picture: longitude and latitude of its middle, log10 odds or None, and the map ("" if unknown)."""

    lon: float
    lat: float
    log10_odds: float | None
    map: str


_SHELVED: list[Reference] = []
_ASKED = [-math.inf]


def list_references(fresh: bool = False) -> list[Reference]:
    """List the references of roadgeo's library, as its program knows them, then those that were built outside it."""
    command = locate_command()
    if command is not None and (fresh or time.monotonic() - _ASKED[0] > _FRESH_S):
        lines: list[str] = []
        run([*command, "reference", "list", "--json"], lambda _, line: lines.append(line), lambda: False)
        found = [list(document["files"]) for document in map(parse, lines) if document and document.get("files")]
        _SHELVED[:] = [Reference(Path(files[0]).stem, Path(files[0]).stem, _geopackage(files)) for files in found]
        _ASKED[0] = time.monotonic()
    return [*_SHELVED, *(Reference(Path(file).stem, file, _geopackage([file])) for file in remembered_references())]


def _geopackage(files: list[str]) -> str:
    return next((file for file in files if file.endswith(".gpkg") and Path(file).is_file()), "")


def find_reference(value: str) -> Reference:
    """Return the reference that a name or a file stands for."""
    known = (reference for reference in list_references() if value in (reference.name, reference.value))
    return next(known, Reference(Path(value).stem, value, _geopackage([value])))


def list_places(location: dict[str, Any]) -> list[Place]:
    """List the places at which a picture may lie, the likeliest first, with the maps that hold them."""
    best = [{"center": location["center"], "log10_odds": location["log10_odds"]}] if location["center"] else []
    maps = sorted(list_references(), key=lambda held: held.name != location["reference"])
    boxes = [(held.name, _box(held.file)) for held in maps if held.file]
    places = []
    for found in [*best, *location["alternatives"]]:
        lon, lat = found["center"]["lon"], found["center"]["lat"]
        on = (name for name, box in boxes if box.contains(QgsPointXY(lon, lat)))
        places.append(Place(lon, lat, found["log10_odds"], next(on, "")))
    return sorted(places, key=lambda place: math.inf if place.log10_odds is None else -place.log10_odds)


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
