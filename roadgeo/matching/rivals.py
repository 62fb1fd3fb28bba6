"""The best rival of a place: it is always looked for, and compared with the place by the same likelihood.

The score of a place is its lead over the best other place. Where streets form a lattice, other places explain a query
almost as well: roads that both explain do not count, roads that only one explains favour it. Rivals are the other
places that the search met and, if the place leads these, shifts and turns of the place on the map around it. A rival
that explains more becomes the best place, and is compared in its turn.

The lead has two parts: the pieces of the query that favour the place over the best rival (see
`Evidence.compared_with`), and the gap between its likelihood and the rivals' (`log10_gap`).

Where traced roads do not decide, a soft picture does, for it shows more than the roads that were traced in it (see
`picture`). Its rivals are the places that were met, and all shifts and turns of the place around. A drawn mask shows no
more than its roads: with hints, on 96 masks, it changed no answer.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from typing import NamedTuple

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo.geometry.camera import CameraFault, judge
from roadgeo.matching.estimator import EQUAL, HARDLY, MatchOptions, TripleEstimator
from roadgeo.matching.events import Ledger
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.picture import Picture, by_picture
from roadgeo.matching.place import Place, Weight
from roadgeo.matching.refinement import refine
from roadgeo.matching.scene import N_CLOSELY, N_ROUGHLY, at_least
from roadgeo.matching.search import Search
from roadgeo.matching.shifts import SAME_M, Drawn, LocalSearchOptions, Shift, move_about, search_nearby
from roadgeo.matching.triples import larger

__all__ = ["N_LIKELIEST", "Compared", "Rivals", "fitted", "log10_gap", "places_beside", "similar_places"]

#: Streets that cross at right angles fit themselves when turned by a right angle.
_TURNS_DEG = tuple(90.0 * k for k in range(4))
#: Most and fewest other places by which a gap is judged; their least spacing (log10).
_TAIL, _LEAST_TAIL, _LEAST_SPACING = 20, 5, 0.3
#: A place is not compared further if it leads all places nearby by this score, nothing contradicts it, and the best
#: place nearby explains less than this part of it: streets do not repeat there. Four of 274 mirrored masks led by it,
#: where a city is like its mirror image: they were contradicted by 8.7 and more.
_CERTAIN = 12.0
#: Streets around are searched if the lead over the places met is at least this part of the lead needed. At wrong places
#: that part is up to a tenth, at right places nine tenths and more.
_MAY_LEAD = 0.5
#: Score that a place loses if all its roads are contradicted, and in proportion (see `Evidence.contradicted`). At right
#: places, on masks with up to half the roads gone, false, stale or bent, the share contradicted is 0 for nine of ten
#: and at most 0.09; at the best wrong places of mirrored masks its median is 0.16.
_PENALTY = 60.0
#: Number of the likeliest places met by the search that are compared, and most times that one turns out to be better.
N_LIKELIEST = 12
#: Two places are different if their middles are further apart than this share of half the frame's diagonal, and they
#: share less than this share of the roads met (see `Evidence.shared`), unless the other place explains more.
_APART, _SAME = 0.04, 0.67
#: The blocks beside a place (farther where the frame is large), and the streets around it, where the lead over places
#: near may be enough.
_NEARBY = LocalSearchOptions(reach_m=500.0, turn_deg=0.0, n_places=N_CLOSELY)
_AROUND = replace(_NEARBY, reach_m=4000.0, n_places=LocalSearchOptions.n_places)
#: Mirrors nothing (see `similar_places`).
_AS_SEEN = np.eye(3)


class Compared(NamedTuple):
    """Another place, its log10 likelihood by the best place's yardstick, the lead over it, and the score against it."""

    place: Place
    log10_likelihood: float
    lead: float
    against: float = 0.0

    @property
    def net(self) -> float:
        """Log10 likelihood, less the score against it."""
        return self.log10_likelihood - self.against


