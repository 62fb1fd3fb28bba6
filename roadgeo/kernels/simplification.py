"""Kernels of `roadgeo.simplification`: polylines walked end to end, and points drawn together.

A *half-edge* is 2 * edge + side: side 0 leaves `edges[e, 0]`, side 1 leaves `edges[e, 1]`.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["close_pairs", "draw_together", "join_chains", "parallel_twins", "reattach"]


@njit(cache=True)
def join_chains(
    n_nodes: int, edges: NDArray[np.int32], offsets: NDArray[np.int64], coords: NDArray[np.float64]
) -> tuple[NDArray[np.int32], NDArray[np.float64], NDArray[np.int64]]:
    """Make one edge of every chain of edges whose inner nodes have degree two.

    Rings without any other node stay as one loop at an arbitrary node of theirs.

    Parameters
    ----------
    n_nodes : int
    edges : (E, 2) int32
    offsets : (E + 1,) int64
    coords : (C, 2) float64

    Returns
    -------
    edges, coords, offsets
        The same layout; nodes keep their numbers.
    """
    n_edges = len(edges)
    degree = np.zeros(n_nodes, np.int64)
    ends = np.full((n_nodes, 2), -1, np.int64)  # half-edges leaving a node of degree two
    for e in range(n_edges):
        for side in range(2):
            n = edges[e, side]
            if degree[n] < 2:
                ends[n, degree[n]] = 2 * e + side
            degree[n] += 1
    through = np.zeros(n_nodes, np.bool_)
    for n in range(n_nodes):
        through[n] = degree[n] == 2 and ends[n, 0] // 2 != ends[n, 1] // 2

    out_edges = np.empty((n_edges, 2), np.int32)
    out_offsets = np.zeros(n_edges + 1, np.int64)
    out_coords = np.empty_like(coords)
    seen = np.zeros(n_edges, np.bool_)
    n_out = 0
    size = 0
    for phase in range(2):  # chains between other nodes first, then the rings that are left
        for start in range(2 * n_edges):
            if seen[start // 2] or (phase == 0 and through[edges[start // 2, start % 2]]):
                continue
            first = edges[start // 2, start % 2]
            half = start
            while True:
                e = half // 2
                side = half % 2
                seen[e] = True
                lo = offsets[e]
                hi = offsets[e + 1]
                skip = 1 if half != start else 0  # the joint is already there
                for k in range(skip, hi - lo):
                    c = lo + k if side == 0 else hi - 1 - k
                    out_coords[size, 0] = coords[c, 0]
                    out_coords[size, 1] = coords[c, 1]
                    size += 1
                last = edges[e, 1 - side]
                if not through[last]:
                    break
                back = 2 * e + 1 - side
                half = ends[last, 1] if ends[last, 0] == back else ends[last, 0]
                if seen[half // 2]:
                    break
            out_edges[n_out, 0] = first
            out_edges[n_out, 1] = last
            n_out += 1
            out_offsets[n_out] = size
    return out_edges[:n_out].copy(), out_coords[:size].copy(), out_offsets[: n_out + 1].copy()


@njit(cache=True)
def close_pairs(xy: NDArray[np.float64], by_x: NDArray[np.int64], radius: float) -> NDArray[np.int64]:
    """Find all pairs of points nearer than `radius`, by a sweep along x.

    Parameters
    ----------
    xy : (N, 2) float64
    by_x : (N,) int64
        Order of the points along x.
    radius : float

    Returns
    -------
    (P, 2) int64
    """
    n = len(xy)
    pairs = np.empty((max(n, 16), 2), np.int64)
    size = 0
    for a in range(n):
        i = by_x[a]
        for b in range(a + 1, n):
            j = by_x[b]
            dx = xy[j, 0] - xy[i, 0]
            if dx >= radius:
                break
            dy = xy[j, 1] - xy[i, 1]
            if dx * dx + dy * dy < radius * radius:
                if size == len(pairs):
                    grown = np.empty((2 * size, 2), np.int64)
                    grown[:size] = pairs
                    pairs = grown
                pairs[size, 0] = i
                pairs[size, 1] = j
                size += 1
    return pairs[:size].copy()


@njit(cache=True)
def draw_together(
    xy: NDArray[np.float64], pairs: NDArray[np.int64], radius: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Merge pairs of points, in the order given, while the centres of their clusters are nearer than `radius`.

    Comparing centres keeps a row of points from becoming one long cluster.

    Parameters
    ----------
    xy : (N, 2) float64
    pairs : (P, 2) int64
        Nearest first.
    radius : (P,) float64

    Returns
    -------
    cluster : (N,) int64
        Number of each point's cluster, its lowest point.
    centre : (N, 2) float64
        Mean of each point's cluster.
    """
    n = len(xy)
    parent = np.arange(n)
    count = np.ones(n)
    total = xy.copy()
    for p in range(len(pairs)):
        a = pairs[p, 0]
        b = pairs[p, 1]
        while parent[a] != a:
            parent[a] = parent[parent[a]]
            a = parent[a]
        while parent[b] != b:
            parent[b] = parent[parent[b]]
            b = parent[b]
        if a == b:
            continue
        dx = total[a, 0] / count[a] - total[b, 0] / count[b]
        dy = total[a, 1] / count[a] - total[b, 1] / count[b]
        if dx * dx + dy * dy < radius[p] * radius[p]:
            if b < a:
                a, b = b, a
            parent[b] = a
            count[a] += count[b]
            total[a, 0] += total[b, 0]
            total[a, 1] += total[b, 1]
    cluster = np.empty(n, np.int64)
    centre = np.empty((n, 2))
    for i in range(n):
        a = i
        while parent[a] != a:
            a = parent[a]
        cluster[i] = a
        centre[i, 0] = total[a, 0] / count[a]
        centre[i, 1] = total[a, 1] / count[a]
    return cluster, centre


