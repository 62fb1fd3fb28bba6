"""The straight line of a road file: container, table, adapter, lines; of a folder, all its files that are roads."""

from __future__ import annotations

import re
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from roadgeo._text import log_of
from roadgeo.errors import NoRoadsError, RoadgeoError, RoadSourceError
from roadgeo.geometry.projection import transform
from roadgeo.sources.containers import ENDINGS, stream_tables
from roadgeo.sources.lines import RoadLines, join_lines
from roadgeo.sources.osm_files import OSM_ENDINGS
from roadgeo.sources.schemas import Schema, recognise
from roadgeo.storage.geopackage import layer_names
from roadgeo.storage.unpacking import PACKED, unpack
from roadgeo.storage.vectors import first_line, require_file

__all__ = [
    "EXCHANGED",
    "QUERY_ENDINGS",
    "TABLE_ENDINGS",
    "list_sources",
    "read_lines",
    "reading",
    "stream_lines",
    "tell_source",
    "tell_state",
]

_LOG = log_of(__name__)

#: Files that hold lines, not pixels, by their names.
QUERY_ENDINGS = (*ENDINGS, ".json", *(ending + packed for ending in ENDINGS for packed in PACKED), ".zip")
#: Files that may hold lines, but hardly do where nobody says so.
TABLE_ENDINGS = (".csv", ".tsv", ".csv.gz", ".tsv.gz")

#: Files that lie beside road files, or describe them.
_BESIDE = re.compile(
    r"\.(shx|dbf|prj|cpg|sbn|sbx|qpj|qix|qmd|qml|lyrx?|idm|ind|dat|id|map|mid|index|gfs|xsd|aux|xml|txt|md|html?|pdf|log)"
)
#: Number of features by which a file of a folder is recognised as roads.
_LOOK = 20_000
_WHOLE = 1 << 30
EXCHANGED = "exchanged, x for y, they would: swap them, as QGIS does by Swap X and Y Coordinates"


def list_sources(path: Path) -> list[Path]:
    """Return the files of a folder (not of folders in it) that hold roads, by name, or the path itself.

    Passed over, with a message, are results and references of roadgeo, files without roads and, where
    other files have kinds of roads, those that do not.

    Raises
    ------
    RoadSourceError
        Nothing is there, or a folder holds no road file.
    """
    if not path.exists():
        raise RoadSourceError(f"{path}: no such file or folder")
    if not path.is_dir() or path.suffix.lower() == ".gdb":
        return [path]
    return _roads_among(path, sorted(path.iterdir()))


def _roads_among(folder: Path, files: Sequence[Path]) -> list[Path]:
    files = [file for file in files if not file.name.startswith(".")]  # nor what a Macintosh puts beside each
    candidates = [file for file in files if file.name.lower().endswith(QUERY_ENDINGS)]
    others = [file for file in files if file not in candidates]
    unread = Counter("folder" if file.is_dir() else file.suffix.lower() or "without a suffix" for file in others)
    listed = ", ".join(f"{n} {suffix}" for suffix, n in sorted(unread.items()) if not _BESIDE.fullmatch(suffix))
    if listed:
        _LOG.warning("%s: passed over: %s: not read from a folder", folder, listed)
    if not candidates:
        raise RoadSourceError(f"{folder}: no road file in this folder; expected names like *.gpkg, *.shp or *.osm.pbf")
    if len(candidates) == 1:
        return candidates
    why: dict[Path, str] = {}
    tells: dict[Path, bool] = {}
    for file in candidates:
        if _is_own(file):
            why[file] = "a result or a reference of roadgeo"
            continue
        try:
            tells[file] = file.name.lower().endswith(OSM_ENDINGS) or _tells_kinds(file)
        except RoadSourceError as error:
            # By its name a .json, or a packed file, may be anything.
            if not isinstance(error, NoRoadsError) and file.name.lower().endswith(ENDINGS):
                raise
            why[file] = str(error).removeprefix(f"{file}: ")
    if any(tells.values()):
        why |= {
            file: "it does not tell roads from other lines, as others do" for file, tell in tells.items() if not tell
        }
    for file, reason in why.items():
        _LOG.warning(
            "%s: passed over: %s; to take it all the same give it by its name",
            folder / file.name,
            reason,
        )
    kept = [file for file in candidates if file not in why]
    if not kept:
        raise RoadSourceError(f"{folder}: none of its {len(candidates)} files holds roads; name the file that does")
    return kept


def _is_own(file: Path) -> bool:
    """Whether a GeoPackage is a result or a reference of roadgeo."""
    if file.suffix.lower() != ".gpkg":
        return False
    try:
        layers = set(layer_names(file))
    except RoadgeoError:
        return False
    return "query_roads" in layers or layers >= {"intersections", "tangents", "roadgeo_meta"}


def _tells_kinds(file: Path) -> bool:
    """Whether a file has kinds of roads.

    Raises
    ------
    NoRoadsError
        It holds no lines, or none that are roads.
    """
    first = next(stream_lines(file, most=_LOOK))
    if len(first.lines) == 0:
        raise NoRoadsError("no roads in it")
    return first.kinds_known


def read_lines(
    path: Path,
    layer: str | Sequence[str] | None = None,
    advance: Callable[[float], None] = lambda _: None,
    *,
    areas: bool = False,
    whole: bool = False,
) -> RoadLines:
    """Read the lines of a road file that are roads, or may be.

    Parameters
    ----------
    path : Path
    layer : str or sequence of str, optional
        Layers of a file, or of the drawing that it was made of; the one with lines by default.
    advance : callable, optional
        Called with the share of the file that is read.
    areas : bool
        Roads drawn as polygons will do where there are no lines.
    whole : bool
        Lines that a column of a general or unknown name calls something else than roads are wanted, too.

    Raises
    ------
    RoadSourceError
        The file is missing, unreadable, empty or holds no lines.
    """
    parts = list(stream_lines(path, layer, _WHOLE, advance, areas=areas, whole=whole))
    if any(part.crs is None for part in parts) and len({part.crs for part in parts}) > 1:
        raise RoadSourceError(f"{path}: only some of its files or layers name a CRS; read them one by one")
    return join_lines([_in_crs(part, parts[0].crs) for part in parts])


