"""Bytes that come over HTTP, without a network: answers of OpenStreetMap's servers, and requests to ours."""

import asyncio
import io
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any
from unittest import mock

import requests
import urllib3
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.server import ServerState

from roadgeo.serving.app import Service
from roadgeo.serving.options import ServeOptions
from roadgeo.serving.workers import Reply


@contextmanager
def answered(content: bytes) -> Iterator[None]:
    """Give this answer to whatever `requests` asks for."""

    def send(_: Any, request: requests.PreparedRequest, **more: Any) -> requests.Response:
        response = requests.Response()
        response.status_code, response.url, response.request = 200, str(request.url), request
        response.raw = urllib3.HTTPResponse(io.BytesIO(content), status=200, preload_content=False)
        return response

    adapter = mock.patch.object(requests.adapters.HTTPAdapter, "send", send)
    with adapter, mock.patch("time.sleep"):
        yield


class _Wire(asyncio.Transport):
    """A connection on which everything is written down."""

    def __init__(self) -> None:
        super().__init__()
        self.sent, self._is_closing = bytearray(), False

    def write(self, content: Any) -> None:
        self.sent += content

    def close(self) -> None:
        self._is_closing = True

    abort = write_eof = resume_reading = pause_reading = close

    def is_closing(self) -> bool:
        return self._is_closing

    def can_write_eof(self) -> bool:
        return False


_LIMITS = ServeOptions(body_s=0.2)
_WORKERS = SimpleNamespace(take_place=ExitStack, ask=lambda *_: Reply(200, {}))


def serve_request(content: bytes) -> bytes:
    """Return what the server answers to the bytes of a connection; its workers find nothing."""
    return asyncio.run(_serve(content))


async def _serve(content: bytes) -> bytes:
    wire = _Wire()
    with TemporaryDirectory() as folder:
        workers = SimpleNamespace(folder=Path(folder), **vars(_WORKERS))
        service = Service(workers, [SimpleNamespace(name="town")], _LIMITS)  # type: ignore[arg-type, list-item]
        config = uvicorn.Config(service.app, ws="none", lifespan="off", log_config=None)
        connection = H11Protocol(config, ServerState(), {})
        connection.connection_made(wire)
        connection.data_received(content)
        if not wire.is_closing():
            connection.eof_received()
        while connection.tasks:
            await asyncio.wait(connection.tasks)
        connection.connection_lost(None)
        service.close()
    return bytes(wire.sent)
