"""Slow, obvious twins of the kernels of `roadgeo.simplification`."""

from itertools import groupby, pairwise

import networkx as nx
import numpy as np
from shapely import LineString, Polygon, get_parts, polygonize
from shapely.ops import substring


def join_chains(edges, lengths):
    """Sorted (ends, length) of the maximal chains between nodes that are not of degree two; rings have no ends."""
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


def cut_edge(line, cuts):
    """The pieces of a polyline between arc lengths."""
    whole = LineString(line)
    return [substring(whole, a, b) for a, b in pairwise([0.0, *cuts, whole.length])]


def are_twins(first, other, distance):
    """Whether two polylines are near at equal shares of their lengths."""
    shares = np.arange(1, 12) / 12
    a, b = (np.array([LineString(x).interpolate(s, normalized=True).coords[0] for s in shares]) for x in (first, other))
    return bool((np.hypot(*(a - b).T) <= distance).all())


def find_mates(xy, direction, edge, edges, ends, distance, min_cos):
    """Distances: of each sample to the nearest beside it, of each edge end to the nearest edge not meeting it."""
    mate = []
    for i in range(len(xy)):
        d = np.hypot(*(xy - xy[i]).T)
        ok = (edge != edge[i]) & (np.abs(direction @ direction[i]) >= min_cos) & (d < distance)
        mate.append(d[ok].min() if ok.any() else None)
    touch = []
    for half, i in enumerate(ends):
        d = np.hypot(*(xy - xy[i]).T)
        node = edges[half // 2, half % 2]
        ok = (edge != half // 2) & (edges[edge] != node).all(axis=1) & (d < distance)
        touch.append(d[ok].min() if ok.any() else None)
    return mate, touch


def runs(mates):
    """First and last place of each stretch with one and the same mate that is not None."""
    found = []
    start = 0
    for mate, group in groupby(mates):
        n = len(list(group))
        found += [] if mate is None else [(start, start + n - 1)]
        start += n
    return found


def outer_rings(face):
    """The outer ring of a face, then the holes that hang on it by a node: one walks around them too."""
    rings, holes = [face.exterior], list(face.interiors)
    while hanging := [hole for hole in holes if any(hole.intersects(ring) for ring in rings)]:
        rings += hanging
        holes = [hole for hole in holes if hole not in hanging]
    return rings


def narrow_faces(lines, width, longest):
    """Area and perimeter of the inner faces of noded lines that are small and narrow."""
    rings = [outer_rings(face) for face in get_parts(polygonize(lines))]
    faces = [(2 * Polygon(r[0]).area - sum(Polygon(ring).area for ring in r), sum(x.length for x in r)) for r in rings]
    return sorted(f for f in faces if f[1] < longest and 2 * f[0] < width * f[1])


def roads_alongside(xy, along, reach, least, most, min_cos):
    """The way across from each point to the nearest point abreast of it on a road alike in direction."""
    ways = np.full(xy.shape, np.nan)
    for i in range(len(xy)):
        for j in range(len(xy)):
            cos = along[i] @ along[j]
            if i == j or abs(cos) < min_cos:
                continue
            mean = along[i] + np.sign(cos) * along[j]
            mean = mean / np.hypot(*mean)
            ahead = (xy[j] - xy[i]) @ mean
            across = (xy[j] - xy[i]) - ahead * mean
            away = np.hypot(*across)
            abreast = abs(ahead) <= max(reach[i], reach[j])
            if least < away < most and abreast and not np.hypot(*ways[i]) <= away:
                ways[i] = across
    return ways
