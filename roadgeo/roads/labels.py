"""Which street a road of the network is: names and kinds, handed down from the lines that it was drawn from."""

from __future__ import annotations

import numpy as np

from roadgeo._arrays import AnyArray
from roadgeo.roads.graph import RoadGraph

__all__ = ["label_roads"]

#: A road lies no further than this from the line that it was drawn from: dual carriageways are drawn in their middle.
_REACH_M = 30.0


def label_roads(
    graph: RoadGraph, lines: AnyArray, names: AnyArray | None, kinds: AnyArray | None
) -> tuple[AnyArray | None, AnyArray | None]:
    """Return the name and the kind of each road, (E,): as of the line that is nearest to its middle.

    Parameters
    ----------
    lines : (L,) object
        Shapely lines in plane metres.
    names, kinds : (L,) object or None
        Text of each line; None where no line has any.
    """
    if names is None and kinds is None:
        return None, None
    nearest = _nearest(graph, lines)
    named, classed = (
        np.append(np.full(len(lines), "", object) if column is None else column, "")[nearest]
        for column in (names, kinds)
    )
    return named, classed


def _nearest(graph: RoadGraph, lines: AnyArray) -> AnyArray:
    """Return the line nearest to the middle of each road, (E,); -1 where none is near."""
    import shapely

    nearest = np.full(graph.n_edges, -1, np.int64)
    if graph.n_edges == 0 or len(lines) == 0:
        return nearest
    middles = shapely.line_interpolate_point(graph.lines(), 0.5, normalized=True)
    edge, line = shapely.STRtree(lines).query_nearest(middles, max_distance=_REACH_M, all_matches=False)
    nearest[edge] = line
    return nearest