class Rivals:
    """Compares the likeliest place of each part of a map with its best rival, anew where further places were met."""

    def __init__(
        self,
        estimators: Mapping[Search[Place], TripleEstimator],
        ledger: Ledger,
        needed: float,
        time_limit_s: float = math.inf,
    ) -> None:
        """Places with a score below `needed` are not compared; no place is compared after the time limit."""
        self.estimators, self.ledger, self.needed = estimators, ledger, needed
        self._deadline = time.perf_counter() + time_limit_s
        self._compared: dict[tuple[Place, ...], Place] = {}  # by the place and those that were met
        self._pictured: dict[tuple[Place, ...], Place] = {}  # by the place by roads and those that were verified
        self._over_mirrored: list[tuple[Place, float]] = []  # and its lead over the mirrored query beside it
        self._similar: dict[tuple[Place, LocalSearchOptions], list[Compared]] = {}  # by the place, and how far around

    def __call__(self, parts: Sequence[Search[Place]]) -> Search[Place] | None:
        """Return the part whose likeliest place leads all others by twice the score needed, or None."""
        best = max(parts, key=self._explained)
        if max((place.score for place in self.estimators[best].verified), default=-math.inf) < self.needed:
            return None  # a place that was met is already too good a rival
        place = self._among_equals(best, self._by_roads)
        if place is None or place.score < 2.0 * self.needed:
            return None
        others = (self.estimators[part].verified for part in parts if part is not best)
        return None if any(self._are_near(place, verified) for verified in others) else best

    def stands(self, part: Search[Place]) -> bool:
        """Return whether a part of a map that is searched alone has the answer.

        Its likeliest place leads all others of the part by twice the score needed; or, where nothing of the map is left
        to search, a place leads by the score needed, for no better version or rival of it can come.
        """
        if part.best is not None and self([part]) is not None:
            return True
        index = self.estimators[part].index
        own = [it for it, estimator in self.estimators.items() if _is_of_map(index, estimator.index)]
        places = map(self.compare, own) if all(it.stopped for it in own) else ()
        return any(place is not None and place.score >= self.needed for place in places)

    def promise(self, part: Search[Place]) -> float:
        """Return what the likeliest place of a part explains, in scores needed."""
        most = max((place.log10_likelihood for place in self.estimators[part].verified), default=0.0)
        return most / max(self.needed, 1.0)  # of a user who asks for less

    def may_go_on(self, part: Search[Place]) -> bool:
        """Return whether a part may do its next stage: no place on another part explains more."""
        return 0.0 < self.promise(part) == max(map(self.promise, self.estimators))

    def _are_near(self, best: Place, others: Iterable[Place]) -> bool:
        """Return whether another place of another part explains nearly as much as the best place of all."""
        least = best.explained - self.needed * best.statement_px
        return any(other.explained > least and not other.same(best) for other in others)

    def _explained(self, part: Search[Place]) -> float:
        return max((place.explained for place in self.estimators[part].verified), default=-math.inf)

    def compare_all(self) -> Iterator[tuple[Search[Place], Place | None]]:
        """Yield each part with its likeliest place, scored against its best rival; None if no place was verified.

        Where the place of one part has ended the search, the places of a part that explain far less than it, by roads
        and by the picture, are not compared: the part has None.
        """
        accepted = next((part for part in self.estimators if part.stopped == "accepted"), None)
        best = None if accepted is None else self.compare(accepted)
        for part in self.estimators:
            yield part, self.compare(part) if part is accepted or self._may_matter(part, best) else None

    def _may_matter(self, part: Search[Place], best: Place | None) -> bool:
        """Return whether a part has a place that explains nearly as much, by roads or by the picture."""
        others = _likeliest(self.estimators[part])
        if best is None or self._are_near(best.but(by=None), others):
            return True
        if any(other.explained > EQUAL * best.but(by=None).explained for other in others):
            return True
        if best.scene.probability is None:
            return False
        pictured, *others = (by_picture(place, best.gsd_m) for place in [best, *others[:N_LIKELIEST]])
        return self._are_near(pictured, others)

    def compare(self, part: Search[Place]) -> Place | None:
        """Return the likeliest place of a part, scored against its best rival; None if no place was verified."""
        return self._among_equals(part, self._by_roads_and_picture)

    def _by_roads_and_picture(self, part: Search[Place]) -> Place | None:
        """Compare the likeliest place of a part with its best rival, by traced roads; by a soft picture, too.

        Where they favour the same place, the lesser lead counts as far as the best rival leaves traced roads
        unexplained: in a lattice both lead by the same few streets. Where they favour different places, it counts
        against: a grid that equals its mirror image fits, and a place that traced roads speak against is not the
        picture's to decide.
        """
        by_roads, estimator = self._by_roads(part), self.estimators[part]
        is_drawn = estimator.scene.probability is None
        if by_roads is None or by_roads.score >= _CERTAIN or is_drawn or time.perf_counter() > self._deadline:
            return by_roads
        started = time.perf_counter()
        by_picture = self._pictured.get((by_roads, *estimator.verified)) or self._by_picture(estimator)
        self._pictured[by_roads, *estimator.verified] = by_picture  # a rival may have been verified meanwhile
        part.seconds += time.perf_counter() - started
        best, other = sorted((by_roads, by_picture), key=lambda place: -place.score)
        counts = _unexplained(by_roads) if best.same(other) else -1.0
        return best.but(score=best.score + counts * max(other.score, 0.0))

    @property
    def _by_chance(self) -> float:
        """Score that a place loses: the larger the map, the more places may lead all places around them by chance."""
        return 2.0 * math.log10(larger(self.ledger.n_reference))

    def _by_picture(self, estimator: TripleEstimator) -> Place:
        """Compare the place that the picture favours with its best rival.

        A rival that leads by less than the score needed is not located either: it leads the place by no more.
        """
        ranked = _likeliest(estimator)[:N_LIKELIEST]
        gsd_m = ranked[0].gsd_m
        best = max(ranked, key=lambda place: by_picture(place, gsd_m).log10_likelihood)
        for _ in range(N_LIKELIEST):
            compared = self._compare_by_picture(estimator, estimator.refine_whole(best), ranked)
            if compared.rival is None or _lead(compared.rival, compared) < self.needed:
                break
            best = self._take(estimator, compared.rival, ranked)
        return compared

    def _compare_by_picture(self, estimator: TripleEstimator, best: Place, ranked: Sequence[Place]) -> Place:
        """Compare a place with those that were met, and with those around, by the picture."""
        picture = Picture(best.scene, best.index, best.gsd_m)
        apart_m = at_least(SAME_M, picture.gsd_m)
        others = [
            by_picture(place, picture.gsd_m) for place in ranked if math.dist(place.center, best.center) > apart_m
        ]
        likelihood, lead, rival = picture.weigh(best.matrix), math.inf, None
        for around in _surroundings(best):
            others += _around(picture, best, around.reach_m, apart_m, estimator)
            rival = max(others, key=lambda other: other.log10_likelihood, default=None)
            lead = picture.lead(likelihood, -math.inf if rival is None else rival.log10_likelihood)
            if not _MAY_LEAD * self.needed <= lead < 2.0 * self.needed:
                break
        score = max(lead - _penalty(best), 0.0) - self._by_chance
        return best.but(score=score, rival=rival, by=Weight(likelihood, picture.statement_px))

    def _among_equals(self, part: Search[Place], compare: Callable[[Search[Place]], Place | None]) -> Place | None:
        """Compare the likeliest place of a part; where it leads, also with places where the map is as it is there.

        A place where the mirrored query fits better is none.
        """
        place = compare(part)
        if place is None or place.score < self.needed:
            return place
        own = self.estimators[part]
        beside = [estimator for estimator in self.estimators.values() if estimator is not own]
        if not own.look_for_equals(place, self._deadline, beside):
            return place.but(score=min(place.score, 0.0))
        place = compare(part)
        return place if place is None else self._unless_mirrored(place, own.options)

    def _unless_mirrored(self, place: Place, match: MatchOptions) -> Place:
        """Return a place; with a fault, and no lead, if the mirrored query beside it leads it by the score needed."""
        if not self.needed <= place.score < _CERTAIN:
            return place
        lead = next((lead for other, lead in self._over_mirrored if other.same(place)), None)
        if lead is None:
            lead = place.agreement.log10_likelihood - mirrored_likelihood(place, match)
            self._over_mirrored.append((place, lead))
        return place if lead > -self.needed else place.but(score=lead, fault=CameraFault.MIRRORED)

    def _by_roads(self, part: Search[Place]) -> Place | None:
        """Compare the likeliest place of a part with its best rival, by traced roads."""
        estimator = self.estimators[part]
        ranked = _likeliest(estimator)
        if not ranked:
            return None
        started = time.perf_counter()
        best = max(ranked[:N_LIKELIEST], key=lambda place: place.log10_likelihood - _penalty(place))
        for _ in range(N_LIKELIEST):
            key = best, *ranked[: 1 + N_LIKELIEST]
            compared = self._compared.get(key) or self._compare(estimator, best, ranked)
            self._compared[key] = compared
            if not _is_beaten(compared):
                break
            best = self._take(estimator, compared.rival, ranked)
        part.seconds += time.perf_counter() - started
        return compared

    def _compare(self, estimator: TripleEstimator, best: Place, ranked: Sequence[Place]) -> Place:
        """Compare a place with its rivals, as far as hints allow them."""
        gave_up = best.refined is None and not math.isfinite(best.score)
        if gave_up or best.log10_likelihood < self.needed:
            return best.but(rival=None)
        penalty, own = _penalty(best), best.log10_likelihood
        likeliest = next((other.log10_likelihood for other in ranked if not other.same(best)), 0.0)
        lead = min(best.score, own - max(likeliest, 0.0))
        if lead >= _CERTAIN and not penalty and max(likeliest, estimator.nearby(best)) < HARDLY * own:
            return best.but(score=lead - penalty, rival=None)
        if time.perf_counter() > self._deadline:
            return best.but(score=min(lead, 0.0), rival=None)
        apart_m, compare = _APART * best.scene.half_size * best.gsd_m, best.evidence.compared_with(best.matrix)
        against = self._by_chance + penalty

        def is_rival(other: Compared) -> bool:
            return bool(
                math.dist(other.place.center, best.center) > apart_m
                and estimator.may_be(other.place.matrix)
                and (other.net > own or best.evidence.shared(best.matrix, other.place.matrix) < _SAME)
            )

        def scored(others: Sequence[Compared]) -> Place:
            rival = max(others, key=lambda other: other.net, default=None)
            lead = min((other.lead for other in others), default=math.inf)
            lead += log10_gap(own, [other.log10_likelihood for other in others])
            if rival is None:
                return best.but(score=min(lead, own) - against, rival=None)
            score = own - rival.net if rival.net > own else min(lead, own) - against
            return best.but(score=score, rival=rival.place.but(by=Weight(rival.net, best.statement_px)))

        others = [place for place in ranked[: 1 + N_LIKELIEST] if place is not best]
        met = (Compared(place, *compare(place.matrix), _penalty(place)) for place in others)
        rivals = list(filter(is_rival, met))
        compared = scored(rivals)
        leads = compared.score >= _MAY_LEAD * self.needed
        if not leads and estimator.nearby(best) < HARDLY * own:
            return compared
        for around in _surroundings(best)[: 1 + leads]:  # a neighbouring block may be the place
            key = best, around
            if key not in self._similar:
                self._similar[key] = similar_places(best, compare, estimator.options, around)
            rivals += filter(is_rival, self._similar[key])
            compared = scored(rivals)
            if _is_beaten(compared) or compared.score >= _CERTAIN:
                break
        return compared

    def _take(self, estimator: TripleEstimator, rival: Place | None, ranked: Sequence[Place]) -> Place:
        """Return the rival that explains more than the likeliest place, as it was verified; now, if it was not yet."""
        matrix = rival.matrix  # type: ignore[union-attr]
        verified = next((place for place in ranked if place.matrix is matrix), None)
        return verified or estimator.settle(Place(estimator.scene, estimator.index, matrix))[0]


