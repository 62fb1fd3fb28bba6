"""Parts of a scan beyond its map: solid margins, the line around the map, and captions outside it.

All of it would be taken for roads. A margin is solid along a whole side. The line around a map (its neat line) is
straight over most of the sheet, on three sides at least, and no road crosses it: a street as straight has others that
go on beyond it. A caption is a strip of small marks, with an empty strip between them and the map.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from roadgeo._arrays import BoolArray, FloatArray

__all__ = ["find_border"]

#: Rows of a margin, at least; rows and columns of one are road by at least this share.
_LEAST_DEPTH, _SOLID = 3, 0.9
#: Largest share of the sheet's side that is cut from one side.
_MOST = 0.3
#: Sheets lie askew on a scanner by no more.
_MAX_TURN_DEG = 2.5
#: Share of a side that the line around the map must cover, and where there may be road just beyond it; number of sides
#: that must have a line.
_LEAST_LINE, _MOST_CROSSED, _LEAST_SIDES = 0.6, 0.004, 3
#: Number of marks in a caption; each is no wider than this share of the sheet.
_LEAST_MARKS, _MAX_MARK = 6, 0.12
#: Larger sheets are reduced to this side before they are looked at.
_MAX_SIDE = 800


@dataclass(frozen=True)
class _Line:
    """A side's line as seen from that side, in pixels: `depth` of its inner edge in the middle, and its slope."""

    depth: float
    slope: float


