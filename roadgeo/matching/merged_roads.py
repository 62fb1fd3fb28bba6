"""Where roads of a mask have merged: one wide road may be the two carriageways of a motorway.

The line that is traced of them runs between the two of the map. Were it laid on either, the frame would be off by half
their distance; so a fit does not rest on it where it has others.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from roadgeo._arrays import BoolArray, FloatArray, IntArray
from roadgeo.geometry.homography import Homography
from roadgeo.kernels.roads import forward_distances
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.scene import Scene

__all__ = ["find_merged", "mark_merged", "nearest_of", "points_on_map", "roads_beside", "without_merged"]

#: Roads have merged where a mask is wider than usual by this factor, and by this many pixels, at most for a number of
#: points in a row: at crossings it is wide as well, but not for long.
_MERGED, _LEAST_MORE, _IN_A_ROW = 1.6, 4.0, 5
#: Intersections belong to merged roads within this many road widths of their points.
_NEAR_WIDTHS = 2.0
#: The map has two roads where one lies beside a point, 3 to 23 metres from it.
_BESIDE_M, _GIVE_OR_TAKE_M = 13.0, 10.0
#: A fit needs points: where more of them have merged, they are all that there is.
_MOST = 0.5


def mark_merged(scene: Scene, roads: BoolArray, width: float) -> Scene:
    """Return the scene of a mask, its roads (H, W) usually `width` pixels wide, with its merged roads marked."""
    merged = find_merged(roads, scene.points, scene.directions, width)
    xy, away = scene.intersections.xy, _NEAR_WIDTHS * width
    return replace(scene, merged=merged, merged_at=nearest_of(xy, scene.points, np.flatnonzero(merged), away))


def find_merged(roads: BoolArray, points: FloatArray, directions: FloatArray, width: float) -> BoolArray:
    """Return at which points (S, 2) of the query plane a mask's roads (H, W) are so wide that two may have merged.

    `directions` (S, 2) run along the road; `width` is the usual one, pixels, where not most have merged.
    """
    if not len(points):
        return np.zeros(0, np.bool_)
    across, pixels = directions[:, ::-1] * (-1.0, -1.0), points * (1.0, -1.0)
    reach = np.arange(0.0, np.ceil(_MERGED * width) + 1.0)
    height, wide = roads.shape
    widths = np.zeros(len(points))
    for side in (-1.0, 1.0):
        at = np.floor(pixels[:, None] + side * reach[:, None] * across[:, None]).astype(np.int64)
        inside = ((at >= 0) & (at < (wide, height))).all(axis=2)
        column, row = np.clip(at, 0, (wide - 1, height - 1)).transpose(2, 0, 1)
        on_road = inside & roads[row, column]
        # The line may run in the narrow gap between two carriageways.
        before_it = ~np.logical_or.accumulate(on_road, axis=1) & (reach < width)
        widths += np.where(np.logical_and.accumulate(on_road | before_it, axis=1) & on_road, reach, 0.0).max(axis=1)
    usual = min(width, float(np.median(widths)))
    flags = np.pad(widths > max(_MERGED * usual, usual + _LEAST_MORE), _IN_A_ROW // 2, mode="edge")
    return np.asarray(np.lib.stride_tricks.sliding_window_view(flags, _IN_A_ROW).mean(axis=1) > 0.5)


def nearest_of(xy: FloatArray, points: FloatArray, among: IntArray, away: float) -> IntArray:
    """Return which of `points` (S, 2), `among` those numbered, lies nearest to each of `xy` (N, 2); -1: none within."""
    nearest, least = np.full(len(xy), -1), np.full(len(xy), away**2)
    for number in among:
        square = ((xy - points[number]) ** 2).sum(axis=1)
        closer = square < least
        nearest[closer], least[closer] = number, square[closer]
    return nearest


def without_merged(
    matrix: FloatArray, scene: Scene, index: ReferenceIndex, matched: IntArray, max_turn_deg: float
) -> tuple[Scene, IntArray]:
    """Return the scene, and the matches (N,), without points and intersections of merged roads; themselves if none.

    Only where the map has two roads: where it has one, the mask's is wide, or near in a steep view.
    """
    if scene.merged is None or scene.merged_at is None or not scene.merged.any():
        return scene, matched
    between = np.zeros(len(scene.points), np.bool_)
    merged = scene.of_points(scene.merged)
    right, left = roads_beside(matrix, merged, index, _BESIDE_M, _GIVE_OR_TAKE_M, max_turn_deg)
    between[scene.merged] = right | left
    if not 0.0 < between.mean() <= _MOST:
        return scene, matched
    length = scene.road_length_px * float(1.0 - between.mean())
    apart = replace(scene.of_points(~between), road_length_px=length)
    return apart, np.where((scene.merged_at >= 0) & between[scene.merged_at], -1, matched)


def roads_beside(
    matrix: FloatArray, scene: Scene, index: ReferenceIndex, beside_m: float, give_or_take_m: float, max_turn_deg: float
) -> tuple[BoolArray, BoolArray]:
    """Return which road points (S,) have a road of the map beside them that runs their way, to the right and left."""
    points, along, _ = points_on_map(matrix, scene)
    min_cos, roads = math.cos(math.radians(max_turn_deg)), index.road_buckets

    def beside(away_m: float) -> BoolArray:
        away, shifted = np.empty(len(points)), np.ascontiguousarray(points + away_m * along[:, ::-1] * (1.0, -1.0))
        forward_distances(np.eye(3), shifted, along, give_or_take_m, min_cos, 0.0, 0.0, roads, away)
        return np.isfinite(away)

    return beside(beside_m), beside(-beside_m)


def points_on_map(matrix: FloatArray, scene: Scene) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return road points on the map (S, 2), unit vectors along the roads (S, 2), and metres per pixel there (S,)."""
    to_map = Homography(matrix).facing(scene.center)
    points = np.ascontiguousarray(to_map(scene.points))
    ahead = to_map(scene.points + scene.directions) - points
    length = np.maximum(np.hypot(*ahead.T), 1e-12)
    return points, np.ascontiguousarray(ahead / length[:, None]), length