def _likeliest(estimator: TripleEstimator) -> list[Place]:
    """Return the places that were verified, the likeliest by roads first."""
    return sorted(estimator.verified, key=lambda place: -place.log10_likelihood)


def _is_of_map(index: ReferenceIndex, other: ReferenceIndex) -> bool:
    return index.is_of_map(other) or index.is_shard_beside(other)


def _surroundings(place: Place) -> tuple[LocalSearchOptions, LocalSearchOptions]:
    """Return where rivals of a place are looked for: beside it, then in the streets around.

    Beside it is as far as half of the frame's diagonal at least, for in a large frame a lattice that is off by several
    blocks still fits most roads.
    """
    beside_m = max(_NEARBY.reach_m, place.scene.half_size * place.gsd_m)
    return replace(_NEARBY, reach_m=min(beside_m, _AROUND.reach_m)), _AROUND


def _is_beaten(place: Place) -> bool:
    """Return whether a place's rival explains more."""
    return place.rival is not None and place.rival.log10_likelihood > place.log10_likelihood


def _unexplained(place: Place) -> float:
    """Return the share of a place's likelihood that its best rival lacks."""
    rival = 0.0 if place.rival is None else place.rival.log10_likelihood
    return min(max(1.0 - rival / max(place.log10_likelihood, 1e-9), 0.0), 1.0)


