"""Branches of two intersections compared.

Branches are unit vectors scaled to 127 and rounded, (N, R, 2) int8 with zeros behind the last. A comparison takes a few
products and no trigonometry, an intersection takes 2 R bytes, and rounding turns a branch by less than 0.4 degrees.
"""

import math

import numpy as np
from numpy.typing import NDArray

from roadgeo.kernels.compilation import kernel

__all__ = ["rays_agree"]


@kernel()
def rays_agree(
    branches: NDArray[np.int8],
    i: int,
    ref_branches: NDArray[np.int8],
    j: int,
    j00: float,
    j01: float,
    j10: float,
    j11: float,
    min_cos: float,
) -> bool:
    """Return whether the branches of query intersection i, mapped, agree with the branches of map intersection j.

    Each branch takes the nearest free partner. Every branch of the intersection with fewer branches must find one.

    Parameters
    ----------
    branches : (N, R, 2) int8, ref_branches : (M, R', 2) int8
        Scaled unit vectors, zeros behind the last; R' <= 64.
    j00, j01, j10, j11 : float
        Jacobian of the map from query to reference, which turns the branches.
    min_cos : float
        Cosine of the greatest angle between partners, positive.
    """
    n, m, same = 0, 0, 0
    while m < ref_branches.shape[1] and (ref_branches[j, m, 0] != 0 or ref_branches[j, m, 1] != 0):
        m += 1
    used = 0
    for s in range(branches.shape[1]):
        qx, qy = float(branches[i, s, 0]), float(branches[i, s, 1])
        if qx == 0.0 and qy == 0.0:
            break
        n += 1
        dx, dy = j00 * qx + j01 * qy, j10 * qx + j11 * qy
        best, where = min_cos * 127.0 * math.sqrt(dx * dx + dy * dy), -1
        for t in range(m):
            if (used >> t) & 1:
                continue
            along = dx * ref_branches[j, t, 0] + dy * ref_branches[j, t, 1]
            if along > best:
                best, where = along, t
        if where >= 0:
            used |= 1 << where
            same += 1
    return same >= min(n, m)
