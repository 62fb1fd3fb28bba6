"""Writing files so that a reader sees the old one or the whole new one, never a part."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from roadgeo.errors import OutputError

__all__ = ["replacing", "write_bytes", "write_text"]


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
    temporary = target.with_name(f".{target.stem}.{os.getpid()}.part{target.suffix}")
    try:
        try:
            yield temporary
            if sync:
                _sync(temporary)
            temporary.replace(target)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(
            f"cannot write {target}: {error.strerror or error}; choose a folder that exists and that you may write to"
        ) from error


def write_bytes(path: str | os.PathLike[str], content: bytes) -> None:
    """Write a whole file in one step (see `replacing`)."""
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def write_text(path: str | os.PathLike[str], content: str) -> None:
    """Write a whole UTF-8 text file with line feeds in one step (see `replacing`)."""
    write_bytes(path, content.encode())


def _sync(path: Path) -> None:
    with path.open("rb+") as file:
        os.fsync(file.fileno())
