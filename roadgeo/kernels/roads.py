"""Roads as short straight segments in buckets: the nearest one to a point, and how well two networks cover each other.

`segments` (S, 4) are x1, y1, x2, y2; bucket `c` lists the ids `ids[starts[c]:starts[c + 1]]` of all segments that touch it.
`grid` = (x0, y0, cell size), `shape` = (columns, rows), as in `kernels.buckets`.
"""

import math

import numpy as np
from numba import njit


@njit(cache=True)
def bin_segments(segments, grid, shape, starts, ids):
    """Count the buckets of every segment (empty `ids`), or write the ids; `starts` as in `kernels.triples.fill_table`.

    A segment is listed in every bucket of its bounding box that it crosses or comes near: segments are short, and a few
    entries too many cost less than an exact clip.
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
                    if abs(mx * (y2 - y1) - my * (x2 - x1)) > 0.7072 * grid[2] * length:
                        continue
                bucket = r * shape[0] + c
                if write:
                    ids[starts[bucket]] = s
                    starts[bucket] += 1
                else:
                    starts[bucket + 1] += 1
                total += 1
    return total


@njit(cache=True)
def nearest_road(x, y, dx, dy, radius, min_cos, segments, starts, ids, grid, shape):
    """Return (distance, foot x, foot y, direction x, direction y) of the nearest road within `radius`.

    Only roads whose direction agrees with the unit vector (dx, dy) count: |cos| >= `min_cos`. Nothing found: distance = inf.
    """
    best = radius * radius
    fx, fy, ux, uy = 0.0, 0.0, 0.0, 0.0
    found = False
    c0 = max(int(np.floor((x - radius - grid[0]) / grid[2])), 0)
    c1 = min(int(np.floor((x + radius - grid[0]) / grid[2])), shape[0] - 1)
    r0 = max(int(np.floor((y - radius - grid[1]) / grid[2])), 0)
    r1 = min(int(np.floor((y + radius - grid[1]) / grid[2])), shape[1] - 1)
    for r in range(r0, r1 + 1):
        for c in range(c0, c1 + 1):
            bucket = r * shape[0] + c
            for e in range(starts[bucket], starts[bucket + 1]):
                s = ids[e]
                ax, ay = segments[s, 0], segments[s, 1]
                sx, sy = segments[s, 2] - ax, segments[s, 3] - ay
                square = sx * sx + sy * sy
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


@njit(cache=True)
def forward_distances(matrix, points, directions, radius, min_cos, shift_x, shift_y, segments, starts, ids, grid, shape, out):
    """Fill `out` (S,) with the distance, in metres, from each query road point to the nearest road of the map alike in direction.

    The points (S, 2) and unit directions (S, 2) of the query plane are mapped by `matrix`, then shifted. inf: no road within
    `radius`. Returns the number of finite distances.
    """
    n = 0
    for i in range(points.shape[0]):
        u, v = points[i, 0], points[i, 1]
        w = matrix[2, 0] * u + matrix[2, 1] * v + matrix[2, 2]
        out[i] = np.inf
        if w <= 0.0:
            continue
        x = (matrix[0, 0] * u + matrix[0, 1] * v + matrix[0, 2]) / w
        y = (matrix[1, 0] * u + matrix[1, 1] * v + matrix[1, 2]) / w
        du, dv = directions[i, 0], directions[i, 1]
        dw = matrix[2, 0] * du + matrix[2, 1] * dv
        dx = matrix[0, 0] * du + matrix[0, 1] * dv - x * dw
        dy = matrix[1, 0] * du + matrix[1, 1] * dv - y * dw
        length = math.sqrt(dx * dx + dy * dy)
        if length == 0.0:
            continue
        d = nearest_road(
            x + shift_x, y + shift_y, dx / length, dy / length, radius, min_cos, segments, starts, ids, grid, shape
        )[0]
        out[i] = d
        if d < np.inf:
            n += 1
    return n


@njit(cache=True)
def backward_agreement(inverse, bounds, step, tolerance_m, shift_x, shift_y, segments, starts, ids, grid, shape, field, field_scale, observed):
    """Count the map's roads inside the footprint: return (samples on observed ground, samples near a query road).

    The map is sampled every `step` metres along its segments within `bounds` (x0, y0, x1, y1), shifted by minus the shift and
    taken to the query plane by `inverse`. `field` is the distance to the nearest query road in field cells, one cell being `field_scale` pixels;
    `observed` (same shape) tells where the query saw the ground. `tolerance_m` is turned into pixels by the local scale.
    """
    n_seen, n_near = 0, 0
    c0 = max(int(np.floor((bounds[0] + shift_x - grid[0]) / grid[2])), 0)
    c1 = min(int(np.floor((bounds[2] + shift_x - grid[0]) / grid[2])), shape[0] - 1)
    r0 = max(int(np.floor((bounds[1] + shift_y - grid[1]) / grid[2])), 0)
    r1 = min(int(np.floor((bounds[3] + shift_y - grid[1]) / grid[2])), shape[1] - 1)
    det = (
        inverse[0, 0] * (inverse[1, 1] * inverse[2, 2] - inverse[1, 2] * inverse[2, 1])
        - inverse[0, 1] * (inverse[1, 0] * inverse[2, 2] - inverse[1, 2] * inverse[2, 0])
        + inverse[0, 2] * (inverse[1, 0] * inverse[2, 1] - inverse[1, 1] * inverse[2, 0])
    )
    for r in range(r0, r1 + 1):
        for c in range(c0, c1 + 1):
            bucket = r * shape[0] + c
            for e in range(starts[bucket], starts[bucket + 1]):
                s = ids[e]
                ax, ay = segments[s, 0], segments[s, 1]
                sx, sy = segments[s, 2] - ax, segments[s, 3] - ay
                length = math.sqrt(sx * sx + sy * sy)
                # An even phase over all segments, so that short ones are sampled in proportion to their length.
                count = int(length / step + ((s * 0.6180339887) % 1.0))
                for k in range(count):
                    t = (k + 0.5) / count
                    x, y = ax + t * sx, ay + t * sy
                    if int(np.floor((x - grid[0]) / grid[2])) != c or int(np.floor((y - grid[1]) / grid[2])) != r:
                        continue
                    x -= shift_x
                    y -= shift_y
                    w = inverse[2, 0] * x + inverse[2, 1] * y + inverse[2, 2]
                    if w <= 0.0:
                        continue
                    u = (inverse[0, 0] * x + inverse[0, 1] * y + inverse[0, 2]) / w
                    v = -(inverse[1, 0] * x + inverse[1, 1] * y + inverse[1, 2]) / w
                    column, row = int(np.floor(u / field_scale)), int(np.floor(v / field_scale))
                    if u < 0.0 or v < 0.0 or column >= field.shape[1] or row >= field.shape[0]:
                        continue
                    if not observed[row, column]:
                        continue
                    n_seen += 1
                    scale = math.sqrt(abs(det) / (w * w * w))  # pixels per metre
                    if field[row, column] * field_scale <= tolerance_m * scale + 0.7 * field_scale:
                        n_near += 1
    return n_seen, n_near


@njit(cache=True)
def screen(
    references, affines, anchor_xy, ref_xy, points, directions, radius, min_cos, least,
    segments, starts, ids, grid, shape, shares,
):  # fmt: skip
    """Fill `shares` (M,) with the part of the query's road points that lie on roads of the map under each proposal.

    A proposal puts `anchor_xy` on intersection `references[m]`, with the 2 x 2 map `affines[m]` around it; the points are those
    near the anchor. A proposal is given up, with share 0, once it cannot reach the share `least`.
    """
    n = points.shape[0]
    for m in range(references.shape[0]):
        x0, y0 = ref_xy[references[m], 0], ref_xy[references[m], 1]
        j00, j01, j10, j11 = affines[m, 0], affines[m, 1], affines[m, 2], affines[m, 3]
        hits, misses = 0, 0
        for i in range(n):
            u, v = points[i, 0] - anchor_xy[0], points[i, 1] - anchor_xy[1]
            dx = j00 * directions[i, 0] + j01 * directions[i, 1]
            dy = j10 * directions[i, 0] + j11 * directions[i, 1]
            length = math.sqrt(dx * dx + dy * dy)
            d = nearest_road(
                x0 + j00 * u + j01 * v, y0 + j10 * u + j11 * v, dx / length, dy / length, radius, min_cos,
                segments, starts, ids, grid, shape,
            )[0]  # fmt: skip
            if d < np.inf:
                hits += 1
            else:
                misses += 1
                if misses > (1.0 - least) * n:
                    break
        shares[m] = hits / n if misses <= (1.0 - least) * n else 0.0
