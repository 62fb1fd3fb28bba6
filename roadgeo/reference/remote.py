"""Shards in an object store or behind a web server: fetched when they are first searched, and kept on this machine.

What fsspec calls a URL names the folder: s3://bucket/atlas.shards, https://host/atlas.shards. Its manifest is fetched
each time; a shard is fetched once, whole, checked against the manifest's digest, and then memory-mapped as any other.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from hashlib import blake2b
from pathlib import Path
from typing import Any

from roadgeo.errors import IndexFormatError
from roadgeo.storage.atomic import publish, staging, writing
from roadgeo.storage.files import write_text
from roadgeo.storage.folders import cache_dir

__all__ = ["fetch_manifest", "fetch_shard", "is_remote"]

_MANIFEST, _SOURCE = "manifest.json", "source.txt"


def is_remote(name: str | os.PathLike[str]) -> bool:
    """Whether a name is a URL."""
    return "://" in os.fspath(name)


def fetch_manifest(url: str) -> Path:
    """Fetch the manifest of a sharded reference; return the folder on this machine that stands for it.

    Raises
    ------
    IndexFormatError
        There is none, or it cannot be reached.
    OutputError
        It cannot be kept in the user's cache folder.
    """
    url = url.removesuffix(f"/{_MANIFEST}").rstrip("/")
    name = f"{blake2b(url.encode(), digest_size=8).hexdigest()}-{url.rpartition('/')[2]}"
    folder = cache_dir() / "shards" / name
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    _fetch(f"{url}/{_MANIFEST}", folder / _MANIFEST)
    write_text(folder / _SOURCE, url)
    return folder


def fetch_shard(folder: Path, build: str, name: str) -> bool:
    """Fetch the index of a shard, if the folder stands for one that lies elsewhere; return whether it does.

    Raises
    ------
    IndexFormatError
        It cannot be fetched.
    """
    source = folder / _SOURCE
    if not source.is_file():
        return False
    target = folder / build / f"{name}.index"
    with writing(target):
        target.parent.mkdir(exist_ok=True)
    _fetch(f"{source.read_text(encoding='utf-8')}/{build}/{name}.index", target)
    return True


def _fetch(url: str, target: Path) -> None:
    """Copy a file here, whole or not at all: others may be fetching or reading it, too."""
    with _reaching(url):
        from fsspec.core import url_to_fs

        files, path = url_to_fs(url)
    with staging(target) as folder:
        with _reaching(url):
            files.get_file(path, str(folder / target.name))
        with writing(target):
            publish(folder / target.name, target)


@contextmanager
def _reaching(url: str) -> Iterator[Any]:
    """Turn what goes wrong with a store into one line."""
    try:
        yield
    except ImportError as error:
        raise IndexFormatError(
            f"{url}: {error}; references elsewhere need pip install 'roadgeo[dask]', and s3fs or gcsfs for such stores"
        ) from error
    except Exception as error:
        # Each store has errors of its own, and many libraries beneath.
        what = " ".join(f"{type(error).__name__}: {error}".split())[:300]
        raise IndexFormatError(
            f"{url}: cannot be fetched: {what}; is this the folder of a sharded reference?"
        ) from error
