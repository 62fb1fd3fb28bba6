"""How far mapped road points lie from the roads of the map, with the side and the road's direction."""

import math

import numpy as np

from roadgeo.kernels.arrays import Floats1, Floats2
from roadgeo.kernels.compilation import kernel
from roadgeo.kernels.roads import nearest_road
from roadgeo.kernels.structs import RoadBuckets

__all__ = ["road_residuals"]


@kernel(writes=("out",))
def road_residuals(
    mapped: Floats2, along: Floats2, radii: Floats1, min_cos: float, roads: RoadBuckets, out: Floats2
) -> int:
    """Find the nearest road that runs along each point.

    Parameters
    ----------
    mapped, along : (S, 2) float64
        Points on the reference plane, metres, and unit vectors along the road.
    radii : (S,) float64
        Roads nearer than this count, metres.
    min_cos
        As in `nearest_road`.
    out : (S, 3) float64
        Filled: the way from the point to the road, metres, and the unit vector in which it is counted; NaN where there
        is no road.

    Returns
    -------
    int
        How many points have a road.
    """
    met = 0
    for i in range(mapped.shape[0]):
        x, y = mapped[i, 0], mapped[i, 1]
        d, fx, fy, rx, ry = nearest_road(
            x, y, along[i, 0], along[i, 1], radii[i], min_cos,
            roads.segments, roads.starts, roads.ids, roads.grid, roads.shape,
        )  # fmt: skip
        if d == np.inf or math.isnan(d):
            out[i, 0] = out[i, 1] = out[i, 2] = np.nan
            continue
        met += 1
        out[i, 0] = (fy - y) * rx - (fx - x) * ry
        out[i, 1], out[i, 2] = -ry, rx
    return met
