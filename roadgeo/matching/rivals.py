"""The best rival of a place: it is always looked for, and compared with the place by the same likelihood.

The score of a place is its lead over the best other place. Where streets form a lattice, other places explain a query
almost as well: roads that both explain do not count, roads that only one explains favour it. Rivals are the other
places that the search met and, if the place leads these, shifts and turns of the place on the map around it. A rival
that explains more becomes the best place, and is compared in its turn.

The lead has two parts: the pieces of the query that favour the place over the best rival (see
`Evidence.compared_with`), and the gap between its likelihood and the rivals' (`log10_gap`).

Where traced roads do not decide, a soft picture does, for it shows more than the roads that were traced in it, and any
picture where hints exclude most rivals (see `picture`). Its rivals are the places that were met, and all shifts and
turns of the place around.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo.geometry.camera import CameraFault, judge, sampling
from roadgeo.geometry.homography import Homography
from roadgeo.matching.estimator import MatchOptions, TripleEstimator
from roadgeo.matching.events import Ledger
from roadgeo.matching.evidence import Evidence, match_intersections, statement_px
from roadgeo.matching.growing import Hypothesis, SamePlace
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.picture import Peak, Picture
from roadgeo.matching.refinement import refine
from roadgeo.matching.scene import Scene
from roadgeo.matching.search import Search
from roadgeo.matching.shifts import Drawn, LocalSearchOptions, Shift, move_about, search_nearby
from roadgeo.matching.triples import larger

__all__ = ["Other", "Rivals", "Standing", "log10_gap", "similar_places"]

#: Streets that cross at right angles fit themselves when turned by a right angle.
_TURNS_DEG = (0.0, 90.0, 180.0, 270.0)
#: Most and fewest other places by which a gap is judged; their least spacing (log10).
_TAIL, _LEAST_TAIL, _LEAST_SPACING = 20, 5, 0.3
#: Most times that a rival may turn out to be better.
_MOST_TURNS = 12


#: A place is not compared further if it leads all places nearby by the first score, is contradicted by less than the
#: second, and the best place nearby explains less than this part of it: streets do not repeat there. Four of 274
#: mirrored masks led by the first, where a city is like its mirror image: they were contradicted by 8.7 and more.
_CERTAIN, _DOUBTED, _REPEATING = 12.0, 1.0, 0.5
#: Streets around are searched if the lead over the places met is at least this part of the lead needed. At wrong places
#: that part is up to a tenth, at right places nine tenths and more.
_WORTH_LOOKING = 0.5
#: Score that a place loses if all its roads are contradicted, and in proportion (see `Evidence.contradicted`). At right
#: places, on masks with up to half the roads gone, false, stale or bent, the share contradicted is 0 for nine of ten
#: and at most 0.09; at the best wrong places of mirrored masks its median is 0.16.
_DOUBT = 60.0
#: Number of the likeliest places met by the search that are compared; and number of road points for the rough
#: refinement of places around.
_N_KNOWN, _N_POINTS = 12, 200
#: Number of the likeliest places around that are fully refined.
_N_LAID = 8
#: Two places are different if their middles are further apart than this share of half the frame's diagonal, and they
#: share less than this share of the roads met (see `Evidence.shared`), unless the other place explains more.
_APART, _SAME = 0.04, 0.67
#: Where traced roads and a soft picture favour the same place, this part of the lesser lead counts as well, for they
#: are not independent, and in a drawn mask they are the same; where they favour different places, it counts against.
#: A place that traced roads speak against is not the picture's to decide: a grid that equals its mirror image fits.
_AGREEING = 0.5
#: How far around a place the picture is compared, metres: farther where the lead over places near may be enough, and is
#: not clear. Correlations of each turn, and the likeliest of all turns that are weighed.
_REACHES_M, _PEAKS, _WEIGHED = (1000.0, 4000.0), 12, 4
#: The picture's places are different if their middles are further apart than this, metres and pixels.
_BESIDE_M, _BESIDE_PX = 30.0, 8.0
#: Streets around a place, and the blocks beside it.
_AROUND = LocalSearchOptions(reach_m=4000.0, turn_deg=0.0, cell_m=10.0, road_m=20.0, max_points=200, n_places=40)
_NEARBY = replace(_AROUND, reach_m=500.0, n_places=8)


class Standing(NamedTuple):
    """A place, its best rival (3, 3) if it has any, and its lead over the rival (log10).

    `log10_likelihood`, `rival_likelihood`: the log10 likelihood of each, at the same metres per pixel.
    """

    model: Hypothesis
    rival: FloatArray | None
    log10_lead: float
    log10_likelihood: float = -math.inf
    rival_likelihood: float = -math.inf

    @property
    def is_beaten(self) -> bool:
        """Return whether the rival explains more."""
        return self.rival is not None and self.rival_likelihood > self.log10_likelihood


class Other(NamedTuple):
    """Another place: its log10 likelihood, the lead over it, its homography (3, 3), and the score against it."""

    worth: float
    lead: float
    matrix: FloatArray
    against: float = 0.0


class Rivals:
    """Compares the likeliest place of each part of a map with its best rival, anew where further places were met."""

    def __init__(
        self,
        estimators: Mapping[Search[Hypothesis], TripleEstimator],
        ledger: Ledger,
        needed: float,
        time_limit_s: float = math.inf,
        same: SamePlace = lambda *_: False,
    ) -> None:
        """Places with a score below `needed` are not compared; no place is compared after the time limit.

        `same` returns whether places of two parts, which may overlap, are the same.
        """
        self.estimators, self.ledger, self.needed, self._same = estimators, ledger, needed, same
        self._deadline = time.perf_counter() + time_limit_s
        # by the ids of the place and of those that were met, which are not reused while a standing exists
        self._known: dict[tuple[int, ...], Standing] = {}
        self._doubts: dict[int, tuple[FloatArray, float]] = {}  # with the matrix as it was then

    def __call__(self, parts: Sequence[Search[Hypothesis]]) -> Search[Hypothesis] | None:
        """Return the part whose likeliest place leads all others by twice the score needed, or None."""
        best = max(parts, key=self._explained)
        if max((model.log10_odds for model in self.estimators[best].verified), default=-math.inf) < self.needed:
            return None  # a place that was met is already too good a rival
        standing = self._by_roads(best)
        if standing is None or standing.log10_lead < 2.0 * self.needed:
            return None
        return None if any(self._rivals(part, best, standing.model) for part in parts) else best

    def _rivals(self, part: Search[Hypothesis], best: Search[Hypothesis], model: Hypothesis) -> bool:
        """Return whether another part has another place that explains nearly as much as the best place of all."""
        here, there = self.estimators[best], self.estimators[part]
        least = here.explained(model) - self.needed * statement_px(sampling(model.matrix, here.scene.size))
        return part is not best and any(
            there.explained(other) > least and not self._same(here, model, there, other) for other in there.verified
        )

    def _explained(self, part: Search[Hypothesis]) -> float:
        estimator = self.estimators[part]
        return max(map(estimator.explained, estimator.verified), default=-math.inf)

    def standing(self, part: Search[Hypothesis]) -> Standing | None:
        """Compare the likeliest place of a part with its best rival; return None if no place was verified."""
        by_roads, estimator = self._by_roads(part), self.estimators[part]
        is_soft = estimator.scene.probability is not None
        may_decide = (is_soft or estimator.anywhere is not None) and time.perf_counter() <= self._deadline
        if by_roads is None or by_roads.log10_lead >= _CERTAIN or not may_decide:
            return by_roads
        started = time.perf_counter()
        seen = self._by_picture(estimator)
        part.seconds += time.perf_counter() - started
        best, other = sorted((by_roads, seen), key=lambda standing: -standing.log10_lead)
        is_same, lesser = estimator.same(best.model, other.model), max(other.log10_lead, 0.0)
        if (
            best is seen and best.rival is not None and not is_soft
        ):  # likelihoods of drawn masks are those of their roads
            scene, gsd_m = estimator.scene_of(best.model), sampling(best.model.matrix, estimator.scene.size)
            best = best._replace(rival_likelihood=Evidence(scene, estimator.index, gsd_m).weigh(best.rival))
        return best._replace(log10_lead=best.log10_lead + (_AGREEING * is_soft if is_same else -1.0) * lesser)

    @property
    def _by_chance(self) -> float:
        """Score that a place loses: the larger the map, the more places may lead all places around them by chance."""
        return 2.0 * math.log10(larger(self.ledger.n_reference))

    def _by_picture(self, estimator: TripleEstimator) -> Standing:
        """Compare the place that the picture favours with its best rival."""
        ranked = sorted(estimator.verified, key=lambda model: -model.log10_likelihood)[:_N_KNOWN]
        gsd_m = sampling(ranked[0].matrix, estimator.scene.size)
        best = max(ranked, key=lambda model: estimator.picture(model, gsd_m).weigh(model.matrix))
        for _ in range(_MOST_TURNS):
            estimator.refine_whole(best)
            standing = self._seen(estimator, best, ranked)
            if standing.rival is None or not standing.is_beaten:
                break
            best = self._take(estimator, standing.rival, ranked)
        if estimator.anywhere is None or standing.is_beaten:
            return standing
        free = self._seen(estimator.anywhere, standing.model, ranked)  # see `_compare`
        return standing._replace(log10_lead=max(standing.log10_lead, free.log10_lead))

    def _seen(self, estimator: TripleEstimator, best: Hypothesis, ranked: Sequence[Hypothesis]) -> Standing:
        """Compare a place with those that were met, and with those around, by the picture."""
        picture = estimator.picture(best, sampling(best.matrix, estimator.scene.size))
        apart_m, middle = max(_BESIDE_M, _BESIDE_PX * picture.gsd_m), estimator.center(best)
        others = [
            Peak(estimator.picture(model, picture.gsd_m).weigh(model.matrix), model.matrix)
            for model in ranked
            if math.dist(estimator.center(model), middle) > apart_m
        ]
        worth, lead, rival = picture.weigh(best.matrix), math.inf, None
        for reach_m in _REACHES_M:
            others += _around(picture, best.matrix, reach_m, apart_m, estimator)
            rival = max(others, key=lambda other: other.worth, default=None)
            likelihood = -math.inf if rival is None else rival.worth
            lead = picture.lead(worth, likelihood)
            if not _WORTH_LOOKING * self.needed <= lead < 2.0 * self.needed:
                break
        lead = max(lead - self.doubt(estimator, best), 0.0) - self._by_chance
        return Standing(best, None if rival is None else rival.matrix, lead, worth, likelihood)

    def _by_roads(self, part: Search[Hypothesis]) -> Standing | None:
        """Compare the likeliest place of a part with its best rival, by traced roads."""
        estimator = self.estimators[part]
        ranked = sorted(estimator.verified, key=lambda model: -model.log10_likelihood)
        if not ranked:
            return None
        started = time.perf_counter()
        best = max(ranked[:_N_KNOWN], key=lambda model: model.log10_likelihood - self.doubt(estimator, model))
        for _ in range(_MOST_TURNS):
            key = id(best), *map(id, ranked[: 1 + _N_KNOWN])
            standing = self._known.get(key) or self._compare(estimator, best, ranked)
            self._known[key] = standing
            if standing.rival is None or not standing.is_beaten:
                break
            best = self._take(estimator, standing.rival, ranked)
        part.seconds += time.perf_counter() - started
        return standing

    def _compare(self, estimator: TripleEstimator, best: Hypothesis, ranked: Sequence[Hypothesis]) -> Standing:
        """Compare a place with its rivals, and with those that hints exclude where it leads these too by more.

        Hints leave few rivals, by which a gap is hard to judge: without them a place would lead by less.
        """
        standing, anywhere = self._compare_allowed(estimator, best, ranked), estimator.anywhere
        if anywhere is None or standing.is_beaten or standing.log10_lead >= _CERTAIN:
            return standing
        free = self._compare_allowed(anywhere, best, ranked)
        return standing._replace(log10_lead=max(standing.log10_lead, free.log10_lead))

    def _compare_allowed(self, estimator: TripleEstimator, best: Hypothesis, ranked: Sequence[Hypothesis]) -> Standing:
        scene, matrix = estimator.scene_of(best), best.matrix
        if best.log10_likelihood < self.needed:
            return Standing(best, None, best.log10_odds)
        doubt = self.doubt(estimator, best)
        likeliest = next((m.log10_likelihood for m in ranked if not estimator.same(m, best)), 0.0)
        odds = min(best.log10_odds, best.log10_likelihood - max(likeliest, 0.0))
        most = _REPEATING * best.log10_likelihood
        if odds >= _CERTAIN and doubt < _DOUBTED and max(likeliest, estimator.nearby(best)) < most:
            return Standing(best, None, odds - doubt, best.log10_likelihood)
        if time.perf_counter() > self._deadline:
            return Standing(best, None, min(odds, 0.0), best.log10_likelihood)
        evidence = Evidence(scene, estimator.index, sampling(matrix, scene.size))
        worth, middle = evidence.weigh(matrix), Homography(matrix).everywhere(scene.center)
        apart_m, compare = _APART * scene.half_size * evidence.gsd_m, evidence.compared_with(matrix)
        against = self._by_chance + doubt

        def is_rival(other: Other) -> bool:
            return bool(
                np.hypot(*(Homography(other.matrix).everywhere(scene.center) - middle)) > apart_m
                and estimator.may_be(other.matrix)
                and (other.worth - other.against > worth or evidence.shared(matrix, other.matrix) < _SAME)
            )

        def stand(others: Sequence[Other]) -> Standing:
            rival = max(others, key=lambda other: other.worth - other.against, default=None)
            lead = min((other.lead for other in others), default=math.inf)
            lead += log10_gap(worth, [other.worth for other in others])
            if rival is None:
                return Standing(best, None, min(lead, worth) - against, worth)
            likelihood = rival.worth - rival.against
            odds = worth - likelihood if likelihood > worth else min(lead, worth) - against
            return Standing(best, rival.matrix, odds, worth, likelihood)

        known = [model for model in ranked[: 1 + _N_KNOWN] if model is not best]
        met = (Other(*compare(model.matrix), model.matrix, self.doubt(estimator, model)) for model in known)
        rivals = list(filter(is_rival, met))
        standing = stand(rivals)
        leads = standing.log10_lead >= _WORTH_LOOKING * self.needed
        if not leads and estimator.nearby(best) < _REPEATING * worth:
            return standing
        for around in (_NEARBY, _AROUND) if leads else (_NEARBY,):  # a neighbouring block may be the place
            rivals += filter(is_rival, similar_places(matrix, evidence, compare, estimator.options, around))
            standing = stand(rivals)
            if standing.is_beaten or standing.log10_lead >= _CERTAIN:
                break
        return standing

    def doubt(self, estimator: TripleEstimator, model: Hypothesis) -> float:
        """Return the score against a place for the roads that it contradicts; computed once for each matrix."""
        known, matrix = self._doubts.get(id(model)), model.matrix
        if known is None or known[0] is not matrix:
            scene = estimator.scene_of(model)
            evidence = Evidence(scene, estimator.index, sampling(matrix, scene.size))
            known = self._doubts[id(model)] = matrix, _DOUBT * evidence.contradicted(matrix)
        return known[1]

    def _take(self, estimator: TripleEstimator, matrix: FloatArray, ranked: Sequence[Hypothesis]) -> Hypothesis:
        """Return the hypothesis of a rival that explains more than the likeliest place: a known one, or a new one."""
        known = next((model for model in ranked if model.matrix is matrix), None)
        if known is not None:
            return known
        model = Hypothesis.at(matrix, estimator.scene, estimator.index)
        estimator.score(model)
        return model


def _around(
    picture: Picture, matrix: FloatArray, reach_m: float, apart_m: float, estimator: TripleEstimator
) -> list[Peak]:
    """Return the likeliest other places around a place (3, 3), shifted or turned, that agree with the hints."""
    center = Homography(matrix).everywhere(picture.scene.center)
    if estimator.near is not None:
        reach_m = min(reach_m, 2.0 * estimator.near[2])
    found: list[Peak] = []
    for peak in picture.correlate(matrix, reach_m, _TURNS_DEG, _PEAKS, apart_m):
        away_m = np.hypot(*(Homography(peak.matrix).everywhere(picture.scene.center) - center))
        if (peak.turn_deg != 0.0 or away_m > apart_m) and estimator.may_be(peak.matrix):
            found.append(picture.settle(peak))
        if len(found) == _WEIGHED:
            break
    return found


def similar_places(
    matrix: FloatArray,
    evidence: Evidence,
    compare: Callable[[FloatArray], tuple[float, float]],
    match: MatchOptions,
    around: LocalSearchOptions = _AROUND,
) -> list[Other]:
    """Return other places around a place that fit most roads; the likeliest are fully refined."""
    scene, index = evidence.scene, evidence.index
    center = Homography(matrix).everywhere(scene.center)
    drawn: Drawn = {}
    found: list[tuple[float, FloatArray]] = []
    for turn in _TURNS_DEG:
        turned = move_about(center, Shift(0.0, 0.0, turn, 1.0, 0.0)) @ matrix
        if judge(turned, scene.size, match.camera) is CameraFault.HEADING:
            continue
        shifts = search_nearby(turned, scene, index, around, drawn)
        found += [(shift.share, move_about(center, shift) @ turned) for shift in shifts]
    found.sort(key=lambda place: -place[0])
    fits = (_lay(start, scene, index, match, _N_POINTS) for _, start in found[: around.n_places])
    roughly = sorted((Other(*compare(fit), fit) for fit in fits), key=lambda other: -other.worth)
    finely = (_lay(other.matrix, scene, index, match, None) for other in roughly[:_N_LAID])
    return [*(Other(*compare(fit), fit) for fit in finely), *roughly[_N_LAID:]]


def log10_gap(best: float, others: Sequence[float]) -> float:
    """Return the log10 score of the best place's lead over the next, beyond chance.

    Among many places that fit by chance, the best few differ by exponential spacings (Renyi, 1953), whatever their
    number: the gap to the next place is compared with the next place's lead over the others. Where streets form a
    lattice, others crowd below the best; elsewhere few come near. A place that explains less than another has a gap
    below zero, whatever the score against the other.
    """
    ranked = np.sort(others)[::-1][: _TAIL + 1]
    if not len(ranked):
        return 0.0
    n, gap = len(ranked) - 1, best - float(ranked[0])
    if gap <= 0.0 or n < _LEAST_TAIL:
        return min(gap, 0.0)
    usual = float((ranked[:-1] - ranked[-1]).sum() / (1.0 - 1.0 / np.arange(2, n + 2)).sum())
    return n * math.log10(1.0 + gap / (n * max(usual, _LEAST_SPACING)))


def _lay(
    start: FloatArray, scene: Scene, index: ReferenceIndex, match: MatchOptions, n_points: int | None
) -> FloatArray:
    """Refine a place; return the start if the refinement diverges."""
    gsd = sampling(start, scene.size)
    matched, _ = match_intersections(start, scene, index)
    refined = refine(start, scene, index, matched, match.refine, n_points, held=True)
    if refined is None or judge(refined.matrix, scene.size, match.camera) is not None:
        return start
    if abs(math.log(sampling(refined.matrix, scene.size) / gsd)) > math.log(1.1):
        return start
    return refined.matrix
