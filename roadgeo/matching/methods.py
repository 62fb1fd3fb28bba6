"""The two methods of finding a query on one reference: triples of intersections, and the paper's pairs."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from roadgeo._arrays import FloatArray, IntArray
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.projection import from_lonlat
from roadgeo.location import Stats
from roadgeo.matching.estimator import Hypothesis, MatchOptions, TripleEstimator
from roadgeo.matching.index import ReferenceIndex, crop, unpack_tangents
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.paper.search import match_pairs
from roadgeo.matching.paper.tuples import PairIndex, PairOptions, build_pair_index
from roadgeo.matching.query import Query
from roadgeo.matching.search import SearchResult, search
from roadgeo.matching.trace import NO_TRACE, Trace
from roadgeo.roads.intersections import Intersections

__all__ = ["Fit", "Found", "search_reference"]


@dataclass(frozen=True)
class Fit:
    """A place on a reference where the query fits. Dimension: N intersections of the query.

    Attributes
    ----------
    index : ReferenceIndex
        The reference, or the part of it that was searched.
    matrix : (3, 3) float64
        Query plane to reference plane.
    matched : (N,) int
        Intersection of `index` that each of the query's is, or -1.
    distance : (N,) float64
        Metres between them.
    agreeing : float
        Share of the query's roads that agree.
    log10_odds : float
        NaN where the method knows none.
    corner_sigma_m : (4,) float64 or None
    corner_covariance_m2 : (8, 8) float64 or None
        As in `Refined`.
    lens_k1 : float
        As of `Refined`.
    """

    index: ReferenceIndex
    matrix: FloatArray
    matched: IntArray
    distance: FloatArray
    agreeing: float = math.nan
    log10_odds: float = math.nan
    corner_sigma_m: FloatArray | None = None
    corner_covariance_m2: FloatArray | None = None
    lens_k1: float = 0.0


@dataclass(frozen=True)
class Found:
    """What the search of one reference came to.

    Attributes
    ----------
    index : ReferenceIndex
        The whole reference.
    fits : tuple of Fit
        The best place and the best other one, as far as there are any.
    stopped : str
        As in `SearchResult`; "" where nothing was searched, or by the paper's method.
    said : str
        What the method itself says of the result.
    n_searched : int
        Intersections of the part of the reference that was searched.
    n_tried : int
        Places that were screened.
    """

    index: ReferenceIndex
    fits: tuple[Fit, ...] = ()
    stopped: str = ""
    said: str = ""
    n_searched: int = 0
    n_tried: int = 0
    stats: Stats = field(default_factory=Stats)
    match_s: float = 0.0
    refine_s: float = 0.0


def search_reference(
    query: Query, index: ReferenceIndex, options: LocateOptions, time_limit_s: float, trace: Trace = NO_TRACE
) -> Found:
    """Search one reference for a query, by the method and within the limits of the options."""
    if len(query.scene.intersections) < options.min_intersections:
        return Found(index)
    if options.method == "pair":
        return _search_pairs(query, index, options.pair, time_limit_s)
    return _search_triples(query, index, options, time_limit_s, trace)


def _search_triples(
    query: Query, index: ReferenceIndex, options: LocateOptions, time_limit_s: float, trace: Trace
) -> Found:
    started = time.perf_counter()
    part, near = index, _near(index, options.near)
    if near is not None:
        part = _part(
            index, near[:2], _rounded_up(near[2] + 2.0 * query.scene.half_size * options.match.camera.gsd_m[1])
        )
        if len(part) < options.min_intersections:
            return Found(index, n_searched=len(part))
    cropping_s = time.perf_counter() - started
    estimator = TripleEstimator(query.scene, part, promising_options(options), near, trace)
    started = time.perf_counter() - cropping_s
    result = search(estimator, replace(options.search, time_limit_s=time_limit_s - cropping_s))
    elapsed = time.perf_counter() - started
    trace.finished(estimator, result)
    return Found(
        index,
        _fits(estimator, result),
        result.stopped,
        n_searched=len(part),
        n_tried=estimator.n_screened,
        stats=Stats(estimator.n_tuples, estimator.n_candidates, estimator.n_hypotheses, estimator.n_verified),
        match_s=elapsed - estimator.refine_s,
        refine_s=estimator.refine_s,
    )


def _fits(estimator: TripleEstimator, result: SearchResult[Hypothesis]) -> tuple[Fit, ...]:
    """Return the best place and the runner-up, as far as they were verified."""
    fits = []
    for model, score in ((result.best, result.score), (result.runner_up, result.runner_up_score)):
        if model is None or model.refined is None or model.found is None or model.distance is None:
            continue
        if not math.isfinite(score):
            continue
        fits.append(
            Fit(
                estimator.index,
                model.refined.matrix,
                model.matched,
                model.distance,
                model.found.forward,
                score,
                model.refined.corner_sigma_m,
                model.refined.corner_covariance_m2,
                model.refined.lens_k1,
            )
        )
    return tuple(fits)


def promising_options(options: LocateOptions) -> MatchOptions:
    """Call every place promising that may be reported, or come within the margin of one that is; heed the effort."""
    least = options.min_log10_odds - options.min_margin
    verify = replace(options.match.verify, promising=min(options.match.verify.promising, least))
    match = replace(options.match, verify=verify)
    return match if options.effort == "full" else replace(match, last=(), roads=None, sightings=1)


def _near(index: ReferenceIndex, near: tuple[float, float, float] | None) -> tuple[float, float, float] | None:
    """Take (lon, lat, radius) to the plane."""
    if near is None:
        return None
    x, y = from_lonlat(index.plane, np.array([near[:2]]))[0]
    return float(x), float(y), near[2]


def _rounded_up(radius_m: float) -> float:
    """Return the next step of a ladder, so that masks of many sizes are looked for on a few parts of a map."""
    return float(1.25 ** math.ceil(math.log(radius_m) / math.log(1.25)))


@lru_cache(maxsize=4)
def _part(index: ReferenceIndex, center: tuple[float, float], radius_m: float) -> ReferenceIndex:
    """Crop a reference to a circle, unless it hardly reaches beyond: made once for a batch."""
    inside = np.hypot(*(index.xy - center).T) <= radius_m
    return crop(index, center, radius_m) if inside.mean() < 0.7 else index


# --- the paper's method -----------------------------------------------------------------------------------------------


def _search_pairs(query: Query, index: ReferenceIndex, options: PairOptions, time_limit_s: float) -> Found:
    """Run the paper's method: what it finds has no odds, for it knows none."""
    scene = query.scene
    reference, table = _pair_index(index, options)
    limited = replace(options, time_limit_s=time_limit_s)
    match = match_pairs(scene.intersections, reference, table, scene.corners, limited)
    found = Found(
        index,
        said=match.reason,
        n_searched=len(index),
        stats=Stats(match.n_samples, match.candidates, match.hypotheses, match.hypotheses),
        match_s=match.seconds,
    )
    if match.homography is None:
        return found
    matched = np.full(len(scene.intersections), -1, np.int64)
    matched[match.matches[:, 0]] = match.matches[:, 1]
    chosen = matched >= 0
    gap = Homography(match.homography)(scene.intersections.xy[chosen]) - index.xy[matched[chosen]]
    distance = np.zeros(len(matched))
    distance[chosen] = np.hypot(*gap.T)
    return replace(found, fits=(Fit(index, match.homography, matched, distance),))


@lru_cache(maxsize=4)
def _pair_index(index: ReferenceIndex, options: PairOptions) -> tuple[Intersections, PairIndex]:
    """Build the paper's tables for a reference: too large to store with it, kept for a batch."""
    n = len(index)
    vectors = index.branches.astype(np.float32)
    rays = np.where(vectors.any(axis=2), np.arctan2(vectors[..., 1], vectors[..., 0]), np.nan)
    found = Intersections(index.xy, rays, unpack_tangents(index.tangents), np.zeros(n, np.float32), np.arange(n))
    return found, build_pair_index(found, options)
