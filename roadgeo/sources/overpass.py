"""Roads of an area from OpenStreetMap's servers, through osmnx: Nominatim finds the place, Overpass gives its roads.

osmnx keeps its settings in the process; they are set for a call and put back after it, and so is the name lookup that
osmnx replaces. Answers are kept in the user's cache folder.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import shutil
import socket
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from roadgeo import __version__
from roadgeo._arrays import AnyArray
from roadgeo._progress import Say, say_nothing
from roadgeo.errors import RoadSourceError
from roadgeo.roads.kinds import RoadKind, highways, in_tunnel
from roadgeo.sources.lines import OSM_ATTRIBUTION, RoadLines
from roadgeo.sources.vectors import first_line, read_layer
from roadgeo.storage.folders import cache_dir

__all__ = ["FetchOptions", "box_area", "fetch_lines", "find_place", "read_area", "square"]

OVERPASS_URL = "https://overpass-api.de/api"
NOMINATIM_URL = "https://nominatim.openstreetmap.org"

_BUSY = {429, 502, 503, 504}


@dataclass(frozen=True)
class FetchOptions:
    """How OpenStreetMap's servers are asked.

    Attributes
    ----------
    overpass_url, nominatim_url
        Servers to ask.
    date
        Roads as of this day, "2019-10-28" or "2019-10-28T19:20:00Z"; None: now.
    cache
        Keep answers, and take them from there.
    max_age_days
        Older answers are fetched anew.
    timeout_s
        For one request.
    retries, pause_s
        A busy server is asked again this often, after this pause at first, then after twice as long each time.
    """

    overpass_url: str = OVERPASS_URL
    nominatim_url: str = NOMINATIM_URL
    date: str | None = None
    cache: bool = True
    max_age_days: float = 30.0
    timeout_s: float = 180.0
    retries: int = 5
    pause_s: float = 15.0


def find_place(place: str, options: FetchOptions, say: Say = say_nothing) -> tuple[Any, str]:
    """Ask Nominatim for the outline of a place.

    Returns
    -------
    area : shapely Polygon or MultiPolygon
        Degrees.
    name : str
        The place's full name.

    Raises
    ------
    RoadSourceError
        The place is unknown, or is a point without an area; the server cannot be reached.
    """
    import osmnx as ox

    asked = hashlib.sha256(f"{options.nominatim_url} {place}".encode()).hexdigest()[:20]
    with _asking(options, f"nominatim-{asked}", say) as folder:
        try:
            found = ox.geocode_to_gdf(place)
        except ox._errors.InsufficientResponseError as error:
            shutil.rmtree(folder, ignore_errors=True)
            raise RoadSourceError(f"{place!r}: OpenStreetMap knows no such place; check the spelling") from error
        except TypeError as error:
            raise RoadSourceError(
                f"{place!r} is a point on OpenStreetMap, not an area; name a town or district, "
                "or give a box around it with --bbox W,S,E,N"
            ) from error
    return found.geometry.iloc[0], str(found["display_name"].iloc[0] if "display_name" in found else place)


def fetch_lines(
    area: Any,
    which: RoadKind,
    tunnels: bool,
    options: FetchOptions,
    say: Say = say_nothing,
    *,
    hint: str = "",
) -> RoadLines:
    """Ask Overpass for the roads of an area in degrees; ways are given in pieces between two of their nodes.

    A large area is asked for in parts, each of which is kept as it comes: a later call fetches only what is missing.

    Parameters
    ----------
    hint : str
        Added to the error where there are no roads.

    Raises
    ------
    RoadSourceError
        No network, a server that stays busy or gives up, or no roads there.
    """
    import shapely

    kinds = highways(which)
    tags = '["highway"]' if kinds is None else f'["highway"~"^({"|".join(kinds)})$"]'
    tags += '["area"!~"yes"]' + ("" if tunnels else '["tunnel"!~"^(yes|avalanche_protector)$"]')
    query = json.dumps([area.wkt, tags, options.date, options.overpass_url])
    sides = _hemispheres(area)
    asked, n_parts = hashlib.sha256(query.encode()).hexdigest()[:20], sum(map(_count_parts, sides))
    with _asking(options, f"overpass-{asked}", say, n_parts) as folder:
        graphs = [_network(side, tags) for side in sides]
        pieces = [_edges(graph) for graph in graphs if graph is not None]
        if not pieces:
            shutil.rmtree(folder, ignore_errors=True)
            raise RoadSourceError(
                f"OpenStreetMap has no {which} roads there; check the area or try another --kinds{hint}"
            )
        timestamp = _timestamp(folder)
    ends, highway, tunnel, called = (np.concatenate(column) for column in zip(*pieces, strict=True))
    meta = {"format": "OpenStreetMap", "features": len(ends), "attribution": OSM_ATTRIBUTION}
    meta |= {"server": options.overpass_url} | ({"osm_timestamp": timestamp} if timestamp else {})
    meta |= {"date": options.date} if options.date else {}
    return RoadLines(shapely.linestrings(ends), "EPSG:4326", highway, in_tunnel(tunnel), meta, called)


def box_area(bbox: tuple[float, float, float, float]) -> Any:
    """Return a box (west, south, east, north) in degrees as a geometry; astride 180 degrees, west > east, as two."""
    import shapely

    west, south, east, north = bbox
    if west <= east:
        return shapely.box(west, south, east, north)
    return shapely.MultiPolygon([shapely.box(west, south, 180.0, north), shapely.box(-180.0, south, east, north)])


def square(lon: float, lat: float, distance_m: float) -> Any:
    """Return the square around a point, in degrees, whose sides are `distance_m` away from it."""
    from pyproj import Geod

    geod = Geod(ellps="WGS84")
    reach = [geod.fwd(lon, lat, azimuth, distance_m)[:2] for azimuth in (270.0, 180.0, 90.0, 0.0)]
    return box_area((reach[0][0], reach[1][1], reach[2][0], reach[3][1]))


def read_area(polygon: str | os.PathLike[str] | Any) -> tuple[Any, str]:
    """Return an area in degrees and its name, out of a file with polygons or a geometry in degrees.

    Raises
    ------
    RoadSourceError
        The file is missing, unreadable, or holds no polygons.
    """
    import shapely

    from roadgeo.geometry.projection import transformer
    from roadgeo.sources.lines import crs_name

    if not isinstance(polygon, str | os.PathLike):
        return polygon, "the given area"
    path = Path(polygon)
    found = read_layer(path, None, ())
    try:
        parts = shapely.get_parts(shapely.from_wkb(found.shapes if found.shapes is not None else []))
    except shapely.errors.ShapelyError as error:
        raise RoadSourceError(f"{path}: holds no shapes that can be read: {first_line(error)}") from error
    parts = parts[shapely.get_type_id(parts) == 3]
    if len(parts) == 0:
        raise RoadSourceError(f"{path}: no polygon in it, expected the outline of an area")
    crs = crs_name(found.crs)
    if crs is None:
        raise RoadSourceError(f"{path}: says nothing of its CRS; save the outline in one, for example as GeoJSON")
    way = transformer(crs, "EPSG:4326")
    area = shapely.transform(shapely.union_all(parts), lambda xy: np.stack(way.transform(*xy.T), axis=1))
    return area, path.stem


def _network(area: Any, tags: str) -> Any:
    """Return osmnx's graph of an area; None where there is no road."""
    import osmnx as ox

    try:
        return ox.graph_from_polygon(area, simplify=False, retain_all=True, truncate_by_edge=True, custom_filter=tags)
    except ox._errors.InsufficientResponseError as error:
        if error.__cause__ is not None:  # what came was no JSON
            raise
    except ValueError as error:
        if not str(error).startswith("Found no graph nodes"):
            raise
    return None


