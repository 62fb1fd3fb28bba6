"""The paper's matcher: tuples of two intersections with their tangents, in a hypothesise-and-test search.

Li, Yang, Wang, He, "Road-network-based Rapid Geolocalization" (arXiv 1906.12174), sections 3.2-3.3, complete. Where the
paper leaves a choice open or a step costs nothing but time, this module decides as follows.

- Equal types at both ends leave open which end is which: such a tuple is looked up both ways.
- Candidates are drawn without repetition, so k_i draws (eq. 15) need at most N_match tests.
- The matching pairs of eq. 10 are one to one. Read literally, any number of query intersections may match the same
  one, and an H that shrinks the image to a few streets passes for a place.
- The paper's "gold standard" is the Sampson error of all tangents for each hypothesis, and after the search the
  geometric error of all matched intersections, with guided matching (Hartley & Zisserman, algorithm 4.6).
- Query tuples of a type that the reference does not hold are not drawn.

A fixed inlier ratio separates right from wrong poorly; this is the baseline that other methods are measured against.

Frames: query plane in pixels and reference plane in metres, both y up (see `geometry.mask`); x_ref = H x_query.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import cache
from itertools import combinations
from typing import Literal, NamedTuple

import numpy as np

from roadgeo._arrays import AnyArray, Float32Array, FloatArray, Int32Array, IntArray
from roadgeo.errors import IndexFormatError
from roadgeo.geometry.homography import Homography
from roadgeo.kernels import pairs as kernels
from roadgeo.roads.intersections import Intersections

__all__ = ["PairIndex", "PairMatch", "PairOptions", "build_pair_index", "match_pairs", "query_draws", "reference_draws"]

#: Intersections tested in one kernel call, about a tenth of a second: the grain of the time limit.
_TESTS_PER_CALL = 5_000_000


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
    time_limit_s : float
        The search stops after this many seconds.
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
    time_limit_s: float = 10.0


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

    @property
    def n_bytes(self) -> int:
        """Bytes in all arrays."""
        return sum(array.nbytes for array in self.to_arrays().values())

    def to_arrays(self) -> dict[str, AnyArray]:
        """Return the arrays by name, to be stored."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, AnyArray]) -> PairIndex:
        """Take arrays that `to_arrays` returned, after checking all that the kernels rely on; nothing is copied.

        Raises
        ------
        IndexFormatError
            If an array is missing, has another type or shape, or refers to what is not there.
        """
        checked = {name: _checked_array(arrays, name, *kind) for name, kind in _ARRAY_KINDS.items()}
        index = cls(**checked)
        _check_references(index)
        return index

    def tuples(self, t: int) -> Int32Array:
        """Tuples of type `t`, (P_t, 2), a view."""
        return self.pairs[self.offsets[t] : self.offsets[t + 1]]

    def tree(self, t: int) -> Float32Array:
        """Descriptors of type `t`, (P_t, D_t), a view; D_t = 0 where both ends have two tangents."""
        widths = _descriptor_widths(self.types)
        begin = int(np.dot(np.diff(self.offsets[: t + 1]), widths[:t]))
        n = int(self.offsets[t + 1] - self.offsets[t])
        return self.descriptors[begin : begin + n * widths[t]].reshape(n, widths[t])


#: Type and number of dimensions of the arrays of `PairIndex`.
_ARRAY_KINDS: dict[str, tuple[type, int]] = {
    "types": (np.uint8, 2),
    "offsets": (np.int64, 1),
    "pairs": (np.int32, 2),
    "descriptors": (np.float32, 1),
    "codes": (np.uint8, 1),
    "grid": (np.float64, 1),
    "shape": (np.int64, 1),
    "starts": (np.int32, 1),
    "items": (np.int32, 1),
}


@dataclass(frozen=True)
class PairMatch:
    """What the search found. Dimensions: M matched intersections.

    Attributes
    ----------
    homography : (3, 3) float64 or None
        Query plane to reference plane, w = 1 at the frame's centre. None: not located.
    matches : (M, 2) int64
        Query intersection, and the reference intersection near which it lands.
    inlier_ratio : float
        M over the query's intersections (eq. 10); 0 where not located.
    n_samples : int
        Query tuples drawn (l).
    n_sum : int
        Sum of the k_i of those tuples (eq. 15).
    candidates : int
        Sum of their N_match.
    hypotheses : int
        Homographies whose inliers were counted.
    confidence : float
        Probability that the search, as far as it got, finds a place that is there: 1 - P_fail-sum (eq. 12).
    reason : str
    seconds : float
    """

    homography: FloatArray | None
    matches: IntArray
    inlier_ratio: float
    n_samples: int
    n_sum: int
    candidates: int
    hypotheses: int
    confidence: float
    reason: str
    seconds: float


