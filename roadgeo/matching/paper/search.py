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

from roadgeo._arrays import FloatArray, IntArray
from roadgeo.geometry.homography import Homography
from roadgeo.kernels import pairs as kernels
from roadgeo.matching.paper.tuples import (
    PairIndex,
    PairOptions,
    cotangents,
    cross_ratios,
    list_pairs,
    type_codes,
    type_keys,
)
from roadgeo.matching.refinement import denormalise, normalise
from roadgeo.roads.intersections import Intersections

__all__ = ["PairMatch", "match_pairs", "query_draws", "reference_draws"]

#: Intersections tested in one kernel call, about a tenth of a second: the grain of the limits.
_TESTS_PER_CALL = 5_000_000
#: Seconds of a usual machine, on masks of Liège: of a query tuple, of a candidate, and of an intersection by which a
#: hypothesis is judged, which is given up as soon as too many miss.
_SAMPLE_S, _TESTED_S, _COUNTED_S = 0.35e-3, 0.1e-6, 0.04e-6


@dataclass(frozen=True)
class PairMatch:
    """The result of the search. Dimensions: M matched intersections.

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
    stopped : str
        Why the search ended: "accepted", "exhausted", or a limit, "work" or "time"; "" where there was none.
    work_s : float
        The work done, in seconds of a usual machine.
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
    query: Intersections, index: PairIndex, frame: FloatArray, options: PairOptions | None = None, seed: int = 0
) -> PairMatch:
    """Find the query on the reference (Algorithm 1).

    Parameters
    ----------
    query : Intersections
        Query plane, pixels.
    index : PairIndex
    frame : (4, 2) float64
        The image's corners in the query plane.
    options : PairOptions
    seed : int
        Of the random draws.
    """
    options = options or PairOptions()
    search = _Search(query, index, np.asarray(frame, float), options, np.random.default_rng(seed))
    if len(query) < options.min_intersections:
        return search.not_located(f"only {len(query)} intersections, {options.min_intersections} are needed")
    for (a, b), key in search.draw_query_tuples():
        search.test(a, b, key)
        if search.homography is not None:
            return search.located(search.homography)
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
    ends : (2,) int64
        Query intersections that become P1 and P2.
    cotangents : two (N_q,) arrays
        Of their tangents, relative to the connecting line, in the order in which they correspond.
    candidates : (C, 2) int64
        Reference tuples with like cross ratios.
    """

    ends: IntArray
    cotangents: tuple[FloatArray, FloatArray]
    candidates: IntArray


