"""The paper's tuples of two intersections, hashed by type, with their cross ratios in search trees (section 3.3)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from itertools import combinations
from typing import Literal

import numpy as np

from roadgeo._arrays import AnyArray, Float32Array, FloatArray, Int32Array, IntArray
from roadgeo.errors import IndexFormatError
from roadgeo.kernels import pairs as kernels
from roadgeo.roads.intersections import Intersections

__all__ = [
    "PairIndex",
    "PairOptions",
    "build_pair_index",
    "fixed",
    "line_subsets",
    "list_pairs",
    "type_codes",
    "type_keys",
    "type_table",
]


#: A dense city of 15,000 intersections has some millions; each takes about 50 bytes while the tables are built.
_MAX_TUPLES = 50_000_000


@dataclass(frozen=True)
class PairOptions:
    """Thresholds of the paper, by its symbols. Those that the paper states are 0.3, 0.5 and 30.

    Attributes
    ----------
    d_max_m : float
        Greatest distance between the two intersections of a reference tuple (eq. 8).
    d_max_px : float or None
        The same on the query, where its ground sampling is known. None: any two of its intersections form a tuple.
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
    discard_poor : bool
        Leave out intersections of the reference whose branches are too short or fit their tangents badly, as section
        4.2 does (see `quality.well_fitted`).
    work_limit_s : float
        The search stops after so much work: seconds of a usual machine, counted, not measured.
    time_limit_s : float
        The same after this time by the clock: the last resort.
    """

    d_max_m: float = 1000.0
    d_max_px: float | None = None
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
    discard_poor: bool = True
    work_limit_s: float = 10.0
    time_limit_s: float = 60.0


@dataclass(frozen=True)
class PairIndex:
    """Reference tuples hashed by type, with one search tree of cross ratios for each type.

    Dimensions: N intersections, T tuple types, P tuples, C buckets.

    Attributes
    ----------
    types : (T, 4) uint8
        Branch descriptors d_b = [N_B(P1), N_B(P2), N_q(P1), N_q(P2)], ascending by (N_B, N_q) of the first end, then
        of the second; the first end is never the greater.
    offsets : (T + 1,) int64
        Type t owns `pairs[offsets[t]:offsets[t + 1]]`.
    pairs : (P, 2) int32
        The intersections of each tuple; within a type in the order of an implicit k-d tree
        (`kernels.pairs.order_tree`).
    descriptors : float32
        Cross ratios d_c of all tuples, one row for each, type after type (eq. 4).
    codes : (N,) uint8
        Types of the intersections, 16 N_B + N_q.
    grid : (3,) float64
        Buckets of the intersections: x and y of the lower left corner, side of a cell; metres.
    shape : (2,) int64
        Rows and columns of buckets.
    starts : (C + 1,) int32
        Bucket c, row by row, owns `items[starts[c]:starts[c + 1]]`.
    items : (N,) int32
        Intersections.
    """

    types: AnyArray
    offsets: IntArray
    pairs: Int32Array
    descriptors: Float32Array
    codes: AnyArray
    grid: FloatArray
    shape: IntArray
    starts: Int32Array
    items: Int32Array

    def __len__(self) -> int:
        """P."""
        return len(self.pairs)

    def tuples(self, t: int) -> Int32Array:
        """Tuples of type `t`, (P_t, 2), a view."""
        return self.pairs[self.offsets[t] : self.offsets[t + 1]]

    def tree(self, t: int) -> Float32Array:
        """Descriptors of type `t`, (P_t, D_t), a view; D_t = 0 where both ends have two tangents."""
        widths = _descriptor_widths(self.types)
        begin = int(np.dot(np.diff(self.offsets[: t + 1]), widths[:t]))
        n = int(self.offsets[t + 1] - self.offsets[t])
        return self.descriptors[begin : begin + n * widths[t]].reshape(n, widths[t])


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
    options = options or PairOptions()
    _require_few(intersections.xy, options.d_max_m)
    codes = type_codes(intersections)
    pairs = list_pairs(intersections, codes, options.d_max_m, options)
    # tuples of one type side by side
    keys = type_keys(codes, pairs)
    order = np.argsort(keys, kind="stable")
    found, sizes = np.unique(keys, return_counts=True)
    types = types_of_keys(found)
    offsets = np.concatenate(([0], np.cumsum(sizes, dtype=np.int64)))
    xy, tangents = fixed(intersections.xy, np.float64), fixed(intersections.tangents, np.float32)
    sorted_pairs, trees = [], []
    for t, d_b in enumerate(types.tolist()):
        of_type = pairs[order[offsets[t] : offsets[t + 1]]]
        subsets, n_first = line_subsets(d_b[2], d_b[3])
        # of each type a tree over the cross ratios of its lines
        tree = np.empty((len(of_type), len(subsets)), np.float32)
        if len(subsets):
            kernels.describe_pairs(of_type, xy, tangents, fixed(codes, np.uint8), subsets, n_first, tree)
            in_tree = np.arange(len(of_type), dtype=np.int32)
            kernels.order_tree(tree, in_tree)
            of_type, tree = of_type[in_tree], tree[in_tree]
        sorted_pairs.append(of_type)
        trees.append(tree.ravel())
    grid, shape, starts, items = _bucket(intersections.xy)
    return PairIndex(
        types=fixed(types, np.uint8),
        offsets=fixed(offsets, np.int64),
        pairs=fixed(np.concatenate([np.empty((0, 2), np.int32), *sorted_pairs]), np.int32),
        descriptors=fixed(np.concatenate([np.empty(0, np.float32), *trees]), np.float32),
        codes=fixed(codes, np.uint8),
        grid=fixed(grid, np.float64),
        shape=fixed(shape, np.int64),
        starts=fixed(starts, np.int32),
        items=fixed(items, np.int32),
    )


def _require_few(xy: FloatArray, d_max_m: float) -> None:
    """Refuse a map whose tuples would fill the memory, before they are listed."""
    from scipy.spatial import cKDTree

    if len(xy) ** 2 <= _MAX_TUPLES:
        return
    tree = cKDTree(xy)
    count = (int(tree.count_neighbors(tree, d_max_m)) - len(xy)) // 2
    if count > _MAX_TUPLES:
        raise IndexFormatError(
            f"the map has {count:,} pairs of intersections nearer than {d_max_m:g} m, expected at most {_MAX_TUPLES:,};"
            " the paper's method does not fit it: use the usual one"
        )


def type_codes(intersections: Intersections) -> AnyArray:
    """Return the (N,) uint8 types of intersections, 16 N_B + N_q."""
    return (16 * intersections.n_branches + intersections.n_tangents).astype(np.uint8)


def type_keys(codes: AnyArray, pairs: Int32Array) -> AnyArray:
    """Return the (P,) uint16 hash keys of tuples: the codes of both ends."""
    ends = codes[pairs].astype(np.uint16)
    return ends[:, 0] * np.uint16(256) + ends[:, 1]


def types_of_keys(keys: AnyArray) -> AnyArray:
    """Return the (T, 4) branch descriptors d_b of hash keys."""
    first, second = keys >> 8, keys & 255
    return np.column_stack([first >> 4, second >> 4, first & 15, second & 15]).astype(np.uint8)


def type_table(types: AnyArray) -> IntArray:
    """Return the (65536,) hash table from keys to types, -1 where the reference has none."""
    d_b = types.astype(np.int64)
    table = np.full(1 << 16, -1, np.int64)
    table[(16 * d_b[:, 0] + d_b[:, 2]) * 256 + 16 * d_b[:, 1] + d_b[:, 3]] = np.arange(len(types))
    return table


@cache
def line_subsets(n_first: int, n_second: int) -> tuple[AnyArray, int]:
    """Return the (D, 4) lines of each cross ratio for two N_q (eq. 4), and how many rows are the first end's."""
    groups = [list(combinations(range(n + 1), 4)) for n in (n_first, n_second)]
    subsets = np.array([*groups[0], *groups[1]], np.uint8).reshape(-1, 4)
    return subsets, len(groups[0])


