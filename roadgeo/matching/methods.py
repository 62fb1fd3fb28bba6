"""The two methods of finding a query on one reference: triples of intersections, and the paper's pairs."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TypeAlias

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo._progress import Say, say_nothing
from roadgeo.geometry.projection import from_lonlat
from roadgeo.location import Seconds, Stats
from roadgeo.matching.estimator import MatchOptions, TripleEstimator
from roadgeo.matching.events import Events, Ledger
from roadgeo.matching.finishing import measure_corners, measured
from roadgeo.matching.growing import SharedSweeps
from roadgeo.matching.index import ReferenceIndex, crop
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.pairs import paired
from roadgeo.matching.paper import PairOptions, match_pairs
from roadgeo.matching.parts import Part, Whole
from roadgeo.matching.picture import by_picture
from roadgeo.matching.place import Place, Weight
from roadgeo.matching.rivals import N_LIKELIEST, Rivals
from roadgeo.matching.road_search import COARSE_PIXEL_M
from roadgeo.matching.scene import Query
from roadgeo.matching.search import Ahead, Search, search_each, search_together
from roadgeo.matching.triples import larger, n_units
from roadgeo.storage.memory import let_pages_go

__all__ = ["N_PLACES", "Proposed", "Searched", "less_than", "search_references"]


#: Limit of work for a first look at coarse maps, seconds.
_FIRST_LOOK_S = 0.03
#: Places that a refusal lists at most.
N_PLACES = 5


@dataclass(frozen=True)
class Searched:
    """The result of the search of one reference.

    Attributes
    ----------
    index : ReferenceIndex
        The whole reference.
    places : tuple of Place
        The likeliest place, which is scored against its rival, and other verified ones, the best first.
    stopped : str
        As in `Search`; "" if no map was searched.
    said : str
        The method's own sentence on the result.
    counts : Counter
        Intersections of the part of the reference that was "searched", places "tried", and "anchors": intersections of
        the query that were looked up.
    seconds : Seconds
        Time spent on matching and refining.
    likeliest : tuple of Place
        The likeliest places that were verified, by traced roads alone.
    better : Place or None
        Where the roads fit better than at a place that hints led to (see `veto`).
    estimator, search : TripleEstimator, Search or None
        What searched, for explanation; None where nothing was to be searched, or by pairs.
    """

    index: ReferenceIndex
    places: tuple[Place, ...] = ()
    stopped: str = ""
    said: str = ""
    counts: Counter[str] = field(default_factory=Counter)
    stats: Stats = field(default_factory=Stats)
    seconds: Seconds = field(default_factory=Seconds)
    events: Events = field(default_factory=Events)
    likeliest: tuple[Place, ...] = ()
    better: Place | None = None
    estimator: TripleEstimator | None = None
    search: Search[Place] | None = None

    @property
    def compared(self) -> tuple[Place, ...]:
        """The places that the answer rests on: the likeliest and its rival, as far as they exist."""
        best = self.places[:1]
        return (*best, *(place.rival for place in best if place.rival is not None))

    def later(self, spent_s: float) -> Searched:
        """Return the result after a search before it that took some seconds."""
        return replace(self, seconds=replace(self.seconds, match=self.seconds.match + spent_s))

    def less_likely(self, log10: float) -> Searched:
        """Return the result with all places less likely by a number: they could have agreed by chance more often."""
        return replace(self, places=tuple(_less_likely(place, log10) for place in self.places))


def _less_likely(place: Place, log10: float) -> Place:
    rival = None if place.rival is None else place.rival.but(score=place.rival.score - log10)
    return place.but(score=place.score - log10, rival=rival)


#: A map, and a homography (3, 3) of a place on it that is to be verified first.
Proposed: TypeAlias = tuple[ReferenceIndex, FloatArray]


def search_references(
    query: Query,
    parts: Sequence[Part],
    options: LocateOptions,
    time_limit_s: float,
    explained: bool = False,
    proposed: Sequence[Proposed] = (),
    say: Say = say_nothing,
) -> list[Searched]:
    """Search references, or parts of them, for a query together, by the method and within the limits of the options.

    Parts that cannot contain the place are not opened, and have no result; if no part can, the first is opened. Coarse
    maps come first: if a place stands out on them, the others are not opened. Events are kept if the search is to be
    `explained`. Places that were `proposed` before are verified first.
    """
    coarse, fine = _split(parts, options)
    with Ahead(options.threads) as ahead:
        if not coarse or not fine or options.method == "pair":
            return _search(query, coarse + fine, options, time_limit_s, explained, ahead, proposed, say)
        started = time.perf_counter()
        quick = _at_first_look(coarse, options)
        first = _search(query, coarse, quick, time_limit_s, explained, ahead, proposed, say)
        if any(result.stopped == "accepted" for result in first):
            return first
        spent_s = time.perf_counter() - started
        left_s = time_limit_s - spent_s
        begun, *others = _search(query, coarse + fine, options, left_s, explained, ahead, proposed, say)
        return [begun.later(spent_s), *others]


def _split(parts: Sequence[Part], options: LocateOptions) -> tuple[list[Part], list[Part]]:
    """Return the coarse maps, unless pixels are too small for them, and the others."""
    coarse = [part for part in parts if part.coarseness > 1.0]
    fine = [part for part in parts if part.coarseness == 1.0]
    largest_m = options.match.camera.gsd_m[1]
    return [part for part in coarse if largest_m > part.coarseness * COARSE_PIXEL_M or not fine], fine


def _at_first_look(coarse: Sequence[Part], options: LocateOptions) -> LocateOptions:
    """Return the options for a search of coarse maps alone: a quick search, unless pixels are large enough for them."""
    least_m = options.match.camera.gsd_m[0]
    if all(least_m >= part.coarseness * COARSE_PIXEL_M for part in coarse):
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
    proposed: Sequence[Proposed],
    say: Say,
) -> list[Searched]:
    """Search parts together."""
    frame_m = 2.0 * query.scene.half_size * options.match.camera.gsd_m[1]
    indexes = _open(parts, options, frame_m)
    if len(indexes) > 1:  # every search reads all tables, but few roads: those that masks before this one led to go
        let_pages_go(array for index in indexes for array in index.road_buckets[:3])
    if len(query.scene.intersections) == 0:
        return [Searched(index, events=Events(explained)) for index in indexes]
    if options.method == "pair":
        return _search_pairs_in_turn(query, indexes, options, time_limit_s)
    started = time.perf_counter()
    sweeps = SharedSweeps(query.scene, options.match.camera, ahead)
    begun = [_begin(sweeps, index, options, Events(explained)) for index in indexes]
    for result in begun:
        if result.estimator is not None and proposed:
            here = (matrix for index, matrix in proposed if index is result.index)
            result.estimator.proposed = [Place(query.scene, result.estimator.index, matrix) for matrix in here]
    together = [result.estimator for result in begun if result.estimator is not None]
    units = sum(n_units(len(estimator.index)) for estimator in together)
    ledger = Ledger(sum(len(estimator.index) for estimator in together))
    for estimator in together:
        estimator.in_company, estimator.ledger = units > 1, ledger
    estimators = {Search(estimator): estimator for estimator in together}
    left = time_limit_s - (time.perf_counter() - started)

    scale = larger(ledger.n_reference)
    limits = replace(options.search, time_limit_s=left, work_limit_s=scale * options.search.work_limit_s)
    rivals = Rivals(estimators, ledger, options.min_log10_odds, left)
    search_together(list(estimators), limits, rivals)
    sweeps.end()
    ended = any(search.stopped in ("accepted", "time") for search in estimators)
    if units > 1 and options.effort == "full" and not ended:
        left, scale = left - (time.perf_counter() - started), float(units)
        rivals = _search_alone(estimators, options, ledger, left, say)
    compared = iter(rivals.compare_all())
    return [
        result if result.estimator is None else _end(result, result.estimator, *next(compared), rivals.needed, scale)
        for result in begun
    ]


def _search_alone(
    together: Mapping[Search[Place], TripleEstimator],
    options: LocateOptions,
    ledger: Ledger,
    time_limit_s: float,
    say: Say,
) -> Rivals:
    """Search each part, and each unit of it, as if it were alone: leads compete, each on its own part.

    Returns the comparison of their places. The more is searched in all, by the `ledger`, the more a place must lead.
    """
    for estimator in together.values():
        estimator.leave_company()
    searches = {Search(estimator, search.seconds): estimator for search, estimator in together.items()}
    rivals = Rivals(searches, ledger, options.min_log10_odds, time_limit_s)
    usual = replace(options.search, time_limit_s=time_limit_s)
    limits = {
        search: replace(usual, work_limit_s=usual.work_limit_s * n_units(len(estimator.index)))
        for search, estimator in searches.items()
    }
    search_each(limits, rivals.stands, rivals.promise, rivals.may_go_on, _name_maps(searches, say))
    for estimator in together.values():
        estimator.sweeps.end()
    return rivals


def _name_maps(searches: Mapping[Search[Place], TripleEstimator], say: Say) -> Callable[[Search[Place]], None]:
    """Return a function that says how many of several maps have had a turn, when the next one has its first."""
    names = list(dict.fromkeys(estimator.index.name for estimator in searches.values()))  # shards bear one name
    begun: set[str] = set()

    def hear(search: Search[Place]) -> None:
        name = searches[search].index.name
        if len(names) > 1 and name not in begun:
            begun.add(name)
            say(f"searching each map alone, map {len(begun)} of {len(names)}")

    return hear


def _open(parts: Sequence[Part], options: LocateOptions, frame_m: float) -> list[ReferenceIndex]:
    """Open the parts that may contain the place, or else the first, to report that."""
    able = [part for part in parts if may_show(part, options, frame_m)]
    return [part.open() for part in able or parts[:1]]


def may_show(part: Part, options: LocateOptions, frame_m: float) -> bool:
    """Return whether a frame of at most this size may lie on a part, given the user's hints; opens nothing."""
    near, within = options.near, options.match.within
    return (near is None or part.may_hold(near, frame_m)) and (within is None or part.touches(within))


