"""Roads on a metric plane: of files, of OpenStreetMap, or of a program's objects. References are built of them.

Whatever holds roads gives tables (`containers`, `overpass`), and one adapter makes lines of them (`schemas`). Here the
lines that were asked for are chosen and brought to one plane.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from roadgeo._arrays import AnyArray, BoolArray, FloatArray
from roadgeo._progress import Say, say_nothing
from roadgeo._text import log_of
from roadgeo.errors import CrsError, NoRoadsError, RoadSourceError
from roadgeo.geometry.projection import LocalPlane, choose_plane, to_lonlat, to_plane
from roadgeo.roads.kinds import RoadKind, drives
from roadgeo.sources.containers import held_table
from roadgeo.sources.lines import RoadLines, cut_lines
from roadgeo.sources.overpass import FetchOptions, box_area, fetch_lines, find_place, read_area, square
from roadgeo.sources.schemas import recognise
from roadgeo.sources.streams import EXCHANGED, list_sources, read_lines, tell_source
from roadgeo.storage.crs import known_crs, name_crs

__all__ = [
    *(
        "Box",
        "Roads",
        "are_exchanged",
        "choose_lines",
        "choose_roads",
        "fetch_roads",
        "join_roads",
        "read_roads",
        "with_crs",
    ),
]

_LOG = log_of(__name__)

#: West, south, east, north in degrees; west > east where it lies astride 180 degrees.
Box = tuple[float, float, float, float]

#: Greatest share of lines beyond the Earth in their CRS that is left out; with more of them the CRS is wrong.
_MOST_ASTRAY = 0.1
#: A vertex at the origin of coordinates is one that is missing where no other lies as near it as that.
_FAR_DEG = 1.0


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
    names, kinds : (L,) object or None
        Name of each street, and its `highway`: text, "" where that is not known; None: of none.
    """

    lines: AnyArray
    plane: LocalPlane
    meta: dict[str, Any] = field(default_factory=dict)
    names: AnyArray | None = None
    kinds: AnyArray | None = None

    def __len__(self) -> int:
        """L."""
        return len(self.lines)

    def __repr__(self) -> str:
        """Describe the roads in one line."""
        return f"<Roads: {len(self):,} lines, {self.plane.crs[:40]}>"


def choose_roads(
    roads: Any,
    which: RoadKind = "drivable",
    tunnels: bool = False,
    attribution: str | None = None,
    crs: Any = None,
) -> Roads:
    """Return the roads to build a reference from, of files or of whatever a program holds; `Roads` as they are.

    Parameters
    ----------
    roads : Roads, path or paths, GeoDataFrame, GeoSeries, networkx graph with places, shapely lines, arrays
        Arrays of coordinates (N, 2) or (N, 3), x first, are a line each; of a single one, rows that are not finite part
        the lines.
    crs : anything that pyproj knows, optional
        CRS of the coordinates; needed where the roads have none.

    Raises
    ------
    CrsError
        There is no CRS, or the coordinates do not fit it.
    RoadSourceError
        There are no lines of the kind asked for, or what is given holds none.
    """
    paths, name = (str, os.PathLike), "the roads"
    if isinstance(roads, Roads):
        return roads if attribution is None else replace(roads, meta={**roads.meta, "attribution": attribution})
    listed = roads if isinstance(roads, list | tuple) else [roads]
    if listed and all(isinstance(one, paths) for one in listed):
        given = None if crs is None else name_crs(crs)
        return read_roads(listed, crs=given, which=which, tunnels=tunnels, attribution=attribution)
    table = held_table(roads)
    lines = recognise(table).adapt(table, which == "all")
    lines = with_crs(lines, crs, name)
    lines = choose_lines(lines, name, which, tunnels)
    tell_source(name, lines.meta)
    return join_roads([lines], {"roads": which, "tunnels": tunnels, "bbox": None}, attribution)


