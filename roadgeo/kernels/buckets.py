"""Bucket grids over points: the nearest neighbours of every point, and points near a place.

Points are stored sorted by bucket (row-major), so that bucket `c` owns the points `starts[c]:starts[c + 1]` and no list of
ids is needed. `grid` = (x0, y0, cell size) and `shape` = (columns, rows).
"""

import numpy as np
from numba import njit


@njit(cache=True)
def bucket_of(x, y, grid, shape):
    """Return the bucket of a point; points outside fall into the nearest bucket of the rim."""
    column = int(np.floor((x - grid[0]) / grid[2]))
    row = int(np.floor((y - grid[1]) / grid[2]))
    column = min(max(column, 0), shape[0] - 1)
    row = min(max(row, 0), shape[1] - 1)
    return row * shape[0] + column


@njit(cache=True)
def nearest_neighbours(xy, starts, grid, shape, k):
    """Return (N, k) int32: each point's k nearest others, nearest first, -1 where there are fewer.

    Rings of buckets are searched outwards until the k-th distance lies inside the searched square.
    """
    n = xy.shape[0]
    neighbours = np.full((n, k), -1, np.int32)
    best = np.empty(k)
    reach = max(shape[0], shape[1])
    for i in range(n):
        x, y = xy[i, 0], xy[i, 1]
        column = min(max(int(np.floor((x - grid[0]) / grid[2])), 0), shape[0] - 1)
        row = min(max(int(np.floor((y - grid[1]) / grid[2])), 0), shape[1] - 1)
        found = 0
        best[:] = np.inf
        for ring in range(reach + 1):
            safe = (ring - 1) * grid[2]
            if found == k and ring > 0 and best[k - 1] <= safe * safe:
                break
            for r in range(max(row - ring, 0), min(row + ring, shape[1] - 1) + 1):
                inner = abs(r - row) < ring
                step = 2 * ring if inner and ring > 0 else 1
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
