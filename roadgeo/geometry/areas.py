"""Areas by name or by their bounds: countries and states, whose extents EPSG lists in the database of PROJ."""

from __future__ import annotations

import os
from contextlib import closing
from functools import lru_cache
from pathlib import Path
from typing import TypeAlias

__all__ = ["Box", "find_area", "is_box", "lies_in", "overlap"]

#: West, south, east and north in degrees. West is greater than east where it crosses the antimeridian.
Box: TypeAlias = tuple[float, float, float, float]

_BOUNDS = "WEST,SOUTH,EAST,NORTH in degrees"


def find_area(text: str) -> Box:
    """Return the bounds of an area: "9.47,47.05,9.64,47.28", "Liechtenstein", "Utah" or "USA - Utah".

    Raises
    ------
    ValueError
        No area or several areas have that name.
    """
    words = " " in text.strip() and any(sign.isalpha() for sign in text)  # as "Germany - onshore east of 12°E" has
    if any(sign.isdigit() for sign in text) and not words:
        return _read_box(text)
    extents, wanted = _extents(), " ".join(text.split()).casefold()
    if not wanted:
        raise ValueError(f"got {text!r}, expected {_BOUNDS} or the name of a country or state")
    if wanted in extents:
        return extents[wanted][1]
    ending = [extent for extent in extents if extent.rpartition(" - ")[2] == wanted]
    if len(ending) == 1:
        return extents[ending[0]][1]
    if ending:
        names = " or ".join(extents[extent][0] for extent in sorted(ending)[:6])
        raise ValueError(f"{text!r} may be {names}: give the whole name")
    import difflib

    alike = difflib.get_close_matches(wanted, extents, n=1, cutoff=0.75)
    hint = f"did you mean {extents[alike[0]][0]!r}, or else " if alike else ""
    raise ValueError(f"no country or state is called {text!r}; {hint}give {_BOUNDS}")


def _read_box(text: str) -> Box:
    try:
        west, south, east, north = (float(part) for part in text.split(","))
    except ValueError as error:
        raise ValueError(f"got {text!r}, expected {_BOUNDS}, or the name of a country or state") from error
    if not is_box((west, south, east, north)):
        raise ValueError(f"got {text!r}, expected {_BOUNDS}, south below north")
    return west, south, east, north


def is_box(box: Box) -> bool:
    """Whether numbers are bounds of an area."""
    west, south, east, north = box
    return -180 <= west <= 180 and -180 <= east <= 180 and west != east and -90 <= south < north <= 90


def lies_in(box: Box, lon: float, lat: float) -> bool:
    """Whether a place lies in a box."""
    return overlap(box, (lon, lat, lon, lat))


def overlap(first: Box, other: Box) -> bool:
    """Whether two boxes share ground."""
    if first[1] > other[3] or other[1] > first[3]:
        return False
    west, east = _unrolled(first)
    from_west, to_east = _unrolled(other)
    return any(west <= to_east + turn and from_west + turn <= east for turn in (-360.0, 0.0, 360.0))


def _unrolled(box: Box) -> tuple[float, float]:
    """Return west and east, the second not below the first."""
    return box[0], box[2] if box[2] >= box[0] else box[2] + 360.0


@lru_cache(maxsize=1)
def _extents() -> dict[str, tuple[str, Box]]:
    """Return the extents that EPSG names: by their names in lower case, the names and the bounds.

    PROJ, which every user has, brings them; its database has had this table since version 7.2.
    """
    import sqlite3  # not for those who name no area

    from pyproj.datadir import get_data_dir

    asked = (
        "SELECT name, west_lon, south_lat, east_lon, north_lat FROM extent"
        " WHERE auth_name = 'EPSG' AND NOT deprecated AND west_lon IS NOT NULL AND south_lat < north_lat"
    )
    path = Path(get_data_dir().split(os.pathsep)[0]) / "proj.db"
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as database:
            return {str(name).casefold(): (str(name), tuple(box)) for name, *box in database.execute(asked)}
    except sqlite3.Error as error:
        raise ValueError(f"areas have no names here: {path}: {error}; give {_BOUNDS}") from error
