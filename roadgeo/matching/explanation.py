"""Why a mask was or was not located: how far the search got, the best rejected places, and the missing evidence.

`Explanation.to_dict` gives schema `roadgeo.explanation/1`:

============  ==========================================================================================================
query         as in `Location`, and so are `status`, `reason`, `reason_code`, `version`, `options`, `command` and
              `reference_digest`
seen          `intersections` (of very many, those nearest to the middle), how many of them have two
              tangents or more, `roads`, their length and the frame's size in pixels, the share of it that was observed
searches      one for each reference, in the order in which they were searched:

              `reference`, `stopped` ("accepted", "exhausted", "work" or "time", "elsewhere": a place on another
              reference ended the search, or "" where there was nothing to search for), `needed` (the least log10 odds
              and margin)

              `funnel`, input and output of each stage: `anchors` (intersections tried), `tuples` of the
              mask looked up, `candidates` (tuples of the map like them), `proposals` (places on which several agree),
              `on_roads` (those that put the roads around the anchor on roads), `grown` (followed outwards), `survived`
              (not given up on the way), `verified` (different ones, refined and compared with the map), `measured`
              (likely ones that were compared with all places nearby)

              `camera_refusals`: how often which reason kept a place that had grown from being verified

              `starved_at`: the first stage that nothing came out of, "odds" or "margin"; null where it was located

              `missing`: sentences

              `truth`: the fate of the true place, where it was given; see `truth.TruthStory`

              `places`: the best ones, best first; see `RejectedPlace`
============  ==========================================================================================================
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from roadgeo import __version__
from roadgeo._arrays import BoolArray, FloatArray
from roadgeo.geometry.camera import CameraFault, CameraOptions, pose, sampling
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.projection import to_lonlat
from roadgeo.kernels.roads import road_residuals
from roadgeo.location import Location, Place
from roadgeo.matching.estimator import TripleEstimator
from roadgeo.matching.events import Events, Scored
from roadgeo.matching.evidence import Agreement, agreement, tolerance_m
from roadgeo.matching.growing import Hypothesis
from roadgeo.matching.methods import Found
from roadgeo.matching.scene import MIN_COS, Query, Scene
from roadgeo.matching.search import Search
from roadgeo.matching.truth import TruthStory, tell_truth
from roadgeo.matching.verdict import Needed
from roadgeo.roads.graph import RoadGraph

__all__ = ["SCHEMA", "Explanation", "Funnel", "RejectedPlace", "Story", "tell"]

SCHEMA = "roadgeo.explanation/1"

#: Places that are shown.
_MAX_PLACES = 6

#: Masks with fewer intersections are seldom located.
_USUAL_INTERSECTIONS = 6

#: Places that a camera refused which are looked at again, and how many of those are kept.
_MAX_RETRIED, _MAX_REFUSED, _MAX_ELSEWHERE = 6, 200, 20

#: Limits that a user may have set too narrow; other faults hold for every camera.
_NEGOTIABLE = (CameraFault.SAMPLING, CameraFault.SKEW, CameraFault.TILT, CameraFault.HEADING)


@dataclass(frozen=True)
class Funnel:
    """The output of each stage, in order; see the module's text."""

    intersections: int = 0
    anchors: int = 0
    tuples: int = 0
    candidates: int = 0
    proposals: int = 0
    on_roads: int = 0
    grown: int = 0
    survived: int = 0
    verified: int = 0
    measured: int = 0


