"""Slow, obvious twins of `roadgeo.kernels.tracing`."""

import numpy as np

GROUND, ROAD, SOLID = 0, 1, 2


def around(states, pixel, value):
    row, column = pixel
    near = [(row + r, column + c) for r in (-1, 0, 1) for c in (-1, 0, 1) if (r, c) != (0, 0)]
    return {q for q in near if states[q] == value}


def trace(states):
    """Nodes as {frozenset of pixels: open}, chains as [(pixels on the way, its one or two nodes)]."""
    roads = {(int(r), int(c)) for r, c in np.argwhere(states == ROAD)}
    degree = {p: len(around(states, p, ROAD)) for p in roads}
    opened = {p for p in roads if around(states, p, SOLID)}
    ends = {p for p in roads if degree[p] < 2} | opened
    crossings = {p for p in roads if degree[p] > 2} - ends
    nodes = {frozenset([p]): p in opened for p in ends}
    while crossings:
        cluster, front = set(), {min(crossings)}
        while front:
            cluster |= front
            front = {q for p in front for q in around(states, p, ROAD)} & crossings - cluster
        crossings -= cluster
        nodes[frozenset(cluster)] = False

    paths = roads - set().union(*nodes) if nodes else set(roads)
    chains = []
    while True:
        node_of = {p: node for node in nodes for p in node}
        for p in sorted(node_of):
            for q in sorted(around(states, p, ROAD)):
                if q in paths:
                    way = [p, q]
                    while way[-1] in paths:
                        onward = around(states, way[-1], ROAD) - {way[-2]}
                        way.append(onward.pop())
                    paths -= set(way)
                    chains.append((frozenset(way[1:-1]), frozenset([node_of[p], node_of[way[-1]]])))
        if not paths:
            break
        nodes[frozenset([min(paths)])] = False  # a ring
        paths.remove(min(paths))
    touching = [(p, q) for p in node_of for q in around(states, p, ROAD) & set(node_of) if p < q]
    chains += [(frozenset(), frozenset([node_of[p], node_of[q]])) for p, q in touching if node_of[p] != node_of[q]]
    return nodes, chains


def smooth_chain(distance, pixels, start, end, trims, passes, spacing):
    """One chain, given as (row, column) pixels, as a polyline of (column, row)."""
    kept = pixels[trims[0] : max(len(pixels) - trims[1], 0)]
    if not kept:
        kept = pixels[len(pixels) // 2 : len(pixels) // 2 + 1]
    line = []
    for row, column in kept:
        weights = distance[row - 1 : row + 2, column - 1 : column + 2].astype(float)
        weights = weights - weights.min()
        shift = np.array([(weights * [-1, 0, 1]).sum(), (weights.T * [-1, 0, 1]).sum()]) / max(weights.sum(), 1e-30)
        line.append(np.add((column, row), shift))
    line = np.array(line).reshape(-1, 2)
    for _ in range(passes):
        line[1:-1] = (line[:-2] + 2 * line[1:-1] + line[2:]) / 4
    chosen = [i for i in range(len(line)) if i % spacing == 0 or i == len(line) - 1]
    return np.concatenate(([start], line[chosen], [end]))
