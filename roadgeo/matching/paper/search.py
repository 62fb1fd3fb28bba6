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
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from roadgeo._arrays import Float32Array, FloatArray, Int32Array, IntArray
from roadgeo.geometry.homography import Homography
from roadgeo.kernels import pairs as kernels
from roadgeo.matching.paper.homographies import fit_points, pair_homography, to_pair_frame
from roadgeo.matching.paper.tuples import (
    PairIndex,
    PairOptions,
    fixed,
    line_subsets,
    list_pairs,
    type_codes,
    type_keys,
    type_table,
)
from roadgeo.matching.work import PairWork
from roadgeo.roads.intersections import Intersections

__all__ = ["PairMatch", "match_pairs", "query_draws", "reference_draws"]

#: Intersections tested in one kernel call, about a tenth of a second: the grain of the limits.
_TESTS_PER_CALL = 5_000_000


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
    stopped : str
        What ended the search: "accepted", "exhausted", or a limit, "work" or "time"; "" where there was none.
    work_s : float
        What was done, in seconds of a usual machine (see `work.PairWork`).
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
    stopped: str
    work_s: float
    seconds: float


def query_draws(lambda_: float, lambda_1: float, p_query: float) -> int:
    """Return the number l of query tuples to draw (eq. 16)."""
    return math.floor(math.log(lambda_) / math.log(1.0 - p_query + p_query * lambda_1)) + 1


def reference_draws(n_match: int, lambda_1: float) -> int:
    """Return the number k_i of candidates to draw from N_match, with replacement (eq. 15)."""
    if n_match <= 1:
        return n_match
    return math.floor(math.log(lambda_1) / math.log1p(-1.0 / n_match)) + 1


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
        if search.spent:
            return search.cut_short(search.spent)
    return search.not_located(
        f"no such place (confidence {search.confidence:.3g}): none matched more than {options.delta_inlier:.0%} of the "
        f"intersections in {search.n_samples} query tuples and {search.hypotheses} hypotheses",
        "exhausted",
    )


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
        self.codes = type_codes(query)
        self.xy, self.tangents = fixed(reference.xy, np.float64), fixed(reference.tangents, np.float32)
        self.buckets = kernels.PairBuckets(
            index.grid[:2],
            float(index.grid[2]),
            int(index.shape[0]),
            int(index.shape[1]),
            index.starts,
            index.items,
            fixed(reference.xy[index.items], np.float64),
            fixed(index.codes[index.items], np.uint8),
        )
        # Rare types miss most often where a hypothesis is wrong: they judge first.
        frequency = np.bincount(index.codes, minlength=256)
        self.judges = np.argsort(frequency[self.codes], kind="stable")
        self.best = math.floor(options.delta_inlier * len(query))
        self.homography: FloatArray | None = None
        self.n_samples = self.n_sum = self.candidates = self.tested = self.hypotheses = 0
        self.log_p_fail = 0.0

    @property
    def work_s(self) -> float:
        return PairWork(self.n_samples, self.tested, self.hypotheses, len(self.query)).seconds

    @property
    def spent(self) -> str:
        """Say which limit is reached: "work", "time", or "" for neither."""
        if self.work_s >= self.options.work_limit_s:
            return "work"
        return "time" if time.perf_counter() - self.begin > self.options.time_limit_s else ""

    @property
    def is_located(self) -> bool:
        return self.homography is not None

    @property
    def confidence(self) -> float:
        return -math.expm1(self.log_p_fail)

    def test(self, a: int, b: int, t: int) -> None:
        """Draw candidates for the query tuple (a, b) of type `t` and test them, within the limits."""
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
        """Test `n_draws` candidates in random order; return how many the limits allowed."""
        if n_draws == 0:
            return 0
        first, second = self.query.xy[list(correspondence.ends)]
        uv = to_pair_frame(self.query.xy[self.judges], first, second)
        corners = to_pair_frame(self.frame, first, second)
        query = kernels.PairQuery(uv, self.codes[self.judges], corners, *correspondence.cotangents)
        start, stride = _permutation(correspondence.n_match, self.rng)
        stamps = np.full(len(self.index.codes) if self.options.one_to_one else 0, -1, np.int64)
        model = np.empty(8)
        # The kernel comes back now and then, for a look at the limits.
        per_call = max(1, _TESTS_PER_CALL // len(uv))
        done = 0
        while done < n_draws and not self.spent:
            until = min(done + per_call, n_draws)
            best, n_models = kernels.evaluate_pairs(
                query,
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
                self.homography = pair_homography(model, first, second)
            self.hypotheses += n_models
            self.tested += until - done
            done = until
        return done

    def matches(self, homography: FloatArray) -> IntArray:
        """Return the (M, 2) matching pairs MP under a homography (eq. 10)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = Homography(homography).everywhere(self.query.xy)
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
        return self._report(facing, matches, ratio, reason, "accepted")

    def _refine(self, homography: FloatArray) -> tuple[FloatArray, IntArray]:
        """Alternate between the gold-standard fit and matching, as long as that matches more."""
        matches = self.matches(homography)
        for _ in range(5):
            refined = fit_points(homography, self.query.xy[matches[:, 0]], self.xy[matches[:, 1]])
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

    def cut_short(self, limit: str) -> PairMatch:
        """Report that no place was found before a limit was reached."""
        options = self.options
        ended = "after as much work as a search may take"
        if limit == "time":
            ended = f"at the time limit of {options.time_limit_s:g} s, so that a machine with less to do may find more"
        return self.not_located(
            f"stopped {ended}; {self.n_samples} query tuples (confidence {self.confidence:.3g}): none matched more "
            f"than {options.delta_inlier:.0%} of the intersections",
            limit,
        )

    def not_located(self, reason: str, stopped: str = "") -> PairMatch:
        """Report that no place was found."""
        return self._report(None, np.empty((0, 2), np.int64), 0.0, reason, stopped)

    def _report(
        self, homography: FloatArray | None, matches: IntArray, ratio: float, reason: str, stopped: str
    ) -> PairMatch:
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
            stopped,
            self.work_s,
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
    pairs = list_pairs(search.query, search.codes, d_max, options, chosen)
    types = type_table(search.index.types)[type_keys(search.codes, pairs)]
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
    subsets, n_first = line_subsets(tangents_1, tangents_2)
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
