"""Road lines on a metric plane, from files or from OpenStreetMap: the input of a reference."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from roadgeo._arrays import AnyArray, FloatArray
from roadgeo._progress import Say, say_nothing
from roadgeo._text import visible
from roadgeo.errors import CrsError, RoadSourceError
from roadgeo.geometry.projection import LocalPlane, choose_plane, transformer
from roadgeo.roads.kinds import RoadKind, drives
from roadgeo.sources.lines import RoadLines, crs_name, simple_lines
from roadgeo.sources.streams import list_sources, read_lines, tell_source
from roadgeo.storage.crs import known_crs

if TYPE_CHECKING:
    from roadgeo.sources.overpass import FetchOptions

__all__ = [
    "Box",
    "Roads",
    "as_text",
    "choose_lines",
    "fetch_roads",
    "join_roads",
    "overruled_crs",
    "project_lines",
    "read_roads",
]

_LOG = logging.getLogger(__name__)

#: West, south, east, north in degrees; west > east where it lies astride 180 degrees.
Box = tuple[float, float, float, float]

#: Greatest share of lines beyond the Earth in their CRS that is left out; with more of them the CRS is wrong.
_MOST_ASTRAY = 0.1


@dataclass(frozen=True)
class Roads:
    """Lines of roads on their plane. Dimension: L lines.

    Attributes
    ----------
    lines : (L,) object
        Shapely LineStrings in plane metres, not noded.
    plane : LocalPlane
    meta : dict
        Plain values: `sources` (one dict each: where from, features read, lines kept and left out, OSM timestamp),
        `attribution`, `roads` (which kinds), `tunnels`, `bbox`.
    area : shapely Polygon or MultiPolygon, or None
        The ground whose roads were asked for, in degrees; None where it was all that there are.
    names, kinds : (L,) object or None
        Name of each street, and its `highway`: text, "" where that is not known; None: of none.
    """

    lines: AnyArray
    plane: LocalPlane
    meta: dict[str, Any] = field(default_factory=dict)
    area: Any = None
    names: AnyArray | None = None
    kinds: AnyArray | None = None

    def __len__(self) -> int:
        """L."""
        return len(self.lines)

    def __repr__(self) -> str:
        """Describe the roads in one line."""
        return f"<Roads: {len(self):,} lines, {self.plane.crs[:40]}>"


def read_roads(
    path: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    layer: str | None = None,
    crs: str | None = None,
    which: RoadKind = "drivable",
    *,
    tunnels: bool = False,
    bbox: Box | None = None,
    attribution: str | None = None,
    say: Say = say_nothing,
) -> Roads:
    """Read roads from one or more files or folders of files, of any formats and CRS, onto one plane.

    Parameters
    ----------
    path : path or sequence of paths
        A folder stands for every road file in it.
    layer : str, optional
        Layer of files that have several.
    crs : str, optional
        CRS of the coordinates, whatever the files state. Needed where a file states none, as a shapefile without its
        .prj. OpenStreetMap files are always in degrees.
    which : RoadKind
        Kinds of road to take, where the file has kinds (see `sources.schemas`); otherwise all, with a message.
    tunnels : bool
        Take tunnels too: a mask does not show them.
    bbox : (west, south, east, north), optional
        Degrees; roads are cut at its border. West > east: astride 180 degrees.
    attribution : str, optional
        Overrides what the sources call for.
    say : Say
        Called with the source being read and, of PBF files, the share that is read.

    Raises
    ------
    RoadSourceError
        A file is missing, unreadable, or holds no lines; no road is left.
    CrsError
        A file has no CRS and none was given, or its coordinates do not fit.
    """
    from roadgeo.sources.overpass import box_area

    given = [path] if isinstance(path, str | os.PathLike) else list(path)
    files = [file for one in given for file in list_sources(Path(one))]
    sources, elsewhere = [], []
    for n, file in enumerate(files, 1):
        what = f"reading {file.name}" + (f", {n} of {len(files)}" if len(files) > 1 else "")
        say(what)
        source = read_lines(file, layer, lambda share, what=what: say(what, share))  # type: ignore[misc]
        if crs is not None and source.meta["format"] != "OpenStreetMap":
            source = replace(source, crs=overruled_crs(source.crs, crs, file))
        if source.crs is None:
            raise CrsError(f"{file}: says nothing of its CRS; name it, for example --crs EPSG:26986")
        chosen = choose_lines(source, file.name, which, tunnels, bbox)
        tell_source(file.name, chosen.meta)
        if not len(chosen.lines):
            elsewhere.append(source)
        sources.append(chosen)
    if len(elsewhere) == len(sources):
        raise _no_roads(sources, _ask_exchanged(bbox, elsewhere))
    roads = join_roads(sources, {"roads": which, "tunnels": tunnels, "bbox": _plain(bbox)}, attribution)
    return roads if bbox is None else replace(roads, area=box_area(bbox))


def fetch_roads(
    place: str | None = None,
    *,
    bbox: Box | None = None,
    polygon: str | os.PathLike[str] | Any = None,
    around: tuple[float, float, float] | None = None,
    which: RoadKind = "drivable",
    tunnels: bool = False,
    options: FetchOptions | None = None,
    say: Say = say_nothing,
) -> Roads:
    """Fetch the roads of an area from OpenStreetMap.

    Parameters
    ----------
    place : str, optional
        A name that Nominatim knows the outline of: "Boston, MA".
    bbox : (west, south, east, north), optional
        Degrees.
    polygon : path or shapely geometry, optional
        A file with polygons, or a geometry in degrees.
    around : (lon, lat, metres), optional
        A square around a point; the distance is half its side.
    which, tunnels
        As for `read_roads`.
    options : FetchOptions, optional
        Servers, cache, patience, date.
    say : Say
        Called with the server that is waited for, and the share that has come.

    Raises
    ------
    RoadSourceError
        The place is unknown or has no area, there is no network, the server stays busy, or there are no roads.
    ValueError
        Not exactly one area.
    """
    from roadgeo.sources.overpass import FetchOptions, box_area, fetch_lines, find_place, read_area, square

    given = [area is not None for area in (place, bbox, polygon, around)]
    if sum(given) != 1:
        raise ValueError("give exactly one of place, bbox, polygon and around")
    options = options or FetchOptions()
    if place is not None:
        area, name = find_place(place, options, say)
    elif bbox is not None:
        area, name = box_area(bbox), ",".join(f"{degrees:g}" for degrees in bbox)
    elif around is not None:
        area, name = square(*around), "{:g},{:g} within {:g} m".format(*around)
    else:
        area, name = read_area(polygon)
    source = fetch_lines(area, which, tunnels, options, say, hint=_ask_exchanged(bbox))
    chosen = choose_lines(source, name, which, tunnels, None)
    return replace(join_roads([chosen], {"roads": which, "tunnels": tunnels, "bbox": _plain(bbox)}, None), area=area)


def project_lines(shapes: Iterable[Any], crs: Any) -> tuple[AnyArray, LocalPlane]:
    """Take shapely lines from their CRS (anything pyproj understands) to a metric plane of our choice.

    Raises
    ------
    CrsError
        No CRS, or coordinates that do not fit it.
    RoadSourceError
        No lines.
    """
    lines, _ = simple_lines(np.fromiter(shapes, object))
    name = crs_name(crs)
    if name is None:
        raise CrsError("the roads have no CRS; set one, for example roads.set_crs('EPSG:26986')")
    roads = join_roads([RoadLines(lines, name, meta={"name": "the roads"})], {}, None)
    return roads.lines, roads.plane


def choose_lines(source: RoadLines, name: str, which: RoadKind, tunnels: bool, bbox: Box | None) -> RoadLines:
    """Keep the lines that were asked for, and count what was left out."""
    wanted = np.ones(len(source.lines), bool) if source.highway is None else drives(source.highway, which)
    hidden = np.zeros(len(wanted), bool) if tunnels or source.tunnel is None else source.tunnel & wanted
    chosen = np.flatnonzero(wanted & ~hidden)
    lines, crs = source.lines[chosen], source.crs
    if bbox is not None:
        lines, place = _clip(_to_degrees(lines, source.crs, name), bbox)
        chosen, crs = chosen[place], "EPSG:4326"
    meta = {
        "name": name,
        **source.meta,
        "lines": len(source.lines),
        "kinds_known": source.highway is not None,
        "other_kinds": int((~wanted).sum()),
        "tunnels": int(hidden.sum()),
        "kept": len(lines),
    }
    called = None if source.name is None else source.name[chosen]
    kinds = None if source.highway is None else source.highway[chosen]
    return RoadLines(lines, crs, kinds, meta=meta, name=called)


def join_roads(sources: Sequence[RoadLines], meta: dict[str, Any], attribution: str | None) -> Roads:
    """Take the lines of all sources to one plane."""
    filled = [_on_earth(source) for source in sources if len(source.lines)]
    if not filled:
        raise _no_roads(sources)
    shared = {source.crs for source in filled}
    own_crs = shared.pop() if len(shared) == 1 else None
    plane = choose_plane(np.concatenate([_corners(source) for source in filled]), own_crs)
    lines = np.concatenate([_to_plane(source, plane) for source in filled])
    calls = dict.fromkeys(source.meta["attribution"] for source in filled if source.meta.get("attribution"))
    return Roads(
        lines,
        plane,
        {
            **meta,
            "plane": "the source's own CRS" if plane.crs == own_crs else "a metric CRS chosen for the place",
            "sources": [source.meta for source in sources],
            "attribution": "; ".join(calls) if attribution is None else attribution,
        },
        names=as_text([source.name for source in filled], filled),
        kinds=as_text([source.highway for source in filled], filled),
    )


def as_text(columns: Sequence[AnyArray | None], sources: Sequence[RoadLines]) -> AnyArray | None:
    """Join columns to (L,) text, "" where nothing is known; None where no source knows any."""
    if all(column is None for column in columns):
        return None
    text = np.full(sum(len(source.lines) for source in sources), "", object)
    start = 0
    for column, source in zip(columns, sources, strict=True):
        for i, value in enumerate(() if column is None else column, start):
            if isinstance(value, str):
                text[i] = value
            elif isinstance(value, Iterable):
                text[i] = ";".join(map(str, value))
        start += len(source.lines)
    return text


def _corners(source: RoadLines) -> FloatArray:
    """Return longitudes and latitudes of the corners of each line's bounding box; (2 L, 2)."""
    import shapely

    bounds = shapely.bounds(source.lines)
    points = np.concatenate((bounds[:, :2], bounds[:, 2:]))
    return np.stack(transformer(_crs_of(source), "EPSG:4326").transform(points[:, 0], points[:, 1]), axis=1)


