"""Bytes that come over HTTP, without a network: answers of OpenStreetMap's servers, and requests to ours."""

import io
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any
from unittest import mock

import geopandas
import requests
import urllib3

from roadgeo.running.serving.documents import documents_of
from roadgeo.running.serving.server import ServeOptions, _Handler
from roadgeo.running.serving.workers import Answer


@contextmanager
def answered(content: bytes) -> Iterator[None]:
    """Give this answer to whatever `requests` asks for."""

    def send(_: Any, request: requests.PreparedRequest, **more: Any) -> requests.Response:
        response = requests.Response()
        response.status_code, response.url, response.request = 200, str(request.url), request
        response.raw = urllib3.HTTPResponse(io.BytesIO(content), status=200, preload_content=False)
        return response

    adapter = mock.patch.object(requests.adapters.HTTPAdapter, "send", send)
    # Which zone a place lies in is looked up for half a second.
    plane = mock.patch.object(geopandas.GeoSeries, "estimate_utm_crs", return_value="EPSG:32629")
    with adapter, plane, mock.patch("osmnx._http._config_dns"), mock.patch("time.sleep"):
        yield


class _Wire:
    """A connection on which everything was sent already."""

    def __init__(self, content: bytes) -> None:
        self._content, self.sent = io.BytesIO(content), bytearray()

    def recv_into(self, buffer: Any) -> int:
        return self._content.readinto(buffer)

    def sendall(self, content: bytes) -> None:
        self.sent += content

    def makefile(self, *_: Any) -> io.BytesIO:
        return io.BytesIO()

    def settimeout(self, _: float) -> None:
        """Nothing waits here."""


_SERVER = SimpleNamespace(
    options=ServeOptions(),
    documents=documents_of(["town"]),
    workers=SimpleNamespace(is_full=lambda: False, ask=lambda asked: Answer(200, {})),
    told=None,
)


def serve_request(content: bytes) -> bytes:
    """Return what the server answers to the bytes of a connection; its workers find nothing."""
    wire = _Wire(content)
    _Handler(wire, ("127.0.0.1", 1), _SERVER)  # type: ignore[arg-type]
    return bytes(wire.sent)
