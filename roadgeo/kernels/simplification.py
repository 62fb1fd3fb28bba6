"""Kernels of `roadgeo.roads.simplification`: polylines walked end to end, and points drawn together.

A *half-edge* is 2 * edge + side: side 0 leaves `edges[e, 0]`, side 1 leaves `edges[e, 1]`. Rows of arrays are copied
element by element here: the first assignment of a whole row costs numba two seconds.
"""

import numpy as np

from roadgeo.kernels.arrays import Floats1, Floats2, Int32s2, Ints1, Ints2
from roadgeo.kernels.compilation import kernel

__all__ = [
    "close_pairs",
    "cut_edges",
    "draw_together",
    "join_chains",
    "measure_edges",
    "narrow_faces",
    "reattach",
]


@kernel()
def join_chains(n_nodes: int, edges: Int32s2, offsets: Ints1, coords: Floats2) -> tuple[Int32s2, Floats2, Ints1]:
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


@kernel()
def measure_edges(offsets: Ints1, coords: Floats2) -> Floats1:
    """Return the (E,) lengths of edges; `offsets` (E + 1,), `coords` (C, 2)."""
    lengths = np.zeros(len(offsets) - 1)
    for e in range(len(lengths)):
        for c in range(offsets[e], offsets[e + 1] - 1):
            dx = coords[c + 1, 0] - coords[c, 0]
            dy = coords[c + 1, 1] - coords[c, 1]
            lengths[e] += np.sqrt(dx * dx + dy * dy)
    return lengths


@kernel()
def close_pairs(xy: Floats2, by_x: Ints1, radius: float) -> Ints2:
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
def reattach(centre: Floats2, ends: Int32s2, offsets: Ints1, coords: Floats2) -> tuple[Floats2, Ints1]:
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


@kernel()
def cut_edges(
    edges: Int32s2,
    offsets: Ints1,
    coords: Floats2,
    cuts: Floats1,
    cut_starts: Ints1,
    n_nodes: int,
) -> tuple[Floats2, Int32s2, Floats2, Ints1]:
    """Cut edges at given arc lengths; cut k becomes node `n_nodes + k`.

    Parameters
    ----------
    edges : (E, 2) int32
    offsets : (E + 1,) int64
    coords : (C, 2) float64
    cuts : (K,) float64
        Arc lengths, ascending within each edge, inside it.
    cut_starts : (E + 1,) int64
        Edge e is cut at `cuts[cut_starts[e]:cut_starts[e + 1]]`.
    n_nodes : int

    Returns
    -------
    places : (K, 2) float64
        Of the new nodes.
    edges, coords, offsets
    """
    n_edges = len(edges)
    n_cuts = len(cuts)
    places = np.empty((n_cuts, 2))
    out_edges = np.empty((n_edges + n_cuts, 2), np.int32)
    out_offsets = np.zeros(n_edges + n_cuts + 1, np.int64)
    out = np.empty((len(coords) + 2 * n_cuts, 2))
    size = 0
    n_out = 0
    for e in range(n_edges):
        k = cut_starts[e]
        done = 0.0
        node = edges[e, 0]
        for c in range(offsets[e], offsets[e + 1]):
            if c > offsets[e]:
                dx = coords[c, 0] - coords[c - 1, 0]
                dy = coords[c, 1] - coords[c - 1, 1]
                step = np.sqrt(dx * dx + dy * dy)
                # a cut ends one edge and begins the next
                while k < cut_starts[e + 1] and cuts[k] <= done + step:
                    t = (cuts[k] - done) / step if step > 0.0 else 0.0
                    places[k, 0] = coords[c - 1, 0] + t * dx
                    places[k, 1] = coords[c - 1, 1] + t * dy
                    for axis in range(2):
                        out[size, axis] = places[k, axis]
                        out[size + 1, axis] = places[k, axis]
                    out_edges[n_out, 0] = node
                    node = n_nodes + k
                    out_edges[n_out, 1] = node
                    n_out += 1
                    out_offsets[n_out] = size + 1
                    size += 2
                    k += 1
                done += step
            out[size, 0] = coords[c, 0]
            out[size, 1] = coords[c, 1]
            size += 1
        out_edges[n_out, 0] = node
        out_edges[n_out, 1] = edges[e, 1]
        n_out += 1
        out_offsets[n_out] = size
    return places, out_edges, out, out_offsets


@kernel()
def narrow_faces(follow: Ints1, area: Floats1, lengths: Floats1, width: float, longest: float) -> Ints1:
    """Find the faces of a plane graph that are small and narrow: a roundabout, the triangle of a slip road.

    Parameters
    ----------
    follow : (2 E,) int64
        The half-edge that comes after each half-edge around the face on its left.
    area : (2 E,) float64
        Area swept by each half-edge as seen from the origin, counterclockwise positive.
    lengths : (E,) float64
    width : float
        A face is narrow when twice its area is less than this times its perimeter.
    longest : float
        Largest perimeter.

    Returns
    -------
    (2 E,) int64
        The first half-edge of the narrow face on the left of each half-edge, -1 for other faces.
    """
    n = len(follow)
    face = np.full(n, -2)
    for first in range(n):
        if face[first] != -2:
            continue
        perimeter = 0.0
        total = 0.0
        half = first
        while True:
            perimeter += lengths[half // 2]
            total += area[half]
            face[half] = -1
            half = follow[half]
            if half == first:
                break
        if perimeter < longest and 0.0 < 2 * total < width * perimeter:
            while face[half] == -1:
                face[half] = first
                half = follow[half]
    return face
