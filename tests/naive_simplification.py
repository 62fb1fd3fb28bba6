"""Slow, obvious twins of the kernels of `roadgeo.simplification`."""

import networkx as nx
import numpy as np


def join_chains(edges, lengths):
    """Sorted list of (ends, length) of the maximal chains between nodes that are not of degree two; rings have no ends."""
    graph = nx.MultiGraph()
    for (a, b), length in zip(edges, lengths, strict=True):
        graph.add_edge(int(a), int(b), length=length)
    while True:
        for n in list(graph):
            around = list(graph.edges(n, keys=True, data="length"))
            if graph.degree(n) == 2 and len(around) == 2:
                (_, a, _, p), (_, b, _, q) = around
                graph.remove_node(n)
                graph.add_edge(a, b, length=p + q)
                break
        else:
            ends = [((a, b) if a <= b else (b, a), d) for a, b, d in graph.edges(data="length")]
            return sorted((((), d) if graph.degree(e[0]) == 2 and e[0] == e[1] else (e, d)) for e, d in ends)


def close_pairs(xy, radius):
    """All pairs of points nearer than `radius`."""
    return {(i, j) for j in range(len(xy)) for i in range(j) if np.hypot(*(xy[i] - xy[j])) < radius}


def draw_together(xy, pairs, radius):
    """Clusters as sets, merged in the order given while their centres are near."""
    clusters = [{i} for i in range(len(xy))]
    for (i, j), limit in zip(pairs, radius, strict=True):
        a, b = (next(c for c in clusters if n in c) for n in (i, j))
        if a is not b and np.hypot(*(xy[list(a)].mean(axis=0) - xy[list(b)].mean(axis=0))) < limit:
            a |= b
            clusters.remove(b)
    return clusters
