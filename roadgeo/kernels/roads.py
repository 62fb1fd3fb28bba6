"""Roads as short straight segments in buckets: the nearest one to a point, and how well two networks cover each other.

`segments` (S, 4) are x1, y1, x2, y2; bucket c lists the segments that touch it, `ids[starts[c]:starts[c + 1]]`. See
`kernels.buckets` for `grid` and `shape`.
"""

import math

import numpy as np
from numpy.typing import NDArray

from roadgeo.kernels.arrays import Bools2, Floats1, Floats2, Int32s1, Ints1, Singles2
from roadgeo.kernels.compilation import kernel
from roadgeo.kernels.structs import RoadBuckets

__all__ = [
    "bin_segments",
    "count_residuals",
    "meets_road",
    "nearest_road",
    "road_residuals",
    "screen",
    "shares_near_roads",
]


@kernel(writes=("starts", "ids"))
def bin_segments(
    segments: Singles2,
    grid: tuple[float, float, float],
    shape: tuple[int, int],
    starts: Ints1,
    ids: Int32s1,
) -> int:
    """Count the segments of every bucket, or list them.

    A segment is listed in every bucket of its bounding box that it crosses or comes near: segments are short, and a few
    entries too many cost less than an exact clip. Roads outside the grid belong to the buckets of its rim.

    Parameters
    ----------
    segments : (S, 4) float32
    starts : (B + 1,) int64
        To count: zeros; `starts[c + 1]` then grows by one for every segment of bucket c. To list: each bucket's first
        free place, which moves on.
    ids : (L,) int32
        Empty to count; otherwise filled with the segments' numbers.

    Returns
    -------
    int
        L, the number of entries.
    """
    write = ids.shape[0] > 0
    total = 0
    for s in range(segments.shape[0]):
        x1, y1, x2, y2 = segments[s, 0], segments[s, 1], segments[s, 2], segments[s, 3]
        c0 = min(max(int(np.floor((min(x1, x2) - grid[0]) / grid[2])), 0), shape[0] - 1)
        c1 = min(max(int(np.floor((max(x1, x2) - grid[0]) / grid[2])), 0), shape[0] - 1)
        r0 = min(max(int(np.floor((min(y1, y2) - grid[1]) / grid[2])), 0), shape[1] - 1)
        r1 = min(max(int(np.floor((max(y1, y2) - grid[1]) / grid[2])), 0), shape[1] - 1)
        length = math.sqrt((x2 - x1) ** 2 + (y2 - y1) ** 2)
        for r in range(r0, r1 + 1):
            for c in range(c0, c1 + 1):
                if r1 > r0 and c1 > c0:
                    mx = grid[0] + (c + 0.5) * grid[2] - x1
                    my = grid[1] + (r + 0.5) * grid[2] - y1
                    if abs(mx * (y2 - y1) - my * (x2 - x1)) > 0.7072 * grid[2] * length:  # half a bucket's diagonal
                        continue
                bucket = r * shape[0] + c
                if write:
                    ids[starts[bucket]] = s
                    starts[bucket] += 1
                else:
                    starts[bucket + 1] += 1
                total += 1
    return total


@kernel(forceinline=True)
def _buckets_around(
    x: float, y: float, radius: float, grid: tuple[float, float, float], shape: tuple[int, int]
) -> tuple[int, int, int, int]:
    """Return the first and last column, and the first and last row, of the buckets that a circle may touch.

    Where it touches none, the last row is less than the first.
    """
    column, row, reach = (x - grid[0]) / grid[2], (y - grid[1]) / grid[2], radius / grid[2]
    c0, c1 = int(max(column - reach, 0.0)), int(min(column + reach, shape[0] - 1.0))
    r0, r1 = int(max(row - reach, 0.0)), int(min(row + reach, shape[1] - 1.0))
    return c0, c1, r0, r1 if c0 <= c1 else r0 - 1


