"""Hypotheses from triples of neighbouring intersections.

For a query intersection (the anchor) all triples with two of its nearest neighbours are looked up in the reference's
table. Hits of different triples that put the anchor on the same map intersection, with nearly the same affine map, make
a proposal: a single triple may agree with thousands of others by chance, two or three triples that share an anchor
hardly ever.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import islice

import numpy as np

from roadgeo._arrays import FloatArray, Int32Array, IntArray
from roadgeo.kernels.structs import Hits, TripleLimits, TripleQuery
from roadgeo.kernels.triple_codes import UNITS, find_sides
from roadgeo.kernels.triples import count_alike, gather, look_up_each
from roadgeo.matching.index import IndexOptions, ReferenceIndex
from roadgeo.matching.scene import MAX_COSTLY, MIN_COS, N_NEIGHBOURS, Scene
from roadgeo.matching.search import ALONE, Ahead

__all__ = [
    "BEFORE_ROADS",
    "MAX_ANCHORS",
    "N_RAREST",
    "WITHOUT_ROADS",
    "Proposals",
    "Sweep",
    "TripleOptions",
    "cut_to_units",
    "farthest_first",
    "larger",
    "n_units",
    "propose",
    "smaller",
]


#: Intersections of the map for which search limits are set: a city's.
_USUAL_SIZE = 15_000


def larger(n_reference: int) -> float:
    """Return max(1, sqrt(n / 15,000)): the factor by which search budgets grow with the map."""
    return math.sqrt(max(1.0, n_reference / _USUAL_SIZE))


def smaller(n_reference: int) -> float:
    """Return max(1, sqrt(15,000 / n)): the same for maps smaller than a city's."""
    return math.sqrt(max(1.0, _USUAL_SIZE / max(n_reference, 1)))


def n_units(n_reference: int) -> int:
    """Return how many units of usual size a map of n intersections has: each is searched as a map of its own."""
    return max(1, round(n_reference / _USUAL_SIZE))


