"""Kernels of `roadgeo.roads.simplification`: polylines walked end to end, and points drawn together.

Edges are `edges` (E, 2), their nodes, and polylines: edge e has the vertices `coords[offsets[e]:offsets[e + 1]]`. A
*half-edge* is 2 * edge + side: side 0 leaves `edges[e, 0]`, side 1 leaves `edges[e, 1]`. Rows of arrays are copied
element by element here: the first assignment of a whole row costs numba two seconds.
"""

import numpy as np

from roadgeo.kernels.arrays import Floats1, Floats2, Int32s2, Ints1, Ints2
from roadgeo.kernels.compilation import kernel

__all__ = ["close_pairs", "draw_together", "find_cuts", "join_chains", "measure_edges"]


@kernel()
def join_chains(n_nodes: int, edges: Int32s2, offsets: Ints1, coords: Floats2) -> tuple[Int32s2, Floats2, Ints1]:
    """Join every chain of edges whose inner nodes have degree two into an edge; nodes keep their numbers.

    A ring without other nodes becomes a loop at an arbitrary node of it. Returns edges, coords and offsets.
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


@kernel()
def measure_edges(offsets: Ints1, coords: Floats2) -> Floats1:
    """Return the (E,) lengths of edges."""
    lengths = np.zeros(len(offsets) - 1)
    for e in range(len(lengths)):
        for c in range(offsets[e], offsets[e + 1] - 1):
            dx = coords[c + 1, 0] - coords[c, 0]
            dy = coords[c + 1, 1] - coords[c, 1]
            lengths[e] += np.sqrt(dx * dx + dy * dy)
    return lengths


@kernel()
def close_pairs(xy: Floats2, by_x: Ints1, radius: float) -> Ints2:
    """Find all pairs (P, 2) of points (N, 2) nearer than `radius`, by a sweep along x, in their order `by_x` (N,)."""
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
                    for k in range(size):
                        grown[k, 0], grown[k, 1] = pairs[k, 0], pairs[k, 1]
                    pairs = grown
                pairs[size, 0] = i
                pairs[size, 1] = j
                size += 1
    return pairs[:size].copy()


@kernel()
def draw_together(xy: Floats2, pairs: Ints2, radius: Floats1) -> tuple[Ints1, Floats2]:
    """Merge pairs of points, in the order given, while the centres of their clusters are nearer than `radius`.

    Comparing centres keeps a row of points from becoming one long cluster. Pairs (P, 2) and their radii (P,) come with
    the nearest first. Returns the number (N,) of each point's cluster, its lowest point, and the mean (N, 2) of that.
    """
    n = len(xy)
    parent = np.arange(n)
    count = np.ones(n)
    total = xy.copy()
    # union-find over points; each root keeps the number and the sum of its points
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
    # each point's root, and the mean there
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


@kernel()
def find_cuts(offsets: Ints1, coords: Floats2, cuts: Floats1, cut_starts: Ints1) -> tuple[Floats2, Ints1]:
    """Find where edges are cut at given arc lengths.

    Parameters
    ----------
    cuts : (K,) float64
        Arc lengths, ascending within each edge, inside it: edge e is cut at `cuts[cut_starts[e]:cut_starts[e + 1]]`.

    Returns
    -------
    places : (K, 2) float64
    at : (K,) int64
        The vertex that each cut comes before.
    """
    places = np.empty((len(cuts), 2))
    at = np.empty(len(cuts), np.int64)
    for e in range(len(offsets) - 1):
        k = cut_starts[e]
        done = 0.0
        for c in range(offsets[e] + 1, offsets[e + 1]):
            dx = coords[c, 0] - coords[c - 1, 0]
            dy = coords[c, 1] - coords[c - 1, 1]
            step = np.sqrt(dx * dx + dy * dy)
            while k < cut_starts[e + 1] and cuts[k] <= done + step:
                t = (cuts[k] - done) / step if step > 0.0 else 0.0
                places[k, 0] = coords[c - 1, 0] + t * dx
                places[k, 1] = coords[c - 1, 1] + t * dy
                at[k] = c
                k += 1
            done += step
    return places, at
