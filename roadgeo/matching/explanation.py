"""Why a mask was or was not located: how far the search got, the best rejected places, and the missing evidence.

`Explanation.to_dict` gives schema `roadgeo.explanation/2`, which `outputs/schemas` describes.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import islice
from typing import Any

import numpy as np

from roadgeo._version import __version__
from roadgeo.geometry.camera import CameraFault, CameraOptions
from roadgeo.geometry.projection import to_lonlat
from roadgeo.location import Location
from roadgeo.matching.estimator import TripleEstimator
from roadgeo.matching.growing import SharedSweeps
from roadgeo.matching.methods import N_PLACES, Searched, less_than
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.place import Place
from roadgeo.matching.rivals import N_LIKELIEST, Rivals
from roadgeo.matching.scene import Query, Scene
from roadgeo.matching.search import Search
from roadgeo.matching.truth import TruthStory, finite_or_none, tell_truth, true_place
from roadgeo.matching.verdict import decide
from roadgeo.roads.graph import RoadGraph

__all__ = ["SCHEMA", "Explanation", "Funnel", "Story", "Told", "tell"]

SCHEMA = "roadgeo.explanation/2"

#: Masks with fewer intersections are seldom located.
_USUAL_INTERSECTIONS = 6
#: Most refused places that are compared.
_MAX_REFUSED = 200
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

    intersections: int
    anchors: int  # intersections tried
    tuples: int  # of the mask, looked up
    candidates: int  # tuples of the map like them
    proposals: int  # places on which several agree
    on_roads: int  # proposals that put the roads around the anchor on roads
    grown: int  # followed outwards
    survived: int  # not given up on the way
    verified: int  # different ones, refined and compared with the map
    measured: int  # likely ones that were compared with all places nearby


@dataclass(frozen=True)
class Told:
    """A place that was met, and `why` it is not the answer; of the answer itself, which comes first, that it is.

    Attributes
    ----------
    nearby : float
        Log10 likelihood of the best place nearby; 0 if nothing could be compared.
    """

    place: Place
    nearby: float
    why: str

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for `json.dumps`."""
        place, plane = self.place, self.place.index.plane
        camera, agreement = place.view, place.agreement
        x, y = plane.to_crs(place.center).tolist()
        lon, lat = place.lonlat.tolist()
        matched = int((place.matches[0] >= 0).sum())
        return {
            "why": self.why,
            "log10_odds": finite_or_none(place.score),
            "center": {"x": x, "y": y, "lon": lon, "lat": lat},
            "footprint_lonlat": to_lonlat(plane.crs, plane.to_crs(place.corners)).tolist(),
            "gsd_m": camera.gsd_m,
            "rotation_deg": camera.rotation_deg,
            "tilt_deg": camera.tilt_deg,
            "agreement": None
            if place.refined is None
            else {
                "intersections": matched / max(len(place.scene.intersections), 1),
                "intersections_matched": matched,
                "intersections_tested": len(place.scene.intersections),
                "roads_of_mask": agreement.forward,
                "roads_of_map": agreement.backward,
            },
            "log10_likelihood": finite_or_none(agreement.log10_likelihood),
            "nearby": self.nearby,
        }


