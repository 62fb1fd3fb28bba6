"""Limits on a CRS from a stranger's file: PROJ opens no file but its own grids.

A CRS may name grids to shift by (`+nadgrids=`, `PARAMETERFILE`, `EXTENSION["PROJ4_GRIDS", ...]`), or a file that
defines it (`+init=`), by any path: PROJ then opens that, be it a pipe that nobody writes to. Names without folders are
looked for among PROJ's own, and are allowed.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from roadgeo.errors import CrsError

if TYPE_CHECKING:
    from pyproj import CRS

__all__ = ["NoCrsError", "all_text", "crs_name", "known_crs", "name_crs", "named_file"]

#: Keys of PROJ's strings that take files, and the forms of file names in WKT and PROJJSON.
_KEYS = re.compile(r"(?:grids|file|model)\s*=\s*(\"[^\"]*|[^\s\"]*)", re.IGNORECASE)
_INIT = re.compile(r"init\s*=\s*(\"[^\"]*|[^\s\"]*)", re.IGNORECASE)
_JSON = re.compile(r'"value"\s*:\s*"((?:[^"\\]|\\.)*)"')
_WKT = re.compile(
    r'(?:PARAMETERFILE\s*[\[(]\s*"(?:[^"]|"")*"|EXTENSION\s*[\[(]\s*"PROJ4_GRIDS")\s*,\s*"((?:[^"]|"")*)"',
    re.IGNORECASE,
)


class NoCrsError(CrsError):
    """The given text is no CRS, or none of places on Earth."""


def known_crs(crs: Any) -> CRS:
    """Return a CRS as pyproj knows it, of whatever pyproj takes for one.

    Raises
    ------
    CrsError
        It names a file that is none of PROJ's own.
    pyproj.exceptions.CRSError
        It is none.
    """
    return _known(crs) if isinstance(crs, str) else _checked(crs)


def name_crs(crs: Any) -> str:
    """Return a CRS as all libraries read it, "EPSG:n" or else WKT2, of whatever pyproj takes for one.

    That is a code (3857, "EPSG:3857", "ESRI:102003"), a name ("OSGB36 / British National Grid"), WKT, PROJJSON ...

    Raises
    ------
    NoCrsError
        It is none, or none of places on a map.
    CrsError
        It names a file that is none of PROJ's own.
    """
    from pyproj.exceptions import CRSError

    told = f"{str(crs)[:60]!r}"
    expected = "expected for example EPSG:3857, 3857, a name such as 'WGS 84 / UTM zone 29N', or WKT"
    try:
        known = known_crs(crs)
    except CRSError as error:
        raise NoCrsError(f"{told} is no CRS that PROJ knows; {expected}") from error
    known = known.to_2d() if len(known.axis_info) == 3 else known
    if not (known.is_geographic or known.is_projected):
        raise NoCrsError(f"{told} is no CRS of a map, but a {known.type_name}; {expected}")
    code = known.to_epsg(min_confidence=100)
    return f"EPSG:{code}" if code else known.to_wkt("WKT2_2019")


def crs_name(crs: Any) -> str | None:
    """Return a CRS as `name_crs` does; None where there is none, or one that is bound to no place on Earth."""
    try:
        return None if crs is None else name_crs(crs)
    except NoCrsError:
        return None


@lru_cache(maxsize=64)
def _known(crs: str) -> CRS:
    return _checked(crs)


def _checked(crs: Any) -> CRS:
    import pyproj

    _refuse(crs if isinstance(crs, str) else json.dumps(crs, default=str), crs)
    known = pyproj.CRS.from_user_input(crs)  # opens what `init` names; grids are opened on the way to another CRS
    told = known.to_json_dict()
    _refuse("\n".join(all_text(told)), crs)
    for name in _parameter_files(told):
        _refuse(f"grids={name}", crs)
    return known


def _refuse(text: str, crs: Any) -> None:
    found = named_file(text)
    if found:
        raise CrsError(
            f"the CRS {str(crs)[:60]!r} names the file {found[:60]!r}, which is not opened; expected a grid's name "
            "without folders, which PROJ finds among its own"
        )


def named_file(text: str) -> str:
    """Return the first file that a text in any language of CRS names, other than by a bare name; "" for none."""
    named = [name.strip('"') for name in (*_KEYS.findall(text), *_WKT.findall(text), *_JSON.findall(text))]
    defined = [name.strip('"').rsplit(":", 1)[0] for name in _INIT.findall(text)]
    return next((name for name in (*named, *defined) if re.search(r"[/\\:]", name)), "")


def all_text(value: Any) -> Iterator[str]:
    """Yield all text in a value as JSON has them."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for each in value.values() if isinstance(value, dict) else value:
            yield from all_text(each)


def _parameter_files(value: Any) -> Iterator[str]:
    """Yield the text that is the value of a parameter in PROJJSON: of those it is the name of a file."""
    if isinstance(value, dict):
        if isinstance(value.get("value"), str):
            yield value["value"]
        value = list(value.values())
    if isinstance(value, list):
        for each in value:
            yield from _parameter_files(each)