def cut_to_units(xy: FloatArray) -> IntArray:
    """Return the unit (N,) of each intersection, (N, 2): a compact piece of the map, of about the usual size."""
    unit = np.zeros(len(xy), np.int64)
    pieces = [(np.arange(len(xy)), 0, n_units(len(xy)))]
    while pieces:
        rows, first, n = pieces.pop()
        if n == 1:
            unit[rows] = first
            continue
        axis = int(np.ptp(xy[rows], axis=0).argmax())
        order = rows[np.argsort(xy[rows, axis], kind="stable")]
        cut = len(rows) * (n // 2) // n
        pieces += [(order[:cut], first, n // 2), (order[cut:], first + n // 2, n - n // 2)]
    return unit


#: Thinner triangles are left out (see `kernels.triple_codes.orient`); the map's may be thinner still.
_MIN_SHAPE = 0.12
#: Number of pairs of tangents that are looked up for an intersection with three or more tangents.
_CODES_PER_VERTEX = 1
#: Most intersections of the query that are looked up all over the frame, and of those with the rarest triples.
MAX_ANCHORS, N_RAREST = 30, 12
#: Hits of a proposal may differ by this part of their affine maps' size.
_AFFINE_TOLERANCE = 0.3


@dataclass(frozen=True)
class TripleOptions:
    """Options of the look-up of triples.

    Attributes
    ----------
    n_neighbours : int
        Triples are formed with pairs of this number of nearest neighbours of the anchor.
    angle_tolerance_deg : float
        Greatest difference of tangents in the equilateral frame.
    spread : bool
        Whether the order of anchors is spread over the frame, from its middle outwards, or begins with rare triples.
        Rare triples are quick to look up, but often rare because they are wrong: on `noisy` and `hard` training masks
        9 % of the rarest sixth of the anchors lead to the place, and 44 % of the commonest sixth.
    max_hits, max_compared : int
        An anchor's triples are looked up, the rarest first, until this number is found or compared on a map of 15,000
        intersections. On a larger map the limits grow by the root of the ratio.
    """

    n_neighbours: int = IndexOptions.n_neighbours
    angle_tolerance_deg: float = 8.0
    spread: bool = False
    max_hits: int = 12_000
    max_compared: int = 400_000

    def bounds(self, n_reference: int, share: float = 1.0) -> tuple[int, int]:
        """Return `max_hits` and `max_compared` for a share of a map of this number of intersections."""
        scale = share * larger(n_reference)
        return max(int(self.max_hits * scale), 1), int(self.max_compared * scale)


@dataclass(frozen=True)
class Proposals:
    """The proposals of an anchor. Dimensions: M proposals, K neighbour slots.

    Attributes
    ----------
    anchor : int
        The query intersection.
    reference : (M,) int
        Map intersections it may be.
    partners : (M, K) int
        Map intersections of the anchor's neighbours, -1 where not placed.
    affine : (M, 4) float64
        The 2 x 2 map (row-major) from query to reference around the anchor.
    placed : (M,) int
        Neighbours placed; proposals stand in descending order of it.
    """

    anchor: int
    reference: IntArray
    partners: IntArray
    affine: FloatArray
    placed: IntArray
    n_tuples: int
    n_candidates: int
    n_hits: int

    def only(self, rows: IntArray) -> Proposals:
        """Return some of the proposals."""
        return replace(
            self,
            reference=self.reference[rows],
            partners=self.partners[rows],
            affine=self.affine[rows],
            placed=self.placed[rows],
        )


def propose(
    scene: Scene,
    indexes: Sequence[ReferenceIndex],
    scale: tuple[float, float],
    min_ratio: float,
    options: TripleOptions,
    ahead: Ahead = ALONE,
    among: IntArray | None = None,
) -> Iterator[list[Proposals]]:
    """Yield each anchor's proposals on each of the indexes (see `TripleOptions.spread` for the order of anchors).

    Anchors are all intersections of the query, or those `among` (K,).

    All indexes together determine the order of anchors and triples and the bounds, as if they were a single index. Each
    gets a share of the bounds that grows with its number of entries to compare.
    """
    query, branches = scene.intersections, scene.branches
    neighbours = np.ascontiguousarray(scene.neighbours[:, : options.n_neighbours])
    weighed = np.arange(len(query)) if among is None else among
    # Weighing all takes longer than using some.
    weighed = np.ascontiguousarray(weighed[:: max(1, math.ceil(len(weighed) / MAX_COSTLY))])
    # the number of table entries to compare with each pair of an anchor's neighbours
    sides = np.empty(query.tangents.shape, np.int8)
    find_sides(query.tangents, branches, sides)
    traced = TripleQuery(query.xy, branches, query.tangents, sides, neighbours)
    costs = _count_alike(traced, weighed, _starts(tuple(indexes)))
    n_reference = sum(map(len, indexes))
    tolerance = round(options.angle_tolerance_deg * UNITS / 180.0)
    limits = TripleLimits(_CODES_PER_VERTEX, tolerance, MIN_COS, scale, min_ratio)
    room = _Room(options.bounds(n_reference)[0])
    # anchors with rare codes first, or each time the anchor furthest from all before
    usable = costs >= 0
    total = np.where(usable, costs, 0).sum(axis=(1, 2))
    n_usable = usable.sum(axis=(1, 2))
    able = np.flatnonzero(n_usable >= 3)
    rarest = able[np.argsort(total[able] / n_usable[able], kind="stable")]

    def look_up(i: int) -> list[Proposals]:
        a = int(weighed[i])
        slots = np.argwhere(usable[i])
        slots = np.ascontiguousarray(slots[np.argsort(costs[i][usable[i]], kind="stable")])
        shares = _shares(traced, a, indexes)
        return [
            _look_up(traced, a, slots, index, options.bounds(n_reference, share), limits, room.hits)
            for index, share in zip(indexes, shares, strict=True)
        ]

    yield from ahead.map(look_up, farthest_first(query.xy[weighed[able]], able) if options.spread else rarest)


@dataclass(frozen=True)
class Sweep:
    """A pass over the query's anchors: their number, and the options for their triples.

    Attributes
    ----------
    triples : TripleOptions
    max_anchors : int
        Most anchors on a map of 15,000 intersections or more; more on a smaller map, where each takes less time.
    most_more : float
        Greatest factor by which `max_anchors` grows on a smaller map.
    """

    triples: TripleOptions
    max_anchors: int
    most_more: float = 3.0

    def proposals(
        self,
        scene: Scene,
        indexes: Sequence[ReferenceIndex],
        scale: tuple[float, float],
        min_ratio: float,
        ahead: Ahead = ALONE,
    ) -> Iterator[list[Proposals]]:
        """Yield each query intersection's proposals on each index, the most promising first.

        `scale` = (least, greatest) root of the determinant of a proposed map, metres per pixel; `min_ratio` is the
        least ratio of its singular values. `ahead` looks for the next intersections meanwhile.
        """
        anchors = propose(scene, indexes, scale, min_ratio, self.triples, ahead)
        more = min(smaller(sum(map(len, indexes))), self.most_more)
        return islice(anchors, int(self.max_anchors * more))


#: If the rarest triples lead to no place, triples with more neighbours are used, all over the frame.
_SECOND = Sweep(TripleOptions(n_neighbours=N_NEIGHBOURS, spread=True), MAX_ANCHORS)
#: The sweeps if roads propose after them, when a few intersections with the rarest triples suffice; and the sweeps if
#: roads propose nothing.
BEFORE_ROADS: tuple[Sweep, ...] = (Sweep(TripleOptions(), N_RAREST), _SECOND)
WITHOUT_ROADS: tuple[Sweep, ...] = (Sweep(TripleOptions(), MAX_ANCHORS), _SECOND)


class _Room(threading.local):
    """Each thread's room for hits."""

    def __init__(self, most: int) -> None:
        self.hits = Hits(np.empty((most, 5), np.int64), np.empty((most, 4)))


def _starts(indexes: tuple[ReferenceIndex, ...]) -> Int32Array:
    """Return the starts of the cells in a table of all indexes together; in larger units for many entries."""
    return indexes[0].table_starts if len(indexes) == 1 else _added_starts(indexes)


@lru_cache(maxsize=1)  # it keeps the indexes open
def _added_starts(indexes: tuple[ReferenceIndex, ...]) -> Int32Array:
    starts = np.zeros(len(indexes[0].table_starts), np.int64)
    for index in indexes:
        starts += index.table_starts
    return (starts >> max(0, int(starts[-1]).bit_length() - 31)).astype(np.int32)


def _count_alike(traced: TripleQuery, anchors: IntArray, starts: Int32Array) -> IntArray:
    """Return how many entries of a table are in the cells of each triple of the anchors (see `count_alike`)."""
    k = traced.neighbours.shape[1]
    costs = np.empty((len(anchors), k, k), np.int64)
    count_alike(
        traced.xy, traced.tangents, traced.sides, traced.neighbours, anchors, _MIN_SHAPE, _CODES_PER_VERTEX,
        starts, costs,
    )  # fmt: skip
    return costs


def _shares(traced: TripleQuery, anchor: int, indexes: Sequence[ReferenceIndex]) -> FloatArray:
    """Return each index's share of an anchor's work: half of it by size, half by the entries to compare."""
    if len(indexes) == 1:
        return np.ones(1)
    anchors = np.array([anchor])
    sizes = np.array([len(index) for index in indexes], float)
    costs = [np.maximum(_count_alike(traced, anchors, index.table_starts), 0).sum() for index in indexes]
    return np.asarray(sizes / sizes.sum() + np.array(costs) / max(sum(costs), 1)) / 2.0


def _look_up(
    traced: TripleQuery,
    anchor: int,
    slots: IntArray,
    index: ReferenceIndex,
    bounds: tuple[int, int],
    limits: TripleLimits,
    hits: Hits,
) -> Proposals:
    """Look up an anchor's triples in an index; return their proposals there, the best placed first."""
    max_hits, max_compared = bounds
    ids, affine = hits = Hits(hits.ids[:max_hits], hits.affine[:max_hits])
    n_hits, n_compared = look_up_each(traced, anchor, slots, max_compared, index.triple_map, limits, hits)
    k = traced.neighbours.shape[1]
    # hits on the same map intersection that agree make a proposal; proposals with most neighbours placed come first
    out_ids = np.empty((max(n_hits // 2, 1), k + 1), np.int64)
    out_affine = np.empty((len(out_ids), 4))
    out_placed = np.empty(len(out_ids), np.int64)
    order = np.argsort(ids[:n_hits, 0] * n_hits + np.arange(n_hits))  # a stable order, five times as quick
    n = gather(ids, affine, order, k, _AFFINE_TOLERANCE, out_ids, out_affine, out_placed)
    best = np.argsort(_scattered(out_ids[:n, 0]) - (out_placed[:n] << 32))
    return Proposals(
        anchor, out_ids[best, 0], out_ids[best, 1:], out_affine[best], out_placed[best],
        len(slots), n_compared, n_hits,
    )  # fmt: skip


def _scattered(numbers: IntArray) -> IntArray:
    """Return keys that sort numbers in a fixed scattered order: the map's intersections are numbered from the south."""
    return (numbers * 2654435761) % 2**32  # Knuth's multiplicative hash


def farthest_first(xy: FloatArray, names: IntArray) -> Iterator[int]:
    """Yield the name of the point nearest to the middle, then always of the point farthest from all yielded before."""
    if len(xy) == 0:
        return
    away = -np.hypot(*(xy - (xy.min(axis=0) + xy.max(axis=0)) / 2.0).T)
    nearest = np.full(len(xy), np.inf)
    for _ in range(len(xy)):
        i = int(np.argmax(away))
        yield int(names[i])
        nearest = np.minimum(nearest, np.hypot(*(xy - xy[i]).T))
        nearest[i] = -1.0
        away = nearest
