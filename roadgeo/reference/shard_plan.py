"""Where a map is cut into shards: boxes of about as many roads each, and the ground around them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from roadgeo._arrays import IntArray
from roadgeo.geometry.projection import transformer
from roadgeo.reference.spool import Bounds, Cell

__all__ = ["ShardBox", "bounds_in_degrees", "plan_shards", "widen"]

_DEGREE_M = 111_320.0

#: First column and row of cells, and those behind the last.
_Box: TypeAlias = tuple[int, int, int, int]


@dataclass(frozen=True)
class ShardBox:
    """One shard: its name, and the ground that is its own, in units of the CRS that the lines came in."""

    name: str
    core: Bounds


def plan_shards(n_segments: Mapping[Cell, int], size: float, most: float) -> list[ShardBox]:
    """Cut the ground into boxes with at most about `most` segments each; one without roads is left out.

    Parameters
    ----------
    n_segments : mapping of cell to int
        Straight pieces of roads by cell.
    size : float
        Side of a cell, units of the CRS.
    most : float
        Segments in a box, unless it is a single cell.
    """
    cells = np.array(sorted(n_segments), np.int64).reshape(-1, 2)
    counts = np.array([n_segments[x, y] for x, y in cells.tolist()], np.int64)
    boxes = _cut(cells, counts, _bounding(cells), most) if len(cells) else []
    return [
        ShardBox(f"{x0}_{y0}_{x1 - x0}x{y1 - y0}", (x0 * size, y0 * size, x1 * size, y1 * size))
        for x0, y0, x1, y1 in boxes
    ]


def _cut(cells: IntArray, counts: IntArray, box: _Box, most: float) -> list[_Box]:
    """Halve a box along its longer side until no part holds more than `most`; together the parts cover all of it."""
    axis = 0 if box[2] - box[0] >= box[3] - box[1] else 1
    start, end = box[axis], box[axis + 2]
    if counts.sum() <= most or end - start < 2:
        return [box] if counts.sum() else []
    order = np.argsort(cells[:, axis], kind="stable")
    half = int(np.searchsorted(np.cumsum(counts[order]), counts.sum() / 2.0))
    at = min(max(int(cells[order[min(half, len(order) - 1)], axis]), start + 1), end - 1)
    low = cells[:, axis] < at
    x0, y0, x1, y1 = box
    sides: tuple[_Box, _Box] = ((x0, y0, at, y1), (at, y0, x1, y1))
    if axis == 1:
        sides = ((x0, y0, x1, at), (x0, at, x1, y1))
    return [
        part
        for side, inside in zip(sides, (low, ~low), strict=True)
        for part in _cut(cells[inside], counts[inside], side, most)
    ]


def _bounding(cells: IntArray) -> _Box:
    """Return the first column and row, and those behind the last."""
    low, high = cells.min(axis=0), cells.max(axis=0) + 1
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def widen(box: Bounds, margin_m: float, metres: float | None) -> Bounds:
    """Return a box with a margin on all sides; `metres` of a unit of its CRS, None where that is degrees."""
    x0, y0, x1, y1 = box
    if metres is not None:
        margin = margin_m / metres
        return x0 - margin, y0 - margin, x1 + margin, y1 + margin
    north = margin_m / _DEGREE_M
    widest = min(max(abs(y0), abs(y1)) + north, 89.0)
    east = north / math.cos(math.radians(widest))
    return x0 - east, y0 - north, x1 + east, y1 + north


def bounds_in_degrees(box: Bounds, crs: str) -> Bounds:
    """Return west, south, east and north of a box of some CRS; west > east astride 180 degrees."""
    return transformer(crs, "EPSG:4326").transform_bounds(*box)
