"""Tracing: from lines one pixel wide to nodes and the chains of pixels between them.

Rows of arrays are copied element by element here: the first assignment of a whole row costs numba two seconds.
"""

import numpy as np

from roadgeo.kernels.arrays import Bools1, Bytes2, Floats2, Int32s1, Int32s2, Ints1, Ints2, Singles2
from roadgeo.kernels.compilation import kernel
from roadgeo.kernels.thinning import ROAD, neighbour_steps, neighbours, touches_solid

__all__ = ["smooth_chains", "trace"]

PATH, WALKED, FREE_END, OPEN_END, JUNCTION = -1, -2, -3, -4, -5  # a pixel's label before its node is numbered

#: (256,) how many bits are set, and the number of the lowest (of 0 it is 0).
COUNT = np.array([code.bit_count() for code in range(256)], np.int64)
LOWEST_BIT = np.array([max((code & -code).bit_length() - 1, 0) for code in range(256)], np.int64)


@kernel()
def _label(states: Bytes2, pixels: Int32s1, node_of: Int32s1) -> int:
    """Label each pixel as chain or node by its number of neighbours; return the summed neighbours of node pixels."""
    flat = states.ravel()
    stride = np.uint64(states.shape[1])
    slots = 0
    for i in range(len(pixels)):
        p = np.uint64(pixels[i])
        around = neighbours(flat, p, stride)
        solid = touches_solid(flat, p, stride)
        if COUNT[around] == 2 and not solid:
            node_of[p] = PATH
        else:
            node_of[p] = OPEN_END if solid else JUNCTION if COUNT[around] > 2 else FREE_END
            slots += COUNT[around]
    return slots


@kernel()
def _gather_nodes(
    states: Bytes2, pixels: Int32s1, node_of: Int32s1, members: Int32s1, first: Ints1, is_open: Bools1
) -> tuple[int, int]:
    """Give nodes their numbers; return how many there are, and how many pixels they have.

    Junctions that touch are one node. Node k gets the pixels `members[first[k]:first[k + 1]]`.
    """
    flat = states.ravel()
    back, steps = np.uint64(states.shape[1] + 1), neighbour_steps(states.shape[1])
    n_nodes = 0
    n_members = 0
    for i in range(len(pixels)):
        seed = np.uint64(pixels[i])
        kind = node_of[seed]
        if kind > FREE_END:
            continue
        first[n_nodes] = n_members
        is_open[n_nodes] = kind == OPEN_END
        members[n_members] = seed
        n_members += 1
        node_of[seed] = n_nodes
        head = first[n_nodes]
        while kind == JUNCTION and head < n_members:
            p = np.uint64(members[head])
            head += 1
            for k in range(8):
                q = p - back + steps[k]
                if flat[q] == ROAD and node_of[q] == JUNCTION:
                    node_of[q] = n_nodes
                    members[n_members] = q
                    n_members += 1
        n_nodes += 1
    first[n_nodes] = n_members
    return n_nodes, n_members


@kernel()
def _mean_places(members: Int32s1, first: Ints1, n_nodes: int, width: int) -> Floats2:
    """Return the mean (column, row) of each node's pixels."""
    xy = np.zeros((n_nodes, 2))
    for node in range(n_nodes):
        for i in range(first[node], first[node + 1]):
            xy[node, 0] += members[i] % width
            xy[node, 1] += members[i] // width
        xy[node, 0] /= first[node + 1] - first[node]
        xy[node, 1] /= first[node + 1] - first[node]
    return xy


