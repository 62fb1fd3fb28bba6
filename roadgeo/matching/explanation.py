"""Why a mask was or was not located: how far the search got, the best rejected places, and the missing evidence.

`Explanation.to_dict` gives schema `roadgeo.explanation/1`, which `outputs/schemas` describes.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import islice
from typing import Any

import numpy as np

from roadgeo import __version__
from roadgeo._arrays import BoolArray, FloatArray
from roadgeo.geometry.camera import CameraFault, CameraOptions, CameraPose, pose
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.projection import to_lonlat
from roadgeo.kernels.roads import road_residuals
from roadgeo.location import Location, Place
from roadgeo.matching.estimator import TripleEstimator
from roadgeo.matching.events import Events, Scored
from roadgeo.matching.evidence import agreement, tolerance_m
from roadgeo.matching.growing import Hypothesis
from roadgeo.matching.methods import Found
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.scene import MIN_COS, Query, Scene
from roadgeo.matching.search import Search
from roadgeo.matching.truth import TruthStory, finite_or_none, tell_truth, true_place
from roadgeo.matching.verdict import center_of, decide
from roadgeo.roads.graph import RoadGraph

__all__ = ["SCHEMA", "Explanation", "Funnel", "RejectedPlace", "Story", "tell"]

SCHEMA = "roadgeo.explanation/1"

#: Most places that are shown, and most refused places that are verified without limits.
_MAX_PLACES = 6
#: Masks with fewer intersections are seldom located.
_USUAL_INTERSECTIONS = 6
#: Most refused places that are compared, and most barred proposals of an anchor that are grown.
_MAX_REFUSED, _MAX_ELSEWHERE = 200, 20
#: Limits that a user may have set too narrow; other faults hold for every camera.
_NEGOTIABLE = (CameraFault.SAMPLING, CameraFault.SKEW, CameraFault.TILT, CameraFault.HEADING)
#: Messages for stages without a result.
_NOTHING = {
    "anchors": "no intersection has three neighbours and tangents that make usable tuples",
    "tuples": "no intersection has three neighbours and tangents that make usable tuples",
    "candidates": "no tuple of the mask's intersections is like one of the map's",
    "proposals": "nowhere on the map do two tuples that share an intersection agree",
    "on_roads": "wherever tuples agree, the roads around them do not",
    "survived": "whatever was followed outwards met too few intersections where they should be",
}


@dataclass(frozen=True)
class Funnel:
    """The output of each stage, in order."""

    intersections: int = 0
    anchors: int = 0  # intersections tried
    tuples: int = 0  # of the mask, looked up
    candidates: int = 0  # tuples of the map like them
    proposals: int = 0  # places on which several agree
    on_roads: int = 0  # proposals that put the roads around the anchor on roads
    grown: int = 0  # followed outwards
    survived: int = 0  # not given up on the way
    verified: int = 0  # different ones, refined and compared with the map
    measured: int = 0  # likely ones that were compared with all places nearby


@dataclass(frozen=True)
class RejectedPlace:
    """A verified place, and `why` it is not the answer; the answer itself comes first, and its `why` states that.

    Attributes
    ----------
    scored : Scored
        The hypothesis, its odds, and the camera's objection if that ended it.
    footprint, footprint_lonlat : (4, 2) float64
        Corners TL, TR, BR, BL, plane metres and longitude, latitude.
    agrees : (S,) bool
        Which of the scene's road points lie on roads of the map that run their way.
    nearby : float
        Log10 likelihood of the best place nearby; 0 if nothing could be compared.
    """

    scored: Scored
    camera: CameraPose
    center: Place
    footprint: FloatArray
    footprint_lonlat: FloatArray
    agrees: BoolArray
    nearby: float
    why: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for `json.dumps`."""
        model, center, camera = self.scored.model, self.center, self.camera
        found = model.found
        return {
            "why": self.why,
            "log10_odds": finite_or_none(self.scored.log10_odds),
            "center": {"x": center.x, "y": center.y, "lon": center.lon, "lat": center.lat},
            "footprint_lonlat": self.footprint_lonlat.tolist(),
            "gsd_m": camera.gsd_m,
            "rotation_deg": camera.rotation_deg,
            "tilt_deg": camera.tilt_deg,
            "agreement": found
            and {
                "intersections": found.rate,
                "intersections_matched": found.matched,
                "intersections_tested": found.tested,
                "roads_of_mask": found.forward,
                "roads_of_map": found.backward,
            },
            "log10_likelihood": finite_or_none(model.log10_likelihood),
            "nearby": self.nearby,
        }


