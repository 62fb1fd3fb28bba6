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
from collections.abc import Sequence
from dataclasses import Field, dataclass, fields, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from roadgeo._arrays import FloatArray, IntArray
from roadgeo.geometry.homography import Homography
from roadgeo.kernels.pairs import count_inliers
from roadgeo.matching.pairs import (
    PairIndex,
    TupleOptions,
    cotangents,
    cross_ratios,
    list_pairs,
    type_codes,
    type_keys,
)
from roadgeo.matching.refinement import denormalise, normalise
from roadgeo.matching.scene import MAX_COSTLY
from roadgeo.matching.search import SearchOptions
from roadgeo.roads.intersections import Intersections

__all__ = ["PAPER", "PairMatch", "PairOptions", "match_pairs", "read_options", "thresholds"]

#: Intersections tested in one kernel call, about a tenth of a second: the grain of the limits.
_TESTS_PER_CALL = 5_000_000
#: Seconds of a usual machine, on masks of Liège: for a candidate, and for an intersection that
#: judges a hypothesis. A hypothesis is given up as soon as too many intersections miss.
_TESTED_S, _COUNTED_S = 0.1e-6, 0.04e-6


@dataclass(frozen=True)
class PairOptions(TupleOptions):
    """Thresholds of the paper, by its symbols. Those that the paper states are 0.3, 0.5 and 30, and 15 and 0.5 pixels.

    Attributes
    ----------
    delta : float
        Relative error allowed in every cross ratio (eq. 6).
    delta_inlier : float
        Inlier ratio above which a place is located.
    inlier_distance_m : float
        Greatest distance of a mapped intersection from one of the same type that it matches (delta of eq. 10).
    min_intersections : int
        Queries with fewer are not searched.
    lambda_ : float
        Greatest probability to miss a place that is there (eq. 13).
    lambda_1 : float
        Greatest probability to miss a tuple's counterpart that is there (eq. 14).
    p_query : float
        Probability that a query tuple has its counterpart in the reference (eq. 12).
    orders : {"++", "all"}
        Correspondences of the tangents tried (section 3.2). "++": both ends in the same rotational sense, the only
        physical case, with w > 0 all over the frame; "all": all four, without restriction.
    one_to_one : bool
        Let each reference intersection match once only. False: eq. 10 to the letter.
    rarest_first : bool
        Draw query tuples of types rare in the reference first (section 3.3). False: all types alike.
    refined : bool
        Fit the homography of a place to all its matches. False: the homography of the tuple, by eq. 9, stays.
    work_limit_s, time_limit_s : float
        The search stops after this amount of work, counted in seconds of a usual machine, or this time by the clock.
    """

    delta: float = 0.3
    delta_inlier: float = 0.5
    inlier_distance_m: float = 20.0
    min_intersections: int = 30
    lambda_: float = 0.01
    lambda_1: float = 0.05
    p_query: float = 0.01
    orders: Literal["++", "all"] = "++"
    one_to_one: bool = True
    rarest_first: bool = True
    refined: bool = True
    work_limit_s: float = SearchOptions.work_limit_s
    time_limit_s: float = SearchOptions.time_limit_s

    @property
    def tuples(self) -> TupleOptions:
        """The options that determine a reference's tuples."""
        return TupleOptions(**{option.name: getattr(self, option.name) for option in fields(TupleOptions)})


#: The paper to the letter; what it leaves open stays as it is.
PAPER = PairOptions(from_center=True, orders="all", one_to_one=False, refined=False)

#: Greatest factor between a number that is given and its usual value.
_WIDEST = 20


def thresholds() -> dict[str, Field[Any]]:
    """Return the paper's thresholds by the names that they are given by."""
    return {option.name.rstrip("_"): option for option in fields(PairOptions) if not option.name.endswith("_limit_s")}


def read_options(given: Sequence[str], options: PairOptions) -> PairOptions:
    """Set options that are given as NAME=VALUE: "delta=0.2", "lambda=0.05" or "one_to_one=no".

    Raises
    ------
    ValueError
        There is no such option, or no such value.
    """
    known = thresholds()
    for setting in given:
        name, _, value = setting.partition("=")
        if name not in known:
            raise ValueError(f"{setting!r}, expected NAME=VALUE, NAME one of {', '.join(known)}")
        options = replace(options, **{known[name].name: _read(setting, value, known[name].default)})
    return options