def _in_crs(part: RoadLines, crs: str | None) -> RoadLines:
    """Return lines in a CRS."""
    import shapely

    if crs is None or part.crs is None or part.crs == crs:
        return part
    move = partial(transform, part.crs, crs)
    return replace(part, crs=crs, lines=shapely.transform(part.lines, move), areas=shapely.transform(part.areas, move))


def stream_lines(
    path: Path,
    layer: str | Sequence[str] | None = None,
    most: int = 100_000,
    advance: Callable[[float], None] = lambda _: None,
    *,
    areas: bool = False,
    whole: bool = False,
) -> Iterator[RoadLines]:
    """Yield the lines of a road file as `read_lines` gives them, in parts of bounded size.

    Raises
    ------
    RoadSourceError
        The file is missing, unreadable, empty or holds no lines.
    """
    n, counts = 0, {"no_roads": 0, "without_places": 0}
    with tempfile.TemporaryDirectory(prefix="roadgeo-") as folder, reading(path, folder):
        for file in _unpacked(path, Path(folder)):
            schemas: dict[frozenset[str], Schema] = {}
            for table in stream_tables(file, layer, most, advance, Path(folder), areas=areas):
                names = frozenset(table.columns)
                schema = schemas[names] = schemas.get(names) or recognise(table)
                part = schema.adapt(table, whole)
                n += len(part.lines) + (len(part.areas) if areas else 0)
                counts = {key: value + part.meta.get(key, 0) for key, value in counts.items()}
                yield part
    if n == 0:
        why = "expected the centre lines of roads"
        if counts["without_places"]:
            why = "for the nodes of its ways are not in it: export them too (of Overpass: out body; >; out skel qt;)"
        elif counts["no_roads"]:
            why = f"for its {counts['no_roads']:,} features are something else, such as streams, railways or fences"
        raise NoRoadsError(f"{path}: no {'roads' if counts['no_roads'] else 'lines'} in it, {why}")


def _unpacked(path: Path, folder: Path) -> list[Path]:
    """Return the road files that a file stands for: itself, or what is packed in it."""
    name = path.name.lower()
    if name.endswith(OSM_ENDINGS) or not name.endswith(PACKED):
        return [path]
    unpacked = unpack(path, folder)
    if unpacked.is_file():
        return [unpacked]
    geodatabases = [folder for folder in unpacked.rglob("*.[gG][dD][bB]") if folder.is_dir()]
    return geodatabases or _roads_among(path, sorted(file for file in unpacked.rglob("*") if file.is_file()))


def tell_source(name: str, meta: Mapping[str, Any]) -> None:
    """Report the parts of a source that were left out, or are not known."""
    by = f", by its column {meta['kind_columns']}; --kinds all keeps them" if meta.get("kind_columns") else ""
    reasons = {
        "no_roads": f"are no roads: streams, railways, fences, or not built{by}",
        **({"other_kinds": f"are of other kinds{by}"} if by else {}),
        "broken": "have a vertex that is not finite",
        "without_places": "are ways whose nodes are not in the file",
        "astray": "lie beyond the Earth, or have a vertex at 0, 0 far off all others",
    }
    for key, what in reasons.items():
        if meta.get(key):
            _LOG.warning(
                "%s: left out %s of %s features, which %s", name, f"{meta[key]:,}", f"{meta['features']:,}", what
            )
    tell_state(name, meta)
    if meta.get("without_kind"):
        kindless, kept = f"{meta['without_kind']:,}", f"{meta['kept']:,}"
        _LOG.warning("%s: %s of %s lines have no kind of road; they are taken, paths too", name, kindless, kept)
    if not meta["kinds_known"]:
        _LOG.warning(
            "%s: no column tells what kind of road a line is (as highway, fclass or class do): all %s lines are taken, "
            "paths too, and --kinds does nothing%s",
            name,
            f"{meta['kept']:,}",
            f"; --layer chooses by {meta['levels']}" if "levels" in meta else "",
        )


def tell_state(name: str, meta: Mapping[str, Any]) -> None:
    """Report faults of a source as a whole."""
    faults = {
        "exchanged": f"its coordinates do not lie where its CRS is made for; {EXCHANGED}",
        "part": meta.get("part"),
        "encoding": "its text is not in the encoding that it names; read as Latin-1, names may be garbled",
    }
    for key, fault in faults.items():
        if key in meta:
            _LOG.warning("%s: %s", name, fault)


@contextmanager
def reading(path: Path, unpacked: str | None = None) -> Iterator[None]:
    """Turn what goes wrong with a road file, or with what is unpacked of it, into a `RoadSourceError` that names it."""
    require_file(path)
    try:
        yield
    except RoadSourceError as error:
        said = str(error).replace(unpacked or str(path), str(path))
        if said == str(error) and str(path) in said:
            raise
        raise type(error)(said if str(path) in said else f"{path}: {said}") from error
    except (RoadgeoError, MemoryError, ImportError):
        raise
    except Exception as error:  # many libraries read such files, and a damaged one may make them raise anything
        raise RoadSourceError(f"{path}: not readable as a map of roads: {first_line(error)}; is it damaged?") from error
