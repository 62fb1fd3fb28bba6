"""Roads to look at: a map as the camera of a simulation meets it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely

from roadgeo._arrays import AnyArray, FloatArray, IntArray
from roadgeo.geometry.pinhole import View
from roadgeo.geometry.projection import LocalPlane
from roadgeo.roads.graph import RoadGraph
from roadgeo.roads.network import RoadNetwork
from roadgeo.roads.simplification import planarize

__all__ = ["Landscape", "Strokes", "visible_intersections", "visible_strokes"]

#: Pixels around the frame that are drawn too, so that roads do not end at its border.
PAD_PX = 40


@dataclass(frozen=True)
class Landscape:
    """Roads to look at, in metres on a plane.

    Attributes
    ----------
    intersections : (N, 2) float64
        Where three branches or more meet.
    coverage : tuple of (V, 2) float64
        Closed rings around the ground where roads are known; views stay inside. Empty: the box around the roads.
    """

    graph: RoadGraph
    intersections: FloatArray
    plane: LocalPlane
    coverage: tuple[FloatArray, ...] = ()

    @classmethod
    def from_network(cls, network: RoadNetwork) -> Landscape:
        """Look at a reference's own roads."""
        return cls(network.graph, network.intersections.xy, network.plane, network.coverage)

    @classmethod
    def from_lines(cls, lines: AnyArray, plane: LocalPlane, coverage: tuple[FloatArray, ...] = ()) -> Landscape:
        """Look at lines (shapely, plane metres) as they are: two carriageways stay two."""
        graph = planarize(lines)
        return cls(graph, graph.xy[graph.degree() >= 3], plane, coverage)

    @cached_property
    def bounds(self) -> FloatArray:
        """(2, 2) lower left and upper right corner of all roads."""
        return np.array([self.graph.coords.min(axis=0), self.graph.coords.max(axis=0)])

    @cached_property
    def lines(self) -> AnyArray:
        """(E,) shapely LineString of every edge."""
        return self.graph.lines()

    def covers(self, points: FloatArray) -> bool:
        """Whether all (K, 2) points lie on ground whose roads are known."""
        low, high = self.bounds
        if ((points < low) | (points > high)).any():
            return False
        # Rings may be holes of one another: inside is where an odd number of them goes around.
        inside = shapely.contains_xy(self._rings, *points.T).sum(axis=0)
        return not self.coverage or bool((inside % 2 == 1).all())

    @cached_property
    def _rings(self) -> AnyArray:
        """(R, 1) polygons of `coverage`."""
        rings = np.array([shapely.Polygon(ring) for ring in self.coverage], object).reshape(-1, 1)
        shapely.prepare(rings)
        return rings


@dataclass(frozen=True)
class Strokes:
    """Short straight strokes of the visible roads. Dimension: S strokes, in the order of the roads.

    Attributes
    ----------
    start, end : (S, 2) float64
        Pixels, corner convention.
    length : (S,) float64
        Pixels.
    street, piece : (S,) int64
        Numbers of the edge of the graph, and of the stretch of 60 to 200 m of it, that the stroke belongs to.
    """

    start: FloatArray
    end: FloatArray
    length: FloatArray
    street: IntArray
    piece: IntArray


def visible_strokes(landscape: Landscape, view: View, rng: np.random.Generator) -> Strokes:
    """Sample the roads around the footprint every few pixels and see them through the camera."""
    low, high = view.footprint.min(axis=0), view.footprint.max(axis=0)
    pad = PAD_PX * float(view.sampling(view.corners).max())
    boxes = shapely.bounds(landscape.lines)
    near = np.flatnonzero(((boxes[:, :2] <= high + pad) & (boxes[:, 2:] >= low - pad)).all(axis=1))
    step = 8.0 * float(view.sampling(view.corners).min())
    points, owner = shapely.get_coordinates(shapely.segmentize(landscape.lines[near], step), return_index=True)
    street, steps = near[owner], np.hypot(*np.diff(points, axis=0).T)
    steps[owner[1:] != owner[:-1]] = 0.0  # the jump from one edge to the next is no road
    along = np.cumsum(np.append(0.0, steps))[: len(points)]

    pixels = view.homography.inverse()(points)
    frame = np.array(view.size_px)
    inside = np.asarray(((pixels > -PAD_PX) & (pixels < frame + PAD_PX)).all(axis=1))
    drawn = np.flatnonzero(np.equal(street[:-1], street[1:]) & inside[:-1] & inside[1:])
    cuts = np.cumsum(rng.uniform(60.0, 200.0, int(along[-1] / 60.0) + 1 if len(along) else 0))
    stretch = np.searchsorted(cuts, along)
    # A stretch that goes on in the next street is another piece there.
    changes = np.not_equal(np.diff(stretch), 0) | np.not_equal(np.diff(street), 0)
    piece = np.concatenate(([0], np.cumsum(changes)))[: len(along)]
    start, end = pixels[drawn], pixels[drawn + 1]
    return Strokes(start, end, np.hypot(*(end - start).T), street[drawn], piece[drawn])


def visible_intersections(landscape: Landscape, view: View, margin_px: float = 15.0) -> FloatArray:
    """(K, 2) pixels of the intersections in the frame; of those within 14 px of one another one is kept."""
    low, high = view.footprint.min(axis=0), view.footprint.max(axis=0)
    near = landscape.intersections[((landscape.intersections >= low) & (landscape.intersections <= high)).all(axis=1)]
    pixels = view.homography.inverse()(near)
    inside = ((pixels > margin_px) & (pixels < np.array(view.size_px) - margin_px)).all(axis=1)
    pixels = pixels[inside]
    _, first = np.unique(np.floor(pixels / 14.0), axis=0, return_index=True)
    return pixels[np.sort(first)]
