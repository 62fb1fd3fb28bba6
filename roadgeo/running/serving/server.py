"""The HTTP server, made of the standard library's: nothing to install, and it only hands bytes on.

It reads requests in threads that compute nothing; processes locate (`workers`). Everything is bounded: connections,
time to send a request, its size, and how many wait. On loopback it answers only to the names of this machine, and not
to pages of other sites that a browser shows.
"""

from __future__ import annotations

import hmac
import io
import json
import socket
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import SplitResult, urlsplit

from roadgeo import __version__
from roadgeo.running.serving.documents import documents_of, problem
from roadgeo.running.serving.requests import LIMIT, Refused, ending_of, read_execution, read_query_string
from roadgeo.running.serving.workers import Answer, Asked, Full, Workers

__all__ = ["LOOPBACK", "ServeOptions", "Server"]

LOOPBACK = ("127.0.0.1", "::1", "localhost")

_CHUNK = 1 << 16
_MOST_DRAINED = 1 << 20  # a refused body up to this is read, so that its sender hears the answer


def _too_many() -> bytes:
    """Return the answer to a connection for which there is no thread."""
    status = HTTPStatus.SERVICE_UNAVAILABLE
    body = json.dumps(problem(status, status.phrase, "too many connections are open; come again")).encode()
    head = f"HTTP/1.1 503 {status.phrase}\r\nRetry-After: 1\r\nContent-Type: application/problem+json\r\n"
    return f"{head}Content-Length: {len(body)}\r\nConnection: close\r\n\r\n".encode() + body


_TOO_MANY = _too_many()


@dataclass(frozen=True)
class ServeOptions:
    """What the server allows.

    Attributes
    ----------
    token : str
        Whoever asks must show it; "" for nobody.
    workers, waiting : int
        Processes, and requests that may wait for one.
    max_bytes, max_pixels : int
        Of an image, as sent and unpacked.
    head_s, body_s : float
        Time to send a request's head, and its body.
    time_limit_s : float
        Of a search; requests may ask for less.
    connections : int
        Open at once.
    """

    host: str = "127.0.0.1"
    port: int = 8017
    token: str = ""
    workers: int = 1
    waiting: int = 8
    max_bytes: int = 64_000_000
    max_pixels: int = 64_000_000
    head_s: float = 10.0
    body_s: float = 60.0
    time_limit_s: float = 10.0
    connections: int = 64


class Server(ThreadingHTTPServer):
    """The server; `close` ends it and its processes.

    Attributes
    ----------
    told : callable or None
        Hears of each place that is found: of its document, and when its request came.
    """

    daemon_threads = True
    block_on_close = False
    request_queue_size = 128

    def __init__(
        self,
        workers: Workers,
        references: list[str],
        options: ServeOptions,
        told: Callable[[dict[str, Any], float], None] | None = None,
    ) -> None:
        if ":" in options.host:
            self.address_family = socket.AF_INET6
        self.workers, self.options, self.told = workers, options, told
        self.documents = documents_of(references)
        self._free = threading.Semaphore(options.connections)
        super().__init__((options.host, options.port), _Handler)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Take a connection, or say that there are too many."""
        if not self._free.acquire(blocking=False):
            request.settimeout(0.2)
            with suppress(OSError):
                request.sendall(_TOO_MANY)
                request.setblocking(False)
                while request.recv(_CHUNK):  # closed with bytes unread, the connection would take the answer with it
                    pass
            self.shutdown_request(request)
            return
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Serve a connection to its end."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore what clients break off."""

    def close(self) -> None:
        """Stop listening and end the processes."""
        self.server_close()
        self.workers.close()


