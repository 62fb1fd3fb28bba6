"""Limits on a CRS from a stranger's file: PROJ opens no file but its own grids.

A CRS may name grids to shift by (`+nadgrids=`, `PARAMETERFILE`, `EXTENSION["PROJ4_GRIDS", ...]`), or a file that
defines it (`+init=`), by any path: GDAL and PROJ open that while they read the CRS, be it a pipe that nobody writes to.
Names without folders are looked for among PROJ's own, and are allowed.
"""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Iterator
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from roadgeo.errors import CrsError

if TYPE_CHECKING:
    from pyproj import CRS

__all__ = ["NoCrsError", "all_text", "crs_name", "file_in_bytes", "known_crs", "name_crs", "named_file"]

#: Keys of PROJ's strings that take files, "value" PROJJSON's; pyproj drops a plus or a blank beside the sign.
_KEYS = re.compile(
    r"(?:(?:grids|file|model|^value)[\s+]*=[\s+]*|\"value\"\s*:\s*)(?:\"+([^\"]*)|([^\s\"]*))", re.I | re.M
)
_INIT = re.compile(r"init[\s+]*=[\s+]*\"*([^\s\"]*)", re.IGNORECASE)
#: The usual forms of file names in WKT, and what PROJ takes for one besides: any path behind these words.
_WKT = re.compile(
    r'(?:PARAMETERFILE\s*[\[(]\s*"(?:[^"]|"")*"|EXTENSION\s*[\[(]\s*"PROJ4_GRIDS")\s*,\s*"((?:[^"]|"")*)"',
    re.IGNORECASE,
)
_WORDS = re.compile(r"PROJ4_GRIDS|PARAMETERFILE", re.IGNORECASE)
_PATH = re.compile(r"(?<=[\"\[(,=@\s])(?:~?/|\.{1,2}[/\\]|\\|[a-z]:[/\\]|https?:)[^\s\"\])]+", re.IGNORECASE)
#: WKT may be written with these quotes (UTF-8 is taken for Latin-1 here); most files hold none of these words.
_QUOTES = ("\u201c", "\u201d", "\u201c".encode().decode("latin-1"), "\u201d".encode().decode("latin-1"))
_HINTS = (b"grids", b"parameterfile", b"init", b"tinshift", b"defmodel")
_CHUNK, _OVERLAP = 1 << 18, 1 << 12


class NoCrsError(CrsError):
    """The given text is no CRS, or none of places on Earth."""


def known_crs(crs: Any) -> CRS:
    """Return a CRS as pyproj knows it, of whatever pyproj takes for one.

    Raises
    ------
    CrsError
        It names a file that PROJ does not own.
    pyproj.exceptions.CRSError
        It is no CRS.
    """
    return _known(crs) if isinstance(crs, str) else _checked(crs)


def name_crs(crs: Any) -> str:
    """Return a CRS as all libraries read it, "EPSG:n" or else WKT2, of whatever pyproj takes for one.

    That is a code (3857, "EPSG:3857", "ESRI:102003"), a name ("OSGB36 / British National Grid"), WKT, PROJJSON ...

    Raises
    ------
    NoCrsError
        It is no CRS, or not one of places on a map.
    CrsError
        It names a file that PROJ does not own.
    """
    from pyproj.exceptions import CRSError

    text = f"{str(crs)[:60]!r}"
    expected = "expected for example EPSG:3857, 3857, a name such as 'WGS 84 / UTM zone 29N', or WKT"
    try:
        known = known_crs(crs)
    except CRSError as error:
        raise NoCrsError(f"{text} is no CRS that PROJ knows; {expected}") from error
    known = known.to_2d() if len(known.axis_info) == 3 else known
    if not (known.is_geographic or known.is_projected):
        raise NoCrsError(f"{text} is no CRS of a map, but a {known.type_name}; {expected}")
    code = known.to_epsg(min_confidence=100)
    return f"EPSG:{code}" if code else known.to_wkt("WKT2_2019")


def crs_name(crs: Any) -> str | None:
    """Return a CRS as `name_crs` does; None without one, or where it is bound to no place on Earth."""
    try:
        return None if crs is None else name_crs(crs)
    except NoCrsError:
        return None


@lru_cache(maxsize=64)
def _known(crs: str) -> CRS:
    return _checked(crs)


def _checked(crs: Any) -> CRS:
    import pyproj

    _refuse(crs)
    known = pyproj.CRS.from_user_input(crs)  # opens what `init` names; grids are opened on the way to another CRS
    _refuse(known.to_json_dict(), crs)
    return known


def _refuse(source: Any, crs: Any = None) -> None:
    """Refuse a CRS that names a file, given in whatever way pyproj takes it."""
    crs = source if crs is None else crs
    found = named_file("\n".join(all_text(source)) if isinstance(source, dict | list) else str(source))
    if found:
        raise CrsError(
            f"the CRS {str(crs)[:60]!r} names the file {found[:60]!r}, which is not opened; expected a grid's name "
            "without folders, which PROJ finds among its own"
        )


def named_file(text: str) -> str:
    """Return the first file that a text in any language of CRS names, other than by a bare name; "" for none."""
    if text.lstrip().startswith("{"):
        with contextlib.suppress(ValueError):  # which no reader of PROJJSON takes
            try:
                text = "\n".join(all_text(json.loads(text, strict=False, parse_int=str)))
            except RecursionError:
                return "{/"
    for quote in _QUOTES:
        text = text.replace(quote, '"')
    named = [name for names in _KEYS.findall(text) for name in names] + _WKT.findall(text)
    defined = [name.rsplit(":", 1)[0] for name in _INIT.findall(text)]
    found = next((name for name in (*named, *defined) if re.search(r"[/\\:]", name)), "")
    word = None if found else _WORDS.search(text)
    path = word and _PATH.search(text, word.end())
    return path[0] if path else found


def file_in_bytes(content: Any) -> str:
    """Return the first file that a CRS anywhere in bytes (or a mapped file) names, as `named_file` does.

    The content is not parsed, for a library may parse it otherwise; UTF-16 is found too.
    """
    behind = False
    for start in range(0, len(content), _CHUNK):
        part = content[start : start + _CHUNK + _OVERLAP].replace(b"\0", b"")
        if behind or any(hint in part.lower() for hint in _HINTS):
            text = part.decode("latin-1")
            path = _PATH.search(text) if behind else None
            found = path[0] if path else named_file(text)
            if found:
                return found
            behind = behind or _WORDS.search(text) is not None
    return ""


def all_text(value: Any, key: str = "") -> Iterator[str]:
    """Yield all text in a value as JSON has them, as "key=text"."""
    if isinstance(value, str):
        yield f"{key}={value}"
    elif isinstance(value, dict):
        for name, each in value.items():
            yield from all_text(each, name)
    elif isinstance(value, list):
        for each in value:
            yield from all_text(each, key)
