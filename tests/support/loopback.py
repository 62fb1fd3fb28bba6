"""Servers on this machine; one of them counts what is asked: what reads a file of strangers must ask nothing."""

import http.server
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def serving(handler: Any) -> Iterator[http.server.ThreadingHTTPServer]:
    """Serve on a port that nobody uses."""
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()


class Counting(http.server.BaseHTTPRequestHandler):
    """Answers 404 to everything, and keeps the paths."""

    def do_GET(self) -> None:
        self.server.asked.append(self.path)  # type: ignore[attr-defined]
        self.send_response(404)
        self.send_header("Content-Length", "0")
        self.end_headers()

    do_HEAD = do_POST = do_GET  # noqa: N815

    def log_message(self, *_: object) -> None:
        pass


@contextmanager
def counting_server() -> Iterator[tuple[str, list[str]]]:
    """Yield the server's address and the list of paths asked for so far."""
    with serving(Counting) as server:
        server.asked = []  # type: ignore[attr-defined]
        yield f"http://127.0.0.1:{server.server_port}", server.asked  # type: ignore[attr-defined]