class _Timely(io.RawIOBase):
    """Reads of a socket, all of which together end at a deadline: slow senders get no further."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection, self.deadline = connection, 0.0

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        left = self.deadline - time.monotonic()
        if left <= 0.0:
            raise TimeoutError("the request took too long to be sent")
        self._connection.settimeout(left)
        return self._connection.recv_into(buffer)


def _split(url: str) -> SplitResult:
    """Take the URL of a request apart, or refuse it."""
    try:
        return urlsplit(url)
    except ValueError as error:
        raise Refused(400, "the URL cannot be read; begin at /") from error


def _host_of(url: str) -> str | None:
    """Return the host that a URL names; None where it is none."""
    try:
        return urlsplit(url).hostname
    except ValueError:
        return None


class _Handler(BaseHTTPRequestHandler):
    server: Server
    server_version = f"roadgeo/{__version__}"
    sys_version = ""
    protocol_version = "HTTP/1.1"

    def setup(self) -> None:
        super().setup()
        self._timely = _Timely(self.connection)
        self.rfile = io.BufferedReader(self._timely, _CHUNK)

    def handle_one_request(self) -> None:
        self._timely.deadline = time.monotonic() + self.server.options.head_s
        self._body_read = False
        super().handle_one_request()

    def log_message(self, *_: Any) -> None:
        """Keep quiet."""

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Say what is wrong with a head that the library refuses."""
        self.request_version, self.close_connection = self.protocol_version, True
        status = HTTPStatus(code)
        detail = message or explain or status.description or status.phrase
        self._send(code, problem(code, status.phrase, detail[:200]), {"Content-Type": "application/problem+json"})

    def handle_expect_100(self) -> bool:
        """Ask for a body only where it may be taken."""
        try:
            self._allow()
            self._require_size()
        except Refused as refused:
            self._refuse(refused)
            return False
        return super().handle_expect_100()

    def do_GET(self) -> None:
        """Answer with a document."""
        self._serve(self._document)

    def do_HEAD(self) -> None:
        """Answer without the document."""
        self._serve(self._document)

    def do_POST(self) -> None:
        """Locate what is sent."""
        self._serve(self._locate)

    def _serve(self, make: Callable[[], Answer]) -> None:
        try:
            self._allow()
            answer = make()
        except Refused as refused:
            self._refuse(refused)
        except Full:
            self._refuse(Refused(503, "as many requests as may be are waiting; come again", 1))
        except TimeoutError:
            self.close_connection = True
            self._refuse(Refused(408, "the request took too long to be sent"))
        else:
            if answer.status >= 400:
                self._refuse(Refused(answer.status, answer.document["detail"]))
            else:
                self._send(answer.status, answer.document)

    # --- what is asked ------------------------------------------------------------------------------------------------

    def _allow(self) -> None:
        """Refuse who may not ask."""
        options = self.server.options
        if options.token:
            shown = self.headers.get("Authorization", "").removeprefix("Bearer ").strip()
            if not hmac.compare_digest(shown.encode("utf-8", "replace"), options.token.encode()):
                raise Refused(401, "expected the header Authorization: Bearer TOKEN")
        elif self._name() not in LOOPBACK:
            raise Refused(403, "this server answers to localhost and 127.0.0.1 only")
        origin = self.headers.get("Origin")
        if origin and _host_of(origin) not in LOOPBACK:
            raise Refused(403, "this server does not answer to pages of other sites")

    def _name(self) -> str | None:
        """Return under which name this server was asked: other names may be tricks of a page in a browser."""
        return _host_of("//" + self.headers.get("Host", "localhost"))

    def _document(self) -> Answer:
        path = _split(self.path).path.rstrip("/") or "/"
        document = self.server.documents.get(path)
        if document is None:
            raise Refused(404, f"there is nothing at {path[:80]}; begin at /")
        return Answer(200, document)

    def _locate(self) -> Answer:
        came = time.time()
        parts = _split(self.path)
        if parts.path not in ("/locate", "/processes/locate/execution"):
            if parts.path in self.server.documents:
                raise Refused(405, "expected GET")
            raise Refused(404, f"there is nothing at {parts.path[:80]}; post an image to /locate")
        self._require_size()
        if self.server.workers.is_full():
            raise Full
        body = self._read_body()
        if parts.path == "/locate":
            hints = read_query_string(parts.query)
        else:
            body, hints = read_execution(body)
        answer = self._ask(body, hints)
        if answer.status == 200 and self.server.told is not None:
            self.server.told(answer.document, came)
        if parts.path == "/locate" or answer.status >= 400:
            return answer
        return Answer(200, {"location": answer.document})

    def _ask(self, image: bytes, hints: dict[str, Any]) -> Answer:
        options = self.server.options
        limit = min(hints.pop(LIMIT, options.time_limit_s), options.time_limit_s)
        with tempfile.TemporaryDirectory(prefix="roadgeo-") as folder:
            path = Path(folder) / f"image{ending_of(image[:16])}"
            path.write_bytes(image)
            return self.server.workers.ask(Asked(str(path), hints, limit, options.max_pixels))

    def _require_size(self) -> None:
        """Refuse a body that says it is too large, or does not say how it ends."""
        coding = self.headers.get("Transfer-Encoding", "").strip().lower()
        lengths = set(self.headers.get_all("Content-Length", []))
        if coding not in ("", "chunked") or (coding and lengths) or len(lengths) > 1:
            self.close_connection = True
            raise Refused(400, "expected either Content-Length, once, or Transfer-Encoding: chunked")
        if self.headers.get("Content-Encoding", "identity").lower() != "identity":
            raise Refused(415, "expected a body without Content-Encoding")
        if coding:
            return
        length = next(iter(lengths), "")
        if not (length.isascii() and length.isdigit() and len(length) < 19):
            self.close_connection = True
            raise Refused(411, "expected Content-Length, or Transfer-Encoding: chunked")
        if int(length) > self.server.options.max_bytes:
            raise Refused(413, f"a body of {int(length):,} bytes, expected at most {self.server.options.max_bytes:,}")

    def _read_body(self) -> bytes:
        self._timely.deadline = time.monotonic() + self.server.options.body_s
        if self.headers.get("Transfer-Encoding"):
            body = self._read_chunks()
        else:
            body = self._read_exactly(int(self.headers["Content-Length"]))
        self._body_read = True
        return body

    def _read_exactly(self, length: int) -> bytes:
        parts, left = [], length
        while left:
            part = self.rfile.read1(min(left, _CHUNK))
            if not part:
                self.close_connection = True
                raise Refused(400, "the body ends before it should")
            parts.append(part)
            left -= len(part)
        return b"".join(parts)

    def _read_chunks(self) -> bytes:
        """Read a chunked body (RFC 9112, 7.1)."""
        parts: list[bytes] = []
        total, most = 0, self.server.options.max_bytes
        self.close_connection = True  # trailers are left unread
        while True:
            line = self.rfile.readline(256)
            size = line.split(b";")[0].strip()
            if not line.endswith(b"\n") or not size or len(size) > 8 or set(size.lower()) - set(b"0123456789abcdef"):
                raise Refused(400, "a chunk of the body has no size")
            length = int(size, 16)
            if length == 0:
                return b"".join(parts)
            total += length
            if total > most:
                raise Refused(413, f"a body of more than {most:,} bytes")
            parts.append(self._read_exactly(length))
            if self.rfile.readline(3).strip():
                raise Refused(400, "a chunk of the body is longer than it says")

    # --- what is answered ---------------------------------------------------------------------------------------------

    def _refuse(self, refused: Refused) -> None:
        self._drain()
        status = HTTPStatus(refused.status)
        headers = {"Content-Type": "application/problem+json"}
        if refused.retry_after_s is not None:
            headers["Retry-After"] = str(refused.retry_after_s)
        if refused.status == 401:
            headers["WWW-Authenticate"] = "Bearer"
        self._send(status, problem(refused.status, status.phrase, refused.detail), headers)

    def _drain(self) -> None:
        """Read what is left of a short body, so that the answer is heard; leave a long one, and hang up."""
        length = self.headers.get("Content-Length", "0")
        if self._body_read or (self.command in ("GET", "HEAD") and length == "0"):
            return
        if not length.isdigit() or len(length) > 18 or self.headers.get("Transfer-Encoding") or self.close_connection:
            self.close_connection = True
            return
        if int(length) > _MOST_DRAINED or self.headers.get("Expect"):
            self.close_connection = True
            return
        self._timely.deadline = min(time.monotonic() + 2.0, self._timely.deadline)
        try:
            self._read_exactly(int(length))
            self._body_read = True
        except (OSError, Refused):
            self.close_connection = True

    def _send(self, status: int, document: dict[str, Any], headers: dict[str, str] | None = None) -> None:
        content = json.dumps(document).encode()
        try:
            self.connection.settimeout(self.server.options.head_s)
            self.send_response(status)
            for name, value in {"Content-Type": "application/json", **(headers or {})}.items():
                self.send_header(name, value)
            self.send_header("Content-Length", str(len(content)))
            self.send_header("X-Content-Type-Options", "nosniff")
            if self.close_connection:
                self.send_header("Connection", "close")
            self.end_headers()
            if self.command != "HEAD":
                self.wfile.write(content)
        except OSError:  # whoever asked has gone
            self.close_connection = True