def _lead(place: Place, other: Place) -> float:
    """Return the log10 lead of a place over another by the picture."""
    return Picture.lead(place.log10_likelihood, other.log10_likelihood)


def _penalty(place: Place) -> float:
    """Return the score that a place loses for the roads that it contradicts."""
    return _PENALTY * place.contradicted


def _around(picture: Picture, best: Place, reach_m: float, apart_m: float, estimator: TripleEstimator) -> list[Place]:
    """Return the likeliest other places around a place, shifted or turned, that agree with the hints."""
    if estimator.near is not None:
        reach_m = min(reach_m, 2.0 * estimator.near[2])
    peaks = picture.correlate(best.matrix, reach_m, _TURNS_DEG, N_LIKELIEST, apart_m)
    allowed = (place for place in peaks if estimator.may_be(place.matrix))
    return [picture.settle(place) for place in islice(allowed, N_CLOSELY)]


def similar_places(
    best: Place,
    compare: Callable[[FloatArray], tuple[float, float]],
    match: MatchOptions,
    around: LocalSearchOptions = _AROUND,
    mirror: FloatArray = _AS_SEEN,
) -> list[Compared]:
    """Return other places around a place that fit most roads; the likeliest are fully refined.

    `mirror` (3, 3) mirrors the query plane about the middle of the frame: places of the mirrored query are returned.
    """
    scene, index = best.scene, best.index
    drawn: Drawn = {}
    proposed: list[tuple[float, FloatArray]] = []
    for turn in _TURNS_DEG:
        turned = move_about(best.center, Shift(0.0, 0.0, turn, 1.0, 0.0)) @ best.matrix @ mirror
        if judge(turned @ mirror, scene.size, match.camera) is CameraFault.HEADING:
            continue
        shifts = search_nearby(turned, scene, index, around, drawn)
        proposed += [(shift.share, move_about(best.center, shift) @ turned) for shift in shifts]
    proposed.sort(key=lambda place: -place[0])
    starts = (Place(scene, index, matrix) for _, matrix in proposed[: around.n_places])
    fits = (fitted(start, match, N_ROUGHLY, mirror) for start in starts)
    roughly = sorted((Compared(fit, *compare(fit.matrix)) for fit in fits), key=lambda other: -other.log10_likelihood)
    finely = (fitted(other.place, match, None, mirror) for other in roughly[:N_CLOSELY])
    return [*(Compared(fit, *compare(fit.matrix)) for fit in finely), *roughly[N_CLOSELY:]]


