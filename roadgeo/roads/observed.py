"""Ground that a mask cannot show: the black corners that a warped image leaves in its frame.

A mask is black where no road is, too. A warped frame is recognised by its straight sides: beyond them lies no road
at all, and along them road after road ends on the same line.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from roadgeo._arrays import BoolArray, FloatArray

__all__ = ["find_voids"]

#: Roads that must end on one line before anything is cut at all, and on every further line.
SURE_ENDS, LEAST_ENDS = 5, 4
#: How far the ends may lie off their line, pixels.
_STRAIGHTNESS_PX = 1.5
#: Length of the line between the outermost ends, as a share of the frame's shorter side.
_MIN_LENGTH = 0.12
#: Beyond a line with this share of the frame, fewer roads need end on it: of 360 masks without a void 31 had one on
#: which 3 roads end, and at most 0.07 of the frame lay beyond any of them. One of 55 real masks had a line with 3 ends
#: beside a wood, 0.33 of the frame's side long.
_WIDE, _WIDE_ENDS, _WIDE_LENGTH = 0.15, 3, 0.45
#: Largest share of the frame that may lie beyond one line.
_MAX_CUT = 0.75


@dataclass(frozen=True)
class _Side:
    """A line that has all roads on one side; pixels, corner convention."""

    start: FloatArray
    along: FloatArray  # unit vector
    outwards: FloatArray  # unit vector
    length: float
    bulge: float  # how far roads reach beyond the line


def find_voids(roads: BoolArray, road_width_px: float) -> BoolArray | None:
    """Return which pixels were observed, or None where all of them may have been.

    Parameters
    ----------
    roads : (H, W) bool
    road_width_px : float

    Returns
    -------
    (H, W) bool or None
    """
    sides = _sides(_hull(roads), roads.shape)
    ends = [_count_ends(roads, side, road_width_px) for side in sides]
    is_warped = max(ends, default=0) >= SURE_ENDS
    observed = np.ones(roads.shape, np.bool_)
    for side, n in zip(sides, ends, strict=True):
        is_long = n >= _WIDE_ENDS and side.length >= _WIDE_LENGTH * min(roads.shape)
        if n >= LEAST_ENDS or is_long:
            least = 0.0 if is_warped and n >= LEAST_ENDS else _WIDE
            _cut(observed, side, least, _MAX_CUT)
    return None if observed.all() else observed


def _cut(observed: BoolArray, side: _Side, least: float, most: float) -> None:
    """Clear (H, W) the pixels whose centres lie beyond a side, if they are a share from `least` to `most` of all."""
    height, width = observed.shape
    slope_x, slope_y = side.outwards
    room = (
        -(np.arange(height) + 0.5 - side.start[1]) * slope_y
    )  # column x lies beyond where (x - start) * slope_x > room
    if abs(slope_x) > 1e-6:
        edge = np.clip(np.rint(side.start[0] + room / slope_x), 0, width).astype(np.int64)
    else:
        edge = np.where(room >= 0, width, 0)
    from_right = slope_x >= 0 or abs(slope_x) <= 1e-6
    beyond = (width - edge if from_right else edge) / width
    if not least <= beyond.mean() <= most:
        return
    for row in np.flatnonzero(beyond):
        if from_right:
            observed[row, edge[row] :] = False
        else:
            observed[row, : edge[row]] = False


def _hull(roads: BoolArray) -> FloatArray:
    """Return the convex hull (V, 2) around all road pixels, clockwise as seen in the image."""
    rows = np.flatnonzero(roads.any(axis=1))
    left = roads.argmax(axis=1)[rows]
    mirrored = cv2.flip(roads.view(np.uint8), 1).view(np.bool_)  # backwards, `argmax` looks at one pixel at a time
    right = roads.shape[1] - mirrored.argmax(axis=1)[rows]
    ends = [np.stack((x, y), axis=1) for x in (left, right) for y in (rows, rows + 1)]
    hull = cv2.convexHull(np.concatenate(ends).astype(np.int32), clockwise=False)  # OpenCV thinks of y upwards
    return np.asarray(hull[:, 0], np.float64)


def _sides(hull: FloatArray, shape: tuple[int, ...]) -> list[_Side]:
    """Return the straight stretches of a hull that are not the frame itself, longest first, apart from each other."""
    n = len(hull)
    stretches = []
    for i in range(n):
        longest = None
        for k in range(1, n):
            side = _side(hull[(i + np.arange(k + 1)) % n])
            if side.bulge > _STRAIGHTNESS_PX:
                break
            longest = (side.length, i, k, side)
        if longest is not None:
            stretches.append(longest)
    stretches.sort(key=lambda stretch: -stretch[0])
    taken = np.zeros(n, bool)
    sides = []
    for length, i, k, side in stretches:
        steps = (i + np.arange(k)) % n
        if length < _MIN_LENGTH * min(shape):
            break
        if taken[steps].any():
            continue
        taken[steps] = True
        if not _on_frame(side, shape):
            sides.append(side)
    return sides


def _side(points: FloatArray) -> _Side:
    """Return the line from the first to the last of some hull points."""
    chord = points[-1] - points[0]
    length = float(np.hypot(*chord))
    along = chord / length
    outwards = np.array([along[1], -along[0]])
    return _Side(points[0], along, outwards, length, float(((points - points[0]) @ outwards).max()))


def _on_frame(side: _Side, shape: tuple[int, ...]) -> bool:
    """Return whether a side lies along the frame, within 2 px."""
    ends = np.stack((side.start, side.start + side.length * side.along))
    gaps = np.concatenate((ends, np.array(shape[::-1]) - ends), axis=1)
    return bool((gaps.max(axis=0) < 2.5).any())


def _count_ends(roads: BoolArray, side: _Side, road_width_px: float) -> int:
    """Count the roads that end at a side: seen just inside it and, still apart, most of a road width further in."""
    along = np.arange(-30.0, side.length + 30.0, 0.5)
    counts = []
    for depth in 2.0 + road_width_px * np.array(
        [0.0, 0.3, 0.6, 0.9]
    ):  # a road along the side is one wide end somewhere
        line = side.start + along[:, None] * side.along - (depth - side.bulge) * side.outwards
        columns, rows = np.floor(line).astype(np.int64).T
        inside = (columns >= 0) & (rows >= 0) & (columns < roads.shape[1]) & (rows < roads.shape[0])
        on = np.zeros(len(along) + 2, np.int8)
        on[1:-1][inside] = roads[rows[inside], columns[inside]]
        starts, stops = np.flatnonzero(np.diff(on) > 0), np.flatnonzero(np.diff(on) < 0)
        widths = 0.5 * (stops - starts) / road_width_px
        counts.append(int(((widths > 0.5) & (widths < 5.0)).sum()))
    return min(counts)