@kernel(writes=("node_of",))
def trace(states: Bytes2, pixels: Int32s1, node_of: Int32s1) -> tuple[Floats2, Bools1, Int32s2, Int32s1, Ints1]:
    """Split a skeleton into nodes and chains.

    A node is a cluster of touching pixels with three or more ROAD neighbours, a pixel with one ROAD neighbour, a pixel
    that touches SOLID (an *open* end: the road goes on unseen), or any one pixel of a ring without such pixels.

    Parameters
    ----------
    states, pixels : (H, W) uint8, (P,) int32
        As left by `thin`: its ROAD pixels.
    node_of : (H * W,) int32
        Room to work in; need not be set.

    Returns
    -------
    xy, is_open : (N, 2) float64, (N,) bool
        Mean (column, row) of each node's pixels, and which nodes are open ends.
    edges, chain, offsets : (E, 2) int32, (C,) int32, (E + 1,) int64
        Nodes at the two ends of each chain; flat indices of the pixels strictly between them, chain after chain.
    """
    flat = states.ravel()
    width = states.shape[1]
    stride = np.uint64(width)
    back, steps = stride + np.uint64(1), neighbour_steps(width)
    n = len(pixels)
    slots = _label(states, pixels, node_of)
    members = np.empty(n, np.int32)  # pixels of the nodes, node after node
    first = np.empty(n + 1, np.int64)
    is_open = np.zeros(n, np.bool_)
    n_nodes, n_members = _gather_nodes(states, pixels, node_of, members, first, is_open)
    edges = np.empty((slots + n // 2 + 1, 2), np.int32)
    offsets = np.zeros(len(edges) + 1, np.int64)
    chain = np.empty(n, np.int32)
    n_edges = 0
    n_chain = 0
    m = 0
    next_ring = 0
    # Walk from every pixel of a node along all chains that leave it.
    while True:
        if m == n_members:  # all nodes done: is there a ring left?
            while next_ring < n and node_of[pixels[next_ring]] != PATH:
                next_ring += 1
            if next_ring == n:
                break
            members[m] = pixels[next_ring]
            node_of[members[m]] = n_nodes
            n_members += 1
            n_nodes += 1
            first[n_nodes] = n_members
        p = np.uint64(members[m])
        m += 1
        for k in range(8):
            q = p - back + steps[k]
            if flat[q] != ROAD or node_of[q] == WALKED or node_of[q] == node_of[p]:
                continue
            if node_of[q] >= 0 and node_of[p] > node_of[q]:
                continue  # seen from the other node
            edges[n_edges, 0] = node_of[p]
            came_along = k
            while node_of[q] == PATH:
                node_of[q] = WALKED
                chain[n_chain] = q
                n_chain += 1
                onward = np.int64(neighbours(flat, q, stride)) & ~(1 << ((came_along + 4) & 7))
                came_along = LOWEST_BIT[onward]
                q = q - back + steps[came_along]
            edges[n_edges, 1] = node_of[q]
            n_edges += 1
            offsets[n_edges] = n_chain
    xy = _mean_places(members, first, n_nodes, width)
    return xy, is_open[:n_nodes].copy(), edges[:n_edges].copy(), chain[:n_chain].copy(), offsets[: n_edges + 1].copy()


@kernel()
def smooth_chains(
    distance: Singles2,
    chain: Int32s1,
    chain_offsets: Ints1,
    ends: Floats2,
    trims: Ints2,
    passes: int,
    spacing: int,
) -> tuple[Floats2, Ints1]:
    """Turn chains of pixels into smooth sub-pixel polylines.

    Each pixel moves to the centroid of the distance ridge in its 3 x 3 neighbourhood; then binomial smoothing
    (1/4, 1/2, 1/4) runs `passes` times with the two ends held; then every `spacing`-th vertex is kept.

    Parameters
    ----------
    distance : (H, W) float32
    chain, chain_offsets : (C,) int32, (E + 1,) int64
        Flat indices of pixels; no pixel lies in the outermost rows and columns. Chain e, which may be empty, is
        `chain[chain_offsets[e]:chain_offsets[e + 1]]`.
    ends : (E, 4) float64
        Column, row of the nodes at the two ends.
    trims : (E, 2) int64
        How many pixels to leave out at either end: near a junction a skeleton is bent. One pixel is always kept.

    Returns
    -------
    coords, offsets : (V, 2) float64, (E + 1,) int64
        Column, row (pixel centres at whole numbers), from node to node; at least two vertices per chain.
    """
    depth = distance.ravel()
    width = distance.shape[1]
    n_edges = len(chain_offsets) - 1
    coords = np.empty((len(chain) + 2 * n_edges, 2))
    offsets = np.zeros(n_edges + 1, np.int64)
    n_out = 0
    for e in range(n_edges):
        lo = chain_offsets[e] + trims[e, 0]
        hi = chain_offsets[e + 1] - trims[e, 1]
        if lo >= hi and chain_offsets[e] < chain_offsets[e + 1]:
            lo = (chain_offsets[e] + chain_offsets[e + 1]) // 2
            hi = lo + 1
        coords[n_out, 0] = ends[e, 0]
        coords[n_out, 1] = ends[e, 1]
        n_out += 1
        n = max(hi - lo, 0)
        line = coords[n_out : n_out + n]  # worked on in place, then thinned out
        for i in range(n):
            p = chain[lo + i]
            lowest = depth[p]
            for dy in range(-width, width + 1, width):
                for dx in range(-1, 2):
                    lowest = min(lowest, depth[p + dy + dx])
            total = 0.0
            sum_x = 0.0
            sum_y = 0.0
            for row in range(-1, 2):
                for dx in range(-1, 2):
                    weight = depth[p + row * width + dx] - lowest
                    total += weight
                    sum_x += weight * dx
                    sum_y += weight * row
            line[i, 0] = p % width
            line[i, 1] = p // width
            if total > 0.0:
                line[i, 0] += sum_x / total
                line[i, 1] += sum_y / total
        for _ in range(passes):
            before_x = 0.0
            before_y = 0.0
            for i in range(n):
                here_x = line[i, 0]
                here_y = line[i, 1]
                if 0 < i < n - 1:
                    line[i, 0] = 0.25 * (before_x + line[i + 1, 0]) + 0.5 * here_x
                    line[i, 1] = 0.25 * (before_y + line[i + 1, 1]) + 0.5 * here_y
                before_x = here_x
                before_y = here_y
        kept = 0
        for i in range(n):
            if i % spacing == 0 or i == n - 1:
                line[kept, 0], line[kept, 1] = line[i, 0], line[i, 1]
                kept += 1
        n_out += kept
        coords[n_out, 0] = ends[e, 2]
        coords[n_out, 1] = ends[e, 3]
        n_out += 1
        offsets[e + 1] = n_out
    return coords[:n_out].copy(), offsets