def places_beside(place: Place, match: MatchOptions) -> list[Place]:
    """Return the other places beside a place, whatever hints allow."""
    beside, _ = _surroundings(place)
    return [other.place for other in similar_places(place, place.evidence.compared_with(place.matrix), match, beside)]


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


def mirrored_likelihood(place: Place, match: MatchOptions) -> float:
    """Return the log10 likelihood of the best place of the mirrored query beside a place, by that one's yardstick.

    The query is mirrored along its streets: a grid then runs as it does.
    """
    scene, camera = place.scene, replace(match.camera, heading_deg=None, north_up=False)
    east, north = scene.directions.T
    twice = np.angle((scene.weights * np.exp(4j * np.arctan2(north, east))).sum()) / 2.0
    linear = np.array([[math.cos(twice), math.sin(twice)], [math.sin(twice), -math.cos(twice)]])
    mirror = np.eye(3)
    mirror[:2] = np.column_stack((linear, scene.center - linear @ scene.center))
    args = place, place.evidence.compared_with(place.matrix), replace(match, camera=camera)
    mirrored = similar_places(*args, _surroundings(place)[0], mirror)
    return max((other.log10_likelihood for other in mirrored), default=-math.inf)


def fitted(start: Place, match: MatchOptions, n_points: int | None, mirror: FloatArray = _AS_SEEN) -> Place:
    """Return a place refined; the start if the refinement diverges. `mirror`: as in `similar_places`."""
    args = start.matrix, start.scene, start.index, start.matched
    refined = refine(*args, match.refine, n_points, held=True)
    if refined is None or judge(refined.matrix @ mirror, start.scene.size, match.camera) is not None:
        return start
    place = start.at(refined)
    return start if abs(math.log(place.gsd_m / start.gsd_m)) > math.log(1.1) else place
