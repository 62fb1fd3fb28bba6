"""How much agrees at a place: intersections, roads of the query on roads of the map, and roads of the map it shows.

These shares control growth and are reported; `evidence` compares places.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from roadgeo._arrays import FloatArray, IntArray
from roadgeo.geometry.homography import Homography
from roadgeo.kernels.point_matching import match_all
from roadgeo.kernels.roads import backward_agreement, forward_distances
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.scene import Scene

__all__ = ["Agreement", "VerifyOptions", "agreement", "map_agreement", "tolerance_m"]


@dataclass(frozen=True)
class VerifyOptions:
    """Tolerances.

    Attributes
    ----------
    map_sigma_m : float
        Usual distance between a mapped road and the road.
    pixel_sigma_px : float
        Usual error of a traced road in pixels.
    """

    map_sigma_m: float = 1.8
    pixel_sigma_px: float = 1.0
    max_turn_deg: float = 25.0
    ray_tolerance_deg: float = 25.0
    backward_step_m: float = 12.0

    @property
    def ray_cos(self) -> float:
        """Cosine of the angle within which branches agree."""
        return math.cos(math.radians(self.ray_tolerance_deg))


@dataclass(frozen=True)
class Agreement:
    """Hits and trials of the three kinds of evidence."""

    matched: int
    tested: int
    forward: float
    backward: float
    n_seen: int

    @property
    def rate(self) -> float:
        """Share of intersections matched."""
        return self.matched / max(self.tested, 1)

    @property
    def mean(self) -> float:
        """Mean of the shares of intersections, of the query's roads and of the map's roads that agree."""
        return (self.rate + self.forward + self.backward) / 3


def tolerance_m(gsd_m: float, options: VerifyOptions) -> float:
    """Three standard deviations of a road's place, map and mask together, in metres."""
    return 3.0 * math.hypot(options.map_sigma_m, options.pixel_sigma_px * gsd_m)


def _bounds(matrix: FloatArray, scene: Scene) -> FloatArray:
    ground = Homography(matrix).everywhere(scene.corners)
    return np.concatenate([ground.min(axis=0), ground.max(axis=0)])


def agreement(
    matrix: FloatArray,
    scene: Scene,
    index: ReferenceIndex,
    gsd_m: float,
    seeds: IntArray,
    options: VerifyOptions,
) -> tuple[Agreement, IntArray, FloatArray]:
    """Compare query and map under `matrix`.

    `seeds` are query intersections that made the hypothesis: they are matched but not counted.

    Returns
    -------
    Agreement
    matched : (N,) int64
        Map intersection of each query intersection, or -1.
    distance : (N,) float64
        Metres between them.
    """
    tolerance = tolerance_m(gsd_m, options)
    found = scene.intersections
    matched = np.empty(len(found), np.int64)
    distance = np.empty(len(found))
    match_all(
        matrix, found.xy, scene.branches, 1.5 * tolerance, options.ray_cos, 0.0, 0.0, True,
        index.point_buckets, matched, distance,
    )  # fmt: skip
    counted = np.ones(len(found), bool)
    counted[seeds] = False
    out = np.empty(len(scene.points))
    min_cos = math.cos(math.radians(options.max_turn_deg))
    roads = index.road_buckets
    forward_distances(matrix, scene.points, scene.directions, tolerance, min_cos, 0.0, 0.0, roads, out)
    forward = float(np.average(np.isfinite(out), weights=scene.weights)) if scene.weights.any() else 0.0
    seen, shown = map_agreement(matrix, scene, index, gsd_m, options)
    result = Agreement(
        int((matched[counted] >= 0).sum()), int(counted.sum()),
        forward, shown / max(seen, 1), seen,
    )  # fmt: skip
    return result, matched, distance


def map_agreement(
    matrix: FloatArray, scene: Scene, index: ReferenceIndex, gsd_m: float, options: VerifyOptions
) -> tuple[int, int]:
    """Return how many points of the map's roads lie where the scene is observed, and how many of them it shows."""
    return backward_agreement(
        np.asarray(np.linalg.inv(matrix), float), _bounds(matrix, scene), options.backward_step_m,
        tolerance_m(gsd_m, options), 0.0, 0.0, index.road_buckets, scene.field, scene.field_scale, scene.observed,
    )  # fmt: skip