def _descriptor_widths(types: AnyArray) -> IntArray:
    """Return the (T,) dimensions D_t of the cross-ratio descriptors."""
    return np.array([math.comb(n + 1, 4) + math.comb(m + 1, 4) for _, _, n, m in types.tolist()], np.int64)


def list_pairs(
    intersections: Intersections, codes: AnyArray, d_max: float, options: PairOptions, chosen: IntArray | None = None
) -> Int32Array:
    """Return the (P, 2) tuples of (chosen) intersections that pass eq. 7-8, canonical end first."""
    xy = fixed(intersections.xy, np.float64)
    tangents = intersections.tangents.astype(np.float64)
    directions = np.stack([np.cos(tangents), np.sin(tangents)], axis=-1)
    chosen = np.arange(len(xy)) if chosen is None else chosen
    by_x = chosen[np.argsort(xy[chosen, 0], kind="stable")].astype(np.int64)
    arguments = (xy, directions, codes, by_x, float(d_max), math.sin(math.radians(options.min_line_angle_deg)))
    pairs = np.empty((kernels.list_pairs(*arguments, np.empty((0, 2), np.int32)), 2), np.int32)
    kernels.list_pairs(*arguments, pairs)
    return pairs


def _bucket(xy: FloatArray) -> tuple[FloatArray, IntArray, Int32Array, Int32Array]:
    """Sort intersections into square buckets, about sixteen for each: `grid`, `shape`, `starts`, `items`."""
    if len(xy) == 0:
        return np.array([0.0, 0.0, 1.0]), np.array([1, 1]), np.zeros(2, np.int32), np.empty(0, np.int32)
    low, extent = xy.min(axis=0), np.ptp(xy, axis=0)
    cell = max(math.sqrt(extent[0] * extent[1] / (16 * len(xy))), float(extent.max()) / (16 * len(xy)), 1.0)
    n_cols, n_rows = (extent // cell).astype(np.int64) + 1
    cols, rows = ((xy - low) // cell).astype(np.int64).T
    buckets = rows * n_cols + cols
    starts = np.searchsorted(np.sort(buckets), np.arange(n_rows * n_cols + 1))
    return (
        np.array([low[0], low[1], cell]),
        np.array([n_rows, n_cols]),
        starts.astype(np.int32),
        np.argsort(buckets, kind="stable").astype(np.int32),
    )


def fixed(array: AnyArray, dtype: type) -> AnyArray:
    """Return a contiguous read-only array, so that built, given and memory-mapped arrays share one compiled kernel."""
    fixed = np.ascontiguousarray(array, dtype).view(np.ndarray)
    fixed.setflags(write=False)
    return fixed
