"""Packed files of strangers: unpacked size is bounded, and a temporary folder receives them."""

from __future__ import annotations

import bz2
import gzip
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from roadgeo.errors import RoadSourceError

__all__ = ["PACKED", "read_chunks", "require_bounded", "unpack"]

#: Endings of packed files. OpenStreetMap's are read as they are.
_ARCHIVES = (".zip", ".shz")
PACKED = (".gz", ".bz2", *_ARCHIVES)

#: A packed file may unpack to this many bytes, and beyond them to a multiple of its size: XML shrinks to a tenth.
_FREE, _TIMES = 64 << 20, 100
_CHUNK, _BLOCK = 1 << 20, 4096


def read_chunks(path: Path) -> Iterator[bytes]:
    """Yield the content of a file, unpacked where its name ends in .gz or .bz2.

    Raises
    ------
    RoadSourceError
        It unpacks to far more than any map, or is damaged.
    """
    opener: Any = {".gz": gzip.open, ".bz2": bz2.open}.get(path.suffix.lower())
    n_read = 0
    try:
        with opener(path) if opener else path.open("rb") as file:
            while chunk := file.read(_CHUNK):
                n_read += len(chunk)
                if opener:
                    require_bounded(path, n_read)
                yield chunk
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise RoadSourceError(f"{path}: it is cut off or damaged") from error


def require_bounded(path: Path, unpacked: int) -> None:
    """Refuse a file that unpacks to far more than any map."""
    if unpacked > _FREE + _TIMES * path.stat().st_size:
        raise RoadSourceError(
            f"{path}: unpacks to more than {_TIMES} times its size; unpack it yourself if you trust it"
        )


def unpack(path: Path, folder: Path) -> Path:
    """Unpack a file into a folder that exists; return the file, or of an archive the folder.

    Raises
    ------
    RoadSourceError
        As `read_chunks`; it is encrypted, or no archive.
    """
    if path.suffix.lower() not in _ARCHIVES:
        target = folder / path.stem
        with target.open("wb") as out:
            out.writelines(read_chunks(path))
        return target
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            # No more of a member is unpacked than its header states; and each costs a block of the disk.
            require_bounded(path, sum(member.file_size + _BLOCK for member in members))
            archive.extractall(folder)  # leaves out what would lie outside
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, NotImplementedError, ValueError) as error:
        raise RoadSourceError(f"{path}: not readable as a ZIP file: {str(error)[:100]}") from error
    return folder
