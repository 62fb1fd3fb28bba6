"""Checks before the routes: clients, limits of size and time, and the form of refusals."""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import logging
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import ClientDisconnect
from starlette.responses import JSONResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from roadgeo._text import visible
from roadgeo.serving.documents import problem
from roadgeo.serving.options import LOOPBACK, ServeOptions
from roadgeo.serving.protocol import MAX_HEAD_BYTES
from roadgeo.serving.requests import Refused
from roadgeo.serving.workers import Full

__all__ = ["COOKIE", "Guard", "is_same", "pass_of", "refusal", "require_body"]

_LOG = logging.getLogger(__name__)

_MOST_HEADERS, _MOST_TARGET = 100, 8192

#: Under this name a browser shows that it was given the token.
COOKIE = "roadgeo"

#: Nothing here is for other sites, and nothing of other sites belongs here.
_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "Content-Security-Policy": "default-src 'none'; frame-ancestors 'none'; sandbox",
}


def refusal(refused: Refused) -> Response:
    """Return an error as a document of RFC 7807."""
    status = HTTPStatus(refused.status)
    headers = {} if refused.retry_after_s is None else {"Retry-After": str(refused.retry_after_s)}
    if refused.status == 401:
        headers["WWW-Authenticate"] = "Bearer"
    told = problem(refused.status, status.phrase, refused.detail)
    return JSONResponse(told, refused.status, headers, "application/problem+json")


def require_body(headers: Headers, most: int) -> None:
    """Refuse a body that is declared too large, or does not declare how it ends.

    Raises
    ------
    Refused
        It is so.
    """
    coding, lengths = headers.get("transfer-encoding", "").strip().lower(), headers.getlist("content-length")
    if coding not in ("", "chunked") or (coding and lengths) or len(lengths) > 1:
        raise Refused(400, "expected either Content-Length, once, or Transfer-Encoding: chunked")
    if headers.get("content-encoding", "identity").lower() != "identity":
        raise Refused(415, "expected a body without Content-Encoding")
    if not coding and not lengths:
        raise Refused(411, "expected Content-Length, or Transfer-Encoding: chunked")
    if lengths and int(lengths[0]) > most:
        raise Refused(413, f"a body of {int(lengths[0]):,} bytes, expected at most {most:,}")


