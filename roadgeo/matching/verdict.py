"""Located, ambiguous or refused: the places found on all references are judged together, once."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from time import perf_counter

import numpy as np

from roadgeo.geometry.camera import CameraFault, CameraOptions
from roadgeo.geometry.homography import Homography, shift
from roadgeo.geometry.lens import Lens
from roadgeo.geometry.mask import PIXEL_TO_PLANE
from roadgeo.geometry.placement import Matches, Placement
from roadgeo.geometry.projection import metres_apart
from roadgeo.geometry.similarity import find_similarity
from roadgeo.location import Content, Kind, Location, Reason, Spent, Stats
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.lens import straighten_scene
from roadgeo.matching.methods import N_PLACES, Searched
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.place import Place
from roadgeo.matching.scene import NOTICEABLE, Query, Scene
from roadgeo.matching.veto import broken_hints, without_hints

__all__ = ["away", "decide", "georeference", "how_clear", "match_again", "searched_within"]


#: Reason if the clock ended a search: the only case in which an answer depends on the machine and its load.
_CUT_SHORT = "the result may differ between runs"

#: Mean share of intersections and roads that agree at the true place of a good mask.
_LIKE_THE_TRUTH = 0.85

#: A place is only half known if the standard deviation of its middle exceeds this share of the frame's side. The share
#: is .0001 to .003 for located photographs; for frames almost without roads it was up to .09, and they lay 52 m off.
_MOST_UNSURE = 0.03


def decide(query: Query, searched: Sequence[Searched], options: LocateOptions) -> Location:
    """Judge the places found on one or more references, and describe the answer."""
    started = perf_counter()
    location = _judge(query, searched, options)
    return location.spending(match=location.seconds.match + perf_counter() - started)


def _judge(query: Query, searched: Sequence[Searched], options: LocateOptions) -> Location:
    """Decide: the first case that holds is the answer. S is the score needed; scores are leads (see `rivals.Rivals`).

    ===========================================================  ===========================
    the roads fit better where the hints exclude (`veto`)        not located, fits_elsewhere
    the roads fit better with the query mirrored                 not located, mirrored
    no score of S, but two places agree in whole, or lead all    ambiguous, two_places
    no score of S                                                not located (`_why_nothing`)
    a place that leads another map by S lowers the score below   ambiguous, two_places
    the middle is uncertain along a road                         ambiguous, half_a_place
    otherwise                                                    located
    ===========================================================  ===========================
    """
    location = _describe_work(query, searched, options)
    if options.method == "pair":
        return _decide_pairs(location, query, searched, options)
    # The best place of all references, and the others.
    better = next((result.better for result in searched if result.better is not None), None)
    compared = _ranked([place for result in searched for place in result.compared], options.min_log10_odds)
    if better is not None:
        return _fits_elsewhere(location, [better, *_listed(searched, compared)][:N_PLACES], options)
    best, rivals = (compared[0] if compared else None), compared[1:]
    needed = options.min_log10_odds
    listed = _listed(searched, compared)
    rival = None if best is None else _equal(best, rivals, listed, needed)
    if best is None or best.fault is CameraFault.MIRRORED or (best.score < needed and rival is None):
        return _refuse(location, query, searched, listed, options)
    best = _against(best, rivals, needed)
    runner_up = rival or (rivals[0] if rivals else None)
    location = _at(location, [best, *listed[1:]], runner_up, options)
    cut = f"; time limit reached, {_CUT_SHORT}" if location.spent.stopped == "time" else ""
    if rival is not None:
        reason = _two_places(best, rival) + cut
        return replace(location, status="ambiguous", reason=reason, reason_code=Reason.TWO_PLACES)
    half = _only_half(location.places[0])
    if half:
        return replace(location, status="ambiguous", reason=half + cut, reason_code=Reason.HALF_A_PLACE)
    reason = (
        f"{len(location.places[0].matches or ())} of {location.n_intersections} intersections and "
        f"{best.agreement.forward:.0%} of the roads agree; score {best.score:.1f}{cut}"
    )
    return replace(location, status="located", reason=reason, reason_code=Reason.LOCATED)


def _describe_work(query: Query, searched: Sequence[Searched], options: LocateOptions) -> Location:
    """Return the fields that do not depend on the answer."""
    stats = [result.stats for result in searched]
    work = Stats(
        sum(own.tuples_sampled for own in stats),
        sum(own.candidates for own in stats),
        sum(own.hypotheses for own in stats),
        sum(own.verified for own in stats),
        sum(own.work_ms for own in stats),
    )
    spent = [result.seconds for result in searched]
    seconds = replace(query.seconds, match=sum(own.match for own in spent), refine=sum(own.refine for own in spent))
    soft: Kind = "mask" if query.scene.probability is None else "soft mask"
    kind: Kind = soft if without_hints(options) is None else "hints"
    content = Content(query.scene.size, query.graph, query.scene.intersections.xy, kind=kind)
    return Location(query.name, "not_located", "", content=content, spent=Spent(seconds, work, _ended_by(searched)))


def _ended_by(searched: Sequence[Searched]) -> str:
    """Return why a search of one or more parts ended: an answer, a limit, or nothing left to try."""
    ends = {result.stopped for result in searched}
    return next((end for end in ("accepted", "time", "work", "exhausted") if end in ends), "")


def _at(location: Location, places: Sequence[Place], rival: Place | None, options: LocateOptions) -> Location:
    """Return an answer with its places, the first of which has this rival, and the map of the first."""
    focal_px = options.match.camera.focal_px
    best, *others = (georeference(place, focal_px) for place in places)
    beaten = None if rival is None else next((k for k, place in enumerate(places) if _is_at(place, rival)), None)
    if rival is not None:
        best = replace(best, rival=georeference(rival, focal_px) if not beaten else others[beaten - 1])
    return replace(location, places=(best, *others), reference=best.reference, attribution=best.attribution)


def _is_at(place: Place, other: Place) -> bool:
    """Return whether two values are of one homography."""
    return place.matrix is other.matrix


def _ranked(pool: Sequence[Place], needed: float) -> list[Place]:
    """Return the places of all references, the best first; a place on overlapping parts occurs once.

    Leads compete: a place that leads its own map comes before all that do not. Those that do are ranked by likelihood.
    """
    leading = _distinct([place for place in pool if place.score >= needed])
    return leading + _distinct([place for place in pool if place.score < needed], leading)


def _distinct(pool: Sequence[Place], listed: Sequence[Place] = ()) -> list[Place]:
    """Return the places that are not listed yet, the best first, each once; places of one search are different."""
    distinct = list(listed)
    for place in sorted(pool, key=lambda place: (-place.explained, -place.score)):
        if not any(place.index is not other.index and place.same(other) for other in distinct):
            distinct.append(place)
    return distinct[len(listed) :]


def _listed(searched: Sequence[Searched], compared: Sequence[Place]) -> list[Place]:
    """Return the places that an answer lists: those that were compared, then others that were verified."""
    if not compared:
        return []
    further = _distinct([place for result in searched for place in result.places[1:]], compared)
    return [*compared, *further][:N_PLACES]


def _against(best: Place, rivals: Sequence[Place], needed: float) -> Place:
    """Return a place with its lead over the places on all references that lead their own."""
    others = [rival for rival in rivals if rival.index is not best.index and rival.score >= needed]
    leads = [best.explained - rival.explained for rival in others]
    return best.but(score=min([best.score, *(lead / best.statement_px for lead in leads)]))


def _equal(best: Place, rivals: Sequence[Place], listed: Sequence[Place], needed: float) -> Place | None:
    """Return a rival that makes the best place ambiguous, or None.

    If no place would be reported, that is a rival that agrees as well as the best place where streets repeat; or one
    with which it stands out from all others. Otherwise it is a rival without which the best place would be reported.
    """
    if best.score < needed:
        alike = next((rival for rival in rivals if _are_alike(best, rival)), None)
        return alike or (rivals[0] if rivals and _stand_out(best, rivals[0], listed[2:], needed) else None)
    return next((rival for rival in rivals if _against(best, [rival], needed).score < needed), None)


def _are_alike(best: Place, rival: Place) -> bool:
    """Return whether both places agree so well that only repeating streets explain it, whatever their scores."""
    return min(best.agreeing, rival.agreeing) >= _LIKE_THE_TRUTH


def _stand_out(best: Place, rival: Place, others: Sequence[Place], needed: float) -> bool:
    """Return whether two places of a map explain much, and more than all others by the score needed."""
    explains = min(best.log10_likelihood, rival.log10_likelihood) >= 2.0 * needed
    on_one_map = best.index.is_of_map(rival.index) and abs(best.log10_likelihood - rival.log10_likelihood) < needed
    return explains and on_one_map and all(other.score <= rival.score - needed for other in others)


def _only_half(placed: Placement) -> str:
    """Describe a place whose middle is uncertain by much of the frame; "" for a whole place."""
    error, side_m = placed.center_error, placed.gsd_m * math.sqrt(placed.size[0] * placed.size[1])
    if error is None or error.along_m <= _MOST_UNSURE * side_m:
        return ""
    return (
        f"position is uncertain along one direction: +-{2.0 * error.along_m:.0f} m at azimuth "
        f"{error.azimuth_deg:.0f} degrees, +-{2.0 * error.across_m:.0f} m across (95 %), of a frame of {side_m:.0f} m; "
        "roads in other directions would fix it"
    )


def _two_places(best: Place, rival: Place) -> str:
    on = ("", "")
    if best.index.name != rival.index.name:
        on = (f" on {best.index.name}", f" on {rival.index.name}")
    return (
        f"two places fit almost equally, for streets repeat there: {best.agreeing:.0%} agrees at one{on[0]}, "
        f"{rival.agreeing:.0%} at another{on[1]}"
    )


def _decide_pairs(location: Location, query: Query, searched: Sequence[Searched], options: LocateOptions) -> Location:
    """Report the place that the paper's method found; the method has no scores."""
    best = next((result for result in searched if result.places), None)
    if best is None:
        return _refuse(location, query, searched, [], options)
    location = _at(location, best.places[:1], None, options)
    return replace(location, status="located", reason=best.said, reason_code=Reason.LOCATED)


