"""Road intersections with their branches and tangents: what the matcher sees of a road network."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roadgeo.graph import RoadGraph
from roadgeo.typing import Float32Array, FloatArray, IntArray

__all__ = ["IntersectionOptions", "Intersections", "find_intersections"]

#: Columns of `Intersections.rays` and `.tangents`: more branches than this at one place are kept as the first eight.
MAX_BRANCHES = 8


@dataclass(frozen=True)
class IntersectionOptions:
    """How tangents are fitted. Lengths are in the units of the graph's plane (metres or pixels)."""

    tangent_length: float = 25.0
    skip_length: float = 3.0
    merge_angle_deg: float = 20.0
    min_branch_length: float = 6.0


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
    node : (N,) int32
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

    @property
    def n_branches(self) -> IntArray:
        """(N,) N_B, the number of branches."""
        return np.isfinite(self.rays).sum(axis=1)

    @property
    def n_tangents(self) -> IntArray:
        """(N,) N_q, the number of distinct tangent lines."""
        return np.isfinite(self.tangents).sum(axis=1)


def find_intersections(graph: RoadGraph, options: IntersectionOptions | None = None) -> Intersections:
    """Fit rays and tangents at every node of degree three or more."""
    raise NotImplementedError