class _Search:
    """Algorithm 1 under way: the best hypothesis until now, and the counts."""

    def __init__(
        self,
        query: Intersections,
        index: PairIndex,
        frame: FloatArray,
        options: PairOptions,
        rng: np.random.Generator,
    ) -> None:
        self.begin = time.perf_counter()
        self.query, self.index, self.frame, self.options, self.rng = query, index, frame, options, rng
        self.codes = type_codes(query)
        # Rare types miss most often where a hypothesis is wrong: they judge first.
        self.judges = np.argsort(np.bincount(index.codes, minlength=256)[self.codes], kind="stable")
        self.best = math.floor(options.delta_inlier * len(query))
        self.homography: FloatArray | None = None
        self.n_samples = self.n_sum = self.candidates = self.tested = self.hypotheses = 0
        self.log_p_fail = 0.0

    @property
    def work_s(self) -> float:
        counted = len(self.query) * self.hypotheses
        return _SAMPLE_S * self.n_samples + _TESTED_S * self.tested + _COUNTED_S * counted

    @property
    def spent(self) -> str:
        """Return which limit is reached: "work", "time", or "" for neither."""
        if self.work_s >= self.options.work_limit_s:
            return "work"
        return "time" if time.perf_counter() - self.begin > self.options.time_limit_s else ""

    @property
    def confidence(self) -> float:
        return -math.expm1(self.log_p_fail)

    def draw_query_tuples(self) -> list[tuple[list[int], int]]:
        """Draw l query tuples with their types, those rare in the reference first, at random within a type."""
        options, rng, tuples = self.options, self.rng, self.index.tuples
        chosen = np.arange(len(self.query))
        if len(chosen) > options.max_tuple_intersections:
            chosen = rng.choice(chosen, options.max_tuple_intersections, replace=False)
        pairs = list_pairs(self.query, chosen, np.inf, options)
        keys = type_keys(self.codes, pairs)
        order = rng.permutation(np.flatnonzero(np.isin(keys, list(tuples))))
        if options.rarest_first:
            order = order[np.argsort([len(tuples[key].pairs) for key in keys[order].tolist()], kind="stable")]
        drawn = order[: query_draws(options.lambda_, options.lambda_1, options.p_query)]
        return list(zip(pairs[drawn].tolist(), keys[drawn].tolist(), strict=True))

    def correspondences(self, a: int, b: int, key: int) -> list[_Correspondence]:
        """Find the candidates of the query tuple (a, b) by the matching rules (section 3.2, eq. 6)."""
        options, (pairs, tree) = self.options, self.index.tuples[key]
        low, high = math.log1p(-options.delta_cross_ratio), math.log1p(options.delta_cross_ratio)
        found = []
        for ends in np.array([(a, b), (b, a)] if self.codes[a] == self.codes[b] else [(a, b)]):
            step = self.query.xy[ends[1]] - self.query.xy[ends[0]]
            falling = [cotangents(self.query, ends[k : k + 1], step[:1], step[1:])[0] for k in (0, 1)]
            for signs in [(1, 1)] if options.tangent_orders == "++" else [(1, 1), (1, -1), (-1, 1), (-1, -1)]:
                # Clockwise, angles count the other way round: cotangents change sign and, to fall again, order.
                first, second = (sign * cot[::sign] for sign, cot in zip(signs, falling, strict=True))
                candidates = pairs
                if tree is not None:
                    d_c = np.log(np.concatenate((cross_ratios(first[None]), cross_ratios(second[None])), axis=1))[0]
                    rows = tree.query_ball_point(d_c + (low + high) / 2.0, (high - low) / 2.0, p=np.inf)
                    candidates = pairs[np.sort(np.array(rows, np.int64))]
                found.append(_Correspondence(ends, (first * signs[0], second * signs[1]), candidates))
        return found

    def test(self, a: int, b: int, key: int) -> None:
        """Draw candidates for the query tuple (a, b) of type `key` and test them, within the limits."""
        correspondences = self.correspondences(a, b, key)
        n_match = sum(len(one.candidates) for one in correspondences)
        k = reference_draws(n_match, self.options.lambda_1)
        tested = 0
        for one in correspondences:
            n = len(one.candidates)
            tested += self._test(one, min(n, math.ceil(k * n / max(n_match, 1))))
        self.n_samples += 1
        self.n_sum += k
        self.candidates += n_match
        self.log_p_fail += math.log1p(-self.options.p_query * (tested / n_match if n_match else 1.0))

    def _test(self, one: _Correspondence, n_draws: int) -> int:
        """Test `n_draws` candidates in random order; return how many the limits allowed."""
        first, second = self.query.xy[one.ends]
        seen = kernels.PairQuery(
            to_pair_frame(self.query.xy[self.judges], first, second),
            self.codes[self.judges],
            to_pair_frame(self.frame, first, second),
            *one.cotangents,
        )
        model, drawn = np.empty(8), self.rng.permutation(len(one.candidates))[:n_draws]
        # The kernel comes back now and then, for a look at the limits.
        per_call, done = max(1, _TESTS_PER_CALL // len(seen.uv)), 0
        while done < n_draws and not self.spent:
            some = one.candidates[drawn[done : done + per_call]]
            best, n_models = kernels.evaluate_pairs(
                seen, some, self.index.reference.xy, self.index.reference.tangents, self.index.buckets,
                self.options.inlier_distance_m, self.options.tangent_orders == "++", self.options.one_to_one,
                self.best, model,
            )  # fmt: skip
            if best > self.best:
                self.best, self.homography = best, pair_homography(model, first, second)
            self.hypotheses += n_models
            self.tested += len(some)
            done += len(some)
        return done

    def matches(self, homography: FloatArray) -> IntArray:
        """Return the (M, 2) matching pairs MP under a homography (eq. 10)."""
        from scipy.spatial import cKDTree

        reference, codes = self.index.reference, self.index.codes
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = np.nan_to_num(Homography(homography).everywhere(self.query.xy), nan=1e300, posinf=1e300, neginf=1e300)
        nearest, distance = np.full(len(xy), -1), np.full(len(xy), np.inf)
        for code in np.unique(self.codes):
            here, there = np.flatnonzero(self.codes == code), np.flatnonzero(codes == code)
            if len(there):
                away, found = cKDTree(reference.xy[there]).query(
                    xy[here], distance_upper_bound=self.options.inlier_distance_m
                )
                near = np.isfinite(away)
                nearest[here[near]], distance[here[near]] = there[found[near]], away[near]
        found = np.flatnonzero(nearest >= 0)
        if self.options.one_to_one:
            closest_first = found[np.argsort(distance[found], kind="stable")]
            found = np.sort(closest_first[np.unique(nearest[closest_first], return_index=True)[1]])
        return np.column_stack([found, nearest[found]])

    def located(self, homography: FloatArray) -> PairMatch:
        """Refine the best homography on its matches, as long as that matches more, and report it."""
        matches = self.matches(homography)
        for _ in range(5):
            refined = fit_points(homography, self.query.xy[matches[:, 0]], self.index.reference.xy[matches[:, 1]])
            rematched = self.matches(refined)
            w = Homography(refined).w(self.frame)
            is_allowed = self.options.tangent_orders == "all" or bool(np.all(w * w[0] > 0))
            if len(rematched) < len(matches) or not is_allowed:
                break
            is_stable = np.array_equal(rematched, matches)
            homography, matches = refined, rematched
            if is_stable:
                break
        ratio, middle = len(matches) / len(self.query), self.frame.mean(axis=0)
        reason = (
            f"{len(matches)} of {len(self.query)} intersections ({ratio:.0%}) match, after {self.n_samples} "
            f"query tuples and {self.hypotheses} hypotheses"
        )
        return self._report(homography / Homography(homography).w(middle), matches, reason, "accepted")

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
        return self._report(None, np.empty((0, 2), np.int64), reason, stopped)

    def _report(self, homography: FloatArray | None, matches: IntArray, reason: str, stopped: str) -> PairMatch:
        ratio, seconds = len(matches) / max(len(self.query), 1), time.perf_counter() - self.begin
        counts = self.n_samples, self.n_sum, self.candidates, self.hypotheses, self.confidence
        return PairMatch(homography, matches, ratio, *counts, reason, stopped, self.work_s, seconds)


# --- homographies -----------------------------------------------------------------------------------------------------


def to_pair_frame(xy: FloatArray, first: FloatArray, second: FloatArray) -> FloatArray:
    """Take (N, 2) points to the frame where `first` is (0, 0) and `second` is (1, 0), turned and scaled alike."""
    dx, dy = (second - first) / np.sum((second - first) ** 2)
    return np.asarray((xy - first) @ np.array([[dx, -dy], [dy, dx]]))


def pair_homography(model: FloatArray, first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the (3, 3) homography of a hypothesis (see `kernels.pairs.evaluate_pairs`) on the query plane."""
    alpha_1, beta_1, alpha_2, beta_2, x, y, dx, dy = model
    from_pair_frame = np.array([[dx, -dy, x], [dy, dx, y], [0.0, 0.0, 1.0]])
    in_pair_frame = np.array([[alpha_1, beta_1, 0.0], [0.0, 1.0, 0.0], [alpha_1 - alpha_2, beta_1 - beta_2, alpha_2]])
    (ex, ey), (x, y) = (second - first) / np.sum((second - first) ** 2), first
    into_pair_frame = np.array([[ex, ey, -ex * x - ey * y], [-ey, ex, ey * x - ex * y], [0.0, 0.0, 1.0]])
    return np.asarray(from_pair_frame @ in_pair_frame @ into_pair_frame)


def fit_points(homography: FloatArray, query_xy: FloatArray, reference_xy: FloatArray) -> FloatArray:
    """Minimise the squared distances |H x - x'| over all pairs of points, from a given homography.

    Gold standard for errors in the reference plane only (Hartley & Zisserman, section 4.2). Returns the given
    homography where the points cannot carry eight parameters.
    """
    from scipy.optimize import least_squares

    if len(query_xy) < 4:
        return homography
    middle, spread = query_xy.mean(axis=0), float(query_xy.std()) or 1.0
    p, origin, unit = normalise(homography, middle, spread)
    uv, places = (query_xy - middle) / spread, (reference_xy - origin) / unit

    def off(p: FloatArray) -> FloatArray:
        return np.asarray((Homography(np.append(p, 1.0).reshape(3, 3)).everywhere(uv) - places).ravel())

    return denormalise(least_squares(off, p, method="lm", xtol=1e-12, ftol=1e-12).x, middle, spread, origin, unit)