# --- refusals ---------------------------------------------------------------------------------------------------------


def _refuse(
    location: Location, query: Query, searched: Sequence[Searched], listed: Sequence[Place], options: LocateOptions
) -> Location:
    """Describe why nothing is reported, for the reference that came nearest."""
    nearest = next((result for result in searched if listed and listed[0].index.is_of_map(result.index)), None)
    nearest = nearest or max(searched, key=lambda result: result.counts["tried"])
    names = list(dict.fromkeys(result.index.name for result in searched))  # shards bear the name of their map
    where = "on this map" if len(names) == 1 else "on these maps"
    code, reason = _why_nothing(query, nearest, listed, options, where)
    if listed:
        best, *others = listed
        runner_up = next((place for place in others if _was_compared(place, searched)), None)
        # The likeliest leads nothing, so what leads another map has no higher score.
        capped = [place.but(score=min(place.score, best.score)) for place in others]
        capped.sort(key=lambda place: -place.score)
        location = _at(location, [best, *capped], runner_up, options)
    owed = dict.fromkeys(str(result.index.meta.get("attribution") or "") for result in searched)
    if len(names) > 1:
        n_ended = len(names) - len({result.index.name for result in searched if result.stopped != "exhausted"})
        done = f"{n_ended} of {len(names)} maps searched to the end"
        reason = f"{reason} (looked on {', '.join(names)}; {done})"
    return replace(
        location,
        reference=", ".join(names),
        attribution="; ".join(filter(None, owed)),
        reason=reason,
        reason_code=code,
    )