def _on_earth(source: RoadLines) -> RoadLines:
    """Return a source without the few lines that lie beyond the Earth, which one wrong value makes."""
    import shapely

    lonlat = _corners(source)
    sound = np.asarray(np.isfinite(lonlat).all(axis=1) & (np.abs(lonlat) <= (360.0, 90.0)).all(axis=1))
    kept = sound[: len(source.lines)] & sound[len(source.lines) :]
    if kept.all():
        return source
    n_astray = int((~kept).sum())
    if n_astray > _MOST_ASTRAY * len(kept):
        reach = np.abs(shapely.total_bounds(source.lines)).max()
        raise CrsError(
            f"{source.meta['name']}: coordinates reach {reach:.6g} and do not fit its CRS, {_crs_of(source)[:40]}; "
            "give the right one with --crs"
        )
    _LOG.warning("%s: left out %s lines that lie beyond the Earth", source.meta["name"], f"{n_astray:,}")
    highway, name = (None if one is None else one[kept] for one in (source.highway, source.name))
    return replace(source, lines=source.lines[kept], highway=highway, name=name, tunnel=None)


def _ask_exchanged(bbox: Box | None, sources: Sequence[RoadLines] | None = None) -> str:
    """Ask whether longitudes and latitudes of a box without roads were exchanged, if there are roads in it then."""
    import shapely

    if bbox is None:
        return ""
    south, west, north, east = bbox  # if so
    sound = -90 <= south < north <= 90 and -180 <= west < east <= 180
    if sound and sources is not None:
        sound = any(
            shapely.box(west, south, east, north).intersects(shapely.multipoints(_corners(one))) for one in sources
        )
    return f" (longitude comes first: did you mean --bbox={west:g},{south:g},{east:g},{north:g}?)" if sound else ""