def read_roads(
    path: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    layer: str | Sequence[str] | None = None,
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
    layer : str or sequence of str, optional
        Layers of files that have several, or of the drawings that they were made of.
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
    given = [path] if isinstance(path, str | os.PathLike) else list(path)
    files = [file for one in given for file in list_sources(Path(one))]
    area = None if bbox is None else box_area(bbox)
    sources, elsewhere = [], []
    for n, file in enumerate(files, 1):
        what = f"reading {file.name}" + (f", {n} of {len(files)}" if len(files) > 1 else "")
        say(what)
        advance = partial(say, what)
        source = read_lines(file, layer, advance, whole=which == "all")
        source = with_crs(source, crs, file)
        chosen = choose_lines(source, file.name, which, tunnels, area)
        tell_source(file.name, chosen.meta)
        if not len(chosen.lines):
            elsewhere.append(_corners(source))
        sources.append(chosen)
    if len(elsewhere) == len(sources):
        raise _no_roads(sources, _ask_exchanged(bbox, elsewhere))
    return join_roads(sources, {"roads": which, "tunnels": tunnels, "bbox": _plain(bbox)}, attribution)


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
    if sum(area is not None for area in (place, bbox, polygon, around)) != 1:
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
    source = choose_lines(fetch_lines(area, which, tunnels, options, say), name, which, tunnels, area)
    if not len(source.lines):
        hint = _ask_exchanged(bbox)
        raise NoRoadsError(f"OpenStreetMap has no {which} roads there; check the area or try another --kinds{hint}")
    return join_roads([source], {"roads": which, "tunnels": tunnels, "bbox": _plain(bbox)}, None)


def with_crs(source: RoadLines, crs: Any, name: Path | str) -> RoadLines:
    """Return a source in the CRS that was given, or else its own; OpenStreetMap's are in degrees in any case.

    Raises
    ------
    CrsError
        There is no file.
    """
    if crs is None or source.meta.get("format") == "OpenStreetMap":
        if source.crs is None:
            raise CrsError(f"{name}: has no CRS; name it, for example --crs EPSG:26986, crs= in Python")
        return source
    named, own = name_crs(crs), source.crs
    if own is not None and not known_crs(own).equals(known_crs(named), ignore_axis_order=True):
        _LOG.warning(
            "%s: says that its CRS is %s; read as %s, as --crs asks. Leave --crs out if that is wrong",
            name,
            known_crs(own).name if len(own) > len("EPSG:123456") else own,
            crs,
        )
    return replace(source, crs=named)


def choose_lines(source: RoadLines, name: str, which: RoadKind, tunnels: bool, area: Any = None) -> RoadLines:
    """Keep the lines that were asked for, and count what was left out; they are cut at the border of an area."""
    import shapely

    wanted = drives(source.highway, which) if source.kinds_known else np.ones(len(source.lines), bool)
    hidden = source.tunnel & wanted & (not tunnels)
    chosen = source.take(wanted & ~hidden)
    astray = _astray(chosen, name)
    chosen = chosen.take(~astray)
    if area is not None:
        lines, place = cut_lines(shapely.transform(chosen.lines, lambda xy: to_lonlat(str(source.crs), xy)), area)
        chosen = replace(chosen.take(place), lines=lines, crs="EPSG:4326")
    kindless = int((chosen.highway == "").sum()) * source.kinds_known
    meta = {
        "name": name,
        **source.meta,
        "lines": len(source.lines),
        "kinds_known": source.kinds_known or which == "all",
        "other_kinds": int((~wanted).sum()),
        "tunnels": int(hidden.sum()),
        **({"exchanged": True} if are_exchanged(chosen) else {}),
        **({"astray": int(astray.sum())} if astray.any() else {}),
        **({"without_kind": kindless} if kindless else {}),
        "kept": len(chosen.lines),
    }
    return replace(chosen, meta=meta)


def join_roads(sources: Sequence[RoadLines], meta: dict[str, Any], attribution: str | None) -> Roads:
    """Take the lines of all sources to one plane."""
    filled = [source for source in sources if len(source.lines)]
    if not filled:
        raise _no_roads(sources)
    shared = {source.crs for source in filled}
    own_crs = shared.pop() if len(shared) == 1 else None
    plane = choose_plane(np.concatenate([_corners(source) for source in filled]), own_crs)
    calls = dict.fromkeys(source.meta["attribution"] for source in filled if source.meta.get("attribution"))
    return Roads(
        np.concatenate([_to_plane(source, plane) for source in filled]),
        plane,
        {
            **meta,
            "plane": "the source's own CRS" if plane.crs == own_crs else "a metric CRS chosen for the place",
            "sources": [source.meta for source in sources],
            "attribution": "; ".join(calls) if attribution is None else attribution,
        },
        np.concatenate([source.name for source in filled]),
        np.concatenate([source.highway for source in filled]),
    )


def _corners(source: RoadLines) -> FloatArray:
    """Return longitudes and latitudes of the corners of each line's bounding box; (2 L, 2)."""
    import shapely

    bounds = shapely.bounds(source.lines)
    return to_lonlat(str(source.crs), np.concatenate((bounds[:, :2], bounds[:, 2:])))


def _astray(source: RoadLines, name: str) -> BoolArray:
    """Return which lines lie beyond the Earth, or have a vertex at the origin of coordinates, far off all others.

    One wrong value makes such lines, or a missing one that is written as 0.
    """
    import shapely

    corners = _corners(source)
    lonlat = np.hstack((corners[: len(source.lines)], corners[len(source.lines) :]))
    sound = np.asarray((np.isfinite(lonlat) & (np.abs(lonlat) <= (360.0, 90.0) * 2)).all(axis=1))
    if np.count_nonzero(~sound) > _MOST_ASTRAY * len(sound):
        reach = np.abs(shapely.total_bounds(source.lines)).max()
        hint = EXCHANGED if are_exchanged(source) else "give the right one with --crs"
        raise CrsError(f"{name}: coordinates reach {reach:.6g} and do not fit its CRS, {str(source.crs)[:40]}; {hint}")
    coords, line = shapely.get_coordinates(source.lines, return_index=True)
    suspected = np.isin(np.arange(len(sound)), line[(coords == 0.0).all(axis=1)])
    others = lonlat[sound & ~suspected].reshape(-1, 2)
    if suspected.any() and len(others):
        apart = np.abs(others - to_lonlat(str(source.crs), np.zeros((1, 2)))).max(axis=1)
        sound &= ~suspected | bool((apart < _FAR_DEG).any())
    return ~sound


def are_exchanged(source: RoadLines) -> bool:
    """Whether lines lie outside the area that their CRS is made for, and within it with coordinates exchanged."""
    import shapely

    area = None if source.crs is None else known_crs(source.crs).area_of_use
    if area is None or not len(source.lines) or area.west > area.east:
        return False
    bounds = shapely.bounds(source.lines)
    middles = (bounds[:, :2] + bounds[:, 2:]) / 2.0
    there = [to_lonlat(str(source.crs), xy) for xy in (middles, middles[:, ::-1])]
    low, high = (area.west, area.south), (area.east, area.north)
    given, exchanged = (float(((xy >= low) & (xy <= high)).all(axis=1).mean()) for xy in there)
    return given < _MOST_ASTRAY and exchanged > 1.0 - _MOST_ASTRAY


def _ask_exchanged(bbox: Box | None, corners: Sequence[FloatArray] | None = None) -> str:
    """Ask whether longitudes and latitudes of a box without roads were exchanged, if there are roads in it then."""
    import shapely

    if bbox is None:
        return ""
    south, west, north, east = bbox  # if so
    sound = -90 <= south < north <= 90 and -180 <= west < east <= 180
    if sound and corners is not None:
        sound = any(shapely.box(west, south, east, north).intersects(shapely.multipoints(one)) for one in corners)
    return f" (longitude comes first: did you mean --bbox={west:g},{south:g},{east:g},{north:g}?)" if sound else ""


def _to_plane(source: RoadLines, plane: LocalPlane) -> AnyArray:
    """Return a source's lines in plane metres."""
    import shapely

    return np.asarray(shapely.transform(source.lines, lambda xy: to_plane(str(source.crs), plane, xy)))


def _no_roads(sources: Sequence[RoadLines], hint: str = "") -> RoadSourceError:
    names = ", ".join(str(source.meta["name"]) for source in sources) or "no source"
    return RoadSourceError(f"{names}: no roads of the kind asked for; try another --kinds or area{hint}")


def _plain(bbox: Box | None) -> list[float] | None:
    return None if bbox is None else [float(degrees) for degrees in bbox]
