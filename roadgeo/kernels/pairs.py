"""Kernel of the paper's matcher: hypotheses tested by the intersections that they send to others of their type."""

from typing import NamedTuple

import numpy as np

from roadgeo.kernels.arrays import Floats2, Floats3, Int32s1, Ints1
from roadgeo.kernels.compilation import kernel

__all__ = ["PairBuckets", "count_inliers"]


class PairBuckets(NamedTuple):
    """Reference intersections sorted by bucket (see `kernels.buckets`), and their types."""

    xy: Floats2  # (M, 2)
    codes: Ints1  # (M,)
    starts: Int32s1  # (B + 1,)
    grid: tuple[float, float, float]
    shape: tuple[int, int]


@kernel(error_model="numpy")
def _nearest(buckets: PairBuckets, x: float, y: float, code: int, radius: float) -> int:
    """Return the place of the reference intersection of type `code` nearest to (x, y) within `radius`, or -1."""
    xy, codes, starts, grid, shape = buckets
    left, right = (x - radius - grid[0]) / grid[2], (x + radius - grid[0]) / grid[2]
    low, high = (y - radius - grid[1]) / grid[2], (y + radius - grid[1]) / grid[2]
    if not (right >= 0.0 and left < shape[0] and high >= 0.0 and low < shape[1]):  # NaN neither
        return -1
    first, last = int(max(left, 0.0)), int(min(right, shape[0] - 1.0))
    best, found = radius * radius, -1
    for row in range(int(max(low, 0.0)), int(min(high, shape[1] - 1.0)) + 1):
        for slot in range(starts[row * shape[0] + first], starts[row * shape[0] + last + 1]):
            if codes[slot] != code:
                continue
            dx, dy = xy[slot, 0] - x, xy[slot, 1] - y
            squared = dx * dx + dy * dy
            if squared < best:
                best, found = squared, slot
    return found


@kernel(error_model="numpy")
def count_inliers(
    models: Floats3, xy: Floats2, codes: Ints1, buckets: PairBuckets, radius: float, one_to_one: bool, best: int
) -> tuple[int, int]:
    """Count the query intersections that are mapped near a reference intersection of their type (eq. 10).

    Parameters
    ----------
    models : (H, 3, 3) float64
        Query plane to reference plane.
    xy, codes : (N, 2) float64, (N,) int64
        Query intersections and their types: those likely to miss come first, so that failures end soon.
    radius : float
        Inlier distance, metres.
    one_to_one : bool
        Each reference intersection counts once; else as often as it is met.
    best : int
        The count to beat.

    Returns
    -------
    best, row : int
        The greatest count and its model; `best` as given and -1 where it was not beaten.
    """
    row = -1
    stamps = np.full(len(buckets.xy) if one_to_one else 0, -1)  # of the last model that met each of them
    for m in range(len(models)):
        h = models[m]
        misses_left, inliers = len(xy) - best, 0
        for q in range(len(xy)):
            u, v = xy[q, 0], xy[q, 1]
            w = 1.0 / (h[2, 0] * u + h[2, 1] * v + h[2, 2])
            x, y = (h[0, 0] * u + h[0, 1] * v + h[0, 2]) * w, (h[1, 0] * u + h[1, 1] * v + h[1, 2]) * w
            place = _nearest(buckets, x, y, codes[q], radius)
            if place >= 0 and (not one_to_one or stamps[place] != m):
                if one_to_one:
                    stamps[place] = m
                inliers += 1
            else:
                misses_left -= 1
                if misses_left <= 0:
                    break
        if misses_left > 0 and inliers > best:
            best, row = inliers, m
    return best, row
