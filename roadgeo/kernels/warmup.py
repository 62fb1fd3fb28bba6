"""Prepare kernels before any clock runs: they are compiled once per machine and loaded once per process."""

from __future__ import annotations

import os
import shutil
import time
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

from roadgeo._progress import Say, say_nothing
from roadgeo.kernels.compilation import kernel_folder, load, modules_of_maps

__all__ = ["remove_unused", "warm_up"]

#: Machine code takes some megabytes for each version of roadgeo, numba, numpy and Python.
_KEPT_DAYS = 30.0


def warm_up(say: Say = say_nothing, map_only: bool = False) -> None:
    """Load the machine code of the search, or of a map only; compile it first where this machine lacks it.

    It is cheap to call again. `say` is called for compilation only.
    """
    compiling = False

    def tell(done: int, total: int) -> None:
        nonlocal compiling
        compiling = True
        say(f"Compiling {total} kernels for this machine, once: up to half a minute", done / total)

    load(modules_of_maps() if map_only else None, tell)
    _note_use()
    if compiling:
        remove_unused(kernel_folder())


@lru_cache(maxsize=1)
def _note_use() -> None:
    """Mark the machine code as used today, once a process."""
    with suppress(OSError):  # it may lie in a read-only folder
        os.utime(kernel_folder())


def remove_unused(folder: Path) -> None:
    """Delete the machine code of other versions beside a folder that was not used for weeks."""
    oldest = time.time() - _KEPT_DAYS * 86_400.0
    for other in folder.parent.glob("kernels-*"):
        with suppress(OSError):
            if other != folder and other.is_dir() and not other.is_symlink() and other.stat().st_mtime < oldest:
                shutil.rmtree(other, ignore_errors=True)