@njit(cache=True)
def reattach(
    centre: NDArray[np.float64], ends: NDArray[np.int32], offsets: NDArray[np.int64], coords: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Run every edge from the new place of one end node to that of the other, through all its old vertices.

    Parameters
    ----------
    centre : (N, 2) float64
        New place of each node.
    ends : (E, 2) int32
        Node at each end.
    offsets : (E + 1,) int64
    coords : (C, 2) float64

    Returns
    -------
    coords, offsets
    """
    n_edges = len(ends)
    out_offsets = np.zeros(n_edges + 1, np.int64)
    out = np.empty((len(coords) + 2 * n_edges, 2))
    size = 0
    for e in range(n_edges):
        lo = offsets[e]
        hi = offsets[e + 1]
        a = centre[ends[e, 0]]
        b = centre[ends[e, 1]]
        if a[0] != coords[lo, 0] or a[1] != coords[lo, 1]:
            out[size, 0] = a[0]
            out[size, 1] = a[1]
            size += 1
        for c in range(lo, hi):
            out[size, 0] = coords[c, 0]
            out[size, 1] = coords[c, 1]
            size += 1
        if b[0] != coords[hi - 1, 0] or b[1] != coords[hi - 1, 1]:
            out[size, 0] = b[0]
            out[size, 1] = b[1]
            size += 1
        out_offsets[e + 1] = size
    return out[:size].copy(), out_offsets


@njit(cache=True)
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


@njit(cache=True)
def parallel_twins(
    edges: NDArray[np.int32],
    offsets: NDArray[np.int64],
    coords: NDArray[np.float64],
    lengths: NDArray[np.float64],
    by_ends: NDArray[np.int64],
    distance: float,
) -> NDArray[np.int64]:
    """Find edges that run beside another one between the same two nodes.

    Parameters
    ----------
    edges : (E, 2) int32
        With `edges[e, 0] <= edges[e, 1]`.
    offsets : (E + 1,) int64
    coords : (C, 2) float64
    lengths : (E,) float64
    by_ends : (E,) int64
        Order of the edges by their two ends.
    distance : float
        Twins are everywhere nearer to each other than this, compared at equal shares of their lengths.

    Returns
    -------
    (E,) int64
        The edge that stands for this one: itself, or the twin that it is dropped for.
    """
    n_edges = len(edges)
    stands = np.arange(n_edges)
    for a in range(n_edges):
        e = by_ends[a]
        if stands[e] != e or edges[e, 0] == edges[e, 1]:
            continue
        for b in range(a + 1, n_edges):
            f = by_ends[b]
            if edges[f, 0] != edges[e, 0] or edges[f, 1] != edges[e, 1]:
                break
            if stands[f] != f:
                continue
            near = True
            for k in range(1, 12):
                x, y = _point_at(coords, offsets[e], offsets[e + 1], lengths[e] * k / 12)
                u, v = _point_at(coords, offsets[f], offsets[f + 1], lengths[f] * k / 12)
                if (x - u) ** 2 + (y - v) ** 2 > distance * distance:
                    near = False
                    break
            if near:
                stands[f] = e
    return stands
