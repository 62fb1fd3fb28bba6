"""Draw a road network as a mask sees it.

Ways of a map are not split where they cross, a bridge looks like a crossing from above, two carriageways melt into one
stripe and a roundabout into a blob. `planarize` nodes a map's lines at every crossing; `simplify` does, on a map as on
the skeleton of a mask, the merging that the width of the roads causes in both.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from roadgeo._arrays import AnyArray, BoolArray, FloatArray, Int32Array, IntArray
from roadgeo.errors import RoadSourceError
from roadgeo.kernels import simplification as kernels
from roadgeo.kernels.parallel_roads import find_mates, find_twins, sample_edges, tie_runs
from roadgeo.roads.graph import RoadGraph
from roadgeo.storage.memory import give_back_memory

if TYPE_CHECKING:
    from shapely.geometry import LineString

__all__ = ["SimplifyOptions", "planarize", "simplify"]

#: Roads at a smaller angle than this run side by side.
_PARALLEL_COS = float(np.cos(np.radians(25.0)))

#: On a map with more, memory that one step has freed is given back before the next needs its own.
_MANY_EDGES = 100_000

#: Limits on lines, far above any map that can be indexed: beyond them they would fill the memory.
MAX_LENGTH_M = 1e10
MAX_PAIRS, MAX_PAIRS_PER_SEGMENT = 1_000_000, 100


@dataclass(frozen=True)
class SimplifyOptions:
    """Distances below which the width of the roads merges them, in units of the graph's plane (metres or pixels).

    Attributes
    ----------
    merge_radius
        Intersections nearer than this and joined by a road as short are one.
    fuse_distance
        Roads whose centre lines run closer than this are one, and so are intersections, joined or not.
    stub_length
        Dead ends shorter than this are dropped.
    max_passes
        One step can make another possible; it ends when nothing changes, or after this many rounds.
    """

    merge_radius: float = 14.0
    fuse_distance: float = 12.0
    stub_length: float = 15.0
    max_passes: int = 3

    def times(self, factor: float) -> SimplifyOptions:
        """Return them with all lengths multiplied by a factor."""
        lengths = ("merge_radius", "fuse_distance", "stub_length")
        return replace(self, **{name: factor * getattr(self, name) for name in lengths})


def planarize(lines: Sequence[LineString] | Any, grid_m: float = 0.1) -> RoadGraph:
    """Node lines wherever they cross or touch.

    Parameters
    ----------
    lines : sequence of shapely LineString or MultiLineString
        On a metric plane. Empty ones are left out; heights are dropped.
    grid_m : float
        Coordinates are rounded to this grid first, so that vertices that nearly coincide do. Ends that stop short of a
        road are for `simplify`.

    Returns
    -------
    RoadGraph
        Every crossing is a node; edges are what lies between two nodes.

    Raises
    ------
    RoadSourceError
        The number of crossings, or the total length, is implausible for roads: memory and time are bounded.
    """
    import shapely

    rounded = _rounded(lines, grid_m)
    _require_mappable(rounded)
    parts = _noded(rounded, grid_m)
    coords = shapely.get_coordinates(parts)
    offsets = np.concatenate(([0], np.cumsum(shapely.get_num_coordinates(parts)))).astype(np.int64)
    at_ends = np.stack((offsets[:-1], offsets[1:] - 1), axis=1).ravel()
    ends = coords[at_ends]
    cells = np.round(ends / grid_m).astype(np.int64)
    _, first, inverse = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    edges = inverse.reshape(-1, 2).astype(np.int32)
    coords[at_ends] = ends[first][edges.ravel()]
    specks = (edges[:, 0] == edges[:, 1]) & (shapely.length(parts) < 2 * grid_m)
    return _keep_edges(RoadGraph(ends[first], edges, coords, offsets), ~(specks | _repeated(edges, offsets)))


def _require_mappable(lines: AnyArray) -> None:
    """Refuse lines whose crossings could not be held in memory, by an estimate that takes hardly any time.

    Segments are sampled once in each cell of a grid, and those that share a cell are counted in pairs. Real maps have 2
    to 4 pairs for each segment, whatever their size; an estimate may be a few times what crosses.
    """
    import shapely

    coords, line = shapely.get_coordinates(lines, return_index=True)
    inside = line[1:] == line[:-1]
    start, step = coords[:-1][inside], np.diff(coords, axis=0)[inside]
    length = np.hypot(*step.T)
    total, n = float(length.sum()), len(start)
    if not total <= MAX_LENGTH_M:
        raise RoadSourceError(
            f"the lines are {total / 1e3:,.0f} km long, expected at most {MAX_LENGTH_M / 1e3:,.0f}: "
            "check their CRS, or give a smaller area"
        )
    if n == 0:
        return
    size = max(2.0 * float(np.median(length)), total / (4e6 + n), 1e-9)
    count = np.ceil(length / size).astype(np.int64) + 1
    segment = np.repeat(np.arange(n), count)
    share = (np.arange(len(segment)) - (np.cumsum(count) - count)[segment]) / (count - 1).clip(1)[segment]
    column, row = (_cells(start[segment, axis] + step[segment, axis] * share, size) for axis in (0, 1))
    key = row * (int(column.max()) + 1) + column
    first = np.ones(len(key), bool)
    first[1:] = (key[1:] != key[:-1]) | (segment[1:] != segment[:-1])
    held = np.unique(key[first], return_counts=True)[1].astype(float)
    pairs, most = float(held @ (held - 1)) / 2, MAX_PAIRS + MAX_PAIRS_PER_SEGMENT * n
    if pairs > most:
        raise RoadSourceError(
            f"the {n:,} pieces of line may cross each other {pairs:,.0f} times, expected at most {most:,} times: "
            "these are no roads, or the file holds each of them many times over"
        )


def _repeated(edges: Int32Array, offsets: IntArray) -> BoolArray:
    """Return which straight edges join the same two nodes as one before them: they differ by rounding only."""
    straight = np.flatnonzero(np.diff(offsets) == 2)
    _, first = np.unique(np.sort(edges[straight], axis=1), axis=0, return_index=True)
    repeated = np.zeros(len(edges), bool)
    repeated[np.delete(straight, first)] = True
    return repeated


def _rounded(lines: Sequence[LineString] | Any, grid: float) -> AnyArray:
    """Return lines with their vertices on a grid; those that shrink to a point are left out."""
    import shapely

    parts = shapely.get_parts(shapely.force_2d(np.asarray(lines, object)))
    coords, line = shapely.get_coordinates(parts, return_index=True)
    coords = np.round(coords / grid) * grid
    moves = np.ones(len(coords), bool)
    moves[1:] = (np.diff(line) != 0) | (np.diff(coords, axis=0) != 0).any(axis=1)
    coords, line = coords[moves], line[moves]
    long = np.bincount(line, minlength=len(parts))[line] >= 2
    _, number = np.unique(line[long], return_inverse=True)
    return np.asarray(shapely.linestrings(coords[long], indices=number))


def _noded(lines: AnyArray, grid: float) -> AnyArray:
    """Return the pieces of lines between their crossings, each once."""
    import shapely

    try:
        whole = shapely.node(shapely.multilinestrings(lines))
    except shapely.GEOSException:  # rounding may upset it; on a grid it cannot, but takes three times as long
        whole = shapely.union_all(lines, grid_size=grid)
    parts = shapely.get_parts(whole)
    return np.asarray(parts[shapely.get_num_coordinates(parts) >= 2])


def simplify(
    graph: RoadGraph, options: SimplifyOptions | None = None, advance: Callable[[float], None] = lambda _: None
) -> RoadGraph:
    """Join chains, merge intersections, fuse parallel roads and drop stubs until nothing changes.

    Parameters
    ----------
    graph : RoadGraph
        Noded: roads meet only at nodes.
    advance : callable, optional
        Called with the share that is done, at most.

    Returns
    -------
    RoadGraph
        Without nodes of degree two (but for rings) and without unused nodes.
    """
    options = options or SimplifyOptions()
    graph = _join_chains(graph)
    steps = _close_narrow_faces, _merge_intersections, _fuse_parallels, _drop_stubs
    for n_passes in range(options.max_passes):
        before = graph.n_nodes, graph.n_edges
        for n_steps, step in enumerate(steps):
            advance((n_passes + n_steps / len(steps)) / options.max_passes)
            if graph.n_edges > _MANY_EDGES:
                give_back_memory()
            changed = step(graph, options)
            graph = graph if changed is graph else _join_chains(changed)
        if (graph.n_nodes, graph.n_edges) == before:
            break
    return graph


def _join_chains(graph: RoadGraph) -> RoadGraph:
    """Make one edge of every chain through nodes of degree two, and forget the nodes nobody uses."""
    edges, coords, offsets = kernels.join_chains(graph.n_nodes, graph.edges, graph.offsets, graph.coords)
    used = np.zeros(graph.n_nodes, bool)
    used[edges.ravel()] = True
    number = np.cumsum(used, dtype=np.int32) - 1
    return RoadGraph(graph.xy[used], number[edges].astype(np.int32), coords, offsets)


def _merge_intersections(graph: RoadGraph, options: SimplifyOptions) -> RoadGraph:
    """Move intersections that a road's width makes one to their common centre."""
    joint = np.flatnonzero(graph.degree() >= 3)
    if len(joint) < 2:
        return graph
    number = np.full(graph.n_nodes, -1)
    number[joint] = np.arange(len(joint))
    xy = graph.xy[joint]
    near: IntArray = joint[kernels.close_pairs(xy, np.argsort(xy[:, 0], kind="stable"), options.fuse_distance)]
    short = graph.edges[_lengths(graph) < options.merge_radius]
    joined = short[(number[short] >= 0).all(axis=1) & (short[:, 0] != short[:, 1])]
    pairs = np.concatenate((near, joined))
    radius = np.repeat((options.fuse_distance, options.merge_radius), (len(near), len(joined)))
    return _merge(graph, pairs, radius, 4 * options.merge_radius)


