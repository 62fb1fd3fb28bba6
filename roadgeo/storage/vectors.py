"""The one place that opens vector files of strangers with GDAL: few drivers, no network, no views.

GDAL chooses its driver by content, and some drivers fetch what a file names, run programs, or read any other file.
While a file is read only those below are registered, and its network leads nowhere. Pyogrio's GDAL is its own; the
other drivers are registered again afterwards, for this may be part of a larger program.
"""

from __future__ import annotations

import os
import re
import sqlite3
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from roadgeo._arrays import AnyArray
from roadgeo.errors import RoadSourceError
from roadgeo.storage.fence import remedy
from roadgeo.storage.gdal import CONSENT, NETWORK, OWN_SHIFT, allowed_drivers
from roadgeo.storage.sqlite import opened, table_problem

__all__ = [
    "Description",
    "VectorLayer",
    "beside",
    "describe_layer",
    "few_drivers",
    "first_line",
    "list_layers",
    "read_layer",
    "require_file",
]

#: GDAL's names of the drivers that may read; they read the file, and those beside it that belong to it.
_DRIVERS = {
    *("CSV", "DXF", "ESRI Shapefile", "ESRIJSON", "FlatGeobuf", "GML", "GPKG", "GPX", "GeoJSON", "GeoJSONSeq", "KML"),
    *("LIBKML", "MapInfo File", "OpenFileGDB", "SQLite", "TopoJSON"),
}

#: Tables that GDAL reads to find out what a GeoPackage or SpatiaLite file holds.
_OWN_TABLES = (
    "SELECT name FROM sqlite_master WHERE type IN ('table', 'view') AND (name LIKE 'gpkg@_%' ESCAPE '@'"
    " OR name LIKE '%geometry_columns' OR name = 'spatial_ref_sys')"
)

_LOCK = threading.RLock()
_alone = False  # whether the drivers that may read are the only ones; changed by whoever has the lock
_BREAK = re.compile(r"[\t\r\n]")


class VectorLayer(NamedTuple):
    """One layer as it stands in its file. Dimension: N features.

    Attributes
    ----------
    shapes : (N,) object, WKB, or None where the layer has no geometry
    columns : (N,) object each, by name
    crs : str or None
    notes : dict
        `encoding`, where text was not in the encoding that the file names.
    """

    shapes: AnyArray | None
    columns: dict[str, AnyArray]
    crs: str | None
    notes: dict[str, str]


class Description(NamedTuple):
    """A layer as its file describes it."""

    n_features: int
    columns: list[str]
    driver: str


def list_layers(path: Path) -> list[tuple[str, str]]:
    """Return the names and geometry types of a file's layers.

    Raises
    ------
    RoadSourceError
        The file cannot be read, or not without opening others.
    """
    import pyogrio

    with _guarded(path) as file:
        return [(str(name), str(kind)) for name, kind in pyogrio.list_layers(file)]


def describe_layer(path: Path, layer: str) -> Description:
    """Describe a layer, as its file claims; errors as of `list_layers`."""
    import pyogrio

    with _guarded(path, layer) as file:
        info, _ = _decoded(lambda **more: pyogrio.read_info(file, layer=layer, force_feature_count=True, **more))
        return Description(int(info["features"]), [str(name) for name in info["fields"]], str(info["driver"]))


def read_layer(
    path: Path, layer: str | None, columns: Sequence[str], skip: int = 0, most: int | None = None
) -> VectorLayer:
    """Read a layer (the first by default), with the named columns, as far as it has them.

    The first `skip` features are left out, and a bounded number is read. Text that is not in the encoding that the file
    names is read as Latin-1, which may garble it, and that is reported. It raises as `list_layers` does.
    """
    import pyogrio

    with _guarded(path) as file:
        layer = layer or str(pyogrio.list_layers(file)[0][0])
        _require_stored(path, layer)
        part = {"skip_features": skip, "max_features": most, "columns": list(columns), "force_2d": True}
        decoded, notes = _decoded(lambda **more: pyogrio.raw.read(file, layer=layer, **part, **more))
    meta, _, shapes, values = decoded
    named = {name.lower(): column for name, column in zip(meta["fields"], values, strict=True)}
    return VectorLayer(shapes, named, meta["crs"], notes)


def _decoded(read: Callable[..., Any]) -> tuple[Any, dict[str, str]]:
    """Return the text, as Latin-1 where it is not in the encoding that its file names, and whether that is so."""
    try:
        return read(), {}
    except UnicodeDecodeError:
        return read(encoding="ISO-8859-1"), {"encoding": "Latin-1"}


def require_file(path: Path) -> None:
    """Raise `RoadSourceError` unless a path is a regular file, or a folder that is a geodatabase."""
    if not path.exists():
        raise RoadSourceError(f"{path}: no such file")
    if not path.is_file() and not (path.is_dir() and path.suffix.lower() == ".gdb"):
        raise RoadSourceError(f"{path}: is no regular file; save the roads in one first")


@contextmanager
def _guarded(path: Path, layer: str | None = None) -> Iterator[Path]:
    """Check all that needs no GDAL, then read with as little of it as possible; yield the source to open."""
    from pyogrio.errors import CRSError, DataLayerError, DataSourceError

    require_file(path)
    _require_stored(path, layer)
    file = path
    try:
        with few_drivers(), _offline(), _aside(path) as file, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield file
    except (CRSError, UnboundLocalError) as error:  # the latter is pyogrio's
        reason = "it is no text in UTF-8" if isinstance(error, UnboundLocalError) else first_line(error)
        raise RoadSourceError(f"{path}: names an unknown CRS: {reason}") from error
    except (DataSourceError, DataLayerError, UnicodeDecodeError) as error:
        reason = "of a format that is not read here" if "not recognized" in str(error) else first_line(error)
        reason = re.sub(r"^\S+\.cpp, \d+: ", "", reason.replace(str(file), str(path)))
        hint = f"; save it as GeoPackage, or allow GDAL's driver with {CONSENT}" if reason.startswith("of") else ""
        raise RoadSourceError(f"{path}: not readable as a map of roads: {reason}{hint}{remedy(reason)}") from error


