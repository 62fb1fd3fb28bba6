"""The two methods of finding a query on one reference: triples of intersections, and the paper's pairs."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TypeAlias

import numpy as np

from roadgeo._arrays import FloatArray, IntArray
from roadgeo.geometry.camera import sampling
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.projection import from_lonlat, metres_apart, to_lonlat
from roadgeo.location import Stats
from roadgeo.matching.estimator import MatchOptions, TripleEstimator
from roadgeo.matching.events import Events, Ledger
from roadgeo.matching.evidence import agreement, statement_px
from roadgeo.matching.finishing import measure_corners
from roadgeo.matching.growing import Hypothesis, SharedSweeps
from roadgeo.matching.index import ReferenceIndex, crop, unpack_tangents
from roadgeo.matching.lens import straighten_scene
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.pairs import PairIndex, build_pair_index, well_fitted
from roadgeo.matching.paper import PairOptions, match_pairs
from roadgeo.matching.parts import Part, Whole, same_within_m
from roadgeo.matching.picture import Picture
from roadgeo.matching.rivals import Rivals, Standing
from roadgeo.matching.road_search import COARSE_PIXEL_M
from roadgeo.matching.scene import Query
from roadgeo.matching.search import Ahead, Search, search_together
from roadgeo.matching.triples import larger
from roadgeo.roads.intersections import Intersections, unpack_branches
from roadgeo.storage.memory import let_pages_go

__all__ = ["N_PLACES", "Fit", "Found", "Known", "search_references"]


#: Limit of work for a first look at coarse maps, seconds.
_FIRST_LOOK_S = 0.03
#: Places that a refusal lists at most.
N_PLACES = 5


@dataclass(frozen=True)
class Fit:
    """A place on a reference where the query fits. Dimension: N intersections of the query.

    Attributes
    ----------
    index : ReferenceIndex
        The reference, or the part of it that was searched.
    matrix : (3, 3) float64
        Query plane to reference plane.
    matched, distance : (N,) int, (N,) float64
        Intersection of `index` that matches each query intersection, or -1, and the distance between them, metres.
    agreeing : float
        Share of the query's roads that agree.
    log10_odds : float
        Lead of the place over any other; NaN if the method has no scores.
    log10_likelihood, statement_px : float
        See `evidence`.
    corner_sigma_m, corner_covariance_m2, lens_k1
        See `Refined`.
    agreement : float
        Mean of the shares of intersections, of the query's roads and of the map's roads that agree.
    """

    index: ReferenceIndex
    matrix: FloatArray
    matched: IntArray
    distance: FloatArray
    agreeing: float = math.nan
    log10_odds: float = math.nan
    log10_likelihood: float = -math.inf
    corner_sigma_m: FloatArray | None = None
    corner_covariance_m2: FloatArray | None = None
    lens_k1: float = 0.0
    agreement: float = math.nan
    statement_px: float = 1.0

    @property
    def explained(self) -> float:
        """Likelihood, scaled so that places of different scale compare (see `evidence.statement_px`)."""
        return self.log10_likelihood * self.statement_px


@dataclass(frozen=True)
class Found:
    """The result of the search of one reference.

    Attributes
    ----------
    index : ReferenceIndex
        The whole reference.
    fits : tuple of Fit
        The likeliest place and its best rival, if they exist: the answer is based on them.
    stopped : str
        As in `Search`; "" if no map was searched.
    said : str
        The method's own sentence on the result.
    n_searched, n_tried, n_anchors : int
        Intersections of the part of the reference that was searched, places screened, and intersections of the query
        that were looked up.
    further : tuple of Fit
        Other verified places, the best first: they are shown, no more.
    """

    index: ReferenceIndex
    fits: tuple[Fit, ...] = ()
    stopped: str = ""
    said: str = ""
    n_searched: int = 0
    n_tried: int = 0
    n_anchors: int = 0
    stats: Stats = field(default_factory=Stats)
    match_s: float = 0.0
    refine_s: float = 0.0
    events: Events = field(default_factory=Events)
    further: tuple[Fit, ...] = ()

    def less_likely(self, log10: float) -> Found:
        """Return the result with all places less likely by a number: they could have agreed by chance more often."""
        fits, further = (
            tuple(replace(fit, log10_odds=fit.log10_odds - log10) for fit in some) for some in (self.fits, self.further)
        )
        return replace(self, fits=fits, further=further)


#: A map, and a place on it, (3, 3), where a query is known to fit, or did once.
Known: TypeAlias = tuple[ReferenceIndex, FloatArray]


def search_references(
    query: Query,
    parts: Sequence[Part],
    options: LocateOptions,
    time_limit_s: float,
    explained: bool = False,
    known: Sequence[Known] = (),
) -> list[Found]:
    """Search references, or parts of them, for a query together, by the method and within the limits of the options.

    Parts that cannot contain the place are not opened, and have no result; if no part can, the first is opened. Coarse
    maps come first: if a place stands out on them, the others are not opened. Events are kept if the search is to be
    `explained`. Places that are `known` are verified first.
    """
    coarse, fine = _split(parts, options)
    with Ahead(options.threads) as ahead:
        if not coarse or not fine or options.method == "pair":
            return _search(query, coarse + fine, options, time_limit_s, explained, ahead, known)
        started = time.perf_counter()
        found = _search(query, coarse, _at_first_look(coarse, options), time_limit_s, explained, ahead, known)
        if any(one.stopped == "accepted" for one in found):
            return found
        spent_s = time.perf_counter() - started
        first, *others = _search(query, coarse + fine, options, time_limit_s - spent_s, explained, ahead, known)
        return [replace(first, match_s=first.match_s + spent_s), *others]


def _split(parts: Sequence[Part], options: LocateOptions) -> tuple[list[Part], list[Part]]:
    """Return the coarse maps, unless pixels are too small for them, and the others."""
    coarse = [part for part in parts if part.coarseness > 1.0]
    fine = [part for part in parts if part.coarseness == 1.0]
    largest_m = options.match.camera.gsd_m[1]
    return [one for one in coarse if largest_m > one.coarseness * COARSE_PIXEL_M or not fine], fine


def _at_first_look(coarse: Sequence[Part], options: LocateOptions) -> LocateOptions:
    """Return the options for a search of coarse maps alone: a quick search, unless pixels are large enough for them."""
    least_m = options.match.camera.gsd_m[0]
    if all(least_m >= one.coarseness * COARSE_PIXEL_M for one in coarse):
        return options
    search = replace(options.search, work_limit_s=min(_FIRST_LOOK_S, options.search.work_limit_s))
    return replace(options, effort="quick", search=search)


def _search(
    query: Query,
    parts: Sequence[Part],
    options: LocateOptions,
    time_limit_s: float,
    explained: bool,
    ahead: Ahead,
    known: Sequence[Known],
) -> list[Found]:
    """Search parts together."""
    frame_m = 2.0 * query.scene.half_size * options.match.camera.gsd_m[1]
    indexes = _open(parts, options, frame_m)
    if len(indexes) > 1:  # every search reads all tables, but few roads: those that masks before this one led to go
        let_pages_go(array for index in indexes for array in index.road_buckets[:3])
    if len(query.scene.intersections) == 0:
        return [Found(index, events=Events(explained)) for index in indexes]
    if options.method == "pair":
        return _search_pairs_in_turn(query, indexes, options, time_limit_s)
    started, ledger = time.perf_counter(), Ledger()
    sweeps: SharedSweeps = SharedSweeps(query.scene, options.match.camera, _same_place, ahead)
    begun = [_begin(query, one, options, Events(explained), ledger, sweeps) for one in indexes]
    for found, estimator in begun:
        if estimator is not None and known:
            here = (matrix for index, matrix in known if index is found.index)
            estimator.known = [Hypothesis.at(matrix, query.scene, estimator.index) for matrix in here]
    estimators = {Search(estimator): estimator for _, estimator in begun if estimator is not None}
    ledger.n_reference = sum(found.n_searched for found, estimator in begun if estimator is not None)
    left = time_limit_s - (time.perf_counter() - started)

    scale = larger(sum(found.n_searched for found, _ in begun))
    limits = replace(options.search, time_limit_s=left, work_limit_s=scale * options.search.work_limit_s)
    rivals = Rivals(estimators, ledger, options.min_log10_odds, left, _same_ground)
    search_together(list(estimators), limits, rivals)
    sweeps.end()
    searches = iter(estimators)
    return [found if one is None else _end(found, one, next(searches), rivals, scale) for found, one in begun]


def _open(parts: Sequence[Part], options: LocateOptions, frame_m: float) -> list[ReferenceIndex]:
    """Open the parts that may contain the place, or else the first, to report that."""
    able = [part for part in parts if may_show(part, options, frame_m)]
    return [part.open() for part in able or parts[:1]]


def may_show(part: Part, options: LocateOptions, frame_m: float) -> bool:
    """Return whether a frame of at most this size may lie on a part, given the user's hints; opens nothing."""
    near, within = options.near, options.match.within
    return (near is None or part.may_hold(near, frame_m)) and (within is None or part.touches(within))


