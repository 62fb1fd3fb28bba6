"""The references that QGIS knows, in roadgeo's library and beside it, and the places of a picture on them."""

from __future__ import annotations

import json
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

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
    score : float
        Its lead over all other places, powers of ten; below 0 where another fits better.
    map : str
        Name of the reference that holds it.
    footprint : list of [float, float]
        Corners, longitude and latitude; empty where only the middle is known.
    """

    lon: float
    lat: float
    score: float
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
    best = [location] if location["center"] else []
    return [
        ListedPlace(
            listed["center"]["lon"],
            listed["center"]["lat"],
            listed["log10_odds"] or 0.0,
            listed["reference"],
            listed.get("footprint_lonlat") or [],
        )
        for listed in [*best, *location["alternatives"]]
    ]


def parse(line: str) -> dict[str, Any] | None:
    """Return the JSON object that a line of the program holds, if it does."""
    try:
        document = json.loads(line) if line.startswith("{") else None
    except ValueError:
        return None
    return document if isinstance(document, dict) else None
