"""Where a mask shows two roads, and the map has one between them: carriageways that were made one road.

Either is as near to the map's road as the other. A fit that lays one on it is off by half of how far they are apart,
and surer than it should be; so their middle is laid there.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from roadgeo._arrays import FloatArray, IntArray
from roadgeo.geometry.homography import Homography
from roadgeo.kernels.parallel_roads import roads_alongside
from roadgeo.kernels.residuals import road_residuals
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.merged_roads import nearest_of, points_on_map
from roadgeo.matching.refinement import Refined, RefineOptions, refine
from roadgeo.matching.scene import Scene

__all__ = ["between_carriageways", "refine_between", "weight_on_roads"]

#: Roads at these distances, metres, may be one on the map, if it has one for both: nearest points, seen from the two,
#: that lie within this part of how far they are apart.
_APART_M, _ONE = (3.0, 30.0), 0.35
#: The nearest point beside one lies within half the way to the next along the road, or a little more.
_BESIDE = 0.55
#: Intersections within this multiple of that distance are of such a road: the map has them in the middle too.
_NEAR = 2.0
#: A smaller share of the points does not bend a fit.
_FEW = 0.03
#: The middle depends on the fit, and the fit on the middle: first about this many points are used, then all.
_ROUNDS = (200, None)
#: Points within this many standard deviations of a road lie on it.
_ON_ROADS = 4.0


def refine_between(
    refined: Refined, scene: Scene, index: ReferenceIndex, matched: IntArray, options: RefineOptions
) -> tuple[Refined, Scene]:
    """Refine a homography once more where the map has one road for two of the mask.

    Return it and the scene with road points between the two, or what was given where there are few, or where no more of
    the points lie on roads so: a false road beside a true one looks alike.
    """
    found, seen = refined, scene
    for n_points in _ROUNDS:
        moved, left = between_carriageways(found.matrix, scene, index, matched, options.max_turn_deg)
        again = None if moved is scene else refine(found.matrix, moved, index, left, options, n_points, held=True)
        if again is None:
            return refined, scene
        found, seen = again, moved
    before = weight_on_roads(refined.matrix, scene, index, options)
    better = weight_on_roads(found.matrix, seen, index, options) >= before
    return (found, seen) if better else (refined, scene)


def between_carriageways(
    matrix: FloatArray, scene: Scene, index: ReferenceIndex, matched: IntArray, max_turn_deg: float
) -> tuple[Scene, IntArray]:
    """Return the scene with road points halfway between two roads where the map has one; itself if there are few.

    The matches (N,) come without those at such points.
    """
    if not len(scene.points):
        return scene, matched
    min_cos = math.cos(math.radians(max_turn_deg))
    at, along, gsd = points_on_map(matrix, scene)
    across, step_px = np.empty_like(at), scene.road_length_px / len(at)
    roads_alongside(at, along, _BESIDE * step_px * gsd, *_APART_M, min_cos, across)
    apart = np.hypot(*across.T)
    reach = np.where(np.isfinite(apart), apart, 0.0) + _APART_M[0]
    feet = [_nearest(start, along, reach, min_cos, index) for start in (at, at + across)]
    one = np.hypot(*(feet[0] - feet[1]).T) < _ONE * apart  # not where anything is NaN
    if one.mean() < _FEW:
        return scene, matched
    points = scene.points.copy()
    points[one] = Homography(matrix).inverse().everywhere(at[one] + 0.5 * across[one])
    there = nearest_of(scene.intersections.xy, scene.points, np.flatnonzero(one), _NEAR * step_px) >= 0
    return replace(scene, points=points), np.where(there, -1, matched)


def weight_on_roads(matrix: FloatArray, scene: Scene, index: ReferenceIndex, options: RefineOptions) -> float:
    """Return the sum of the road points' weights in a fit of a view from straight above."""
    at, along, gsd = points_on_map(matrix, scene)
    sigma = math.hypot(options.sigma_m, options.sigma_px * float(np.median(gsd)))
    found = np.empty((len(at), 3))
    min_cos = math.cos(math.radians(options.max_turn_deg))
    road_residuals(at, along, np.full(len(at), _ON_ROADS * sigma), min_cos, index.road_buckets, found)
    return float(np.nansum(1.0 / (1.0 + (found[:, 0] / sigma) ** 2)))


def _nearest(at: FloatArray, along: FloatArray, reach: FloatArray, min_cos: float, index: ReferenceIndex) -> FloatArray:
    """Return the nearest points (S, 2) on roads of the map that run along points (S, 2); NaN beyond `reach` (S,)."""
    found = np.empty((len(at), 3))
    road_residuals(np.ascontiguousarray(at), along, reach, min_cos, index.road_buckets, found)
    return np.asarray(at + found[:, :1] * found[:, 1:])
