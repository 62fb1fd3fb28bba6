"""Limits and settings of the server."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["LOOPBACK", "ServeOptions"]

LOOPBACK = ("127.0.0.1", "::1", "localhost")


@dataclass(frozen=True)
class ServeOptions:
    """Limits and settings of the server.

    Attributes
    ----------
    token : str
        Whoever asks must show it; "" for nobody.
    workers, waiting : int
        Processes, and requests that may wait for one.
    max_bytes, max_pixels : int
        Size of an image, as sent and unpacked.
    body_s : float
        Time to send a request's body.
    time_limit_s : float
        Longest search; requests may ask for less.
    connections : int
        Open at once; with more, every request gets 503.
    kept_jobs, kept_bytes : int
        Answers that are kept for clients that asked not to wait, and their limit on disk.
    basemap, basemap_attribution : str
        Address of the tiles of a map that the page shows below the roads, with {z}, {x} and {y}; "" for none.
    """

    host: str = "127.0.0.1"
    port: int = 8017
    token: str = ""
    workers: int = 1
    waiting: int = 8
    max_bytes: int = 64_000_000
    max_pixels: int = 64_000_000
    body_s: float = 60.0
    time_limit_s: float = 10.0
    connections: int = 64
    kept_jobs: int = 20
    kept_bytes: int = 2_000_000_000
    basemap: str = ""
    basemap_attribution: str = ""
