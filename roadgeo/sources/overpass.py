"""Roads of an area from OpenStreetMap's servers: Nominatim finds the place, Overpass gives its roads.

Answers are kept in the user's cache folder, and read there as files of Overpass are.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import re
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import urlencode, urlsplit

import numpy as np

from roadgeo import __version__
from roadgeo._progress import Say, say_nothing
from roadgeo.errors import OutputError, RoadSourceError
from roadgeo.roads.kinds import RoadKind, highways
from roadgeo.sources.containers import overpass_table
from roadgeo.sources.lines import RoadLines, simple_areas
from roadgeo.sources.schemas import recognise
from roadgeo.storage.crs import crs_name
from roadgeo.storage.files import write_bytes
from roadgeo.storage.folders import cache_dir
from roadgeo.storage.vectors import first_line, read_layer

__all__ = ["FetchOptions", "box_area", "fetch_lines", "find_place", "read_area", "square"]

OVERPASS_URL = "https://overpass-api.de/api"
NOMINATIM_URL = "https://nominatim.openstreetmap.org"

_BUSY = (429, 502, 503, 504)
_MOST_PAUSE_S = 300.0
#: A server is asked for squares of at most this side, degrees of latitude: 50 km.
_PART_DEG = 0.45


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
    import shapely

    query = urlencode({"q": place, "format": "json", "polygon_geojson": 1, "limit": 50, "dedupe": 0})
    found = [one for one in _ask(f"{options.nominatim_url}/search?{query}", options, say) if isinstance(one, Mapping)]
    if not found:
        raise RoadSourceError(f"{place!r}: OpenStreetMap knows no such place; check the spelling")
    for one in found:
        shape = one.get("geojson")
        if not isinstance(shape, Mapping) or shape.get("type") not in ("Polygon", "MultiPolygon"):
            continue
        area = shapely.from_geojson(json.dumps(shape), on_invalid="ignore")
        if area is not None and np.isfinite(area.bounds).all() and area.area > 0:
            return area, str(one.get("display_name", place))
    raise RoadSourceError(
        f"{place!r} is a point on OpenStreetMap, not an area; name a town or district, "
        "or give a box around it with --bbox W,S,E,N"
    )


def fetch_lines(area: Any, which: RoadKind, tunnels: bool, options: FetchOptions, say: Say = say_nothing) -> RoadLines:
    """Ask Overpass for the roads of an area in degrees, and some of those around it.

    A large area is asked for in parts, each of which is kept as it comes: a later call fetches only what is missing.

    Raises
    ------
    RoadSourceError
        No network, a server that stays busy or gives up.
    """
    kinds = highways(which)
    tags = '["highway"]' if kinds is None else f'["highway"~"^({"|".join(kinds)})$"]'
    tags += '["area"!~"yes"]' + ("" if tunnels else '["tunnel"!~"^(yes|avalanche_protector)$"]')
    head, server = f"[out:json][timeout:{options.timeout_s:.0f}]{_date_setting(options.date)}", options.overpass_url
    found: dict[tuple[str, str], Any] = {}
    stamps, parts = [], _parts(area)
    for n, part in enumerate(parts):
        ways = "".join(f'way{tags}(poly:"{ring}");' for ring in _rings(part))
        answer = _ask(f"{server}/interpreter", options, say, f"{head};({ways});(._;>;);out;", (n, len(parts)))
        found |= {(str(one.get("type")), str(one.get("id"))): one for one in answer["elements"] if type(one) is dict}
        stamps += re.findall(r"timestamp_osm_base\W+([-\w:]+)", json.dumps(answer.get("osm3s")))
    table = overpass_table(list(found.values()))
    told = {"server": server, "osm_timestamp": min(stamps, default=None), "date": options.date}
    lines = recognise(table).adapt(table)
    return replace(lines, meta=lines.meta | {key: value for key, value in told.items() if value})


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

    from roadgeo.geometry.projection import to_lonlat

    if not isinstance(polygon, str | os.PathLike):
        return polygon, "the given area"
    path = Path(polygon)
    found = read_layer(path, None, ())
    try:
        parts = simple_areas(shapely.from_wkb(found.shapes if found.shapes is not None else []))
    except shapely.errors.ShapelyError as error:
        raise RoadSourceError(f"{path}: holds no shapes that can be read: {first_line(error)}") from error
    if len(parts) == 0:
        raise RoadSourceError(f"{path}: no polygon in it, expected the outline of an area")
    crs = crs_name(found.crs)
    if crs is None:
        raise RoadSourceError(f"{path}: has no CRS; save the outline with one, for example as GeoJSON")
    return shapely.transform(shapely.union_all(parts), lambda xy: to_lonlat(crs, xy)), path.stem


def _parts(area: Any) -> list[Any]:
    """Cut an area in degrees into parts that are asked for one by one."""
    import shapely

    west, south, east, north = area.bounds
    rows = max(math.ceil((north - south) / _PART_DEG), 1)
    columns = max(math.ceil((east - west) * math.cos(math.radians((south + north) / 2)) / _PART_DEG), 1)
    x, y = np.meshgrid(np.linspace(west, east, columns + 1), np.linspace(south, north, rows + 1))
    boxes = shapely.box(*(side.ravel() for side in (x[:-1, :-1], y[:-1, :-1], x[1:, 1:], y[1:, 1:])))
    boxes = boxes[shapely.intersects(area, boxes)]
    return [part for part in shapely.intersection(area, boxes) if part.area > 0] if len(boxes) > 1 else [area]


def _rings(part: Any) -> list[str]:
    """Return the outlines of the polygons of a part, as Overpass takes them."""
    import shapely

    rings = shapely.get_exterior_ring(simple_areas(np.array([part], object)))
    return [" ".join(f"{lat:.6f} {lon:.6f}" for lon, lat in ring.coords) for ring in rings]


def _date_setting(date: str | None) -> str:
    """Return the Overpass setting for roads as of a day."""
    if date is None:
        return ""
    if not re.fullmatch(r"\d{4}-\d\d-\d\d(T\d\d:\d\d:\d\dZ)?", date):
        raise RoadSourceError(f"{date!r} is no date; expected for example 2019-10-28")
    return f'[date:"{date if "T" in date else date + "T00:00:00Z"}"]'


def _ask(url: str, options: FetchOptions, say: Say, query: str = "", part: tuple[int, int] = (0, 1)) -> Any:
    """Return a server's answer, new or kept: a list of Nominatim's, or the object of Overpass.

    Parameters
    ----------
    query : str
        The body of the request.
    part : (int, int)
        The number of this part, from 0, and how many there are.
    """
    import requests
    from requests.adapters import HTTPAdapter

    host = urlsplit(url).netloc
    kept = cache_dir() / "osm" / f"{hashlib.sha256(f'{url} {query}'.encode()).hexdigest()[:20]}.json"
    with contextlib.suppress(OSError, ValueError):  # there is none, or it is damaged
        if options.cache and kept.stat().st_mtime > time.time() - options.max_age_days * 86400.0:
            return json.loads(kept.read_bytes())
    n, total = part
    say(f"asking {host}" + (f" for part {n + 1} of {total}" if total > 1 else ""), n / total if total > 1 else None)
    try:
        with requests.Session() as session:
            session.headers.update({"User-Agent": f"roadgeo/{__version__}", "Referer": "roadgeo"})
            for scheme in ("http://", "https://"):
                session.mount(scheme, HTTPAdapter(max_retries=_patience(host, options, say)))
            response = session.request(
                "POST" if query else "GET", url, data={"data": query} if query else None, timeout=options.timeout_s
            )
    except requests.exceptions.Timeout as error:
        raise RoadSourceError(f"{host} did not answer within {options.timeout_s:g} s; try again later") from error
    except requests.exceptions.RequestException as error:
        raise RoadSourceError(
            f"{host} cannot be reached or broke off; is there a network connection? Without one give --roads FILE: "
            "extracts are at download.geofabrik.de and extract.bbbike.org"
        ) from error
    if response.status_code in _BUSY:
        raise RoadSourceError(
            f"{host} is still busy ({response.status_code}) after {options.retries} more tries; "
            "try later, a smaller area, or another server"
        )
    try:
        answer = response.json()
    except (ValueError, RecursionError):
        answer = None
    elements = answer if not query else answer.get("elements") if isinstance(answer, dict) else None
    if not isinstance(elements, list):
        raise RoadSourceError(f"{host} gave an answer that cannot be read: {response.text[:60]!r}")
    remark = str(answer.get("remark", "")) if query else ""
    if "error" in remark:
        raise RoadSourceError(f"{host} gave up: {remark[:200]}; ask for a smaller area")
    if options.cache and elements:
        with contextlib.suppress(OSError, OutputError):
            kept.parent.mkdir(parents=True, exist_ok=True)
            write_bytes(kept, response.content)
    return answer


def _patience(host: str, options: FetchOptions, say: Say) -> Any:
    """Return a hook that asks a busy server again, and reports it."""
    from urllib3 import Retry
    from urllib3.exceptions import InvalidHeader

    class Patience(Retry):
        def sleep(self, response: Any = None) -> None:
            wait = options.pause_s * 2.0 ** (len(self.history) - 1)
            with contextlib.suppress(InvalidHeader):
                wait = min(self.get_retry_after(response) or wait, _MOST_PAUSE_S)
            say(f"{host} is busy ({response.status}), trying again in {wait:.0f} s")
            time.sleep(wait)

    return Patience(
        None, connect=0, read=False, other=0, status=options.retries, status_forcelist=_BUSY, allowed_methods=None,
        raise_on_status=False,
    )  # fmt: skip
