"""Memory given back to the system: blocks that libraries have freed, pages of mapped files."""

from __future__ import annotations

import contextlib
import ctypes
import mmap
from collections.abc import Iterable

import numpy as np

from roadgeo._arrays import AnyArray

__all__ = ["give_back_memory", "let_pages_go"]


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
