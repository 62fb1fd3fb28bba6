"""Roads of an area from OpenStreetMap's servers, asked by osmnx: Nominatim finds the place, Overpass gives its roads.

Osmnx keeps their limits, waits while they are busy, and keeps each answer as a file; here these are read as files of
Overpass are. Its graph of them, asked for all roads, holds the same ones at twice the cost (docs/references.md). Osmnx
is imported only here and late: it takes longer than to open a reference.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import socket
import tempfile
import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import urljoin, urlsplit

from roadgeo._progress import Say, say_nothing
from roadgeo._text import counted, log_of
from roadgeo._version import __version__
from roadgeo.errors import RoadSourceError
from roadgeo.roads.kinds import RoadKind, highways
from roadgeo.sources.containers import overpass_table, what_is_missing
from roadgeo.sources.lines import RoadLines, objects, simple_areas
from roadgeo.sources.schemas import recognise
from roadgeo.storage.crs import crs_name
from roadgeo.storage.folders import cache_dir, writable
from roadgeo.storage.memory import bounded
from roadgeo.storage.vectors import read_layer

__all__ = ["FetchOptions", "box_area", "fetch_lines", "find_place", "read_area", "square"]

_LOG = log_of(__name__)

#: Osmnx's settings, and the way to resolve names that it replaces, are those of the process.
_ONE_AT_A_TIME = threading.Lock()
_BUSY = (429, 504)  # osmnx waits a minute, and asks again without end
_MOST_TRIES = 5
_MOST_AGE_S = 30 * 86400.0
_TAIL_BYTES = 4096  # of an answer, where Overpass puts its remark
#: An answer of osmnx's largest area, of a dense city, has some 100 MB; servers give up before this time.
_MOST_BYTES, _MOST_S, _CHUNK = 256 << 20, 600.0, 1 << 20


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
        Take answers of the last 30 days from the cache.
    """

    overpass_url: str = "https://overpass-api.de/api"
    nominatim_url: str = "https://nominatim.openstreetmap.org"
    date: str | None = None
    cache: bool = True


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
    with _asking(options.nominatim_url, options, say, place) as (osmnx, _):
        try:
            with bounded(options.nominatim_url):
                areas = osmnx.geocode_to_gdf(place)
        except TypeError as error:
            raise RoadSourceError(
                f"{place!r} is a point on OpenStreetMap, not an area; name a town or district, "
                "or give a box around it with --bbox W,S,E,N"
            ) from error
        except ValueError as error:
            if "returned 0 results" not in str(error):
                raise
            raise RoadSourceError(f"{place!r}: OpenStreetMap knows no such place; check the spelling") from error
    return areas.geometry[0], str(areas.display_name[0])


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
    elements: dict[tuple[str, str], Any] = {}
    stamps: list[str] = []
    with _asking(options.overpass_url, options, say, f"{tags} {area.wkt}") as (osmnx, folder):
        osmnx.settings.cache_only_mode = True
        for side in _sides(area):
            try:
                with bounded(options.overpass_url):
                    osmnx.graph_from_polygon(side, custom_filter=tags)
            except InterruptedError:  # osmnx's own end of that mode, once all answers are kept
                continue
        for file in sorted(folder.glob("*.json")):
            with bounded(file):
                answer = json.loads(file.read_bytes())
                elements |= {(str(item["type"]), str(item["id"])): item for item in answer["elements"]}
            stamps += re.findall(r"timestamp_osm_base\W+([-\w:]+)", json.dumps(answer.get("osm3s")))
        if not elements:
            shutil.rmtree(folder)
    table = overpass_table(list(elements.values()))
    origin = {"server": options.overpass_url, "osm_timestamp": min(stamps, default=None), "date": options.date}
    lines = recognise(table).adapt(table)
    return replace(lines, meta=lines.meta | {key: value for key, value in origin.items() if value})


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
    layer = read_layer(path, None, ())
    shapes = objects([] if layer.shapes is None else layer.shapes)
    parts = simple_areas(shapely.from_wkb(shapes, on_invalid="ignore"))
    if len(parts) == 0:
        raise RoadSourceError(f"{path}: no polygon in it, expected the outline of an area")
    if part := what_is_missing(path, len(shapes)):
        _LOG.warning("%s: %s", path, part)
    crs = crs_name(layer.crs)
    if crs is None:
        raise RoadSourceError(f"{path}: has no CRS; save the outline with one, for example as GeoJSON")
    return shapely.transform(shapely.union_all(parts), lambda xy: to_lonlat(crs, xy)), path.stem


def _sides(area: Any) -> list[Any]:
    """Return the parts of an area in degrees east and west of 180 degrees: on a plane they lie far apart."""
    import shapely

    west, _, east, _ = area.bounds
    if east - west < 180.0:
        return [area]
    halves = shapely.intersection(area, shapely.box([-180.0, 0.0], -90.0, [0.0, 180.0], 90.0))
    return [half for half in halves if half.area > 0]


