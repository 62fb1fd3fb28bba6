"""Slow twins of `kernels.road_raster` and `kernels.road_votes`."""

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


def draw_turns(candidates, draws, rays, tolerance, directions, most):
    """Draw pairs of place and turn among those that the branches allow, `most` at most."""
    pairs = []
    for j, draw in zip(candidates, draws, strict=True):
        stored = directions[j].astype(float)
        turns = find_turns(rays, stored[~np.isnan(stored)], tolerance)[:16]
        if turns:
            pairs.append((j, turns[int(draw * len(turns))]))
    return pairs[:most]


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


def laid_hits(points, s, x, y, turn, raster, n_turns):
    """Tell the same of points turned by the nearest of `n_turns` angles and moved by eighths of a cell."""
    turn = 2 * math.pi * (round(turn * n_turns / (2 * math.pi)) % n_turns) / n_turns
    out = []
    for i in range(points.starts[s], points.starts[s + 1]):
        u, v = points.offsets[i] * points.scales[s] / raster.cell
        right = math.floor(8 * (math.cos(turn) * u - math.sin(turn) * v) + 0.5)
        up = math.floor(8 * (math.sin(turn) * u + math.cos(turn) * v) + 0.5)
        column, row = (math.floor(8 * x) + right) // 8, (math.floor(8 * y) + up) // 8
        direction = math.floor(points.angles[i] + turn * DIRECTIONS / math.pi) % DIRECTIONS
        out.append(bool(word_at(row, column, raster.tile_of, raster.bits) >> direction & 1))
    return out


def ratio(met, rate, trial, block):
    """Return the log-likelihood ratio, looked at after each block, and where it ended."""
    total = 0.0
    for first in range(0, len(met), block):
        for one in met[first : first + block]:
            total += math.log(trial.hit_rate / rate) if one else math.log((1 - trial.hit_rate) / (1 - rate))
        if total < -trial.patience:
            break
    return total
