"""The search is compiled once per machine. It is done here, before any clock runs, and with a word to the user."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from roadgeo._arrays import BoolArray
    from roadgeo.reference.reference import Reference

__all__ = ["compile_once"]

#: The practice mask shows about this many intersections, at one metre per pixel, on at most this many pixels.
_SHOWN, _MAX_SIDE = 60, 3000


def compile_once(reference: Reference, quiet: bool) -> None:
    """Where nothing was compiled yet, locate a mask drawn from the reference itself, which uses every kernel."""
    if not _is_cold() or len(reference.index) < _SHOWN:
        return
    if not quiet:
        click.echo("Compiling the search for this machine, once; it takes a few seconds ...", err=True)
    from roadgeo.workflows import locate

    locate(_practice_mask(reference), reference)


def _is_cold() -> bool:
    """Whether no kernel of the search was compiled yet."""
    from roadgeo.kernels.compilation import kernel_folder

    folder = os.environ.get("NUMBA_CACHE_DIR") or kernel_folder()
    return not any(Path(folder).rglob("growth.*.nbi"))


def _practice_mask(reference: Reference) -> BoolArray:
    """Draw the roads around the middle of the map, one metre per pixel, as a (H, W) bool mask."""
    import cv2
    import numpy as np

    index = reference.index
    middle = index.xy[np.argmin(np.hypot(*(index.xy - np.median(index.xy, axis=0)).T))]
    reach = np.sort(np.hypot(*(index.xy - middle).T))[_SHOWN - 1]
    side = int(min(2 * reach, _MAX_SIDE))
    ends = (index.segments.astype(float).reshape(-1, 2, 2) - middle) * (1, -1) + side / 2
    near = (np.abs(ends - side / 2) < 2 * side).all(axis=(1, 2))
    mask = np.zeros((side, side), np.uint8)
    cv2.polylines(mask, list(np.rint(ends[near]).astype(np.int32)), False, 1, 7)
    return mask > 0
