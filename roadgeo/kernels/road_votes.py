"""One query intersection and the roads around it, laid on intersections of the map (see `matching.road_votes`)."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from roadgeo.kernels.arrays import Floats1, Floats2, Int8s3, Ints1
from roadgeo.kernels.compilation import kernel
from roadgeo.kernels.road_raster import DIRECTIONS, Raster, passes

__all__ = ["Places", "RoadPoints", "Trial", "chance_rates", "draw_turns", "find_turns", "improve_votes", "vote"]

#: Turns of one intersection on another at most, and how close two are the same, radians.
MAX_TURNS = 16
_SAME_TURN = 0.17
#: Chance rates are told apart in so many steps, and lie no lower than this.
_LEVELS = 128
_LEAST_RATE = 0.03
#: Points are looked up so many at a time: without a branch between them, processors overlap them.
_BLOCK = 6


class Places(NamedTuple):
    """Intersections of the map: (N, 2) cells from the raster's corner, (N, R, 2) int8 branches, (N,) density.

    The density is the chance of a point of any direction to meet a road there.
    """

    cells: Floats2
    branches: Int8s3
    density: Floats1


class RoadPoints(NamedTuple):
    """Road points of the query to test at each of S scales, `starts[s]:starts[s + 1]`.

    `scales` (S,) are metres per unit of the query plane, `offsets` (P, 2) positions from the query intersection in that
    plane, `angles` (P,) directions in units of pi / DIRECTIONS, at least 0.
    """

    scales: Floats1
    starts: Ints1
    offsets: Floats2
    angles: Floats1


class Trial(NamedTuple):
    """Of the sequential test: share of points that meet roads in the right place, and the nats lost before it ends."""

    hit_rate: float
    patience: float


@kernel()
def find_turns(rays: Floats1, branches: Int8s3, j: int, tolerance: float, turns: Floats1) -> int:
    """List the turns that lay all branches of a query intersection on branches of map intersection j, or the reverse.

    The poorer of the two may lack branches, but not have others.

    Parameters
    ----------
    rays : (R,) float64
        Directions of the query's branches, radians.
    branches : (M, R', 2) int8
        The map's (see `kernels.rays`).
    tolerance : float
        How far branches may be apart, radians.
    turns : (MAX_TURNS,) float64
        Filled with counterclockwise turns in [-pi, pi], the mean over the branches that agree; those close to one
        listed before are left out.

    Returns
    -------
    int
        How many.
    """
    n, m = 0, 0
    directions = np.empty(branches.shape[1])
    while m < branches.shape[1] and (branches[j, m, 0] != 0 or branches[j, m, 1] != 0):
        directions[m] = math.atan2(float(branches[j, m, 1]), float(branches[j, m, 0]))
        m += 1
    for i in range(rays.shape[0]):
        for t in range(m):
            first = directions[t] - rays[i]
            total, agreeing = 0.0, 1
            for k in range(rays.shape[0]):
                best = tolerance
                for u in range(m):
                    if k != i and u != t:
                        away = _wrapped(directions[u] - rays[k] - first)
                        if abs(away) < abs(best):
                            best = away
                if best != tolerance:
                    total += best
                    agreeing += 1
            if agreeing < max(2, min(rays.shape[0], m)):
                continue
            turn = _wrapped(first + total / agreeing)
            new = n < turns.shape[0]
            for k in range(n):
                new = new and abs(_wrapped(turn - turns[k])) >= _SAME_TURN
            if new:
                turns[n] = turn
                n += 1
    return n


@kernel()
def _wrapped(angle: float) -> float:
    """Return an angle modulo 2 pi in [-pi, pi]."""
    return angle - 2.0 * math.pi * round(angle / (2.0 * math.pi))


@kernel(forceinline=True)
def _count_met(
    points: RoadPoints, first: int, last: int, x: float, y: float, turn: float, c: float, d: float, raster: Raster
) -> int:
    """Count the points `first` to `last` that meet roads; (c, d) = (cos, sin) of `turn`, times cells per unit."""
    turned = turn * (DIRECTIONS / math.pi) + 2.0 * DIRECTIONS
    met = 0
    for i in range(first, last):
        u, v = points.offsets[i, 0], points.offsets[i, 1]
        direction = int(points.angles[i] + turned) & (DIRECTIONS - 1)
        met += passes(x + c * u - d * v, y + d * u + c * v, direction, raster)
    return met


@kernel()
def draw_turns(
    candidates: Ints1, draws: Floats1, rays: Floats1, tolerance: float, places: Places, sample: Ints1, turns: Floats1
) -> int:
    """Draw places and turns at random among those that the branches allow, until the sample is full.

    Parameters
    ----------
    candidates, draws : (M,)
        Map intersections in random order, and a number from 0 to 1 for each, which chooses one of its turns.
    rays, tolerance
        As in `find_turns`.
    sample, turns : (K,)
        Filled: map intersections and a turn of each.

    Returns
    -------
    int
        How many.
    """
    room = np.empty(MAX_TURNS)
    n = 0
    for m in range(candidates.shape[0]):
        if n == sample.shape[0]:
            break
        k = find_turns(rays, places.branches, candidates[m], tolerance, room)
        if k > 0:
            sample[n], turns[n] = candidates[m], room[int(draws[m] * k)]
            n += 1
    return n


@kernel()
def chance_rates(
    sample: Ints1,
    turns: Floats1,
    points: RoadPoints,
    places: Places,
    raster: Raster,
    out: Floats1,
) -> None:
    """Measure how often points meet roads by chance at each scale, in units of the density of roads at the place.

    Parameters
    ----------
    sample, turns : (M,)
        Map intersections and turns, chosen at random among those that the branches allow.
    out : (S,) float64
        Filled with the mean of share / density.
    """
    for s in range(points.scales.shape[0]):
        out[s] = 0.0
        n = points.starts[s + 1] - points.starts[s]
        for m in range(sample.shape[0] if n > 0 else 0):
            j = sample[m]
            c = math.cos(turns[m]) * points.scales[s] / raster.cell
            d = math.sin(turns[m]) * points.scales[s] / raster.cell
            x, y = places.cells[j, 0], places.cells[j, 1]
            met = _count_met(points, points.starts[s], points.starts[s + 1], x, y, turns[m], c, d, raster)
            out[s] += met / n / places.density[j] / sample.shape[0]


@kernel()
def vote(
    candidates: Ints1,
    rays: Floats1,
    tolerance: float,
    max_turn: float,
    points: RoadPoints,
    places: Places,
    raster: Raster,
    chance: Floats1,
    trial: Trial,
    votes: Floats2,
    kept: int,
) -> tuple[int, int]:
    """Lay the roads around a query intersection on those around map intersections; keep the best.

    Each turn that the branches allow is tried at every scale. A sequential probability ratio test (Wald 1945) over the
    points, in the order given, gives up below -`patience`; of all scales of one turn the best ratio counts.

    Parameters
    ----------
    candidates : (M,) int64
        Map intersections to try.
    rays, tolerance
        As in `find_turns`.
    max_turn : float
        Turns beyond, in radians, are left out.
    chance : (S,) float64
        The chance rate at a place and scale is its density times this (see `chance_rates`).
    votes : (K, 5) float64
        (map intersection, turn, scale, ratio in nats, chance rate), the first `kept` of them a heap, worst first; goes
        on to be one.

    Returns
    -------
    int, int
        `kept` now, and how many places and turns were tried.
    """
    turns = np.empty(MAX_TURNS)
    rates, gains, losses = np.empty(_LEVELS), np.empty(_LEVELS), np.empty(_LEVELS)
    # what a hit and a miss weigh, by the chance rate
    for level in range(_LEVELS):
        rates[level] = min(max((level + 0.5) / _LEVELS, _LEAST_RATE), 0.8 * trial.hit_rate)
        gains[level] = math.log(trial.hit_rate / rates[level])
        losses[level] = math.log((1.0 - trial.hit_rate) / (1.0 - rates[level]))
    tried = 0
    for index in range(candidates.shape[0]):
        j = candidates[index]
        x, y = places.cells[j, 0], places.cells[j, 1]
        for t in range(find_turns(rays, places.branches, j, tolerance, turns)):
            turn = turns[t]
            if abs(turn) > max_turn:
                continue
            tried += 1
            best, where, rate = 0.0, -1, 0.0
            # the best scale: points are counted in blocks, and a scale is left when it has lost too much, or when all
            # points that are left would not make it better than another scale and the worst vote that is kept
            least = votes[0, 3] if kept == votes.shape[0] else 0.0
            cosine, sine = math.cos(turn) / raster.cell, math.sin(turn) / raster.cell
            for s in range(points.scales.shape[0]):
                i, last = points.starts[s], points.starts[s + 1]
                level = int(min(chance[s] * places.density[j], 0.99) * _LEVELS)
                c, d = cosine * points.scales[s], sine * points.scales[s]
                ratio = 0.0
                enough = max(best, least)
                while i < last and ratio >= -trial.patience and ratio + gains[level] * (last - i) > enough:
                    stop = min(i + _BLOCK, last)
                    met = _count_met(points, i, stop, x, y, turn, c, d, raster)
                    ratio += gains[level] * met + losses[level] * (stop - i - met)
                    i = stop
                if ratio > best:
                    best, where, rate = ratio, s, rates[level]
            # the heap keeps the best votes
            if where >= 0 and (kept < votes.shape[0] or best > votes[0, 3]):
                row = kept if kept < votes.shape[0] else 0
                kept = min(kept + 1, votes.shape[0])
                votes[row, 0], votes[row, 1], votes[row, 2] = j, turn, points.scales[where]
                votes[row, 3], votes[row, 4] = best, rate
                _sift(votes, row, kept)
    return kept, tried


@kernel()
def _sift(heap: NDArray[np.float64], row: int, n: int) -> None:
    """Restore the order of a heap by column 3, least first, after row `row` of its first `n` changed."""
    while row > 0 and heap[(row - 1) // 2, 3] > heap[row, 3]:
        _swap(heap, row, (row - 1) // 2)
        row = (row - 1) // 2
    while True:
        least = row
        for child in (2 * row + 1, 2 * row + 2):
            if child < n and heap[child, 3] < heap[least, 3]:
                least = child
        if least == row:
            return
        _swap(heap, row, least)
        row = least


@kernel()
def _swap(heap: NDArray[np.float64], a: int, b: int) -> None:
    for k in range(heap.shape[1]):
        heap[a, k], heap[b, k] = heap[b, k], heap[a, k]


@kernel()
def improve_votes(
    votes: Floats2,
    turns: Floats1,
    factors: Floats1,
    points: RoadPoints,
    places: Places,
    raster: Raster,
    trial: Trial,
) -> None:
    """Move the turn and scale of each proposal in small steps, with more points, and judge it anew.

    Parameters
    ----------
    votes : (K, 5) float64
        As left by `vote`; turn, scale and ratio are replaced by the best.
    turns, factors : float64
        Steps: radians added, and factors of the scale.
    points : RoadPoints
        Those of the nearest scale are taken.
    """
    for k in range(votes.shape[0]):
        j, turn0, scale0 = int(votes[k, 0]), votes[k, 1], votes[k, 2]
        s = np.argmin(np.abs(np.log(points.scales / scale0)))
        first, last = points.starts[s], points.starts[s + 1]
        gain = math.log(trial.hit_rate / votes[k, 4])
        loss = math.log((1.0 - trial.hit_rate) / (1.0 - votes[k, 4]))
        votes[k, 3] = -np.inf
        for a in range(turns.shape[0]):
            for b in range(factors.shape[0]):
                turn, scale = turn0 + turns[a], scale0 * factors[b]
                c, d = math.cos(turn) * scale / raster.cell, math.sin(turn) * scale / raster.cell
                met = _count_met(points, first, last, places.cells[j, 0], places.cells[j, 1], turn, c, d, raster)
                ratio = gain * met + loss * (last - first - met)
                if ratio > votes[k, 3]:
                    votes[k, 1], votes[k, 2], votes[k, 3] = turn, scale, ratio
