"""The paper's tuples: two intersections of a map with their tangents, hashed by type (section 3.3).

At each end of a tuple every tangent has an angle r in (0, pi), counterclockwise from the connecting line; its cotangent
falls as the angle grows, so "in one rotational sense, starting from the line" is "falling cotangents". Cross ratios of
lines in that order are greater than 1, so that a relative error (eq. 6) makes sense; trees hold their logarithms.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, lru_cache
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from roadgeo._arrays import FloatArray, IntArray
from roadgeo.errors import IndexFormatError
from roadgeo.kernels.pairs import PairBuckets
from roadgeo.kernels.roads import road_residuals
from roadgeo.matching.index import ReferenceIndex, neighbour_grid, sort_by_bucket, unpack_tangents
from roadgeo.matching.scene import MIN_COS
from roadgeo.roads.intersections import IntersectionOptions, Intersections, describe, unpack_branches

__all__ = [
    "PairIndex",
    "TupleOptions",
    "build_pair_index",
    "cotangents",
    "cross_ratios",
    "list_pairs",
    "paired",
    "type_codes",
    "type_keys",
]

#: A dense city of 15,000 intersections has some millions; each takes about 100 bytes while the tables are built.
_MAX_TUPLES = 30_000_000
#: Tangents of the reference begin so far from the intersection (see `IntersectionOptions`), and are sampled every
#: `_STEP_M`. Roads further off than `_REACH_M`, or turned from the branch by more, are other roads.
_SKIP_M, _STEP_M, _REACH_M = IntersectionOptions.skip_length, 3.0, 6.0


@dataclass(frozen=True)
class TupleOptions:
    """Which tuples are formed, by the paper's symbols.

    Attributes
    ----------
    d_max_m : float
        Greatest distance between the two intersections of a reference tuple (eq. 8).
    delta_angle_deg : float
        Least angle between a tangent and the connecting line (eq. 7).
    n_px : int
        Pixels of a branch that must lie on a line, metres on the map (section 4.2).
    fit_error_px : float
        Their greatest average distance from that line; the map's other intersections form no tuples.
    from_center : bool
        Those pixels begin at the intersection, and the line is the branch's tangent (section 3.1). False: tangents are
        those of the traced roads, which are fitted further out, where the width of the roads does not bend them.
    """

    d_max_m: float = 1000.0
    delta_angle_deg: float = 15.0
    n_px: int = 15
    fit_error_px: float = 0.5
    from_center: bool = False


class Tuples(NamedTuple):
    """Tuples of one type: (P, 2) intersections, and a `scipy` tree of their D cross ratios, None where D = 0."""

    pairs: IntArray
    tree: Any


@dataclass(frozen=True, eq=False)
class PairIndex:
    """Reference tuples hashed by type, with one search tree of cross ratios for each type.

    Attributes
    ----------
    codes : (N,) int64
        Types of the intersections, 16 N_B + N_q.
    tuples : mapping of int to Tuples
        Keys are 256 times the code of the first end plus the code of the second end; the first is never the greater.
    """

    reference: Intersections
    codes: IntArray
    tuples: Mapping[int, Tuples]
    buckets: PairBuckets

    def __len__(self) -> int:
        """Return the number of all tuples."""
        return sum(len(tuples.pairs) for tuples in self.tuples.values())


@lru_cache(maxsize=4)
def paired(index: ReferenceIndex, options: TupleOptions) -> PairIndex:
    """Build the paper's tables for a reference, kept for a batch: to store them would save a second or two of it."""
    return build_pair_index(_fitted(index, options), options)


def build_pair_index(intersections: Intersections, options: TupleOptions) -> PairIndex:
    """Extract, hash and sort the reference's tuples (section 3.3, "Sampling in reference map").

    Raises
    ------
    IndexFormatError
        More intersections lie close to each other than on any map.
    """
    from scipy.spatial import cKDTree

    xy = intersections.xy
    codes = type_codes(intersections)
    pairs = list_pairs(intersections, np.arange(len(xy)), options.d_max_m, options.delta_angle_deg)
    keys = type_keys(codes, pairs)
    order = np.argsort(keys, kind="stable")
    tuples = {}
    for of_type in np.split(pairs[order], np.flatnonzero(np.diff(keys[order])) + 1) if len(pairs) else []:
        step = (xy[of_type[:, 1]] - xy[of_type[:, 0]]).T
        ratios = [cross_ratios(cotangents(intersections, ends, *step)) for ends in of_type.T]
        logs = np.log(np.concatenate(ratios, axis=1))
        tree = cKDTree(logs, balanced_tree=False, compact_nodes=False) if logs.shape[1] else None
        tuples[int(type_keys(codes, of_type[:1])[0])] = Tuples(of_type, tree)
    grid, shape = neighbour_grid(xy, min_bucket=10.0) if len(xy) else ((0.0, 0.0, 1.0), (1, 1))
    items, starts = sort_by_bucket(xy, grid, shape)
    return PairIndex(intersections, codes, tuples, PairBuckets(xy[items], codes[items], starts, grid, shape))


