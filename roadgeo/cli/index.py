"""`roadgeo index`: roads in, a reference out."""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import click

from roadgeo._options import option, part, take
from roadgeo._progress import Say
from roadgeo._text import counted
from roadgeo.cli.options import Engine, Plugin, Shared, Verbosity, command, installed, make_cluster
from roadgeo.cli.printing import echo, is_set, tell
from roadgeo.geometry.areas import Box
from roadgeo.matching.hints import read_box, read_place
from roadgeo.roads.kinds import RoadKind
from roadgeo.storage.crs import name_crs

if TYPE_CHECKING:
    from roadgeo.sources.roads import Roads

__all__ = ["index_command"]

SOURCE, ROADS, RESULT, PIECES = "Where the roads come from", "Which roads", "The reference", "In pieces"


def _read_shards(text: str) -> dict[str, Any]:
    """Read how a map is cut, as options of the build: "auto", about how many shards, or the side of square ones."""
    if text == "auto":
        return {}
    if text.isdecimal() and int(text) > 0:
        return {"count": int(text)}
    size = re.fullmatch(r"(\d+\.?\d*|\.\d+) ?km", text)
    if size and 1 <= float(size[1]) <= 1000:
        return {"size_m": 1000.0 * float(size[1])}
    raise ValueError(f"got {text!r}, expected auto, a number, or a side such as 25km (1 to 1000)")


# fmt: off
@dataclass(frozen=True, kw_only=True)
class Index:
    """The parameters of `roadgeo index`."""

    place: str | None = option("--osm", "PLACE", SOURCE, "Fetch the roads of a place from OpenStreetMap.")
    bbox: Box | None = option("--bbox", "W,S,E,N", SOURCE, "Fetch those in a box, degrees; or cut --roads to it.",
        read=read_box)
    around: tuple[float, float, float] | None = option("--around", "LON,LAT,METRES", SOURCE,
        "Fetch those within a distance of a point.", read=read_place)
    polygon: str | None = option("--polygon", "FILE", SOURCE, "Fetch those inside a polygon of a file.",
        type=click.Path())
    roads: tuple[str, ...] = option("--roads", "FILE", SOURCE,
        "Take roads from a file or a folder of files. Repeatable.", type=click.Path(), multiple=True, default=())
    plugin: str | None = option("--source", "NAME:WHERE", SOURCE,
        "Take roads from a plugin; `roadgeo --plugins` lists them.",
        type=Plugin(partial(installed, "roadgeo.sources"), has_argument=True), rare=True)
    layer: tuple[str, ...] = option("--layer", "NAME", SOURCE,
        "Layer of --roads, or of the drawing that they were made of, where there are several. Repeatable.", default=())
    crs: str | None = option("--crs", "CRS", SOURCE, "CRS of --roads, where the file does not say, such as EPSG:26986.",
        read=name_crs)
    kinds: RoadKind = option("--kinds", None, ROADS,
        "Which roads: those that the masks show.", default="drivable", show_default=True)
    tunnels: bool = option("--tunnels", "", ROADS, "Take tunnels too, which a camera does not see.", rare=True)
    attribution: str | None = option("--attribution", "TEXT", ROADS,
        "Whom to name beside the map, where --roads does not say.", rare=True)
    date: str | None = option("--date", "YYYY-MM-DD", SOURCE, "Fetch the roads as they were on that day.", rare=True)
    overpass_url: str | None = option("--overpass-url", "URL", SOURCE, "Overpass server to fetch from.", rare=True)
    nominatim_url: str | None = option("--nominatim-url", "URL", SOURCE, "Nominatim server that finds --osm places.",
        rare=True)
    no_cache: bool = option("--no-cache", "", SOURCE, "Fetch anew what was fetched before.", rare=True)
    coarse: bool = option("--coarse", "", ROADS,
        "Draw main roads alone, as pixels of 2 to 12 m show them: a map of a whole region, for images of 5 to 50 km.")
    rebuild: str | None = option("--rebuild", "REF", RESULT,
        "Build the index of REF again from its GeoPackage alone, after an edit in QGIS for example.")
    name: str | None = option("--name", "NAME", RESULT,
        "Name of the reference. Default: after the place, else after REF.gpkg or the file.")
    out: str | None = option("-o --out", "REF.gpkg", RESULT,
        "Where it goes. Default: into the library, under its name.", type=click.Path())
    replace: bool = option("--replace", "", RESULT, "Replace a reference of that name without asking.")
    shards: dict[str, Any] | None = option("--shards", "auto|N|SIZEkm", PIECES,
        "Build REF.shards, in pieces. As many as is good, about N, or squares of a side: for maps of any size.",
        read=_read_shards)
    margin: float = option("--margin", "METRES", PIECES,
        "Ground that neighbours share. Half the diagonal of the largest frame to locate.",
        limits=(0, 100_000), default=3000.0, show_default=True, rare=True)
    jobs: int = option("-j --jobs", "N", PIECES,
        "Processes, each of which builds a piece at a time.", limits=(1, None), default=1, show_default=True)
    engine: Engine | None = take(Shared, "engine", group=PIECES)
    scheduler: str | None = take(Shared, "scheduler", group=PIECES)
    verbosity: Verbosity = part(Verbosity)