def _fits_elsewhere(location: Location, listed: Sequence[Place], options: LocateOptions) -> Location:
    """Refuse what hints led to: the first of the places, which they exclude, explains more."""
    better, *hinted = listed
    lon, lat, radius_m = options.near or (*better.lonlat, 0.0)
    if hinted and hinted[0].score >= options.min_log10_odds:
        where = f"{away(better.apart_m(hinted[0]))} away"
    elif (off_m := metres_apart(better.lonlat, np.array([lon, lat]))) > radius_m:
        where = f"{away(off_m)} away"
    else:
        where = f"on {better.index.name}"
    ways = broken_hints(better, options)
    reason = f"the roads fit better {where}, {', and '.join(ways)}" if ways else f"the roads fit better {where}"
    return replace(_at(location, listed, None, options), reason=reason, reason_code=Reason.FITS_ELSEWHERE)


def away(metres: float) -> str:
    """Write a distance, in metres or kilometres."""
    return f"{metres:.0f} m" if metres < 1000.0 else f"{metres / 1000.0:.1f} km"


def _was_compared(place: Place, searched: Sequence[Searched]) -> bool:
    """Return whether an answer rests on a place; others are only listed."""
    return any(_is_at(place, other) for result in searched for other in result.compared)


def _why_nothing(
    query: Query, nearest: Searched, listed: Sequence[Place], options: LocateOptions, where: str
) -> tuple[Reason, str]:
    """Return why nothing is reported, as a code and as a sentence with the remedy."""
    if len(query.scene.intersections) == 0:
        return Reason.FEW_INTERSECTIONS, "no intersections are seen, at least 1 is needed"
    if listed and listed[0].fault is CameraFault.MIRRORED:
        return Reason.MIRRORED, "the roads fit better with the image mirrored: was it scanned from its back? Flip it"
    if nearest.said:
        return Reason.TIME_LIMIT if nearest.stopped in ("work", "time") else Reason.NOTHING_STANDS_OUT, nearest.said
    within = searched_within(options)
    if nearest.counts["searched"] == 0 and (options.near is not None or options.match.within is not None):
        given = ["around the place given by near"] * (options.near is not None)
        given += ["in the area given by within"] * (options.match.within is not None)
        return Reason.FEW_NEAR, f"no map has an intersection {' and '.join(given)}{within}"
    score = listed[0].score if listed else -math.inf
    best = how_clear(score, options.min_log10_odds) if math.isfinite(score) else "none fits"
    if nearest.stopped == "work":
        stopped = f"stopped after as much work as a search may take; of the places tried, {best}{within}"
        return Reason.TIME_LIMIT, f"{stopped}; {_how_far(query, nearest, options)}"
    if nearest.stopped == "time":
        limit, tracing_s = options.search.time_limit_s, query.seconds.vectorize
        tracing = f", of which tracing the mask took {tracing_s:.1f} s" if tracing_s > limit / 4 else ""
        stopped = f"time limit of {limit:g} s reached{tracing}, {_CUT_SHORT}"
        sentence = f"{stopped}; of the places tried, {best}{within}; {_how_far(query, nearest, options)}"
        return Reason.TIME_LIMIT, sentence
    return (
        Reason.NOTHING_STANDS_OUT,
        f"no place {where} stands out: {best}{within}; {_what_may_help(listed, options)}",
    )


