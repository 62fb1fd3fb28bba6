"""Where a map knows its roads at all: the ground around them, as rings."""

from __future__ import annotations

import numpy as np

from roadgeo._arrays import AnyArray, FloatArray
from roadgeo.errors import RoadSourceError
from roadgeo.roads.graph import RoadGraph

__all__ = ["coverage"]

#: Squares that roads lie in, far above any map that can be indexed: more would fill the memory.
MAX_CELLS = 3_000_000


def coverage(graph: RoadGraph, cell_m: float = 150.0, gap_m: float = 600.0) -> list[FloatArray]:
    """Outline the ground where the map knows its roads, no farther than the roads themselves reach.

    Covered are all cells with a road, the gaps between such cells, and the areas they enclose; of that, the part
    within the convex hull of each part's roads, and a road's width around it.

    Parameters
    ----------
    graph : RoadGraph
        In metres.
    cell_m : float
    gap_m : float
        Widest gap that is closed.

    Returns
    -------
    list of (V, 2) float64
        Closed rings, plane metres, counterclockwise, disjoint.
    """
    import shapely

    if graph.n_edges == 0:
        return []
    lines = graph.lines()
    stripes = _stripes(shapely.get_coordinates(shapely.segmentize(lines, cell_m / 2)), cell_m)
    half = gap_m / 2
    left, bottom, right, top = stripes.T
    grown = shapely.union_all(shapely.box(left - half, bottom - half, right + half, top + half))
    shells = shapely.get_exterior_ring(shapely.get_parts(grown))
    filled = shapely.union_all(shapely.polygons(shells))  # without holes, nor islands in them
    parts = shapely.get_parts(shapely.buffer(filled, -half, join_style="mitre"))
    parts = shapely.get_parts(shapely.intersection(parts, _hulls(lines, parts)))
    rings = shapely.get_exterior_ring(parts[shapely.get_dimensions(parts) == 2])  # where they touch is no ground
    rings = np.where(shapely.is_ccw(rings), rings, shapely.reverse(rings))
    return [shapely.get_coordinates(ring) for ring in rings]


def _stripes(points: FloatArray, cell_m: float) -> FloatArray:
    """(S, 4) left, bottom, right, top of the squares of a grid that hold points, those above one another joined."""
    square = np.floor(points / cell_m).astype(np.int64)
    corner, rows = square.min(axis=0), int(np.ptp(square[:, 1])) + 2
    numbers = np.sort((square - corner) @ (rows, 1))  # `np.unique` hashes them: minutes, where they are regular
    numbers = numbers[np.diff(numbers, prepend=-1) > 0]
    if len(numbers) > MAX_CELLS:
        raise RoadSourceError(
            f"the roads lie in {len(numbers):,} squares of {cell_m:g} m, expected at most {MAX_CELLS:,}: "
            "give a smaller area, or check that these are roads"
        )
    ends = [numbers[np.diff(numbers, prepend=-2) > 1], numbers[np.diff(numbers, append=numbers[-1] + 2) > 1]]
    low, high = (np.stack(np.divmod(end, rows), axis=1) + corner for end in ends)
    return np.hstack([low, high + 1]) * cell_m


def _hulls(lines: AnyArray, parts: AnyArray, width_m: float = 10.0) -> AnyArray:
    """Return the convex hull of the roads that meet each part, as wide as a road where they lie in one line."""
    import shapely

    part, line = shapely.STRtree(lines).query(parts, predicate="intersects")
    hulls = [shapely.convex_hull(shapely.multilinestrings(lines[line[part == n]])) for n in range(len(parts))]
    return np.asarray(shapely.buffer(hulls, width_m, cap_style="square", join_style="mitre"))