def list_pairs(intersections: Intersections, chosen: IntArray, d_max: float, least_deg: float) -> IntArray:
    """Return the (P, 2) tuples of (chosen) intersections that pass eq. 7-8, the end of lesser code first.

    Raises
    ------
    IndexFormatError
        They would fill the memory.
    """
    from scipy.spatial import cKDTree

    tree = cKDTree(intersections.xy[chosen])
    if len(chosen) ** 2 > _MAX_TUPLES:
        count = (int(tree.count_neighbors(tree, d_max)) - len(chosen)) // 2
        if count > _MAX_TUPLES:
            raise IndexFormatError(
                f"the map has {count:,} pairs of intersections nearer than {d_max:g} m, expected at most"
                f" {_MAX_TUPLES:,}; the paper's method does not fit it: use the usual one"
            )
    pairs = chosen[tree.query_pairs(d_max, output_type="ndarray").reshape(-1, 2)]
    dx, dy = (intersections.xy[pairs[:, 1]] - intersections.xy[pairs[:, 0]]).T
    phi, least = np.arctan2(dy, dx), math.sin(math.radians(least_deg))
    passes = (dx != 0.0) | (dy != 0.0)
    for ends in pairs.T:
        passes &= intersections.n_tangents[ends] >= 2  # fewer cannot carry a homography (eq. 9)
        # NaN: no tangent
        passes &= ~(np.abs(np.sin(intersections.tangents[ends] - phi[:, None])) <= least).any(axis=1)
    pairs, codes = np.sort(pairs[passes], axis=1), type_codes(intersections)
    swapped = codes[pairs[:, 0]] > codes[pairs[:, 1]]
    pairs[swapped] = pairs[swapped, ::-1]
    return np.asarray(pairs)


def type_codes(intersections: Intersections) -> IntArray:
    """Return the (N,) types of intersections, 16 N_B + N_q."""
    return (16 * intersections.n_branches + intersections.n_tangents).astype(np.int64)


def type_keys(codes: IntArray, pairs: IntArray) -> IntArray:
    """Return the (P,) types of tuples (see `PairIndex.tuples`)."""
    return np.asarray(256 * codes[pairs[:, 0]] + codes[pairs[:, 1]])


def cotangents(intersections: Intersections, ends: IntArray, dx: FloatArray, dy: FloatArray) -> FloatArray:
    """Return the (P, N_q) falling cotangents of the tangents of `ends` (P,), all with N_q, relative to the lines."""
    tangents = intersections.tangents[ends, : int(intersections.n_tangents[ends[0]])].astype(float)
    return np.asarray(-np.sort(-1.0 / np.tan(tangents - np.arctan2(dy, dx)[:, None]), axis=1))


def cross_ratios(cot: FloatArray) -> FloatArray:
    """Return (P, D) cross ratios (a, b; c, d) = sin(ac) sin(bd) / (sin(bc) sin(ad)) of fours of lines (eq. 4).

    They are concurrent: the tangents and the connecting line, whose cotangent is infinite, so that two factors cancel.
    """
    by_line, others = _fours(cot.shape[1])
    b, c, d = cot[:, by_line].transpose(2, 0, 1)
    first = (b - d) / (b - c)
    a, b, c, d = cot[:, others].transpose(2, 0, 1)
    return np.concatenate((first, (a - c) * (b - d) / ((b - c) * (a - d))), axis=1)


@cache
def _fours(n: int) -> tuple[IntArray, IntArray]:
    """Return threes of n tangents, which make fours with the connecting line, and fours of them."""
    three, four = (np.array(list(combinations(range(n), k)), np.int64).reshape(-1, k) for k in (3, 4))
    return three, four


def _fitted(index: ReferenceIndex, options: TupleOptions) -> Intersections:
    """Return the intersections (N,) whose branches are all long and straight enough, with the tangents asked for.

    Their `node` is their row in the index.
    """
    at, lines, error = _fit_lines(index, 0.0 if options.from_center else _SKIP_M, options.n_px)
    good = np.ones(len(index), bool)
    good[at[~(error <= options.fit_error_px)]] = False  # NaN: it is too short
    if options.from_center:
        starts = np.searchsorted(at, np.arange(len(index) + 1))
        intersections = describe(index.xy, starts, lines, IntersectionOptions())
    else:
        rays, tangents = unpack_branches(index.branches), unpack_tangents(index.tangents)
        intersections = Intersections(index.xy, rays, tangents, np.zeros(len(index), np.float32), np.arange(len(index)))
    return intersections.only(np.flatnonzero(good))


def _fit_lines(index: ReferenceIndex, start_m: float, length_m: float) -> tuple[IntArray, FloatArray, FloatArray]:
    """Fit a line to each branch of a reference.

    Returns
    -------
    at : (B,) int64
        Intersections that own the branches, ascending.
    lines : (B, 4) float64
        As `kernels.intersections.fit_branches` gives them.
    error : (B,) float64
        Average distance of the road from its line, metres; NaN where the branch is shorter than `length_m`.
    """
    vectors = index.branches.astype(float) / 127.0
    at, column = np.nonzero(vectors.any(axis=2))
    ahead = vectors[at, column]
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    steps = start_m + np.arange(0.0, length_m + 1e-9, _STEP_M)
    points = (index.xy[at, None] + steps[:, None] * ahead[:, None]).reshape(-1, 2)
    along, out = np.repeat(ahead, len(steps), axis=0), np.empty((len(points), 3))
    road_residuals(np.eye(3), points, along, np.full(len(points), _REACH_M), MIN_COS, index.road_buckets, out)
    across = np.column_stack([-ahead[:, 1], ahead[:, 0]])
    offsets = (out[:, 0] * (out[:, 1:] * across.repeat(len(steps), axis=0)).sum(axis=1)).reshape(-1, len(steps))
    # The line need not meet the intersection.
    away, slope = np.linalg.lstsq(np.column_stack([np.ones(len(steps)), steps]), offsets.T, rcond=None)[0]
    left = offsets - away[:, None] - slope[:, None] * steps
    direction = np.arctan2(ahead[:, 1], ahead[:, 0]) + np.arctan(slope)
    through = index.xy[at] + away[:, None] * across
    turned = (direction + np.pi) % (2.0 * np.pi) - np.pi
    return at, np.column_stack([through, turned, (left**2).mean(axis=1)]), np.abs(left).mean(axis=1)
