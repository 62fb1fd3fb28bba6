"""Slow twins of `kernels.road_raster`, `kernels.road_rings` and `kernels.road_votes`."""

import math

import numpy as np

from roadgeo.kernels.road_raster import DIRECTIONS, TILE


def distance(x, y, segment):
    """From a point to a segment."""
    a, b = np.array(segment[:2], float), np.array(segment[2:], float)
    along = b - a
    t = min(max(((x, y) - a) @ along / (along @ along), 0.0), 1.0)
    return math.hypot(*(a + t * along - (x, y)))


def bits_at(row, column, segments, x0, y0, cell, reach, turn):
    """Direction bits of one cell."""
    found = set()
    for segment in segments:
        if distance(x0 + (column + 0.5) * cell, y0 + (row + 0.5) * cell, segment) <= reach:
            angle = math.atan2(segment[3] - segment[1], segment[2] - segment[0])
            for d in range(DIRECTIONS):
                away = (d + 0.5) * math.pi / DIRECTIONS - angle
                if abs((away + math.pi / 2) % math.pi - math.pi / 2) <= turn:
                    found.add(d)
    return sum(1 << d for d in found)


def word_at(row, column, tile_of, bits):
    """Read the stored bits of one cell."""
    return int(bits[tile_of[row // TILE, column // TILE], row % TILE, column % TILE])


def wrapped(angle):
    """Modulo 2 pi, in [-pi, pi)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def find_turns(rays, directions, tolerance, same=0.17):
    """List turns that lay all branches of the poorer intersection on branches of the other, two at least."""
    turns = []
    for i, ray in enumerate(rays):
        for t, direction in enumerate(directions):
            first, gaps = direction - ray, [0.0]
            for k, other in enumerate(rays):
                away = [wrapped(d - other - first) for u, d in enumerate(directions) if u != t]
                if k != i and away and min(map(abs, away)) < tolerance:
                    gaps.append(min(away, key=abs))
            turn = first + sum(gaps) / len(gaps)
            enough = len(gaps) >= max(2, min(len(rays), len(directions)))
            if enough and all(abs(wrapped(turn - known)) >= same for known in turns):
                turns.append(wrapped(turn))
    return turns


def hits(points, s, x, y, turn, scale, raster):
    """Tell which points of scale number s meet roads."""
    out = []
    for i in range(points.starts[s], points.starts[s + 1]):
        u, v = points.offsets[i] * scale / raster.cell
        column = math.floor(x + math.cos(turn) * u - math.sin(turn) * v)
        row = math.floor(y + math.sin(turn) * u + math.cos(turn) * v)
        direction = math.floor(points.angles[i] + turn * DIRECTIONS / math.pi) % DIRECTIONS
        out.append(bool(word_at(row, column, raster.tile_of, raster.bits) >> direction & 1))
    return out


def bits_of(words, bearings=64):
    """Bits of the rings of one place, (2, rings, bearings): roads along the ring's radius, and across."""
    return (words.reshape(2, -1, 1) >> np.arange(bearings, dtype=np.uint64) & np.uint64(1)).astype(bool)


def rings_around(x, y, radii, raster, bearings=64):
    """Bits of all rings around a place."""
    found = np.zeros((2, len(radii), bearings), bool)
    for r, radius in enumerate(radii):
        for b in range(bearings):
            bearing = 2 * math.pi * (b + 0.5) / bearings
            word = word_at(
                math.floor(y + radius * math.sin(bearing)), math.floor(x + radius * math.cos(bearing)),
                raster.tile_of, raster.bits,
            )  # fmt: skip
            for d in range(DIRECTIONS):
                away = abs(wrapped(2 * ((d + 0.5) * math.pi / DIRECTIONS - bearing))) / 2
                if word >> d & 1:
                    found[int(away >= math.pi / 4), r, b] = True
    return found


def marks_of(rings, bearings, along, own, first_own, n_rings, n_bearings=64):
    """Bits of road points around an intersection."""
    found = np.zeros((2, n_rings, n_bearings), bool)
    for r, bearing, runs_along, branch in zip(rings, bearings, along, own, strict=True):
        if 0 <= r < n_rings and not (branch and r < first_own):
            found[int(not runs_along), r, math.floor(bearing / (2 * math.pi) * n_bearings) % n_bearings] = True
    return found


def beyond_chance(points, roads, turn, least=0.0):
    """How many points meet roads when they are turned, beyond those of all turns, in standard deviations.

    0 where those of every second ring do not bring more than `least` of it, the rest being left out.
    """
    met = np.roll(points, turn, axis=2) & roads
    expected = (points * roads.mean(axis=2, keepdims=True)).sum()
    sigma = math.sqrt(max(expected * (1 - expected / points.sum()), 1))
    by_some = met[:, ::2].sum() - expected * points[:, ::2].sum() / points.sum()
    return (met.sum() - expected) / sigma if by_some > least * sigma else 0.0


def ratio(met, hit_rate, rate):
    """Return the log-likelihood ratio of points that meet roads or not."""
    return sum(math.log(hit_rate / rate) if place else math.log((1 - hit_rate) / (1 - rate)) for place in met)