def _to_plane(source: RoadLines, plane: LocalPlane) -> AnyArray:
    """Return a source's lines in plane metres."""
    import shapely

    way = transformer(_crs_of(source), plane.crs)
    coords = shapely.get_coordinates(source.lines)
    xy = plane.from_crs(np.stack(way.transform(coords[:, 0], coords[:, 1]), axis=1))
    return np.asarray(shapely.set_coordinates(source.lines.copy(), xy))


def _to_degrees(lines: AnyArray, crs: str | None, name: str) -> AnyArray:
    import shapely

    if crs is None:
        raise CrsError(f"{name}: says nothing of its CRS")
    coords = shapely.get_coordinates(lines)
    lonlat = np.stack(transformer(crs, "EPSG:4326").transform(coords[:, 0], coords[:, 1]), axis=1)
    return np.asarray(shapely.set_coordinates(lines.copy(), lonlat))


def _clip(lines: AnyArray, bbox: Box) -> tuple[AnyArray, AnyArray]:
    """Cut lines in degrees at the border of a box; a line or a box may lie astride 180 degrees.

    Returns
    -------
    pieces, line
        And the line that each piece came from.
    """
    import shapely

    west, south, east, north = bbox
    east += 360.0 * (east < west)
    coords, line = shapely.get_coordinates(lines, return_index=True)
    jumps = (np.abs(np.diff(coords[:, 0])) > 180.0) & (np.diff(line) == 0)
    astride = np.isin(line, line[1:][jumps])
    coords[astride, 0] %= 360.0
    lines = shapely.set_coordinates(lines.copy(), coords)
    pieces = [shapely.clip_by_rect(lines, west + turn, south, east + turn, north) for turn in (-360.0, 0.0, 360.0)]
    found, place = simple_lines(np.concatenate(pieces))
    return found, place % max(len(lines), 1)