def _count_parts(area: Any) -> int:
    """Count the requests in which osmnx asks for the network of an area; 1 should it no longer report them."""
    import osmnx as ox

    plane, crs = ox.projection.project_geometry(area)
    around, _ = ox.projection.project_geometry(plane.buffer(500.0), crs=crs, to_latlong=True)  # as osmnx does
    try:
        return len(ox._overpass._make_overpass_polygon_coord_strs(around))
    except AttributeError:
        return 1


def _edges(graph: Any) -> tuple[AnyArray, AnyArray, AnyArray, AnyArray]:
    """Return the pieces of ways in an osmnx graph, each once: ends (P, 2, 2), highway, tunnel and name (P,)."""
    place = {node: (data["x"], data["y"]) for node, data in graph.nodes(data=True)}
    pieces = {(min(u, v), max(u, v)): data for u, v, data in graph.edges(data=True) if u != v}
    ends = np.array([(place[u], place[v]) for u, v in pieces], float).reshape(-1, 2, 2)
    columns = []
    for key in ("highway", "tunnel", "name"):
        column = np.empty(len(pieces), object)
        column[:] = [data.get(key) for data in pieces.values()]
        columns.append(column)
    return ends, columns[0], columns[1], columns[2]


def _hemispheres(area: Any) -> list[Any]:
    """Return the western and eastern part of an area that lies astride 180 degrees; any other area as it is."""
    import shapely

    west, _, east, _ = area.bounds
    if east - west < 180.0:
        return [area]
    parts = [part for part in shapely.get_parts(area) if not part.is_empty]
    sides = [[part for part in parts if (part.bounds[0] + part.bounds[2] < 0) == is_west] for is_west in (True, False)]
    return [shapely.union_all(side) for side in sides if side]


