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
from roadgeo.kernels.roads import count_residuals
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.scene import MIN_COS, Scene

__all__ = ["Agreement", "VerifyOptions", "agreement", "tolerance_m"]


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
    backward_step_m: float = 12.0


@dataclass(frozen=True)
class Agreement:
    """Hits and trials of the three kinds of evidence."""

    matched: int
    tested: int
    forward: float
    backward: float

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
    match_all(matrix, found.xy, scene.branches, 1.5 * tolerance, MIN_COS, index.point_buckets, matched, distance)
    counted = np.ones(len(found), bool)
    counted[seeds] = False
    ground, (drawn, mapped) = Homography(matrix).everywhere(scene.corners), np.empty((2, 1, 2))
    count_residuals(
        matrix, np.asarray(np.linalg.inv(matrix), float), np.concatenate([ground.min(axis=0), ground.max(axis=0)]),
        scene.points, scene.directions, scene.weights, tolerance, MIN_COS,
        options.backward_step_m, index.road_buckets, scene.field, scene.field_scale, scene.observed, math.inf, 1,
        drawn, mapped,
    )  # fmt: skip
    forward, backward = (float(near / max(near + none, 1e-9)) for near, none in (drawn[0], mapped[0]))
    n_matched, n_counted = int((matched[counted] >= 0).sum()), int(counted.sum())
    return Agreement(n_matched, n_counted, forward, backward), matched, distance
