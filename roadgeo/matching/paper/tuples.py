"""The paper's tuples of two intersections, hashed by type, with their cross ratios in search trees (section 3.3).

At each end of a tuple every tangent has an angle in (0, pi), counterclockwise from the connecting line; its cotangent
falls as the angle grows, so "in one rotational sense, starting from the line" is "falling cotangents". Cross ratios of
lines in that order are greater than 1, so that a relative error (eq. 6) makes sense; trees hold their logarithms.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from itertools import combinations
from typing import Any, Literal, NamedTuple

import numpy as np

from roadgeo._arrays import BoolArray, FloatArray, IntArray
from roadgeo.errors import IndexFormatError
from roadgeo.kernels.pairs import PairBuckets
from roadgeo.kernels.roads import road_residuals
from roadgeo.matching.index import ReferenceIndex, neighbour_grid, sort_by_bucket
from roadgeo.matching.scene import MIN_COS
from roadgeo.roads.intersections import Intersections

__all__ = ["PairIndex", "PairOptions", "Tuples", "build_pair_index", "cotangents", "cross_ratios", "well_fitted"]

#: A dense city of 15,000 intersections has some millions; each takes about 100 bytes while the tables are built.
_MAX_TUPLES = 30_000_000
#: The buckets of intersections are not smaller, metres.
_LEAST_BUCKET_M = 10.0
#: Section 4.2 asks for 15 pixels, of 1 m, of every branch, and an average distance of half a pixel from the tangent.
#: Branches begin `_SKIP_M` from the intersection (see `IntersectionOptions`), and are looked at in such steps; roads
#: further off, or turned from the branch by more, are others.
_LENGTH_M, _MAX_ERROR_M, _SKIP_M, _STEP_M, _REACH_M = 15.0, 0.5, 8.0, 3.0, 6.0


@dataclass(frozen=True)
class PairOptions:
    """Thresholds of the paper, by its symbols. Those that the paper states are 0.3, 0.5 and 30.

    Attributes
    ----------
    d_max_m : float
        Greatest distance between the two intersections of a reference tuple (eq. 8).
    min_line_angle_deg : float
        Least angle between a tangent and the connecting line (eq. 7).
    delta_cross_ratio : float
        Relative error allowed in every cross ratio (eq. 6).
    tangent_orders : {"++", "all"}
        Correspondences of the tangents tried (section 3.2): both ends in the same rotational sense, the only physical
        one, with w > 0 all over the frame; or all four, anything going.
    lambda_, lambda_1 : float
        Greatest probability to miss a place that is there (eq. 13), and a tuple's counterpart that is there (eq. 14).
    p_query : float
        Probability that a query tuple has its counterpart in the reference (eq. 12).
    delta_inlier : float
        Inlier ratio above which a place is found.
    inlier_distance_m : float
        How close to an intersection of the same type a mapped one must come (eq. 10).
    one_to_one : bool
        Let each reference intersection match once only. False: eq. 10 to the letter.
    min_intersections : int
        Queries with fewer are not searched.
    rarest_first : bool
        Draw query tuples of types rare in the reference first (section 3.3). False: all types alike.
    max_tuple_intersections : int
        Of larger queries, this many intersections at random form the tuples; all of them still judge.
    work_limit_s : float
        The search stops after this amount of work: seconds of a usual machine, counted, not measured.
    time_limit_s : float
        The same after this time by the clock: the last resort.
    """

    d_max_m: float = 1000.0
    min_line_angle_deg: float = 15.0
    delta_cross_ratio: float = 0.3
    tangent_orders: Literal["++", "all"] = "++"
    lambda_: float = 0.01
    lambda_1: float = 0.05
    p_query: float = 0.01
    delta_inlier: float = 0.5
    inlier_distance_m: float = 20.0
    one_to_one: bool = True
    min_intersections: int = 30
    rarest_first: bool = True
    max_tuple_intersections: int = 1000
    work_limit_s: float = 10.0
    time_limit_s: float = 60.0


class Tuples(NamedTuple):
    """Tuples of one type: (P, 2) intersections, and a `scipy` tree of their D cross ratios, None where D = 0."""

    pairs: IntArray
    tree: Any


@dataclass(frozen=True, eq=False)
class PairIndex:
    """Reference tuples hashed by type, with one search tree of cross ratios for each type.

    Attributes
    ----------
    reference : Intersections
    codes : (N,) int64
        Types of the intersections, 16 N_B + N_q.
    tuples : mapping of int to Tuples
        By type, 256 times the code of the first end and that of the second; the first is never the greater.
    buckets : PairBuckets
    """

    reference: Intersections
    codes: IntArray
    tuples: Mapping[int, Tuples]
    buckets: PairBuckets

    def __len__(self) -> int:
        """Return the number of all tuples."""
        return sum(len(one.pairs) for one in self.tuples.values())


def build_pair_index(intersections: Intersections, options: PairOptions | None = None) -> PairIndex:
    """Extract, hash and sort the reference's tuples (section 3.3, "Sampling in reference map").

    Parameters
    ----------
    intersections : Intersections
        Reference plane, metres.
    options : PairOptions
        `d_max_m` and `min_line_angle_deg` matter.

    Raises
    ------
    IndexFormatError
        More intersections lie close to each other than on any map.
    """
    from scipy.spatial import cKDTree

    options, xy = options or PairOptions(), intersections.xy
    codes = type_codes(intersections)
    pairs = list_pairs(intersections, np.arange(len(xy)), options.d_max_m, options)
    keys = type_keys(codes, pairs)
    order = np.argsort(keys, kind="stable")
    tuples = {}
    for of_type in np.split(pairs[order], np.flatnonzero(np.diff(keys[order])) + 1) if len(pairs) else []:
        ratios = [
            cross_ratios(cotangents(intersections, of_type[:, end], *(xy[of_type[:, 1]] - xy[of_type[:, 0]]).T))
            for end in (0, 1)
        ]
        logs = np.log(np.concatenate(ratios, axis=1))
        tree = cKDTree(logs, balanced_tree=False, compact_nodes=False) if logs.shape[1] else None
        tuples[int(type_keys(codes, of_type[:1])[0])] = Tuples(of_type, tree)
    grid, shape = neighbour_grid(xy, _LEAST_BUCKET_M) if len(xy) else ((0.0, 0.0, 1.0), (1, 1))
    items, starts = sort_by_bucket(xy, grid, shape)
    return PairIndex(intersections, codes, tuples, PairBuckets(xy[items], codes[items], starts, grid, shape))


def list_pairs(found: Intersections, chosen: IntArray, d_max: float, options: PairOptions) -> IntArray:
    """Return the (P, 2) tuples of (chosen) intersections that pass eq. 7-8, the end of lesser code first.

    Raises
    ------
    IndexFormatError
        They would fill the memory.
    """
    from scipy.spatial import cKDTree

    tree = cKDTree(found.xy[chosen])
    if len(chosen) ** 2 > _MAX_TUPLES:
        count = (int(tree.count_neighbors(tree, d_max)) - len(chosen)) // 2
        if count > _MAX_TUPLES:
            raise IndexFormatError(
                f"the map has {count:,} pairs of intersections nearer than {d_max:g} m, expected at most"
                f" {_MAX_TUPLES:,}; the paper's method does not fit it: use the usual one"
            )
    pairs = chosen[tree.query_pairs(d_max, output_type="ndarray").reshape(-1, 2)]
    dx, dy = (found.xy[pairs[:, 1]] - found.xy[pairs[:, 0]]).T
    phi, least = np.arctan2(dy, dx), math.sin(math.radians(options.min_line_angle_deg))
    passes = (dx != 0.0) | (dy != 0.0)
    for end in (0, 1):
        passes &= found.n_tangents[pairs[:, end]] >= 2  # fewer cannot carry a homography (eq. 9)
        for column in range(found.tangents.shape[1]):
            passes &= ~(np.abs(np.sin(found.tangents[pairs[:, end], column] - phi)) <= least)  # NaN: there is none
    pairs, codes = np.sort(pairs[passes], axis=1), type_codes(found)
    swapped = codes[pairs[:, 0]] > codes[pairs[:, 1]]
    pairs[swapped] = pairs[swapped, ::-1]
    return np.asarray(pairs)


def type_codes(intersections: Intersections) -> IntArray:
    """Return the (N,) types of intersections, 16 N_B + N_q."""
    return (16 * intersections.n_branches + intersections.n_tangents).astype(np.int64)


def type_keys(codes: IntArray, pairs: IntArray) -> IntArray:
    """Return the (P,) types of tuples (see `PairIndex.tuples`)."""
    return np.asarray(256 * codes[pairs[:, 0]] + codes[pairs[:, 1]])


def cotangents(found: Intersections, ends: IntArray, dx: FloatArray, dy: FloatArray) -> FloatArray:
    """Return the (P, N_q) cotangents, falling, of the tangents of `ends` (P,), all of one N_q, relative to lines."""
    tangents = found.tangents[ends, : int(found.n_tangents[ends[0]])].astype(float)
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


def well_fitted(index: ReferenceIndex) -> BoolArray:
    """Return which intersections (N,) have branches that are all long and straight enough (section 4.2)."""
    vectors = index.branches.astype(float) / 127.0
    at, column = np.nonzero(vectors.any(axis=2))
    ahead = vectors[at, column]
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    steps = _SKIP_M + np.arange(0.0, _LENGTH_M + 1e-9, _STEP_M)
    points = (index.xy[at, None] + steps[:, None] * ahead[:, None]).reshape(-1, 2)
    along, out = np.repeat(ahead, len(steps), axis=0), np.empty((len(points), 3))
    road_residuals(np.eye(3), points, along, np.full(len(points), _REACH_M), MIN_COS, index.road_buckets, out)
    across = np.column_stack([-along[:, 1], along[:, 0]])
    offsets = (out[:, 0] * (out[:, 1:] * across).sum(axis=1)).reshape(-1, len(steps))
    # Residuals of the line fitted to a branch, which need not meet the intersection; NaN: it is too short.
    basis = np.linalg.qr(np.column_stack([np.ones(len(steps)), steps]))[0]
    error = np.abs(offsets - offsets @ basis @ basis.T).mean(axis=1)
    good = np.ones(len(index), bool)
    good[at[~(error <= _MAX_ERROR_M)]] = False
    return good
