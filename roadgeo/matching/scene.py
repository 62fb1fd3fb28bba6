"""The query for search, verification and refinement: intersections, road points, and the observed ground."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, BoolArray, Float32Array, FloatArray, Int32Array
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.mask import PROBABILITY_SURE, PROBABILITY_UNKNOWN, RoadMask
from roadgeo.kernels.buckets import nearest_neighbours
from roadgeo.location import Seconds
from roadgeo.matching.index import neighbour_grid, sort_by_bucket
from roadgeo.roads.graph import RoadGraph
from roadgeo.roads.intersections import IntersectionOptions, Intersections, find_intersections
from roadgeo.roads.simplification import SimplifyOptions, simplify
from roadgeo.roads.vectorization import vectorize

__all__ = [
    "AGREE_DEG",
    "APART_M",
    "FEWEST",
    "LARGE_PIXEL_M",
    "LEAST_SHARE",
    "MAX_COSTLY",
    "MIN_COS",
    "NOTICEABLE",
    "N_CLOSELY",
    "N_NEIGHBOURS",
    "N_ROUGHLY",
    "ROAD_TURN",
    "Query",
    "Scene",
    "and_pixels",
    "at_least",
    "in_pixels",
    "prepare_scene",
    "query_neighbours",
    "read_query",
    "sample_roads",
    "trace_query",
]


#: Most intersections, the nearest to the middle of the frame, which locate a mask as well and bound time and memory;
#: most of them where each takes long; and most neighbours of each.
_MAX_INTERSECTIONS, MAX_COSTLY, N_NEIGHBOURS = 5000, 1000, 12
#: Road points by which many places are compared roughly, and number of the best of these that are looked at closely.
N_ROUGHLY, N_CLOSELY = 200, 6
#: Roads nearer than this to each other, metres, err alike.
APART_M = 60.0
#: A smaller share of the roads, more or less, makes no difference; and a fit is given up with a smaller share on roads.
#: Wrong places end at 0.3 to 0.4, right ones at 0.5 and more, on masks with 40 % of the roads gone and 40 % false.
NOTICEABLE, LEAST_SHARE = 0.025, 0.3
#: Most points along the roads, and their least spacing, pixels: a few for quick comparisons, more for an intersection's
#: surroundings.
_N_POINTS, _N_DENSE, _SPACING_PX = 600, 6000, 3.0
#: Road points that a fit needs, and a scale at which roads vote.
FEWEST = 12
#: Cells of the reduced frame along its longer side.
_FIELD_CELLS = 400
#: Greatest difference of the directions of roads, or branches, that agree, degrees, and its cosine: a proposal may turn
#: the image's up by as much.
AGREE_DEG = 25.0
MIN_COS = math.cos(math.radians(AGREE_DEG))
#: Directions that differ by less from a road's belong to it, and branches that are less apart agree, radians.
ROAD_TURN = math.radians(20.0)
#: Larger pixels, metres, hardly show the surroundings of an intersection: the search around a hint `near` goes no
#: further than frames of such pixels reach, and a length on the ground is never fewer pixels than of these.
LARGE_PIXEL_M = 5.0
#: The mask's roads are traced to some pixels, as the map's are drawn to some metres: so many metres for each pixel.
_TRACED_M = 2.5


def at_least(metres: float, gsd_m: float) -> float:
    """Return a distance on the ground, or as far as roads are traced in pixels of `gsd_m` metres."""
    return metres * max(1.0, gsd_m / _TRACED_M)


def and_pixels(metres: float) -> tuple[float, float]:
    """Return a tolerance's part on the map, metres, and its part in the mask, pixels; both are added."""
    return metres, metres / _TRACED_M


def in_pixels(metres: float, gsd_m: float) -> float:
    """Return a length on the ground in pixels of `gsd_m` metres, or of `LARGE_PIXEL_M` where these are larger."""
    return metres / min(gsd_m, LARGE_PIXEL_M)


