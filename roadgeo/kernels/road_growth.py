"""Growth of a hypothesis by roads alone: from the roads around one intersection outwards over the whole query.

The model has the parameters of `kernels.adjustment`, between normalised coordinates: query (x - x0) / half_size and
reference (X - X0) / unit.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from roadgeo.kernels.adjustment import add_row, carry, point_row, solve_system
from roadgeo.kernels.arrays import Floats1, Floats2
from roadgeo.kernels.compilation import kernel
from roadgeo.kernels.roads import nearest_road
from roadgeo.kernels.structs import RoadBuckets

__all__ = ["Stages", "fit_to_roads", "grow_by_roads", "share_on_roads"]

#: Points of the first stage, the factor by which they grow at each stage, and the most; more are thinned out evenly.
_FIRST, _MORE, _ENOUGH = 60, 1.45, 120
#: Search radii of a stage's steps, metres: a proposal's scale and turn are rougher than a grown map's predictions.
_FIRST_RADII, _RADII = (25.0, 18.0, 12.0), (18.0, 12.0, 12.0)
#: Prior of a stage's change of the map: standard deviations of its linear part, and of its place.
_LINEAR_SIGMA, _PLACE_SIGMA_M = 0.08, 10.0
_POINT_SIGMA_M = 12.0
_FEWEST = 6
#: Points whose denominator is less lie at the horizon.
_LEAST_W = 0.05


class Stages(NamedTuple):
    """Options of growth.

    Maps are affine up to `affine_until`, in normalised units. A stage fails with less than `least_share` of its points
    on roads. `perspective_sigma` is the prior standard deviation of the two perspective parameters. `min_cos` limits
    the angle between a road and a point's direction. After each of the first stages only the `go_on` maps whose points
    are closest to roads are kept, and the first `sure` maps.
    """

    affine_until: float
    least_share: float
    perspective_sigma: float
    min_cos: float
    go_on: tuple[int, int, int]
    sure: int


@kernel(forceinline=True)
def _nearest(
    p: NDArray[np.float64],
    unit: float,
    origin: tuple[float, float],
    place: tuple[float, float, float, float],
    radius: float,
    min_cos: float,
    segments: NDArray[np.float32],
    starts: NDArray[np.int32],
    ids: NDArray[np.int32],
    grid: tuple[float, float, float],
    shape: tuple[int, int],
) -> tuple[float, float, float, float]:
    """Return the distance of the nearest road from a mapped point, across the road, its direction, and w.

    `place` is the point and its direction. Without a road within `radius` metres the distance is inf.
    """
    x, y, w, dx, dy, length = carry(p, place[0], place[1], place[2], place[3])
    if w < _LEAST_W or length == 0.0:
        return np.inf, 0.0, 0.0, w
    gx, gy = origin[0] + unit * x, origin[1] + unit * y
    d, fx, fy, rx, ry = nearest_road(
        gx, gy, dx / length, dy / length, radius, min_cos, segments, starts, ids, grid, shape,
    )  # fmt: skip
    if d == np.inf:
        return np.inf, 0.0, 0.0, w
    return (fy - gy) * rx - (fx - gx) * ry, rx, ry, w


@kernel()
def fit_to_roads(
    p: NDArray[np.float64],
    unit: float,
    origin: NDArray[np.float64],
    points: NDArray[np.float64],
    directions: NDArray[np.float64],
    radius: float,
    min_cos: float,
    holds: NDArray[np.float64],
    roads: RoadBuckets,
) -> bool:
    """Take a Gauss-Newton step that moves road points to the nearest roads of the map; return whether it worked.

    Residuals lie across the roads, with Cauchy weights of half the search radius.

    Parameters
    ----------
    p : (8,) float64
        Adjusted in place.
    unit, origin
        Metres per normalised unit, and the reference point (2,) of the normalised (0, 0).
    points, directions : (S, 2) float64
        The query's road points, normalised, and unit vectors along the road.
    radius : float
        Roads nearer than this count, metres.
    min_cos
        As in `nearest_road`.
    holds : (8,) float64
        Weights that hold each parameter where it is.
    """
    normal, factor, right, row = np.zeros((8, 8)), np.zeros((8, 8)), np.zeros(8), np.empty(8)
    segments, starts, ids, grid, shape = roads
    at = origin[0], origin[1]
    met = 0
    for i in range(points.shape[0]):
        place = points[i, 0], points[i, 1], directions[i, 0], directions[i, 1]
        away, rx, ry, w = _nearest(p, unit, at, place, radius, min_cos, segments, starts, ids, grid, shape)
        if w < _LEAST_W:
            return False
        if away == np.inf:
            continue
        met += 1
        point_row(p, points[i, 0], points[i, 1], (0.0, 0.0), -ry, rx, row)
        add_row(normal, right, row, 1.0 / (1.0 + (2.0 * away / radius) ** 2), away / unit)
    for r in range(8):
        normal[r, r] += holds[r]
    return met >= _FEWEST and solve_system(p, normal, right, factor) >= 0.0


@kernel()
def share_on_roads(
    p: NDArray[np.float64],
    unit: float,
    origin: NDArray[np.float64],
    points: NDArray[np.float64],
    directions: NDArray[np.float64],
    radius: float,
    min_cos: float,
    roads: RoadBuckets,
) -> tuple[float, float]:
    """Return the share of points on roads of their direction (see `fit_to_roads`), and their mean closeness.

    A point is on a road that is nearer than `radius` metres. Its closeness falls from 1 on the road to 0 at `radius`.
    """
    segments, starts, ids, grid, shape = roads
    at = origin[0], origin[1]
    met, closeness = 0, 0.0
    for i in range(points.shape[0]):
        place = points[i, 0], points[i, 1], directions[i, 0], directions[i, 1]
        away, _, _, w = _nearest(p, unit, at, place, radius, min_cos, segments, starts, ids, grid, shape)
        if w >= _LEAST_W and away < np.inf:
            met += 1
            closeness += 1.0 - min(abs(away) / radius, 1.0)
    n = max(points.shape[0], 1)
    return met / n, closeness / n


@kernel(writes=("ps", "closeness"))
def grow_by_roads(
    ps: Floats2,
    units: Floats1,
    origins: Floats2,
    tolerances: Floats1,
    points: Floats2,
    directions: Floats2,
    stages: Stages,
    roads: RoadBuckets,
    closeness: Floats1,
) -> None:
    """Grow maps of one query side by side from the nearest points outwards; those that fit worst are given up.

    Each stage fits the maps to the nearest points, more of them each time: affine maps first, homographies beyond
    `affine_until` and over the whole query.

    Parameters
    ----------
    ps, units, origins : (M, 8), (M,), (M, 2) float64
        As in `fit_to_roads`, of each map. `ps` are adjusted in place.
    tolerances : (M,) float64
        Distance within which a point lies on a road, metres.
    points, directions
        As in `fit_to_roads`; points nearest to (0, 0) first.
    closeness : (M,) float64
        Filled with the mean closeness of all points (see `share_on_roads`); -1 for a map that was given up.
    """
    n = points.shape[0]
    closeness[:] = 0.0 if n > 0 else -1.0
    count, stage = min(_FIRST, n), 0
    while count > 0:
        bent = count == n or math.hypot(points[count - 1, 0], points[count - 1, 1]) > stages.affine_until
        step = max(1, count // _ENOUGH)
        some, along = points[:count:step], directions[:count:step]
        radii = _FIRST_RADII if stage == 0 else _RADII
        for m in range(closeness.shape[0]):
            if closeness[m] >= 0.0:
                place = ps[m], units[m], origins[m]
                closeness[m] = _fit_stage(place, tolerances[m], some, along, radii, bent, stages, roads)
        if count == n:
            break
        if stage < len(stages.go_on):
            _give_up_worst(closeness[stages.sure :], stages.go_on[stage])
        count, stage = min(int(count * _MORE) + 1, n), stage + 1


@kernel()
def _fit_stage(
    place: tuple[NDArray[np.float64], float, NDArray[np.float64]],
    tolerance: float,
    points: NDArray[np.float64],
    directions: NDArray[np.float64],
    radii: tuple[float, float, float],
    bent: bool,
    stages: Stages,
    roads: RoadBuckets,
) -> float:
    """Fit one map, its `place` being p, unit and origin, to a stage's points; return their closeness, or -1."""
    p, unit, origin = place
    holds = np.empty(8)
    for r in range(6):
        sigma = _PLACE_SIGMA_M / unit if r % 3 == 2 else _LINEAR_SIGMA
        holds[r] = (_POINT_SIGMA_M / unit / sigma) ** 2
    holds[6] = holds[7] = (_POINT_SIGMA_M / unit / stages.perspective_sigma) ** 2 if bent else 1e9
    for k in range(3):
        radius = max(radii[k], 1.5 * tolerance)
        if not fit_to_roads(p, unit, origin, points, directions, radius, stages.min_cos, holds, roads):
            return -1.0
    share, closeness = share_on_roads(p, unit, origin, points, directions, tolerance, stages.min_cos, roads)
    return closeness if share >= stages.least_share else -1.0


@kernel()
def _give_up_worst(closeness: NDArray[np.float64], most: int) -> None:
    """Set to -1 all but the `most` greatest; of equal ones the first stay."""
    for _ in range((closeness >= 0.0).sum() - most):
        worst = -1
        for m in range(closeness.shape[0]):
            if closeness[m] >= 0.0 and (worst < 0 or closeness[m] <= closeness[worst]):
                worst = m
        closeness[worst] = -1.0