def _begin(sweeps: SharedSweeps, index: ReferenceIndex, options: LocateOptions, events: Events) -> Searched:
    """Return a result without places; it has an estimator, unless the reference has no intersection near the hint."""
    part, near, within = index, _near(index, options.near), options.match.within
    if within is not None and not Whole(index).touches(within):
        return Searched(index, events=events)
    if near is not None:
        reach = _rounded_up(near[2] + 2.0 * sweeps.scene.half_size * options.match.camera.gsd_m[1])
        part = _part(index, near[:2], reach)
        if len(part) == 0:
            return Searched(index, events=events)
    estimator = TripleEstimator(sweeps, part, _of_effort(options), near, events)
    return Searched(index, counts=Counter(searched=len(part)), events=events, estimator=estimator)


def _end(
    begun: Searched,
    estimator: TripleEstimator,
    search: Search[Place],
    best: Place | None,
    needed: float,
    scale: float,
) -> Searched:
    """Return the result with its places; work is divided by `scale`, as on a map of usual size."""
    work_ms = round(1000 * estimator.work / scale)
    counts = estimator.n_tuples, estimator.n_candidates, estimator.n_hypotheses, estimator.n_verified
    kept = begun.events.kept
    return replace(
        begun,
        places=() if best is None or best.refined is None else _listed(estimator, best, needed),
        likeliest=tuple(sorted(estimator.verified, key=lambda place: -place.log10_likelihood)[:N_LIKELIEST]),
        stopped=search.stopped,
        counts=begun.counts + Counter(tried=estimator.n_screened, anchors=estimator.n_anchors),
        stats=Stats(*counts, work_ms),
        seconds=Seconds(match=search.seconds - estimator.refine_s, refine=estimator.refine_s),
        estimator=estimator if kept else None,
        search=search if kept else None,
    )