@dataclass(frozen=True)
class RejectedPlace:
    """A place that was verified, and why it is not the answer; the answer itself is the first, with that as its `why`.

    Attributes
    ----------
    matrix : (3, 3) float64
        Query plane to reference plane.
    footprint, footprint_lonlat : (4, 2) float64
        Corners TL, TR, BR, BL, plane metres and longitude, latitude.
    agreement : Agreement or None
        None where the fit failed before anything could be compared.
    log10_likelihood, nearby : float
        Its likelihood, and that of the best place nearby (see `evidence`).
    agrees : (S,) bool
        Which of the scene's road points lie on roads of the map that run their way.
    fault : CameraFault or None
        The camera's objection, if that ended it.
    """

    matrix: FloatArray
    center: Place
    footprint: FloatArray
    footprint_lonlat: FloatArray
    log10_odds: float
    gsd_m: float
    rotation_deg: float
    tilt_deg: float
    agreement: Agreement | None
    log10_likelihood: float
    nearby: float
    agrees: BoolArray
    why: str
    fault: CameraFault | None = None

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for `json.dumps`."""
        found = self.agreement
        return {
            "why": self.why,
            "log10_odds": self.log10_odds if math.isfinite(self.log10_odds) else None,
            "center": {"x": self.center.x, "y": self.center.y, "lon": self.center.lon, "lat": self.center.lat},
            "footprint_lonlat": self.footprint_lonlat.tolist(),
            "gsd_m": self.gsd_m,
            "rotation_deg": self.rotation_deg,
            "tilt_deg": self.tilt_deg,
            "agreement": found
            and {
                "intersections": found.rate,
                "intersections_matched": found.matched,
                "intersections_tested": found.tested,
                "roads_of_mask": found.forward,
                "roads_of_map": found.backward,
            },
            "log10_likelihood": self.log10_likelihood if math.isfinite(self.log10_likelihood) else None,
            "nearby": self.nearby,
        }


@dataclass(frozen=True)
class Story:
    """How the search on one reference went; see the module's text."""

    reference: str
    stopped: str
    needed: Needed
    funnel: Funnel
    camera_refusals: dict[str, int]
    starved_at: str | None
    missing: tuple[str, ...]
    places: tuple[RejectedPlace, ...] = ()
    truth: TruthStory | None = None

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for `json.dumps`."""
        return {
            "reference": self.reference,
            "stopped": self.stopped,
            "needed": asdict(self.needed),
            "funnel": asdict(self.funnel),
            "camera_refusals": self.camera_refusals,
            "starved_at": self.starved_at,
            "missing": list(self.missing),
            "places": [place.to_dict() for place in self.places],
            "truth": self.truth and self.truth.to_dict(),
        }


@dataclass(frozen=True)
class Explanation:
    """A location and how it came about: the roads seen in the mask, and a story for each reference."""

    location: Location
    scene: Scene
    graph: RoadGraph
    stories: tuple[Story, ...]

    def __repr__(self) -> str:
        """Describe the answer in one line."""
        return f"<Explanation of {self.location!r}, on {len(self.stories)} references>"

    @property
    def nearest(self) -> Story:
        """The story of the reference that the mask was located on, or else came nearest to it."""

        def rank(story: Story) -> tuple[bool, float]:
            best = max((place.log10_odds for place in story.places), default=-math.inf)
            return self.location.located and story.reference == self.location.reference, best

        return max(self.stories, key=rank)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for `json.dumps`; see the module's text."""
        location, scene = self.location, self.scene
        return {
            "schema": SCHEMA,
            "version": __version__,
            "query": location.query,
            "status": location.status,
            "reason": location.reason,
            "reason_code": location.reason_code.value,
            "reference_digest": location.reference_digest or None,
            "options": location.options,
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


def tell(
    query: Query, found: Found, location: Location, needed: Needed, truth: tuple[float, float] | None = None
) -> Story:
    """Describe the search on one reference; `location` is its answer on that reference alone.

    `truth` is longitude and latitude of the true place, where that is known.
    """
    n, name, located, events = len(query.scene.intersections), found.index.name, location.located, found.events
    search, result, stats = events.estimator, events.result, found.stats
    if search is None or result is None:  # there was nothing to search for, or another method searched
        ended = "intersections" if n < needed.intersections else "verified" if stats.tuples_sampled else "anchors"
        funnel = Funnel(n, stats.tuples_sampled, 0, stats.candidates, 0, 0, stats.hypotheses, 0, stats.verified)
        told = None if truth is None else tell_truth(truth, events, location, needed)
        missing = () if located else (location.reason,)
        return Story(name, "", needed, funnel, {}, None if located else ended, _with_truth(missing, told), truth=told)
    _look_elsewhere(events, search)
    screened, voted, scored = events.of("screened"), events.of("voted"), events.of("scored")
    proposed = sum(count for _, count in voted)  # all of them lie on roads
    funnel = Funnel(
        n,
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
    refusals = Counter([fault for fault, _ in events.of("refused")] + [one.fault for one in scored if one.fault])
    entries = [*scored, *([] if located else _without_limits(events, search))]
    ranked = _distinct(search, sorted(entries, key=lambda entry: _rank(entry, needed)))
    places = tuple(_describe(search, entry, result, location, needed) for entry in ranked)
    starved = None if located else _starved(funnel, refusals, result, needed)
    absent = () if located else tuple(_missing(funnel, refusals, search, result, places, needed))
    counts = {fault.value: times for fault, times in refusals.most_common()}
    told = None if truth is None else tell_truth(truth, events, location, needed)
    return Story(name, result.stopped, needed, funnel, counts, starved, _with_truth(absent, told), places, told)


def _with_truth(missing: tuple[str, ...], told: TruthStory | None) -> tuple[str, ...]:
    return missing if told is None or told.lost_at is None else (told.said, *missing)


def _look_elsewhere(events: Events, search: TripleEstimator) -> None:
    """Grow some proposals that point elsewhere than a camera may, to report that they would fit."""
    for proposals, allowed, _ in events.of("screened"):
        barred = proposals.only(np.flatnonzero(~allowed)[:_MAX_ELSEWHERE])
        for hypothesis in search.grow(barred, np.arange(len(barred.reference)))[:_MAX_RETRIED]:
            fault = search.judge(hypothesis.matrix, rough=True)
            if fault is not None:
                events.note("refused", fault, hypothesis.matrix)


def _without_limits(events: Events, search: TripleEstimator) -> list[Scored]:
    """Verify the best of the places that the camera refused as if it had not."""
    scene, index, options = search.scene, search.index, search.options
    camera = CameraOptions(gsd_m=(0.0, math.inf), max_tilt_deg=180.0, max_skew=math.inf)
    free = TripleEstimator(scene, index, replace(options, camera=camera), ledger=search.ledger)
    compared = []
    for fault, unscaled in [one for one in events.of("refused") if one[0] in _NEGOTIABLE][:_MAX_REFUSED]:
        matrix = unscaled / unscaled[2, 2]
        gsd = sampling(matrix, scene.size)
        found, matched, _ = agreement(matrix, scene, index, gsd)
        compared.append((found.rate + found.forward, fault, Hypothesis(matrix, 0.0, matched)))
    compared.sort(key=lambda entry: -entry[0])
    return [Scored(model, free.score(model), fault) for _, fault, model in compared[:_MAX_RETRIED]]


def _rank(entry: Scored, needed: Needed) -> tuple[bool, float]:
    """Sort by odds; places that the camera refused come last, unless nothing else kept them from being the answer."""
    return entry.fault is not None and entry.log10_odds < needed.log10_odds, -entry.log10_odds


def _distinct(search: TripleEstimator, entries: Sequence[Scored]) -> list[Scored]:
    """Return the best entry of each place."""
    kept: list[Scored] = []
    for entry in entries:
        if kept and not math.isfinite(entry.log10_odds):
            break
        if not any(search.same(entry.model, other.model) for other in kept):
            kept.append(entry)
        if len(kept) == _MAX_PLACES:
            break
    return kept


def _describe(
    search: TripleEstimator,
    entry: Scored,
    result: Search[Hypothesis],
    location: Location,
    needed: Needed,
) -> RejectedPlace:
    """Describe a place that was verified."""
    model, scene, index = entry.model, search.scene_of(entry.model), search.index
    camera = pose(model.matrix, scene.size)
    # where it lies
    ground = Homography(model.matrix).everywhere(np.vstack([scene.corners, scene.center]))
    in_crs = index.plane.to_crs(ground)
    lonlat = to_lonlat(index.plane.crs, in_crs)
    # which of the query's road points agree
    away, near = np.empty((len(scene.points), 3)), np.full(len(scene.points), tolerance_m(camera.gsd_m))
    road_residuals(model.matrix, scene.points, scene.directions, near, MIN_COS, index.road_buckets, away)
    place = RejectedPlace(
        matrix=model.matrix,
        center=Place(
            float(in_crs[4, 0]), float(in_crs[4, 1]), float(lonlat[4, 0]), float(lonlat[4, 1]), entry.log10_odds
        ),
        footprint=ground[:4],
        footprint_lonlat=lonlat[:4],
        log10_odds=entry.log10_odds,
        gsd_m=camera.gsd_m,
        rotation_deg=camera.rotation_deg,
        tilt_deg=camera.tilt_deg,
        agreement=model.found,
        log10_likelihood=model.log10_likelihood,
        nearby=model.nearby,
        agrees=np.isfinite(away[:, 0]),
        why="",
        fault=entry.fault,
    )
    return replace(place, why=_why(place, entry, result, location, needed))


def _why(place: RejectedPlace, entry: Scored, result: Search[Hypothesis], location: Location, needed: Needed) -> str:
    """Return why a place is not the answer."""
    if entry.fault is not None:
        return f"the camera: {_objection(place, entry.fault)}"
    if not math.isfinite(entry.log10_odds):
        return "the fit does not converge to a place within the limits"
    if entry.model is result.best and location.located:
        return "located"
    if entry.log10_odds >= needed.log10_odds:
        if result.score - entry.log10_odds < needed.margin:
            return f"fits as well as another place: the margin is below {needed.margin:g}"
        return f"another place has log10 odds {_number(result.score)}"
    return f"log10 odds {_number(entry.log10_odds)} of {needed.log10_odds:g} needed: {_weakest(place)}"


def _number(value: float) -> str:
    """Write a number to one digit, and never -0.0."""
    return f"{round(value, 1) + 0.0:.1f}"


def _objection(place: RejectedPlace, fault: CameraFault) -> str:
    """Return the camera's objection to a place, and its odds otherwise."""
    values = {
        CameraFault.SAMPLING: f" ({place.gsd_m:.2f} m per pixel)",
        CameraFault.TILT: f" ({place.tilt_deg:.0f} degrees)",
        CameraFault.HEADING: f" (up is {place.rotation_deg % 360:.0f} degrees)",
    }
    known = math.isfinite(place.log10_odds)
    odds = f"; without that its log10 odds were {_number(place.log10_odds)}" if known else ""
    return f"{fault.value}{values.get(fault, '')}{odds}"


def _weakest(place: RejectedPlace) -> str:
    """Compare a place with the best one nearby."""
    if place.agreement is None:
        return "nothing could be compared"
    return f"its roads explain 10^{_number(place.log10_likelihood)}, those of a place nearby 10^{_number(place.nearby)}"


def _starved(funnel: Funnel, refusals: Counter[CameraFault], result: Search[Hypothesis], needed: Needed) -> str:
    """Return the first stage that nothing came out of."""
    stages = ("intersections", "anchors", "tuples", "candidates", "proposals", "on_roads", "survived", "verified")
    empty = next((stage for stage in stages if getattr(funnel, stage) == 0), None)
    if empty == "verified" and refusals:
        return "camera"
    if empty is not None:
        return empty
    if result.score < needed.log10_odds:
        return "odds"
    return "margin"


_NOTHING = {
    "anchors": "no intersection has three neighbours and tangents that make usable tuples",
    "tuples": "no intersection has three neighbours and tangents that make usable tuples",
    "candidates": "no tuple of the mask's intersections is like one of the map's",
    "proposals": "nowhere on the map do two tuples that share an intersection agree",
    "on_roads": "wherever tuples agree, the roads around them do not",
    "survived": "whatever was followed outwards met too few intersections where they should be",
}


def _missing(
    funnel: Funnel,
    refusals: Counter[CameraFault],
    search: TripleEstimator,
    result: Search[Hypothesis],
    places: Sequence[RejectedPlace],
    needed: Needed,
) -> list[str]:
    """List the missing evidence, the surest first."""
    told, scene = [], search.scene
    if result.stopped in ("time", "work"):
        told.append(f"{result.stopped}: the search was stopped by its limit, places may be left untried")
    starved = _starved(funnel, refusals, result, needed)
    if starved in _NOTHING:
        told.append(_NOTHING[starved])
    if starved == "camera":
        reasons = ", ".join(f"{fault.value} ({times})" for fault, times in refusals.most_common())
        told.append(f"a camera: all places that grew are such as none sees, or none within the limits: {reasons}")
    best = places[0] if places else None
    if best is not None and best.fault is not None and best.log10_odds >= needed.log10_odds:
        objection = _objection(best, best.fault)
        told.append(f"the limits on the camera may be too narrow: the best place fails by them alone: {objection}")
    elif best is not None and starved == "odds":
        told.append(f"evidence: at the best place {_weakest(best)}")
    if starved == "margin":
        told.append(
            "difference: another place fits almost as well; more of the surroundings in view would tell them apart"
        )
    if len(scene.intersections) < _USUAL_INTERSECTIONS:
        told.append(
            f"intersections: {len(scene.intersections)} are seen; masks with fewer than {_USUAL_INTERSECTIONS} are"
            " seldom located"
        )
    if best is not None and best.nearby > 0.5 * best.log10_likelihood > 0.0:
        told.append("variety: streets here are so alike that a shifted copy explains half as much and more")
    if search.near is not None and not places:
        told.append("perhaps the circle given is wrong: nothing outside it was tried")
    return told or ["agreement: nothing on this map is like the mask; another map may be needed"]