def _timestamp(folder: Path) -> str | None:
    """Return the age of the map data: the oldest one in the answers of a query."""
    found = []
    for answer in folder.glob("*.json"):
        with answer.open(encoding="utf-8") as file:
            match = re.search(r'"timestamp_osm_base"\s*:\s*"([^"]+)"', file.read(2000))
        found += [match[1]] if match else []
    return min(found, default=None)


@contextlib.contextmanager
def _asking(options: FetchOptions, query: str, say: Say, n_parts: int = 1) -> Iterator[Path]:
    """Set osmnx up for one query and yield the folder of its answers; errors become a `RoadSourceError`."""
    import osmnx as ox
    import requests

    host = urlsplit(options.overpass_url if query.startswith("overpass") else options.nominatim_url).netloc
    settings = {
        "overpass_url": options.overpass_url,
        "nominatim_url": options.nominatim_url,
        "overpass_rate_limit": False,  # where it cannot ask, osmnx waits for a minute in silence; `_Patience` waits
        "overpass_settings": "[out:json][timeout:{timeout}]{maxsize}" + _date_setting(options.date),
        "requests_timeout": options.timeout_s,
        "doh_url_template": None,
        "http_user_agent": f"roadgeo/{__version__}",
        "http_referer": "roadgeo",
        "use_cache": True,
        "useful_tags_way": ["highway", "name", "tunnel"],
    }
    lookup = socket.getaddrinfo
    with _answers(options, query) as folder:
        settings["cache_folder"] = str(folder)
        before = {name: getattr(ox.settings, name) for name in (*settings, "requests_kwargs")}
        try:
            counted = _Parts(host, n_parts, sum(1 for _ in folder.glob("*.json")), say)
            settings["requests_kwargs"] = {"hooks": {"response": _Patience(options, say, counted)}}
            for name, value in settings.items():
                setattr(ox.settings, name, value)
            counted.tell()
            yield folder
        except requests.exceptions.Timeout as error:
            raise RoadSourceError(f"{host} did not answer within {options.timeout_s:g} s; try again later") from error
        except requests.exceptions.RequestException as error:
            raise RoadSourceError(
                f"{host} cannot be reached or broke off; is there a network connection? Without one give --roads FILE: "
                "extracts are at download.geofabrik.de and extract.bbbike.org"
            ) from error
        except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError) as error:
            # JSON of any shape: osmnx may raise anything.
            shutil.rmtree(folder, ignore_errors=True)
            raise RoadSourceError(f"{host} gave an answer that makes no sense: {first_line(error)}") from error
        finally:
            for name, value in before.items():
                setattr(ox.settings, name, value)
            socket.getaddrinfo = lookup


