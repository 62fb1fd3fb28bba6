"""Replace the roads of an area in a road network, and leave the rest as it is.

Only the area and a margin around it are drawn anew. There the old roads and the fresh ones are simplified together; the
result is stitched to the old network where nothing has changed on either side, in the middle of that margin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from roadgeo._arrays import AnyArray, BoolArray, FloatArray, IntArray
from roadgeo.geometry.projection import LocalPlane, from_lonlat, to_lonlat
from roadgeo.roads.graph import RoadGraph
from roadgeo.roads.intersections import IntersectionOptions, find_intersections
from roadgeo.roads.network import RoadNetwork
from roadgeo.roads.simplification import SimplifyOptions, coverage, planarize, simplify

__all__ = ["UpdateOptions", "ground_of", "move_area", "move_lines", "replace_area", "replace_roads"]


@dataclass(frozen=True)
class UpdateOptions:
    """How old and fresh roads are joined; lengths in metres.

    Attributes
    ----------
    margin_m
        Width of the strip around the area that is simplified again with the fresh roads.
    tie_m
        Old and fresh roads that end this near each other at the border of the area are one.
    seam_m
        The same where the margin meets the untouched network: only simplifying again can have moved a road there.
    """

    margin_m: float = 300.0
    tie_m: float = 20.0
    seam_m: float = 6.0
    simplify: SimplifyOptions = field(default_factory=SimplifyOptions)
    intersections: IntersectionOptions = field(default_factory=IntersectionOptions)


def replace_area(
    network: RoadNetwork,
    lines: Sequence[Any] | AnyArray,
    area: Any,
    meta: dict[str, Any] | None = None,
    options: UpdateOptions | None = None,
) -> RoadNetwork:
    """Replace the roads inside an area by fresh ones; an area without old roads is added.

    Parameters
    ----------
    network : RoadNetwork
    lines : sequence of shapely LineString or MultiLineString
        Fresh roads in the network's plane, metres; parts outside `area` are not used.
    area : shapely Polygon or MultiPolygon
        In the network's plane, metres; see `ground_of`.
    meta : dict, optional
        Takes the place of the network's.

    Returns
    -------
    RoadNetwork
        Its intersections farther than the margin from the area are those of `network`, but for rounding.
    """
    options = options or UpdateOptions()
    graph = replace_roads(network.graph, lines, area, options)
    found = find_intersections(graph, options.intersections)
    return replace(
        network,
        graph=graph,
        intersections=found,
        coverage=tuple(coverage(graph)),
        meta=network.meta if meta is None else meta,
    )


def ground_of(lines: Sequence[Any] | AnyArray, reach_m: float = 200.0) -> Any:
    """Outline the ground that roads cover: they, the areas they enclose, and the gaps between roads near each other.

    Returns
    -------
    shapely Polygon or MultiPolygon
        No farther than a few metres from the outermost roads.
    """
    import shapely

    wide = shapely.union_all(shapely.buffer(shapely.simplify(np.asarray(lines, object), 5.0), reach_m))
    filled = shapely.union_all([shapely.Polygon(part.exterior) for part in shapely.get_parts(wide)])
    return shapely.buffer(filled, 10.0 - reach_m)


def move_lines(lines: Sequence[Any] | AnyArray, source: LocalPlane, target: LocalPlane) -> AnyArray:
    """Take shapely geometries from one plane to another."""
    import shapely

    if source == target:
        return np.asarray(lines, object)

    def move(xy: FloatArray) -> FloatArray:
        return from_lonlat(target, to_lonlat(source.crs, source.to_crs(xy)))

    return np.asarray(shapely.transform(np.asarray(lines, object), move))


def move_area(area: Any, plane: LocalPlane) -> Any:
    """Take a shapely Polygon or MultiPolygon from degrees to a plane; parts that meet at 180 degrees become one."""
    import shapely

    dense = shapely.segmentize(area, 0.01)  # the sides of a box of degrees are no straight lines on the plane
    parts = shapely.get_parts(shapely.transform(dense, lambda lonlat: from_lonlat(plane, lonlat)))
    return shapely.union_all(shapely.make_valid(parts), grid_size=0.01)


def replace_roads(
    graph: RoadGraph, lines: Sequence[Any] | AnyArray, area: Any, options: UpdateOptions | None = None
) -> RoadGraph:
    """Replace the roads of a graph inside an area; see `replace_area`."""
    import shapely

    options = options or UpdateOptions()
    old = shapely.linestrings(graph.coords, indices=np.repeat(np.arange(graph.n_edges), np.diff(graph.offsets)))
    if graph.n_edges == 0:
        old = np.empty(0, object)
    seam = shapely.buffer(area, 0.5 * options.margin_m, quad_segs=4)
    near = shapely.buffer(area, options.margin_m, quad_segs=4)
    shapely.prepare(near)

    around = _cut(old[shapely.intersects(near, old)], area, inside=False)
    fresh = _cut(np.asarray(lines, object), area, inside=True)
    ties = _tie(around, fresh, shapely.boundary(area), options.tie_m)
    drawn = simplify(planarize(np.concatenate((around, fresh, ties))), options.simplify)

    inner = _cut(np.array([shapely.LineString(line) for line in drawn.polylines()], object), seam, inside=True)
    outer = _cut(old, seam, inside=False)
    return _sew(_coords(outer), _coords(inner), seam, options.seam_m)


def _cut(whole: AnyArray, area: Any, *, inside: bool) -> AnyArray:
    """Keep the parts of lines inside an area, or outside; lines that do not cross its border stay as they are."""
    import shapely

    shapely.prepare(area)
    lines: AnyArray = shapely.get_parts(shapely.force_2d(whole))
    within = shapely.contains_properly(area, lines)
    apart = shapely.disjoint(area, lines)
    crossing = lines[~within & ~apart]
    pieces = (shapely.intersection if inside else shapely.difference)(crossing, area)
    pieces = shapely.get_parts(shapely.line_merge(pieces))
    pieces = pieces[(shapely.get_type_id(pieces) == shapely.GeometryType.LINESTRING) & (shapely.length(pieces) > 0)]
    return np.concatenate((lines[within if inside else apart], pieces))


def _tie(around: AnyArray, fresh: AnyArray, border: Any, reach: float) -> AnyArray:
    """Join roads that were cut at the border on both of its sides by short straight lines."""
    import shapely

    here, there = _loose_ends(_coords(around), border), _loose_ends(_coords(fresh), border)
    pairs = _nearest_pairs(here[:, 2:], there[:, 2:], reach)
    ties: AnyArray = shapely.linestrings(np.stack((here[pairs[:, 0], 2:], there[pairs[:, 1], 2:]), axis=1))
    return ties


def _sew(outer: list[FloatArray], inner: list[FloatArray], seam: Any, reach: float) -> RoadGraph:
    """Make one graph of the lines outside and inside a seam; those outside only move their ends at the seam."""
    import shapely

    border = shapely.boundary(seam)
    here, there = _loose_ends(outer, border), _loose_ends(inner, border)
    for i, j in _nearest_pairs(here[:, 2:], there[:, 2:], reach):
        line, end = here[i, :2].astype(int)
        outer[line][end] = there[j, 2:]
    lines = [line for line in (*outer, *inner) if len(line) > 1]
    ends = np.array([line[[0, -1]] for line in lines]).reshape(-1, 2)
    xy, number = np.unique(ends, axis=0, return_inverse=True)
    graph = RoadGraph.from_polylines(xy, number.reshape(-1, 2).astype(np.int32), lines)
    return simplify(graph, SimplifyOptions(max_passes=0))  # joins the roads through the seam, and does no more


def _coords(lines: AnyArray) -> list[FloatArray]:
    """Vertices of every line, copies."""
    import shapely

    return [shapely.get_coordinates(line) for line in lines]


def _loose_ends(lines: list[FloatArray], border: Any) -> FloatArray:
    """List the ends of lines that lie on a border: rows of line, end (0 or -1), x, y."""
    import shapely

    if not lines:
        return np.empty((0, 4))
    ends = np.concatenate([line[[0, -1]] for line in lines])
    rows = np.column_stack((np.repeat(np.arange(len(lines)), 2), np.tile((0, -1), len(lines)), ends))
    shapely.prepare(border)
    at_border: BoolArray = shapely.dwithin(border, shapely.points(ends), 1e-3)
    return rows[at_border]


def _nearest_pairs(here: FloatArray, there: FloatArray, reach: float) -> IntArray:
    """Pair points one to one, nearest first, (P, 2) rows."""
    from scipy.spatial import KDTree

    if not len(here) or not len(there):
        return np.empty((0, 2), np.int64)
    near = KDTree(here).query_ball_tree(KDTree(there), reach)
    pairs = np.array([(i, j) for i, found in enumerate(near) for j in found], np.int64).reshape(-1, 2)
    apart = np.hypot(*(here[pairs[:, 0]] - there[pairs[:, 1]]).T)
    free_here, free_there, kept = np.ones(len(here), bool), np.ones(len(there), bool), []
    for i, j in pairs[np.argsort(apart, kind="stable")]:
        if free_here[i] and free_there[j]:
            free_here[i] = free_there[j] = False
            kept.append((i, j))
    return np.array(kept, np.int64).reshape(-1, 2)