# fmt: on


@command("index", Index)
def index_command(asked: Index) -> None:
    """Build a reference: draw the roads of a place as a mask shows them, and index their intersections.

    Done once per place; `roadgeo locate` then searches it. The result is REF.gpkg, which opens styled in QGIS, and
    REF.index beside it. Without --out it goes into the library, which `roadgeo locate` searches by default.

    \b
    Examples:
      roadgeo index --osm "Boston, MA"
      roadgeo index --bbox=-71.19,42.23,-70.95,42.44 --name boston
      roadgeo index --roads streets.shp --crs EPSG:26986 --out maps/streets.gpkg
      roadgeo index --roads massachusetts.osm.pbf --bbox=-71.19,42.23,-70.95,42.44
      roadgeo index --rebuild maps/streets.gpkg
      roadgeo index --roads germany.osm.pbf --shards auto --jobs 4
      roadgeo index --osm "Massachusetts" --coarse --name massachusetts-main
    \f

    With --shards a map of any size is built piece by piece from road files, in as much memory as one piece needs; the
    result is a folder, REF.shards, and is searched as one map. The same command goes on with a build cut short.
    """
    from roadgeo.cli.compilation import compile_once
    from roadgeo.cli.progress import show_steps
    from roadgeo.reference.library import make_slug, new_reference
    from roadgeo.reference.reference import COARSE
    from roadgeo.storage.files import make_folder
    from roadgeo.workflows import build_reference

    started = perf_counter()
    if asked.rebuild is not None:
        others = (*_FETCHED, "bbox", "roads", "plugin", "replace", "coarse", "name", "out")
        if any(getattr(asked, name) for name in others):
            raise click.UsageError("--rebuild takes nothing but the reference: its roads are in its GeoPackage.")
        _rebuild(asked.rebuild)
        return
    given = _one_source(asked)
    if asked.coarse:
        asked = replace(asked, kinds=_kinds_of_coarse(asked))
    if asked.shards is None:
        _require_geopackage(asked.out)
    name = asked.name or _name(asked, given)
    if asked.shards is not None:
        _build_in_shards(asked, name)
        return
    path = Path(asked.out) if asked.out else new_reference(name)
    make_folder(path.parent)  # before the long part
    if not asked.replace:
        _keep_or_replace(path)
    read = {"roads": _read, "plugin": _read_plugin}.get(given, _fetch)
    with show_steps() as say:
        roads = read(asked, given, say)
    compile_once(map_only=True)  # nobody waits for that whose roads cannot be read
    with show_steps() as say:
        reference = build_reference(roads, make_slug(name), COARSE if asked.coarse else None, say=say)
        reference.save(path, say)
    if is_set("verbose"):
        for key, value in roads.meta.items():
            echo(f"  {key}: {value}", err=True)
    _tell_built(f"{path}: {counted(len(reference.index), 'intersection')}", started, asked.out or path.stem)


