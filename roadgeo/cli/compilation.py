"""Kernels are compiled once per machine: here, with a word to the user."""

from __future__ import annotations

__all__ = ["compile_once"]


def compile_once(map_only: bool = False) -> None:
    """Make the kernels ready; where they were not compiled yet, show that on standard error.

    A map alone needs half of them.
    """
    from roadgeo.cli.progress import show_steps
    from roadgeo.kernels.warmup import warm_up

    with show_steps() as say:
        warm_up(say, map_only)