@kernel()
def nearest_road(
    x: float,
    y: float,
    dx: float,
    dy: float,
    radius: float,
    min_cos: float,
    segments: NDArray[np.float32],
    starts: NDArray[np.int32],
    ids: NDArray[np.int32],
    grid: tuple[float, float, float],
    shape: tuple[int, int],
) -> tuple[float, float, float, float, float]:
    """Return the distance of the nearest road that runs along (dx, dy), its foot point and its own direction.

    Parameters
    ----------
    x, y : float
        Metres on the reference plane.
    dx, dy : float
        Unit vector; roads count whose direction has |cos| >= `min_cos` with it.
    radius : float
        Roads nearer than this count, metres.

    Returns
    -------
    distance, foot x, foot y, direction x, direction y
        The distance is inf if no road is within the radius.
    """
    best = radius * radius
    fx, fy, ux, uy = 0.0, 0.0, 0.0, 0.0
    found = False
    if not abs(x) + abs(y) < 1e15:  # infinite or NaN: no bucket has such a number
        return np.inf, fx, fy, ux, uy
    c0, c1, r0, r1 = _buckets_around(x, y, radius, grid, shape)
    for first in range(r0 * shape[0] + c0, r1 * shape[0] + c0 + 1, shape[0]):  # the buckets of a row lie side by side
        for e in range(starts[first], starts[first + c1 - c0 + 1]):
            s = ids[e]
            ax, ay = segments[s, 0], segments[s, 1]
            sx, sy = segments[s, 2] - ax, segments[s, 3] - ay
            square = sx * sx + sy * sy
            across = (x - ax) * sy - (y - ay) * sx
            if across * across > best * square:  # as most are: too far from the line, found without a division
                continue
            t = ((x - ax) * sx + (y - ay) * sy) / square if square > 0.0 else 0.0
            t = min(max(t, 0.0), 1.0)
            ex, ey = ax + t * sx - x, ay + t * sy - y
            d = ex * ex + ey * ey
            if d < best:
                length = math.sqrt(square)
                if length == 0.0 or abs(sx * dx + sy * dy) < min_cos * length:
                    continue
                best = d
                found = True
                fx, fy, ux, uy = ax + t * sx, ay + t * sy, sx / length, sy / length
    if not found:
        return np.inf, fx, fy, ux, uy
    return math.sqrt(best), fx, fy, ux, uy


@kernel(forceinline=True)
def _carry(matrix: Floats2, u: float, v: float, du: float, dv: float) -> tuple[bool, float, float, float, float]:
    """Map a point and a unit vector along its road; return whether it lies this side of the horizon, and both."""
    w = matrix[2, 0] * u + matrix[2, 1] * v + matrix[2, 2]
    if w <= 0.0:
        return False, 0.0, 0.0, 0.0, 0.0
    x = (matrix[0, 0] * u + matrix[0, 1] * v + matrix[0, 2]) / w
    y = (matrix[1, 0] * u + matrix[1, 1] * v + matrix[1, 2]) / w
    dw = matrix[2, 0] * du + matrix[2, 1] * dv
    dx = matrix[0, 0] * du + matrix[0, 1] * dv - x * dw
    dy = matrix[1, 0] * du + matrix[1, 1] * dv - y * dw
    length = math.sqrt(dx * dx + dy * dy)
    if length == 0.0:
        return False, x, y, 0.0, 0.0
    return True, x, y, dx / length, dy / length


