"""Kernels of `roadgeo.roads.simplification`: roads that run beside each other, such as the two ways of a motorway.

Edges have the layout of `kernels.simplification`; `lengths` (E,) are their lengths.
"""

import numpy as np
from numpy.typing import NDArray

from roadgeo.kernels.arrays import Floats1, Floats2, Int32s1, Int32s2, Ints1
from roadgeo.kernels.compilation import kernel

__all__ = ["find_mates", "find_twins", "roads_alongside", "sample_edges", "tie_runs"]


@kernel()
def _point_at(coords: NDArray[np.float64], lo: int, hi: int, along: float) -> tuple[float, float]:
    """Return the point at arc length `along` of a polyline."""
    done = 0.0
    for c in range(lo, hi - 1):
        dx = coords[c + 1, 0] - coords[c, 0]
        dy = coords[c + 1, 1] - coords[c, 1]
        step = np.sqrt(dx * dx + dy * dy)
        if done + step >= along and step > 0.0:
            t = (along - done) / step
            return coords[c, 0] + t * dx, coords[c, 1] + t * dy
        done += step
    return coords[hi - 1, 0], coords[hi - 1, 1]


@kernel()
def find_twins(
    edges: Int32s2, offsets: Ints1, coords: Floats2, lengths: Floats1, by_ends: Ints1, distance: float
) -> Ints1:
    """Find edges that run beside each other between the same two nodes: (E,) the first of each edge's twins, or itself.

    Twins are everywhere nearer to each other than `distance`, compared at equal shares of their lengths.

    Parameters
    ----------
    edges : (E, 2) int32
        With `edges[e, 0] <= edges[e, 1]`.
    by_ends : (E,) int64
        Order of the edges by their two ends.
    """
    n_edges = len(edges)
    first = np.arange(n_edges)
    for a in range(n_edges):
        e = by_ends[a]
        if first[e] != e or edges[e, 0] == edges[e, 1]:
            continue
        for b in range(a + 1, n_edges):
            f = by_ends[b]
            if edges[f, 0] != edges[e, 0] or edges[f, 1] != edges[e, 1]:
                break
            if first[f] != f:
                continue
            near = True
            for k in range(1, 12):
                x, y = _point_at(coords, offsets[e], offsets[e + 1], lengths[e] * k / 12)
                u, v = _point_at(coords, offsets[f], offsets[f + 1], lengths[f] * k / 12)
                if (x - u) ** 2 + (y - v) ** 2 > distance * distance:
                    near = False
                    break
            if near:
                first[f] = e
    return first


@kernel(writes=("xy", "direction"))
def sample_edges(
    offsets: Ints1, coords: Floats2, lengths: Floats1, starts: Ints1, xy: Floats2, direction: Floats2
) -> None:
    """Write points `xy` (S, 2) evenly spaced along every edge, both ends included, and unit vectors along the road.

    Edge e gets the samples `starts[e]` to `starts[e + 1]`, two or more.
    """
    for e in range(len(lengths)):
        n = starts[e + 1] - starts[e]
        c = offsets[e]
        done = 0.0
        for k in range(n):
            along = lengths[e] * k / (n - 1)
            while True:
                dx = coords[c + 1, 0] - coords[c, 0]
                dy = coords[c + 1, 1] - coords[c, 1]
                step = np.sqrt(dx * dx + dy * dy)
                if (done + step >= along and step > 0.0) or c + 2 >= offsets[e + 1]:
                    break
                done += step
                c += 1
            i = starts[e] + k
            t = min((along - done) / step, 1.0) if step > 0.0 else 0.0
            xy[i, 0] = coords[c, 0] + t * dx
            xy[i, 1] = coords[c, 1] + t * dy
            direction[i, 0] = dx / step if step > 0.0 else 1.0
            direction[i, 1] = dy / step if step > 0.0 else 0.0


