"""Growth of proposals by roads alone (see `kernels.road_growth`)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from roadgeo._arrays import FloatArray
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
    """

    max_points: int = 700
    affine_until: float = 0.45
    least_share: float = 0.3
    tolerance_m: float = 7.0
    tolerance_px: float = 2.0
    perspective_sigma: float = 0.4
    max_turn_deg: float = 25.0


@dataclass(frozen=True)
class Grown:
    """A grown proposal: query plane to reference plane (3, 3), and the share of road points that lie on roads."""

    anchor: int
    matrix: FloatArray
    share: float


class RoadGrower:
    """Grows proposals of one scene on one map."""

    def __init__(self, scene: Scene, index: ReferenceIndex, options: RoadGrowOptions) -> None:
        self.scene, self.index, self.options = scene, index, options
        thin = max(1, len(scene.dense_points) // options.max_points)
        self.points, self.directions = scene.dense_points[::thin], scene.dense_directions[::thin]
        self._anchor, self._outwards = -1, (self.points, self.directions)

    def grow(self, anchor: int, reference: int, affine: FloatArray) -> Grown | None:
        """Grow from query intersection `anchor` on map intersection `reference`, laid there by `affine` (4,), 2 x 2."""
        options, half_size = self.options, self.scene.half_size
        at = self.scene.intersections.xy[anchor]
        points, directions = self._outwards_from(anchor)
        gsd = math.sqrt(affine[0] * affine[3] - affine[1] * affine[2])
        unit = half_size * gsd
        p = np.array([affine[0], affine[1], 0.0, affine[2], affine[3], 0.0, 0.0, 0.0]) / gsd
        stages = Stages(
            options.affine_until,
            options.least_share,
            options.tolerance_m + options.tolerance_px * gsd,
            options.perspective_sigma,
            math.cos(math.radians(options.max_turn_deg)),
        )
        origin = self.index.xy[reference]
        share = grow_by_roads(p, unit, origin, points, directions, stages, self.index.road_buckets)
        if share < 0.0:
            return None
        from_query = np.array([[1.0, 0.0, -at[0]], [0.0, 1.0, -at[1]], [0.0, 0.0, half_size]])
        to_reference = np.array([[unit, 0.0, origin[0]], [0.0, unit, origin[1]], [0.0, 0.0, 1.0]])
        matrix = to_reference @ np.append(p, 1.0).reshape(3, 3) @ from_query
        return Grown(anchor, np.asarray(matrix / (matrix[2] @ np.append(self.scene.center, 1.0))), share)

    def _outwards_from(self, anchor: int) -> tuple[FloatArray, FloatArray]:
        """Return the road points around an intersection, the nearest first, normalised, and the roads' directions.

        Kept: an intersection makes many proposals.
        """
        if anchor != self._anchor:
            away = self.points - self.scene.intersections.xy[anchor]
            order = np.argsort(np.hypot(*away.T), kind="stable")
            self._anchor, self._outwards = anchor, (away[order] / self.scene.half_size, self.directions[order])
        return self._outwards
