"""Intersections of the query matched to the nearest ones of the map whose branches agree."""

import math

import numpy as np
from numpy.typing import NDArray

from roadgeo.kernels.arrays import Floats1, Floats2, Int8s3, Ints1
from roadgeo.kernels.compilation import kernel
from roadgeo.kernels.rays import rays_agree
from roadgeo.kernels.structs import PointBuckets

__all__ = ["keep_nearest", "match_all", "nearest_alike"]


@kernel()
def nearest_alike(
    x: float,
    y: float,
    radius: float,
    branches: NDArray[np.int8],
    i: int,
    ref_xy: NDArray[np.float64],
    ref_branches: NDArray[np.int8],
    starts: NDArray[np.int32],
    grid: tuple[float, float, float],
    shape: tuple[int, int],
    jacobian: tuple[float, float, float, float],
    min_cos: float,
) -> tuple[int, float]:
    """Return the number and distance of the nearest intersection of the map with agreeing branches, or (-1, `radius`).

    Parameters
    ----------
    x, y, radius : float
        Metres on the reference plane; intersections nearer than this count.
    branches, i, jacobian, min_cos
        As in `rays_agree`; the Jacobian row-major.
    ref_xy, ref_branches, starts, grid, shape
        The map's intersections, as in `PointBuckets`.
    """
    j00, j01, j10, j11 = jacobian
    best, where = radius, -1
    if not abs(x) + abs(y) < 1e15:  # infinite or NaN: no bucket has such a number
        return where, best
    c0 = max(int(np.floor((x - radius - grid[0]) / grid[2])), 0)
    c1 = min(int(np.floor((x + radius - grid[0]) / grid[2])), shape[0] - 1)
    r0 = max(int(np.floor((y - radius - grid[1]) / grid[2])), 0)
    r1 = min(int(np.floor((y + radius - grid[1]) / grid[2])), shape[1] - 1)
    if c1 < c0:
        return where, best
    for r in range(r0, r1 + 1):
        for j in range(starts[r * shape[0] + c0], starts[r * shape[0] + c1 + 1]):
            dx, dy = ref_xy[j, 0] - x, ref_xy[j, 1] - y
            d = math.sqrt(dx * dx + dy * dy)
            if d < best and rays_agree(branches, i, ref_branches, j, j00, j01, j10, j11, min_cos):
                best, where = d, j
    return where, best


@kernel()
def keep_nearest(matched: NDArray[np.int64], distance: NDArray[np.float64]) -> int:
    """Let the nearest of several claimants keep a partner, the first of equals; return the number of matches left.

    Parameters
    ----------
    matched : (N,) int64
        Partners or -1; the losers' are set to -1.
    distance : (N,) float64
        Distance from each point to its partner.
    """
    n = matched.shape[0]
    size = 4
    while size < 2 * n:
        size *= 2
    keeper = np.full(size, -1, np.int64)  # a hash table by partner, probed linearly
    count = 0
    for i in range(n):
        if matched[i] < 0:
            continue
        slot = (matched[i] * 40503) & (size - 1)
        while keeper[slot] >= 0 and matched[keeper[slot]] != matched[i]:
            slot = (slot + 1) & (size - 1)
        k = keeper[slot]
        if k < 0:
            keeper[slot] = i
            count += 1
        elif distance[i] < distance[k]:
            keeper[slot] = i
            matched[k] = -1
        else:
            matched[i] = -1
    return count


@kernel(writes=("matched", "distance"))
def match_all(
    matrix: Floats2,
    xy: Floats2,
    branches: Int8s3,
    radius: float,
    min_cos: float,
    points: PointBuckets,
    matched: Ints1,
    distance: Floats1,
) -> int:
    """Match every intersection of the query to the nearest one of the map with agreeing branches, one to one.

    Parameters
    ----------
    matrix : (3, 3) float64
        Query plane to reference plane.
    xy : (N, 2) float64, branches : (N, R, 2) int8
        The query's intersections.
    radius : float
        Metres.
    min_cos : float
        As in `rays_agree`.
    points : PointBuckets
        The map's intersections.
    matched : (N,) int64
        Filled with map intersections or -1.
    distance : (N,) float64
        Filled with metres, `radius` for an intersection without a partner.

    Returns
    -------
    int
        Number of matches.
    """
    ref_xy, ref_branches, starts, grid, shape = points
    for i in range(xy.shape[0]):
        matched[i] = -1
        distance[i] = radius
        u, v = xy[i, 0], xy[i, 1]
        w = matrix[2, 0] * u + matrix[2, 1] * v + matrix[2, 2]
        if w <= 0.0:
            continue
        x = (matrix[0, 0] * u + matrix[0, 1] * v + matrix[0, 2]) / w
        y = (matrix[1, 0] * u + matrix[1, 1] * v + matrix[1, 2]) / w
        jacobian = (
            (matrix[0, 0] - x * matrix[2, 0]) / w, (matrix[0, 1] - x * matrix[2, 1]) / w,
            (matrix[1, 0] - y * matrix[2, 0]) / w, (matrix[1, 1] - y * matrix[2, 1]) / w,
        )  # fmt: skip
        matched[i], distance[i] = nearest_alike(
            x, y, radius, branches, i, ref_xy, ref_branches, starts, grid, shape, jacobian, min_cos
        )
    return keep_nearest(matched, distance)
