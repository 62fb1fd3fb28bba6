"""Road intersections with their branches and tangents: the matcher's view of a road network."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from roadgeo._arrays import AnyArray, Float32Array, FloatArray, IntArray
from roadgeo.kernels import intersections as kernels
from roadgeo.roads.graph import RoadGraph

__all__ = ["IntersectionOptions", "Intersections", "describe", "find_intersections", "unpack_branches"]

#: Columns of `Intersections.rays` and `.tangents`: more branches than this at one place are kept as the first eight.
MAX_BRANCHES = 8

#: Weight of the node against one branch line in eq. 1: it decides only where the lines are nearly parallel.
_STIFFNESS = 0.05


@dataclass(frozen=True)
class IntersectionOptions:
    """How tangents are fitted. Lengths are in the units of the graph's plane (metres or pixels).

    Attributes
    ----------
    tangent_length, skip_length
        A branch's line is fitted to the road between these distances from its node: nearer, the width of the roads
        bends a skeleton.
    merge_angle_deg
        Tangents closer than this are one line.
    min_branch_length
        Shorter branches do not count.
    max_shift
        Centres move no further than this from their node.
    """

    tangent_length: float = 45.0
    skip_length: float = 8.0
    merge_angle_deg: float = 20.0
    min_branch_length: float = 6.0
    max_shift: float = 10.0


@dataclass(frozen=True)
class Intersections:
    """Nodes with three branches or more.

    Dimensions: N intersections, R = MAX_BRANCHES columns.

    Attributes
    ----------
    xy : (N, 2) float64
        Centre: the point nearest to all branch lines (eq. 1), in the graph's plane.
    rays : (N, R) float32
        Directions of the branches, outwards, radians counterclockwise from +x in [-pi, pi), ascending, NaN-padded.
    tangents : (N, R) float32
        Distinct tangent lines: directions modulo pi, in [0, pi), ascending, NaN-padded; branch lines closer than
        `merge_angle_deg` count as one (eq. 2-3).
    residual : (N,) float32
        Rms distance of the branch vertices from their fitted lines, in plane units.
    node : (N,) int64
        The graph node each intersection came from.
    """

    xy: FloatArray
    rays: Float32Array
    tangents: Float32Array
    residual: Float32Array
    node: IntArray

    def __len__(self) -> int:
        """N."""
        return len(self.xy)

    def only(self, chosen: IntArray) -> Intersections:
        """Return some of them, in the order of their numbers `chosen`."""
        xy, rays, tangents = self.xy[chosen], self.rays[chosen], self.tangents[chosen]
        return Intersections(xy, rays, tangents, self.residual[chosen], self.node[chosen])

    def branches(self) -> AnyArray:
        """(N, R, 2) int8: the rays as unit vectors scaled to 127, zeros behind the last (see `kernels.rays`)."""
        vectors = np.stack([np.cos(self.rays), np.sin(self.rays)], axis=-1) * 127.0
        return np.round(np.nan_to_num(vectors)).astype(np.int8)

    @property
    def n_branches(self) -> IntArray:
        """(N,) N_B, the number of branches."""
        return np.asarray(np.isfinite(self.rays).sum(axis=1))

    @property
    def n_tangents(self) -> IntArray:
        """(N,) N_q, the number of distinct tangent lines."""
        return np.asarray(np.isfinite(self.tangents).sum(axis=1))


def unpack_branches(branches: AnyArray) -> Float32Array:
    """Undo `Intersections.branches`: (N, R) float32 radians, NaN beyond the last."""
    vectors = np.asarray(branches, np.float32)
    rays = np.where(vectors.any(axis=2), np.arctan2(vectors[..., 1], vectors[..., 0]), np.float32(np.nan))
    return np.ascontiguousarray(rays)


def find_intersections(graph: RoadGraph, options: IntersectionOptions | None = None) -> Intersections:
    """Fit rays and tangents at every node with three branches or more.

    Parameters
    ----------
    graph : RoadGraph
        Simplified; lengths of the options are in its plane's units.

    Returns
    -------
    Intersections
        In the order of the graph's nodes.
    """
    options = options or IntersectionOptions()
    degree = graph.degree()
    leaving = np.argsort(graph.edges.ravel(), kind="stable")  # half-edges 2 * edge + side, by node
    half_edges = leaving[np.repeat(degree >= 3, degree)]
    lines = kernels.fit_branches(
        half_edges,
        graph.edges,
        graph.offsets,
        graph.coords,
        graph.edge_lengths(),
        options.skip_length,
        options.tangent_length,
        options.min_branch_length,
    )
    node = np.flatnonzero(degree >= 3)
    starts = np.concatenate(([0], np.cumsum(degree[node]))).astype(np.int64)
    described = describe(graph.xy[node], starts, lines, options)
    return replace(described, node=node).only(np.flatnonzero(described.n_branches >= 3))


def describe(near: FloatArray, starts: IntArray, lines: FloatArray, options: IntersectionOptions) -> Intersections:
    """Describe intersections near (N, 2) points by their branches' lines; see `kernels.describe_intersections`."""
    n = len(near)
    xy, residual = np.empty((n, 2)), np.empty(n, np.float32)
    rays, tangents = (np.full((n, MAX_BRANCHES), np.nan, np.float32) for _ in range(2))
    kernels.describe_intersections(
        near,
        starts,
        lines,
        np.radians(options.merge_angle_deg),
        _STIFFNESS,
        options.max_shift,
        xy,
        rays,
        tangents,
        residual,
    )
    return Intersections(xy, rays, tangents, residual, np.arange(n))
