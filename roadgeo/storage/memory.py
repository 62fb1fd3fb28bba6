"""Memory: how much of it readers of strangers' files may take, and memory that is given back to the system."""

from __future__ import annotations

import contextlib
import ctypes
import mmap
import os
import re
import threading
from collections.abc import Callable, Iterable, Iterator
from functools import cache, wraps
from pathlib import Path
from typing import Concatenate, ParamSpec, TypeVar

import numpy as np

from roadgeo._arrays import AnyArray
from roadgeo.errors import RoadgeoError, RoadSourceError, is_of_memory
from roadgeo.storage.fence import is_inside

__all__ = ["MEMORY", "bounded", "each_bounded", "give_back_memory", "let_pages_go"]

_P = ParamSpec("_P")
_Part = TypeVar("_Part")

#: Variable that states how much memory the reading of a file may take, GB.
MEMORY = "ROADGEO_MEMORY"
#: Else it is this number of bytes, and beyond them a multiple of the file's size, but no more than half of free memory.
_FREE, _TIMES = 1 << 30, 100


@contextlib.contextmanager
def bounded(
    path: str | os.PathLike[str], fault: type[RoadgeoError] = RoadSourceError, before: int | None = None
) -> Iterator[None]:
    """Bound the memory that the block takes to read a file: inside the fence, or where ROADGEO_MEMORY sets how much.

    The bound is one of the whole process, and so not for programs that merely use roadgeo.

    Parameters
    ----------
    fault : class
        The error that is raised where it takes more.
    before : int, optional
        What the process held before the file was opened, bytes; by default what it holds now.

    Raises
    ------
    RoadgeoError
        The block takes more; the class is `fault`.
    """
    held, thread = _held_bytes() if before is None else before, threading.get_ident()
    if held is None or thread in _bounds or not (is_inside() or MEMORY in os.environ):
        yield
        return
    most = _allowance(path)
    _set_bound(thread, (held, most))
    try:
        yield
    except Exception as error:
        if not is_of_memory(error):
            raise
        raise fault(
            f"{os.fspath(path)}: takes more than {most / 1e9:.1f} GB of memory to read; if you trust it, --memory GB"
        ) from error
    finally:
        _set_bound(thread, None)


#: The bound of each thread that reads: bytes that the process held before, and how many more it may take.
_bounds: dict[int, tuple[int, int]] = {}
_LOCK = threading.Lock()
_UNLIMITED = 1 << 64  # -1 stands for no limit


def _set_bound(thread: int, bound: tuple[int, int] | None) -> None:
    """Have the system refuse this process more memory than its threads may take together; None ends a thread's."""
    import resource

    with _LOCK:
        own, hard = _own_limits()
        _bounds.pop(thread, None)
        _bounds.update({} if bound is None else {thread: bound})
        before, more = zip(*_bounds.values(), strict=True) if _bounds else ((own,), (0,))
        limit = min(own, min(before) + sum(more), key=lambda limit: limit % _UNLIMITED)
        resource.setrlimit(resource.RLIMIT_DATA, (limit, hard))


@cache
def _own_limits() -> tuple[int, int]:
    """Return the limits that this process was started with."""
    import resource

    return resource.getrlimit(resource.RLIMIT_DATA)


def each_bounded(
    read: Callable[Concatenate[Path, _P], Iterator[_Part]],
) -> Callable[Concatenate[Path, _P], Iterator[_Part]]:
    """Have a reader read the parts of a file within one bound on memory (see `bounded`), with all that is kept."""

    @wraps(read)
    def read_bounded(path: Path, /, *args: _P.args, **kwargs: _P.kwargs) -> Iterator[_Part]:
        before, rest = _held_bytes(), read(path, *args, **kwargs)
        while True:
            with bounded(path, before=before):
                part = next(rest, None)
            if part is None:
                return
            yield part

    return read_bounded


def _allowance(path: str | os.PathLike[str]) -> int:
    """Return how much memory the reading of a file may take, bytes."""
    with contextlib.suppress(ValueError):
        return round(float(os.environ.get(MEMORY, "")) * 1e9)
    size = Path(path).stat().st_size if Path(path).is_file() else 0
    return min(_FREE + _TIMES * size, _available_bytes() // 2)


def _held_bytes() -> int | None:
    """Return the memory for data that this process has asked for; None where that is not known."""
    try:
        return int(Path("/proc/self/statm").read_text("ascii").split()[5]) * mmap.PAGESIZE
    except (OSError, ValueError, IndexError):
        return None


def _available_bytes() -> int:
    """Return the memory that is free, or can be made so."""
    match = re.search(r"MemAvailable:\s+(\d+) kB", Path("/proc/meminfo").read_text("ascii"))
    return int(match[1]) << 10 if match else _FREE


def give_back_memory() -> None:
    """Give memory that is free within this process back to the system, where its C library can.

    Memory of many small objects, such as geometries, is kept by glibc for more of their kind: cutting a million lines
    where they cross leaves 1.9 GB of it, and arrays take none of that.
    """
    with contextlib.suppress(AttributeError, OSError, TypeError):  # not on macOS, Windows and musl
        ctypes.CDLL(None).malloc_trim(0)


def let_pages_go(arrays: Iterable[AnyArray]) -> None:
    """Take the pages of memory-mapped arrays out of this process; those that are used come back by themselves.

    An index is read whole when it is opened, to sum its bytes. A search then looks at part of it. Pages that an array
    shares with its neighbours in the file stay.
    """
    for array in arrays:
        mapped = _mapped_file(array)
        if mapped is None or not array.size:
            continue
        start = array.ctypes.data - np.frombuffer(mapped, np.uint8).ctypes.data
        end = start + array.itemsize + int(np.subtract(array.shape, 1) @ np.array(array.strides))
        first, last = -(-start // mmap.PAGESIZE) * mmap.PAGESIZE, end // mmap.PAGESIZE * mmap.PAGESIZE
        if first < last:
            with contextlib.suppress(AttributeError, OSError):  # not on Windows
                mapped.madvise(mmap.MADV_DONTNEED, first, last - first)


def _mapped_file(array: AnyArray) -> mmap.mmap | None:
    """Return the file that an array is a view of, if it is one and cannot have been written to."""
    base: object = array
    while base is not None and not isinstance(base, mmap.mmap):
        base = base.obj if isinstance(base, memoryview) else getattr(base, "base", None)
    return None if array.flags.writeable else base