def _close_narrow_faces(graph: RoadGraph, options: SimplifyOptions) -> RoadGraph:
    """Make one intersection of the nodes around a face that the roads around it fill: a roundabout, a slip road."""
    if graph.n_edges == 0:
        return graph
    follow, area = _walk_faces(graph)
    face = narrow_faces(follow, area, _lengths(graph), options.fuse_distance, 6.0 * options.merge_radius)
    node = graph.edges.ravel()
    inner = np.flatnonzero(face >= 0)
    pairs = np.stack((node[inner], node[face[inner]]), axis=1).astype(np.int64)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    filled = np.asarray((face >= 0).reshape(-1, 2).any(axis=1))
    return _merge(graph, pairs, np.full(len(pairs), np.inf), 0.0, drop=filled)


def narrow_faces(follow: IntArray, area: FloatArray, lengths: FloatArray, width: float, longest: float) -> IntArray:
    """Return the first half-edge (2 E,) of the narrow face on the left of each half-edge, -1 for other faces.

    `follow` and `area` come from `_walk_faces`, `lengths` (E,). A face is narrow when twice its area is less than
    `width` times its perimeter, which is less than `longest`.
    """
    first, ahead = np.arange(len(follow)), follow
    while (lower := np.minimum(first, first[ahead])).sum() < first.sum():  # twice as far ahead each time
        first, ahead = lower, ahead[ahead]
    total = np.bincount(first, area, len(follow))
    perimeter = np.bincount(first, np.repeat(lengths, 2), len(follow))
    narrow = (perimeter < longest) & (2 * total > 0.0) & (2 * total < width * perimeter)
    return np.asarray(np.where(narrow[first], first, -1))