def _build_in_shards(asked: Index, name: str) -> None:
    """Build a reference in shards from road files, and describe the result.

    Raises
    ------
    click.UsageError
        The roads do not come from files, or `--out` names something else.
    """
    from roadgeo.cli.compilation import compile_once
    from roadgeo.cli.progress import show_steps
    from roadgeo.reference.library import make_slug, new_reference
    from roadgeo.reference.shards import ENDING
    from roadgeo.running.sharding import RoadFiles, ShardOptions, build_shards
    from roadgeo.storage.files import make_folder

    out = asked.out
    if not asked.roads:
        raise click.UsageError("--shards goes with --roads: what is fetched from OpenStreetMap fits in one piece.")
    # Target: a folder, in the library unless `--out` names another.
    started = perf_counter()
    path = Path(out) if out else new_reference(name).with_suffix(ENDING)
    if path.suffix != ENDING:
        if path.suffix in {".gpkg", ".index"}:
            raise click.UsageError(f"--out {out}: with --shards that is a folder; did you mean {path.stem}{ENDING}?")
        path = path.with_name(f"{path.name}{ENDING}")
    make_folder(path)
    # Sources and options.
    which = (asked.layer, asked.crs, asked.kinds, asked.tunnels, asked.bbox, asked.attribution)
    files = RoadFiles(tuple(map(Path, asked.roads)), *which)
    compile_once(map_only=True)
    with show_steps() as say:
        options = ShardOptions(**asked.shards or {}, margin_m=asked.margin)
        cluster = make_cluster(asked.engine, asked.scheduler, asked.jobs)
        reference = build_shards(files, path, make_slug(name), options, jobs=asked.jobs, cluster=cluster, say=say)
    entries = reference.manifest.filled
    n = sum(entry.own_intersections for entry in entries)
    _tell_built(f"{path}: {n:,} intersections in {len(entries)} shards", started, out or path.stem)


def _tell_built(built: str, started: float, reference: str) -> None:
    """Print what was built, since a moment of `perf_counter`, and how it is searched."""
    seconds = perf_counter() - started
    tell(f"{built} in {seconds:.1f} s; search it with `roadgeo locate photo.jpg -r {reference}`")


def _kinds_of_coarse(asked: Index) -> RoadKind:
    """Return which roads a coarse map holds: main ones, unless the user named others."""
    if asked.shards is not None:
        raise click.UsageError("--shards makes a coarse map beside the shards: leave out --coarse.")
    source = click.get_current_context().get_parameter_source("kinds")
    return "main" if source is click.core.ParameterSource.DEFAULT else asked.kinds


#: Endings that `--out` must not have.
_OTHER_FORMATS = {".shp", ".geojson", ".json", ".fgb", ".kml", ".gml", ".parquet", ".sqlite", ".osm", ".pbf", ".zip"}


def _require_geopackage(out: str | None) -> None:
    """Refuse a reference in another format than the one there is."""
    if out is not None and Path(out).suffix.lower() in _OTHER_FORMATS:
        raise click.UsageError(
            f"--out {out}: a reference is a GeoPackage with its index beside it; did you mean"
            f" {Path(out).with_suffix('.gpkg')}?"
        )


def _keep_or_replace(path: Path) -> None:
    """Ask whether a reference at that path may be replaced; where nobody can be asked, it stays.

    Raises
    ------
    OutputError
        Nobody can be asked.
    """
    from roadgeo.errors import IndexFormatError, OutputError
    from roadgeo.reference.inspection import describe_reference

    if not path.exists():
        return
    try:
        size = counted(describe_reference(path).get("counts", {}).get("intersections", 0), "intersection")
    except IndexFormatError:  # it is damaged: nothing is lost
        return
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        raise OutputError(f"{path}: is a reference of {size}; replace it with --replace, or choose another name")
    click.confirm(f"There is a reference {path.stem} of {size}. Replace it?", abort=True, err=True)