@kernel(writes=("out",))
def road_residuals(
    matrix: Floats2,
    points: Floats2,
    directions: Floats2,
    radii: Floats1,
    min_cos: float,
    roads: RoadBuckets,
    out: Floats2,
) -> int:
    """Find the distance of each road point of the query from a map road in its direction; return how many meet one.

    Parameters
    ----------
    matrix : (3, 3) float64
        Query plane to reference plane.
    points, directions : (S, 2) float64
        Points on the query's roads, in its plane, and unit vectors along the road.
    radii : (S,) float64
        Roads nearer than this count, metres.
    min_cos
        As in `nearest_road`.
    out : (S, 3) float64
        Filled: the distance from the point to the road, metres, and the unit vector along which it is measured; NaN
        without a road, or for a point beyond the horizon.
    """
    met = 0
    for i in range(points.shape[0]):
        ahead, x, y, dx, dy = _carry(matrix, points[i, 0], points[i, 1], directions[i, 0], directions[i, 1])
        out[i, 0] = out[i, 1] = out[i, 2] = np.nan
        if not ahead:
            continue
        d, fx, fy, rx, ry = nearest_road(
            x, y, dx, dy, radii[i], min_cos, roads.segments, roads.starts, roads.ids, roads.grid, roads.shape
        )
        if d < np.inf:
            met += 1
            out[i, 0] = (fy - y) * rx - (fx - x) * ry
            out[i, 1], out[i, 2] = -ry, rx
    return met


@kernel(writes=("shares",))
def shares_near_roads(
    matrix: Floats2,
    points: Floats2,
    directions: Floats2,
    weights: Floats1,
    radius: float,
    min_cos: float,
    shifts: Floats2,
    roads: RoadBuckets,
    shares: Floats1,
) -> None:
    """Fill `shares` (M,) with the share of the points near roads under each of `shifts` (M, 2), metres.

    Points count by `weights` (S,), which may not all be 0; the rest is as in `road_residuals`.
    """
    total = 0.0
    shares[:] = 0.0
    for i in range(points.shape[0]):
        total += weights[i]
        ahead, x, y, dx, dy = _carry(matrix, points[i, 0], points[i, 1], directions[i, 0], directions[i, 1])
        if not ahead:
            continue
        for m in range(shifts.shape[0]):
            if meets_road(x + shifts[m, 0], y + shifts[m, 1], dx, dy, radius, min_cos, roads):
                shares[m] += weights[i]
    for m in range(shifts.shape[0]):
        shares[m] = shares[m] / total if total > 0.0 else 0.0


@kernel()
def meets_road(x: float, y: float, dx: float, dy: float, radius: float, min_cos: float, roads: RoadBuckets) -> bool:
    """Return whether `nearest_road` would find a road; stop at the first."""
    segments, starts, ids, grid, shape = roads
    if not abs(x) + abs(y) < 1e15:  # infinite or NaN: no bucket has such a number
        return False
    c0, c1, r0, r1 = _buckets_around(x, y, radius, grid, shape)
    for first in range(r0 * shape[0] + c0, r1 * shape[0] + c0 + 1, shape[0]):  # the buckets of a row lie side by side
        for e in range(starts[first], starts[first + c1 - c0 + 1]):
            s = ids[e]
            ax, ay = segments[s, 0], segments[s, 1]
            sx, sy = segments[s, 2] - ax, segments[s, 3] - ay
            square = sx * sx + sy * sy
            across = (x - ax) * sy - (y - ay) * sx
            if across * across > radius * radius * square or square == 0.0:
                continue
            if abs(sx * dx + sy * dy) < min_cos * math.sqrt(square):
                continue
            t = min(max(((x - ax) * sx + (y - ay) * sy) / square, 0.0), 1.0)
            ex, ey = ax + t * sx - x, ay + t * sy - y
            if ex * ex + ey * ey < radius * radius:
                return True
    return False