@contextmanager
def _asking(url: str, options: FetchOptions, say: Say, question: str) -> Iterator[tuple[Any, Path]]:
    """Give osmnx with its settings for a question to a server, and the folder that keeps the answers.

    Raises
    ------
    RoadSourceError
        The server cannot be reached, breaks off, stays busy, or gives no answer that is whole.
    """
    import osmnx
    import requests

    host = urlsplit(url).netloc
    with (
        _ONE_AT_A_TIME,
        _folder(f"{url} {options.date} {question}", options.cache) as folder,
        warnings.catch_warnings(),
    ):
        before = {name: value for name, value in vars(osmnx.settings).items() if not name.startswith("_")}
        resolve = socket.getaddrinfo  # osmnx replaces it
        warnings.simplefilter("ignore", UserWarning)  # that a large area takes long: `say` shows that
        was_asked = any(folder.iterdir())
        if not was_asked:
            say(f"asking {host}")
        settings = {
            "cache_folder": folder,
            "use_cache": True,
            "doh_url_template": None,
            "http_referer": "roadgeo",
            "http_user_agent": f"roadgeo/{__version__}",
            "nominatim_url": options.nominatim_url,
            "overpass_rate_limit": was_asked or _answers(f"{url}/status"),  # else osmnx would wait a minute
            "overpass_settings": f"[out:json][timeout:{{timeout}}]{_date_setting(options.date)}{{maxsize}}",
            "overpass_url": options.overpass_url,
            "requests_kwargs": {"hooks": {"response": _Watch(host, say)}},
        }
        try:
            vars(osmnx.settings).update(settings)
            yield osmnx, folder
        except requests.exceptions.Timeout as error:
            raise RoadSourceError(f"{host} did not answer in time; try again later") from error
        except requests.exceptions.RequestException as error:
            raise RoadSourceError(
                f"{host} cannot be reached or broke off; is there a network connection? Without one give --roads FILE: "
                "extracts are at download.geofabrik.de and extract.bbbike.org"
            ) from error
        except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
            shutil.rmtree(folder, ignore_errors=True)
            raise RoadSourceError(f"{host} gave an answer that cannot be read: {str(error)[:80]}") from error
        finally:
            vars(osmnx.settings).update(before)
            socket.getaddrinfo = resolve


@contextmanager
def _folder(question: str, cache: bool) -> Iterator[Path]:
    """Give the folder that keeps the answers to a question; it holds none that are old, or none at all."""
    kept = cache_dir() / "osm" / hashlib.sha256(question.encode()).hexdigest()[:20]
    if kept.is_dir() and not (cache and kept.stat().st_mtime > time.time() - _MOST_AGE_S and _are_whole(kept)):
        shutil.rmtree(kept, ignore_errors=True)
    if writable(kept):
        yield kept
    else:
        with tempfile.TemporaryDirectory() as folder:
            yield Path(folder)


def _are_whole(folder: Path) -> bool:
    """Whether no answer in a folder was cut short while it was written."""
    try:
        return all(json.loads(file.read_bytes()) is not None for file in folder.glob("*.json"))
    except (OSError, ValueError, RecursionError):
        return False


def _answers(url: str) -> bool:
    """Whether there is something at a URL."""
    import requests

    try:
        with requests.get(url, timeout=30.0, stream=True, allow_redirects=False) as response:
            return response.status_code == requests.codes.ok
    except requests.exceptions.RequestException:
        return False


class _Watch:
    """Looks at each answer that osmnx gets: reports what is waited for, and refuses what osmnx would take."""

    def __init__(self, host: str, say: Say) -> None:
        self.host, self.say, self.n_busy, self.n_answers = host, say, 0, 0

    def __call__(self, response: Any, *_: Any, **__: Any) -> None:
        """Look at a response of `requests`.

        Raises
        ------
        RoadSourceError
            The server stays busy, marks its answer as cut short, sends it without end, or sends us elsewhere.
        """
        self._require_same(response)
        self._receive(response)
        if response.url.endswith("/status"):
            wait = re.search(r"in (\d+) seconds", response.text)
            if wait and "slots available now" not in response.text:
                self.say(f"{self.host} is busy, asking again in {wait[1]} s")
        elif response.status_code in _BUSY:
            self.n_busy += 1
            if self.n_busy > _MOST_TRIES:
                raise RoadSourceError(
                    f"{self.host} is still busy ({response.status_code}) after {_MOST_TRIES} more tries; "
                    "try later, a smaller area, or another server"
                )
            self.say(f"{self.host} is busy ({response.status_code}), asking again in a minute")
        elif remark := re.search(rb'"remark"\s*:\s*"(.{1,200})', response.content[-_TAIL_BYTES:]):
            reason = remark[1].decode("utf-8", "replace").rstrip('"}] \n')
            raise RoadSourceError(f"{self.host} gave up: {reason}; ask for a smaller area")
        else:
            self.n_answers += 1
            self.say(f"asking {self.host}, after {counted(self.n_answers, 'answer')}")

    def _require_same(self, response: Any) -> None:
        """Follow no redirect to another host, or to one that everybody on the way can read."""
        if not response.is_redirect:
            return
        asked, target = (urlsplit(url) for url in (response.url, urljoin(response.url, response.headers["location"])))
        if target.netloc != asked.netloc or (target.scheme != "https" and asked.scheme == "https"):
            raise RoadSourceError(
                f"{self.host} leads to {target.scheme}://{target.netloc}, which was not asked for; name that server"
            )

    def _receive(self, response: Any) -> None:
        """Receive the body, within bounds of size and time: both bounds are of the unpacked body, and of all of it."""
        until, taken, parts = time.monotonic() + _MOST_S, 0, []
        for part in response.iter_content(_CHUNK):
            taken += len(part)
            parts.append(part)
            if taken > _MOST_BYTES or time.monotonic() > until:
                response.close()
                most = f"{_MOST_BYTES >> 20} MB" if taken > _MOST_BYTES else f"{_MOST_S:g} s"
                raise RoadSourceError(f"{self.host} sends more than {most}; ask for a smaller area")
        response._content = b"".join(parts)


def _date_setting(date: str | None) -> str:
    """Return the Overpass setting for roads as of a day."""
    if date is None:
        return ""
    if not re.fullmatch(r"\d{4}-\d\d-\d\d(T\d\d:\d\d:\d\dZ)?", date):
        raise RoadSourceError(f"{date!r} is no date; expected for example 2019-10-28")
    return f'[date:"{date if "T" in date else date + "T00:00:00Z"}"]'
