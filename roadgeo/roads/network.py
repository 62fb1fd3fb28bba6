"""A reference road network: the map as a mask sees it, on its local plane; and how it is drawn from road lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from roadgeo._arrays import AnyArray, FloatArray
from roadgeo._progress import Say, say_nothing
from roadgeo.geometry.projection import LocalPlane
from roadgeo.roads.coverage import coverage
from roadgeo.roads.graph import RoadGraph
from roadgeo.roads.intersections import IntersectionOptions, Intersections, find_intersections
from roadgeo.roads.labels import label_roads
from roadgeo.roads.simplification import SimplifyOptions, planarize, simplify
from roadgeo.storage.memory import give_back_memory

__all__ = ["NetworkOptions", "RoadNetwork", "as_stored", "build_network"]


@dataclass(frozen=True)
class NetworkOptions:
    """Options of drawing a network; lengths in metres."""

    simplify: SimplifyOptions = field(default_factory=SimplifyOptions)
    intersections: IntersectionOptions = field(default_factory=IntersectionOptions)


@dataclass(frozen=True)
class RoadNetwork:
    """Everything that `REF.gpkg` stores.

    Attributes
    ----------
    graph : RoadGraph
        Roads noded at every crossing, in metres from the plane's origin.
    intersections : Intersections
        The nodes with three branches or more.
    plane : LocalPlane
        Where that plane lies on Earth.
    coverage : tuple of (V, 2) float64
        Closed rings, in plane metres, around the ground where the map knows its roads.
    meta : dict
        Plain values: name, sources, attribution, options, versions.
    names, kinds : (E,) object or None
        Name of each road's street, and its `highway`: text, "" where that is not known; for display.
    """

    graph: RoadGraph
    intersections: Intersections
    plane: LocalPlane
    coverage: tuple[FloatArray, ...] = ()
    meta: dict[str, Any] = field(default_factory=dict)
    names: AnyArray | None = None
    kinds: AnyArray | None = None


def build_network(
    lines: Sequence[Any] | AnyArray,
    plane: LocalPlane,
    meta: dict[str, Any],
    options: NetworkOptions | None = None,
    say: Say = say_nothing,
    *,
    names: AnyArray | None = None,
    kinds: AnyArray | None = None,
) -> RoadNetwork:
    """Draw road lines (shapely, in plane metres) as a mask sees them, and find their intersections.

    The network's `meta` is the one given and the options, for whoever builds its index again.

    Parameters
    ----------
    names, kinds : (L,) object, optional
        Text of each line: its street, and its `highway`.
    """
    options = options or NetworkOptions()
    say(f"cutting {len(lines):,} lines where they cross")
    graph = planarize(lines)
    give_back_memory()
    drawing = "drawing them as a mask shows them"
    graph = simplify(graph, options.simplify, lambda share: say(drawing, share))
    give_back_memory()
    rings = tuple(coverage(graph))
    detected = find_intersections(graph, options.intersections)
    names, kinds = label_roads(graph, np.asarray(lines, object), names, kinds)
    return as_stored(RoadNetwork(graph, detected, plane, rings, {**meta, "options": asdict(options)}, names, kinds))


def as_stored(network: RoadNetwork) -> RoadNetwork:
    """Round positions to the resolution of the GeoPackage, at most some nanometres away.

    An index built from the result is identical to one built from the file later.
    """
    plane = network.plane

    def rounded(xy: FloatArray) -> FloatArray:
        return plane.from_crs(plane.to_crs(xy))

    graph = replace(network.graph, xy=rounded(network.graph.xy), coords=rounded(network.graph.coords))
    intersections = replace(network.intersections, xy=rounded(network.intersections.xy))
    return replace(
        network, graph=graph, intersections=intersections, coverage=tuple(rounded(ring) for ring in network.coverage)
    )
