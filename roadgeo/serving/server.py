"""The server: Starlette's routes (`app`) behind a guard, spoken to by uvicorn over HTTP; processes locate (`workers`).

Connections, heads, bodies and waiting requests are bounded. On loopback it answers only to the names of this machine,
and not to pages of other sites that a browser shows. A server for others stands behind a proxy.
"""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Sequence

import uvicorn

from roadgeo import __version__
from roadgeo.reference.reference import AnyReference
from roadgeo.serving.app import Listener, Service
from roadgeo.serving.options import ServeOptions
from roadgeo.serving.workers import Workers

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

    def __init__(
        self,
        workers: Workers,
        references: Sequence[AnyReference],
        options: ServeOptions,
        listener: Listener | None = None,
    ) -> None:
        """Listen on a port; `listener` is called with each place that is found.

        Raises
        ------
        OSError
            It cannot listen there.
        """
        self._workers = workers
        self._socket = _listen(options.host, options.port)
        self.server_address = self._socket.getsockname()
        self.server_port: int = self.server_address[1]
        self._service = Service(workers, references, options, listener)
        config = uvicorn.Config(
            self._service.app,
            http="h11",
            ws="none",
            lifespan="off",
            log_config=None,
            server_header=False,
            headers=[("Server", f"roadgeo/{__version__}")],
            proxy_headers=False,
            limit_concurrency=options.connections,
            timeout_keep_alive=_IDLE_S,
            h11_max_incomplete_event_size=_HEAD_BYTES,
            timeout_graceful_shutdown=_FAREWELL_S,
        )
        self._uvicorn = _Uvicorn(config, workers)

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
        self._workers.close()
        self._service.close()


class _Uvicorn(uvicorn.Server):
    """Ends the processes before it waits for their answers: clients that still wait are asked to come again."""

    def __init__(self, config: uvicorn.Config, workers: Workers) -> None:
        super().__init__(config)
        self._workers = workers

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End."""
        await asyncio.to_thread(self._workers.close)
        await super().shutdown(sockets)


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    return socket.create_server((host, port), family=family, backlog=128)