def _walk_faces(graph: RoadGraph) -> tuple[IntArray, FloatArray]:
    """Return, for each half-edge, the one after it around the face on its left, and the area that it sweeps."""
    first, last = graph.offsets[:-1], graph.offsets[1:] - 1
    out = np.stack((graph.coords[first + 1] - graph.coords[first], graph.coords[last - 1] - graph.coords[last]), axis=1)
    node = graph.edges.ravel()
    around = np.lexsort((np.arctan2(out[..., 1], out[..., 0]).ravel(), node))  # half-edges, counterclockwise
    start = np.concatenate(([0], np.cumsum(graph.degree())))
    place = np.empty(len(node), np.int64)
    place[around] = np.arange(len(node))
    twin = np.arange(len(node)) ^ 1
    clockwise = place[twin] - 1
    clockwise = np.where(clockwise < start[node[twin]], start[node[twin] + 1] - 1, clockwise)
    x, y = graph.coords.T
    sweep = np.zeros(len(x))
    sweep[:-1] = x[:-1] * y[1:] - x[1:] * y[:-1]
    sweep[last] = 0.0
    area = 0.5 * np.add.reduceat(sweep, first)
    return around[clockwise], np.stack((area, -area), axis=1).ravel()


def _fuse_parallels(graph: RoadGraph, options: SimplifyOptions) -> RoadGraph:
    """Make one road of roads that run side by side, nearer than a mask shows apart."""
    halved = _halve_loops(graph)
    tied = _tie(halved, _find_ties(halved, options), options)
    ends = np.sort(tied.edges, axis=1)
    by_ends = np.lexsort((ends[:, 1], ends[:, 0]))
    ends = ends[by_ends]
    if not ((ends[1:] == ends[:-1]).all(axis=1) & (ends[1:, 0] != ends[1:, 1])).any():
        return graph if tied is halved else tied
    turned = _turned(tied)
    first = find_twins(
        turned.edges, turned.offsets, turned.coords, _lengths(turned), by_ends, 1.5 * options.fuse_distance
    )
    return fuse_twins(turned, first, 0.5 * options.fuse_distance)