class Guard:
    """Lets through who may ask what may be asked, and answers the others."""

    def __init__(self, app: ASGIApp, options: ServeOptions) -> None:
        self._app, self._options = app, options

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        body, answer = _Body(receive, self._options), _Answer(send)
        refused = await self._answer(scope, body.receive, answer.send)
        if refused is None:
            return
        if answer.started:
            raise ConnectionAbortedError("an answer broke off")
        response = refusal(refused)
        if refused.status in (408, 500):  # otherwise what is left of the body is passed over: the sender hears this
            response.headers["Connection"] = "close"
        await response(scope, receive, answer.send)

    async def _answer(self, scope: Scope, receive: Receive, send: Send) -> Refused | None:
        """Let a request through; return why it cannot be answered."""
        try:
            self._require_head(scope)
            self._require_right(scope)
            scope["path"] = scope["path"].rstrip("/") or "/"
            await self._app(scope, receive, send)
        except Refused as refused:
            return refused
        except Full:
            return Refused(503, "as many requests as may be are waiting; come again", 1)
        except TimeoutError:
            return Refused(408, "the request took too long to be sent")
        except (ClientDisconnect, ConnectionError):  # whoever asked has gone
            return None
        except Exception:
            _LOG.exception("a fault of the server at %s", visible(f"{scope['method']} {scope['path'][:200]}"))
            return Refused(500, "a fault of roadgeo: its log tells which")
        return None

    def _require_head(self, scope: Scope) -> None:
        """Refuse a head that is too large, or asks for something that is no path."""
        headers = scope["headers"]
        if len(headers) > _MOST_HEADERS or sum(len(name) + len(value) for name, value in headers) > MAX_HEAD_BYTES:
            raise Refused(431, f"more than {_MOST_HEADERS} headers, or {MAX_HEAD_BYTES:,} bytes of them")
        if len(scope["raw_path"]) + len(scope["query_string"]) > _MOST_TARGET:
            raise Refused(414, f"the address is longer than {_MOST_TARGET:,} bytes")
        if not scope["raw_path"].startswith(b"/"):
            raise Refused(400, "the address cannot be read: expected a path")

    def _require_right(self, scope: Scope) -> None:
        """Refuse who may not ask."""
        headers = Headers(scope=scope)
        if self._options.token:
            if not is_open(scope["path"], headers) and not self._shows_token(headers):
                raise Refused(401, "expected the header Authorization: Bearer TOKEN")
        # Other names may be tricks of a page in a browser.
        elif _host_of("//" + headers.get("host", "localhost")) not in LOOPBACK:
            raise Refused(403, "this server answers to localhost and 127.0.0.1 only")
        origin = headers.get("origin")
        if origin and not self._is_own(origin, headers.get("host", "")):
            raise Refused(403, "this server does not answer to pages of other sites")

    def _shows_token(self, headers: Headers) -> bool:
        shown = headers.get("authorization", "")
        if shown[:7].lower() == "bearer " and is_same(shown[7:].strip(), self._options.token):
            return True
        try:
            cookie = SimpleCookie(headers.get("cookie", "")).get(COOKIE)
        except CookieError:
            return False
        return cookie is not None and is_same(cookie.value, pass_of(self._options.token))

    def _is_own(self, origin: str, host: str) -> bool:
        """Whether a page is one of ours: those of this machine, and with a token those of this server's own name."""
        name = _host_of(origin)
        return name in LOOPBACK or (bool(self._options.token) and name is not None and name == _host_of("//" + host))


def is_open(path: str, headers: Headers) -> bool:
    """Whether a path is answered without a token: those without private content, and the page, which asks for it."""
    is_page = path == "/" and "text/html" in headers.get("accept", "")
    return is_page or path in ("/health", "/session") or path.startswith("/page/")


def pass_of(token: str) -> str:
    """Return a browser's substitute for the token, which does not reveal it."""
    return hmac.new(token.encode(), b"roadgeo serve", hashlib.sha256).hexdigest()


def is_same(shown: str, secret: str) -> bool:
    """Compare in a time that is independent of the match; headers come as Latin-1, whatever was meant."""
    given = shown.encode("latin-1", "replace")
    return hmac.compare_digest(given, secret.encode()) or hmac.compare_digest(shown.encode(), secret.encode())


def _host_of(address: str) -> str | None:
    """Return the name in an address; None where that cannot be read."""
    try:
        return urlsplit(address).hostname
    except ValueError:
        return None


class _Body:
    """The body of a request, limited in size and time."""

    def __init__(self, receive: Receive, options: ServeOptions) -> None:
        self._receive, self._most, self._body_s = receive, options.max_bytes, options.body_s
        self._until: float | None = None
        self._taken, self._whole = 0, False

    async def receive(self) -> Message:
        """Return the next part."""
        if self._whole:
            return await self._receive()
        now = asyncio.get_running_loop().time()
        self._until = self._until or now + self._body_s
        message = await asyncio.wait_for(self._receive(), max(self._until - now, 0.0))
        self._whole = message["type"] != "http.request" or not message.get("more_body", False)
        self._taken += len(message.get("body", b""))
        if self._taken > self._most:
            raise Refused(413, f"a body of more than {self._most:,} bytes")
        return message


class _Answer:
    """Sends an answer, with the headers that all share."""

    def __init__(self, send: Send) -> None:
        self._send, self.started = send, False

    async def send(self, message: Message) -> None:
        """Send a part."""
        if message["type"] == "http.response.start":
            self.started = True
            headers: Any = MutableHeaders(scope=message)
            for name, value in _HEADERS.items():
                headers.setdefault(name, value)
        await self._send(message)
