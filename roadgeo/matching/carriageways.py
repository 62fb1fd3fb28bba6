"""Where a mask shows two roads, and the map has one between them: carriageways that were made one road.

Either is as near to the map's road as the other. A fit that lays one on it is off by half of how far they are apart,
and surer than it should be; so their middle is laid there.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from roadgeo._arrays import BoolArray, FloatArray, IntArray
from roadgeo.geometry.homography import Homography
from roadgeo.kernels.parallel_roads import roads_alongside
from roadgeo.kernels.roads import road_residuals
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.refinement import SIGMA_M, SIGMA_PX, Refined, RefineOptions, refine
from roadgeo.matching.scene import MIN_COS, Scene

__all__ = ["between_carriageways", "nearest_of", "points_on_map", "refine_between", "roads_beside"]

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
        moved, left = between_carriageways(found.matrix, scene, index, matched)
        again = None if moved is scene else refine(found.matrix, moved, index, left, options, n_points, held=True)
        if again is None:
            return refined, scene
        found, seen = again, moved
    before = weight_on_roads(refined.matrix, scene, index)
    better = weight_on_roads(found.matrix, seen, index) >= before
    return (found, seen) if better else (refined, scene)


def between_carriageways(
    matrix: FloatArray, scene: Scene, index: ReferenceIndex, matched: IntArray
) -> tuple[Scene, IntArray]:
    """Return the scene with road points halfway between two roads where the map has one; itself if there are few.

    The matches (N,) come without those at such points.
    """
    if not len(scene.points):
        return scene, matched
    at, along, gsd = points_on_map(matrix, scene)
    across, step_px = np.empty_like(at), scene.road_length_px / len(at)
    roads_alongside(at, along, _BESIDE * step_px * gsd, *_APART_M, MIN_COS, across)
    apart = np.hypot(*across.T)
    reach = np.where(np.isfinite(apart), apart, 0.0) + _APART_M[0]
    feet = [_nearest(start, along, reach, index) for start in (at, at + across)]
    one = np.hypot(*(feet[0] - feet[1]).T) < _ONE * apart  # not where anything is NaN
    if one.mean() < _FEW:
        return scene, matched
    points = scene.points.copy()
    points[one] = Homography(matrix).inverse().everywhere(at[one] + 0.5 * across[one])
    there = nearest_of(scene.intersections.xy, scene.points, np.flatnonzero(one), _NEAR * step_px) >= 0
    return replace(scene, points=points), np.where(there, -1, matched)


def weight_on_roads(matrix: FloatArray, scene: Scene, index: ReferenceIndex) -> float:
    """Return the sum of the road points' weights in a fit of a view from straight above."""
    at, along, gsd = points_on_map(matrix, scene)
    sigma = math.hypot(SIGMA_M, SIGMA_PX * float(np.median(gsd)))
    found = np.empty((len(at), 3))
    road_residuals(np.eye(3), at, along, np.full(len(at), _ON_ROADS * sigma), MIN_COS, index.road_buckets, found)
    return float(np.nansum(1.0 / (1.0 + (found[:, 0] / sigma) ** 2)))


def _nearest(at: FloatArray, along: FloatArray, reach: FloatArray, index: ReferenceIndex) -> FloatArray:
    """Return the nearest points (S, 2) on roads of the map that run along points (S, 2); NaN beyond `reach` (S,)."""
    found = np.empty((len(at), 3))
    road_residuals(np.eye(3), np.ascontiguousarray(at), along, reach, MIN_COS, index.road_buckets, found)
    return np.asarray(at + found[:, :1] * found[:, 1:])


def nearest_of(xy: FloatArray, points: FloatArray, among: IntArray, away: float) -> IntArray:
    """Return which of `points` (S, 2), `among` those numbered, lies nearest to each of `xy` (N, 2); -1: none within."""
    nearest, least = np.full(len(xy), -1), np.full(len(xy), away**2)
    for number in among:
        square = ((xy - points[number]) ** 2).sum(axis=1)
        closer = square < least
        nearest[closer], least[closer] = number, square[closer]
    return nearest


def roads_beside(
    matrix: FloatArray, scene: Scene, index: ReferenceIndex, beside_m: float, give_or_take_m: float
) -> tuple[BoolArray, BoolArray]:
    """Return which road points (S,) have a road of the map beside them that runs their way, to the right and left."""
    points, along, _ = points_on_map(matrix, scene)
    roads = index.road_buckets

    def beside(away_m: float) -> BoolArray:
        shifted, away = np.ascontiguousarray(points + away_m * along[:, ::-1] * (1.0, -1.0)), np.empty((len(points), 3))
        road_residuals(np.eye(3), shifted, along, np.full(len(points), give_or_take_m), MIN_COS, roads, away)
        return np.isfinite(away[:, 0])

    return beside(beside_m), beside(-beside_m)


def points_on_map(matrix: FloatArray, scene: Scene) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return road points on the map (S, 2), unit vectors along the roads (S, 2), and metres per pixel there (S,)."""
    to_map = Homography(matrix).facing(scene.center)
    points = np.ascontiguousarray(to_map(scene.points))
    ahead = to_map(scene.points + scene.directions) - points
    length = np.maximum(np.hypot(*ahead.T), 1e-12)
    return points, np.ascontiguousarray(ahead / length[:, None]), length