def _date_setting(date: str | None) -> str:
    """Return the Overpass setting for roads as of a day."""
    if date is None:
        return ""
    if not re.fullmatch(r"\d{4}-\d\d-\d\d(T\d\d:\d\d:\d\dZ)?", date):
        raise RoadSourceError(f"{date!r} is no date; expected for example 2019-10-28")
    return f'[date:"{date if "T" in date else date + "T00:00:00Z"}"]'


@contextlib.contextmanager
def _answers(options: FetchOptions, query: str) -> Iterator[Path]:
    """Give the folder for the answers to one query: the cache's, or a passing one."""
    folder = cache_dir() / query
    try:
        if options.cache:
            folder.mkdir(parents=True, exist_ok=True)
            oldest = time.time() - options.max_age_days * 86400.0
            for answer in folder.glob("*.json"):
                if answer.stat().st_mtime < oldest or not _is_whole(answer):
                    answer.unlink()
            kept = os.access(folder, os.W_OK)
        else:
            kept = False
    except OSError:
        kept = False
    if kept:
        try:
            yield folder
        finally:
            with contextlib.suppress(OSError):  # there are answers in it
                folder.rmdir()
        return
    with tempfile.TemporaryDirectory(prefix="roadgeo-") as passing:
        yield Path(passing)


def _is_whole(answer: Path) -> bool:
    """Return whether a kept answer was written to its end: osmnx may have been interrupted."""
    with answer.open("rb") as file:
        file.seek(max(answer.stat().st_size - 1, 0))
        return file.read(1) in (b"}", b"]")


@dataclass
class _Parts:
    """Which part of a query is asked for."""

    host: str
    total: int
    done: int
    say: Say

    def tell(self) -> None:
        """Report the next request, if there is one."""
        if self.done < self.total:
            part = f" for part {self.done + 1} of {self.total}" if self.total > 1 else ""
            self.say(f"asking {self.host}{part}", self.done / self.total if part else None)


class _Patience:
    """A hook of `requests` that asks a busy server again, reports it, and notices an Overpass that gave up."""

    def __init__(self, options: FetchOptions, say: Say, parts: _Parts) -> None:
        self.options = options
        self.say = say
        self.parts = parts

    def __call__(self, response: Any, **kwargs: Any) -> Any:
        """Return the response, or a better one."""
        import requests

        host = urlsplit(response.url).netloc
        pause = self.options.pause_s
        for _ in range(self.options.retries):
            if response.status_code not in _BUSY:
                break
            wait = _retry_after(response.headers.get("Retry-After"), pause)
            self.say(f"{host} is busy ({response.status_code}), trying again in {wait:.0f} s")
            time.sleep(wait)
            pause *= 2
            again = response.request.copy()
            again.hooks = {"response": []}
            with requests.Session() as session:
                response = session.send(again, **kwargs)
        if response.status_code in _BUSY:
            raise RoadSourceError(
                f"{host} is still busy ({response.status_code}) after {self.options.retries} more tries; "
                "try later, a smaller area, or another server"
            )
        remark = re.search(rb'"remark"\s*:\s*"([^"]*error[^"]*)"', response.content[-1000:])
        if remark:
            reason = remark[1].decode("utf-8", "replace")[:200]
            raise RoadSourceError(f"{host} gave up: {reason}; ask for a smaller area")
        if response.request.method == "POST":  # an answer, not the server's status
            self.parts.done += 1
            self.parts.tell()
        return response


def _retry_after(header: str | None, pause: float) -> float:
    """Return the seconds a server asks to wait, at most five minutes, or else `pause`."""
    try:
        return min(float(header or ""), 300.0)
    except ValueError:
        return pause
