"""Outlines in longitude and latitude as other programs want them: cut at 180 degrees, closed over the poles.

Rings are (V, 2) float64, longitude before latitude, degrees.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from roadgeo._arrays import FloatArray

__all__ = ["bounds_of", "cut_ring", "holds_pole", "unwrap_ring"]


def holds_pole(ring: FloatArray) -> bool:
    """Whether a ring goes once around a pole; its vertices lie less than 180 degrees of longitude apart."""
    return abs(_winding(ring)) > 180.0


def unwrap_ring(ring: FloatArray) -> FloatArray:
    """Close a ring and give it longitudes without a jump, which may reach beyond 180.

    A ring around a pole begins at 180 degrees and is closed along that meridian and over the pole, which has every
    longitude.
    """
    turn = np.array([_winding(ring), 0.0])
    ring = ring[:-1] if np.array_equal(ring[0], ring[-1]) else ring
    ring = np.column_stack((np.unwrap(ring[:, 0], period=360.0), ring[:, 1]))
    ring = np.vstack((ring, ring[0] + turn))
    if turn[0] == 0.0:
        return ring
    pole = math.copysign(90.0, float(ring[:, 1].mean()))
    turns = np.floor((ring[:, 0] - 180.0) / 360.0)
    i = int(np.flatnonzero(np.diff(turns))[0])  # from i to i + 1 it crosses the meridian
    east = 180.0 + 360.0 * float(turns[i : i + 2].max())
    share = (east - ring[i, 0]) / (ring[i + 1, 0] - ring[i, 0])
    first = np.array([east, ring[i, 1] + share * (ring[i + 1, 1] - ring[i, 1])])
    last = first + turn
    return np.vstack((first, ring[i + 1 :], ring[1 : i + 1] + turn, last, (last[0], pole), (first[0], pole), first))


def cut_ring(ring: FloatArray) -> list[FloatArray]:
    """Cut a ring that lies astride 180 degrees there: closed rings within -180..180, one or two."""
    whole = unwrap_ring(ring)
    whole = whole - (360.0 * math.floor((whole[:, 0].min() + 180.0) / 360.0), 0.0)
    if whole[:, 0].max() <= 180.0:
        return [whole]
    return [_clip(whole, 1.0), _clip(whole, -1.0) - (360.0, 0.0)]


def bounds_of(ring: FloatArray) -> tuple[float, float, float, float]:
    """Return west, south, east, north; west exceeds east astride 180 degrees, around a pole they are -180 and 180."""
    parts = cut_ring(ring)
    south, north = (float(f(np.concatenate(parts)[:, 1])) for f in (np.min, np.max))
    if holds_pole(ring):
        return -180.0, south, 180.0, north
    return float(parts[0][:, 0].min()), south, float(parts[-1][:, 0].max()), north


def _winding(ring: FloatArray) -> float:
    """Degrees of longitude that a ring turns by: 0, or 360 around a pole, eastwards positive."""
    steps = np.diff(ring[:, 0], append=ring[0, 0])
    return round(float(((steps + 180.0) % 360.0 - 180.0).sum()) / 360.0) * 360.0


def _clip(ring: FloatArray, side: float) -> FloatArray:
    """Clip a closed ring at 180 degrees: the part west of it (side 1) or east (-1), after Sutherland and Hodgman."""
    kept: list[FloatArray] = []
    for a, b in pairwise(ring):
        if side * (180.0 - a[0]) >= 0:
            kept.append(a)
        if (180.0 - a[0]) * (180.0 - b[0]) < 0:
            kept.append(a + (b - a) * (180.0 - a[0]) / (b[0] - a[0]))
    return np.array([*kept, kept[0]])
