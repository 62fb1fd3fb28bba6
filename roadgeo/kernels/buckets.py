"""Bucket grids over points: the nearest neighbours of every point.

Points are stored sorted by bucket, row by row, so that bucket c owns the points `starts[c]:starts[c + 1]` and no list
of ids is needed. `grid` is (x0, y0, bucket size), `shape` is (columns, rows), and bucket c = row * columns + column.
"""

import numpy as np

from roadgeo.kernels.arrays import Floats2, Int32s1, Int32s2
from roadgeo.kernels.compilation import kernel

__all__ = ["nearest_neighbours"]


@kernel()
def nearest_neighbours(
    xy: Floats2,
    starts: Int32s1,
    grid: tuple[float, float, float],
    shape: tuple[int, int],
    k: int,
) -> Int32s2:
    """Return each point's k nearest others, nearest first.

    Rings of buckets are searched outwards until the k-th distance lies inside the square searched.

    Parameters
    ----------
    xy : (N, 2) float64
        Points, sorted by bucket, none outside the grid.
    starts : (B + 1,) int32

    Returns
    -------
    (N, k) int32
        -1 where there are fewer than k others.
    """
    n = xy.shape[0]
    neighbours = np.full((n, k), -1, np.int32)
    best = np.empty(k)
    for i in range(n):
        x, y = xy[i, 0], xy[i, 1]
        column = min(max(int(np.floor((x - grid[0]) / grid[2])), 0), shape[0] - 1)
        row = min(max(int(np.floor((y - grid[1]) / grid[2])), 0), shape[1] - 1)
        found = 0
        best[:] = np.inf
        for ring in range(max(shape[0], shape[1]) + 1):
            safe = (ring - 1) * grid[2]
            if found == k and ring > 0 and best[k - 1] <= safe * safe:
                break
            for r in range(max(row - ring, 0), min(row + ring, shape[1] - 1) + 1):
                step = 2 * ring if abs(r - row) < ring else 1  # between its first and last row a ring has two buckets
                c = column - ring
                while c <= column + ring:
                    if 0 <= c < shape[0]:
                        bucket = r * shape[0] + c
                        for j in range(starts[bucket], starts[bucket + 1]):
                            if j == i:
                                continue
                            dx, dy = xy[j, 0] - x, xy[j, 1] - y
                            d = dx * dx + dy * dy
                            if d >= best[k - 1]:
                                continue
                            m = min(found, k - 1)
                            while m > 0 and best[m - 1] > d:
                                best[m] = best[m - 1]
                                neighbours[i, m] = neighbours[i, m - 1]
                                m -= 1
                            best[m] = d
                            neighbours[i, m] = j
                            found = min(found + 1, k)
                    c += step
            if found == n - 1 and found < k:
                break
    return neighbours
