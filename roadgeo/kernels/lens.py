"""Road points behind a lens: where nine parameters put them on the map, and the roads that they meet there.

The parameters are the eight of `kernels.homography_fit`, between normalised coordinates, and k1 of `geometry.lens`.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from roadgeo.kernels.adjustment import own_sigma
from roadgeo.kernels.arrays import Floats1, Floats2, Floats3
from roadgeo.kernels.compilation import kernel
from roadgeo.kernels.roads import nearest_road
from roadgeo.kernels.structs import RoadBuckets

__all__ = ["MeetLimits", "lens_rows", "meet_roads"]

#: A barrel folds over where r (1 + k1 r^2) no longer grows; nothing is seen beyond.
_UNFOLDED = 0.98
_NEWTON_STEPS = 8
#: Points nearer to the horizon than this w are not seen.
_LEAST_W = 0.02


class MeetLimits(NamedTuple):
    """Which roads points may meet.

    Attributes
    ----------
    unit, x, y : float
        Metres per normalised unit of the reference plane, and where its (0, 0) lies.
    slack : float
        Places may be off by this multiple of the parameters' covariance.
    max_radius, min_cos, sigma_m, map_sigma_m, mask_sigma
        As in `kernels.structs.AdjustLimits`.
    """

    unit: float
    x: float
    y: float
    slack: float
    max_radius: float
    min_cos: float
    sigma_m: float
    map_sigma_m: float
    mask_sigma: float


@kernel()
def _radius(seen: float, k1: float) -> float:
    """Solve r (1 + k1 r^2) = seen, by Newton's method from where it converges."""
    if k1 == 0.0:
        return seen
    if k1 < 0.0:
        farthest = _UNFOLDED / math.sqrt(-3.0 * k1)
        seen = min(seen, farthest * (1.0 + k1 * farthest**2))
    r = seen
    for _ in range(_NEWTON_STEPS):
        r -= (r * (1.0 + k1 * r * r) - seen) / (1.0 + 3.0 * k1 * r * r)
    return r


@kernel(forceinline=True)
def _see(
    p: NDArray[np.float64],
    k1: float,
    half_side: float,
    place: tuple[float, float, float, float],
    row: NDArray[np.float64],
) -> tuple[float, float, float, float, float]:
    """Map a point and the direction of its road; fill `row` (2, 9) with the derivatives of where it comes to lie.

    `place` is the normalised point and the unit vector, as the lens shows them. How far across the road a step of 1
    reaches comes last. Near the horizon NaN is returned.
    """
    # Lens: the point and its road as a pinhole would have shown them, and how the point moves with k1.
    ou, ov = place[0] / half_side, place[1] / half_side
    seen = math.sqrt(ou * ou + ov * ov)
    r = _radius(seen, k1)
    scale, square = r / seen if seen > 0.0 else 1.0, r * r
    u, v = half_side * scale * ou, half_side * scale * ov
    across, outwards = 1.0 / (1.0 + k1 * square), 1.0 / (1.0 + 3.0 * k1 * square)
    radial_u, radial_v = (ou / seen, ov / seen) if seen > 0.0 else (0.0, 0.0)
    along = (outwards - across) * (radial_u * place[2] + radial_v * place[3])
    du, dv = across * place[2] + along * radial_u, across * place[3] + along * radial_v
    mu, mv = -u * square * outwards, -v * square * outwards
    # Homography.
    w = 1.0 + p[6] * u + p[7] * v
    if not w >= _LEAST_W:
        return np.nan, np.nan, np.nan, np.nan, np.nan
    x, y = (p[0] * u + p[1] * v + p[2]) / w, (p[3] * u + p[4] * v + p[5]) / w
    row[:] = 0.0
    row[0, 0] = row[1, 3] = u / w
    row[0, 1] = row[1, 4] = v / w
    row[0, 2] = row[1, 5] = 1.0 / w
    row[0, 6], row[0, 7] = -x * u / w, -x * v / w
    row[1, 6], row[1, 7] = -y * u / w, -y * v / w
    xu, xv, yu, yv = (p[0] - x * p[6]) / w, (p[1] - x * p[7]) / w, (p[3] - y * p[6]) / w, (p[4] - y * p[7]) / w
    row[0, 8], row[1, 8] = xu * mu + xv * mv, yu * mu + yv * mv
    dx, dy = xu * du + xv * dv, yu * du + yv * dv
    length = math.sqrt(dx * dx + dy * dy)
    return x, y, dx / length, dy / length, abs(xu * yv - xv * yu) * outwards * across / length


