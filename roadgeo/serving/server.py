"""The server: Starlette's routes (`app`) behind a guard, spoken to by uvicorn over HTTP; processes locate (`workers`).

Connections, heads, bodies and waiting requests are bounded. On loopback it answers only to the names of this machine,
and not to pages of other sites that a browser shows. A server for others stands behind a proxy.
"""

from __future__ import annotations

import asyncio
import socket

import uvicorn

from roadgeo._version import __version__
from roadgeo.serving.app import Service
from roadgeo.serving.workers import ImageWorkers

__all__ = ["Server"]

#: Longest head of a request, bytes.
_HEAD_BYTES = 1 << 16
#: Time for answers under way once the processes have ended, and that a connection may stay idle, seconds.
_FAREWELL_S, _IDLE_S = 2, 10


class Server:
    """The server; `close` ends it and its processes.

    Attributes
    ----------
    server_port : int
        Where it listens.
    """

    def __init__(self, service: Service) -> None:
        """Listen on a port.

        Raises
        ------
        OSError
            It cannot listen there.
        """
        host = service.options.host
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._service = service
        self._socket = socket.create_server((host, service.options.port), family=family, backlog=128)
        self.server_address = self._socket.getsockname()
        self.server_port: int = self.server_address[1]
        config = uvicorn.Config(
            service.app,
            http="h11",
            ws="none",
            lifespan="off",
            log_config=None,
            server_header=False,
            headers=[("Server", f"roadgeo/{__version__}")],
            proxy_headers=False,
            limit_concurrency=service.options.connections,
            timeout_keep_alive=_IDLE_S,
            h11_max_incomplete_event_size=_HEAD_BYTES,
            timeout_graceful_shutdown=_FAREWELL_S,
        )
        self._uvicorn = _Uvicorn(config, service.workers)

    def serve_forever(self) -> None:
        """Answer until a signal ends it, or `shutdown`.

        Raises
        ------
        KeyboardInterrupt
            Ctrl-C was pressed.
        """
        self._uvicorn.run(sockets=[self._socket])

    def shutdown(self) -> None:
        """End `serve_forever`, from another thread."""
        self._uvicorn.should_exit = True

    def close(self) -> None:
        """Stop listening and end the processes."""
        self._socket.close()
        self._service.workers.close()
        self._service.close()


class _Uvicorn(uvicorn.Server):
    """Ends the processes before it waits for their answers: clients that still wait are asked to come again."""

    def __init__(self, config: uvicorn.Config, workers: ImageWorkers) -> None:
        super().__init__(config)
        self._workers = workers

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End."""
        await asyncio.to_thread(self._workers.close)
        await super().shutdown(sockets)