def find_border(roads: BoolArray, road_width_px: float) -> BoolArray | None:
    """Return which pixels of a sheet lie on its map, (H, W) bool; None where all of them may.

    Parameters
    ----------
    roads : (H, W) bool
    road_width_px : float
    """
    factor = max(1, -(-max(roads.shape) // _MAX_SIDE))
    small = _reduced(roads, factor)
    width = max(road_width_px / factor, 1.0)
    on_map = np.ones(small.shape, np.bool_)
    for turns in range(4):  # as seen from each side: a margin's first row is row 0
        side = np.rot90(on_map, turns)
        side[: _solid_depth(np.rot90(small, turns))] = False
    for turns in range(4):
        side = np.rot90(on_map, turns)
        side[: _caption_depth(np.rot90(small & on_map, turns), width)] = False
    for turns, line in _find_lines(small & on_map, width):
        _cut(np.rot90(on_map, turns), line)
    if on_map.all() or not (small & on_map).any():
        return None
    height, wide = roads.shape
    if factor > 1:
        on_map = cv2.resize(on_map.view(np.uint8), (wide, height), interpolation=cv2.INTER_NEAREST).astype(np.bool_)
    return on_map


def _reduced(roads: BoolArray, factor: int) -> BoolArray:
    """Reduce a sheet; a pixel shows road where any of those it stands for does."""
    if factor == 1:
        return roads
    size = (-(-roads.shape[1] // factor), -(-roads.shape[0] // factor))
    return np.asarray(cv2.resize(roads.view(np.uint8) * np.uint8(255), size, interpolation=cv2.INTER_AREA) > 0)


def _solid_depth(roads: BoolArray) -> int:
    """Return the rows of a solid margin, 0 for none; its ragged edge belongs to it."""
    if (roads[:_LEAST_DEPTH].mean(axis=1) < _SOLID).any():
        return 0
    share = roads[: int(_MOST * len(roads))].mean(axis=1)
    solid = share >= _SOLID
    depth = int(np.argmin(solid)) if not solid.all() else 0
    if depth < _LEAST_DEPTH:
        return 0
    ragged = share[depth : depth + max(3, depth // 4)] >= 0.5
    return depth + (int(np.flatnonzero(ragged)[-1]) + 1 if ragged.any() else 0)


def _caption_depth(roads: BoolArray, width: float) -> int:
    """Return the rows of a strip of small marks, with the empty strip between them and the map; 0 for none."""
    height, wide = roads.shape
    empty = ~roads[: int(_MOST * height)].any(axis=1)
    shown = np.flatnonzero(~empty)
    if not len(shown):
        return 0
    gap = max(2.0 * width, 6.0)
    starts = np.flatnonzero(np.diff(np.concatenate(([False], empty, [False])).astype(np.int8)) == 1)
    stops = np.flatnonzero(np.diff(np.concatenate(([False], empty, [False])).astype(np.int8)) == -1)
    inner = [stop for start, stop in zip(starts, stops, strict=True) if start > shown[0] and stop - start >= gap]
    for depth in sorted(inner, reverse=True):
        _, _, boxes, _ = cv2.connectedComponentsWithStats(roads[:depth].astype(np.uint8))
        marks = boxes[1:]
        small = marks[:, cv2.CC_STAT_WIDTH] <= _MAX_MARK * wide
        if len(marks) >= _LEAST_MARKS and small.all():
            return int(depth)
    return 0


def _find_lines(roads: BoolArray, width: float) -> list[tuple[int, _Line]]:
    """Return the lines of sides, by the quarter turns that bring them to the top; none where too few sides have one."""
    sides: list[tuple[int, _Line]] = []
    for turns in range(4):
        line = _find_line(np.rot90(roads, turns), width)
        if line is not None:
            sides.append((turns, line))
        elif turns + 1 - len(sides) > 4 - _LEAST_SIDES:
            return []
    return sides


def _find_line(roads: BoolArray, width: float) -> _Line | None:
    """Return the innermost line along the first rows that no road crosses, or None."""
    beyond = round(1.5 * width) + 1
    slopes = np.tan(np.radians(np.linspace(-_MAX_TURN_DEG, _MAX_TURN_DEG, 21)))
    candidates: list[tuple[float, _Line]] = []
    covers = _covers(roads, int(_MOST * len(roads)), slopes)
    able = (covers >= _LEAST_LINE).any(axis=1)
    for slope, cover in zip(slopes[able], covers[able], strict=True):
        line = _innermost(cover, beyond)
        if line is not None:
            candidates.append((float(cover[line]), _Line(line + 1.0, float(slope))))
    if not candidates:
        return None
    best = max(cover for cover, _ in candidates)
    return max((line for cover, line in candidates if cover >= 0.97 * best), key=lambda line: line.depth)


def _covers(roads: BoolArray, deep: int, slopes: FloatArray) -> FloatArray:
    """Return which share of each of the first `deep` rows is road, rows sloping by `slopes` (S,): (S, deep)."""
    wide = roads.shape[1]
    shifts = np.rint(slopes[:, None] * (np.arange(wide) - wide / 2)).astype(np.int64)
    most = int(np.abs(shifts).max())
    # Columns that are shifted alike are counted at once, by sums over all columns before them.
    sums = np.zeros((wide + 1, deep + 2 * most), np.int32)
    np.cumsum(np.ascontiguousarray(roads[:deep].T), axis=0, out=sums[1:, most : most + deep])
    windows = np.lib.stride_tricks.sliding_window_view(sums, deep, axis=1)
    shifts += most
    slope, starts = np.nonzero(np.diff(shifts, axis=1, prepend=-1))
    stops = np.append(starts[1:], 0)
    stops[stops == 0] = wide  # the next slope begins
    shift = shifts[slope, starts]
    runs = windows[stops, shift] - windows[starts, shift]
    return np.asarray(np.add.reduceat(runs, np.flatnonzero(starts == 0)) / wide)


def _innermost(cover: FloatArray, beyond: int) -> int | None:
    """Return the last row of the innermost line that nothing crosses, of the share (D,) of each row that is road."""
    on_line = cover >= _LEAST_LINE
    for last in np.flatnonzero(on_line[:-1] & ~on_line[1:])[::-1]:  # where a line ends, seen from outside
        first = int(last)
        while first > 0 and cover[first - 1] > _MOST_CROSSED:
            first -= 1
        # Just beyond the line there is nothing; or the line is the end of the sheet.
        outside = cover[max(first - beyond, 0) : first]
        is_clear = (outside <= _MOST_CROSSED).all() if first else cover[0] >= _LEAST_LINE
        if last - first <= 3 * beyond and is_clear:
            return int(last)
    return None


def _cut(on_map: BoolArray, line: _Line) -> None:
    """Clear what lies beyond a line, and the line."""
    height, wide = on_map.shape
    depth = np.ceil(line.depth + 1.0 + line.slope * (np.arange(wide) - wide / 2))
    on_map &= np.arange(height)[:, None] >= depth
