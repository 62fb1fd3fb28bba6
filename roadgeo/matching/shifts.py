"""The places where a mask's roads run on roads of the map: shifts and turns of a start.

The roads around the frame are drawn on a coarse raster, a layer for each of 16 directions. A road point of the query
reads the layer of its own direction: the layer around its place answers for all shifts at once, and the sum over all
points counts the points on roads under each shift (a generalised Hough transform; Ballard 1981). Turns are tried one by
one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, FloatArray
from roadgeo.geometry.homography import Homography
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.scene import N_ROUGHLY, ROAD_TURN, Scene

__all__ = [
    "Drawn",
    "LocalSearchOptions",
    "Shift",
    "move_about",
    "search_nearby",
    "shifted",
]


#: Layers that were drawn and the corner of their first cell, by the middle and the reach.
Drawn: TypeAlias = dict[tuple[float, ...], tuple[AnyArray, FloatArray]]

_DIRECTIONS = 16


#: A place nearer than this to a better place, metres, is the same place.
SAME_M = 30.0
#: Side of the raster's cells, and step of the shifts, metres; and width of the roads that are drawn: the motion of a
#: point by a step of shift and of turn must fit in.
_CELL_M, _ROAD_M = 10.0, 20.0


@dataclass(frozen=True)
class LocalSearchOptions:
    """The reach of a local search.

    Attributes
    ----------
    reach_m : float
        Greatest shift, east and north.
    turn_deg : float
        Greatest turn, either way.
    n_places : int
        Places returned.
    """

    reach_m: float = 350.0
    turn_deg: float = 6.0
    n_places: int = 40


@dataclass(frozen=True)
class Shift:
    """A place near the start: metres east and north, degrees clockwise, scale, and the share of points on roads."""

    east_m: float
    north_m: float
    turn_deg: float
    scale: float
    share: float


def move_about(center: FloatArray, shift: Shift) -> FloatArray:
    """Return the (3, 3) similarity that turns and scales the plane about a point (2,), and then shifts it."""
    turn = -math.radians(shift.turn_deg)
    a, b = shift.scale * math.cos(turn), shift.scale * math.sin(turn)
    linear = np.array([[a, -b], [b, a]])
    to = center - linear @ center + np.array([shift.east_m, shift.north_m])
    return np.array([[a, -b, to[0]], [b, a, to[1]], [0.0, 0.0, 1.0]])


def shifted(matrix: FloatArray, east_m: float, north_m: float) -> FloatArray:
    """Return a place (3, 3) moved on the map."""
    return np.array([[1.0, 0.0, east_m], [0.0, 1.0, north_m], [0.0, 0.0, 1.0]]) @ matrix


def search_nearby(
    start: FloatArray,
    scene: Scene,
    index: ReferenceIndex,
    options: LocalSearchOptions | None = None,
    drawn: Drawn | None = None,
) -> list[Shift]:
    """Return the best places near a start, the best first.

    Parameters
    ----------
    start : (3, 3) float64
        Query plane to reference plane.
    drawn : Drawn, optional
        Keeps the roads that were drawn, for starts about the same middle, by the same options.
    """
    options = options or LocalSearchOptions()
    thin = max(1, len(scene.points) // N_ROUGHLY)
    to_map = Homography(start)
    points = to_map(scene.points[::thin])
    ends = to_map(scene.points[::thin] + scene.directions[::thin])
    finite = np.isfinite(points).all(axis=1) & np.isfinite(ends).all(axis=1)
    points, ends = points[finite], ends[finite]
    center = to_map(scene.center)
    frame = to_map(scene.corners)
    if not len(points) or not np.isfinite(frame).all():
        return []
    radius = float(np.hypot(*(frame - center).T).max())
    drawn, reach_m = {} if drawn is None else drawn, radius + options.reach_m
    key = (*np.round(center, 3).tolist(), round(reach_m, 3))
    layers, origin = drawn[key] = drawn.get(key) or _draw_layers(index, center, reach_m)
    best: list[Shift] = []
    for turn in _turns(radius, options):
        turned = Homography(move_about(center, Shift(0.0, 0.0, turn, 1.0, 0.0)))
        best += _best_shifts(layers, origin, turned(points), turned(ends), turn, options)
    return _distinct(best, options)


def _turns(radius_m: float, options: LocalSearchOptions) -> FloatArray:
    """Return the turns to try: from turn to turn the frame's corners move by less than a road's width."""
    step = min(math.degrees(0.8 * _ROAD_M / radius_m), 1.5)
    n = math.ceil(options.turn_deg / step)
    return np.asarray(np.linspace(-options.turn_deg, options.turn_deg, 2 * n + 1))


def _draw_layers(index: ReferenceIndex, center: FloatArray, reach_m: float) -> tuple[AnyArray, FloatArray]:
    """Draw the roads around a point: (16, rows, columns) uint8, 1 on roads; and the first cell's corner (2,)."""
    cell = _CELL_M
    side = math.ceil(2.0 * (reach_m + 2.0 * cell) / cell)
    origin = center - side * cell / 2.0
    a, b = index.segments[:, :2].astype(float) - origin, index.segments[:, 2:].astype(float) - origin
    outside = (np.minimum(a, b) > side * cell).any(axis=1) | (np.maximum(a, b) < 0.0).any(axis=1)
    a, b = a[~outside], b[~outside]
    angle = np.arctan2(*(b - a).T[::-1]) % math.pi
    lines = np.round(np.stack((a, b), axis=1) / cell * 16.0 - 8.0).astype(np.int32)  # 1/16 cells from cell centres
    layers = np.zeros((_DIRECTIONS, side, side), np.uint8)
    for d, layer in enumerate(layers):
        away = np.abs((d + 0.5) * math.pi / _DIRECTIONS - angle)
        chosen = lines[np.minimum(away, math.pi - away) <= ROAD_TURN]
        cv2.polylines(layer, list(chosen), False, 1, max(1, round(_ROAD_M / cell)), cv2.LINE_8, 4)
    return layers, origin