@dataclass(frozen=True)
class Story:
    """The course of the search on a reference.

    Attributes
    ----------
    stopped : str
        As in `Search`; "elsewhere": a place on another reference ended it, "": there was nothing to search for.
    needed : dict
        The log10 odds and the margin that an answer needs.
    camera_refusals : dict
        The number of times each reason kept a grown place from being verified.
    starved_at : str or None
        The first stage without a result, "camera", "odds" or "margin"; None if the mask was located.
    """

    reference: str
    stopped: str
    needed: dict[str, float]
    funnel: Funnel
    camera_refusals: dict[str, int]
    starved_at: str | None
    missing: tuple[str, ...]
    places: tuple[RejectedPlace, ...] = ()
    truth: TruthStory | None = None

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for `json.dumps`."""
        plain = ("reference", "stopped", "needed", "camera_refusals", "starved_at")
        return {
            **{name: getattr(self, name) for name in plain},
            "funnel": asdict(self.funnel),
            "missing": list(self.missing),
            "places": [place.to_dict() for place in self.places],
            "truth": self.truth and asdict(self.truth),
        }


@dataclass(frozen=True)
class Explanation:
    """A location and its derivation: the roads seen in the mask, and a story for each reference."""

    location: Location
    scene: Scene
    graph: RoadGraph
    stories: tuple[Story, ...]

    def __repr__(self) -> str:
        """Describe the answer in one line."""
        return f"<Explanation of {self.location!r}, on {len(self.stories)} references>"

    @property
    def nearest(self) -> Story:
        """The story of the reference on which the mask was located, or came nearest to it."""

        def rank(story: Story) -> tuple[bool, float]:
            best = max((place.scored.log10_odds for place in story.places), default=-math.inf)
            return self.location.located and story.reference == self.location.reference, best

        return max(self.stories, key=rank)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for `json.dumps`."""
        location, scene = self.location, self.scene
        return {
            "schema": SCHEMA,
            "version": __version__,
            **{name: getattr(location, name) for name in ("query", "status", "reason", "options")},
            "reason_code": location.reason_code.value,
            "reference_digest": location.reference_digest or None,
            "command": location.command or None,
            "seen": {
                "size": list(scene.size),
                "intersections": len(scene.intersections),
                "with_two_tangents": int((scene.intersections.n_tangents >= 2).sum()),
                "roads": scene.n_edges,
                "road_length_px": scene.road_length_px,
                "observed": float(scene.observed.mean()),
            },
            "searches": [story.to_dict() for story in self.stories],
        }


def tell(query: Query, found: Found, options: LocateOptions) -> Story:
    """Describe the search on one reference."""
    location = decide(query, [found], options)  # its answer on that reference alone
    needed = {"log10_odds": options.min_log10_odds, "margin": options.min_margin}
    n, name, located, events = len(query.scene.intersections), found.index.name, location.located, found.events
    search, result, stats = events.estimator, events.result, found.stats
    if search is None or result is None:  # there was nothing to search for, or another method searched
        ended = "intersections" if n == 0 else "verified" if stats.tuples_sampled else "anchors"
        funnel = Funnel(n, stats.tuples_sampled, 0, stats.candidates, 0, 0, stats.hypotheses, 0, stats.verified)
        missing: tuple[str, ...] = () if located else (location.reason,)
        story = Story(name, "", needed, funnel, {}, None if located else ended, missing)
    else:
        course = _Course(events, search, result, location, options)
        counts = {fault.value: times for fault, times in course.refusals.most_common()}
        starved, missing = (None, ()) if located else (course.starved, tuple(course.missing()))
        story = Story(name, result.stopped, needed, course.funnel, counts, starved, missing, course.places)
    truth = true_place(query.name, options)
    if truth is None:
        return story
    fate = tell_truth(truth, events, location, options)
    return replace(story, truth=fate, missing=story.missing if fate.lost_at is None else (fate.said, *story.missing))