def query_draws(lambda_: float, lambda_1: float, p_query: float) -> int:
    """Return the number l of query tuples to draw (eq. 16)."""
    return math.floor(math.log(lambda_) / math.log(1.0 - p_query + p_query * lambda_1)) + 1


def reference_draws(n_match: int, lambda_1: float) -> int:
    """Return the number k_i of candidates to draw from N_match, with replacement (eq. 15)."""
    if n_match <= 1:
        return n_match
    return math.floor(math.log(lambda_1) / math.log1p(-1.0 / n_match)) + 1


def build_pair_index(intersections: Intersections, options: PairOptions | None = None) -> PairIndex:
    """Extract, hash and sort the reference's tuples (section 3.3, "Sampling in reference map").

    Parameters
    ----------
    intersections : Intersections
        Reference plane, metres.
    options : PairOptions
        `d_max_m` and `min_line_angle_deg` matter.
    """
    options = options or PairOptions()
    codes = _codes(intersections)
    pairs = _list_pairs(intersections, codes, options.d_max_m, options)
    keys = _keys(codes, pairs)
    order = np.argsort(keys, kind="stable")
    found, sizes = np.unique(keys, return_counts=True)
    types = _types_of_keys(found)
    offsets = np.concatenate(([0], np.cumsum(sizes, dtype=np.int64)))
    xy, tangents = _fixed(intersections.xy, np.float64), _fixed(intersections.tangents, np.float32)
    sorted_pairs, trees = [], []
    for t, d_b in enumerate(types.tolist()):
        of_type = pairs[order[offsets[t] : offsets[t + 1]]]
        subsets, n_first = _subsets(d_b[2], d_b[3])
        tree = np.empty((len(of_type), len(subsets)), np.float32)
        if len(subsets):
            kernels.describe_pairs(of_type, xy, tangents, _fixed(codes, np.uint8), subsets, n_first, tree)
            in_tree = np.arange(len(of_type), dtype=np.int32)
            kernels.order_tree(tree, in_tree)
            of_type, tree = of_type[in_tree], tree[in_tree]
        sorted_pairs.append(of_type)
        trees.append(tree.ravel())
    grid, shape, starts, items = _bucket(intersections.xy)
    return PairIndex(
        types=_fixed(types, np.uint8),
        offsets=_fixed(offsets, np.int64),
        pairs=_fixed(np.concatenate([np.empty((0, 2), np.int32), *sorted_pairs]), np.int32),
        descriptors=_fixed(np.concatenate([np.empty(0, np.float32), *trees]), np.float32),
        codes=_fixed(codes, np.uint8),
        grid=_fixed(grid, np.float64),
        shape=_fixed(shape, np.int64),
        starts=_fixed(starts, np.int32),
        items=_fixed(items, np.int32),
    )


def match_pairs(
    query: Intersections,
    reference: Intersections,
    index: PairIndex,
    frame: FloatArray,
    options: PairOptions | None = None,
    seed: int = 0,
) -> PairMatch:
    """Find the query on the reference (Algorithm 1).

    Parameters
    ----------
    query : Intersections
        Query plane, pixels.
    reference : Intersections
        Reference plane, metres: those that `index` was built from.
    index : PairIndex
    frame : (4, 2) float64
        The image's corners in the query plane.
    options : PairOptions
    seed : int
        Of the random draws.

    Raises
    ------
    ValueError
        If `index` was built from another number of intersections.
    """
    if len(reference) != len(index.codes):
        raise ValueError(
            f"the index holds {len(index.codes)} intersections, the reference {len(reference)}: rebuild it"
        )
    options = options or PairOptions()
    search = _Search(query, reference, index, np.asarray(frame, float), options, np.random.default_rng(seed))
    if len(query) < options.min_intersections:
        return search.not_located(f"only {len(query)} intersections, {options.min_intersections} are needed")
    drawn, types = _draw_query_tuples(search)
    for (a, b), t in zip(drawn.tolist(), types.tolist(), strict=True):
        search.test(a, b, t)
        if search.is_located:
            return search.located()
        if search.is_late:
            return search.not_located(
                f"stopped after {options.time_limit_s:.3g} s and {search.n_samples} query tuples (confidence "
                f"{search.confidence:.3g}): none matched more than {options.delta_inlier:.0%} of the intersections"
            )
    return search.not_located(
        f"no such place (confidence {search.confidence:.3g}): none matched more than {options.delta_inlier:.0%} of the "
        f"intersections in {search.n_samples} query tuples and {search.hypotheses} hypotheses"
    )


