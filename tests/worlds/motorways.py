"""Towns whose roads are two carriageways."""

from dataclasses import replace

import numpy as np
import shapely

from roadgeo.roads.graph import RoadGraph


def motorways(network, where, apart_m=14.0, sides=(1, -1)):
    """A network of which each road with its middle where `where` says is two carriageways, or one of them."""
    graph, lines = network.graph, []
    for e in range(graph.n_edges):
        line = graph.coords[graph.offsets[e] : graph.offsets[e + 1]]
        if where(line.mean(axis=0)):
            road = shapely.LineString(line)
            lines += [np.asarray(road.offset_curve(side * apart_m / 2).coords) for side in sides]
        else:
            lines.append(line)
    lines = [line for line in lines if len(line) > 1]
    ends = np.arange(2 * len(lines)).reshape(-1, 2)
    xy = np.concatenate([line[[0, -1]] for line in lines])
    return replace(network, graph=RoadGraph.from_polylines(xy, ends, lines), names=None, kinds=None)
