"""A small road network of tests' own making: a crooked grid of streets, no kernel involved."""

from typing import Any

import numpy as np

from roadgeo.geometry.projection import LocalPlane
from roadgeo.roads.graph import RoadGraph
from roadgeo.roads.intersections import MAX_BRANCHES, Intersections
from roadgeo.roads.network import RoadNetwork, as_stored

__all__ = ["IndexParts", "grid_network", "parts", "same_values", "two_networks"]

IndexParts = tuple[dict[str, Any], dict[str, np.ndarray]]


def grid_network(columns: int = 5, rows: int = 4, seed: int = 0, **meta: Any) -> RoadNetwork:
    """Streets 120 m apart, each corner moved at random, each street with a bend."""
    rng = np.random.default_rng(seed)
    corners = np.stack(np.meshgrid(np.arange(columns), np.arange(rows), indexing="ij"), -1).reshape(-1, 2) * 120.0
    xy = corners + rng.uniform(-30, 30, corners.shape)
    number = np.arange(columns * rows).reshape(columns, rows)
    pairs = np.concatenate(
        [
            np.column_stack([number[:-1].ravel(), number[1:].ravel()]),
            np.column_stack([number[:, :-1].ravel(), number[:, 1:].ravel()]),
        ]
    )
    lines = [np.stack([xy[a], (xy[a] + xy[b]) / 2 + rng.uniform(-5, 5, 2), xy[b]]) for a, b in pairs]
    graph = RoadGraph.from_polylines(xy, pairs, lines)

    node = np.flatnonzero(graph.degree() >= 3)
    rays = np.full((len(node), MAX_BRANCHES), np.nan, np.float32)
    tangents = rays.copy()
    for i, n in enumerate(node):
        ends = [xy[b if a == n else a] - xy[n] for a, b in pairs if n in (a, b)]
        angles = np.sort([np.arctan2(y, x) for x, y in ends])
        rays[i, : len(angles)] = angles
        tangents[i, : len(angles)] = np.sort(angles % np.pi)
    residual = rng.uniform(0, 1, len(node)).astype(np.float32)
    low, high = xy.min(axis=0) - 50, xy.max(axis=0) + 50
    ring = np.array([low, [high[0], low[1]], high, [low[0], high[1]], low])
    return RoadNetwork(
        graph,
        Intersections(xy[node], rays, tangents, residual, node),
        LocalPlane("EPSG:32619", (330000.0, 4690000.0)),
        (ring,),
        {"name": "Grid, MA", "attribution": "© tests", "sources": [{"path": "grid.gpkg"}], **meta},
    )


def same_values(a: Any, b: Any) -> bool:
    """Whether two values of arrays hold the same bits, shapes and types."""
    pairs = [(getattr(a, field), getattr(b, field)) for field in a.__dataclass_fields__]
    return all(x.dtype == y.dtype and np.array_equal(x, y, equal_nan=True) for x, y in pairs)


def parts(network: RoadNetwork) -> IndexParts:
    """Stand in for an index."""
    return {"name": network.meta["name"], "n": len(network.intersections)}, {"xy": network.intersections.xy}


def two_networks() -> list[RoadNetwork]:
    return [as_stored(grid_network(size, size, seed=size)) for size in (6, 16)]