@dataclass(frozen=True, eq=False)
class Scene:
    """One query, in the query plane (pixels, y up); equal to itself only.

    Dimensions: N intersections, K neighbours, S road points, (h, w) cells of the reduced frame.

    Attributes
    ----------
    size : (width, height) in pixels.
    intersections : Intersections
    branches : (N, R, 2) int8
        As in `Intersections.branches`.
    neighbours : (N, K) int32
    points, directions : (S, 2) float64
        Points spread evenly along the roads, and unit vectors along the road.
    weights : (S,) float64
        Weight of each point where roads are compared: its probability of road, 1 where the mask has none.
    dense_points, dense_directions : (D, 2) float64
        The same with a smaller spacing, for enough points within a few roads of any place.
    road_length_px : float
        Length of all roads.
    n_edges : int
        Edges of the road graph.
    field : (h, w) float32
        Distance from each cell to the nearest road, in cells; rows downwards as in the image.
    field_scale : float
        Pixels per cell.
    observed : (h, w) bool
    probability : (h, w) float32 or None
        Mean probability of road of each cell, where the mask was made of such probabilities.
    road_width_px : float
        Usual width of the mask's roads; NaN: not known.
    """

    size: tuple[int, int]
    intersections: Intersections
    branches: AnyArray
    neighbours: Int32Array
    points: FloatArray
    directions: FloatArray
    weights: FloatArray
    dense_points: FloatArray
    dense_directions: FloatArray
    road_length_px: float
    n_edges: int
    field: Float32Array
    field_scale: float
    observed: BoolArray
    probability: Float32Array | None = None
    road_width_px: float = math.nan

    @cached_property
    def center(self) -> FloatArray:
        """(2,) middle of the frame."""
        return Frame(*self.size).plane_center

    @cached_property
    def corners(self) -> FloatArray:
        """(4, 2) corners TL, TR, BR, BL of the frame."""
        return Frame(*self.size).plane_corners

    @cached_property
    def half_size(self) -> float:
        """Half the frame's diagonal in pixels."""
        return Frame(*self.size).half_diagonal

    def of_points(self, kept: BoolArray | slice) -> Scene:
        """Return the scene with some of its road points only."""
        return replace(
            self,
            points=np.ascontiguousarray(self.points[kept]),
            directions=np.ascontiguousarray(self.directions[kept]),
            weights=np.ascontiguousarray(self.weights[kept]),
        )


def query_neighbours(xy: FloatArray, k: int) -> Int32Array:
    """(N, k) nearest neighbours of each point, in the points' own order."""
    if not len(xy):
        return np.empty((0, k), np.int32)
    grid, shape = neighbour_grid(xy, 1.0)
    order, starts = sort_by_bucket(xy, grid, shape)
    inside = nearest_neighbours(np.ascontiguousarray(xy[order]), starts, grid, shape, k)
    neighbours = np.empty_like(inside)
    neighbours[order] = np.where(inside >= 0, order[inside], -1)
    return neighbours


def sample_roads(graph: RoadGraph, spacing: float) -> tuple[FloatArray, FloatArray]:
    """Return points every `spacing` along all edges, (S, 2), and the unit directions of the roads there, (S, 2)."""
    if graph.n_edges == 0:
        return np.empty((0, 2)), np.empty((0, 2))
    steps = np.diff(graph.coords, axis=0)
    lengths = np.hypot(*steps.T)
    lengths[graph.offsets[1:-1] - 1] = 0.0  # the jump from one edge to the next is no road
    along = np.concatenate(([0.0], np.cumsum(lengths)))
    at = np.arange(spacing / 2, along[-1], spacing)
    at = at[at < along[-1]]  # `arange` may round up to its end
    segment = np.searchsorted(along, at, side="right") - 1
    fraction = (at - along[segment]) / lengths[segment]
    return graph.coords[segment] + fraction[:, None] * steps[segment], steps[segment] / lengths[segment][:, None]


def _nearest(intersections: Intersections, center: FloatArray, most: int) -> Intersections:
    """Return the `most` intersections nearest to a point (2,), in their own order."""
    if len(intersections) <= most:
        return intersections
    kept = np.sort(np.argsort(np.hypot(*(intersections.xy - center).T), kind="stable")[:most])
    return intersections.only(kept)


def _probability_at(points: FloatArray, probability: AnyArray) -> FloatArray:
    """Return the greatest probability of road (S,) within a pixel of each point (S, 2) of the query plane."""
    height, width = probability.shape
    stated = np.where(probability == PROBABILITY_UNKNOWN, np.uint8(0), probability)
    column, row = np.clip((points * (1.0, -1.0)).astype(np.int64), 0, (width - 1, height - 1)).T
    around = cv2.dilate(stated, np.ones((3, 3), np.uint8))  # a road's middle is traced within a pixel
    return np.asarray(around[row, column] / PROBABILITY_SURE)


