"""Hints leave few rivals, or none: a place found with them proves nothing. The query is searched without them, too.

A hinted place stands only if no other place explains more, by traced roads. On 98 masks and photographs with hints, 19
false and 79 true, that refused 18 of the 19 and none of the 79.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from roadgeo.geometry.areas import lies_in
from roadgeo.geometry.camera import CameraOptions
from roadgeo.geometry.projection import metres_apart
from roadgeo.matching.evidence import Evidence
from roadgeo.matching.hints import GSD_FACTOR
from roadgeo.matching.methods import Searched, may_show, search_references
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.parts import Part
from roadgeo.matching.place import Place, Weight
from roadgeo.matching.rivals import places_beside
from roadgeo.matching.scene import Query

__all__ = ["broken_hints", "contest", "without_hints"]

#: A place at the hinted one is another place if it is turned by more, or of a size that a hint tells from it.
_TURNED_DEG = 45.0
#: Another place explains more if its log10 likelihood is greater by this. Where streets repeat, places are equal but
#: for the accuracy of tracing, and it is a hint that separates them: in a perfect grid they differ by 0.1. Hints that
#: were false were refuted by 0.2 and more.
_MORE = 0.15
#: Limit of work for a search without hints where the one with hints found nothing that would be reported, seconds.
_BRIEFLY_S = 1.0


def without_hints(options: LocateOptions) -> LocateOptions | None:
    """Return the options without hints on the place, the heading and the scale; None where none are given."""
    camera, usual = options.match.camera, CameraOptions().gsd_m
    is_scale_given = camera.gsd_m[1] / camera.gsd_m[0] < 0.999 * usual[1] / usual[0]
    if options.near is None and options.match.within is None and camera.heading is None and not is_scale_given:
        return None
    camera = replace(camera, heading_deg=None, north_up=False, gsd_m=usual if is_scale_given else camera.gsd_m)
    return replace(options, near=None, match=replace(options.match, camera=camera, within=None))


def _alike(place: Place, free: LocateOptions) -> LocateOptions:
    """Return options for places of a place's own heading and scale, wherever they are."""
    scale = place.gsd_m / GSD_FACTOR, place.gsd_m * GSD_FACTOR
    camera = replace(free.match.camera, heading_deg=(place.view.rotation_deg, _TURNED_DEG), gsd_m=scale)
    return replace(free, match=replace(free.match, camera=camera))


def contest(
    query: Query, hinted: Sequence[Searched], parts: Sequence[Part], options: LocateOptions, time_limit_s: float
) -> list[Searched]:
    """Return what a search with hints found; with the place where the roads fit better without them, if there is one.

    Where the search with hints found a place that would be reported, any other that explains more is a better one: one
    beside it, or one that the search without them met, or, where that led nowhere, as in a lattice, a search at its own
    heading and scale. Where it did not, only a place that would be reported itself is. A better place that agrees with
    the hints is the answer: the places found without them. Where no time is left to search without hints, the place is
    not reported.

    Parameters
    ----------
    time_limit_s : float
        For both, what the search with hints took included.
    """
    free, needed = without_hints(options), options.min_log10_odds
    leading = max(hinted, key=lambda result: result.places[0].score if result.places else -math.inf)
    if free is None or leading.counts["searched"] == 0 or options.method == "pair":
        return list(hinted)
    best = next(iter(leading.places), None)
    reported = best if best is not None and best.score >= needed else None
    if reported is not None:
        fewer = [free, _alike(reported, free)]
        others = [place for place in places_beside(reported, free.match) if broken_hints(place, options)]
    else:
        brief = replace(free.search, work_limit_s=min(_BRIEFLY_S, free.search.work_limit_s))
        fewer, others = [replace(free, effort="quick", search=brief)], []
    frame_m = 2.0 * query.scene.half_size * options.match.camera.gsd_m[1]
    here = [part for part in parts if may_show(part, options, frame_m)]  # no other was opened
    time_limit_s -= sum(result.seconds.total for result in hinted)
    spent_s, is_cut = 0.0, False
    for known in fewer:
        results = search_references(query, here, known, max(time_limit_s - spent_s, 0.0))
        spent_s += sum(result.seconds.total for result in results)
        standing = [place for result in results for place in result.places[:1] if place.score >= needed]
        others += standing if reported is None else [place for result in results for place in result.likeliest]
        better = _better(best, others)
        if better is not None and not broken_hints(better, options):  # hints led past it
            return results
        if better is not None or standing:
            break
        is_cut = any(result.stopped == "time" for result in results)
        if is_cut:
            break
    contested = _unproved(leading) if reported is not None and is_cut else replace(leading, better=better)
    return [contested.later(spent_s) if result is leading else result for result in hinted]


def _unproved(found: Searched) -> Searched:
    """Return a result whose place is not reported, for there was no time to search without hints."""
    said = "time limit reached before the roads were looked for without the hints: they may fit better elsewhere"
    return replace(
        found, places=tuple(place.but(score=min(place.score, 0.0)) for place in found.places), stopped="time", said=said
    )


def _better(hinted: Place | None, others: Sequence[Place]) -> Place | None:
    """Return the other place that explains most, if it explains more than the hinted one, at that one's scale."""
    if hinted is None:
        return max(others, key=lambda place: place.explained, default=None)
    weighed = [
        (Evidence(hinted.scene, place.index, hinted.gsd_m).weigh(place.matrix), place)
        for place in others
        if _is_other(hinted, place)
    ]
    likelihood, best = max(weighed, key=lambda pair: pair[0], default=(-math.inf, None))
    own = hinted.agreement.log10_likelihood
    if best is None or likelihood < own + _MORE:
        return None
    return best.but(score=likelihood - own, by=Weight(likelihood, hinted.but(by=None).statement_px))


def _is_other(hinted: Place, place: Place) -> bool:
    """Return whether a place is another than the hinted one: elsewhere, turned, or of another size."""
    turn = hinted.view.rotation_deg - place.view.rotation_deg
    is_turned = abs((turn + 180.0) % 360.0 - 180.0) > _TURNED_DEG
    return is_turned or abs(math.log(place.gsd_m / hinted.gsd_m)) > math.log(GSD_FACTOR) or not place.same(hinted)


def broken_hints(place: Place, options: LocateOptions) -> list[str]:
    """Return in which ways a place contradicts the hints, each with the hint to leave out."""
    camera, near, within = options.match.camera, options.near, options.match.within
    lon, lat = place.lonlat.tolist()
    ways = []
    if near is not None and metres_apart(place.lonlat, np.array(near[:2])) > near[2]:
        ways.append("outside the circle given: leave --near out")
    if within is not None and not lies_in(within, lon, lat):
        ways.append("outside the area given: leave --within out")
    if not camera.gsd_m[0] <= place.gsd_m <= camera.gsd_m[1]:
        ways.append("at another scale than given: leave --gsd out")
    east, north = place.corners[0] - place.corners[3]
    if camera.turned_off(east, north) > 0.0:
        ways.append("turned away from the heading given: leave --heading out")
    return ways
