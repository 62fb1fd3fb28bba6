"""Checks before the routes: who may ask, how large a body may be and how long it may take, and the form of errors."""

from __future__ import annotations

import asyncio
import hashlib
import hmac
from collections.abc import Mapping
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.responses import JSONResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from roadgeo.serving.options import LOOPBACK, ServeOptions

__all__ = ["COOKIE", "Guard", "is_same", "pass_of", "problem"]

#: Under this name a browser shows that it was given the token.
COOKIE = "roadgeo"
#: Wrong tokens, of all who ask, are answered one after another, with this time between them, seconds.
_GUESS_S = 0.5
#: Longest body of a request that brings a token.
_TOKEN_BYTES = 4096

#: Nothing here is for other sites, and nothing of other sites belongs here.
_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "Content-Security-Policy": "default-src 'none'; frame-ancestors 'none'; sandbox",
}


def problem(status: int, detail: str, headers: Mapping[str, str] | None = None) -> Response:
    """Return an error as a document of RFC 7807."""
    document = {"type": "about:blank", "status": status, "title": HTTPStatus(status).phrase, "detail": detail}
    more = {401: {"WWW-Authenticate": "Bearer"}, 408: {"Connection": "close"}, 503: {"Retry-After": "1"}}
    return JSONResponse(document, status, {**more.get(status, {}), **(headers or {})}, "application/problem+json")


class Guard:
    """Lets through who may ask, within the limits of a body, and gives all answers their common headers."""

    def __init__(self, app: ASGIApp, options: ServeOptions) -> None:
        self._app, self._options, self._guesses = app, options, asyncio.Lock()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""

        async def send_all(message: Message) -> None:
            if message["type"] == "http.response.start":
                if message["status"] == HTTPStatus.UNAUTHORIZED:
                    async with self._guesses:
                        await asyncio.sleep(_GUESS_S)
                headers = MutableHeaders(scope=message)
                for name, value in _HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        most = _TOKEN_BYTES if scope["path"] == "/session" else self._options.max_bytes
        try:
            self._require_right(scope["path"], Headers(scope=scope), most)
        except HTTPException as error:
            await problem(error.status_code, error.detail)(scope, receive, send_all)
            return
        await self._app(scope, _limit(receive, most, self._options.body_s), send_all)

    def _require_right(self, path: str, headers: Headers, most: int) -> None:
        """Refuse who may not ask, and bodies that are declared too large."""
        host, origin = headers.get("host", ""), headers.get("origin")
        if self._options.token:
            if not _is_open(path) and not self._shows_token(headers):
                raise HTTPException(401, "expected the header Authorization: Bearer TOKEN")
        elif _split("//" + host)[1] not in LOOPBACK:  # other names may be tricks of a page in a browser
            raise HTTPException(403, "this server answers to localhost and 127.0.0.1 only")
        # Who has a token is behind a proxy, perhaps, that speaks https to browsers.
        schemes = ("http", "https") if self._options.token else ("http",)
        if origin and origin.lower() not in [f"{scheme}://{host.lower()}" for scheme in schemes]:
            raise HTTPException(403, "this server does not answer to pages of other sites")
        if int(headers.get("content-length", 0)) > most:
            raise HTTPException(413, f"a body of {headers['content-length']} bytes, expected at most {most:,}")

    def _shows_token(self, headers: Headers) -> bool:
        shown = headers.get("authorization", "")
        if shown[:7].lower() == "bearer " and is_same(shown[7:].strip(), self._options.token):
            return True
        try:
            cookie = SimpleCookie(headers.get("cookie", "")).get(COOKIE)
        except CookieError:
            return False
        return cookie is not None and is_same(cookie.value, pass_of(self._options.token))


def _is_open(path: str) -> bool:
    """Whether a path is answered without a token: those without private content, and the page, which asks for it."""
    return path in ("/", "/health", "/session") or path.startswith("/page/")


def pass_of(token: str) -> str:
    """Return a browser's substitute for the token, which does not reveal it."""
    return hmac.new(token.encode(), b"roadgeo serve", hashlib.sha256).hexdigest()


def is_same(shown: str, secret: str) -> bool:
    """Compare in a time that is independent of the match; headers come as Latin-1, whatever was meant."""
    given = shown.encode("latin-1", "replace")
    return hmac.compare_digest(given, secret.encode()) or hmac.compare_digest(shown.encode(), secret.encode())


def _split(address: str) -> tuple[str, str | None]:
    """Return name and port of an address as it is written, and the name alone; nothing where that cannot be read."""
    try:
        parts = urlsplit(address)
        return parts.netloc.lower(), parts.hostname
    except ValueError:
        return "", None


def _limit(receive: Receive, most: int, body_s: float) -> Receive:
    """Bound a body in size and time; messages after it, such as that the client has gone, are waited for."""
    until, taken, is_whole = 0.0, 0, False

    async def take() -> Message:
        nonlocal until, taken, is_whole
        if is_whole:
            return await receive()
        until = until or asyncio.get_running_loop().time() + body_s
        try:
            async with asyncio.timeout_at(until):
                message = await receive()
        except TimeoutError as error:
            raise HTTPException(408, f"the body took longer than {body_s:g} s to be sent") from error
        is_whole = not message.get("more_body", False)
        taken += len(message.get("body", b""))
        if taken > most:
            raise HTTPException(413, f"a body of more than {most:,} bytes")
        return message

    return take
