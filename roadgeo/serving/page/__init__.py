"""The page for people: its files as they are sent, and the sources that a browser may load."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from urllib.parse import urlsplit

from roadgeo.serving.options import ServeOptions

__all__ = ["page_file", "page_text", "policy_of"]

_FOLDERS = (Path(__file__).parent, Path(__file__).parent / "maplibre")
_KINDS = (".html", ".css", ".js", ".mjs")


@cache
def _files() -> dict[str, Path]:
    paths = {path.name.removesuffix(".gz"): path for folder in _FOLDERS for path in folder.iterdir()}
    return {name: path for name, path in paths.items() if name.endswith(_KINDS)}


def page_file(name: str) -> Path | None:
    """Return a file of the page by its name, compressed if its own name ends in `.gz`; None without such a file."""
    return _files().get(name)


def page_text(name: str) -> str:
    """Return a file of the page as text."""
    return _files()[name].read_text(encoding="utf-8")


def policy_of(options: ServeOptions) -> str:
    """Return the sources that the page may load: this server, and the tiles of a basemap that the user named."""
    basemap = ""
    if options.basemap:
        parts = urlsplit(options.basemap)
        basemap = f" {parts.scheme}://{parts.netloc}"
    return (
        "default-src 'none'; script-src 'self'; worker-src 'self'; style-src 'self'; "
        f"img-src 'self' data: blob:{basemap}; connect-src 'self'{basemap}; form-action 'none'; base-uri 'none'; "
        "frame-ancestors 'none'"
    )
