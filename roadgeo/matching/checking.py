"""Is a given place right? The search is given it and the places around, as hints; what it decides is held against it.

The decision is the search's own (see `rivals`, `veto`, `verdict`): a place must lead its rivals, contradict few roads,
and no other place on the map, whether within reach or not, may explain more.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo.geometry.displacement import Displacement, measure
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.mask import PIXEL_TO_PLANE
from roadgeo.geometry.placement import Placement
from roadgeo.geometry.projection import metres_apart
from roadgeo.location import Location, Reason
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.methods import search_references
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.parts import Whole
from roadgeo.matching.place import Place
from roadgeo.matching.refinement import TOLERANCE_M
from roadgeo.matching.rivals import fitted
from roadgeo.matching.scene import N_ROUGHLY, Query
from roadgeo.matching.shifts import LocalSearchOptions, move_about, search_nearby
from roadgeo.matching.verdict import away, decide
from roadgeo.matching.veto import contest

__all__ = ["CheckOptions", "Checked", "Verdict", "check_place"]

Verdict = Literal["agrees", "off", "unknown"]


#: Score that a place needs; less if it is the given place, which is seldom the best of a dozen that fit by chance.
_MIN_SCORE, _MIN_SCORE_AS_GIVEN = 2.0, 1.0
#: Chi-squared of a displacement that counts as off: met by chance once in 1000 with 4 degrees of freedom.
_MIN_CHI2 = 18.5
#: Length of road, metres, that mask and map must each show.
_MIN_ROADS_M = 300.0
#: By how much a given scale and tilt may be wrong: a factor, and degrees.
_SCALED, _TILTED_DEG = 1.1, 5.0


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
    placement : Placement or None
        Where the roads put the frame.
    log10_lead, rival : float, Displacement or None
        Score of the best place, and the displacement of its strongest rival.
    agreeing, agreeing_as_given : float or None
        Share of the roads of mask and map that agree at the best place, and at the given place.
    """

    verdict: Verdict
    reason: str
    displacement: Displacement | None = None
    placement: Placement | None = None
    log10_lead: float | None = None
    rival: Displacement | None = None
    agreeing: float | None = None
    agreeing_as_given: float | None = None


def check_place(
    start: FloatArray, query: Query, index: ReferenceIndex, options: CheckOptions | None = None, beyond: bool = True
) -> Checked:
    """Check the place of a query, within the search's reach.

    Parameters
    ----------
    start : (3, 3) float64
        Query plane to reference plane, as it is given.
    beyond : bool
        Whether the map is searched beyond the reach, too, for a place that explains more.
    """
    given, options = Place(query.scene, index, start), options or CheckOptions()
    shown_m = query.scene.road_length_px * given.gsd_m
    if shown_m < _MIN_ROADS_M:
        return Checked("unknown", f"too few roads: the mask shows {shown_m:.0f} m of them")
    mapped_m = given.gsd_m * given.evidence.mapped_px(start)
    if mapped_m < _MIN_ROADS_M:
        return Checked("unknown", f"the map has {mapped_m:.0f} m of roads there: not on this map")
    return _judge(_locate(given, query, options, beyond), given, options)


def _locate(given: Place, query: Query, options: CheckOptions, beyond: bool) -> Location:
    """Search for a query at its given place and around it; beyond, only for a place that explains more."""
    hints, parts = _as_hints(given, options), [Whole(given.index)]
    only_there = replace(hints, match=replace(hints.match, sweeps=(), without_roads=(), roads=False))
    proposed = [(given.index, place.matrix) for place in _around(given, options)]
    limit_s = hints.search.time_limit_s
    results = search_references(query, parts, only_there, limit_s, proposed=proposed)
    return decide(query, contest(query, results, parts, hints, limit_s) if beyond else results, hints)