def fuse_twins(graph: RoadGraph, first: IntArray, spacing: float) -> RoadGraph:
    """Make one edge, halfway, of each edge and its twins (see `find_twins`), with a vertex every `spacing`."""
    members = np.bincount(first, minlength=graph.n_edges)
    is_first = members > 0
    lengths = _lengths(graph)
    count = np.where(members > 1, (lengths / spacing).astype(np.int64) + 2, np.diff(graph.offsets))
    starts = np.concatenate(([0], np.cumsum(np.where(is_first, count, 0))))
    coords = np.zeros((starts[-1], 2))
    alone = np.repeat(members == 1, np.diff(graph.offsets))
    coords[np.repeat(members[is_first] == 1, count[is_first])] = graph.coords[alone]
    twins = np.flatnonzero(members[first] > 1)
    samples = np.concatenate(([0], np.cumsum(count[first[twins]])))
    xy, direction = np.empty((2, samples[-1], 2))
    part = _keep_edges(graph, members[first] > 1)
    sample_edges(part.offsets, part.coords, lengths[twins], samples, xy, direction)
    for n, e in enumerate(first[twins]):
        coords[starts[e] : starts[e + 1]] += xy[samples[n] : samples[n + 1]] / members[e]
    return RoadGraph(graph.xy, graph.edges[is_first], coords, starts[np.append(is_first, True)])


