"""A road mask becomes a query: traced, simplified, and its intersections found, by the calls that draw a reference."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from pathlib import Path

from roadgeo._arrays import AnyArray
from roadgeo.geometry.mask import RoadMask
from roadgeo.location import Seconds
from roadgeo.matching.merged_roads import mark_merged
from roadgeo.matching.scene import Scene, SceneOptions, prepare_scene
from roadgeo.roads.graph import RoadGraph
from roadgeo.roads.intersections import IntersectionOptions, find_intersections
from roadgeo.roads.simplification import SimplifyOptions, simplify
from roadgeo.roads.vectorization import VectorizeOptions, vectorize

__all__ = ["Query", "QueryOptions", "read_query", "trace_query"]


@dataclass(frozen=True)
class QueryOptions:
    """How a mask becomes intersections. Names ending in `_widths` count road widths."""

    vectorize: VectorizeOptions = field(default_factory=VectorizeOptions)
    merge_widths: float = 1.4
    fuse_widths: float = 1.0
    stub_widths: float = 1.5
    tangent_widths: float = 4.5
    skip_widths: float = 0.6
    branch_widths: float = 0.8
    scene: SceneOptions = field(default_factory=SceneOptions)


def trace_query(mask: RoadMask, options: QueryOptions | None = None) -> tuple[Scene, RoadGraph]:
    """Vectorize a mask and prepare it for matching; the same calls as for a reference, in units of its road width."""
    options = options or QueryOptions()
    traced = vectorize(mask, options.vectorize)
    width = traced.road_width_px
    graph = simplify(
        traced.graph,
        SimplifyOptions(
            merge_radius=options.merge_widths * width,
            fuse_distance=options.fuse_widths * width,
            stub_length=options.stub_widths * width,
        ),
    )
    found = find_intersections(
        graph,
        IntersectionOptions(
            tangent_length=options.tangent_widths * width,
            skip_length=options.skip_widths * width,
            min_branch_length=options.branch_widths * width,
        ),
    )
    height, wide = mask.shape
    scene = prepare_scene(graph, found, (wide, height), mask.observed, options.scene, mask.probability)
    return mark_merged(replace(scene, road_width_px=width), mask.roads, width), graph


@dataclass(frozen=True)
class Query:
    """A mask that was read and traced."""

    name: str
    scene: Scene
    graph: RoadGraph
    seconds: Seconds


def read_query(mask: RoadMask | AnyArray | str | Path, options: QueryOptions | None = None) -> Query:
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
    scene, graph = trace_query(mask, options)
    return Query(mask.name, scene, graph, Seconds(read=read - started, vectorize=time.perf_counter() - read))
