"""A small made-up town for tests of what looks at landscapes."""

import numpy as np

from roadgeo.evaluation.landscape import Landscape
from roadgeo.geometry.projection import LocalPlane
from roadgeo.roads.graph import RoadGraph


def lattice_town(n: int = 12, spacing: float = 100.0) -> Landscape:
    """n x n streets of a lattice whose inner crossings are shifted at random, so that no place looks like another."""
    rng = np.random.default_rng(1)
    column, row = np.meshgrid(np.arange(n), np.arange(n))
    xy = spacing * np.column_stack([column.ravel(), row.ravel()]) + rng.uniform(-25, 25, (n * n, 2))
    number = np.arange(n * n).reshape(n, n)
    across = np.column_stack([number[:, :-1].ravel(), number[:, 1:].ravel()])
    along = np.column_stack([number[:-1].ravel(), number[1:].ravel()])
    edges = np.vstack([across, along])
    graph = RoadGraph.from_polylines(xy, edges, [xy[[a, b]] for a, b in edges])
    return Landscape(graph, xy[graph.degree() >= 3], LocalPlane("EPSG:32619", (300000.0, 4600000.0)))
