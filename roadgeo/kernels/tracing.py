"""Tracing: from lines one pixel wide to nodes and the chains of pixels between them."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from roadgeo.kernels.thinning import ROAD, SOLID, neighbour_steps

__all__ = ["smooth_chains", "trace"]


@njit(cache=True)
def trace(
    states: NDArray[np.uint8], pixels: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.int32], NDArray[np.int64], NDArray[np.int64]]:
    """Split a skeleton into nodes and chains.

    A node is a cluster of touching pixels with three ROAD neighbours or more, a pixel with one, a pixel that touches
    SOLID (an *open* end: the road goes on unseen), or one pixel of a ring that has none of these.

    Parameters
    ----------
    states : (H, W) uint8, C-contiguous
        As left by `thin`.
    pixels : (P,) int64
        Flat indices of its ROAD pixels.

    Returns
    -------
    xy : (N, 2) float64
        Mean (column, row) of each node's pixels.
    is_open : (N,) bool
    edges : (E, 2) int32
        Nodes at the two ends of each chain.
    chain : (C,) int64
        Flat indices of the pixels strictly between the nodes, chain after chain.
    offsets : (E + 1,) int64
    """
    flat = states.ravel()
    width = states.shape[1]
    steps = neighbour_steps(width)
    n = len(pixels)
    node_of = np.empty(len(flat), np.int32)  # defined at ROAD pixels: node, -1 path, -2 path already walked
    slots = 0
    for i in range(n):
        p = pixels[i]
        n_road = 0
        solid = False
        for k in range(8):
            state = flat[p + steps[k]]
            n_road += state == ROAD
            solid |= state == SOLID
        if n_road == 2 and not solid:
            node_of[p] = -1
        else:
            node_of[p] = -3 if n_road < 2 or solid else -4
            slots += n_road

    members = np.empty(n, np.int64)  # pixels of the nodes, node after node
    first = np.empty(n + 1, np.int64)
    is_open = np.zeros(n, np.bool_)
    n_nodes = 0
    n_members = 0
    for i in range(n):
        seed = pixels[i]
        if node_of[seed] > -3:
            continue
        first[n_nodes] = n_members
        spread = node_of[seed] == -4
        members[n_members] = seed
        n_members += 1
        node_of[seed] = n_nodes
        head = first[n_nodes]
        while head < n_members:
            p = members[head]
            head += 1
            for k in range(8):
                q = p + steps[k]
                if flat[q] == SOLID:
                    is_open[n_nodes] = True
                elif spread and flat[q] == ROAD and node_of[q] == -4:
                    node_of[q] = n_nodes
                    members[n_members] = q
                    n_members += 1
        n_nodes += 1
    first[n_nodes] = n_members

    edges = np.empty((slots + n // 2 + 1, 2), np.int32)
    offsets = np.zeros(len(edges) + 1, np.int64)
    chain = np.empty(n, np.int64)
    n_edges = 0
    n_chain = 0
    m = 0
    next_ring = 0
    while True:
        if m == n_members:  # all nodes done: is there a ring left?
            while next_ring < n and node_of[pixels[next_ring]] != -1:
                next_ring += 1
            if next_ring == n:
                break
            members[m] = pixels[next_ring]
            node_of[members[m]] = n_nodes
            n_members += 1
            n_nodes += 1
            first[n_nodes] = n_members
        p = members[m]
        m += 1
        for k in range(8):
            q = p + steps[k]
            if flat[q] != ROAD or node_of[q] == -2 or node_of[q] == node_of[p]:
                continue
            if node_of[q] >= 0:
                if node_of[p] > node_of[q]:
                    continue  # seen from the other node
                edges[n_edges, 0] = node_of[p]
                edges[n_edges, 1] = node_of[q]
            else:
                edges[n_edges, 0] = node_of[p]
                came_from = p
                while node_of[q] == -1:
                    node_of[q] = -2
                    chain[n_chain] = q
                    n_chain += 1
                    for j in range(8):
                        onward = q + steps[j]
                        if flat[onward] == ROAD and onward != came_from:
                            break
                    came_from = q
                    q = onward
                edges[n_edges, 1] = node_of[q]
            n_edges += 1
            offsets[n_edges] = n_chain

    xy = np.zeros((n_nodes, 2))
    for node in range(n_nodes):
        for i in range(first[node], first[node + 1]):
            xy[node, 0] += members[i] % width
            xy[node, 1] += members[i] // width
        xy[node] /= first[node + 1] - first[node]
    return xy, is_open[:n_nodes].copy(), edges[:n_edges].copy(), chain[:n_chain].copy(), offsets[: n_edges + 1].copy()


@njit(cache=True)
def smooth_chains(
    distance: NDArray[np.float32],
    chain: NDArray[np.int64],
    chain_offsets: NDArray[np.int64],
    starts: NDArray[np.float64],
    ends: NDArray[np.float64],
    passes: int,
    spacing: int,
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Turn chains of pixels into smooth sub-pixel polylines.

    Each pixel moves to the centroid of the distance ridge in its 3 x 3 neighbourhood; then binomial smoothing
    (1/4, 1/2, 1/4) runs `passes` times with the two ends held; then every `spacing`-th vertex is kept.

    Parameters
    ----------
    distance : (H, W) float32, C-contiguous
    chain : (C,) int64
    chain_offsets : (E + 1,) int64
        Chain e owns `chain[chain_offsets[e]:chain_offsets[e + 1]]`, possibly nothing.
    starts, ends : (E, 2) float64
        (column, row) of the nodes at the two ends.
    passes, spacing : int

    Returns
    -------
    coords : (V, 2) float64
        Column, row (pixel centres at whole numbers); at least two vertices per chain.
    offsets : (E + 1,) int64
    """
    depth = distance.ravel()
    width = distance.shape[1]
    n_edges = len(chain_offsets) - 1
    coords = np.empty((len(chain) + 2 * n_edges, 2))
    offsets = np.zeros(n_edges + 1, np.int64)
    longest = 0
    for e in range(n_edges):
        longest = max(longest, chain_offsets[e + 1] - chain_offsets[e])
    line = np.empty((longest + 2, 2))
    n_out = 0
    for e in range(n_edges):
        n = chain_offsets[e + 1] - chain_offsets[e] + 2
        line[0] = starts[e]
        line[n - 1] = ends[e]
        for i in range(1, n - 1):
            p = chain[chain_offsets[e] + i - 1]
            lowest = depth[p]
            for dy in range(-1, 2):
                for dx in range(-1, 2):
                    lowest = min(lowest, depth[p + dy * width + dx])
            total = 0.0
            sum_x = 0.0
            sum_y = 0.0
            for dy in range(-1, 2):
                for dx in range(-1, 2):
                    weight = depth[p + dy * width + dx] - lowest
                    total += weight
                    sum_x += weight * dx
                    sum_y += weight * dy
            line[i, 0] = p % width
            line[i, 1] = p // width
            if total > 0.0:
                line[i, 0] += sum_x / total
                line[i, 1] += sum_y / total
        for _ in range(passes):
            before_x = line[0, 0]
            before_y = line[0, 1]
            for i in range(1, n - 1):
                here_x = line[i, 0]
                here_y = line[i, 1]
                line[i, 0] = 0.25 * (before_x + line[i + 1, 0]) + 0.5 * here_x
                line[i, 1] = 0.25 * (before_y + line[i + 1, 1]) + 0.5 * here_y
                before_x = here_x
                before_y = here_y
        coords[n_out] = line[0]
        n_out += 1
        for i in range(spacing, n - 1 - spacing // 2, spacing):
            coords[n_out] = line[i]
            n_out += 1
        coords[n_out] = line[n - 1]
        n_out += 1
        offsets[e + 1] = n_out
    return coords[:n_out].copy(), offsets
