"""The query for search, verification and refinement: intersections, road points, and the observed ground."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, BoolArray, Float32Array, FloatArray, Int32Array, IntArray
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.mask import PROBABILITY_SURE, PROBABILITY_UNKNOWN
from roadgeo.kernels.buckets import nearest_neighbours
from roadgeo.matching.index import neighbour_grid, sort_by_bucket
from roadgeo.roads.graph import RoadGraph
from roadgeo.roads.intersections import Intersections

__all__ = ["Scene", "SceneOptions", "prepare_scene", "query_neighbours", "sample_roads"]

#: A road's middle is traced within a pixel.
_NEAR = (-1, 0, 1)


@dataclass(frozen=True)
class SceneOptions:
    """Sizes of the scene's tables.

    Attributes
    ----------
    max_intersections : int
        Of more, those nearest to the middle of the frame are kept: they place a mask as surely, and time and memory
        are bounded.
    """

    max_intersections: int = 5000
    n_neighbours: int = 12
    max_road_points: int = 600
    max_dense_points: int = 6000
    min_point_spacing_px: float = 6.0
    min_dense_spacing_px: float = 3.0
    field_cells: int = 400


@dataclass(frozen=True)
class Scene:
    """One query, in the query plane (pixels, y up).

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
        The same, closer together: enough of them within a few roads of any place.
    road_length_px : float
        Length of all roads.
    n_edges : int
        Edges of the road graph.
    field : (h, w) float32
        Distance from each cell to the nearest road, in cells; rows downwards as in the image.
    field_scale : float
        Pixels per cell.
    observed : (h, w) bool
    road_width_px : float
        Usual width of the mask's roads; 0: not known.
    merged : (S,) bool or None
        Points where the mask is wider than usual, as where two roads may have merged, such as the carriageways of a
        motorway: the line between them is neither's. None: not known.
    merged_at : (N,) int64 or None
        Of each intersection the nearest such point, within two road widths; -1: none.
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
    road_width_px: float = 0.0
    merged: BoolArray | None = None
    merged_at: IntArray | None = None

    @property
    def center(self) -> FloatArray:
        """(2,) middle of the frame."""
        return Frame(*self.size).plane_center

    @property
    def corners(self) -> FloatArray:
        """(4, 2) corners TL, TR, BR, BL of the frame."""
        return Frame(*self.size).plane_corners

    @property
    def half_size(self) -> float:
        """Half the frame's diagonal in pixels."""
        return Frame(*self.size).half_diagonal

    def of_points(self, kept: BoolArray | slice) -> Scene:
        """Return the scene with some of its road points only."""
        number = np.full(len(self.points) + 1, -1)
        number[:-1][kept] = np.arange(len(self.points[kept]))
        return replace(
            self,
            points=np.ascontiguousarray(self.points[kept]),
            directions=np.ascontiguousarray(self.directions[kept]),
            weights=np.ascontiguousarray(self.weights[kept]),
            merged=None if self.merged is None else self.merged[kept],
            merged_at=None if self.merged_at is None else number[self.merged_at],
        )


def query_neighbours(xy: FloatArray, k: int) -> Int32Array:
    """(N, k) nearest neighbours of each point, in the points' own order."""
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


def _nearest(found: Intersections, center: FloatArray, most: int) -> Intersections:
    """Return the `most` intersections nearest to a point (2,), in their own order."""
    if len(found) <= most:
        return found
    kept = np.sort(np.argsort(np.hypot(*(found.xy - center).T), kind="stable")[:most])
    return found.only(kept)


def _probability_at(points: FloatArray, probability: AnyArray) -> FloatArray:
    """Return the greatest probability of road (S,) within a pixel of each point (S, 2) of the query plane."""
    height, width = probability.shape
    known = np.where(probability == PROBABILITY_UNKNOWN, np.uint8(0), probability)
    column, row = np.clip((points * (1.0, -1.0)).astype(np.int64), 0, (width - 1, height - 1)).T
    around = [known[np.clip(row + i, 0, height - 1), np.clip(column + j, 0, width - 1)] for i in _NEAR for j in _NEAR]
    return np.asarray(np.max(around, axis=0) / PROBABILITY_SURE)


def prepare_scene(
    graph: RoadGraph,
    intersections: Intersections,
    size: tuple[int, int],
    observed: BoolArray | None = None,
    options: SceneOptions | None = None,
    probability: AnyArray | None = None,
) -> Scene:
    """Prepare a vectorized mask for matching; `size` is (width, height), `observed` and `probability` (height, width).

    `probability` is that of `RoadMask`: roads that are less sure count less.
    """
    options = options or SceneOptions()
    width, height = size
    length = float(graph.edge_lengths().sum())
    # points along the roads: some for a quick look, more for one intersection's surroundings
    spacing = max(options.min_point_spacing_px, length / options.max_road_points)
    points, directions = sample_roads(graph, spacing)
    dense = sample_roads(graph, max(options.min_dense_spacing_px, length / options.max_dense_points))
    # distance of each cell of the frame to a road; drawn from the graph, so that roads thinner than a cell count too
    scale = max(1.0, max(size) / options.field_cells)
    cells = (int(np.ceil(height / scale)), int(np.ceil(width / scale)))
    canvas = np.full(cells, 255, np.uint8)
    pixels = np.round((graph.coords * (1.0, -1.0) / scale - 0.5) * 16).astype(np.int32)
    lines = [pixels[graph.offsets[e] : graph.offsets[e + 1]] for e in range(graph.n_edges)]
    cv2.polylines(canvas, lines, False, 0, 1, cv2.LINE_8, 4)
    field = np.asarray(cv2.distanceTransform(canvas, cv2.DIST_L2, 3), np.float32)
    if observed is None:
        seen = np.ones(cells, bool)
    else:
        seen = cv2.resize(observed.astype(np.uint8), cells[::-1], interpolation=cv2.INTER_AREA) > 0
    intersections = _nearest(intersections, Frame(*size).plane_center, options.max_intersections)
    k = options.n_neighbours
    neighbours = query_neighbours(intersections.xy, k) if len(intersections) else np.empty((0, k), np.int32)
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
        observed=seen,
    )