def prepare_scene(
    graph: RoadGraph,
    intersections: Intersections,
    size: tuple[int, int],
    observed: BoolArray | None = None,
    probability: AnyArray | None = None,
) -> Scene:
    """Prepare a vectorized mask for matching; `size` is (width, height), `observed` and `probability` (height, width).

    `probability` comes from `RoadMask`: less certain roads count less.
    """
    width, height = size
    length = float(graph.edge_lengths().sum())
    points, directions = sample_roads(graph, max(_SPACING_PX, length / _N_POINTS))
    dense = sample_roads(graph, max(_SPACING_PX, length / _N_DENSE))
    # distance of each cell of the frame to a road; drawn from the graph, so that roads thinner than a cell count too
    scale = max(1.0, max(size) / _FIELD_CELLS)
    cells = (int(np.ceil(height / scale)), int(np.ceil(width / scale)))
    canvas = np.full(cells, 255, np.uint8)
    pixels = np.round((graph.coords * (1.0, -1.0) / scale - 0.5) * 16).astype(np.int32)
    lines = [pixels[graph.offsets[e] : graph.offsets[e + 1]] for e in range(graph.n_edges)]
    cv2.polylines(canvas, lines, False, 0, 1, cv2.LINE_8, 4)
    field = np.asarray(cv2.distanceTransform(canvas, cv2.DIST_L2, 3), np.float32)
    if observed is None:
        shown = np.ones(cells, bool)
    else:
        shown = cv2.resize(observed.astype(np.uint8), cells[::-1], interpolation=cv2.INTER_AREA) > 0
    intersections = _nearest(intersections, Frame(*size).plane_center, _MAX_INTERSECTIONS)
    neighbours = query_neighbours(intersections.xy, N_NEIGHBOURS)
    return Scene(
        size=size,
        intersections=intersections,
        branches=intersections.branches(),
        neighbours=neighbours,
        points=points,
        directions=directions,
        weights=np.ones(len(points)) if probability is None else _probability_at(points, probability),
        dense_points=dense[0],
        dense_directions=dense[1],
        road_length_px=length,
        n_edges=graph.n_edges,
        field=field,
        field_scale=scale,
        observed=shown,
        probability=None if probability is None else _reduced(probability, cells),
    )


def _reduced(probability: AnyArray, cells: tuple[int, int]) -> Float32Array:
    """Return the mean probability of road of each cell (h, w) of the reduced frame, 0 to 1."""
    stated = np.where(probability == PROBABILITY_UNKNOWN, np.uint8(0), probability).astype(np.float32)
    return np.asarray(cv2.resize(stated, cells[::-1], interpolation=cv2.INTER_AREA) / PROBABILITY_SURE, np.float32)


#: Lengths in road widths: roads nearer to each other are a single road, intersections nearer a single intersection;
#: shorter dead ends are dropped; tangents are fitted to branches of this length, which begin this far from the
#: intersection.
_MERGE, _FUSE, _STUB, _TANGENT, _SKIP, _BRANCH = 1.4, 1.0, 1.5, 4.5, 0.6, 0.8


def trace_query(mask: RoadMask) -> tuple[Scene, RoadGraph]:
    """Vectorize a mask and prepare it for matching; the same calls as for a reference, in units of its road width."""
    traced = vectorize(mask)
    width = traced.road_width_px
    near = SimplifyOptions(merge_radius=_MERGE * width, fuse_distance=_FUSE * width, stub_length=_STUB * width)
    graph = simplify(traced.graph, near)
    intersections = find_intersections(graph, _lengths(width))
    height, wide = mask.shape
    scene = prepare_scene(graph, intersections, (wide, height), mask.observed, mask.probability)
    return replace(scene, road_width_px=width), graph


def _lengths(width: float) -> IntersectionOptions:
    """Return how tangents are fitted to roads of a width, pixels."""
    return IntersectionOptions(
        tangent_length=_TANGENT * width, skip_length=_SKIP * width, min_branch_length=_BRANCH * width
    )


@dataclass(frozen=True)
class Query:
    """A mask that was read and traced."""

    name: str
    scene: Scene
    graph: RoadGraph
    seconds: Seconds

    def intersections_by(self, tangent_px: float) -> Intersections:
        """Return the scene's intersections with tangents of the first pixels of their branches."""
        lengths = replace(_lengths(self.scene.road_width_px), tangent_length=tangent_px, skip_length=0.0)
        detected = find_intersections(self.graph, lengths)
        return detected.only(np.flatnonzero(np.isin(detected.node, self.scene.intersections.node)))


def read_query(mask: RoadMask | AnyArray | str | Path) -> Query:
    """Read a mask, unless it is a `RoadMask` already, and trace it.

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
