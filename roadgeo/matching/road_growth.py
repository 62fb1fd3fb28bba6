"""Growth of proposals by roads alone (see `kernels.road_growth`)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from roadgeo._arrays import FloatArray, IntArray
from roadgeo.kernels.road_growth import Stages, grow_by_roads
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.scene import Scene

__all__ = ["Grown", "RoadGrowOptions", "RoadGrower"]


@dataclass(frozen=True)
class RoadGrowOptions:
    """How proposals grow by roads.

    Attributes
    ----------
    max_points : int
        Road points used.
    affine_until : float
        Part of half the frame's diagonal up to which an affine map will do.
    least_share : float
        A proposal withers where fewer of the points around it lie on roads. Wrong ones end at 0.3 to 0.4, masks of
        which 40 % are gone and 40 % false at 0.5 and more.
    tolerance_m, tolerance_px : float
        Points within their sum of a road lie on it.
    perspective_sigma : float
        Prior standard deviation of the two perspective parameters.
    go_on, sure : (int, int, int), int
        After each of the first stages so many of an intersection's proposals go on, those that lie closest to roads,
        and the `sure` ones that had most votes. Of 396 intersections of which one of 40 proposals led to the place of a
        broken mask 395 do so still, at half the time; in lattices 255 of 266, at a quarter.
    """

    max_points: int = 700
    affine_until: float = 0.45
    least_share: float = 0.3
    tolerance_m: float = 7.0
    tolerance_px: float = 2.0
    perspective_sigma: float = 0.4
    max_turn_deg: float = 25.0
    go_on: tuple[int, int, int] = (16, 6, 3)
    sure: int = 2


@dataclass(frozen=True)
class Grown:
    """A grown proposal: query plane to reference plane (3, 3), and how close to roads the road points lie, 0 to 1."""

    anchor: int
    matrix: FloatArray
    closeness: float


class RoadGrower:
    """Grows proposals of one scene on one map."""

    def __init__(self, scene: Scene, index: ReferenceIndex, options: RoadGrowOptions) -> None:
        self.scene, self.index, self.options = scene, index, options
        thin = max(1, len(scene.dense_points) // options.max_points)
        self.points, self.directions = scene.dense_points[::thin], scene.dense_directions[::thin]
        self._anchor, self._outwards = -1, (self.points, self.directions)

    def grow(self, anchor: int, references: IntArray, affines: FloatArray) -> list[Grown]:
        """Grow proposals of query intersection `anchor`; return those that did not wither, in their order.

        `references` (M,) are the map intersections that it is laid on, `affines` (M, 4) how: 2 x 2, row-major.
        """
        options, half_size = self.options, self.scene.half_size
        at = self.scene.intersections.xy[anchor]
        points, directions = self._outwards_from(anchor)
        j00, j01, j10, j11 = np.asarray(affines, float).T
        gsd = np.sqrt(j00 * j11 - j01 * j10)
        zero = np.zeros_like(gsd)
        ps = np.stack([j00 / gsd, j01 / gsd, zero, j10 / gsd, j11 / gsd, zero, zero, zero], axis=1)
        units, origins = half_size * gsd, self.index.xy[references]
        min_cos = math.cos(math.radians(options.max_turn_deg))
        stages = Stages(
            options.affine_until, options.least_share, options.perspective_sigma, min_cos, options.go_on, options.sure
        )
        tolerances = options.tolerance_m + options.tolerance_px * gsd
        closeness = np.empty(len(gsd))
        grow_by_roads(
            ps, units, origins, tolerances, points, directions, stages, self.index.road_buckets, closeness
        )  # fmt: skip
        from_query = np.array([[1.0, 0.0, -at[0]], [0.0, 1.0, -at[1]], [0.0, 0.0, half_size]])
        grown = []
        for k in np.flatnonzero(closeness >= 0.0):
            (x, y), unit = origins[k], units[k]
            to_reference = np.array([[unit, 0.0, x], [0.0, unit, y], [0.0, 0.0, 1.0]])
            matrix = to_reference @ np.append(ps[k], 1.0).reshape(3, 3) @ from_query
            matrix = matrix / (matrix[2] @ np.append(self.scene.center, 1.0))
            grown.append(Grown(anchor, np.asarray(matrix), float(closeness[k])))
        return grown

    def _outwards_from(self, anchor: int) -> tuple[FloatArray, FloatArray]:
        """Return the road points around an intersection, the nearest first, normalised, and the roads' directions.

        Kept: an intersection makes many proposals.
        """
        if anchor != self._anchor:
            away = self.points - self.scene.intersections.xy[anchor]
            order = np.argsort(np.hypot(*away.T), kind="stable")
            self._anchor, self._outwards = anchor, (away[order] / self.scene.half_size, self.directions[order])
        return self._outwards
