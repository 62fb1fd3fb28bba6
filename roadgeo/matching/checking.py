"""Is a given place right? Find the best place near it, its lead over all others there, and its distance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from roadgeo._arrays import FloatArray, IntArray
from roadgeo.geometry.displacement import Displacement, measure
from roadgeo.geometry.homography import Homography
from roadgeo.kernels.roads import road_residuals
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.picture import Picture
from roadgeo.matching.place import Place, Weight
from roadgeo.matching.refinement import RefineOptions, points_on_map, refine, refine_between
from roadgeo.matching.scene import MIN_COS, Scene
from roadgeo.matching.shifts import APART_M, LocalSearchOptions, move_about, search_nearby

__all__ = ["CheckOptions", "Checked", "Verdict", "check_place"]

Verdict = Literal["agrees", "off", "unknown"]


#: Log10 lead that the best place needs over each other place nearby; less if it is the given place, which is seldom the
#: best of a dozen places that fit by chance.
_MIN_LOG10, _MIN_LOG10_AS_GIVEN = 2.0, 1.0
#: Chi-squared of a displacement that counts as off: met by chance once in 1000 with 4 degrees of freedom.
_MIN_CHI2 = 18.5
#: Length of road, metres, that mask and map must each show.
_MIN_ROADS_M = 300.0
#: A refinement that moves the corners by more than this, metres, has diverged.
_MAX_DRIFT_M = 40.0
#: Number of shifts with which a soft picture is compared.
_N_SHIFTS = 8
#: Half the distance between the lines of a dual carriageway, metres, up to 1.8 times as much.
_TWIN_M = 10.0
#: Prior standard deviation of the perspective that is left: georeferenced images are rectified.
_PERSPECTIVE_SIGMA = 0.003


@dataclass(frozen=True)
class CheckOptions:
    """When a place is right, and where it is looked for.

    Attributes
    ----------
    tolerance_m : float
        A place agrees where the frame, on average, is off by less.
    max_sigma_m : float
        A frame whose place is less certain than this is not judged.
    """

    tolerance_m: float = 3.0
    max_sigma_m: float = 3.0
    search: LocalSearchOptions = field(default_factory=LocalSearchOptions)


@dataclass(frozen=True)
class Checked:
    """The result for a given place; None for unknown values.

    Attributes
    ----------
    displacement : Displacement or None
        From where it was put to where it belongs, on the reference plane.
    matrix : (3, 3) float64 or None
        Query plane to reference plane, corrected.
    log10_lead, rival : float, Displacement or None
        Log10 lead of the best place over its strongest rival, and the rival's displacement.
    agreeing, agreeing_as_given : float or None
        Share of the roads of mask and map that agree at the best place, and at the given place.
    matched : (N,) int or None
        Map intersection of each query intersection, or -1.
    """

    verdict: Verdict
    reason: str
    displacement: Displacement | None = None
    matrix: FloatArray | None = None
    log10_lead: float | None = None
    rival: Displacement | None = None
    agreeing: float | None = None
    agreeing_as_given: float | None = None
    matched: IntArray | None = None


def check_place(start: FloatArray, scene: Scene, index: ReferenceIndex, options: CheckOptions | None = None) -> Checked:
    """Check the place of a scene, within the search's reach.

    Parameters
    ----------
    start : (3, 3) float64
        Query plane to reference plane, as it is given.
    """
    judge = _Judge(Place(scene, index, start), options or CheckOptions())
    shown_m = scene.road_length_px * judge.given.gsd_m
    if shown_m < _MIN_ROADS_M:
        return Checked("unknown", f"too few roads: the mask shows {shown_m:.0f} m of them")
    if judge.map_length_m < _MIN_ROADS_M:
        return Checked("unknown", f"the map has {judge.map_length_m:.0f} m of roads there: not on this map")
    return _judge_best(judge, judge.refine_all([judge.given, *judge.propose()]))


class _Judge:
    """Refines places of one scene and measures their agreement; `given` is the place to be checked."""

    def __init__(self, given: Place, options: CheckOptions) -> None:
        self.given, self.options = given, options
        scene, index, start = given.scene, given.index, given.matrix
        self.corners = Homography(start)(scene.corners)
        self.picture = Picture(scene, index, given.gsd_m) if scene.probability is not None else None
        tilted = np.abs(start[2, :2]).max() / abs(start[2] @ np.append(scene.center, 1.0)) * scene.half_size > 0.01
        self.refine_options = RefineOptions() if tilted else RefineOptions(perspective_sigma=_PERSPECTIVE_SIGMA)

    @property
    def map_length_m(self) -> float:
        """Length of the map's roads inside the frame as it is given, metres."""
        return self.given.gsd_m * self.given.evidence.mapped_px(self.given.matrix)

    def propose(self) -> list[Place]:
        """Return the starts of the places nearby."""
        given = self.given
        center = Homography(given.matrix)(given.scene.center)
        shifts = search_nearby(given.matrix, given.scene, given.index, self.options.search)
        return [Place(given.scene, given.index, move_about(center, shift) @ given.matrix) for shift in shifts]

    def refine_all(self, starts: Sequence[Place]) -> list[Place]:
        """Refine places roughly; return the distinct ones, by falling agreement."""
        places = [self.refine(start, 200) for start in starts]
        distinct: list[Place] = []
        for place in sorted(places, key=lambda place: -place.log10_likelihood):
            if all(self.gap(place, other) >= APART_M for other in distinct):
                distinct.append(place)
        return distinct

    def refine(self, start: Place, n_points: int | None) -> Place:
        """Refine a place until its matches settle; keep it unchanged if the refinement diverges."""
        place = start
        scene = start.scene if n_points else self.without_twins(start)
        matched = np.full(len(scene.intersections), -1)
        for _ in range(3):
            matched, _ = place.matches
            step = refine(place.matrix, scene, place.index, matched, self.refine_options, n_points, held=True)
            moved = None if step is None else place.at(step)
            if moved is None or not self.gap(moved, start) < _MAX_DRIFT_M:
                break
            place = moved
        if place.refined is not None and n_points is None:
            place = place.at(refine_between(place.refined, scene, place.index, matched, self.refine_options)[0])
        return place.but(by=self.weigh(place.matrix))

    def weigh(self, matrix: FloatArray) -> Weight:
        """Return the likelihood of a place: by a soft picture, or by the roads of a drawn mask."""
        yardstick = self.picture or self.given.evidence
        return Weight(yardstick.weigh(matrix), yardstick.statement_px)

    def lead(self, best: Place, places: Sequence[Place]) -> tuple[float, Place | None]:
        """Return the log10 lead of a place over its strongest rival, and the rival.

        A soft picture is compared with all shifts as well, for it shows more than the roads that were traced in it.
        """
        rivals = [place for place in places if self.gap(place, best) >= APART_M]
        if self.picture is None:
            compare = self.given.evidence.compared_with(best.matrix)
            leads = [compare(rival.matrix)[1] for rival in rivals]
            return min(zip(leads, rivals, strict=True), key=lambda pair: pair[0], default=(0.0, None))
        peaks = self.picture.correlate(best.matrix, self.options.search.reach_m, (0.0,), _N_SHIFTS, APART_M)
        rivals += map(self.picture.settle, peaks)
        hardest = max(rivals, key=lambda rival: rival.log10_likelihood, default=None)
        likelihood = 0.0 if hardest is None else hardest.log10_likelihood
        return self.picture.lead(best.log10_likelihood, likelihood), hardest

    def without_twins(self, place: Place) -> Scene:
        """Return the scene without road points that have parallel roads of the map on both sides.

        A mask often shows a dual carriageway as a single line, halfway between the two lines of the map. A fit to
        either line would be off by half their distance.
        """
        scene, buckets = place.scene, place.index.road_buckets
        points, along, _ = points_on_map(place.matrix, scene)
        alone, away = np.zeros(len(points), bool), np.empty((len(points), 3))
        for across in (along[:, ::-1] * (1.0, -1.0), along[:, ::-1] * (-1.0, 1.0)):
            reach, shifted = np.full(len(points), 0.8 * _TWIN_M), np.ascontiguousarray(points + _TWIN_M * across)
            road_residuals(np.eye(3), shifted, along, reach, MIN_COS, buckets, away)
            alone |= np.isnan(away[:, 0])
        if alone.mean() < 0.4:
            return scene
        return replace(scene.of_points(alone), road_length_px=scene.road_length_px * alone.mean())

    def displacement(self, place: Place) -> Displacement:
        """Return how far a place lies from the given one."""
        covariance = np.eye(8) if place.refined is None else place.refined.corner_covariance_m2
        return measure(self.corners, Homography(place.matrix)(place.scene.corners), covariance)

    def gap(self, a: Place, b: Place) -> float:
        """Return the root mean square distance, metres, between the frame's corners at two places."""
        gaps = Homography(a.matrix)(a.scene.corners) - Homography(b.matrix)(b.scene.corners)
        return float(np.sqrt(np.mean(np.sum(gaps**2, axis=1))))


