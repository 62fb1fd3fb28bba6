"""CRS in vector files that name other files, or lie elsewhere: both are found before GDAL opens them.

`storage.crs` defines which names a CRS may not have. Here stands where each format keeps its CRS.
"""

from __future__ import annotations

import html
import json
import mmap
import os
import re
import sqlite3
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from roadgeo.errors import RoadSourceError
from roadgeo.storage.crs import all_text, file_in_bytes, named_file
from roadgeo.storage.sqlite import opened

__all__ = ["refuse_named_files"]

#: The CRS of GeoJSON and of ESRI's JSON: GDAL takes either quote, letters of any case, and letters written as escapes.
_CRS = re.compile(
    b"[\"'](?:%s)[\"']"
    % b"|".join(
        b"".join(b"(?:%c|\\\\u00(?:%02x|%02x))" % (letter, letter, letter ^ 32) for letter in key)
        for key in (b"crs", b"spatialreference")
    ),
    re.IGNORECASE,
)
_WINDOWS = (1 << 12, 1 << 24)  # a CRS is decoded out of so many bytes
#: The CRS of GML, and the markup that could hide it.
_SRS_NAME = re.compile(rb"srsName\s*=\s*(\"[^\"]*|'[^']*)")
#: Words that send MapInfo's reader to other tables.
_OTHER_TABLES = re.compile(rb"open\s+table|create\s+view|isseamless", re.IGNORECASE)
_HEAD = 1 << 13


def refuse_named_files(path: Path) -> None:
    """Refuse a map whose CRS would have any other file opened, or lies elsewhere, or where a part beside it is a pipe.

    Raises
    ------
    RoadSourceError
        It would.
    """
    for part in _parts(path):
        if path.is_dir() or part.suffix.lower() in (".prj", ".qpj"):
            _refuse(path, _file_in(part))
    if not path.is_dir():
        for text in _texts(path):
            _refuse(path, named_file(text))


def _refuse(path: Path, name: str) -> None:
    if name:
        raise RoadSourceError(
            f"{path}: its CRS names the file {name[:60]!r}, which is not opened; name one such as EPSG:26986 in it"
        )


def _parts(path: Path) -> list[Path]:
    """Return the files of a geodatabase, or the files of a map's name; refuse what is no regular file among them."""
    folder, start = (path, "") if path.is_dir() else (path.parent, f"{path.stem}.")
    parts = []
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.name.lower().startswith(start.lower()) and not entry.is_dir():  # disks ignore case
                try:
                    regular = stat.S_ISREG(entry.stat().st_mode)
                except OSError:  # a link that leads nowhere
                    continue
                if not regular:
                    raise RoadSourceError(f"{path}: {entry.name} beside it is no regular file; remove it")
                parts.append(Path(entry.path))
    return parts


def _file_in(path: Path) -> str:
    """Return the file that any CRS in a file names."""
    if not path.stat().st_size:
        return ""
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        return file_in_bytes(content) or named_file(content[: _WINDOWS[0]].decode("latin-1"))


def _texts(path: Path) -> Iterator[str]:
    """Yield the parts of a file that may hold a CRS, decoded as far as its format requires."""
    with path.open("rb") as file:
        head = file.read(_HEAD)
    text = head.replace(b"\0", b"").lstrip(b"\xef\xbb\xbf\xff\xfe\x1e \t\r\n")
    if head.startswith(b"SQLite format 3\0"):
        yield from _of_sqlite(path)
    elif head.startswith(b"fgb"):
        with path.open("rb") as file:
            yield file.read(min(12 + int.from_bytes(head[8:12], "little"), _WINDOWS[-1])).decode("latin-1")
    elif head.startswith((b"PK\3\4", b"\x1f\x8b")):
        raise RoadSourceError(f"{path}: is packed, whatever its name says; unpack it, or name it .zip or .gz")
    elif text.startswith(b"<") or b"{" in text[:32]:  # GDAL takes JSON behind the names of functions, too
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            yield from _of_xml(content) if text.startswith(b"<") else _of_json(path, content)
    elif path.suffix.lower() == ".tab" and _OTHER_TABLES.search(path.read_bytes()):
        raise RoadSourceError(f"{path}: is a view of other tables, which are not opened; save it as one table")


def _of_sqlite(path: Path) -> Iterator[str]:
    """Yield all text of the tables of CRS of a GeoPackage or a SpatiaLite file."""
    try:
        with opened(path) as database:
            for table in ("gpkg_spatial_ref_sys", "spatial_ref_sys"):
                try:
                    rows = database.execute(f"SELECT * FROM {table}")  # noqa: S608 (one of two names)
                except sqlite3.OperationalError:  # it has none
                    continue
                for row in rows:
                    yield from (
                        value.replace(b"\0", b"").decode("latin-1") if isinstance(value, bytes) else str(value)
                        for value in row
                    )
    except sqlite3.Error as error:
        raise RoadSourceError(f"{path}: not readable as SQLite: {error}") from error


def _of_xml(content: mmap.mmap) -> Iterator[str]:
    """Yield the CRS of GML."""
    if content.find(b"<!ENTITY") >= 0:  # would be put in the place of names, where they are not looked for
        yield "file=/ENTITY"
    for match in _SRS_NAME.finditer(content):
        yield html.unescape(match[1][1:].decode("latin-1"))


def _of_json(path: Path, content: mmap.mmap) -> Iterator[str]:
    """Yield all text of each CRS, its escapes resolved; refuse those that only lenient readers understand."""
    for match in _CRS.finditer(content):
        text = content[match.end() : match.end() + _WINDOWS[0]].lstrip()
        if not text.startswith((b":", b"/")):  # a value, or a word in a text
            continue
        document = _decoded(content[match.end() : match.end() + _WINDOWS[1]], path)
        if isinstance(document, dict) and str(document.get("type")).lower() in ("link", "url"):
            raise RoadSourceError(f"{path}: gives its CRS as a link, which is not followed; name it in the file")
        yield from all_text(document)


def _decoded(content: bytes, path: Path) -> Any:
    """Return the value behind a key as any reader of JSON understands it."""
    decoder = json.JSONDecoder(object_pairs_hook=_only_once)
    for most in _WINDOWS:
        text = content[:most].decode("utf-8", "replace").lstrip(" \t\r\n")
        try:
            return decoder.raw_decode(text.removeprefix(":").lstrip(" \t\r\n"))[0]
        except (ValueError, RecursionError):
            continue
    raise RoadSourceError(f"{path}: what it says of its CRS is no valid JSON; save it again")


def _only_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Make an object of its parts: of a key that stands there twice readers take the first or the last."""
    if len(made := dict(pairs)) < len(pairs):
        raise ValueError("a key stands there twice")
    return made