def _rebuild(name: str) -> None:
    from roadgeo.cli.compilation import compile_once
    from roadgeo.cli.progress import show_steps
    from roadgeo.reference.library import resolve_whole
    from roadgeo.reference.reference import rebuild_reference

    path = resolve_whole(name)
    compile_once(map_only=True)
    with show_steps() as say:
        reference = rebuild_reference(path, say)
    tell(f"{path}: {counted(len(reference.index), 'intersection')} indexed again")


# --- where the roads come from ----------------------------------------------------------------------------------------

_FETCHED = {"place": "--osm PLACE", "around": "--around LON,LAT,METRES", "polygon": "--polygon FILE"}


def _one_source(asked: Index) -> str:
    """Name the option of the source; a box alone is a source, with --roads it cuts them."""
    given = [name for name in (*_FETCHED, "roads", "plugin") if getattr(asked, name)]
    if asked.bbox and given != ["roads"]:
        given.append("bbox")
    if len(given) != 1:
        flags = ", ".join(_FETCHED.values())
        raise click.UsageError(
            f"Give one source of roads: {flags}, --bbox W,S,E,N, --roads FILE or --source NAME:WHERE."
        )
    if given in (["roads"], ["plugin"]) and (asked.date or asked.no_cache):
        raise click.UsageError("--date and --no-cache go with roads that are fetched from OpenStreetMap.")
    if given != ["roads"] and (asked.layer or asked.crs or asked.attribution):
        raise click.UsageError("--layer, --crs and --attribution go with --roads.")
    return given[0]


def _read(asked: Index, given: str, say: Say) -> Roads:
    from roadgeo.sources.roads import read_roads

    which = {name: getattr(asked, name) for name in ("layer", "crs", "tunnels", "bbox", "attribution")}
    return read_roads(getattr(asked, given), which=asked.kinds, **which, say=say)


def _fetch(asked: Index, given: str, say: Say) -> Roads:
    from roadgeo.sources.overpass import FetchOptions
    from roadgeo.sources.roads import fetch_roads

    servers = {key: url for key in ("overpass_url", "nominatim_url") if (url := getattr(asked, key))}
    options = replace(FetchOptions(), date=asked.date, cache=not asked.no_cache, **servers)
    where = {given: getattr(asked, given), "which": asked.kinds, "tunnels": asked.tunnels}
    return fetch_roads(**where, options=options, say=say)


def _read_plugin(asked: Index, given: str, say: Say) -> Roads:
    from roadgeo.errors import PluginError
    from roadgeo.plugins import SOURCES, call_plugin
    from roadgeo.sources.roads import Roads

    name, _, where = getattr(asked, given).partition(":")
    roads = call_plugin(SOURCES, name, where, say=say)
    if not isinstance(roads, Roads):
        raise PluginError(
            f"the source {name!r} returned a {type(roads).__name__}, expected roadgeo.sources.roads.Roads"
        )
    return replace(roads, meta={"sources": [{"name": getattr(asked, given)}], "attribution": "", **roads.meta})


def _name(asked: Index, given: str) -> str:
    value = getattr(asked, given)
    if given == "place":
        return str(value)
    if asked.out:
        from roadgeo.reference.files import reference_paths

        return reference_paths(asked.out).geopackage.stem.removesuffix(".shards")
    if given == "plugin":
        return Path(value.partition(":")[2]).stem or "roads"
    if given in {"roads", "polygon"}:
        return Path(value[0] if given == "roads" else value).name.split(".")[0]
    return given + " " + " ".join(f"{number:g}" for number in value)
