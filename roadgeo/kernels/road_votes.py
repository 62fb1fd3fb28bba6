"""One query intersection and the roads around it, laid on intersections of the map (see `matching.road_votes`)."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from roadgeo.kernels.arrays import Floats1, Floats2, Int32s2, Ints1, Singles2, UInt32s2, UInt64s1, Words1
from roadgeo.kernels.compilation import kernel
from roadgeo.kernels.road_raster import DIRECTIONS, TILE, Raster, passes

__all__ = [
    "BLOCK",
    "NOWHERE",
    "TURNS",
    "LaidPoints",
    "Places",
    "RoadPoints",
    "Trial",
    "chance_rates",
    "draw_turns",
    "find_turns",
    "improve_votes",
    "lay_points",
    "vote",
]

#: Turns of one intersection on another at most, and how close two are the same, radians.
MAX_TURNS = 16
_SAME_TURN = 0.17
#: Chance rates are told apart in so many steps, and lie no lower than this.
_LEVELS = 128
_LEAST_RATE = 0.03
#: Points are looked up so many at a time: without a branch between them, processors overlap them.
BLOCK = 8
#: Points are turned by one of so many angles: at 200 m from the intersection they lie 5 m off at most.
TURNS = 128
#: A laid point lies so many eighths of a cell east and north of the tile's corner that is one tile west and south of an
#: intersection's. Of the bits of each the lowest 3 are eighths, the next 6 cells, and the last 2 tiles, of which the
#: fourth is empty.
_FINE, _BITS = 8, 11
_MIDDLE = TILE * _FINE
#: A point that meets no road.
NOWHERE = 3 * TILE * _FINE


class Places(NamedTuple):
    """Intersections of the map: (N, 2) cells from the raster's corner, (N, R) directions of branches, (N,) density.

    Directions are radians, NaN beyond the last. The density is the chance of a point of any direction to meet a road
    there.
    """

    cells: Floats2
    directions: Singles2
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


class LaidPoints(NamedTuple):
    """Road points of the query, turned and scaled to cells of the raster beforehand, as `vote` looks them up.

    `scales` (S,) and `counts` (S,) are the scales and how many points each has. `words` (TURNS, B * S * BLOCK) uint32
    holds for each turn the first BLOCK points of all scales, then the next ones, and so on: few are looked up beyond
    the first. The lowest 11 bits of a word are x from the query intersection, the next 11 y, in eighths of a cell from
    -64 cells, a tile, on, and 4 more the direction. Where a scale has no point the word is NOWHERE.
    """

    scales: Floats1
    counts: Ints1
    words: UInt32s2


class Trial(NamedTuple):
    """Of the sequential test: share of points that meet roads in the right place, and the nats lost before it ends."""

    hit_rate: float
    patience: float


@kernel()
def find_turns(rays: Floats1, directions: Singles2, j: int, tolerance: float, turns: Floats1) -> int:
    """List the turns that lay all branches of a query intersection on branches of map intersection j, or the reverse.

    The poorer of the two may lack branches, but not have others.

    Parameters
    ----------
    rays : (R,) float64
        Directions of the query's branches, radians.
    directions : (M, R') float32
        Those of the map's, NaN beyond the last.
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
    while m < directions.shape[1] and not math.isnan(directions[j, m]):
        m += 1
    least = max(2, min(rays.shape[0], m))
    for i in range(rays.shape[0]):
        for t in range(m):
            first = directions[j, t] - rays[i]
            total, agreeing, left = 0.0, 1, rays.shape[0] - 1
            for k in range(rays.shape[0]):
                if k == i:
                    continue
                if agreeing + left < least:
                    break
                left -= 1
                best = tolerance
                for u in range(m):
                    if u != t:
                        away = _wrapped(directions[j, u] - rays[k] - first)
                        if abs(away) < abs(best):
                            best = away
                if best != tolerance:
                    total += best
                    agreeing += 1
            if agreeing < least:
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


@kernel(forceinline=True)
def _count_laid(words: UInt32s2, turn: int, first: int, place: np.uint32, around: UInt64s1, bits: Words1) -> int:
    """Count the points of a block, from word `first` on, that meet roads when they are laid on a place.

    `around` says where the cells of each tile begin, four a row; see `LaidPoints` for `place`, which is no direction.
    """
    met = 0
    for i in range(BLOCK):
        word = np.uint32(words[np.uint64(turn), np.uint64(first + i)] + place)
        tile = ((word >> np.uint32(9)) & np.uint32(3)) | ((word >> np.uint32(18)) & np.uint32(12))
        cell = ((word >> np.uint32(3)) & np.uint32(0x3F)) | ((word >> np.uint32(8)) & np.uint32(0xFC0))
        directions = np.uint32(bits[around[tile] + np.uint64(cell)])
        met += int(np.int64((directions >> (word >> np.uint32(2 * _BITS))) & np.uint32(1)))
    return met


@kernel(forceinline=True)
def _find_tiles(row: int, column: int, tile_of: Int32s2, around: UInt64s1) -> None:
    """Fill in where the cells of a tile and of its neighbours begin, four a row, of which the last is empty."""
    for i in range(3):
        for k in range(3):
            around[4 * i + k] = np.uint64(tile_of[row + i - 1, column + k - 1]) * np.uint64(TILE * TILE)


@kernel()
def lay_points(points: RoadPoints, cell: float, words: UInt32s2) -> None:
    """Turn and scale road points to cells of a raster.

    Parameters
    ----------
    points : RoadPoints
        All lie less than TILE - 1 cells from the intersection.
    cell : float
        Of the raster, metres.
    words : (TURNS, B * S * BLOCK) uint32
        Filled, as in `LaidPoints`, where there are points.
    """
    n_scales = points.scales.shape[0]
    for k in range(words.shape[0]):
        turn = 2.0 * math.pi * k / words.shape[0]
        turned = turn * (DIRECTIONS / math.pi) + 2.0 * DIRECTIONS
        for s in range(n_scales):
            c = math.cos(turn) * points.scales[s] / cell * _FINE
            d = math.sin(turn) * points.scales[s] / cell * _FINE
            for i in range(points.starts[s], points.starts[s + 1]):
                u, v = points.offsets[i, 0], points.offsets[i, 1]
                x, y = int(c * u - d * v + _MIDDLE + 0.5), int(d * u + c * v + _MIDDLE + 0.5)
                direction = int(points.angles[i] + turned) & (DIRECTIONS - 1)
                block, place = divmod(i - points.starts[s], BLOCK)
                words[k, (block * n_scales + s) * BLOCK + place] = x | (y << _BITS) | (direction << (2 * _BITS))


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
        k = find_turns(rays, places.directions, candidates[m], tolerance, room)
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
    laid: LaidPoints,
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
    _weigh(trial, rates, gains, losses)
    tried = 0
    n_scales, n_turns = laid.scales.shape[0], laid.words.shape[0]
    bits, around, met_first = raster.bits.reshape(-1), np.zeros(16, np.uint64), np.empty(n_scales, np.int64)
    row, column = -1, -1
    for index in range(candidates.shape[0]):
        j = candidates[index]
        x, y = int(places.cells[j, 0] * _FINE), int(places.cells[j, 1] * _FINE)
        if y // _MIDDLE != row or x // _MIDDLE != column:
            row, column = y // _MIDDLE, x // _MIDDLE
            _find_tiles(row, column, raster.tile_of, around)
        place = np.uint32((x % _MIDDLE) | ((y % _MIDDLE) << _BITS))
        for t in range(find_turns(rays, places.directions, j, tolerance, turns)):
            turn = turns[t]
            if abs(turn) > max_turn:
                continue
            tried += 1
            k = round(turn * n_turns / (2.0 * math.pi)) % n_turns
            # the first block of all scales, without a branch: processors overlap them
            for s in range(n_scales):
                met_first[s] = _count_laid(laid.words, k, s * BLOCK, place, around, bits)
            # the best scale: points are counted in blocks, and a scale is left when it has lost too much, or when all
            # points that are left would not make it better than another scale and the worst vote that is kept
            best, where, rate = 0.0, -1, 0.0
            least = votes[0, 3] if kept == votes.shape[0] else 0.0
            for s in range(n_scales):
                level = int(min(chance[s] * places.density[j], 0.99) * _LEVELS)
                left, enough = laid.counts[s], max(best, least)
                if gains[level] * left <= enough:
                    continue
                n, first = min(BLOCK, left), (n_scales + s) * BLOCK
                ratio = gains[level] * met_first[s] + losses[level] * (n - met_first[s])
                left -= n
                while left > 0 and ratio >= -trial.patience and ratio + gains[level] * left > enough:
                    n = min(BLOCK, left)
                    met = _count_laid(laid.words, k, first, place, around, bits)
                    ratio += gains[level] * met + losses[level] * (n - met)
                    first += n_scales * BLOCK
                    left -= n
                if ratio > best:
                    best, where, rate = ratio, s, rates[level]
            if where >= 0 and (kept < votes.shape[0] or best > votes[0, 3]):
                slot = kept if kept < votes.shape[0] else 0  # the last, or that of the worst vote
                kept = min(kept + 1, votes.shape[0])
                votes[slot, 0], votes[slot, 1], votes[slot, 2] = j, turn, laid.scales[where]
                votes[slot, 3], votes[slot, 4] = best, rate
                _sift(votes, slot, kept)
    return kept, tried


@kernel()
def _weigh(trial: Trial, rates: Floats1, gains: Floats1, losses: Floats1) -> None:
    """Fill in chance rates, and what a hit and a miss weigh against each of them."""
    for level in range(rates.shape[0]):
        rates[level] = min(max((level + 0.5) / rates.shape[0], _LEAST_RATE), 0.8 * trial.hit_rate)
        gains[level] = math.log(trial.hit_rate / rates[level])
        losses[level] = math.log((1.0 - trial.hit_rate) / (1.0 - rates[level]))


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
