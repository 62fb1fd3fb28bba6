"""Kernels of `roadgeo.roads.intersections`: lines fitted to branches, centres and tangents of intersections."""

import numpy as np
from numpy.typing import NDArray

from roadgeo.kernels.arrays import Floats1, Floats2, Int32s2, Ints1, Singles1, Singles2
from roadgeo.kernels.compilation import kernel

__all__ = ["describe_intersections", "fit_branches", "sort_few"]


@kernel()
def _line_of(mx: float, my: float, sxx: float, sxy: float, syy: float) -> tuple[float, float]:
    """Return the direction of the line fitted to means and mean squares, and the mean square distance from it."""
    cxx = sxx - mx * mx
    cyy = syy - my * my
    cxy = sxy - mx * my
    angle = 0.5 * np.arctan2(2 * cxy, cxx - cyy)
    spread = 0.5 * (cxx + cyy) - np.sqrt(0.25 * (cxx - cyy) ** 2 + cxy * cxy)
    return angle, max(spread, 0.0)


@kernel()
def fit_branches(
    half_edges: Ints1,
    edges: Int32s2,
    offsets: Ints1,
    coords: Floats2,
    lengths: Floats1,
    skip: float,
    reach: float,
    least: float,
) -> Floats2:
    """Fit a line to each branch by total least squares, every piece of road weighted by its length.

    Parameters
    ----------
    half_edges : (B,) int64
        2 * edge + side: side 0 leaves `edges[e, 0]`.
    edges : (E, 2) int32
    offsets : (E + 1,) int64
    coords : (C, 2) float64
    lengths : (E,) float64
    skip, reach : float
        The line is fitted between these distances along the branch, or to the whole of a shorter branch.
    least : float
        Branches shorter than this get NaN.

    Returns
    -------
    (B, 4) float64
        A point of the line x, y, the outward direction in [-pi, pi), the mean square distance from the line.
    """
    lines = np.full((len(half_edges), 4), np.nan)
    for b in range(len(half_edges)):
        e = half_edges[b] // 2
        side = half_edges[b] % 2
        length = lengths[e]
        if edges[e, 0] == edges[e, 1]:
            length *= 0.5  # a loop's two branches share it
        if length < least:
            continue
        end = min(reach, length)
        start = max(min(skip, end - least), 0.0)
        lo = offsets[e]
        n = offsets[e + 1] - lo
        # moments of the pieces of road between `start` and `end`, from the branch's first vertex
        weight = sx = sy = sxx = sxy = syy = 0.0
        first_x = first_y = last_x = last_y = 0.0
        done = 0.0
        for k in range(n - 1):
            i = lo + k if side == 0 else lo + n - 1 - k
            j = i + 1 if side == 0 else i - 1
            dx = coords[j, 0] - coords[i, 0]
            dy = coords[j, 1] - coords[i, 1]
            step = np.sqrt(dx * dx + dy * dy)
            if step > 0.0 and done + step > start:
                t0 = max((start - done) / step, 0.0)
                t1 = min((end - done) / step, 1.0)
                ax = coords[i, 0] + t0 * dx - coords[lo, 0]
                ay = coords[i, 1] + t0 * dy - coords[lo, 1]
                bx = coords[i, 0] + t1 * dx - coords[lo, 0]
                by = coords[i, 1] + t1 * dy - coords[lo, 1]
                w = (t1 - t0) * step
                if weight == 0.0:
                    first_x = ax
                    first_y = ay
                last_x = bx
                last_y = by
                weight += w
                sx += w * (ax + bx) / 2
                sy += w * (ay + by) / 2
                sxx += w * (ax * ax + ax * bx + bx * bx) / 3
                syy += w * (ay * ay + ay * by + by * by) / 3
                sxy += w * (2 * ax * ay + 2 * bx * by + ax * by + bx * ay) / 6
            done += step
            if done >= end:
                break
        if weight == 0.0:
            continue
        angle, away = _line_of(sx / weight, sy / weight, sxx / weight, sxy / weight, syy / weight)
        if np.cos(angle) * (last_x - first_x) + np.sin(angle) * (last_y - first_y) < 0:
            angle += np.pi
        if angle >= np.pi:
            angle -= 2 * np.pi
        lines[b, 0] = sx / weight + coords[lo, 0]
        lines[b, 1] = sy / weight + coords[lo, 1]
        lines[b, 2] = angle
        lines[b, 3] = away
    return lines


