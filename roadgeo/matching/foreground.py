"""The foreground of a steep view: towards the horizon roads merge into one another, and a mask shows none of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from roadgeo._arrays import BoolArray, FloatArray, IntArray
from roadgeo.matching.hypothesis import Hypothesis
from roadgeo.matching.scene import Scene, query_neighbours

__all__ = ["Foreground", "before", "foreground"]

#: Fewer road points say little.
_LEAST_POINTS = 30


@dataclass(frozen=True)
class Foreground:
    """The part of a scene that lies before a line across the frame.

    Attributes
    ----------
    scene : Scene
        With the intersections and roads of the part; what lies behind the line is not observed.
    seeds : (M,) int64
        Those of the hypothesis's that lie in it, by their numbers there.
    """

    scene: Scene
    seeds: IntArray


def foreground(model: Hypothesis, scene: Scene, coarser: float, least_share: float) -> Foreground | None:
    """Return the ground whose pixels are at most so many times coarser than those at the middle of the frame.

    None where that is the whole frame, and where no `least_share` of its road points can lie on roads of the map, by
    what agrees in all of the frame.
    """
    if model.found is None:
        return None
    line = _line(model.matrix, scene, coarser)
    if (_side(scene.corners, line) >= 0.0).all():
        return None
    shown = _side(scene.points, line) >= 0.0
    agreeing, most = model.found.forward * scene.weights.sum(), scene.weights[shown].sum()
    if shown.sum() < _LEAST_POINTS or agreeing < least_share * most:
        return None
    kept = np.flatnonzero(_side(scene.intersections.xy, line) >= 0.0)
    seeds = model.seeds[np.isin(model.seeds, kept)]
    return Foreground(_only(scene, line, kept), np.searchsorted(kept, seeds))


def before(xy: FloatArray, matrix: FloatArray, scene: Scene, coarser: float) -> BoolArray:
    """Tell which points (N, 2) of the query plane lie in the foreground, as a homography shows the scene."""
    return _side(xy, _line(matrix, scene, coarser)) >= 0.0


def _line(matrix: FloatArray, scene: Scene, coarser: float) -> FloatArray:
    """Return the line (3,) where pixels are so many times coarser than at the middle; positive before it.

    A pixel at depth w covers an area proportional to 1 / w^3 (the homography's Jacobian).
    """
    row = matrix[2] / (matrix[2] @ np.append(scene.center, 1.0))
    return np.asarray(row - (0.0, 0.0, coarser ** (-2.0 / 3.0)))


def _side(xy: FloatArray, line: FloatArray) -> FloatArray:
    """Return how far points (N, 2) lie before a line, in its units; negative behind it."""
    return np.asarray(xy @ line[:2] + line[2])


def _only(scene: Scene, line: FloatArray, kept: IntArray) -> Scene:
    """Return a scene of what lies before a line, with the intersections `kept`."""
    rows, columns = (np.arange(n) + 0.5 for n in scene.observed.shape)
    ahead = scene.field_scale * (columns * line[0] - rows[:, None] * line[1]) + line[2] >= 0.0
    near, dense = (_side(xy, line) >= 0.0 for xy in (scene.points, scene.dense_points))
    share, xy = float(near.mean()), scene.intersections.xy[kept]
    part = scene.of_points(near)
    return replace(
        part,
        intersections=scene.intersections.only(kept),
        branches=np.ascontiguousarray(scene.branches[kept]),
        neighbours=query_neighbours(xy, scene.neighbours.shape[1]) if len(kept) else scene.neighbours[:0],
        merged_at=None if part.merged_at is None else part.merged_at[kept],
        dense_points=scene.dense_points[dense],
        dense_directions=scene.dense_directions[dense],
        road_length_px=share * scene.road_length_px,
        n_edges=round(share * scene.n_edges),
        observed=scene.observed & ahead,
    )