class _Course:
    """The course of a search: its events, counted and described."""

    def __init__(
        self,
        events: Events,
        search: TripleEstimator,
        result: Search[Hypothesis],
        location: Location,
        options: LocateOptions,
    ) -> None:
        self.events, self.search, self.result = events, search, result
        self.location, self.needed, self.margin = location, options.min_log10_odds, options.min_margin
        self.funnel = self._count()  # before further places are compared, to be shown
        self._look_elsewhere()
        scored = events.of("scored")
        self.refusals = Counter(
            [fault for fault, _ in events.of("refused")] + [entry.fault for entry in scored if entry.fault]
        )
        entries = [*scored, *([] if location.located else self._without_limits())]
        self.places = tuple(map(self._describe, self._distinct(sorted(entries, key=self._rank))))

    def _look_elsewhere(self) -> None:
        """Grow some proposals that the hints bar, to report that they would fit."""
        for proposals, allowed, _ in self.events.of("screened"):
            barred = proposals.only(np.flatnonzero(~allowed)[:_MAX_ELSEWHERE])
            for hypothesis in self.search.grow(barred, np.arange(len(barred.reference)))[:_MAX_PLACES]:
                fault = self.search.judge(hypothesis.matrix, rough=True)
                if fault is not None:
                    self.events.note("refused", fault, hypothesis.matrix)

    def _without_limits(self) -> list[Scored]:
        """Verify the best places that the camera's limits refused, without these limits."""
        scene, index, options = self.search.scene, self.search.index, self.search.options
        camera = CameraOptions(gsd_m=(0.0, math.inf), max_tilt_deg=180.0, max_skew=math.inf)
        free = TripleEstimator(scene, index, replace(options, camera=camera), ledger=self.search.ledger)
        compared = []
        negotiable = (refusal for refusal in self.events.of("refused") if refusal[0] in _NEGOTIABLE)
        for fault, unscaled in islice(negotiable, _MAX_REFUSED):
            matrix = unscaled / unscaled[2, 2]
            found, matched, _ = agreement(matrix, scene, index)
            compared.append((found.rate + found.forward, fault, Hypothesis(matrix, 0.0, matched)))
        compared.sort(key=lambda entry: -entry[0])
        return [Scored(model, free.score(model), fault) for _, fault, model in compared[:_MAX_PLACES]]

    def _rank(self, entry: Scored) -> tuple[bool, float]:
        """Sort by score; refused places come last, unless the camera's limits alone kept them from being the answer."""
        return entry.fault is not None and entry.log10_odds < self.needed, -entry.log10_odds

    def _distinct(self, entries: Sequence[Scored]) -> list[Scored]:
        """Return the best entry of each place."""
        kept: list[Scored] = []
        for entry in entries:
            if len(kept) == _MAX_PLACES or (kept and not math.isfinite(entry.log10_odds)):
                break
            if not any(self.search.same(entry.model, other.model) for other in kept):
                kept.append(entry)
        return kept

    def _count(self) -> Funnel:
        """Count the results of each stage of the search."""
        search, events = self.search, self.events
        screened, voted = events.of("screened"), events.of("voted")
        proposed = sum(count for _, count in voted)  # all of them lie on roads
        return Funnel(
            len(search.scene.intersections),
            len({proposals.anchor for proposals, *_ in screened} | {anchor for anchor, _ in voted}),
            search.n_tuples,
            search.n_candidates,
            proposed + sum(len(proposals.reference) for proposals, *_ in screened),
            proposed + sum(len(kept) for *_, kept in screened),
            search.n_hypotheses,
            sum(map(len, events.of("grown"))),
            search.n_verified,
            search.n_nulls,
        )

    def _describe(self, entry: Scored) -> RejectedPlace:
        """Describe a place that was verified."""
        matrix, index = entry.model.matrix, self.search.index
        scene = self.search.scene_of(entry.model)
        camera = pose(matrix, scene.size)
        # which of the query's road points agree
        away, near = np.empty((len(scene.points), 3)), np.full(len(scene.points), tolerance_m(camera.gsd_m))
        road_residuals(matrix, scene.points, scene.directions, near, MIN_COS, index.road_buckets, away)
        ground = Homography(matrix).everywhere(scene.corners)
        lonlat = to_lonlat(index.plane.crs, index.plane.to_crs(ground))
        center = center_of(matrix, scene, index.plane, entry.log10_odds)
        nearby = 0.0 if entry.model.found is None else self.search.nearby(entry.model)
        place = RejectedPlace(entry, camera, center, ground, lonlat, np.isfinite(away[:, 0]), nearby)
        return replace(place, why=self._why(place))

    def _why(self, place: RejectedPlace) -> str:
        """Return why a place is not the answer."""
        entry = place.scored
        if entry.fault is not None:
            return f"the camera: {_objection(place)}"
        if not math.isfinite(entry.log10_odds):
            return "the fit does not converge to a place within the limits"
        if entry.model is self.result.best and self.location.located:
            return "located"
        if entry.log10_odds >= self.needed:
            if self.result.score - entry.log10_odds < self.margin:
                return f"fits as well as another place: the margin is below {self.margin:g}"
            return f"another place has log10 odds {_number(self.result.score)}"
        return f"log10 odds {_number(entry.log10_odds)} of {self.needed:g} needed: {_weakest(place)}"

    @property
    def starved(self) -> str:
        """The first stage without a result."""
        stages = ("intersections", "anchors", "tuples", "candidates", "proposals", "on_roads", "survived", "verified")
        empty = next((stage for stage in stages if getattr(self.funnel, stage) == 0), None)
        if empty is None:
            return "odds" if self.result.score < self.needed else "margin"
        return "camera" if empty == "verified" and self.refusals else empty

    def missing(self) -> list[str]:
        """List the missing evidence, the surest first."""
        lines, n, starved = [], self.funnel.intersections, self.starved
        if self.result.stopped in ("time", "work"):
            lines.append(f"{self.result.stopped}: the search was stopped by its limit, places may be left untried")
        if starved in _NOTHING:
            lines.append(_NOTHING[starved])
        if starved == "camera":
            reasons = ", ".join(f"{fault.value} ({times})" for fault, times in self.refusals.most_common())
            lines.append(f"a camera: all places that grew are such as none sees, or none within the limits: {reasons}")
        best = self.places[0] if self.places else None
        if best is not None and best.scored.fault is not None and best.scored.log10_odds >= self.needed:
            objection = _objection(best)
            lines.append(f"the limits on the camera may be too narrow: the best place fails by them alone: {objection}")
        elif best is not None and starved == "odds":
            lines.append(f"evidence: at the best place {_weakest(best)}")
        if starved == "margin":
            lines.append(
                "difference: another place fits almost as well; more of the surroundings in view would tell them apart"
            )
        if n < _USUAL_INTERSECTIONS:
            few = f"masks with fewer than {_USUAL_INTERSECTIONS} are seldom located"
            lines.append(f"intersections: {n} are seen; {few}")
        if best is not None and best.nearby > 0.5 * best.scored.model.log10_likelihood > 0.0:
            lines.append("variety: streets here are so alike that a shifted copy explains half as much and more")
        if self.search.near is not None and not self.places:
            lines.append("perhaps the circle given is wrong: nothing outside it was tried")
        return lines or ["agreement: nothing on this map is like the mask; another map may be needed"]


def _number(value: float) -> str:
    """Write a number to one digit, and never -0.0."""
    return f"{round(value, 1) + 0.0:.1f}"


def _objection(place: RejectedPlace) -> str:
    """Return the camera's objection to a place, and its odds otherwise."""
    fault, odds, camera = place.scored.fault, place.scored.log10_odds, place.camera
    values = {
        CameraFault.SAMPLING: f" ({camera.gsd_m:.2f} m per pixel)",
        CameraFault.TILT: f" ({camera.tilt_deg:.0f} degrees)",
        CameraFault.HEADING: f" (up is {camera.rotation_deg % 360:.0f} degrees)",
    }
    otherwise = f"; without that its log10 odds were {_number(odds)}" if math.isfinite(odds) else ""
    return "" if fault is None else f"{fault.value}{values.get(fault, '')}{otherwise}"


def _weakest(place: RejectedPlace) -> str:
    """Compare a place with the best one nearby."""
    model = place.scored.model
    if model.found is None:
        return "nothing could be compared"
    return f"its roads explain 10^{_number(model.log10_likelihood)}, those of a place nearby 10^{_number(place.nearby)}"