@dataclass(frozen=True)
class Story:
    """The course of the search on a reference.

    Attributes
    ----------
    stopped : str
        As in `Search`; "elsewhere": a place on another reference ended it, "": there was nothing to search for.
    needed : float
        The score that an answer needs.
    camera_refusals : dict
        The number of times each reason kept a grown place from being verified.
    starved_at : str or None
        The first stage without a result, "camera" or "odds"; None if the mask was located.
    """

    reference: str
    stopped: str
    needed: float
    funnel: Funnel
    camera_refusals: dict[str, int]
    starved_at: str | None
    missing: tuple[str, ...]
    places: tuple[Told, ...] = ()
    truth: TruthStory | None = None

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for `json.dumps`."""
        plain = ("reference", "stopped", "camera_refusals", "starved_at")
        return {
            **{name: getattr(self, name) for name in plain},
            "needed": {"log10_odds": self.needed},
            "funnel": asdict(self.funnel),
            "missing": list(self.missing),
            "places": [listed.to_dict() for listed in self.places],
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
            best = max((listed.place.score for listed in story.places), default=-math.inf)
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


def tell(query: Query, searched: Searched, options: LocateOptions) -> Story:
    """Describe the search on one reference."""
    location = decide(query, [searched], options)  # its answer on that reference alone
    n, name, stats = len(query.scene.intersections), searched.index.name, searched.stats
    located, needed = location.located, options.min_log10_odds
    if searched.estimator is None or searched.search is None:  # nothing to search for, or another method searched
        ended = "intersections" if n == 0 else "verified" if stats.tuples_sampled else "anchors"
        funnel = Funnel(n, stats.tuples_sampled, 0, stats.candidates, 0, 0, stats.hypotheses, 0, stats.verified, 0)
        missing: tuple[str, ...] = () if located else (location.reason,)
        story = Story(name, "", needed, funnel, {}, None if located else ended, missing)
    else:
        course = _Course(searched, searched.estimator, searched.search, location, needed)
        counts = {fault.value: times for fault, times in course.refusals.most_common()}
        starved, missing = (None, ()) if located else (course.starved, tuple(course.missing()))
        story = Story(name, searched.stopped, needed, course.funnel, counts, starved, missing, course.places)
    truth = true_place(query.name, options)
    if truth is None:
        return story
    fate = tell_truth(truth, searched, location, options)
    return replace(story, truth=fate, missing=story.missing if fate.lost_at is None else (fate.said, *story.missing))


class _Course:
    """The course of a search: its events, counted and described."""

    def __init__(
        self, searched: Searched, estimator: TripleEstimator, search: Search[Place], location: Location, needed: float
    ) -> None:
        self.searched, self.estimator, self.search = searched, estimator, search
        self.events, self.location, self.needed = searched.events, location, needed
        self.funnel = self._count()  # before further places are compared, to be shown
        self._look_elsewhere()
        settled = self.events.of("settled")
        self.refusals = Counter(
            [fault for fault, _ in self.events.of("refused")] + [place.fault for place in settled if place.fault]
        )
        listed = [*searched.compared, *searched.places[1:]]
        met = (place for place in settled if not any(place.same(other) for other in listed))
        others = [less_than(listed[0], place) if listed else place for place in met]
        entries = [*listed, *others, *([] if location.located else self._without_limits())]
        self.places = tuple(map(self._tell, self._distinct(sorted(entries, key=self._rank))))

    def _look_elsewhere(self) -> None:
        """Grow some proposals that the hints bar, to report that they would fit."""
        for proposals, allowed, _ in self.events.of("screened"):
            barred = proposals.only(np.flatnonzero(~allowed)[:N_LIKELIEST])
            for place in self.estimator.grow(barred, np.arange(len(barred.reference)))[:N_PLACES]:
                fault = self.estimator.judge(place.matrix, rough=True)
                if fault is not None:
                    self.events.note("refused", fault, place.matrix)

    def _without_limits(self) -> list[Place]:
        """Verify the best places that the camera's limits refused without these limits, and score them."""
        scene, index, options = self.estimator.scene, self.estimator.index, self.estimator.options
        camera = CameraOptions(gsd_m=(0.0, math.inf), max_tilt_deg=180.0, max_skew=math.inf)
        sweeps = SharedSweeps(scene, camera)
        free = TripleEstimator(sweeps, index, replace(options, camera=camera), ledger=self.estimator.ledger)
        refusals = (refusal for refusal in self.events.of("refused") if refusal[0] in _NEGOTIABLE)
        refused = [
            (fault, Place(scene, index, matrix / matrix[2, 2], by_roads=False))
            for fault, matrix in islice(refusals, _MAX_REFUSED)
        ]
        refused.sort(key=lambda pair: -(pair[1].rate + pair[1].agreement.forward))
        settled = [(fault, free.settle(place)[0]) for fault, place in refused[:N_PLACES]]
        search: Search[Place] = Search(free)
        best = Rivals({search: free}, self.estimator.ledger, self.needed).compare(search)
        if best is None:
            return [place.but(fault=fault) for fault, place in settled]
        return [(best if best.same(place) else less_than(best, place)).but(fault=fault) for fault, place in settled]

    def _rank(self, place: Place) -> tuple[bool, float]:
        """Sort by score; refused places come last, unless the camera's limits alone kept them from being the answer."""
        return place.fault in _NEGOTIABLE and place.score < self.needed, -place.score

    def _distinct(self, places: Sequence[Place]) -> list[Place]:
        """Return the best entry of each place."""
        kept: list[Place] = []
        for place in places:
            if len(kept) == N_PLACES or (kept and not math.isfinite(place.score)):
                break
            if not any(place.same(other) for other in kept):
                kept.append(place)
        return kept

    def _count(self) -> Funnel:
        """Count the results of each stage of the search."""
        search, events = self.estimator, self.events
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

    def _tell(self, place: Place) -> Told:
        """Describe a place that was verified."""
        nearby = 0.0 if place.refined is None else self.estimator.nearby(place)
        return Told(place, nearby, self._why(place, nearby))

    def _why(self, place: Place, nearby: float) -> str:
        """Return why a place is not the answer."""
        if _fits_mirrored(place):
            return "its roads fit better mirrored"
        if place.fault is not None:
            return f"the camera: {_objection(place)}"
        if not math.isfinite(place.score):
            return "the fit does not converge to a place within the limits"
        if place.score >= self.needed:
            return "located" if self.location.located else self.location.reason
        return f"score {_number(place.score)}, {self.needed:g} is needed: {_weakest(place, nearby)}"

    @property
    def starved(self) -> str:
        """The first stage without a result."""
        stages = ("intersections", "anchors", "tuples", "candidates", "proposals", "on_roads", "survived", "verified")
        empty = next((stage for stage in stages if getattr(self.funnel, stage) == 0), None)
        if empty is None:
            return "odds"
        return "camera" if empty == "verified" and self.refusals else empty

    def missing(self) -> list[str]:
        """List the missing evidence, the surest first."""
        lines, n, starved = [], self.funnel.intersections, self.starved
        if self.searched.stopped in ("time", "work"):
            lines.append(f"{self.searched.stopped}: the search was stopped by its limit, places may be left untried")
        if starved in _NOTHING:
            lines.append(_NOTHING[starved])
        if starved == "camera":
            reasons = ", ".join(f"{fault.value} ({times})" for fault, times in self.refusals.most_common())
            lines.append(f"a camera: all places that grew are such as none sees, or none within the limits: {reasons}")
        best = self.places[0] if self.places else None
        if best is not None and best.place.fault is not None and best.place.score >= self.needed:
            objection = _objection(best.place)
            lines.append(f"the limits on the camera may be too narrow: the best place fails by them alone: {objection}")
        elif best is not None and _fits_mirrored(best.place):
            lines.append("the right side: at the best place the roads fit better with the image mirrored")
        elif best is not None and starved == "odds":
            lines.append(f"evidence: at the best place {_weakest(best.place, best.nearby)}")
        if starved == "odds" and self.searched.places and self.searched.places[0].rival is not None:
            lines.append(
                "difference: another place fits almost as well; more of the surroundings in view would tell them apart"
            )
        if n < _USUAL_INTERSECTIONS:
            few = f"masks with fewer than {_USUAL_INTERSECTIONS} are seldom located"
            lines.append(f"intersections: {n} are seen; {few}")
        if best is not None and best.nearby > 0.5 * best.place.agreement.log10_likelihood > 0.0:
            lines.append("variety: streets here are so alike that a shifted copy explains half as much and more")
        if self.estimator.near is not None and not self.places:
            lines.append("perhaps the circle given is wrong: nothing outside it was tried")
        return lines or ["agreement: nothing on this map is like the mask; another map may be needed"]