def _same_ground(one: TripleEstimator, a: Hypothesis, other: TripleEstimator, b: Hypothesis) -> bool:
    """Return whether hypotheses on two parts are the same place."""
    places = [
        to_lonlat(estimator.index.plane.crs, estimator.index.plane.to_crs(estimator.center(model)[None]))[0]
        for estimator, model in ((one, a), (other, b))
    ]
    return metres_apart(*places) <= same_within_m(one.index, other.index, b.matrix, other.scene.size)


def _same_place(one: TripleEstimator, a: Hypothesis, other: TripleEstimator, b: Hypothesis) -> bool:
    """Return whether hypotheses on two shards of a map are the same place."""
    shard_of = one.index.meta.get("shard_of")
    return bool(shard_of) and shard_of == other.index.meta.get("shard_of") and _same_ground(one, a, other, b)


def _begin(
    query: Query,
    index: ReferenceIndex,
    options: LocateOptions,
    events: Events,
    ledger: Ledger,
    sweeps: SharedSweeps,
) -> tuple[Found, TripleEstimator | None]:
    """Return a result without places, and the estimator, or None if the reference has no intersection near the hint."""
    part, near, within = index, _near(index, options.near), options.match.within
    if within is not None and not Whole(index).touches(within):
        return Found(index, events=events), None
    if near is not None:
        reach = _rounded_up(near[2] + 2.0 * query.scene.half_size * options.match.camera.gsd_m[1])
        part = _part(index, near[:2], reach)
        if len(part) == 0:
            return Found(index, events=events), None
    estimator = TripleEstimator(query.scene, part, _of_effort(options), near, events, ledger, sweeps, index)
    return Found(index, n_searched=len(part), events=events), estimator


