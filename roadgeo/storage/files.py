"""Writing files so that a reader sees the old one or the whole new one, never a part."""

from __future__ import annotations

import contextlib
import os
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path

from roadgeo.errors import OutputError
from roadgeo.storage.atomic import sync_file, writing

__all__ = ["replacing", "write_bytes", "write_text"]

#: Names of unfinished files, of whatever process, on whatever machine that shares the disk.
_LEFTOVER = re.compile(r"\..+\.\d+\.part(\.\w+)?")
_LEFT_S = 3600.0


@contextmanager
def replacing(path: str | os.PathLike[str], sync: bool = True) -> Iterator[Path]:
    """Yield a temporary name beside `path`; on success the file there takes the name `path`, else it is deleted.

    The temporary name keeps the suffix, so that drivers that go by it work. With `sync` the content is on the disk
    first: after a power cut the name stands for the old content or the new, not for an empty file.

    Raises
    ------
    OutputError
        The folder is missing or not writable, or the disk is full.
    """
    target = Path(path)
    _remove_leftovers(target.parent)
    temporary = target.with_name(f".{target.stem}.{os.getpid()}.part{target.suffix}")
    try:
        with writing(target):
            try:
                yield temporary
                if sync:
                    sync_file(temporary)
                temporary.replace(target)
            finally:
                temporary.unlink(missing_ok=True)
    except OutputError as error:
        raise OutputError(str(error).replace(str(temporary), str(target))) from error


@lru_cache(maxsize=64)
def _remove_leftovers(folder: Path) -> None:
    """Remove the unfinished files of writers that were killed an hour ago or earlier; once for each folder."""
    oldest = time.time() - _LEFT_S
    for path in folder.glob(".*.part*"):
        with contextlib.suppress(OSError):
            if _LEFTOVER.fullmatch(path.name) and path.stat().st_mtime < oldest:
                path.unlink()


def write_bytes(path: str | os.PathLike[str], content: bytes) -> None:
    """Write a whole file in one step (see `replacing`)."""
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def write_text(path: str | os.PathLike[str], content: str) -> None:
    """Write a whole UTF-8 text file with line feeds in one step (see `replacing`)."""
    write_bytes(path, content.encode())