def _listed(estimator: TripleEstimator, best: Place, needed: float) -> tuple[Place, ...]:
    """Return the likeliest place, its corners measured, and others that were verified; all by one yardstick.

    Likelihoods are those by the picture where there is a soft one, so that places on several maps compare by it. Other
    places have the score of `less_than`. Where the best is not `needed` ahead the corners of all are measured.
    """
    counted_px = best.statement_px
    best = measure_corners(estimator, best.but(by=Weight(best.log10_likelihood, counted_px)))
    rival, others, met = best.rival, list[Place](), [best, *filter(None, [best.rival])]
    for place in sorted(estimator.verified, key=lambda place: -place.log10_likelihood):
        if len(met) + len(others) == N_PLACES:
            break
        if place.refined is not None and not any(place.same(other) for other in (*met, *others)):
            others.append(place.but(by=Weight(place.log10_likelihood, counted_px)))
    if estimator.scene.probability is not None:
        best, *others = (by_picture(place, best.gsd_m) for place in [best, *others])
        rival = rival and by_picture(rival, best.gsd_m)
    if rival is not None:
        behind = 0.0 if estimator.scene.probability is None else rival.log10_likelihood - best.log10_likelihood
        rival = rival.but(score=min(behind, -abs(best.score)))
    others = [less_than(best, place) for place in others]
    if best.score < needed:  # the user may take any of them
        rival, others = rival and measured(estimator, rival), [measured(estimator, place) for place in others]
    return best.but(rival=rival), *others


