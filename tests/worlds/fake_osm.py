"""A Nominatim and an Overpass on loopback, that give real answers and misbehave on request."""

import json
from collections import deque
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from http.server import BaseHTTPRequestHandler
from unittest import mock
from urllib.parse import parse_qs, urlsplit

import shapely
from pyproj import database
from support.loopback import serving

from worlds.fenway import ANSWER

EMPTY = b'{"version": 0.6, "osm3s": {"timestamp_osm_base": "2022-05-04T19:30:42Z"}, "elements": []}'
OUTLINE = shapely.box(-71.0925, 42.3445, -71.0800, 42.3525)
STATUS = b"Connected as: 1\nCurrent time: 2022-05-04T19:30:42Z\nAnnounced endpoint: none\nRate limit: 2\n2 slots now.\n"


def place(name, geometry, importance=0.5):
    """One result of Nominatim."""
    west, south, east, north = geometry.bounds
    center = geometry.centroid
    return {
        "place_id": 1,
        "osm_type": "relation",
        "osm_id": 1,
        "lat": str(center.y),
        "lon": str(center.x),
        "display_name": name,
        "importance": importance,
        "boundingbox": [str(south), str(north), str(west), str(east)],
        "geojson": json.loads(shapely.to_geojson(geometry)),
    }


@dataclass
class FakeOsm:
    """What was asked, and what to answer.

    `overpass` and `nominatim` hold answers to give first: (status, headers, body), or "cut" to break off in the middle;
    then comes the usual answer.
    """

    url: str = ""
    queries: list = field(default_factory=list)
    searches: list = field(default_factory=list)
    overpass: deque = field(default_factory=deque)
    nominatim: deque = field(default_factory=deque)
    roads: bytes = field(default_factory=ANSWER.read_bytes)
    places: dict = field(
        default_factory=lambda: {
            "Fenway, Boston": [
                place("Fenway station", shapely.Point(-71.1, 42.34), 0.9),
                place("Fenway, Boston, Massachusetts, United States", OUTLINE),
            ],
            "Gas Lamp": [place("Gas Lamp", shapely.Point(-71.09, 42.35))],
        }
    )


#: osmnx asks anew for each area, 0.1 s a time; here few areas are asked for.
_zones_of = cache(database.query_utm_crs_info)


@contextmanager
def fake_osm():
    """Run the servers; yields their `FakeOsm`."""
    state = FakeOsm()

    class Handler(BaseHTTPRequestHandler):
        def log_message(self, *args):
            pass

        def answer(self, status, headers, body):
            self.send_response(status)
            for name, value in headers.items():
                self.send_header(name, value)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def give(self, waiting, body):
            first = waiting.popleft() if waiting else (200, {"Content-Type": "application/json"}, body)
            if first == "cut":
                self.send_response(200)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body[: len(body) // 2])
                self.close_connection = True
            else:
                self.answer(*first)

        def do_GET(self):
            address = urlsplit(self.path)
            if address.path == "/api/status":
                self.answer(200, {}, STATUS)
                return
            asked = parse_qs(address.query)["q"][0]
            state.searches.append(asked)
            self.give(state.nominatim, json.dumps(state.places.get(asked, [])).encode())

        def do_POST(self):
            body = self.rfile.read(int(self.headers["Content-Length"])).decode()
            state.queries.append(parse_qs(body)["data"][0])
            self.give(state.overpass, state.roads)

    with serving(Handler) as server, mock.patch.object(database, "query_utm_crs_info", _zones_of):
        state.url = f"http://127.0.0.1:{server.server_port}"
        yield state