def _fits_mirrored(place: Place) -> bool:
    """Return whether the mirrored query fits better where a place was found (see `rivals.mirrored_likelihood`)."""
    return place.fault is CameraFault.MIRRORED and math.isfinite(place.score)


def _number(value: float) -> str:
    """Write a number to one digit, and never -0.0."""
    return f"{round(value, 1) + 0.0:.1f}"


def _objection(place: Place) -> str:
    """Return the camera's objection to a place, and its score otherwise."""
    camera = place.view
    values = {
        CameraFault.SAMPLING: f" ({camera.gsd_m:.2f} m per pixel)",
        CameraFault.TILT: f" ({camera.tilt_deg:.0f} degrees)",
        CameraFault.HEADING: f" (up is {camera.rotation_deg % 360:.0f} degrees)",
    }
    otherwise = f"; without that its score were {_number(place.score)}" if math.isfinite(place.score) else ""
    return "" if place.fault is None else f"{place.fault.value}{values.get(place.fault, '')}{otherwise}"


def _weakest(place: Place, nearby: float) -> str:
    """Compare a place with the best one nearby."""
    if place.refined is None:
        return "nothing could be compared"
    explained = place.agreement.log10_likelihood
    return f"its roads explain 10^{_number(explained)}, those of a place nearby 10^{_number(nearby)}"
