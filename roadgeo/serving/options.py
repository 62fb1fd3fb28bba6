"""Limits and settings of the server."""

from __future__ import annotations

import re
from dataclasses import dataclass

from roadgeo._options import OTHERS, option

__all__ = ["LOOPBACK", "ServeOptions"]

LOOPBACK = ("127.0.0.1", "::1", "localhost")


def _read_basemap(url: str) -> str:
    """Check the address of a basemap's tiles: it goes into the page's policy.

    Raises
    ------
    ValueError
        It is no such address.
    """
    fits = re.fullmatch(r"https?://[\w.-]+(:\d+)?/[^\s;,\"'<>\\]*", url) and all(f"{{{axis}}}" in url for axis in "zxy")
    if url and not fits:
        raise ValueError(f"got {url!r}, expected an address such as https://tiles.example/{{z}}/{{x}}/{{y}}.png")
    return url


# fmt: off
@dataclass(frozen=True)
class ServeOptions:
    """Limits and settings of the server; each option is explained beside it.

    Attributes
    ----------
    token : str
        Whoever asks must show it; "" for nobody.
    workers : int
        Processes.
    body_s : float
        Time to send a request's body.
    time_limit_s : float
        Longest search; requests may ask for less.
    connections : int
        Open at once; with more, every request gets 503.
    kept_jobs, kept_bytes : int
        Answers that are kept for clients that asked not to wait, and their limit on disk.
    """

    host: str = option("--host", "ADDRESS", OTHERS,
        "Listen there, and ask for a token. Default: 127.0.0.1, without one.", default="127.0.0.1")
    port: int = option("--port", None, OTHERS, "0: any that is free.",
        limits=(0, 65535), default=8017, show_default=True)
    waiting: int = option("--waiting", "N", OTHERS, "Requests that may wait.",
        limits=(0, None), default=8, show_default=True)
    max_bytes: int = option("--max-bytes", "N", OTHERS, "Of a body.",
        limits=(1, None), default=64_000_000, show_default=True)
    max_pixels: int = option("--max-pixels", "N", OTHERS, "Of an image.",
        limits=(1, None), default=64_000_000, show_default=True)
    basemap: str = option("--basemap", "URL", OTHERS,
        "Tiles that the page shows below the roads: https://.../{z}/{x}/{y}.png.", read=_read_basemap, default="")
    basemap_attribution: str = option("--basemap-attribution", "TEXT", OTHERS,
        "Whom their owner asks to name.", default="")
    token: str = ""
    workers: int = 1
    body_s: float = 60.0
    time_limit_s: float = 10.0
    connections: int = 64
    kept_jobs: int = 20
    kept_bytes: int = 2_000_000_000
# fmt: on