@kernel()
def sort_few(values: NDArray[np.floating], n: int) -> None:
    """Sort the first n values in place, by insertion: a general sort would cost two seconds to compile."""
    for i in range(1, n):
        value = values[i]
        k = i
        while k > 0 and values[k - 1] > value:
            values[k] = values[k - 1]
            k -= 1
        values[k] = value


@kernel()
def _merge_tangents(angle: NDArray[np.float64], count: int, merge_angle: float, tangents: NDArray[np.float32]) -> None:
    """Merge angles of nearly the same line into a tangent (eq. 2-3).

    `angle[:count]` is ascending, in [0, pi); `count` is 1 or more.
    """
    first = 0  # start after the widest gap, so that no line is cut in two at 0 = pi
    widest = angle[0] + np.pi - angle[count - 1]
    for k in range(1, count):
        if angle[k] - angle[k - 1] > widest:
            widest = angle[k] - angle[k - 1]
            first = k
    n_lines = 0
    total = 0.0
    members = 0
    for k in range(count):
        i = first + k
        value = angle[i] if i < count else angle[i - count] + np.pi
        if members > 0 and value - total / members >= merge_angle:
            tangents[n_lines] = (total / members) % np.pi
            n_lines += 1
            total = 0.0
            members = 0
        total += value
        members += 1
    tangents[n_lines] = (total / members) % np.pi
    n_lines += 1
    sort_few(tangents, n_lines)


@kernel(writes=("xy", "rays", "tangents", "residual"))
def describe_intersections(
    node_xy: Floats2,
    starts: Ints1,
    lines: Floats2,
    merge_angle: float,
    stiffness: float,
    max_shift: float,
    xy: Floats2,
    rays: Singles2,
    tangents: Singles2,
    residual: Singles1,
) -> None:
    """Refine each centre by its branch lines (eq. 1) and merge tangents of nearly the same line (eq. 2-3).

    Parameters
    ----------
    node_xy : (N, 2) float64
    starts : (N + 1,) int64
        Node n owns `lines[starts[n]:starts[n + 1]]`.
    lines : (B, 4) float64
        As `fit_branches` returns them.
    merge_angle : float
        Radians.
    stiffness : float
        Weight of the node relative to a line: it decides where the lines do not.
    max_shift : float
        Centres move no further than this from their node.
    xy, rays, tangents, residual
        Written: (N, 2) float64, (N, R) float32 filled with NaN, the same, (N,) float32.
    """
    most = rays.shape[1]
    angle = np.empty(most)
    for n in range(len(node_xy)):
        count = 0
        a11 = a22 = stiffness
        a12 = b1 = b2 = square = 0.0
        for b in range(starts[n], starts[n + 1]):
            if np.isnan(lines[b, 2]) or count == most:
                continue
            angle[count] = lines[b, 2]
            count += 1
            nx = -np.sin(lines[b, 2])
            ny = np.cos(lines[b, 2])
            away = nx * (lines[b, 0] - node_xy[n, 0]) + ny * (lines[b, 1] - node_xy[n, 1])
            a11 += nx * nx
            a12 += nx * ny
            a22 += ny * ny
            b1 += nx * away
            b2 += ny * away
            square += lines[b, 3]
        # the point nearest to all lines, not too far from the node
        det = a11 * a22 - a12 * a12
        dx = (a22 * b1 - a12 * b2) / det
        dy = (a11 * b2 - a12 * b1) / det
        shift = np.sqrt(dx * dx + dy * dy)
        if shift > max_shift:
            dx *= max_shift / shift
            dy *= max_shift / shift
        xy[n, 0] = node_xy[n, 0] + dx
        xy[n, 1] = node_xy[n, 1] + dy
        residual[n] = np.sqrt(square / max(count, 1))
        if count == 0:
            continue

        sort_few(angle, count)
        for k in range(count):
            rays[n, k] = angle[k]
        for k in range(count):
            angle[k] = angle[k] % np.pi
        sort_few(angle, count)
        _merge_tangents(angle, count, merge_angle, tangents[n])
