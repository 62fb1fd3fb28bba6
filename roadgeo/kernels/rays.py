"""Branches of two intersections compared."""

import math

import numpy as np
from numba import njit


@njit(cache=True)
def rays_agree(rays, i, ref_rays, j, j00, j01, j10, j11, tolerance):
    """Whether the rays of query intersection i, turned by the Jacobian, agree with those of reference intersection j.

    All rays of the poorer of the two must have a partner of their own within `tolerance` radians.
    """
    n, m, same = 0, 0, 0
    while m < ref_rays.shape[1] and not np.isnan(ref_rays[j, m]):
        m += 1
    used = 0
    for s in range(rays.shape[1]):
        if np.isnan(rays[i, s]):
            break
        n += 1
        dx, dy = math.cos(rays[i, s]), math.sin(rays[i, s])
        angle = math.atan2(j10 * dx + j11 * dy, j00 * dx + j01 * dy)
        best, where = tolerance, -1
        for t in range(m):
            if (used >> t) & 1:
                continue
            difference = abs(angle - ref_rays[j, t])
            if difference > math.pi:
                difference = 2.0 * math.pi - difference
            if difference < best:
                best, where = difference, t
        if where >= 0:
            used |= 1 << where
            same += 1
    return same >= min(n, m)