class Buckets(NamedTuple):
    """Reference intersections sorted by square cells: cell c = W row + column owns places `starts[c]:starts[c + 1]`.

    Dimensions: N intersections, H rows, W columns.
    """

    origin: FloatArray  # (2,) lower left corner, metres
    cell: float  # side of a cell, metres
    n_rows: int
    n_cols: int
    starts: Int32Array  # (H W + 1,)
    items: Int32Array  # (N,) the intersection at each place
    xy: FloatArray  # (N, 2) its position
    codes: AnyArray  # (N,) uint8, its type


class _Correspondence(NamedTuple):
    """One way in which a query tuple may correspond to reference tuples of its type: which end, which tangent orders.

    Attributes
    ----------
    ends : (int, int)
        Query intersections that become P1 and P2.
    cotangents : two (N_q,) arrays
        Of their tangents, relative to the connecting line, in the order in which they correspond.
    rows : (C,) int32
        Candidates among the tuples of the type; empty: all of them (where there is no cross ratio to tell them apart).
    n_match : int
        Number of candidates.
    """

    ends: tuple[int, int]
    cotangents: tuple[FloatArray, FloatArray]
    rows: Int32Array
    n_match: int


class _Search:
    """Algorithm 1 at work: the best hypothesis so far, and the counts."""

    def __init__(
        self,
        query: Intersections,
        reference: Intersections,
        index: PairIndex,
        frame: FloatArray,
        options: PairOptions,
        rng: np.random.Generator,
    ) -> None:
        self.begin = time.perf_counter()
        self.query, self.index, self.frame, self.options, self.rng = query, index, frame, options, rng
        self.codes = _codes(query)
        self.xy, self.tangents = _fixed(reference.xy, np.float64), _fixed(reference.tangents, np.float32)
        self.buckets = Buckets(
            index.grid[:2],
            float(index.grid[2]),
            int(index.shape[0]),
            int(index.shape[1]),
            index.starts,
            index.items,
            _fixed(reference.xy[index.items], np.float64),
            _fixed(index.codes[index.items], np.uint8),
        )
        # Rare types miss most often where a hypothesis is wrong: they judge first.
        frequency = np.bincount(index.codes, minlength=256)
        self.judges = np.argsort(frequency[self.codes], kind="stable")
        self.best = math.floor(options.delta_inlier * len(query))
        self.homography: FloatArray | None = None
        self.n_samples = self.n_sum = self.candidates = self.hypotheses = 0
        self.log_p_fail = 0.0

    @property
    def is_late(self) -> bool:
        return time.perf_counter() - self.begin > self.options.time_limit_s

    @property
    def is_located(self) -> bool:
        return self.homography is not None

    @property
    def confidence(self) -> float:
        return -math.expm1(self.log_p_fail)

    def test(self, a: int, b: int, t: int) -> None:
        """Draw candidates for the query tuple (a, b) of type `t` and test them, until the time is up."""
        correspondences = _correspondences(self.query, a, b, t, self.index, self.options)
        n_match = sum(c.n_match for c in correspondences)
        k = reference_draws(n_match, self.options.lambda_1)
        tested = 0
        for correspondence in correspondences:
            share = min(correspondence.n_match, math.ceil(k * correspondence.n_match / max(n_match, 1)))
            tested += self._test_correspondence(correspondence, t, share)
        self.n_samples += 1
        self.n_sum += k
        self.candidates += n_match
        p_fail_reference = 1.0 - tested / n_match if n_match else 0.0
        p_query = self.options.p_query
        self.log_p_fail += math.log1p(-p_query * (1.0 - p_fail_reference))

    def _test_correspondence(self, correspondence: _Correspondence, t: int, n_draws: int) -> int:
        """Test `n_draws` candidates in random order; return how many the time allowed."""
        if n_draws == 0:
            return 0
        first, second = self.query.xy[list(correspondence.ends)]
        uv = _to_pair_frame(self.query.xy[self.judges], first, second)
        corners = _to_pair_frame(self.frame, first, second)
        start, stride = _permutation(correspondence.n_match, self.rng)
        stamps = np.full(len(self.index.codes) if self.options.one_to_one else 0, -1, np.int64)
        model = np.empty(8)
        per_call = max(1, _TESTS_PER_CALL // len(uv))
        done = 0
        while done < n_draws and not self.is_late:
            until = min(done + per_call, n_draws)
            best, n_models = kernels.evaluate_pairs(
                uv,
                self.codes[self.judges],
                corners,
                *correspondence.cotangents,
                self.index.tuples(t),
                correspondence.rows,
                np.array([done, until, start, stride]),
                self.xy,
                self.tangents,
                self.buckets,
                self.options.inlier_distance_m,
                self.options.tangent_orders == "++",
                self.best,
                model,
                stamps,
            )
            if best > self.best:
                self.best = best
                self.homography = _pair_homography(model, first, second)
            self.hypotheses += n_models
            done = until
        return done

    def matches(self, homography: FloatArray) -> IntArray:
        """Return the (M, 2) matching pairs MP under a homography (eq. 10)."""
        mapped = np.column_stack([self.query.xy, np.ones(len(self.query))]) @ homography.T
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = mapped[:, :2] / mapped[:, 2:]
        nearest = np.empty(len(xy), np.int32)
        kernels.nearest_of_type(xy, self.codes, self.buckets, self.options.inlier_distance_m, nearest)
        found = np.flatnonzero(nearest >= 0)
        if self.options.one_to_one:
            distance = np.hypot(*(xy[found] - self.xy[nearest[found]]).T)
            closest_first = found[np.argsort(distance, kind="stable")]
            found = np.sort(closest_first[np.unique(nearest[closest_first], return_index=True)[1]])
        return np.column_stack([found, nearest[found]])

    def located(self) -> PairMatch:
        """Refine the best homography on its matches and report it."""
        assert self.homography is not None  # noqa: S101
        homography, matches = self._refine(self.homography)
        ratio = len(matches) / len(self.query)
        reason = (
            f"{len(matches)} of {len(self.query)} intersections ({ratio:.0%}) match, after {self.n_samples} "
            f"query tuples and {self.hypotheses} hypotheses"
        )
        facing = Homography(homography).facing(self.frame.mean(axis=0)).matrix
        facing = facing / (facing[2] @ [*self.frame.mean(axis=0), 1.0])
        return self._report(facing, matches, ratio, reason)

    def _refine(self, homography: FloatArray) -> tuple[FloatArray, IntArray]:
        """Alternate between the gold-standard fit and matching, as long as that matches more."""
        matches = self.matches(homography)
        for _ in range(5):
            refined = _fit_points(homography, self.query.xy[matches[:, 0]], self.xy[matches[:, 1]])
            rematched = self.matches(refined)
            if len(rematched) < len(matches) or not self._is_allowed(refined):
                break
            is_stable = np.array_equal(rematched, matches)
            homography, matches = refined, rematched
            if is_stable:
                break
        return homography, matches

    def _is_allowed(self, homography: FloatArray) -> bool:
        """Say whether the horizon stays out of the frame, where that is asked for."""
        w = self.frame @ homography[2, :2] + homography[2, 2]
        return self.options.tangent_orders == "all" or bool(np.all(w * w[0] > 0))

    def not_located(self, reason: str) -> PairMatch:
        """Report that no place was found."""
        return self._report(None, np.empty((0, 2), np.int64), 0.0, reason)

    def _report(self, homography: FloatArray | None, matches: IntArray, ratio: float, reason: str) -> PairMatch:
        return PairMatch(
            homography,
            matches,
            ratio,
            self.n_samples,
            self.n_sum,
            self.candidates,
            self.hypotheses,
            self.confidence,
            reason,
            time.perf_counter() - self.begin,
        )


def _draw_query_tuples(search: _Search) -> tuple[Int32Array, IntArray]:
    """Draw l query tuples, those of types rare in the reference first, at random within a type.

    Returns
    -------
    tuples : (l, 2) int32
    types : (l,) int64
        Of the reference's types.
    """
    options, rng = search.options, search.rng
    chosen = np.arange(len(search.query))
    if len(chosen) > options.max_tuple_intersections:
        chosen = rng.choice(chosen, options.max_tuple_intersections, replace=False)
    d_max = np.inf if options.d_max_px is None else options.d_max_px
    pairs = _list_pairs(search.query, search.codes, d_max, options, chosen)
    types = _type_table(search.index.types)[_keys(search.codes, pairs)]
    known = rng.permutation(np.flatnonzero(types >= 0))
    frequency = np.diff(search.index.offsets)[types[known]]
    n = query_draws(options.lambda_, options.lambda_1, options.p_query)
    drawn = (known[np.argsort(frequency, kind="stable")] if options.rarest_first else known)[:n]
    return pairs[drawn], types[drawn]


def _correspondences(
    query: Intersections, a: int, b: int, t: int, index: PairIndex, options: PairOptions
) -> list[_Correspondence]:
    """Find the candidates of the query tuple (a, b) by the matching rules (section 3.2, eq. 6)."""
    branches_1, branches_2, tangents_1, tangents_2 = index.types[t].tolist()
    is_symmetric = (branches_1, tangents_1) == (branches_2, tangents_2)
    subsets, n_first = _subsets(tangents_1, tangents_2)
    tree = index.tree(t)
    found = []
    for ends in [(a, b), (b, a)] if is_symmetric else [(a, b)]:
        dx, dy = query.xy[ends[1]] - query.xy[ends[0]]
        falling = [_cotangents(query.tangents[i], math.atan2(dy, dx)) for i in ends]
        for signs in [(1, 1)] if options.tangent_orders == "++" else [(1, 1), (1, -1), (-1, 1), (-1, -1)]:
            # Clockwise, angles count the other way round: cotangents change sign and, to fall again, order.
            first, second = (sign * cot[::sign] for sign, cot in zip(signs, falling, strict=True))
            rows = np.empty(0, np.int32)
            n_match = len(tree)
            if len(subsets):
                d_c = np.empty(len(subsets))
                kernels.cross_ratios(first, subsets[:n_first], d_c[:n_first])
                kernels.cross_ratios(second, subsets[n_first:], d_c[n_first:])
                rows = np.empty(len(tree), np.int32)
                error = options.delta_cross_ratio * d_c
                n_match = kernels.search_tree(tree, d_c - error, d_c + error, rows)
                rows = rows[:n_match]
            cotangents = (first * signs[0], second * signs[1])
            found.append(_Correspondence(ends, cotangents, rows, n_match))
    return found


def _codes(intersections: Intersections) -> AnyArray:
    """Return the (N,) uint8 types of intersections, 16 N_B + N_q."""
    return (16 * intersections.n_branches + intersections.n_tangents).astype(np.uint8)


def _keys(codes: AnyArray, pairs: Int32Array) -> AnyArray:
    """Return the (P,) uint16 hash keys of tuples: the codes of both ends."""
    ends = codes[pairs].astype(np.uint16)
    return ends[:, 0] * np.uint16(256) + ends[:, 1]


def _types_of_keys(keys: AnyArray) -> AnyArray:
    """Return the (T, 4) branch descriptors d_b of hash keys."""
    first, second = keys >> 8, keys & 255
    return np.column_stack([first >> 4, second >> 4, first & 15, second & 15]).astype(np.uint8)


def _type_table(types: AnyArray) -> IntArray:
    """Return the (65536,) hash table from keys to types, -1 where the reference has none."""
    d_b = types.astype(np.int64)
    table = np.full(1 << 16, -1, np.int64)
    table[(16 * d_b[:, 0] + d_b[:, 2]) * 256 + 16 * d_b[:, 1] + d_b[:, 3]] = np.arange(len(types))
    return table


@cache
def _subsets(n_first: int, n_second: int) -> tuple[AnyArray, int]:
    """Return the (D, 4) lines of each cross ratio for two N_q (eq. 4), and how many rows are the first end's."""
    groups = [list(combinations(range(n + 1), 4)) for n in (n_first, n_second)]
    subsets = np.array([*groups[0], *groups[1]], np.uint8).reshape(-1, 4)
    return subsets, len(groups[0])


def _descriptor_widths(types: AnyArray) -> IntArray:
    """Return the (T,) dimensions D_t of the cross-ratio descriptors."""
    return np.array([math.comb(n + 1, 4) + math.comb(m + 1, 4) for _, _, n, m in types.tolist()], np.int64)


def _list_pairs(
    intersections: Intersections, codes: AnyArray, d_max: float, options: PairOptions, chosen: IntArray | None = None
) -> Int32Array:
    """Return the (P, 2) tuples of (chosen) intersections that pass eq. 7-8, canonical end first."""
    xy = _fixed(intersections.xy, np.float64)
    tangents = intersections.tangents.astype(np.float64)
    directions = np.stack([np.cos(tangents), np.sin(tangents)], axis=-1)
    chosen = np.arange(len(xy)) if chosen is None else chosen
    by_x = chosen[np.argsort(xy[chosen, 0], kind="stable")].astype(np.int64)
    arguments = (xy, directions, codes, by_x, float(d_max), math.sin(math.radians(options.min_line_angle_deg)))
    pairs = np.empty((kernels.list_pairs(*arguments, np.empty((0, 2), np.int32)), 2), np.int32)
    kernels.list_pairs(*arguments, pairs)
    return pairs


def _cotangents(tangents: Float32Array, phi: float) -> FloatArray:
    """Return the (N_q,) cotangents of an intersection's tangents relative to a line of direction `phi`, falling."""
    finite = tangents[np.isfinite(tangents)].astype(np.float64)
    return np.sort(1.0 / np.tan(finite - phi))[::-1]


def _permutation(n: int, rng: np.random.Generator) -> tuple[int, int]:
    """Return start and stride of a pseudo-random walk j -> (start + j stride) mod n that meets all of 0..n-1 once."""
    stride = int(rng.integers(1, n)) if n > 1 else 1
    while math.gcd(stride, n) != 1:
        stride = stride % n + 1
    return int(rng.integers(n)), stride


def _to_pair_frame(xy: FloatArray, first: FloatArray, second: FloatArray) -> FloatArray:
    """Take (N, 2) points to the frame where `first` is (0, 0) and `second` is (1, 0), turned and scaled alike."""
    dx, dy = (second - first) / np.sum((second - first) ** 2)
    return np.asarray((xy - first) @ np.array([[dx, -dy], [dy, dx]]))


def _pair_homography(model: FloatArray, first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the (3, 3) homography of a hypothesis (see `kernels.pairs.evaluate_pairs`) on the query plane."""
    alpha_1, beta_1, alpha_2, beta_2, x, y, dx, dy = model
    from_pair_frame = np.array([[dx, -dy, x], [dy, dx, y], [0.0, 0.0, 1.0]])
    in_pair_frame = np.array([[alpha_1, beta_1, 0.0], [0.0, 1.0, 0.0], [alpha_1 - alpha_2, beta_1 - beta_2, alpha_2]])
    ex, ey = (second - first) / np.sum((second - first) ** 2)
    to_pair_frame = np.array(
        [[ex, ey, -ex * first[0] - ey * first[1]], [-ey, ex, ey * first[0] - ex * first[1]], [0, 0, 1]]
    )
    return np.asarray(from_pair_frame @ in_pair_frame @ to_pair_frame)


def _fit_points(homography: FloatArray, query_xy: FloatArray, reference_xy: FloatArray) -> FloatArray:
    """Minimise the squared distances |H x - x'| over all pairs of points by Gauss-Newton, from a given homography.

    Gold standard for errors in the reference plane only (Hartley & Zisserman, section 4.2). Both planes are moved and
    scaled to mean 0 and unit spread first. Returns the given homography where the points cannot carry eight parameters.
    """
    if len(query_xy) < 4:
        return homography
    to_query, to_reference = _normalising(query_xy), _normalising(reference_xy)
    p = query_xy * to_query[0, 0] + to_query[:2, 2]
    target = reference_xy * to_reference[0, 0] + to_reference[:2, 2]
    h = to_reference @ homography @ np.linalg.inv(to_query)
    cost, best = np.inf, h
    for _ in range(10):
        h = h / h[2, 2]
        mapped = p @ h[:, :2].T + h[:, 2]
        image = mapped[:, :2] / mapped[:, 2:]
        residual = target - image
        if not np.sum(residual**2) < cost * (1 - 1e-12):
            break
        cost, best = float(np.sum(residual**2)), h
        rows = np.column_stack([p, np.ones(len(p))]) / mapped[:, 2:]
        zero = np.zeros_like(rows)
        jacobian = np.concatenate(
            [
                np.column_stack([rows, zero, -image[:, :1] * rows[:, :2]]),
                np.column_stack([zero, rows, -image[:, 1:] * rows[:, :2]]),
            ]
        )
        step = np.linalg.lstsq(jacobian, residual.T.ravel(), rcond=None)[0]
        h = h + np.append(step, 0.0).reshape(3, 3)
    return np.asarray(np.linalg.inv(to_reference) @ best @ to_query)


def _normalising(xy: FloatArray) -> FloatArray:
    """Return the (3, 3) similarity that gives points mean 0 and rms distance sqrt 2 (Hartley & Zisserman 4.4.4)."""
    mean = xy.mean(axis=0)
    spread = math.sqrt(np.mean(np.sum((xy - mean) ** 2, axis=1)) / 2)
    scale = 1.0 / spread if spread > 0 else 1.0
    return np.array([[scale, 0.0, -scale * mean[0]], [0.0, scale, -scale * mean[1]], [0.0, 0.0, 1.0]])


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


def _fixed(array: AnyArray, dtype: type) -> AnyArray:
    """Return a contiguous read-only array, so that built, given and memory-mapped arrays share one compiled kernel."""
    fixed = np.ascontiguousarray(array, dtype).view(np.ndarray)
    fixed.setflags(write=False)
    return fixed


def _checked_array(arrays: Mapping[str, AnyArray], name: str, dtype: type, n_dims: int) -> AnyArray:
    """Return one array of a stored index, read-only."""
    if name not in arrays:
        raise IndexFormatError(f"the pair index lacks its array {name!r}: rebuild the index")
    array = np.asarray(arrays[name])
    if array.dtype != dtype or array.ndim != n_dims:
        raise IndexFormatError(
            f"array {name!r} of the pair index is {array.ndim}-d {array.dtype}, not {n_dims}-d {np.dtype(dtype)}: "
            "rebuild the index"
        )
    return _fixed(array, dtype)


def _check_references(index: PairIndex) -> None:
    """Raise `IndexFormatError` unless every number in a stored index points to something in it."""
    n, types = len(index.codes), index.types
    has_shape = types.shape[1] == 4 and index.pairs.shape[1] == 2 and len(index.grid) == 3 and len(index.shape) == 2
    tests: dict[str, Callable[[], bool]] = {
        "shapes": lambda: has_shape and len(index.items) == n,
        "types": lambda: bool(types.max(initial=0) <= 8) and len(np.unique(types, axis=0)) == len(types),
        "codes": lambda: bool((index.codes & 15).max(initial=0) <= 8),
        "offsets": lambda: _are_offsets(index.offsets, len(types), len(index.pairs)),
        "pairs": lambda: _are_below(index.pairs, n),
        "descriptors": lambda: bool(np.diff(index.offsets) @ _descriptor_widths(types) == len(index.descriptors)),
        "grid": lambda: bool(np.isfinite(index.grid).all() and index.grid[2] > 0),
        "shape": lambda: min(index.shape.tolist()) > 0 and math.prod(index.shape.tolist()) == len(index.starts) - 1,
        "starts": lambda: _are_offsets(index.starts, len(index.starts) - 1, n),
        "items": lambda: _are_below(index.items, n),
    }
    for name, test in tests.items():
        if not test():
            raise IndexFormatError(f"the pair index is damaged ({name} out of range): rebuild the index")


def _are_offsets(offsets: AnyArray, n: int, end: int) -> bool:
    """Say whether n runs, one after another, cover 0..end."""
    return bool(len(offsets) == n + 1 and offsets[0] == 0 and offsets[-1] == end and (np.diff(offsets) >= 0).all())


def _are_below(numbers: AnyArray, n: int) -> bool:
    """Say whether all numbers lie in 0..n-1."""
    return len(numbers) == 0 or bool(numbers.min() >= 0 and numbers.max() < n)