@kernel()
def find_mates(
    xy: Floats2,
    direction: Floats2,
    edge: Int32s1,
    edges: Int32s2,
    starts: Ints1,
    order: Ints1,
    key: Ints1,
    n_columns: int,
    distance: float,
    min_cos: float,
) -> tuple[Ints1, Floats1, Ints1]:
    """Find the nearest sample of another edge beside each sample, in the same or the opposite direction.

    Parameters
    ----------
    xy, direction, edge, starts
        Samples as of `sample_edges`, and the edge of each.
    order, key : (S,) int64
        Samples sorted by the cell (row * n_columns + column, with empty cells around) that they lie in, and those
        cells, ascending; cells are `distance` wide.
    min_cos : float
        Least |cosine| of the angle between the two roads.

    Returns
    -------
    mate : (S,) int64
        -1 for a sample without a mate.
    apart : (S,) float64
        Distance to the mate, `distance` for a sample without a mate.
    touch : (2 E,) int64
        The sample nearest to each end of each edge, in any direction, of edges that do not meet it there, or -1.
    """
    n = len(xy)
    x = xy[order, 0]  # neighbours side by side in memory
    y = xy[order, 1]
    east = direction[order, 0]
    north = direction[order, 1]
    owner = edge[order]
    mate = np.full(n, -1)
    apart = np.full(n, distance * distance)
    touch = np.full(2 * len(edges), -1)
    nearest = np.full(2 * len(edges), distance * distance)
    for row in range(-1, 2):
        lo = 0
        hi = 0
        for a in range(n):
            while lo < n and key[lo] < key[a] + row * n_columns - 1:
                lo += 1
            while hi < n and key[hi] <= key[a] + row * n_columns + 1:
                hi += 1
            i = order[a]
            e = owner[a]
            end = -1
            if i == starts[e]:
                end = 2 * e
            elif i == starts[e + 1] - 1:
                end = 2 * e + 1
            best = apart[i]
            for b in range(lo, hi):
                if owner[b] == e:
                    continue
                d = (x[b] - x[a]) ** 2 + (y[b] - y[a]) ** 2
                if d < best and abs(east[a] * east[b] + north[a] * north[b]) >= min_cos:
                    best = d
                    mate[i] = order[b]
                if end >= 0 and d < nearest[end]:
                    node = edges[e, end % 2]
                    if edges[owner[b], 0] != node and edges[owner[b], 1] != node:
                        nearest[end] = d
                        touch[end] = order[b]
            apart[i] = best
    return mate, np.sqrt(apart), touch


@kernel()
def tie_runs(
    starts: Ints1, lengths: Floats1, edge: Int32s1, mate: Ints1, apart: Floats1, split_distance: float, least: float
) -> Floats2:
    """Tie two edges together where they begin and where they cease to run side by side.

    Parameters
    ----------
    starts, edge, mate, apart
        Samples and their mates, as of `find_mates`.
    split_distance : float
        Two roads that part are a single road until they are this far apart.
    least : float
        Shorter runs are left alone.

    Returns
    -------
    (T, 4) float64
        Edge, arc length along it, other edge, arc length along that.
    """
    ties = np.empty((64, 4))
    size = 0
    for e in range(len(lengths)):
        step = lengths[e] / (starts[e + 1] - starts[e] - 1)
        i = starts[e]
        while i < starts[e + 1]:
            if mate[i] < 0:
                i += 1
                continue
            f = edge[mate[i]]
            j = i
            while j + 1 < starts[e + 1] and mate[j + 1] >= 0 and edge[mate[j + 1]] == f:
                j += 1
            first = i
            last = j
            i = j + 1
            if first > starts[e] and mate[first - 1] < 0:  # the roads draw near here
                while first < last and apart[first] > split_distance and apart[first + 1] < apart[first]:
                    first += 1
            if last + 1 < starts[e + 1] and mate[last + 1] < 0:  # they part here
                while last > first and apart[last] > split_distance and apart[last - 1] < apart[last]:
                    last -= 1
            if (last - first) * step < least:
                continue
            if size + 2 > len(ties):
                grown = np.empty((2 * size, 4))
                for k in range(size):
                    for column in range(4):
                        grown[k, column] = ties[k, column]
                ties = grown
            other = lengths[f] / (starts[f + 1] - starts[f] - 1)
            for k in (first, last):
                ties[size, 0] = e
                ties[size, 1] = (k - starts[e]) * step
                ties[size, 2] = f
                ties[size, 3] = (mate[k] - starts[f]) * other
                size += 1
    return ties[:size].copy()


@kernel(writes=("out",))
def roads_alongside(
    xy: Floats2, along: Floats2, reach: Floats1, least: float, most: float, min_cos: float, out: Floats2
) -> None:
    """Find the vector from each road point across to the nearest road in its direction.

    Parameters
    ----------
    xy, along : (S, 2) float64
        Points on roads, and unit vectors along the road.
    reach : (S,) float64
        Two points lie beside each other if neither is further ahead or behind than the larger of their two reaches.
    least, most : float
        Only roads between these distances count.
    min_cos : float
        Least |cosine| of the angle between the two roads.
    out : (S, 2) float64
        Filled: the vector across to the other road, at right angles to the mean of their directions; NaN without one.
    """
    for i in range(len(xy)):
        nearest = most
        out[i, 0] = out[i, 1] = np.nan
        for j in range(len(xy)):
            dx = xy[j, 0] - xy[i, 0]
            dy = xy[j, 1] - xy[i, 1]
            ahead = max(reach[i], reach[j])
            cos = along[i, 0] * along[j, 0] + along[i, 1] * along[j, 1]
            if dx * dx + dy * dy > most * most + ahead * ahead or abs(cos) < min_cos or i == j:
                continue
            side = 1.0 if cos > 0.0 else -1.0
            length = np.sqrt(2.0 + 2.0 * abs(cos))
            east = (along[i, 0] + side * along[j, 0]) / length
            north = (along[i, 1] + side * along[j, 1]) / length
            across = dy * east - dx * north
            if least < abs(across) < nearest and abs(dx * east + dy * north) <= ahead:
                nearest = abs(across)
                out[i, 0] = -across * north
                out[i, 1] = across * east
