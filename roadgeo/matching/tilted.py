"""Views from a steep angle, seen from above: what a mask may show were the camera level, judged by its roads alone.

Roads around one intersection are laid on the map by a turn and a scale. That finds views tilted by up to 40 degrees; in
steeper ones roads are foreshortened too much. Which way the camera leaned is told by the roads: towards the horizon
they crowd. So a tilt is assumed, in each of some directions, and taken out of the mask; where the density of roads then
is most even over the frame, roads vote again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from roadgeo._arrays import Float32Array, FloatArray, IntArray
from roadgeo.geometry.homography import Homography
from roadgeo.matching.foreground import before
from roadgeo.matching.scene import Scene

__all__ = ["TiltOptions", "evenness", "likely_views", "rectification", "rectify"]

#: The density of roads is compared over so many parts of each side of the frame; of roads, a little is everywhere.
_PARTS, _LEAST_DENSITY = 5, 0.1
#: Ground that was observed is sampled at every so many cells of the reduced frame.
_EVERY = 4


@dataclass(frozen=True)
class TiltOptions:
    """Which tilts are assumed.

    Attributes
    ----------
    tilt_deg, focal : float
        Of the camera that is assumed; the focal length in longer sides of the frame.
    n_directions : int
        So many directions of the horizon are compared.
    n_tried : int
        The best so many are tried, where roads then lie more evenly than in the mask as it is. Of 72 masks tilted by 40
        to 60 degrees the right direction, within 45 degrees, was among the best two for 60.
    coarser : float
        Intersections and roads take part where the view's pixels are at most so many times coarser than at the middle
        (see `foreground`): those far away are few, and seen from above they lie all over the map.
    max_anchors : int
        Intersections that vote in each view.
    """

    tilt_deg: float = 50.0
    focal: float = 1.2
    n_directions: int = 8
    n_tried: int = 2
    coarser: float = 1.6
    max_anchors: int = 20


def likely_views(scene: Scene, options: TiltOptions) -> list[FloatArray]:
    """Return homographies (3, 3) that take out the tilts that the scene most likely has; none where it looks level."""
    level = evenness(scene, np.eye(3))
    turns = [360.0 * k / options.n_directions for k in range(options.n_directions)]
    views = [rectification(scene, options.tilt_deg, turn, options.focal) for turn in turns]
    uneven = [evenness(scene, view) for view in views]
    best = np.argsort(uneven, kind="stable")[: options.n_tried]
    return [views[k] for k in best if uneven[k] < level]


def rectification(scene: Scene, tilt_deg: float, towards_deg: float, focal: float) -> FloatArray:
    """Return the homography (3, 3) that shows the ground from above; the middle stays, and the scale there.

    `towards_deg` is the direction of the horizon in the query plane, counterclockwise from x; `focal` in longer sides
    of the frame.
    """
    turn, tilt = math.radians(towards_deg), math.radians(tilt_deg)
    focal_px = focal * max(scene.size)
    to_middle = np.array([[1.0, 0.0, -scene.center[0]], [0.0, 1.0, -scene.center[1]], [0.0, 0.0, 1.0]])
    cosine, sine = math.cos(turn), math.sin(turn)
    onto_axis = np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]]) @ to_middle
    # A point u pixels up the axis is seen at the angle tilt + atan(u / f) from the vertical.
    level = np.array(
        [
            [math.cos(tilt), 0.0, focal_px * math.sin(tilt)],
            [0.0, 1.0, 0.0],
            [-math.sin(tilt) / focal_px, 0.0, math.cos(tilt)],
        ]
    )
    seen = Homography(level @ onto_axis)
    middle, linear = seen.everywhere(scene.center), seen.jacobian(scene.center)
    scale = 1.0 / math.sqrt(abs(float(np.linalg.det(linear))))
    back = np.array([[scale, 0.0, -scale * middle[0]], [0.0, scale, -scale * middle[1]], [0.0, 0.0, 1.0]])
    matrix = np.linalg.inv(onto_axis) @ back @ level @ onto_axis
    return np.asarray(matrix / (matrix[2] @ np.append(scene.center, 1.0)))


def evenness(scene: Scene, matrix: FloatArray) -> float:
    """Return the variance of the logarithm of the roads' density over the frame, as a homography shows it.

    Infinite where the horizon crosses the frame.
    """
    rows, columns = np.nonzero(scene.observed[::_EVERY, ::_EVERY])
    ground = np.asarray((np.stack([columns, rows], axis=1) + 0.5) * (1, -1) * _EVERY * scene.field_scale, float)
    points, view = scene.dense_points, Homography(matrix)
    depth, ahead = (at @ matrix[2, :2] + matrix[2, 2] for at in (ground, points))
    if min(depth.min(initial=1.0), ahead.min(initial=1.0)) <= 0.0 or not len(ground):
        return math.inf
    step = np.hypot(*(view(points + scene.dense_directions) - view(points)).T)
    area = abs(float(np.linalg.det(matrix))) / depth**3
    seen = np.bincount(_part_of(ground, scene), minlength=_PARTS**2)
    roads = np.bincount(_part_of(points, scene), step, _PARTS**2)
    there = np.bincount(_part_of(ground, scene), area, _PARTS**2)
    known = seen > 0.3 * seen.max()
    density = roads[known] / there[known] * there[known].sum() / max(roads[known].sum(), 1e-9)
    weight, logarithm = seen[known] / seen[known].sum(), np.log(density + _LEAST_DENSITY)
    return float(weight @ (logarithm - weight @ logarithm) ** 2)


def _part_of(xy: FloatArray, scene: Scene) -> IntArray:
    """Return the number of the part of the frame that each point of the query plane lies in."""
    cells = np.clip((xy * (1, -1) / np.array(scene.size) * _PARTS).astype(np.int64), 0, _PARTS - 1)
    return np.asarray(cells[:, 1] * _PARTS + cells[:, 0])


def rectify(scene: Scene, matrix: FloatArray, coarser: float = math.inf) -> Scene:
    """Return a scene whose intersections and roads are those that a homography shows; its frame is the mask's still.

    Roads where pixels are more than so many times coarser than at the middle are left out.
    """
    view, found = Homography(matrix), scene.intersections
    moved = replace(found, xy=view(found.xy), rays=_turned(view, found.xy, found.rays))
    kept = before(scene.dense_points, matrix, scene, coarser)
    points, tips = (view(at[kept]) for at in (scene.dense_points, scene.dense_points + scene.dense_directions))
    directions = (tips - points) / np.maximum(np.hypot(*(tips - points).T), 1e-12)[:, None]
    return replace(scene, intersections=moved, dense_points=points, dense_directions=directions)


def _turned(view: Homography, xy: FloatArray, rays: Float32Array) -> Float32Array:
    """Return directions (N, R) at points as a homography shows them, radians; NaN stays."""
    steps = np.stack([np.cos(rays), np.sin(rays)], axis=-1)
    tips = view((xy[:, None] + np.nan_to_num(steps)).reshape(-1, 2)).reshape(steps.shape)
    moved = tips - view(xy)[:, None]
    return np.where(np.isnan(rays), np.nan, np.arctan2(moved[..., 1], moved[..., 0])).astype(np.float32)