@kernel(writes=("places", "rows"))
def lens_rows(
    p: Floats1, k1: float, half_side: float, points: Floats2, directions: Floats2, places: Floats2, rows: Floats3
) -> None:
    """Find where points come to lie, and the derivatives of that by the nine parameters.

    Parameters
    ----------
    p : (8,) float64
    half_side : float
        Half of the frame's longer side, normalised: the unit of k1.
    points, directions : (S, 2) float64
        Road points as the lens shows them, normalised, and unit vectors along the road.
    places : (S, 2) float64
        Filled, normalised; NaN near the horizon.
    rows : (S, 2, 9) float64
        Filled; NaN likewise.
    """
    for i in range(points.shape[0]):
        place = points[i, 0], points[i, 1], directions[i, 0], directions[i, 1]
        places[i, 0], places[i, 1], _, _, _ = _see(p, k1, half_side, place, rows[i])
        if math.isnan(places[i, 0]):
            rows[i] = np.nan


@kernel(writes=("rows", "residuals", "sigmas", "own"))
def meet_roads(
    p: Floats1,
    k1: float,
    half_side: float,
    points: Floats2,
    directions: Floats2,
    inverse: Floats2,
    limits: MeetLimits,
    roads: RoadBuckets,
    rows: Floats2,
    residuals: Floats1,
    sigmas: Floats1,
    own: Floats1,
) -> int:
    """Find the roads near points whose places are sure enough.

    Parameters
    ----------
    p, k1, half_side, points, directions
        As in `lens_rows`.
    inverse : (9, 9) float64
        Inverse of the present normal matrix: how sure a place is follows from it.
    rows : (S, 9) float64
        Filled for points that meet a road: the derivatives of their places across it, normalised.
    residuals : (S,) float64
        Filled: the way across to the road, metres; NaN where none is met.
    sigmas : (S,) float64
        Filled for points that meet a road: the standard deviation of that, metres.
    own : (S,) float64
        Filled likewise: its value if the place were known, in that of the middle of the frame.

    Returns
    -------
    int
        How many points meet a road.
    """
    segments, starts, ids, grid, shape = roads
    row = np.empty((2, 9))
    n_met = 0
    for i in range(points.shape[0]):
        residuals[i] = np.nan
        place = points[i, 0], points[i, 1], directions[i, 0], directions[i, 1]
        x, y, dx, dy, reach = _see(p, k1, half_side, place, row)
        if math.isnan(x) or math.isnan(dx):
            continue
        spread = 0.0
        for axis in range(2):
            for r in range(9):
                for c in range(9):
                    spread += row[axis, r] * inverse[r, c] * row[axis, c]
        known = own_sigma(limits.unit * reach, limits.sigma_m, limits.map_sigma_m, limits.mask_sigma)
        sigma = limits.sigma_m * math.sqrt(known**2 + limits.slack**2 * max(spread, 0.0))
        if not 3.0 * sigma <= limits.max_radius * max(1.0, known):  # NaN neither
            continue
        gx, gy = limits.x + limits.unit * x, limits.y + limits.unit * y
        d, fx, fy, rx, ry = nearest_road(
            gx, gy, dx, dy, 3.0 * sigma, limits.min_cos, segments, starts, ids, grid, shape
        )
        if d == np.inf:
            continue
        residuals[i], sigmas[i], own[i] = (fy - gy) * rx - (fx - gx) * ry, sigma, known
        for c in range(9):
            rows[i, c] = row[1, c] * rx - row[0, c] * ry
        n_met += 1
    return n_met