def less_than(best: Place, place: Place) -> Place:
    """Return a place with its score: what it explains less than the best, and no more than the best scores or leads."""
    return place.but(score=min(place.log10_likelihood - best.log10_likelihood, -abs(best.score)))


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
) -> list[Searched]:
    """Search the references in turn; each gets an even share of the work and the time that are left."""
    searched: list[Searched] = []
    pair = options.pair
    work_s, time_s = min(pair.work_limit_s, options.search.work_limit_s), min(pair.time_limit_s, time_s)
    for n_left in range(len(indexes), 0, -1):
        share = replace(pair, work_limit_s=work_s / n_left, time_limit_s=time_s / n_left)
        result = _search_pairs(query, indexes[-n_left], share)
        work_s, time_s = max(work_s - result.stats.work_ms / 1000, 0.0), max(time_s - result.seconds.total, 0.0)
        searched.append(result)
    return searched


def _search_pairs(query: Query, index: ReferenceIndex, options: PairOptions) -> Searched:
    """Run the paper's method; its places have no scores."""
    scene, table = query.scene, paired(index, options.tuples)
    intersections = query.intersections_by(options.n_px) if options.from_center else scene.intersections
    match = match_pairs(intersections, table, scene.corners, options)
    searched = Searched(
        index,
        stopped=match.stopped,
        said=match.reason,
        counts=Counter(searched=len(index)),
        stats=Stats(match.n_samples, match.candidates, match.hypotheses, match.hypotheses, round(1000 * match.work_s)),
        seconds=Seconds(match=match.seconds),
    )
    if match.homography is None:
        return searched
    matched = np.full(len(scene.intersections), -1, np.int64)
    rows = np.searchsorted(scene.intersections.node, intersections.node[match.matches[:, 0]])
    matched[rows] = table.reference.node[match.matches[:, 1]]
    return replace(searched, places=(Place(scene, index, match.homography, grown=matched, score=math.nan),))