def _as_hints(given: Place, options: CheckOptions) -> LocateOptions:
    """Return the given place, scale, heading and tilt as what is known of a query."""
    view, (lon, lat), usual = given.view, given.lonlat.tolist(), LocateOptions()
    camera = replace(
        usual.match.camera,
        gsd_m=(view.gsd_m / _SCALED, view.gsd_m * _SCALED),
        heading_deg=(view.rotation_deg, options.search.turn_deg),
        max_tilt_deg=view.tilt_deg + _TILTED_DEG,
    )
    near = lon, lat, options.search.reach_m
    match = replace(usual.match, camera=camera, lens=False)  # what has a georeference was rectified
    return replace(usual, near=near, match=match, min_log10_odds=_MIN_SCORE_AS_GIVEN)


def _around(given: Place, options: CheckOptions) -> Iterator[Place]:
    """Yield the given place and those around it where the query's roads lie on roads, fitted roughly."""
    yield fitted(given, LocateOptions().match, N_ROUGHLY)
    for shift in search_nearby(given.matrix, given.scene, given.index, options.search):
        start = replace(given, matrix=move_about(given.center, shift) @ given.matrix)
        yield fitted(start, LocateOptions().match, N_ROUGHLY)


def _judge(location: Location, given: Place, options: CheckOptions) -> Checked:
    """Hold the answer of the search against the given place."""
    if not location.places:
        return Checked(
            "unknown", f"no place within {options.search.reach_m:g} m fits", agreeing_as_given=_agreeing(given)
        )
    best = location.places[0]
    rival = None if best.rival is None else _displacement(given, best.rival)
    there = replace(given, matrix=best.matrix @ PIXEL_TO_PLANE)
    checked = Checked("unknown", "", None, None, best.score, rival, _agreeing(there), _agreeing(given))
    if not location.located:
        return replace(checked, reason=_why_unknown(location, given, options))
    offset = _displacement(given, best)
    off, sigma = offset.over(given.corners), offset.sigma_over(given.corners)
    agrees, said = off <= options.tolerance_m, f"off by {off:.1f} ± {sigma:.1f} m"
    if best.score < _MIN_SCORE and not agrees:
        return replace(checked, reason=_stands_out_too_little(best.score, _MIN_SCORE, options))
    checked = replace(checked, displacement=offset, placement=best)
    if sigma > options.max_sigma_m:
        return replace(checked, reason=f"the roads place it to {sigma:.1f} m only")
    if agrees:
        return replace(checked, verdict="agrees", reason=said)
    if offset.significance < _MIN_CHI2 or off - sigma < options.tolerance_m:
        return replace(checked, reason=f"{said}: that may be chance")
    return replace(checked, verdict="off", reason=said)


def _why_unknown(location: Location, given: Place, options: CheckOptions) -> str:
    """Return why the search located nothing."""
    best = location.places[0]
    if location.reason_code is Reason.FITS_ELSEWHERE:
        offset, apart_m = _displacement(given, best), metres_apart(np.array(best.center[2:]), given.lonlat)
        ways = [f"{away(apart_m)} away"] * (apart_m > options.tolerance_m)
        ways += [f"turned by {abs(offset.turn_deg):.0f} degrees"] * (abs(offset.turn_deg) > options.search.turn_deg)
        ways += [f"{offset.scale:.2f} times as large"] * (abs(math.log(offset.scale)) > math.log(_SCALED))
        return f"the roads fit better {' and '.join(ways)}"
    if location.status == "ambiguous":
        return location.reason
    return _stands_out_too_little(best.score, _MIN_SCORE_AS_GIVEN, options)


def _stands_out_too_little(score: float, needed: float, options: CheckOptions) -> str:
    at_most = math.floor(10.0 * max(score, 0.0)) / 10.0
    return (
        f"no place within {options.search.reach_m:g} m stands out: the best has a score of {at_most:g}, {needed:g} is "
        "needed"
    )


def _displacement(given: Place, placed: Placement) -> Displacement:
    """Return how far a placement lies from the given place."""
    corners = Homography(placed.matrix).everywhere(Frame(*placed.size).corners)
    covariance = np.eye(8) if placed.corner_covariance_m2 is None else placed.corner_covariance_m2
    covariance = covariance + TOLERANCE_M**2 * np.eye(8)  # corners of a similarity depend on each other
    return measure(given.corners, corners, covariance)


def _agreeing(place: Place) -> float:
    """Return the share of the roads of mask and map that agree."""
    return (place.agreement.forward + place.agreement.backward) / 2.0
