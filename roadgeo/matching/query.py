"""A road mask becomes a query: traced, simplified, and its intersections found, by the calls that draw a reference."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path

from roadgeo._arrays import AnyArray
from roadgeo.geometry.mask import RoadMask
from roadgeo.location import Seconds
from roadgeo.matching.scene import Scene, prepare_scene
from roadgeo.roads.graph import RoadGraph
from roadgeo.roads.intersections import IntersectionOptions, find_intersections
from roadgeo.roads.simplification import SimplifyOptions, simplify
from roadgeo.roads.vectorization import vectorize

__all__ = ["Query", "read_query", "trace_query"]


#: Lengths in road widths: of a mask's roads those are one road, or one intersection, that lie so near to each other;
#: shorter ends are none; tangents are fitted to branches of this length, which begin this far from the intersection.
_MERGE, _FUSE, _STUB, _TANGENT, _SKIP, _BRANCH = 1.4, 1.0, 1.5, 4.5, 0.6, 0.8


def trace_query(mask: RoadMask) -> tuple[Scene, RoadGraph]:
    """Vectorize a mask and prepare it for matching; the same calls as for a reference, in units of its road width."""
    traced = vectorize(mask)
    width = traced.road_width_px
    near = SimplifyOptions(merge_radius=_MERGE * width, fuse_distance=_FUSE * width, stub_length=_STUB * width)
    graph = simplify(traced.graph, near)
    lengths = IntersectionOptions(
        tangent_length=_TANGENT * width, skip_length=_SKIP * width, min_branch_length=_BRANCH * width
    )
    found = find_intersections(graph, lengths)
    height, wide = mask.shape
    scene = prepare_scene(graph, found, (wide, height), mask.observed, mask.probability)
    return replace(scene, road_width_px=width), graph


@dataclass(frozen=True)
class Query:
    """A mask that was read and traced."""

    name: str
    scene: Scene
    graph: RoadGraph
    seconds: Seconds


def read_query(mask: RoadMask | AnyArray | str | Path) -> Query:
    """Read a mask, unless it is one already, and trace it.

    Raises
    ------
    MaskError
        The mask cannot be read or shows no roads.
    """
    started = time.perf_counter()
    if not isinstance(mask, RoadMask):
        from roadgeo.sources.masks import read_mask

        mask = read_mask(mask)
    read = time.perf_counter()
    scene, graph = trace_query(mask)
    return Query(mask.name, scene, graph, Seconds(read=read - started, vectorize=time.perf_counter() - read))