def _end(found: Found, estimator: TripleEstimator, search: Search[Hypothesis], rivals: Rivals, scale: float) -> Found:
    """Return the result with its places; work is divided by `scale`, as on a map of usual size."""
    standing = rivals.standing(search)
    if found.events.kept:
        found.events.result = search
    fits = () if standing is None else _fits(estimator, standing)
    further = () if standing is None else _further(estimator, standing, N_PLACES - len(fits))
    if estimator.scene.probability is not None and fits:
        fits, further = _by_picture(estimator, fits, further)
    work_ms = round(1000 * estimator.work / scale)
    counts = estimator.n_tuples, estimator.n_candidates, estimator.n_hypotheses, estimator.n_verified
    return replace(
        found,
        fits=fits,
        further=further,
        stopped=search.stopped,
        n_tried=estimator.n_screened,
        n_anchors=estimator.n_anchors,
        stats=Stats(*counts, work_ms),
        match_s=search.seconds - estimator.refine_s,
        refine_s=estimator.refine_s,
    )


def _fits(estimator: TripleEstimator, standing: Standing) -> tuple[Fit, ...]:
    """Return the likeliest place and its best rival."""
    model, lead = standing.model, standing.log10_lead
    measure_corners(estimator, model, lead)
    fits = [_fit(estimator, model, lead)]
    if standing.rival is not None:
        fits.append(_fit_of_rival(estimator, standing.rival, min(-lead, 0.0), standing.rival_likelihood))
    counted_px = statement_px(sampling(model.matrix, estimator.scene.size))
    return tuple(replace(fit, statement_px=counted_px) for fit in fits if fit is not None)


def _further(estimator: TripleEstimator, standing: Standing, most: int) -> tuple[Fit, ...]:
    """Return the likeliest verified places besides the two that the answer rests on."""
    likeliest, lead = standing.model, min(-standing.log10_lead, 0.0)
    known = [likeliest]
    if standing.rival is not None:
        known.append(Hypothesis.at(standing.rival, estimator.scene, estimator.index))
    counted_px = statement_px(sampling(likeliest.matrix, estimator.scene.size))
    further: list[Fit] = []
    for model in sorted(estimator.verified, key=lambda model: -model.log10_likelihood):
        if len(further) == most:
            break
        if any(estimator.same(model, other) for other in known):
            continue
        known.append(model)
        fit = _fit(estimator, model, min(model.log10_likelihood - likeliest.log10_likelihood, lead))
        if fit is not None:  # how far its corners may be off was not measured
            further.append(replace(fit, corner_sigma_m=None, corner_covariance_m2=None, statement_px=counted_px))
    return tuple(further)


def _by_picture(
    estimator: TripleEstimator, fits: Sequence[Fit], further: Sequence[Fit]
) -> tuple[tuple[Fit, ...], tuple[Fit, ...]]:
    """Return places with their likelihoods by the picture, so that places on several maps compare by it."""
    scene = estimator.scene
    gsd_m, lead = sampling(fits[0].matrix, scene.size), min(-fits[0].log10_odds, 0.0)

    def weigh(fit: Fit) -> Fit:
        straight = straighten_scene(scene, fit.lens_k1) if fit.lens_k1 else scene
        picture = Picture(straight, estimator.index, gsd_m)
        return replace(fit, log10_likelihood=picture.weigh(fit.matrix), statement_px=picture.statement_px)

    best, *others = map(weigh, (*fits, *further))
    others = [replace(fit, log10_odds=min(fit.log10_likelihood - best.log10_likelihood, lead)) for fit in others]
    return (best, *others[: len(fits) - 1]), tuple(others[len(fits) - 1 :])