def _agreeing(place: Place) -> float:
    """Return the share of the roads of mask and map that agree."""
    return (place.agreement.forward + place.agreement.backward) / 2.0


def _judge_best(judge: _Judge, places: Sequence[Place]) -> Checked:
    """Judge the best of some places, the best first, against the others."""
    # The best place against its strongest rival.
    options = judge.options
    best = judge.refine(places[0], None)
    lead, hardest = judge.lead(best, places[1:])
    if best.refined is None or hardest is None:
        return Checked("unknown", f"no place within {options.search.reach_m:g} m fits")
    found = judge.displacement(best)
    known = Checked(
        "unknown",
        "",
        found,
        best.matrix,
        lead,
        judge.displacement(hardest),
        _agreeing(best),
        _agreeing(judge.given),
        best.matched,
    )
    # Consequences of the distance from the claimed place.
    off, sigma = found.over(judge.corners), found.sigma_over(judge.corners)
    said = f"off by {off:.1f} ± {sigma:.1f} m"
    agrees = off <= options.tolerance_m
    needed = _MIN_LOG10_AS_GIVEN if agrees else _MIN_LOG10
    if lead < needed:
        leads_by = f"the best leads by 10^{lead:.1f}, 10^{needed:g} is needed"
        nothing = f"no place within {options.search.reach_m:g} m stands out: {leads_by}"
        return replace(known, displacement=None, matrix=None, matched=None, reason=nothing)
    if sigma > options.max_sigma_m:
        return replace(known, reason=f"the roads place it to {sigma:.1f} m only")
    if agrees:
        return replace(known, verdict="agrees", reason=said)
    if found.significance < _MIN_CHI2 or off - sigma < options.tolerance_m:
        return replace(known, reason=f"{said}: that may be chance")
    return replace(known, verdict="off", reason=said)
