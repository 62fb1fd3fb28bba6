"""Equations that lay the road points of a query on the roads of a map, for an adjustment with a prior of its own.

The parameters are those of `kernels.growth`: p = (h00 h01 h02 h10 h11 h12 h20 h21), h22 = 1, between normalised
coordinates, query (x - x0) / half_size and reference (X - X0) / unit.
"""

import math

import numpy as np

from roadgeo.kernels.adjustment import add_row, point_row
from roadgeo.kernels.arrays import Floats1, Floats2
from roadgeo.kernels.compilation import kernel
from roadgeo.kernels.roads import nearest_road
from roadgeo.kernels.structs import RoadBuckets

__all__ = ["road_equations"]


@kernel(writes=("normal", "right"))
def road_equations(
    p: Floats1,
    unit: float,
    origin: Floats1,
    points: Floats2,
    directions: Floats2,
    radius: float,
    sigma: float,
    min_cos: float,
    roads: RoadBuckets,
    normal: Floats2,
    right: Floats1,
) -> int:
    """Add the equations of all road points to normal dp = right; return how many met a road.

    Residuals lie across the roads, in normalised units, with Cauchy weights.

    Parameters
    ----------
    p : (8,) float64
    unit, origin
        Metres per normalised unit, and the reference point (2,) of the normalised (0, 0).
    points, directions : (S, 2) float64
        The query's road points, normalised, and unit vectors along the road.
    radius, sigma : float
        Roads nearer than `radius` metres count, and errors of `sigma` metres are usual.
    min_cos
        As in `nearest_road`.
    normal, right : (8, 8), (8,) float64
        Added to; of `normal` both triangles.
    """
    row = np.empty(8)
    met = 0
    for i in range(points.shape[0]):
        u, v = points[i, 0], points[i, 1]
        w = 1.0 + p[6] * u + p[7] * v
        if w < 0.05:
            continue
        # Where the point comes to lie, and which way its road runs there.
        x, y = (p[0] * u + p[1] * v + p[2]) / w, (p[3] * u + p[4] * v + p[5]) / w
        dw = p[6] * directions[i, 0] + p[7] * directions[i, 1]
        dx = p[0] * directions[i, 0] + p[1] * directions[i, 1] - x * dw
        dy = p[3] * directions[i, 0] + p[4] * directions[i, 1] - y * dw
        length = math.sqrt(dx * dx + dy * dy)
        if length == 0.0:
            continue
        gx, gy = origin[0] + unit * x, origin[1] + unit * y
        d, fx, fy, rx, ry = nearest_road(
            gx,
            gy,
            dx / length,
            dy / length,
            radius,
            min_cos,
            roads.segments,
            roads.starts,
            roads.ids,
            roads.grid,
            roads.shape,
        )
        if not d < radius:
            continue
        # One equation, across the road (rx, ry) of the map that it met at (fx, fy).
        met += 1
        point_row(p, u, v, -ry, rx, row)
        away = (fy - gy) * rx - (fx - gx) * ry
        add_row(normal, right, row, 1.0 / (1.0 + (away / sigma) ** 2), away / unit)
    for r in range(8):
        for c in range(r):
            normal[c, r] = normal[r, c]
    return met