def _fit(estimator: TripleEstimator, model: Hypothesis, lead: float) -> Fit | None:
    """Return a place that was verified."""
    if model.refined is None or model.found is None or model.distance is None:
        return None
    found, refined = model.found, model.refined
    return Fit(
        estimator.index,
        refined.matrix,
        model.matched,
        model.distance,
        found.forward,
        lead,
        model.log10_likelihood,
        refined.corner_sigma_m,
        refined.corner_covariance_m2,
        refined.lens_k1,
        found.mean,
    )


def _fit_of_rival(estimator: TripleEstimator, matrix: FloatArray, lead: float, likelihood: float) -> Fit:
    """Return the best rival as a fit."""
    scene, index = estimator.scene, estimator.index
    found, matched, distance = agreement(matrix, scene, index)
    return Fit(index, matrix, matched, distance, found.forward, lead, likelihood, agreement=found.mean)


def _of_effort(options: LocateOptions) -> MatchOptions:
    """Return the options of matching; with low effort roads do not propose."""
    match = options.match
    return match if options.effort == "full" else replace(match, roads=False)


def _near(index: ReferenceIndex, near: tuple[float, float, float] | None) -> tuple[float, float, float] | None:
    """Take (lon, lat, radius) to the plane."""
    if near is None:
        return None
    x, y = from_lonlat(index.plane, np.array([near[:2]]))[0]
    return float(x), float(y), near[2]


def _rounded_up(radius_m: float) -> float:
    """Round up to a power of 1.25, so that masks of many sizes are searched on few different parts of a map."""
    return float(1.25 ** math.ceil(math.log(radius_m) / math.log(1.25)))


@lru_cache(maxsize=32)
def _part(index: ReferenceIndex, center: tuple[float, float], radius_m: float) -> ReferenceIndex:
    """Crop a reference to a circle, unless it hardly extends beyond; kept for a batch."""
    inside = np.hypot(*(index.xy - center).T) <= radius_m
    return crop(index, center, radius_m) if inside.mean() < 0.7 else index


# --- the paper's method -----------------------------------------------------------------------------------------------


def _search_pairs_in_turn(
    query: Query, indexes: Sequence[ReferenceIndex], options: LocateOptions, time_s: float
) -> list[Found]:
    """Search the references in turn; each gets an even share of the work and the time that are left."""
    found: list[Found] = []
    pair = options.pair
    work_s, time_s = min(pair.work_limit_s, options.search.work_limit_s), min(pair.time_limit_s, time_s)
    for n_left in range(len(indexes), 0, -1):
        share = replace(pair, work_limit_s=work_s / n_left, time_limit_s=time_s / n_left)
        one = _search_pairs(query, indexes[-n_left], share)
        work_s, time_s = max(work_s - one.stats.work_ms / 1000, 0.0), max(time_s - one.match_s, 0.0)
        found.append(one)
    return found


def _search_pairs(query: Query, index: ReferenceIndex, options: PairOptions) -> Found:
    """Run the paper's method; its places have no scores."""
    scene = query.scene
    table = _pair_index(index, options.d_max_m)
    match = match_pairs(scene.intersections, table, scene.corners, options)
    found = Found(
        index,
        stopped=match.stopped,
        said=match.reason,
        n_searched=len(index),
        stats=Stats(match.n_samples, match.candidates, match.hypotheses, match.hypotheses, round(1000 * match.work_s)),
        match_s=match.seconds,
    )
    if match.homography is None:
        return found
    matched = np.full(len(scene.intersections), -1, np.int64)
    matched[match.matches[:, 0]] = table.reference.node[match.matches[:, 1]]
    chosen = matched >= 0
    gap = Homography(match.homography)(scene.intersections.xy[chosen]) - index.xy[matched[chosen]]
    distance = np.zeros(len(matched))
    distance[chosen] = np.hypot(*gap.T)
    return replace(found, fits=(Fit(index, match.homography, matched, distance),))


@lru_cache(maxsize=4)
def _pair_index(index: ReferenceIndex, d_max_m: float) -> PairIndex:
    """Build the paper's tables for a reference: too large to store with it, kept for a batch."""
    n = len(index)
    rays = unpack_branches(index.branches)
    found = Intersections(index.xy, rays, unpack_tangents(index.tangents), np.zeros(n, np.float32), np.arange(n))
    return build_pair_index(found.only(np.flatnonzero(well_fitted(index))), d_max_m)