@kernel(forceinline=True)
def _lies_beside(
    inverse: Floats2, grid: tuple[float, float, float], column: int, row: int, right: float, bottom: float
) -> bool:
    """Return whether a bucket lies wholly beyond a side of the frame with corners (0, 0) and (right, bottom)."""
    left, beyond, above, below = 0, 0, 0, 0
    for k in range(4):
        x, y = grid[0] + (column + k % 2) * grid[2], grid[1] + (row + k // 2) * grid[2]
        w = inverse[2, 0] * x + inverse[2, 1] * y + inverse[2, 2]
        if w <= 0.0:
            return False
        u = inverse[0, 0] * x + inverse[0, 1] * y + inverse[0, 2]
        v = inverse[1, 0] * x + inverse[1, 1] * y + inverse[1, 2]
        left += u < 0.0
        beyond += u > right * w
        above += v > 0.0
        below += v < bottom * w
    return max(left, beyond, above, below) == 4


@kernel(writes=("forward", "backward"))
def count_residuals(
    matrix: Floats2,
    inverse: Floats2,
    bounds: Floats1,
    points: Floats2,
    directions: Floats2,
    weights: Floats1,
    radius: float,
    min_cos: float,
    step: float,
    roads: RoadBuckets,
    field: Singles2,
    field_scale: float,
    observed: Bools2,
    piece_px: float,
    columns: int,
    forward: Floats2,
    backward: Floats2,
) -> None:
    """Fill histograms of the distances from the query's roads to the map's roads, and from the map's to the query's.

    Each piece of the frame has a histogram of its own.

    Parameters
    ----------
    matrix, inverse : (3, 3) float64
        Query plane to reference plane, and back.
    bounds : (4,) float64
        x0, y0, x1, y1 of the footprint: only buckets that meet it are looked at.
    points, directions, weights : (S, 2), (S, 2), (S,) float64
        Road points of the query, unit vectors along the road, and the weight of each.
    radius, min_cos
        As in `nearest_road`: metres.
    step : float
        Distance between samples along the map's roads, metres.
    field : (h, w) float32
        Distance from each cell of the frame to the nearest road of the query, in cells of `field_scale` pixels; rows
        run downwards.
    observed : (h, w) bool
        Where the query saw the ground.
    piece_px, columns : float, int
        Width of the frame's pieces, and how many of them are side by side.
    forward, backward : (P, B + 1) float64
        P pieces, row by row; B bins of equal width up to `radius`, and a last bin for roads without a road nearer than
        that. `forward` counts weights, `backward` pixels of road.
    """
    segments, starts, ids, grid, shape = roads
    n = forward.shape[1] - 1
    last_row = forward.shape[0] // columns - 1
    forward[:] = 0.0
    backward[:] = 0.0
    for i in range(points.shape[0]):
        ahead, x, y, dx, dy = _carry(matrix, points[i, 0], points[i, 1], directions[i, 0], directions[i, 1])
        away = np.inf
        if ahead:
            away = nearest_road(x, y, dx, dy, radius, min_cos, segments, starts, ids, grid, shape)[0]
        row, column = 0, 0
        if abs(points[i, 0]) + abs(points[i, 1]) < 1e15:  # infinite or NaN: no piece has such a number
            row = min(max(int(-points[i, 1] / piece_px), 0), last_row)
            column = min(max(int(points[i, 0] / piece_px), 0), columns - 1)
        forward[row * columns + column, min(int(n * away / radius), n) if away < radius else n] += weights[i]
    right, bottom = field.shape[1] * field_scale, -field.shape[0] * field_scale
    c0 = max(int(np.floor((bounds[0] - grid[0]) / grid[2])), 0)
    c1 = min(int(np.floor((bounds[2] - grid[0]) / grid[2])), shape[0] - 1)
    r0 = max(int(np.floor((bounds[1] - grid[1]) / grid[2])), 0)
    r1 = min(int(np.floor((bounds[3] - grid[1]) / grid[2])), shape[1] - 1)
    det = (
        inverse[0, 0] * (inverse[1, 1] * inverse[2, 2] - inverse[1, 2] * inverse[2, 1])
        - inverse[0, 1] * (inverse[1, 0] * inverse[2, 2] - inverse[1, 2] * inverse[2, 0])
        + inverse[0, 2] * (inverse[1, 0] * inverse[2, 1] - inverse[1, 1] * inverse[2, 0])
    )
    root_det, per_cell, per_piece, per_bin = math.sqrt(abs(det)), 1.0 / field_scale, field_scale / piece_px, n / radius
    for r in range(r0, r1 + 1):
        for c in range(c0, c1 + 1):
            bucket = r * shape[0] + c
            if starts[bucket] == starts[bucket + 1] or _lies_beside(inverse, grid, c, r, right, bottom):
                continue
            left, below = grid[0] + c * grid[2], grid[1] + r * grid[2]
            beyond, above = grid[0] + (c + 1) * grid[2], grid[1] + (r + 1) * grid[2]
            for e in range(starts[bucket], starts[bucket + 1]):
                s = ids[e]
                ax, ay = segments[s, 0], segments[s, 1]
                sx, sy = segments[s, 2] - ax, segments[s, 3] - ay
                length = math.sqrt(sx * sx + sy * sy)
                count = int(length / step + ((s * 0.6180339887) % 1.0))
                for k in range(count):
                    t = (k + 0.5) / count
                    x, y = ax + t * sx, ay + t * sy
                    # A segment may be listed in several buckets: each sample counts in its own.
                    if x < left or x >= beyond or y < below or y >= above:
                        continue
                    w = inverse[2, 0] * x + inverse[2, 1] * y + inverse[2, 2]
                    if w <= 0.0:
                        continue
                    nearer = 1.0 / w
                    cells = nearer * per_cell
                    across = (inverse[0, 0] * x + inverse[0, 1] * y + inverse[0, 2]) * cells
                    down = -(inverse[1, 0] * x + inverse[1, 1] * y + inverse[1, 2]) * cells
                    if not (0.0 <= across < field.shape[1] and 0.0 <= down < field.shape[0]):
                        continue
                    if not observed[int(down), int(across)]:
                        continue
                    scale = root_det * nearer * math.sqrt(nearer)  # pixels per metre
                    away = max(field[int(down), int(across)] - 0.5, 0.0) * field_scale / scale
                    row, column = min(int(down * per_piece), last_row), min(int(across * per_piece), columns - 1)
                    bin_ = min(int(per_bin * away), n) if away < radius else n
                    backward[row * columns + column, bin_] += length / count * scale


@kernel(writes=("shares",))
def screen(
    references: Ints1,
    affines: Floats2,
    anchor_xy: Floats1,
    ref_xy: Floats2,
    points: Floats2,
    directions: Floats2,
    radius: float,
    radius_px: float,
    min_cos: float,
    least: float,
    roads: RoadBuckets,
    shares: Floats1,
) -> None:
    """Find the share of the query's road points around an anchor that lie on roads of the map, for each proposal.

    Parameters
    ----------
    references : (M,) int64
        The map intersection that each proposal puts the anchor on.
    affines : (M, 4) float64
        The 2 x 2 map, row-major, from query to reference around the anchor; not mirrored.
    anchor_xy : (2,) float64
        The anchor in the query plane.
    points, directions : (S, 2) float64
        Road points near it, and unit vectors along the road.
    radius, radius_px : float
        Roads count within `radius` metres and this number of pixels more.
    min_cos
        As in `nearest_road`.
    least : float
        A proposal is given up, with share 0, once it cannot reach this share.
    shares : (M,) float64
        Filled; 1 without points, for then no point contradicts a proposal.
    """
    n = points.shape[0]
    for m in range(references.shape[0]):
        x0, y0 = ref_xy[references[m], 0], ref_xy[references[m], 1]
        j00, j01, j10, j11 = affines[m, 0], affines[m, 1], affines[m, 2], affines[m, 3]
        reach = radius + radius_px * math.sqrt(j00 * j11 - j01 * j10)
        hits, misses = 0, 0
        for i in range(n):
            u, v = points[i, 0] - anchor_xy[0], points[i, 1] - anchor_xy[1]
            dx = j00 * directions[i, 0] + j01 * directions[i, 1]
            dy = j10 * directions[i, 0] + j11 * directions[i, 1]
            length = math.sqrt(dx * dx + dy * dy)
            x, y = x0 + j00 * u + j01 * v, y0 + j10 * u + j11 * v
            if meets_road(x, y, dx / length, dy / length, reach, min_cos, roads):
                hits += 1
            else:
                misses += 1
                if misses > (1.0 - least) * n:
                    break
        shares[m] = 0.0 if misses > (1.0 - least) * n else hits / n if n > 0 else 1.0