def _best_shifts(
    layers: AnyArray,
    origin: FloatArray,
    points: FloatArray,
    ends: FloatArray,
    turn: float,
    options: LocalSearchOptions,
) -> list[Shift]:
    """Return the best shifts of a turn."""
    reach, side = round(options.reach_m / _CELL_M), layers.shape[1]
    cells = np.floor((points - origin) / _CELL_M).astype(int) - reach
    angle = np.arctan2(*(ends - points).T[::-1]) % math.pi
    direction = np.minimum((angle / math.pi * _DIRECTIONS).astype(int), _DIRECTIONS - 1)
    span = 2 * reach + 1
    inside = (cells >= 0).all(axis=1) & (cells + span <= side).all(axis=1)
    votes, some = np.zeros((span, span), np.uint16), np.zeros((span, span), np.uint8)
    for n, ((column, row), d) in enumerate(zip(cells[inside].tolist(), direction[inside].tolist(), strict=True), 1):
        some += layers[d, row : row + span, column : column + span]
        if n % 255 == 0:  # a byte is full; they are added several times as fast
            votes += some
            some[:] = 0
    votes += some
    peaks = votes == cv2.dilate(votes, np.ones((5, 5), np.uint8))
    most = 4 * options.n_places  # several cells of a peak may be equal
    at_least = np.cumsum(np.bincount(votes[peaks], minlength=1)[::-1])[::-1]  # peaks with at least each number of votes
    rows, columns = np.nonzero(peaks & (votes >= max(int((at_least >= most).sum()) - 1, 0)))
    away = np.hypot(rows - reach, columns - reach)  # the nearest of equal peaks: where blocks repeat, a neighbour
    order = np.lexsort((away, -votes[rows, columns].astype(int)))[:most]
    return [
        Shift((c - reach) * _CELL_M, (r - reach) * _CELL_M, turn, 1.0, int(votes[r, c]) / len(points))
        for r, c in zip(rows[order].tolist(), columns[order].tolist(), strict=True)
    ]


def _distinct(shifts: list[Shift], options: LocalSearchOptions) -> list[Shift]:
    """Return the best shifts that lie apart from better ones."""
    kept: list[Shift] = []
    for shift in sorted(shifts, key=lambda shift: (-shift.share, math.hypot(shift.east_m, shift.north_m))):
        if all(math.hypot(shift.east_m - k.east_m, shift.north_m - k.north_m) >= SAME_M for k in kept):
            kept.append(shift)
        if len(kept) == options.n_places:
            break
    return kept
