"""A query intersection and the roads around it, compared with intersections of the map (see `matching.road_search`)."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from roadgeo.kernels.arrays import Floats1, Floats2, Int32s2, Ints1, UInt64s2
from roadgeo.kernels.compilation import kernel
from roadgeo.kernels.road_raster import DIRECTIONS, Raster, passes
from roadgeo.kernels.road_rings import BEARINGS, WORDS, count_bits, turn_bits

__all__ = ["MAX_TURNS", "WHOLE_TURN", "Places", "RoadPoints", "VoteRates", "find_turns", "improve_votes", "vote"]

#: Angles of branches are whole numbers: bits beyond a whole turn fall away, and the uppermost 6 bits of 32 are the
#: bearing that they point to.
WHOLE_TURN = 1 << 32
_HALF_TURN, _MASK, _BITS = 1 << 31, (1 << 32) - 1, 26
_UNIT = 2.0 * math.pi / WHOLE_TURN
#: Most turns of an intersection to another, and the difference below which two turns are the same.
MAX_TURNS = 16
_SAME_TURN = round(0.17 / _UNIT)
#: A scale is tried with all rings where every second ring brings this part of the score to be beaten: half its share.
_PROMISING = 0.25
#: Chance rates lie no lower than this.
_LEAST_RATE = 0.03


class Places(NamedTuple):
    """Intersections of the map.

    `cells` (N, 2) are cells from the raster's corner. `directions` (N, R) hold the directions of branches (see
    `WHOLE_TURN`); the first `counts` (N,) of a row are valid. `density` (N,) is the chance that a point of any
    direction meets a road there, and `rings` (N, WORDS) are the roads around (see `kernels.road_rings`).
    """

    cells: Floats2
    directions: Int32s2
    counts: Ints1
    density: Floats1
    rings: UInt64s2


class RoadPoints(NamedTuple):
    """Road points of the query to test at each of S scales, `starts[s]:starts[s + 1]`.

    `scales` (S,) are metres per unit of the query plane, `offsets` (P, 2) positions from the query intersection in that
    plane, `angles` (P,) directions in units of pi / DIRECTIONS, at least 0.
    """

    scales: Floats1
    starts: Ints1
    offsets: Floats2
    angles: Floats1


class VoteRates(NamedTuple):
    """Share of points that meet roads at the right place, and by chance, in units of the density of roads there."""

    hit_rate: float
    chance: float


@kernel(forceinline=True)
def _wrapped(angle: int) -> int:
    """Return an angle in [-half a turn, half a turn)."""
    return ((angle + _HALF_TURN) & _MASK) - _HALF_TURN


@kernel(forceinline=True)
def _bearing(angle: int) -> int:
    """Return the bearing that an angle points to, 0 to 63."""
    return (angle & _MASK) >> _BITS


@kernel(forceinline=True)
def _turns_allowed(rays: Ints1, directions: Int32s2, m: int, j: int, tolerance: int) -> np.uint64:
    """Return, as bits, the turns by whole bearings that may align enough branches: a superset of those that do."""
    branches = np.uint64(0)
    for t in range(m):
        branches |= np.uint64(1) << np.uint64(_bearing(int(directions[j, t])))
    # two angles and the turn are rounded: agreeing roads may lie one and a half bearings more than `tolerance` apart
    for _ in range((tolerance >> _BITS) + 2):
        branches |= turn_bits(branches, 1) | turn_bits(branches, -1)
    # turns at which no ray lacks a branch, a single ray does, and two or more do
    none, single, more = ~np.uint64(0), np.uint64(0), np.uint64(0)
    for k in range(rays.shape[0]):
        near = turn_bits(branches, -_bearing(rays[k]))
        more |= single & ~near
        single = (single & near) | (none & ~near)
        none &= near
    lacking = rays.shape[0] - m
    return none if lacking <= 0 else none | single if lacking == 1 else none | single | more


@kernel(writes=("turns",))
def find_turns(rays: Ints1, directions: Int32s2, counts: Ints1, j: int, tolerance: int, turns: Ints1) -> int:
    """List the turns that align all branches of a query intersection with branches of map intersection j, or reverse.

    The intersection with fewer branches may lack branches, but may not have others.

    Parameters
    ----------
    rays : (R,) int64
        Directions of the query's branches (see `WHOLE_TURN`).
    directions : (M, R') int32
        Directions of the map's branches; the first `counts` (M,) of a row are valid.
    tolerance : int
        Greatest angle between branches that agree.
    turns : (MAX_TURNS,) int64
        Filled with counterclockwise turns, at most half a turn either way: means over the branches that agree. Turns
        close to a turn listed before are left out.

    Returns
    -------
    int
        Number of turns.
    """
    n, m, n_rays = 0, counts[j], rays.shape[0]
    least = max(2, min(n_rays, m))
    allowed = _turns_allowed(rays, directions, m, j, tolerance)
    if allowed == 0:
        return 0
    for i in range(n_rays):
        for t in range(m):
            first = int(directions[j, t]) - rays[i]
            if (allowed >> np.uint64(_bearing(first + (1 << (_BITS - 1))))) & np.uint64(1) == 0:
                continue
            total, agreeing, left = 0, 1, n_rays - 1
            for k in range(n_rays):
                if k == i:
                    continue
                if agreeing + left < least:
                    break
                left -= 1
                best = tolerance
                for u in range(m):
                    away = _wrapped(int(directions[j, u]) - rays[k] - first)
                    if u != t and abs(away) < abs(best):
                        best = away
                if best != tolerance:
                    total += best
                    agreeing += 1
            if agreeing < least:
                continue
            turn = _wrapped(first + total // agreeing)
            new = n < turns.shape[0]
            for k in range(n):
                new = new and abs(_wrapped(turn - turns[k])) >= _SAME_TURN
            if new:
                turns[n] = turn
                n += 1
    return n


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


@kernel(writes=("votes",))
def vote(
    candidates: Ints1,
    rays: Ints1,
    tolerance: int,
    turn: int,
    max_off: int,
    scales: Floats1,
    points: UInt64s2,
    least: int,
    places: Places,
    votes: Floats2,
) -> tuple[int, int]:
    """Compare the roads around a query intersection with the roads around map intersections; keep the best.

    Each turn that the branches allow is tried at every scale, and the best scale of each turn counts. The score is the
    number of points that meet roads, less the number expected by chance if the rings of the place were turned at
    random, in standard deviations of the latter.

    Parameters
    ----------
    candidates : (M,) int64
        Map intersections to try.
    rays, tolerance
        As in `find_turns`.
    turn, max_off : int
        Turns that differ from `turn` by more than `max_off` are left out.
    scales : (S,) float64
        Metres per unit of the query plane.
    points : (S, WORDS) uint64
        The query's roads at each scale (see `kernels.road_rings.mark_rings`).
    least : int
        Scales at which fewer points are in reach are left out.
    votes : (K, 4) float64
        (map intersection, turn in radians, scale, standard deviations): the rows filled are a heap, worst first.

    Returns
    -------
    int, int
        How many rows are filled, and how many places and turns were tried.
    """
    n_scales, tried, kept = scales.shape[0], 0, 0
    n_points, points_of = np.zeros(n_scales), np.empty((n_scales, WORDS), np.int16)
    some, share = np.empty((WORDS // 2, n_scales), np.uint64), np.zeros(n_scales)  # the points of every second ring
    for s in range(n_scales):
        for w in range(WORDS):
            points_of[s, w] = np.int16(count_bits(points[s, w]))
            n_points[s] += points_of[s, w]
        for v in range(WORDS // 2):
            some[v, s] = points[s, 2 * v]
            share[s] += points_of[s, 2 * v] / max(n_points[s], 1.0)
    turns, here, met = np.empty(MAX_TURNS, np.int64), np.empty(WORDS, np.uint64), np.empty(n_scales, np.int64)
    roads, expected, sigma = np.empty(WORDS, np.int16), np.empty(n_scales), np.empty(n_scales)
    needed, inverse = np.empty(n_scales, np.int64), 1.0 / np.maximum(n_points, 1.0)
    for index in range(candidates.shape[0]):
        j = candidates[index]
        n_turns = find_turns(rays, places.directions, places.counts, j, tolerance, turns)
        if n_turns == 0:
            continue
        for w in range(WORDS):
            roads[w] = np.int16(count_bits(places.rings[j, w]))
        for s in range(n_scales):
            total = np.int32(0)
            for w in range(WORDS):
                total = np.int32(total + np.int32(np.int32(points_of[s, w]) * np.int32(roads[w])))
            expected[s] = total * (1.0 / BEARINGS)
        worst = votes[0, 3] if kept == votes.shape[0] else 0.0
        for s in range(n_scales):
            sigma[s] = math.sqrt(max(expected[s] * (1.0 - expected[s] * inverse[s]), 1.0))
            met_by_some = share[s] * expected[s] + _PROMISING * worst * sigma[s]
            needed[s] = int(met_by_some) if n_points[s] >= least else WORDS * BEARINGS
        for t in range(n_turns):
            if abs(_wrapped(turns[t] - turn)) > max_off:
                continue
            tried += 1
            back = -_bearing(turns[t] + (1 << (_BITS - 1)))
            for w in range(WORDS):
                here[w] = turn_bits(places.rings[j, w], back)
            worst = votes[0, 3] if kept == votes.shape[0] else 0.0
            best, where = _best_scale(here, points, some, needed, expected, sigma, met, worst)
            if where >= 0:
                slot = kept if kept < votes.shape[0] else 0  # the next free slot, or the worst vote's
                kept = min(kept + 1, votes.shape[0])
                votes[slot, 0], votes[slot, 1], votes[slot, 2] = j, turns[t] * _UNIT, scales[where]
                votes[slot, 3] = best
                _sift(votes, slot, kept)
    return kept, tried


@kernel(forceinline=True)
def _best_scale(
    here: NDArray[np.uint64],
    points: UInt64s2,
    some: NDArray[np.uint64],
    needed: NDArray[np.int64],
    expected: NDArray[np.float64],
    sigma: NDArray[np.float64],
    met: NDArray[np.int64],
    worst: float,
) -> tuple[float, int]:
    """Return the best score above `worst` of the points on the roads `here`, and its scale; -1 if no scale has one.

    The points of every second ring, `some`, are counted first, at all scales side by side in `met`: where they are not
    more than `needed`, the others are left out.
    """
    met[:] = 0
    for v in range(0, WORDS // 2, 4):  # four at a time: the counts are written a quarter as often
        a, b, c, d = here[2 * v], here[2 * v + 2], here[2 * v + 4], here[2 * v + 6]
        for s in range(met.shape[0]):
            first = count_bits(a & some[v, s]) + count_bits(b & some[v + 1, s])
            met[s] += np.int64(first + count_bits(c & some[v + 2, s]) + count_bits(d & some[v + 3, s]))
    best, where = worst, -1
    for s in range(met.shape[0]):
        if met[s] <= needed[s]:
            continue
        all_met = np.uint64(0)
        for w in range(WORDS):
            all_met += count_bits(here[w] & points[s, w])
        score = (all_met - expected[s]) / sigma[s]
        if score > best:
            best, where = score, s
    return best, where


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


@kernel(writes=("votes",))
def improve_votes(
    votes: Floats2,
    turns: Floats1,
    factors: Floats1,
    points: RoadPoints,
    places: Places,
    raster: Raster,
    trial: VoteRates,
) -> None:
    """Vary the turn, then the scale of each proposal in small steps, with more points, and score it anew.

    Parameters
    ----------
    votes : (K, 4) float64
        As left by `vote`; turn and scale are replaced by the best, and their votes by the log-likelihood
        ratio of the points against chance, nats.
    turns, factors : float64
        Steps: radians added, and factors of the scale.
    points : RoadPoints
        The points of the nearest scale are used.
    """
    for k in range(votes.shape[0]):
        j, turn0, scale0 = int(votes[k, 0]), votes[k, 1], votes[k, 2]
        s = np.argmin(np.abs(np.log(points.scales / scale0)))
        first, last = points.starts[s], points.starts[s + 1]
        rate = min(max(trial.chance * places.density[j], _LEAST_RATE), 0.8 * trial.hit_rate)
        gain = math.log(trial.hit_rate / rate)
        loss = math.log((1.0 - trial.hit_rate) / (1.0 - rate))
        votes[k, 3] = -np.inf
        for step in range(turns.shape[0] + factors.shape[0]):
            n = step - turns.shape[0]
            turn = turn0 + turns[step] if n < 0 else votes[k, 1]
            scale = scale0 if n < 0 else scale0 * factors[n]
            c, d = math.cos(turn) * scale / raster.cell, math.sin(turn) * scale / raster.cell
            met = _count_met(points, first, last, places.cells[j, 0], places.cells[j, 1], turn, c, d, raster)
            ratio = gain * met + loss * (last - first - met)
            if ratio > votes[k, 3]:
                votes[k, 1], votes[k, 2], votes[k, 3] = turn, scale, ratio