def overruled_crs(own: str | None, given: str, file: Path | str) -> str:
    """Return the given CRS, and warn where a file states another."""
    known = _known_crs(given)
    if own is not None and not known_crs(own).equals(known_crs(known), ignore_axis_order=True):
        _LOG.warning(
            "%s: says that its CRS is %s; read as %s, as --crs asks. Leave --crs out if that is wrong",
            visible(str(file)),
            known_crs(own).name if len(own) > len("EPSG:123456") else own,
            given,
        )
    return known


def _known_crs(crs: str) -> str:
    """Return the name of a CRS that a user gave.

    Raises
    ------
    CrsError
        It is none of places on Earth.
    """
    name = crs_name(crs)
    if name is None:
        raise CrsError(f"{crs!r} is no CRS of places on Earth; expected for example EPSG:26986")
    return name


def _crs_of(source: RoadLines) -> str:
    if source.crs is None:
        raise CrsError(f"{source.meta.get('name', 'the roads')}: no CRS")
    return source.crs


def _no_roads(sources: Sequence[RoadLines], hint: str = "") -> RoadSourceError:
    names = ", ".join(str(source.meta["name"]) for source in sources) or "no source"
    return RoadSourceError(f"{names}: no roads of the kind asked for; try another --kinds or area{hint}")


def _plain(bbox: Box | None) -> list[float] | None:
    return None if bbox is None else [float(degrees) for degrees in bbox]
