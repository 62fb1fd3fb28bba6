"""A road network as a plane graph: nodes, and edges with their geometry."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from roadgeo._arrays import AnyArray, FloatArray, Int32Array, IntArray

if TYPE_CHECKING:
    import networkx as nx

__all__ = ["RoadGraph"]


@dataclass(frozen=True)
class RoadGraph:
    """Road network of a mask or a map, y up.

    Dimensions: N nodes, E edges, C vertices of all edges together. The plane is the query plane in pixels (see
    `geometry.mask`) or the reference plane in metres from its local origin.

    Attributes
    ----------
    xy : (N, 2) float64
        Node positions.
    edges : (E, 2) int32
        Nodes at the two ends of each edge; loops and parallel edges may occur.
    coords : (C, 2) float64
        Vertices of all edges, one after another. Edge e runs from `xy[edges[e, 0]]` to `xy[edges[e, 1]]`, both
        included, so it has at least two vertices.
    offsets : (E + 1,) int64
        Edge e owns `coords[offsets[e]:offsets[e + 1]]`.
    """

    xy: FloatArray
    edges: Int32Array
    coords: FloatArray
    offsets: IntArray

    @classmethod
    def from_polylines(cls, xy: FloatArray, edges: Int32Array, polylines: Sequence[FloatArray]) -> RoadGraph:
        """Pack a list of (C_e, 2) polylines."""
        sizes = [len(line) for line in polylines]
        coords = np.concatenate(polylines) if polylines else np.empty((0, 2))
        return cls(
            np.asarray(xy, np.float64).reshape(-1, 2),
            np.asarray(edges, np.int32).reshape(-1, 2),
            np.asarray(coords, np.float64).reshape(-1, 2),
            np.concatenate(([0], np.cumsum(sizes, dtype=np.int64))).astype(np.int64),
        )

    @property
    def n_nodes(self) -> int:
        """N."""
        return len(self.xy)

    @property
    def n_edges(self) -> int:
        """E."""
        return len(self.edges)

    def polyline(self, e: int) -> FloatArray:
        """Vertices of edge `e`, (C_e, 2), a view."""
        return self.coords[self.offsets[e] : self.offsets[e + 1]]

    def polylines(self) -> list[FloatArray]:
        """Vertices of every edge, views."""
        return [self.polyline(e) for e in range(self.n_edges)]

    def lines(self) -> AnyArray:
        """(E,) shapely LineString of every edge."""
        import shapely

        owner = np.repeat(np.arange(self.n_edges), np.diff(self.offsets))
        return np.asarray(shapely.linestrings(self.coords, indices=owner))

    def to_networkx(self, move: Callable[[FloatArray], FloatArray] | None = None, **about: Any) -> nx.MultiGraph:
        """Return it as a networkx graph: nodes with `x` and `y`, edges with `geometry` (shapely) and `length`.

        Parameters
        ----------
        move : callable, optional
            Takes positions (..., 2) from the plane to where the graph is to lie; lengths stay as on the plane.
        **about
            The graph's own attributes: `crs`, as in osmnx, for example.
        """
        import networkx as nx

        move = move or (lambda xy: xy)
        graph = nx.MultiGraph(**about)
        xy = move(self.xy).reshape(-1, 2).tolist()
        graph.add_nodes_from((n, {"x": x, "y": y}) for n, (x, y) in enumerate(xy))
        lines = replace(self, coords=move(self.coords).reshape(-1, 2)).lines()
        ends = zip(self.edges.tolist(), lines, self.edge_lengths().tolist(), strict=True)
        graph.add_edges_from((a, b, {"geometry": line, "length": length}) for (a, b), line, length in ends)
        return graph

    def degree(self) -> IntArray:
        """(N,) number of edge ends at each node; a loop counts twice."""
        return np.bincount(self.edges.ravel(), minlength=self.n_nodes).astype(np.int64)

    def edge_lengths(self) -> FloatArray:
        """(E,) lengths in plane units."""
        if self.n_edges == 0:
            return np.empty(0)
        steps = np.hypot(*np.diff(self.coords, axis=0).T)
        steps[self.offsets[1:-1] - 1] = 0.0  # the jump from one edge to the next is no road
        return np.add.reduceat(steps, self.offsets[:-1])
