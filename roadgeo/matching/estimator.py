"""From a query scene to a place on the map: propose, grow, verify and refine, as one problem for the robust loop."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import islice, zip_longest

import numpy as np

from roadgeo._arrays import BoolArray, FloatArray, IntArray
from roadgeo.geometry.areas import Box, lies_in
from roadgeo.geometry.camera import CameraFault, CameraOptions, judge
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.projection import to_lonlat
from roadgeo.matching.events import Events, Ledger
from roadgeo.matching.growing import (
    MAX_GROWN,
    MAX_SCALE_RATIO,
    MAX_SCREENED,
    MAX_VERIFIED,
    SharedSweeps,
    grow_proposals,
    screen_proposals,
)
from roadgeo.matching.index import ReferenceIndex, unpack_tangents
from roadgeo.matching.lens import ENOUGH, find_lens, grow_whole, straighten_scene
from roadgeo.matching.place import Place
from roadgeo.matching.refinement import RefineOptions, refine
from roadgeo.matching.road_search import RoadRound, RoadSearch
from roadgeo.matching.scene import AGREE_DEG, LEAST_SHARE, N_NEIGHBOURS, NOTICEABLE, Scene, query_neighbours
from roadgeo.matching.triples import (
    BEFORE_ROADS,
    N_RAREST,
    WITHOUT_ROADS,
    Proposals,
    Sweep,
    TripleOptions,
    cut_to_units,
    larger,
    n_units,
    propose,
)
from roadgeo.roads.intersections import Intersections, unpack_branches

__all__ = ["EQUAL", "HARDLY", "Ledger", "MatchOptions", "TripleEstimator"]

#: Stop refining a place below this log10 likelihood, or, after the first two refinements, below this part of
#: the best place's: 276 of 277 right places led every other place by a fifth after the first.
_LEAST_LIKELY, _BEHIND = 0.7, 0.8
#: A place that explains less than this part of the best place is not refined again after the first refinement. A place
#: that grew by roads is not refined at all if it explains less as grown: the least of 71 right places explained 0.9.
HARDLY = 0.5
#: A place that leads all earlier places by this score is compared with places nearby; if it leads these too, a lens is
#: tried. The weakest of ten right places with a lens, or fitted to a part only, led by 3.2.
_LEADING = 2.0
#: How the map's intersections at a place, spread over the frame, are looked up elsewhere before it is accepted; and the
#: part of their neighbours there that an equal place has at least.
_OWN_TRIPLES, EQUAL = TripleOptions(spread=True, max_hits=1_000, max_compared=40_000), 0.75
#: Most of them that are looked up on other maps: an equal place has nearly all of them.
_BESIDE = 3
#: Approximate seconds of each step, measured on lattices, where searches are longest: looking up an intersection of the
#: query, a map triple like a query triple, screening or voting for a place, growing a hypothesis by intersections and
#: by roads, and fitting a hypothesis to the map once, plus the time for each road point.
_STEP_S, _TUPLE_S, _PLACE_S, _GROWN_S, _BY_ROADS_S = 1e-3, 0.5e-6, 1.5e-6, 0.5e-3, 0.1e-3
_FITTED_POINT_S = 3.5e-6


@dataclass(frozen=True)
class MatchOptions:
    """Options of all stages of matching, nested.

    Sweeps follow each other until a place stands out. If no place does, roads propose.

    Attributes
    ----------
    sweeps, without_roads : tuple of Sweep
        The sweeps before roads propose, and the longer sweeps if roads are not used.
    roads : bool
        Whether roads propose, rather than further sweeps, if no triple leads to a place.
    lens : bool
        Whether a lens is tried at promising places.
    max_places : int
        The sweeps also end when this many places were screened on a map of 15,000 intersections. On a larger map the
        limit grows by the root of the ratio. Where streets are alike, proposals abound, and late proposals are seldom
        right: 29 of 31 masks that took more than half a second had been found among the first 7,000 places.
    within : (west, south, east, north) or None
        Box, in degrees, that is known to contain the middle of the frame (see `geometry.areas`).
    """

    sweeps: tuple[Sweep, ...] = BEFORE_ROADS
    without_roads: tuple[Sweep, ...] = WITHOUT_ROADS
    refine: RefineOptions = field(default_factory=RefineOptions)
    camera: CameraOptions = field(default_factory=CameraOptions)
    roads: bool = True
    lens: bool = True
    max_places: int = 12_000
    within: Box | None = None


class TripleEstimator:
    """Locates a scene by triples of neighbouring intersections; see `search.Estimator`."""

    def __init__(
        self,
        sweeps: SharedSweeps,
        index: ReferenceIndex,
        options: MatchOptions | None = None,
        near: tuple[float, float, float] | None = None,
        events: Events | None = None,
        ledger: Ledger | None = None,
    ) -> None:
        """`near` = (x, y, radius) in plane metres restricts where the middle of the frame may lie.

        The `sweeps` of a scene and the `ledger` are shared with the estimators of other parts that are searched with
        this one.
        """
        self.near = near
        self.ledger = ledger or Ledger(len(index))
        self.events = events or Events()
        self.refine_s = 0.0
        self.n_nulls = 0
        self.proposed: list[Place] | None = None  # places that are verified first; None where there are none
        self.verified: list[Place] = []
        self._settled: dict[Place, Place] = {}  # what became of each place that was to be verified
        self._nearby: dict[Place, float] = {}
        self._fitted: list[tuple[Place, float]] = []  # through a lens, and which share of roads agreed without
        self._equals_of: list[Place] = []  # like which others were looked for
        self._equals: list[Place] = []  # that were found
        self.whole: list[Place] = []  # verified, and no better version of them is to be expected
        self.sweeps, self.scene, self.index = sweeps, sweeps.scene, index
        self.options = options or MatchOptions()
        camera, usual = self.options.camera, self.options.refine
        self.refine_options = replace(usual, perspective_sigma=camera.perspective_sigma(usual.perspective_sigma))
        self.n_tuples = self.n_candidates = self.n_screened = self.n_hypotheses = self.n_verified = 0
        self._n_rounds, self._n_by_roads, self._anchors, self._fitted_s = 0, 0, set[int](), 0.0
        sweeps.members.append(self)
        self.in_company = False  # whether it is searched with others, by triples
        self.by_unit = False  # whether it is searched alone then, each unit by roads

    def leave_company(self) -> None:
        """Go on as if no other part were searched; the places that were verified stay known."""
        self.in_company, self.by_unit, self.proposed, self.ledger = False, True, None, Ledger(len(self.index))
        self.sweeps = SharedSweeps(self.scene, self.options.camera, self.sweeps.ahead)
        self.sweeps.members.append(self)

    @cached_property
    def units(self) -> IntArray:
        """The unit (N,) of each intersection of the map."""
        return cut_to_units(self.index.xy)

    def stages(self) -> Iterator[Iterator[list[Place]]]:
        """Yield the places that were proposed before, then those that grew from each anchor; triples before roads.

        On a coarse map roads come first: an intersection is seldom merged there as a mask shows it. They do, too, where
        maps are searched alone: triples were looked up on all of them together.
        """
        options, by_roads = self.options, self.options.roads and len(self.scene.intersections) > 0
        sources = options.sweeps if by_roads else options.without_roads
        stages = [self.sweeps.rounds(self, source) for source in sources]
        if by_roads and not self.in_company:
            roads_first = self.by_unit or self.index.coarseness > 1.0
            stages.insert(0 if roads_first else len(stages), self._rounds_of_roads())
        if self.proposed is not None:
            yield iter([self.proposed])
        yield from stages

    @property
    def work(self) -> float:
        """Seconds that a usual machine takes for the work done (see `search.Estimator`), on one core."""
        tried_s = _STEP_S * self._n_rounds + _TUPLE_S * self.n_candidates + _PLACE_S * self.n_screened
        by_roads_s = (_BY_ROADS_S - _GROWN_S) * self._n_by_roads
        return tried_s + _GROWN_S * self.n_hypotheses + by_roads_s + self._fitted_s

    @property
    def n_anchors(self) -> int:
        """Intersections of the query that were looked up."""
        return len(self._anchors)

    def _count(self, n_places: int, by: str) -> None:
        """Count further places as tried, which triples or roads proposed."""
        self.n_screened += n_places
        self.ledger.tried[by] += n_places

    def _rounds_of_roads(self) -> Iterator[list[Place]]:
        """Yield places that grew by roads from an anchor, on all units, and were not met before."""
        met: list[Place] = []
        for rounds in self._votes_of_roads():
            fresh: list[Place] = []
            for anchor, n_tried, n_proposed, grown in rounds:
                self._count(n_tried, "roads")
                self.n_hypotheses += n_proposed
                self._n_by_roads += n_proposed
                self._n_rounds += 1
                self._anchors.add(anchor)
                self.events.note("voted", anchor, n_proposed)
                for place in grown:
                    is_met = any(self._is_met_again(other, place) for other in met)
                    if not is_met and not any(other.same(place) for other in fresh) and self._is_plausible(place):
                        fresh.append(place)
            met += fresh
            self.events.note("grown", [place.matrix for place in fresh])
            yield fresh

    def _votes_of_roads(self) -> Iterator[list[RoadRound]]:
        """Yield the rounds of an anchor: one, or one of each unit, where the map is searched alone."""
        args = self.scene, self.index, self.options.camera, self.near, self.sweeps.ahead
        if not self.by_unit:
            searches = [RoadSearch(*args)]
        else:
            units = (np.flatnonzero(self.units == unit) for unit in range(n_units(len(self.index))))
            searches = [RoadSearch(*args, own) for own in units]
        for rounds in zip_longest(*(search.rounds() for search in searches)):
            yield [one for one in rounds if one is not None]

    def _is_plausible(self, place: Place) -> bool:
        """Return whether a camera can have seen a place that grew."""
        fault = self.judge(place.matrix, rough=True)
        if fault is not None:
            self.events.note("refused", fault, place.matrix)
        return fault is None

    def _is_met_again(self, other: Place, place: Place) -> bool:
        """Return whether a place is what became of another that turned out promising."""
        settled = self._settled.get(other)
        return settled is not None and settled.log10_likelihood >= _LEAST_LIKELY and settled.same(place)

    def enough(self) -> bool:
        """Return whether the limit of screened places, for a map as large as all parts together, is reached."""
        return self.ledger.tried["triples"] >= int(self.options.max_places * larger(self.ledger.n_reference))

    def screen(self, proposals: Proposals, allowed: BoolArray, most: int) -> IntArray:
        """Return the proposals that are allowed and lie on roads, the best placed first."""
        self._anchors.add(proposals.anchor)
        kept = self._screen(self.scene, proposals, allowed, most)
        self.events.note("screened", proposals, allowed, kept)
        return kept

    def _screen(self, scene: Scene, proposals: Proposals, allowed: BoolArray, most: int) -> IntArray:
        self._n_rounds += 1
        self.n_tuples += proposals.n_tuples
        self.n_candidates += proposals.n_hits
        looked_at = np.flatnonzero(allowed)[:most]
        self._count(len(looked_at), "triples")
        return screen_proposals(scene, self.index, proposals, looked_at)

    def allow(self, proposals: Proposals) -> BoolArray:
        """Return which proposals put the middle of the frame, and its up direction, within the limits."""
        j00, j01, j10, j11 = proposals.affine.T
        allowed = np.ones(len(j00), bool)
        if self.near is not None:
            frame = 2.0 * self.scene.half_size * np.sqrt(np.maximum(j00 * j11 - j01 * j10, 0.0))
            away_m = np.hypot(*(self.index.xy[proposals.reference] - self.near[:2]).T)
            allowed &= away_m < self.near[2] + frame
        return allowed & (self.options.camera.turned_off(j01, j11) < AGREE_DEG)

    def grow(self, proposals: Proposals, chosen: IntArray) -> list[Place]:
        """Grow the chosen proposals of an anchor; return those that were not given up, the best supported first."""
        return grow_proposals(self.scene, self.index, proposals, chosen, self.options.camera)

    def follow_up(self, proposals: Proposals, chosen: IntArray) -> Iterator[Place]:
        """Yield the grown proposals of an anchor that are different places and that a camera can have seen."""
        self.n_hypotheses += len(chosen)
        grown = self.grow(proposals, chosen)
        self.events.note("grown", [place.matrix for place in grown])
        distinct: list[Place] = []
        for place in filter(self._is_plausible, grown):
            if not any(place.same(other) for other in (*self.whole, *distinct)):
                distinct.append(place)
                yield place

    def look_for_equals(self, place: Place, deadline: float = math.inf, beside: Sequence[TripleEstimator] = ()) -> bool:
        """Verify where else the map is as in a place's frame, on it and on maps beside, at any turn and scale; once.

        The map's own intersections there are looked up, not the query's, of which some are false, and others lack. Such
        places are refined to the end: one that grew from few intersections explains little at first. Returns whether
        all were looked for before the deadline, by `time.perf_counter`.
        """
        if any(other.same(place) for other in self._equals_of):
            return True
        shown, placed = map_scene(place), dict[int, float]()
        for (proposals,) in self._look_up(shown, place.gsd_m, [self.index]):
            is_own = proposals.reference == shown.intersections.node[proposals.anchor]
            placed[proposals.anchor] = least = EQUAL * int(proposals.placed[is_own].max(initial=0))
            alike = ~is_own & (proposals.placed >= least)
            if not self._verify_alike(place, shown, proposals, alike, deadline):
                return False
        anchors = np.array([anchor for anchor, least in placed.items() if least > 0.0][:_BESIDE], int)
        for found in self._look_up(shown, place.gsd_m, [one.index for one in beside], anchors) if beside else ():
            for one, proposals in zip(beside, found, strict=True):
                alike = proposals.placed >= placed[proposals.anchor]
                if not one._verify_alike(place, shown, proposals, alike, deadline):
                    return False
        self._equals_of.append(place)
        return True

    def _look_up(
        self, shown: Scene, gsd_m: float, indexes: Sequence[ReferenceIndex], anchors: IntArray | None = None
    ) -> Iterator[list[Proposals]]:
        """Yield where triples of a map's intersections are found on maps, at any turn and scale, for some anchors."""
        camera = self.options.camera
        scale = camera.gsd_m[0] / MAX_SCALE_RATIO / gsd_m, camera.gsd_m[1] * MAX_SCALE_RATIO / gsd_m
        args = shown, indexes, scale, camera.min_shape_ratio, _OWN_TRIPLES
        return islice(propose(*args, self.sweeps.ahead, anchors), N_RAREST)

    def _verify_alike(
        self, place: Place, shown: Scene, proposals: Proposals, alike: BoolArray, deadline: float
    ) -> bool:
        """Verify other places than a place; return whether all were verified before the deadline."""
        kept = self._screen(shown, proposals, alike, MAX_SCREENED)[:MAX_GROWN]
        self.n_hypotheses += len(kept)
        grown = grow_proposals(shown, self.index, proposals, kept, self.options.camera)
        others = (Place(self.scene, self.index, one.matrix @ place.matrix) for one in grown)
        known = [place, *self.whole, *self._equals]
        new = (other for other in filter(self._is_plausible, others) if not any(map(other.same, known)))
        for other in islice(new, MAX_VERIFIED):
            if time.perf_counter() > deadline:
                return False
            whole = self.refine_whole(self.settle(other)[0])
            known.append(whole)
            if whole.refined is not None and self.may_be(whole.matrix):
                self.verified.append(whole)
                self._equals.append(whole)
        return True

    def settle(self, place: Place) -> tuple[Place, float]:
        """Return a place refined, and its score: its lead over the places that were met, and over those nearby."""
        started = time.perf_counter()
        self.n_verified += 1
        settled = self._verify(place)
        if settled.score >= _LEADING:
            settled = self._look_through_lens(settled)
        if math.isfinite(settled.score):
            self.verified.append(settled)
        self._settled[place] = settled
        self.refine_s += time.perf_counter() - started
        self.events.note("settled", settled)
        if not settled.by_roads and self._fits_whole(settled):
            self.whole.append(settled)
        return settled, settled.score

    def _verify(self, place: Place) -> Place:
        """Refine a place with more and more points, as long as it may be the best place, or its rival."""
        best = max((other.log10_likelihood for other in self.verified), default=0.0)
        if place.by_roads and 0.0 < HARDLY * best > place.log10_likelihood:
            return self._scored(place)
        for n_points, least in ((150, _BEHIND * best), (300, _BEHIND * best), (None, 0.0)):
            place, converged = self._converge(place, n_points, HARDLY * best)
            if not converged:
                return place
            if place.log10_likelihood < max(_LEAST_LIKELY, least):
                return self._scored(place)
        return self._weigh(place)

    def refine_whole(self, place: Place) -> Place:
        """Return a verified place refined with all points, which may have been given up before."""
        if place.refined is None or place.lens_k1 != 0.0:
            return place
        return self._converge(place, None, -math.inf)[0].but(fault=None, score=place.score)

    def _weigh(self, place: Place) -> Place:
        """Score a place, and, if it leads all other verified places, compare it with the best place nearby."""
        scored = self._scored(place)
        if scored.score >= _LEADING:
            self.nearby(scored)
            scored = self._scored(scored)
        return scored

    def nearby(self, place: Place) -> float:
        """Return the log10 likelihood of the best place nearby (see `Evidence.nearby`); computed once."""
        if place not in self._nearby:
            self.n_nulls += 1
            self._nearby[place] = place.evidence.nearby(place.matrix, self.near)
        return self._nearby[place]

    def _scored(self, place: Place) -> Place:
        """Return a place with its lead over the other places met, less the log10 number of places tried."""
        most = max(self._nearby.get(place, 0.0), self._most_elsewhere(place), 0.0)
        scored = place.but(score=place.log10_likelihood - most - math.log10(max(self.ledger.tried.total(), 1)))
        if place in self._nearby:
            self._nearby[scored] = self._nearby[place]
        return scored

    def _most_elsewhere(self, place: Place) -> float:
        """Return the log10 likelihood of the best other verified place."""
        likely = sorted(self.verified, key=lambda other: -other.log10_likelihood)
        return next((other.log10_likelihood for other in likely if not other.same(place)), 0.0)

    def _look_through_lens(self, place: Place) -> Place:
        """Return a promising place with a lens, if the lens explains it better."""
        index, refined, forward = self.index, place.refined, place.agreement.forward
        if not self.options.lens or refined is None:
            return place
        if any(share > forward - NOTICEABLE and other.same(place) for other, share in self._fitted):
            return place
        self._fitted.append((place, forward))
        lens = find_lens(refined.matrix, self.scene, index, self.refine_options)
        if lens is None and forward < ENOUGH:
            lens = grow_whole(refined.matrix, self.scene, index, self.refine_options)
        if lens is None or not self.may_be(lens.matrix):
            return place
        scene = straighten_scene(self.scene, lens.lens_k1) if lens.lens_k1 else self.scene
        bent = self._weigh(place.at(lens, scene))
        return bent if bent.score >= place.score and bent.agreement.forward >= forward else place

    def _converge(self, place: Place, n_points: int | None, least: float) -> tuple[Place, bool]:
        """Refine until the agreement stops growing: more matches make a better fit, which finds more matches.

        A place less likely than `least` is not refined again. Also returns whether it converged.
        """
        before, best = -1.0 if place.refined is None else place.agreement.forward, -1.0
        options = self.refinement(place)
        for _ in range(5):
            args = place.matrix, place.scene, place.index, place.matched
            refined = refine(*args, options, n_points, held=place.by_roads)
            n_all = len(place.scene.dense_points)
            self._fitted_s += _STEP_S + _FITTED_POINT_S * min(n_points or n_all, n_all)
            fault = None if refined is None else self.judge(refined.matrix)
            if refined is None or fault is not None or self._is_far(refined.matrix):
                return (place, True) if best >= 0.0 else (place.but(fault=fault, score=-math.inf), False)
            fit = place.at(refined)
            agreeing = fit.agreement.forward
            if agreeing < best:
                break
            place = fit
            if agreeing <= max(before, best) + 0.01 or fit.log10_likelihood < least:
                break
            best = agreeing
        return place, True

    def refinement(self, place: Place) -> RefineOptions:
        """Return the options for refining a place: false roads abound where places grow by roads."""
        usual = self.refine_options
        return replace(usual, least_share=LEAST_SHARE) if place.by_roads and self.options.roads else usual

    def judge(self, matrix: FloatArray, rough: bool = False) -> CameraFault | None:
        """Return why a homography is not plausible for the camera, or None if it is."""
        return judge(matrix, self.scene.size, self.options.camera, rough)

    def may_be(self, matrix: FloatArray) -> bool:
        """Return whether a homography is plausible for the camera, and agrees with the user's hints on the place."""
        return self.judge(matrix) is None and not self._is_far(matrix)

    def _is_far(self, matrix: FloatArray) -> bool:
        """Return whether the middle of the frame lies outside the user's circle or box."""
        if self.near is None and self.options.within is None:
            return False
        middle, plane, within = Homography(matrix).everywhere(self.scene.center), self.index.plane, self.options.within
        if self.near is not None and np.hypot(*(middle - self.near[:2])) > self.near[2]:
            return True
        return within is not None and not lies_in(within, *to_lonlat(plane.crs, plane.to_crs(middle[None]))[0])

    def _fits_whole(self, place: Place) -> bool:
        """Return whether a place fits the whole frame: no better variant of it is expected."""
        if place.refined is None or not math.isfinite(place.score):
            return False
        frame_m = 2.0 * self.scene.half_size * place.gsd_m
        return place.agreement.forward >= 0.65 and bool(place.refined.corner_sigma_m.max() <= 0.005 * frame_m)


def map_scene(place: Place) -> Scene:
    """Return the map's intersections in a place's frame as a scene in metres, with the query's roads there.

    `Intersections.node` numbers the map's intersections.
    """
    scene, index, to_map = place.scene, place.index, Homography(place.matrix)
    at, (width, height) = to_map.inverse()(index.xy), scene.size
    with np.errstate(invalid="ignore"):
        inside = ((at >= (0.0, -height)) & (at <= (width, 0.0))).all(axis=1)
    ids = np.flatnonzero(inside)
    rays, tangents = unpack_branches(index.branches[ids]), unpack_tangents(index.tangents[ids])
    points = to_map(scene.points)
    directions = to_map(scene.points + scene.directions) - points
    return replace(
        scene,
        size=(round(width * place.gsd_m), round(height * place.gsd_m)),
        intersections=Intersections(index.xy[ids], rays, tangents, np.zeros(len(ids), np.float32), ids),
        branches=index.branches[ids],
        neighbours=query_neighbours(index.xy[ids], N_NEIGHBOURS),
        points=points,
        directions=directions / np.hypot(*directions.T)[:, None],
    )