def _read(setting: str, value: str, usual: Any) -> Any:
    """Return the value of a setting: one of several texts, or a number like its `usual` value."""
    if isinstance(usual, (bool, str)):
        texts = {"yes": True, "no": False} if isinstance(usual, bool) else {"++": "++", "all": "all"}
        if value not in texts:
            raise ValueError(f"{setting!r}, expected {' or '.join(texts)}")
        return texts[value]
    low = usual / _WIDEST
    high = 1.0 - low if usual < 1.0 else usual * _WIDEST  # a number usually below 1 stays below
    try:
        number = type(usual)(value)
    except ValueError:
        number = math.nan
    if not low <= number <= high:
        raise ValueError(f"{setting!r}, expected {low:g} to {high:g}")
    return number


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
    n_samples, candidates : int
        Query tuples drawn (l), and the sum of their N_match.
    hypotheses : int
        Homographies whose inliers were counted.
    confidence : float
        Probability that the search, as far as it got, finds a place that is there: 1 - P_fail-sum (eq. 12).
    stopped : str
        Why the search ended: "accepted", "exhausted", or a limit, "work" or "time"; "" without a search.
    work_s : float
        The work done, in seconds of a usual machine.
    """

    homography: FloatArray | None
    matches: IntArray
    inlier_ratio: float
    n_samples: int
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
    frame : (4, 2) float64
        The image's corners in the query plane.
    seed : int
        Seed of the random draws.
    """
    options = options or PairOptions()
    search = _Search(query, index, np.asarray(frame, float), options, np.random.default_rng(seed))
    if len(query) < options.min_intersections:
        return search.report(f"only {len(query)} intersections, {options.min_intersections} are needed")
    for (a, b), key in search.draw_query_tuples():
        search.test(a, b, key)
        if search.homography is not None:
            return search.located(search.homography)
        if search.spent:
            return search.cut_short(search.spent)
    return search.report(
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
        Cotangents of their tangents, relative to the connecting line, in the order in which they correspond.
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
        self.n_samples = self.candidates = self.tested = self.hypotheses = 0
        self.log_p_fail = 0.0

    @property
    def work_s(self) -> float:
        counted = len(self.query) * self.hypotheses
        return _TESTED_S * self.tested + _COUNTED_S * counted

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
        if len(chosen) > MAX_COSTLY:  # all of them still judge hypotheses
            chosen = rng.choice(chosen, MAX_COSTLY, replace=False)
        pairs = list_pairs(self.query, chosen, np.inf, options.delta_angle_deg)
        keys = type_keys(self.codes, pairs)
        order = rng.permutation(np.flatnonzero(np.isin(keys, list(tuples))))
        if options.rarest_first:
            order = order[np.argsort([len(tuples[key].pairs) for key in keys[order].tolist()], kind="stable")]
        drawn = order[: query_draws(options.lambda_, options.lambda_1, options.p_query)]
        return list(zip(pairs[drawn].tolist(), keys[drawn].tolist(), strict=True))

    def correspondences(self, a: int, b: int, key: int) -> list[_Correspondence]:
        """Find the candidates of the query tuple (a, b) by the matching rules (section 3.2, eq. 6)."""
        options, (pairs, tree) = self.options, self.index.tuples[key]
        low, high = math.log1p(-options.delta), math.log1p(options.delta)
        listed = []
        for ends in np.array([(a, b), (b, a)] if self.codes[a] == self.codes[b] else [(a, b)]):
            step = self.query.xy[ends[1]] - self.query.xy[ends[0]]
            falling = [cotangents(self.query, ends[k : k + 1], step[:1], step[1:])[0] for k in (0, 1)]
            for signs in [(1, 1)] if options.orders == "++" else [(1, 1), (1, -1), (-1, 1), (-1, -1)]:
                # Clockwise, angles count the other way round: cotangents change sign and, to fall again, order.
                first, second = (sign * cot[::sign] for sign, cot in zip(signs, falling, strict=True))
                candidates = pairs
                if tree is not None:
                    d_c = np.log(np.concatenate((cross_ratios(first[None]), cross_ratios(second[None])), axis=1))[0]
                    rows = tree.query_ball_point(d_c + (low + high) / 2.0, (high - low) / 2.0, p=np.inf)
                    candidates = pairs[np.sort(np.array(rows, np.int64))]
                listed.append(_Correspondence(ends, (first * signs[0], second * signs[1]), candidates))
        return listed

    def test(self, a: int, b: int, key: int) -> None:
        """Draw candidates for the query tuple (a, b) of type `key` and test them, within the limits."""
        correspondences = self.correspondences(a, b, key)
        n_match = sum(len(correspondence.candidates) for correspondence in correspondences)
        k = reference_draws(n_match, self.options.lambda_1)
        tested = 0
        for correspondence in correspondences:
            n = len(correspondence.candidates)
            tested += self._test(correspondence, min(n, math.ceil(k * n / max(n_match, 1))))
        self.n_samples += 1
        self.candidates += n_match
        self.log_p_fail += math.log1p(-self.options.p_query * (tested / n_match if n_match else 1.0))

    def _test(self, correspondence: _Correspondence, n_draws: int) -> int:
        """Test `n_draws` candidates in random order; return how many the limits allowed."""
        drawn, done = self.rng.permutation(len(correspondence.candidates))[:n_draws], 0
        # The kernel returns now and then, so that the limits are checked.
        per_call = max(1, _TESTS_PER_CALL // len(self.query))
        while done < n_draws and not self.spent:
            some = correspondence.candidates[drawn[done : done + per_call]]
            models = self.models(correspondence, some)
            self.best, row = self.count(models, self.best)
            if row >= 0:
                self.homography = models[row]
            self.hypotheses += len(models)
            self.tested += len(some)
            done += len(some)
        return done

    def models(self, correspondence: _Correspondence, candidates: IntArray) -> FloatArray:
        """Return (H, 3, 3), the possible homographies of candidates from all lines in closed form (eq. 9).

        Both planes are taken to frames where P1 = (0, 0) and P2 = (1, 0): a normalisation under which every homography
        that keeps the connecting line is ``[[a1, b1, 0], [0, 1, 0], [a1 - a2, b1 - b2, a2]]``, and eq. 9 falls apart
        into one linear equation cot r' = a_i cot r + b_i for each tangent at P_i. It is not mirrored and has no horizon
        between the two ends just if a1, a2 > 0.
        """
        reference, (first, second) = self.index.reference, self.query.xy[correspondence.ends]
        step = (reference.xy[candidates[:, 1]] - reference.xy[candidates[:, 0]]).T
        (a1, b1), (a2, b2) = (
            fit_pencils(cot, cotangents(reference, ends, *step))
            for cot, ends in zip(correspondence.cotangents, candidates.T, strict=True)
        )
        zero, unit = np.zeros_like(a1), np.ones_like(a1)
        between = _stacked([[a1, b1, zero], [zero, unit, zero], [a1 - a2, b1 - b2, a2]])
        (x, y), (dx, dy) = reference.xy[candidates[:, 0]].T, step
        from_pair = _stacked([[dx, -dy, x], [dy, dx, y], [zero, zero, unit]])
        (ex, ey), (x, y) = (second - first) / np.sum((second - first) ** 2), first
        into_pair = np.array([[ex, ey, -ex * x - ey * y], [-ey, ex, ey * x - ex * y], [0.0, 0.0, 1.0]])
        models = from_pair @ between @ into_pair
        if self.options.orders == "all":
            return np.asarray(models)
        in_front = (np.column_stack([self.frame, np.ones(4)]) @ models[:, 2].T > 0.0).all(axis=0)
        return np.asarray(models[(a1 > 0.0) & (a2 > 0.0) & in_front])

    def count(self, models: FloatArray, best: int) -> tuple[int, int]:
        """Return the greatest inlier count (eq. 10) and its model, or `best` and -1; see `kernels.pairs`."""
        options = self.options
        xy, codes = self.query.xy[self.judges], self.codes[self.judges]
        radius, one_to_one = options.inlier_distance_m, options.one_to_one
        return count_inliers(models, xy, codes, self.index.buckets, radius, one_to_one, best)

    def matches(self, homography: FloatArray) -> IntArray:
        """Return the (M, 2) matching pairs MP under a homography (eq. 10)."""
        from scipy.spatial import cKDTree

        radius = self.options.inlier_distance_m
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = np.nan_to_num(Homography(homography).everywhere(self.query.xy), nan=1e300, posinf=1e300, neginf=1e300)
        # Types lie further apart than the radius.
        tree = cKDTree(np.column_stack([self.index.reference.xy, 2.0 * radius * self.index.codes]))
        at = np.column_stack([xy, 2.0 * radius * self.codes])
        distance, nearest = tree.query(at, distance_upper_bound=radius)
        inside = np.flatnonzero(np.isfinite(distance))
        if self.options.one_to_one:
            closest_first = inside[np.argsort(distance[inside], kind="stable")]
            inside = np.sort(closest_first[np.unique(nearest[closest_first], return_index=True)[1]])
        return np.column_stack([inside, nearest[inside]])

    def located(self, homography: FloatArray) -> PairMatch:
        """Report the best homography; it is first refined on its matches, as long as that matches more."""
        matches = self.matches(homography)
        for _ in range(5 if self.options.refined else 0):
            refined = fit_points(homography, self.query.xy[matches[:, 0]], self.index.reference.xy[matches[:, 1]])
            rematched = self.matches(refined)
            w = Homography(refined).w(self.frame)
            is_allowed = self.options.orders == "all" or bool(np.all(w * w[0] > 0))
            if len(rematched) < len(matches) or not is_allowed:
                break
            is_stable = np.array_equal(rematched, matches)
            homography, matches = refined, rematched
            if is_stable:
                break
        reason = (
            f"{len(matches)} of {len(self.query)} intersections ({len(matches) / len(self.query):.0%}) match, after"
            f" {self.n_samples} query tuples and {self.hypotheses} hypotheses"
        )
        middle = self.frame.mean(axis=0)
        return self.report(reason, "accepted", homography / Homography(homography).w(middle), matches)

    def cut_short(self, limit: str) -> PairMatch:
        """Report that no place was found before a limit was reached."""
        options = self.options
        ended = "after as much work as a search may take"
        if limit == "time":
            ended = f"at the time limit of {options.time_limit_s:g} s, so that a machine with less to do may find more"
        return self.report(
            f"stopped {ended}; {self.n_samples} query tuples (confidence {self.confidence:.3g}): none matched more "
            f"than {options.delta_inlier:.0%} of the intersections",
            limit,
        )

    def report(
        self, reason: str, stopped: str = "", homography: FloatArray | None = None, matches: IntArray | None = None
    ) -> PairMatch:
        """Report a place, or that none was found."""
        matched = np.empty((0, 2), np.int64) if matches is None else matches
        ratio, seconds = len(matched) / max(len(self.query), 1), time.perf_counter() - self.begin
        counts = self.n_samples, self.candidates, self.hypotheses, self.confidence
        return PairMatch(homography, matched, ratio, *counts, reason, stopped, self.work_s, seconds)


def _stacked(rows: list[list[FloatArray]]) -> FloatArray:
    """Return (C, 3, 3) matrices of three rows of three elements (C,)."""
    return np.moveaxis(np.array(rows), 2, 0)


def fit_pencils(query: FloatArray, reference: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Fit cot r' = alpha cot r + beta to the lines (n,) of a pencil and (C, n) of others: two (C,) arrays.

    It is exact for two lines, gold standard for more: each is weighted by the inverse variance of its equation when all
    angles r, r' carry equal noise (the Sampson error, Hartley & Zisserman 4.2.6), from d cot r = -(1 + cot^2 r) dr.
    """
    alpha = (reference[:, 0] - reference[:, -1]) / (query[0] - query[-1])
    beta = reference[:, 0] - alpha * query[0]
    for _ in range(3 if len(query) > 2 else 0):
        w = 1.0 / ((alpha[:, None] * (1.0 + query**2)) ** 2 + (1.0 + reference**2) ** 2)
        sw, sx, sy, sxx, sxy = ((w * of).sum(axis=1) for of in (1.0, query, reference, query**2, query * reference))
        alpha = (sw * sxy - sx * sy) / (sw * sxx - sx * sx)
        beta = (sy - alpha * sx) / sw
    return alpha, beta


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
