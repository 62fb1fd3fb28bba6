"""Draw a road network as a mask sees it.

Ways of a map are not split where they cross, a bridge looks like a crossing from above, two carriageways melt into one
stripe and a roundabout into a blob. `planarize` nodes a map's lines at every crossing; `simplify` does, on a map as on
the skeleton of a mask, what the width of the roads does to both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from roadgeo.graph import RoadGraph
from roadgeo.kernels import simplification as kernels
from roadgeo.typing import BoolArray, Int32Array

if TYPE_CHECKING:
    from shapely.geometry import LineString

__all__ = ["SimplifyOptions", "planarize", "simplify"]


@dataclass(frozen=True)
class SimplifyOptions:
    """What the width of the roads hides. Lengths are in the units of the graph's plane (metres or pixels).

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
    fuse_distance: float = 10.0
    stub_length: float = 15.0
    max_passes: int = 6


def planarize(lines: Sequence[LineString] | Any, grid_m: float = 0.1) -> RoadGraph:
    """Node lines wherever they cross or touch.

    Parameters
    ----------
    lines : sequence of shapely LineString or MultiLineString
        On a metric plane. Empty ones are left out; heights are dropped.
    grid_m : float
        Coordinates are rounded to this grid, so that lines that nearly touch do.

    Returns
    -------
    RoadGraph
        Every crossing is a node; edges are what lies between two nodes.
    """
    import shapely

    whole = shapely.union_all(shapely.force_2d(np.asarray(lines, object)), grid_size=grid_m)
    parts = shapely.get_parts(whole)
    parts = parts[shapely.get_num_coordinates(parts) >= 2]
    coords = shapely.get_coordinates(parts)
    offsets = np.concatenate(([0], np.cumsum(shapely.get_num_coordinates(parts)))).astype(np.int64)
    ends = coords[np.stack((offsets[:-1], offsets[1:] - 1), axis=1)].reshape(-1, 2)
    cells = np.round(ends / grid_m).astype(np.int64)
    _, first, inverse = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    return RoadGraph(ends[first], inverse.reshape(-1, 2).astype(np.int32), coords, offsets)


def simplify(graph: RoadGraph, options: SimplifyOptions | None = None) -> RoadGraph:
    """Join chains, merge intersections, fuse parallel roads and drop stubs until nothing changes.

    Parameters
    ----------
    graph : RoadGraph
        Noded: roads meet only at nodes.

    Returns
    -------
    RoadGraph
        Without nodes of degree two (but for rings) and without unused nodes.
    """
    options = options or SimplifyOptions()
    graph = _join_chains(graph)
    for _ in range(options.max_passes):
        before = graph.n_nodes, graph.n_edges
        graph = _join_chains(_merge_intersections(graph, options))
        graph = _join_chains(_fuse_parallels(graph, options))
        graph = _join_chains(_drop_stubs(graph, options))
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
    near = kernels.close_pairs(xy, np.argsort(xy[:, 0], kind="stable"), options.fuse_distance)
    short = number[graph.edges[graph.edge_lengths() < options.merge_radius]]
    joined = short[(short >= 0).all(axis=1) & (short[:, 0] != short[:, 1])]
    pairs = np.concatenate((near, joined))
    radius = np.repeat((options.fuse_distance, options.merge_radius), (len(near), len(joined)))
    order = np.argsort(np.hypot(*(xy[pairs[:, 0]] - xy[pairs[:, 1]]).T), kind="stable")
    cluster, centre = kernels.draw_together(xy, pairs[order], radius[order])

    place = graph.xy.copy()
    place[joint] = centre
    target = np.arange(graph.n_nodes)
    target[joint] = joint[cluster]
    edges = target[graph.edges].astype(np.int32)
    coords, offsets = kernels.reattach(place, graph.edges, graph.offsets, graph.coords)
    merged = RoadGraph(place, edges, coords, offsets)
    inside = (edges[:, 0] == edges[:, 1]) & (merged.edge_lengths() < 4 * options.merge_radius)
    return _keep_edges(merged, ~inside)


def _fuse_parallels(graph: RoadGraph, options: SimplifyOptions) -> RoadGraph:
    """Keep one of several edges that run side by side between the same two nodes."""
    graph = _turned(graph)
    by_ends = np.lexsort((graph.edges[:, 1], graph.edges[:, 0]))
    lengths = graph.edge_lengths()
    stands = kernels.parallel_twins(graph.edges, graph.offsets, graph.coords, lengths, by_ends, options.fuse_distance)
    return _keep_edges(graph, stands == np.arange(graph.n_edges))


def _drop_stubs(graph: RoadGraph, options: SimplifyOptions) -> RoadGraph:
    """Leave out dead ends that are too short to be seen."""
    dead = (graph.degree() == 1)[graph.edges].any(axis=1)
    return _keep_edges(graph, ~(dead & (graph.edge_lengths() < options.stub_length)))


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
