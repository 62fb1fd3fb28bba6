"""uvicorn's HTTP over h11, made patient with nobody: heads and answers have a time, connections a number."""

from __future__ import annotations

import asyncio
import json
import sys
from http import HTTPStatus
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

from roadgeo.serving.documents import problem
from roadgeo.serving.options import ServeOptions

__all__ = ["MAX_HEAD_BYTES", "protocol_of"]

#: Of a request line and of all headers together.
MAX_HEAD_BYTES = 1 << 16
#: A connection that was refused stays open this long, that its answer is received before it is closed.
_LINGER_S = 0.3


def protocol_of(options: ServeOptions) -> type[H11Protocol]:
    """Return the protocol with the limits of a server."""
    return type("Protocol", (_Protocol,), {"options": options})


class _Protocol(H11Protocol):
    options: ServeOptions
    _timer: asyncio.TimerHandle | None = None
    _writing: asyncio.TimerHandle | None = None
    _is_refused = False

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Take a connection, or answer that there are too many."""
        if len(self.connections) >= self.options.connections:
            self.transport = transport
            self._refuse(503, "too many connections are open; come again")
            return
        super().connection_made(transport)
        self._await_head()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop all clocks."""
        for timer in (self._timer, self._writing):
            if timer is not None:
                timer.cancel()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Take bytes, unless the connection was refused."""
        if self._is_refused:
            return
        super().data_received(data)
        self._stop_waiting()

    def eof_received(self) -> bool:  # type: ignore[override]
        """Answer who has sent all and listens; a body that ends before it should is refused."""
        if self._is_refused or self.cycle is None or self.cycle.response_complete:
            return False
        if self.cycle.more_body:
            self._refuse(400, "the body ends before it should")
        self.cycle.keep_alive = False
        return True

    def on_response_complete(self) -> None:
        """Wait for the next head, no longer than for the first."""
        self._await_head()
        super().on_response_complete()
        self._stop_waiting()

    def pause_writing(self) -> None:
        """Wait for a reader who does not read, but not for ever."""
        super().pause_writing()
        self._writing = self.loop.call_later(self.options.head_s, self.transport.abort)

    def resume_writing(self) -> None:
        """Go on."""
        super().resume_writing()
        if self._writing is not None:
            self._writing.cancel()

    def send_400_response(self, msg: str) -> None:
        """Answer a request that h11 refuses."""
        error = sys.exception()
        self._refuse(getattr(error, "error_status_hint", 400), str(error or msg)[:200])

    def _await_head(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer = self.loop.call_later(self.options.head_s, self._give_up)

    def _stop_waiting(self) -> None:
        if self._timer is not None and self.cycle is not None and not self.cycle.response_complete:
            self._timer.cancel()
            self._timer = None

    def _give_up(self) -> None:
        if self.transport.is_closing():  # the rest of an answer is not read
            self.transport.abort()
        self.transport.close()

    def _refuse(self, status: int, detail: str) -> None:
        """Answer in place of the application, and hang up once that was heard."""
        self._is_refused = True
        if self.cycle is not None and not self.cycle.response_complete:
            self.cycle.disconnected = True
            self.cycle.message_event.set()
            if self.cycle.response_started:
                self.transport.close()
                return
        phrase = HTTPStatus(status).phrase
        body = json.dumps(problem(status, phrase, detail)).encode()
        headers: dict[str, Any] = {"Content-Type": "application/problem+json", "Content-Length": len(body)}
        headers |= {"Retry-After": 1} if status == 503 else {}
        lines = "".join(f"{name}: {value}\r\n" for name, value in {**headers, "Connection": "close"}.items())
        self.transport.write(f"HTTP/1.1 {status} {phrase}\r\n{lines}\r\n".encode() + body)
        if self.transport.can_write_eof():
            self.transport.write_eof()
        self.loop.call_later(_LINGER_S, self.transport.close)
