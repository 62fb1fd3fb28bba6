"""Shards in an object store or behind a web server: fetched when they are first searched, and kept on this machine.

A URL that the user typed names the folder: s3://bucket/atlas.shards, https://host/atlas.shards. Its manifest is fetched
each time; a shard is fetched once, whole, checked against the manifest's digest, and then memory-mapped as any other.

A folder that came from elsewhere names no URL: only the user's own cache remembers where shards come from. fsspec
knows some forty protocols, and joins them ("simplecache::reference://..."); here it is asked for five, one at a time.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from hashlib import blake2b
from pathlib import Path
from typing import Any

from roadgeo.errors import IndexFormatError, how_to_install
from roadgeo.storage.files import make_folder, replacing, write_text, writing
from roadgeo.storage.folders import cache_dir

__all__ = ["fetch_manifest", "fetch_shard", "is_remote"]

_MANIFEST, _SOURCE = "manifest.json", "source.txt"
_MAX_MANIFEST = 256 << 20

#: Protocols that may be fetched from: web servers, and the object stores of Amazon, Google and Microsoft.
_PROTOCOLS = ("https", "http", "s3", "gs", "az")


def is_remote(name: str | os.PathLike[str]) -> bool:
    """Whether a name is a URL."""
    return "://" in os.fspath(name)


def fetch_manifest(url: str) -> Path:
    """Fetch the manifest of a sharded reference; return the folder on this machine that stands for it.

    Raises
    ------
    IndexFormatError
        No reference is there, it cannot be reached, or the URL is of another protocol.
    OutputError
        It cannot be kept in the user's cache folder.
    """
    url = url.removesuffix(f"/{_MANIFEST}").rstrip("/")
    name = f"{blake2b(url.encode(), digest_size=8).hexdigest()}-{url.rpartition('/')[2]}"
    folder = _kept() / name
    make_folder(folder)
    _fetch(f"{url}/{_MANIFEST}", folder / _MANIFEST, _MAX_MANIFEST)
    write_text(folder / _SOURCE, url)
    return folder


def fetch_shard(folder: Path, build: str, name: str, most: float) -> bool:
    """Fetch the index of a shard, if the folder is one that `fetch_manifest` returned; return whether it is.

    The size of both its files in the manifest bounds the transfer.

    Raises
    ------
    IndexFormatError
        It cannot be fetched.
    """
    source = folder / _SOURCE
    # Any other folder may be a stranger's, and so may the URLs in its files.
    if folder.resolve().parent != _kept().resolve() or not source.is_file():
        return False
    target = folder / build / f"{name}.index"
    with writing(target):
        target.parent.mkdir(exist_ok=True)
    _fetch(f"{source.read_text(encoding='utf-8')}/{build}/{name}.index", target, most)
    return True


def _kept() -> Path:
    """Return the folder of fetched files."""
    return cache_dir() / "shards"


def _fetch(url: str, target: Path, most: float) -> None:
    """Copy a file here, whole or not at all: others may be fetching or reading it, too."""
    protocol, _, rest = url.partition("://")
    if protocol.lower() not in _PROTOCOLS or "::" in rest:
        raise IndexFormatError(
            f"{url}: cannot be fetched from; expected a folder of shards at {', '.join(_PROTOCOLS[:-1])} or "
            f"{_PROTOCOLS[-1]}, such as https://host/porto.shards"
        )
    with _reaching(url):
        import fsspec

        settings = {"client_kwargs": {"trace_configs": [_redirects()]}} if protocol.lower() in {"http", "https"} else {}
        files = fsspec.filesystem(protocol.lower(), **settings)
    with replacing(target) as staged, _reaching(url):
        files.get_file(files._strip_protocol(url), str(staged), callback=_at_most(most))


def _at_most(most: float) -> Any:
    """Return a callback that ends a transfer of more bytes: it receives the size, and each part as it comes."""
    from fsspec.callbacks import Callback

    class AtMost(Callback):  # type: ignore[misc]
        def call(self, *_args: Any, **_options: Any) -> None:
            if max(self.size or 0, self.value) > most:
                raise OSError(f"is larger than the {most:,.0f} bytes in the manifest")

    return AtMost()


@cache
def _redirects() -> Any:
    """Return options by which aiohttp follows a redirect only to https or within one server, never into its network."""
    import aiohttp
    from yarl import URL

    async def check(_session: Any, _context: Any, asked: Any) -> None:
        headers = asked.response.headers
        target = asked.url.join(URL(headers.get("Location") or headers.get("URI") or ""))
        if target.scheme != "https" and target.origin() != asked.url.origin():
            raise OSError(f"redirected to {target}; expected https, or the same server")

    tracing = aiohttp.TraceConfig()
    tracing.on_request_redirect.append(check)
    return tracing


@contextmanager
def _reaching(url: str) -> Iterator[Any]:
    """Turn what goes wrong with a store into one line."""
    try:
        yield
    except ImportError as error:
        raise IndexFormatError(
            f"{url}: {error}; references at a URL need more packages: {how_to_install('dask')}, and s3fs or gcsfs"
            " for such stores"
        ) from error
    except Exception as error:
        # Each store has errors of its own, and many libraries beneath.
        what = " ".join(f"{type(error).__name__}: {error}".split())[:300]
        raise IndexFormatError(
            f"{url}: cannot be fetched: {what}; is this the folder of a sharded reference?"
        ) from error
