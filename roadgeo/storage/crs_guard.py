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

from roadgeo.errors import RoadSourceError
from roadgeo.storage.crs import all_text, named_file
from roadgeo.storage.sqlite import opened

__all__ = ["refuse_named_files"]

#: The CRS of GeoJSON and of ESRI's JSON; GDAL takes either quote.
_KEYS = (b'"crs"', b"'crs'", b"[\"']spatialReference[\"']")
#: Letters that may be written as escapes: where there are any, all ways to write "crs".
_ESCAPES = (rb"\u0063", rb"\u0072", rb"\u0073")
_CRS = re.compile(rb"[\"'](?:c|\\u0063)(?:r|\\u0072)(?:s|\\u0073)[\"']|[\"']spatialReference[\"']")
#: A file with more such texts than this, none of them JSON, is no map.
_MOST_PUZZLING = 8
#: The CRS of GML, and the markup that could hide it.
_SRS_NAME = re.compile(rb"srsName\s*=\s*(\"[^\"]*|'[^']*)")
_DATA = re.compile(rb"<data\s[^<>]*>([^<>]*[=\[{][^<>]*)<")
#: A CRS is searched within this many bytes after its key, and at the beginning of binary formats.
_WINDOW = 1 << 16


def refuse_named_files(path: Path) -> None:
    """Refuse a map whose CRS would have any other file opened, or lies elsewhere, or where a part beside it is a pipe.

    Raises
    ------
    RoadSourceError
        It would.
    """
    _require_regular(path)
    for text in _texts(path):
        name = named_file(text)
        if name:
            raise RoadSourceError(
                f"{path}: its CRS names the file {name[:60]!r}, which is not opened; name one such as EPSG:26986 in it"
            )


def _require_regular(path: Path) -> None:
    """Refuse parts of a map (of a geodatabase, or files of its name) that are no regular files."""
    folder, start = (path, "") if path.is_dir() else (path.parent, f"{path.stem}.")
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.name.startswith(start) and not entry.is_dir():
                try:
                    regular = stat.S_ISREG(entry.stat().st_mode)
                except OSError:  # a link that leads nowhere
                    continue
                if not regular:
                    raise RoadSourceError(f"{path}: {entry.name} beside it is no regular file; remove it")


def _texts(path: Path) -> Iterator[str]:
    """Yield the parts of a file, and of those beside it, that may hold a CRS, decoded as far as its format requires."""
    if path.is_dir():
        for table in path.glob("*.gdbtable"):
            yield _plain(_start(table))
        return
    for ending in (".prj", ".PRJ", ".qpj"):
        beside = path.with_suffix(ending)
        if beside.is_file():
            yield _plain(_start(beside))
    head = _start(path, 512)
    if head.startswith(b"SQLite format 3\0"):
        yield from _of_sqlite(path)
    elif head.startswith(b"fgb"):
        yield _plain(_start(path, 12 + int.from_bytes(head[8:12], "little")))
    elif head.lstrip(b"\xef\xbb\xbf \t\r\n")[:1] in (b"{", b"[", b"<"):
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            yield from _of_xml(content) if b"<" in head[:8] else _of_json(path, content)
    elif head.startswith(b"PAR1"):
        yield from _of_parquet(path)


def _start(path: Path, most: int = _WINDOW) -> bytes:
    with path.open("rb") as file:
        return file.read(min(most, 1 << 24))


def _plain(content: bytes) -> str:
    """Return bytes as text, UTF-16 too: names of files are recognised by letters of ASCII alone."""
    return content.replace(b"\0", b"").decode("latin-1")


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
                    yield from (_plain(bytes(value)) if isinstance(value, bytes) else str(value) for value in row)
    except sqlite3.Error as error:
        raise RoadSourceError(f"{path}: not readable as SQLite: {error}") from error


def _of_parquet(path: Path) -> Iterator[str]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        told = json.loads((pq.read_schema(path).metadata or {}).get(b"geo", b"{}"))
    except (pa.ArrowException, ValueError, RecursionError, OSError):  # the reader will report it
        return
    yield json.dumps(told)
    yield from all_text(told)


def _of_xml(content: mmap.mmap) -> Iterator[str]:
    """Yield the CRS of GML, and of the attributes of a GraphML."""
    if content.find(b"<!ENTITY") >= 0:  # would be put in the place of names, where they are not looked for
        yield "file=/ENTITY"
    told = _DATA if content.find(b"graphml", 0, 4096) >= 0 else _SRS_NAME
    for match in told.finditer(content):
        yield html.unescape(match[1].decode("latin-1"))


def _of_json(path: Path, content: mmap.mmap) -> Iterator[str]:
    """Yield the text after each key of a CRS, its escapes resolved; as it stands where it is no JSON."""
    keys = [_CRS] if any(content.find(letter) >= 0 for letter in _ESCAPES) else [re.compile(key) for key in _KEYS]
    puzzling = 0
    for match in (match for key in keys for match in key.finditer(content)):
        for window in (1 << 12, 1 << 24):
            text = content[match.end() : match.end() + window].decode("utf-8", "replace").lstrip(" \t\r\n:")
            try:
                told = json.JSONDecoder().raw_decode(text)[0]
                yield from all_text(told)
            except (ValueError, RecursionError):
                continue
            if isinstance(told, dict) and str(told.get("type")).lower() in ("link", "url"):
                raise RoadSourceError(f"{path}: gives its CRS as a link, which is not followed; name it in the file")
            break
        else:
            puzzling += 1
            yield text if puzzling < _MOST_PUZZLING else "file=/"