def _what_may_help(listed: Sequence[Place], options: LocateOptions) -> str:
    """List what may decide: more to see, and the missing hints, with the number of listed places that each leaves."""
    camera, usual = options.match.camera, CameraOptions()
    views = [place.view for place in listed]
    turned = [abs((view.rotation_deg - views[0].rotation_deg + 180.0) % 360.0 - 180.0) for view in views]
    scaled = [abs(math.log(view.gsd_m / views[0].gsd_m)) for view in views]
    away = [listed[0].apart_m(place) for place in listed]
    place_lacks = options.near is None and options.match.within is None
    hints = (
        (camera.gsd_m == usual.gsd_m, "the size of a pixel", "5 %", "(--gsd SIZE+-5%)", scaled, math.log(1.05)),
        (camera.heading is None, "the heading", "5 degrees", "(--heading DEG+-5)", turned, 5.0),
        (place_lacks, "the place", "200 m", "(--near LON,LAT,200)", away, 200.0),
    )
    helps = []
    for lacks, name, precision, option, apart, most in hints:
        left = f"{sum(gap <= most for gap in apart)} of {len(listed)} places"
        help_ = f"{name} to {precision} {option} would leave {left}" if len(listed) > 1 else f"{name} {option}"
        helps += [help_] * lacks
    others = ["a search with full effort"] * (options.effort == "quick") + ["more roads in view"]
    # A search for the mirrored image would take as long again, so that is left to those who know what was scanned.
    others += ["another map, or the image flipped if it was scanned from its back may help"]
    if len(listed) > 1 and helps:
        return f"{', '.join(helps)}; {', '.join(others)}"
    return ", ".join(helps + others)


def how_clear(score: float, needed: float) -> str:
    """Describe how far the best place of a refusal leads."""
    if score < 0.2:
        return "another fits as well as the best"
    return f"the best has a score of {math.floor(10.0 * score) / 10.0:g}, {needed:g} is asked for"