@contextmanager
def _aside(path: Path) -> Iterator[Path]:
    """Yield a link in a passing folder to a file beside which GDAL writes, or whose path pyogrio would cut at a break.

    Beside an XML file it writes what it found in it, beside a shapefile a new index where that is missing or damaged.
    """
    import pyogrio

    is_shapefile = path.suffix.lower() == ".shp" and path.is_file() and not _has_index(path)
    is_broken = _BREAK.search(str(path.absolute())) is not None
    if not is_broken and (not path.is_file() or not (is_shapefile or _head(path)[:1] == b"<")):
        yield path
        return
    files = [file for file in beside(path) if not (is_shapefile and file.suffix.lower() == ".shx")]
    with tempfile.TemporaryDirectory(prefix="roadgeo-") as folder:
        link = Path(folder) / _BREAK.sub("_", path.name)
        try:
            for file in files:
                (Path(folder) / _BREAK.sub("_", file.name)).symlink_to(file.absolute())
        except OSError:  # no links here (Windows, without leave)
            link = path
        pyogrio.set_gdal_config_options({"SHAPE_RESTORE_SHX": "YES" if is_shapefile and link != path else None})
        try:
            yield link
        finally:
            pyogrio.set_gdal_config_options({"SHAPE_RESTORE_SHX": None})


def beside(path: Path) -> list[Path]:
    """Return the files of a folder that share a file's stem: its own parts."""
    return [file for file in path.absolute().parent.iterdir() if file.stem == path.stem]


def _has_index(path: Path) -> bool:
    """Whether a shapefile has an index that is as long as it says."""
    index = next((file for file in beside(path) if file.suffix in (".shx", ".SHX")), None)
    stated = b"" if index is None else index.read_bytes()[24:28]
    return index is not None and 0 < 2 * int.from_bytes(stated, "big") == index.stat().st_size


def _head(path: Path) -> bytes:
    """Return how a file begins, less a byte order mark and blanks."""
    with path.open("rb") as file:
        return file.read(512).lstrip(b"\xef\xbb\xbf \t\r\n")


@cache
def _drivers(_skipped: str | None) -> set[str]:
    """Return the names of all drivers of pyogrio's GDAL, of which some are skipped: to list them takes a while."""
    import pyogrio

    return set(pyogrio.list_drivers())


@contextmanager
def few_drivers() -> Iterator[None]:
    """Have pyogrio's GDAL know only the drivers above, and those that the user allows.

    Each look at a file does so. To leave drivers out takes longer than most looks, so a caller with several holds this
    around them.
    """
    global _alone
    import pyogrio
    from pyogrio import core

    with _LOCK:
        if _alone:
            yield
            return
        kept = _DRIVERS | set(allowed_drivers())
        given = pyogrio.get_gdal_config_option("GDAL_SKIP")
        left_out = ",".join(sorted(_drivers(given) - kept))
        pyogrio.set_gdal_config_options({"GDAL_SKIP": f"{left_out},"})
        core._register_drivers()
        _alone = True
        try:
            yield
        finally:
            _alone = False
            pyogrio.set_gdal_config_options({"GDAL_SKIP": None if given == os.environ.get("GDAL_SKIP") else given})
            core._register_drivers()


@contextmanager
def _offline() -> Iterator[None]:
    """Let no request of pyogrio's GDAL reach anything; a file's own datum shift stays."""
    import pyogrio

    # Blocks of a drawing within blocks have no end.
    options = {**NETWORK, **OWN_SHIFT, "GML_DOWNLOAD_SCHEMA": "NO", "DXF_INLINE_BLOCKS": "NO"}
    before = {name: pyogrio.get_gdal_config_option(name) for name in options}
    exempt = {name: os.environ.pop(name) for name in ("no_proxy", "NO_PROXY") if name in os.environ}
    pyogrio.set_gdal_config_options(options)
    try:
        yield
    finally:
        pyogrio.set_gdal_config_options(before)
        os.environ.update(exempt)


def _require_stored(path: Path, layer: str | None) -> None:
    """Refuse what an SQLite file computes in place of storing it: its own tables, which GDAL reads, and the layer."""
    if not path.is_file() or not _head(path).startswith(b"SQLite format 3\0"):
        return
    try:
        with opened(path) as database:
            names = [name for (name,) in database.execute(_OWN_TABLES)] + ([] if layer is None else [layer])
            problem = next(filter(None, (table_problem(database, name) for name in names)), "")
            if layer is not None and not problem:
                quoted = '"' + layer.replace('"', '""') + '"'
                database.execute(f"SELECT sum(1) FROM {quoted}").fetchone()  # noqa: S608 - ends within the work allowed
    except sqlite3.Error as error:
        raise RoadSourceError(f"{path}: not readable as SQLite: {error}") from error
    if problem:
        raise RoadSourceError(f"{path}: {problem}; save the roads as a table of their own")


def first_line(error: BaseException) -> str:
    """Return the first line of a foreign error's message, short."""
    text = (str(error) or type(error).__name__).strip().splitlines()
    return text[0][:200] if text else type(error).__name__
