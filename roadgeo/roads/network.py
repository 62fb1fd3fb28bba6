"""A reference road network: the map as a mask sees it, on its local plane."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from roadgeo._arrays import AnyArray, FloatArray
from roadgeo.geometry.projection import LocalPlane
from roadgeo.roads.graph import RoadGraph
from roadgeo.roads.intersections import Intersections

__all__ = ["RoadNetwork"]


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