def _how_far(query: Query, searched: Searched, options: LocateOptions) -> str:
    """Describe the progress of a search that was cut short, and hints that would shorten it."""
    far = f"{searched.counts['anchors']} of {len(query.scene.intersections)} intersections had been looked for"
    (low, high), usual = options.match.camera.gsd_m, CameraOptions().gsd_m
    if (low, high) == usual:
        share = 2.0 * math.log(1.3) / math.log(high / low)
        return f"{far}; a pixel size known to 30 % (--gsd) leaves {share:.0%} of the scales to try"
    if options.near is None:
        return f"{far}; a place known to some kilometres (--near) leaves less of the map to try"
    return far


def searched_within(options: LocateOptions) -> str:
    """Name the limits of the search, as the end of a sentence; "" without limits."""
    camera, usual = options.match.camera, CameraOptions()
    limits = []
    if options.near is not None:
        lon, lat, radius = options.near
        rounded = float(f"{radius:.2g}")
        reach = f"{rounded:g} m" if rounded < 1000 else f"{rounded / 1000:g} km"
        limits.append(f"within {reach} of {round(lon, 5):.9g},{round(lat, 5):.9g}")
    if options.match.within is not None:
        limits.append("within longitudes {0:g} to {2:g} and latitudes {1:g} to {3:g}".format(*options.match.within))
    if camera.gsd_m != usual.gsd_m:
        limits.append(f"at {camera.gsd_m[0]:g} to {camera.gsd_m[1]:g} m per pixel")
    if camera.max_tilt_deg != usual.max_tilt_deg:
        limits.append(f"tilted by up to {camera.max_tilt_deg:g} degrees")
    if camera.heading_deg is not None:
        center, off = camera.heading_deg
        limits.append(f"with the image's up at {center:g} degrees from north, give or take {off:g}")
    elif camera.north_up:
        limits.append("north up")
    if camera.focal_px is not None:
        limits.append(f"with a focal length of {camera.focal_px:.5g} pixels")
    return f"; searched {', '.join(limits)}" if limits else ""


# --- where the frame lies on Earth ------------------------------------------------------------------------------------


def georeference(place: Place, focal_px: float | None = None) -> Placement:
    """Return a place as it leaves: in the map's CRS, levelled where the camera looked straight down.

    `focal_px`: the camera's focal length, where it is given.
    """
    index, level = place.index, _level(place)
    return Placement(
        place.scene.size,
        index.plane,
        level.matrix @ PIXEL_TO_PLANE,
        place.score,
        index.name,
        str(index.meta.get("attribution") or ""),
        level.covariance,
        place.lens_k1,
        "homography" if level is place else "similarity",
        focal_px,
        matches=_matches(place),
    )


def match_again(placement: Placement, scene: Scene, index: ReferenceIndex) -> Matches:
    """Return the intersections of a scene that match a map's where it was placed; both are in one CRS."""
    to_plane = shift(*np.subtract(placement.plane.origin, index.plane.origin))
    straight = straighten_scene(scene, placement.lens_k1) if placement.lens_k1 else scene
    return _matches(Place(straight, index, to_plane @ placement.matrix @ PIXEL_TO_PLANE), placement.lens_k1)


def _matches(place: Place, lens_k1: float = 0.0) -> Matches:
    """Return the intersections that match at a place, the query's as the lens shows them."""
    index, scene, chosen = place.index, place.scene, place.matched >= 0
    query_xy, there = scene.intersections.xy[chosen], index.xy[place.matched[chosen]]
    residual_m = np.hypot(*(Homography(place.matrix).everywhere(query_xy) - there).T)
    k1 = lens_k1 or place.lens_k1
    bent = Lens.of(k1, scene.size, y_up=True).bend(query_xy) if k1 else query_xy
    return Matches(bent, index.plane.to_crs(there), residual_m)


def _level(place: Place) -> Place:
    """Return a place restricted to a camera that looks straight down, unless the roads are inconsistent with it."""
    if place.refined is None or place.lens_k1:
        return place
    level = find_similarity(place.matrix, place.scene.corners, place.refined.corner_covariance_m2)
    if level is None:
        return place
    # The covariance may be too large. Roads that agreed must still agree.
    refined = replace(place.refined, matrix=level.matrix, corner_covariance_m2=level.corner_covariance + level.by_tilt)
    levelled = place.at(refined)
    return levelled if levelled.agreement.forward >= place.agreement.forward - NOTICEABLE else place
