"""Kernels are made ready here, before any clock runs: compiled once per machine, loaded once per process."""

from __future__ import annotations

from functools import partial

from roadgeo._progress import Say, say_nothing
from roadgeo.kernels.compilation import load

__all__ = ["warm_up"]


def warm_up(say: Say = say_nothing) -> None:
    """Load the machine code of the search, after compiling what this machine has none of.

    It is cheap to call again. `say` hears of compilation only.
    """
    load(progress=partial(_tell, say))


def _tell(say: Say, done: int, total: int) -> None:
    say(f"Compiling {total} kernels for this machine: takes about 40 s, once", done / total)