def _find_ties(graph: RoadGraph, options: SimplifyOptions) -> FloatArray:
    """Find where roads begin and cease to run side by side, or end at the side of another: see `tie_runs`."""
    lengths = _lengths(graph)
    count = np.ceil(lengths / (0.4 * options.fuse_distance)).astype(np.int64) + 1
    count = np.maximum(count, 2)
    starts = np.concatenate(([0], np.cumsum(count)))
    xy = np.empty((starts[-1], 2))
    direction = np.empty((starts[-1], 2))
    sample_edges(graph.offsets, graph.coords, lengths, starts, xy, direction)
    edge = np.repeat(np.arange(graph.n_edges, dtype=np.int32), count)
    # On a map of many cities these arrays are the largest: none is kept longer than it is needed.
    column = _cells(xy[:, 0], options.fuse_distance)
    n_columns = int(column.max(initial=0)) + 2
    key = _cells(xy[:, 1], options.fuse_distance)
    key *= n_columns
    key += column
    del column
    order = np.argsort(key, kind="stable")
    key = key[order]
    mate, apart, touch = find_mates(
        xy,
        direction,
        edge,
        graph.edges,
        starts,
        order,
        key,
        n_columns,
        options.fuse_distance,
        _PARALLEL_COS,
    )
    del xy, direction, order, key
    runs = tie_runs(starts, lengths, edge, mate, apart, 0.7 * options.fuse_distance, options.merge_radius)
    end = np.flatnonzero(touch >= 0)
    there = touch[end]
    share = (there - starts[edge[there]]) / (count[edge[there]] - 1)
    touches = np.stack((end // 2, (end % 2) * lengths[end // 2], edge[there], share * lengths[edge[there]]), axis=1)
    return np.concatenate((runs, touches))


def _cells(along: FloatArray, size: float) -> IntArray:
    """Return the numbers, from 1, of the cells of a grid that coordinates (N,) lie in."""
    return np.asarray((along - along.min(initial=np.inf)) / size + 1.0).astype(np.int64)


def _tie(graph: RoadGraph, ties: FloatArray, options: SimplifyOptions) -> RoadGraph:
    """Cut edges where they are tied together, and merge what is tied."""
    if len(ties) == 0:
        return graph
    edge = ties[:, [0, 2]].ravel().astype(np.int64)
    along = ties[:, [1, 3]].ravel()
    lengths = _lengths(graph)[edge]
    snap = options.fuse_distance
    node = np.where(along < lengths / 2, graph.edges[edge, 0], graph.edges[edge, 1]).astype(np.int64)
    inner = np.flatnonzero((along > snap) & (along < lengths - snap))
    inner = inner[np.lexsort((along[inner], edge[inner]))]
    fresh = np.ones(len(inner), bool)  # cuts closer than `snap` to the one before are the same
    fresh[1:] = (np.diff(edge[inner]) != 0) | (np.diff(along[inner]) > snap)
    node[inner] = graph.n_nodes + np.cumsum(fresh) - 1
    pairs = node.reshape(-1, 2)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    if len(pairs) == 0:
        return graph
    cuts = inner[fresh]
    cut = cut_edges(graph, along[cuts], np.bincount(edge[cuts], minlength=graph.n_edges))
    return _merge(cut, pairs, np.full(len(pairs), 2.0 * options.fuse_distance), 4 * options.merge_radius)


def _halve_loops(graph: RoadGraph) -> RoadGraph:
    """Cut loops in their middle, so that the two halves of a long narrow one run side by side."""
    loop = graph.edges[:, 0] == graph.edges[:, 1]
    if not loop.any():
        return graph
    return cut_edges(graph, _lengths(graph)[loop] / 2, loop.astype(np.int64))


def cut_edges(graph: RoadGraph, cuts: FloatArray, count: IntArray) -> RoadGraph:
    """Cut edges at arc lengths (K,), edge after edge and ascending, of which each has `count` (E,).

    Cut k becomes node `n_nodes + k`.
    """
    starts = np.concatenate(([0], np.cumsum(count)))
    places, at = kernels.find_cuts(graph.offsets, graph.coords, cuts, starts)
    k = np.arange(len(cuts))
    # A cut ends one edge and begins the next: its vertex and its node come twice.
    coords = np.insert(graph.coords, np.repeat(at, 2), np.repeat(places, 2, axis=0), axis=0)
    middle = np.repeat(2 * np.repeat(np.arange(graph.n_edges), count) + 1, 2)
    edges: Int32Array = np.insert(graph.edges.ravel(), middle, np.repeat(graph.n_nodes + k, 2)).reshape(-1, 2)
    offsets = np.sort(np.concatenate((graph.offsets + 2 * starts, at + 2 * k + 1)))
    return RoadGraph(np.concatenate((graph.xy, places)), edges, coords, offsets)


def _drop_stubs(graph: RoadGraph, options: SimplifyOptions) -> RoadGraph:
    """Leave out dead ends that are too short to be seen."""
    dead = (graph.degree() == 1)[graph.edges].any(axis=1)
    return _keep_edges(graph, ~(dead & (_lengths(graph) < options.stub_length)))


def _merge(
    graph: RoadGraph, pairs: IntArray, radius: FloatArray, shortest_loop: float, drop: BoolArray | None = None
) -> RoadGraph:
    """Merge pairs of nodes, nearest first, while the centres of the merged groups are nearer than `radius`.

    Loops shorter than `shortest_loop` vanish, and so do loops among the edges to `drop`.
    """
    merged = graph
    if len(pairs):
        order = np.argsort(np.hypot(*(graph.xy[pairs[:, 0]] - graph.xy[pairs[:, 1]]).T), kind="stable")
        cluster, centre = kernels.draw_together(graph.xy, pairs[order], radius[order])
        merged = replace(reattach(graph, centre), edges=cluster[graph.edges].astype(np.int32))
    loop = merged.edges[:, 0] == merged.edges[:, 1]
    if not loop.any():
        return merged
    short = _lengths(merged) < shortest_loop
    return _keep_edges(merged, ~(loop & (short if drop is None else short | drop)))


def reattach(graph: RoadGraph, centre: FloatArray) -> RoadGraph:
    """Move nodes to `centre` (N, 2): every edge runs from the one place to the other through all its old vertices."""
    place, ends = centre[graph.edges], np.stack((graph.offsets[:-1], graph.offsets[1:]), axis=1)
    fresh = (place != graph.coords[ends - [0, 1]]).any(axis=2)
    coords = np.insert(graph.coords, ends[fresh], place[fresh], axis=0)
    offsets = graph.offsets + np.concatenate(([0], np.cumsum(fresh.sum(axis=1))))
    return RoadGraph(centre, graph.edges, coords, offsets)


def _lengths(graph: RoadGraph) -> FloatArray:
    """(E,) lengths; `RoadGraph.edge_lengths`, ten times as fast on small graphs."""
    return np.asarray(kernels.measure_edges(graph.offsets, graph.coords))


def _keep_edges(graph: RoadGraph, keep: BoolArray) -> RoadGraph:
    """Return the graph with some of its edges; nodes keep their numbers."""
    if keep.all():
        return graph
    sizes = np.diff(graph.offsets)
    return RoadGraph(
        graph.xy,
        graph.edges[keep],
        graph.coords[np.repeat(keep, sizes)],
        np.concatenate(([0], np.cumsum(sizes[keep]))).astype(np.int64),
    )


def _turned(graph: RoadGraph) -> RoadGraph:
    """Turn edges so that each runs from its lower to its higher node."""
    back = graph.edges[:, 0] > graph.edges[:, 1]
    sizes = np.diff(graph.offsets)
    place = np.arange(len(graph.coords))
    mirrored = np.repeat(graph.offsets[:-1] + graph.offsets[1:] - 1, sizes) - place
    coords = graph.coords[np.where(np.repeat(back, sizes), mirrored, place)]
    edges: Int32Array = np.sort(graph.edges, axis=1)
    return RoadGraph(graph.xy, edges, coords, graph.offsets)
