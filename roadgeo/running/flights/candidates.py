"""Places that earlier frames of a flight proposed, tested by later ones on ground that was not seen before.

What a search finds pays for all the places it tried: a hundred thousand and more, five decades of odds. A place that
was proposed once, and then agrees with ground that the search did not know, pays only for how many were proposed
before it; or it pays for all that were tried, and counts all that was seen. So each frame that comes may tell, whether
or not the map is searched again, and where streets are alike a flight is found some frames sooner.

Where they form a lattice, chance nearby is the block beside, and neither comes to much. There two questions are asked
apart: whether the place fits better than streets usually do, less all places that were tried; and whether it agrees
better, piece by piece, than any other place that the roads would fit. The weaker answer counts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import cast

import numpy as np

from roadgeo._arrays import FloatArray, IntArray
from roadgeo.errors import MaskError
from roadgeo.geometry.camera import judge, sampling
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.mask import PIXEL_TO_PLANE, RoadMask
from roadgeo.location import Location
from roadgeo.matching.checking import CheckOptions, check_place
from roadgeo.matching.estimator import MatchOptions, TripleEstimator
from roadgeo.matching.exactness import exact_log10_odds
from roadgeo.matching.hypothesis import Hypothesis
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.methods import Fit, Found, search_references
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.pieces import log10_lead
from roadgeo.matching.query import Query, trace_query
from roadgeo.matching.refinement import refine
from roadgeo.matching.scene import Scene
from roadgeo.matching.trace import NoTrace
from roadgeo.matching.twins import Contest, TwinOptions
from roadgeo.matching.verdict import decide
from roadgeo.matching.verification import agreement, chance_agreement, log10_odds
from roadgeo.reference.reference import Reference
from roadgeo.running.flights.mosaic import Mosaic, MosaicOptions, unseen_before

__all__ = ["CandidateOptions", "Candidates", "Look"]

_NO_SEEDS: IntArray = np.array([], np.int64)

#: So often the places are compared at the scale of the best one, until it stays that.
_MOST_SCALES = 4


@dataclass(frozen=True)
class CandidateOptions:
    """How many places are kept, and which.

    Attributes
    ----------
    per_look : int
        Best places of each look that are tested by the frames to come.
    most : int
        Of more, the half with the best odds are kept, and of the others those that agree best.
    hopeless : float
        Log10 odds of later ground by which a place is given up.
    fewest_roads : int
        Ground that shows fewer roads than this is no test yet.
    n_best : int
        Chance is what so many of the best shifted places reach on average.
    usual : int
        How well streets usually fit is what so many of the best shifted places reach on average.
    check : CheckOptions
        A place that would do is compared with all places near it: it may be one block off. Where it does not lead them
        chance is what the best shifted place reaches.
    """

    per_look: int = 30
    most: int = 60
    hopeless: float = -2.0
    fewest_roads: int = 6
    n_best: int = 8
    usual: int = 60
    twins: TwinOptions = field(default_factory=TwinOptions)
    check: CheckOptions = field(default_factory=lambda: CheckOptions(tolerance_m=20.0, max_sigma_m=10.0))


@dataclass(frozen=True)
class Look:
    """Frames laid together, and which they are.

    Attributes
    ----------
    numbers : sequence of int
        Number of each frame.
    masks : sequence of RoadMask
    searched : bool
        Whether the map is searched for them; otherwise only what was proposed is tested.
    """

    query: Query
    mosaic: Mosaic
    numbers: Sequence[int]
    masks: Sequence[RoadMask]
    searched: bool


@dataclass
class _Candidate:
    """A place.

    Attributes
    ----------
    index : ReferenceIndex
        What it was found on.
    whole : ReferenceIndex
        The reference that is part of.
    matrix : (3, 3) float64
        Pixel of the frame `seen_at` to reference plane.
    since : int
        Number of the latest frame that proposed it.
    n_tried : int
        Places that were tried until then.
    proposed : float
        Log10 odds of all that was seen, less all that were tried.
    rank : int
        So many were proposed before it at that look.
    n_looks : int
        Looks at the map until then.
    tested : float
        Log10 odds of the ground seen since.
    leading : float
        Log10 odds by which it agrees better than any other place, or, if that is less, better than streets usually do,
        less all that were tried; -inf where that was not asked.
    worth : float
        Sum of what all pieces of the mosaic say for it.
    fit : Fit or None
        Where it was last laid; None before any frame came.
    """

    index: ReferenceIndex
    whole: ReferenceIndex
    matrix: FloatArray
    seen_at: int
    since: int
    n_tried: int
    proposed: float
    rank: int
    n_looks: int
    tested: float = 0.0
    leading: float = -math.inf
    worth: float = -math.inf
    fit: Fit | None = None

    @property
    def log10_odds(self) -> float:
        """What speaks for it: all that was seen, less what was tried; what was seen since, less the rank; or its lead.

        Of these what says most, less the looks.
        """
        return max(self.proposed, self.later, self.leading) - math.log10(self.n_looks)

    @property
    def later(self) -> float:
        """What was seen since, less the rank.

        The weights 1 / ((r + 1) (r + 2)) of the ranks r = 0, 1, ... have the sum 1: however many places are tested,
        they pay as one does.
        """
        return self.tested - math.log10((self.rank + 1) * (self.rank + 2))

    def lay(self, look: Look, options: LocateOptions) -> None:
        """Refine it on all that was seen, and count that; without a fit it can be no place of these frames."""
        whole, match = look.query.scene, options.match
        matrix, self.fit = _lay(self, look), None
        if matrix is None or judge(matrix, whole.size, match.camera, rough=True) is not None:
            return
        _, matched, _ = agreement(matrix, whole, self.index, sampling(matrix, whole.size), _NO_SEEDS, match.verify)
        refined = refine(matrix, whole, self.index, matched, match.refine, held=True)
        if refined is None or judge(refined.matrix, whole.size, match.camera) is not None:
            return
        matrix, gsd = refined.matrix, sampling(refined.matrix, whole.size)
        found, matched, distance = agreement(matrix, whole, self.index, gsd, _NO_SEEDS, match.verify)
        chance = chance_agreement(matrix, whole, self.index, gsd, match.verify)
        model = Hypothesis(matrix, _NO_SEEDS, 1.0, matched, found=found, chance=chance, gsd_m=gsd)
        self.proposed = _odds(model, whole, self.index, self.n_tried, match)
        self.matrix, self.seen_at = matrix @ PIXEL_TO_PLANE @ look.mosaic.to_mosaic[-1], look.numbers[-1]
        self.fit = Fit(
            self.index, matrix, matched, distance, found.forward, self.proposed,
            refined.corner_sigma_m, refined.corner_covariance_m2,
            agreement=found.mean,
        )  # fmt: skip

    def test(self, fresh: Scene | None, look: Look, locate: LocateOptions, options: CandidateOptions) -> None:
        """Compare it with the map on ground that had not been seen when it was proposed."""
        self.tested = 0.0
        if self.fit is None or fresh is None:
            return
        whole, verify, matrix = look.query.scene, locate.match.verify, self.fit.matrix
        gsd, least = sampling(matrix, whole.size), locate.min_log10_odds - locate.min_margin
        found, _, _ = agreement(matrix, fresh, self.index, gsd, _NO_SEEDS, verify)
        for n_best in (options.n_best, 1):
            chance = chance_agreement(matrix, fresh, self.index, gsd, verify, n_best=n_best)
            self.tested = log10_odds(found, chance, fresh.n_statements, 1, verify)
            if self.later - math.log10(self.n_looks) < least or _leads(matrix, whole, self.index, options):
                break

    def stands_out(self, look: Look, locate: LocateOptions, usual: int) -> float:
        """Return the log10 odds of all that was seen against how well streets usually fit, less all that were tried."""
        if self.fit is None:
            return -math.inf
        scene, verify, matrix = look.query.scene, locate.match.verify, self.fit.matrix
        gsd = sampling(matrix, scene.size)
        found, _, _ = agreement(matrix, scene, self.index, gsd, _NO_SEEDS, verify)
        chance = chance_agreement(matrix, scene, self.index, gsd, verify, n_best=usual)
        return log10_odds(found, chance, scene.n_statements, self.n_tried, verify)


class _Recorder(NoTrace):
    """Keeps what a search compared with the map."""

    def __init__(self) -> None:
        self.estimator: TripleEstimator | None = None
        self.scored_models: list[Hypothesis] = []

    def began(self, estimator: TripleEstimator) -> None:
        """Note what searches."""
        self.estimator = estimator

    def scored(self, model: Hypothesis) -> None:
        """Note a place."""
        self.scored_models.append(model)

    def best(self, count: int) -> list[Hypothesis]:
        """Return the best places, each once."""
        estimator, kept = self.estimator, list[Hypothesis]()
        if estimator is None:
            return kept
        for model in sorted(self.scored_models, key=lambda one: -one.log10_odds):
            if len(kept) == count or not math.isfinite(model.log10_odds):
                break
            if model.found is not None and not any(estimator.same(model, one) for one in kept):
                kept.append(model)
        return kept


@dataclass
class Candidates:
    """The places that one lost flight may be at.

    Attributes
    ----------
    n_looks : int
        Searches of the map so far: each takes its share off the odds.
    """

    references: Sequence[Reference]
    options: CandidateOptions = field(default_factory=CandidateOptions)
    mosaic: MosaicOptions = field(default_factory=MosaicOptions)
    n_looks: int = 0
    _kept: list[_Candidate] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self._kept)

    def look(self, look: Look, options: LocateOptions) -> Location:
        """Test what was proposed, search the map where that is due, and judge both together."""
        self._test(look, options)
        self.n_looks += look.searched
        if look.searched and options.effort == "full":
            # A quick search proposes the place nearly as often, in a tenth of the time: it will do where that leads.
            location = self._search(look, replace(options, effort="quick"))
            if location.located and self._has_leader(options):
                return location
        return self._search(look, options)

    def _has_leader(self, options: LocateOptions) -> bool:
        """Whether a place leads all others by what is asked."""
        return any(one.leading - math.log10(one.n_looks) >= options.min_log10_odds for one in self._kept)

    def _search(self, look: Look, options: LocateOptions) -> Location:
        """Search the map where that is due, and judge what is found together with what was proposed before."""
        found: list[Found] = []
        if look.searched:
            parts = [part for one in self.references for part in one.parts]
            found = search_references(look.query, parts, options, options.search.time_limit_s, _Recorder)
        for one in found:
            self._take(one, cast("_Recorder", one.trace), look)
        for candidate in self._kept:
            if candidate.since == look.numbers[-1] and candidate.fit is None:
                candidate.lay(look, options)
        self._find_leader(look, options)
        # Flights compare with twins themselves, over all frames.
        location = decide(look.query, self._with_tested(found, look), replace(options, twins=None))
        self._kept = self._best_kept()
        return location

    def _best_kept(self) -> list[_Candidate]:
        """Return the places that are kept: half of them have the best odds, the others agree best.

        In a lattice the odds of the place are as low as those of others, until it leads them.
        """
        by_odds = sorted(self._kept, key=lambda one: -one.log10_odds)
        n = self.options.most // 2
        return by_odds[:n] + sorted(by_odds[n:], key=lambda one: -one.worth)[: self.options.most - n]

    def _test(self, look: Look, options: LocateOptions) -> None:
        """Lay all that frames have shown on each place; count all of it, and what was not seen when it was proposed."""
        scenes: dict[int, Scene | None] = {}
        for one in self._kept:
            if one.since not in scenes:
                scenes[one.since] = self._ground_since(look, one.since, options)
            one.lay(look, options)
            one.test(scenes[one.since], look, options, self.options)
        self._kept = [one for one in self._kept if one.fit is not None and one.tested >= self.options.hopeless]

    def _find_leader(self, look: Look, options: LocateOptions) -> None:
        """Compare the place that agrees best with all others that were proposed, then with its twins on the map."""
        for one in self._kept:
            one.leading = -math.inf
        laid = [(one, one.fit) for one in self._kept if one.fit is not None]
        if not laid:
            return
        scene, size = look.query.scene, look.query.scene.size
        # How near roads must be depends on the scale: that of the best place itself counts.
        gsd, k = float(np.quantile([sampling(fit.matrix, size) for _, fit in laid], 0.75)), -1
        for _ in range(_MOST_SCALES):
            contest = Contest(scene, gsd, options.match, self.options.twins)
            worth = [contest.weigh(fit.matrix, fit.index) for _, fit in laid]
            before, k = k, int(np.argmax([pieces.sum() for pieces in worth]))
            if k == before:
                break
            gsd = sampling(laid[k][1].matrix, size)
        else:
            return
        for (one, _), pieces in zip(laid, worth, strict=True):
            one.worth = float(pieces.sum())
        best, fit = laid[k]

        def lead(matrix: FloatArray, index: ReferenceIndex, pieces: FloatArray) -> float:
            one = index is fit.index and _are_one(matrix, fit.matrix, size)
            return math.inf if one else log10_lead(worth[k] - pieces)

        leads = [lead(other.matrix, other.index, pieces) for (_, other), pieces in zip(laid, worth, strict=True)]
        leading = min(best.stands_out(look, options, self.options.usual), *leads)
        if leading - math.log10(best.n_looks) >= options.min_log10_odds:
            twins = contest.twins_of(fit.matrix, fit.index)
            leads = [lead(twin, fit.index, contest.weigh(twin, fit.index)) for twin in twins]
            best.leading = min(leading, *leads)

    def _ground_since(self, look: Look, since: int, options: LocateOptions) -> Scene | None:
        """Return what is seen on ground that no frame up to `since` saw; None where that shows hardly a road."""
        later = sum(number > since for number in look.numbers)
        mask = unseen_before(look.masks, look.mosaic, len(look.masks) - later, self.mosaic)
        try:
            scene = trace_query(mask, options.query)[0]
        except MaskError:
            return None
        return scene if scene.n_edges >= self.options.fewest_roads else None

    def _with_tested(self, found: list[Found], look: Look) -> list[Found]:
        """Add places that stood a test to what was found; each place counts by what speaks most for it."""
        paid = math.log10(max(self.n_looks, 1))
        merged = [replace(one, fits=tuple(_less(fit, paid) for fit in one.fits)) for one in found]
        for one in self._kept:
            if one.fit is None:
                continue
            fit = replace(one.fit, log10_odds=one.log10_odds)
            k = next((k for k, other in enumerate(merged) if other.index is one.whole), len(merged))
            if k == len(merged):
                merged.append(Found(one.whole, n_searched=len(one.whole)))
            merged[k] = replace(merged[k], fits=_added(merged[k].fits, fit, look.query.scene.size))
        return merged or [Found(one.index) for one in self.references]

    def _take(self, found: Found, recorder: _Recorder, look: Look) -> None:
        """Keep what a search proposed, unless it is known."""
        last, to_frame = look.numbers[-1], PIXEL_TO_PLANE @ look.mosaic.to_mosaic[-1]
        scene, estimator = look.query.scene, recorder.estimator
        if estimator is None:
            return
        last_rank = max((one.rank for one in self._kept if one.since == last and one.whole is found.index), default=-1)
        for rank, model in enumerate(recorder.best(self.options.per_look), last_rank + 1):
            n_tried, proposed = estimator.ledger.n_tried, _fully_scored(model, estimator)
            new = _Candidate(
                estimator.index, found.index, model.matrix @ to_frame, last, last, n_tried, proposed, rank, self.n_looks
            )
            here = (one for one in self._kept if one.whole is found.index)
            old = next((one for one in here if _are_one(_lay(one, look), model.matrix, scene.size)), None)
            if old is None or old.log10_odds < new.log10_odds:
                self._kept = [*(one for one in self._kept if one is not old), new]


def _fully_scored(model: Hypothesis, estimator: TripleEstimator) -> float:
    """Return the log10 odds of a place, less all that were tried, also where the search stopped to look at it."""
    scene, index, verify = estimator.scene, estimator.index, estimator.options.verify
    if model.found is None:
        return -math.inf
    chance = chance_agreement(model.matrix, scene, index, model.gsd_m, verify)
    return _odds(replace(model, chance=chance), scene, index, estimator.ledger.n_tried, estimator.options)


def _odds(model: Hypothesis, scene: Scene, index: ReferenceIndex, n_tried: int, match: MatchOptions) -> float:
    """Return the log10 odds of a place that was compared with the map, as a search does it."""
    if model.found is None:
        return -math.inf
    usual = log10_odds(model.found, model.chance, scene.n_statements, n_tried, match.verify)
    model = replace(model, log10_odds=usual)
    return exact_log10_odds(model, scene, index, n_tried, match.verify, match.certain)


def _leads(matrix: FloatArray, scene: Scene, index: ReferenceIndex, options: CandidateOptions) -> bool:
    """Whether a place agrees better than all others near it."""
    return check_place(matrix, scene, index, options.check).verdict == "agrees"


def _lay(one: _Candidate, look: Look) -> FloatArray | None:
    """Return where a place puts the mosaic, query plane to reference plane; None where their frames do not touch."""
    if one.seen_at not in look.numbers:
        return None
    to_mosaic = look.mosaic.to_mosaic[list(look.numbers).index(one.seen_at)]
    matrix = one.matrix @ np.linalg.inv(to_mosaic) @ PIXEL_TO_PLANE
    return np.asarray(matrix / matrix[2, 2])


def _less(fit: Fit, paid: float) -> Fit:
    return replace(fit, log10_odds=fit.log10_odds - paid)


def _are_one(a: FloatArray | None, b: FloatArray, size: tuple[int, int]) -> bool:
    """Whether two places put the middle of a mosaic within 50 m, or a twentieth of its size, of each other."""
    if a is None:
        return False
    frame = Frame(*size)
    apart = np.hypot(*(Homography(a)(frame.plane_center) - Homography(b)(frame.plane_center)))
    return bool(apart < frame.one_place_m(sampling(b, size)))


def _added(fits: tuple[Fit, ...], fit: Fit, size: tuple[int, int]) -> tuple[Fit, ...]:
    """Add a fit to others on its reference, which lie apart; of those at one place the likeliest stays."""
    twins = [one for one in fits if _are_one(one.matrix, fit.matrix, size)]
    if any(one.log10_odds >= fit.log10_odds for one in twins):
        return fits
    return (*(one for one in fits if not any(one is twin for twin in twins)), fit)
