"""Located, ambiguous or refused: the places found on all references are judged together, once."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from time import perf_counter

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo._text import counted
from roadgeo.geometry.camera import CameraOptions, pose
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.mask import PIXEL_TO_PLANE
from roadgeo.geometry.pose import find_pose, turned
from roadgeo.geometry.projection import from_lonlat, grid_north, to_lonlat
from roadgeo.geometry.similarity import find_similarity
from roadgeo.geometry.transformation import LONLAT, exactness
from roadgeo.location import Camera, Evidence, Location, Place, Reason, Seen, Stats
from roadgeo.matching.estimator import MatchOptions
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.methods import N_PLACES, Searched
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.place import Place as Hyp
from roadgeo.matching.refinement import corner_sigmas
from roadgeo.matching.scene import Query
from roadgeo.matching.veto import broken_hints

__all__ = ["center_of", "decide", "place_frame"]


#: Reason if the clock ended a search: the only case in which an answer depends on the machine and its load.
_CUT_SHORT = "so that another run may tell otherwise"

#: Mean share of intersections and roads that agree at the true place of a good mask.
_LIKE_THE_TRUTH = 0.85

#: A place is only half known if the standard deviation of its middle exceeds this share of the frame's side. The share
#: is .0001 to .003 for located photographs; for frames almost without roads it was up to .09, and they lay 52 m off.
_MOST_UNSURE = 0.03

#: A similarity replaces the homography if it loses at most this share of the query's roads.
_LEAST_LOST = 0.02


def decide(query: Query, found: Sequence[Searched], options: LocateOptions) -> Location:
    """Judge the places found on one or more references, and describe the answer."""
    started = perf_counter()
    location = _judge(query, found, options)
    seconds = location.seconds
    return replace(location, seconds=replace(seconds, match=seconds.match + perf_counter() - started))


def _judge(query: Query, found: Sequence[Searched], options: LocateOptions) -> Location:
    """Compare the places with each other and with the thresholds; describe the best, or the reason for a refusal."""
    location = _describe_work(query, found)
    if options.method == "pair":
        return _decide_pairs(location, query, found, options)
    # The best place of all references, and the others.
    better = next((one.better for one in found if one.better is not None), None)
    candidates = [*filter(None, [better]), *_pool(found, options.min_log10_odds)]
    best, rivals = (candidates[0] if candidates else None), candidates[1:]
    listed = _listed(found, candidates)
    places = tuple(_describe(location, query, listed, number, options) for number in range(1, 1 + len(listed)))
    if best is not None:
        runner_up = places[1] if rivals else None
        location = replace(location, log10_odds=best.score, runner_up=runner_up, alternatives=places[1:])
    if better is not None:
        return _fits_elsewhere(replace(location, log10_odds=None, alternatives=places), candidates, options)
    needed = options.min_log10_odds
    rival = None if best is None else _equal(best, rivals, needed)
    if best is None or (best.score < needed and rival is None):
        return _refuse(replace(location, alternatives=places), query, found, listed, options)
    best = _against(best, rivals, needed)
    placed = place_frame(_on(location, best.index), query, best, options.match)
    cut = f"; stopped at the time limit, {_CUT_SHORT}" if location.stopped == "time" else ""
    if rival is not None:
        runner_up = _seen_from(best, rival)
        placed = replace(placed, runner_up=runner_up)
        reason = _two_places(best, rival) + cut
        return replace(placed, status="ambiguous", reason=reason, reason_code=Reason.TWO_PLACES)
    half = _only_half(placed)
    if half:
        return replace(placed, status="ambiguous", reason=half + cut, reason_code=Reason.HALF_A_PLACE)
    reason = (
        f"{placed.n_matched} of {placed.n_intersections} intersections and {best.agreement.forward:.0%} of the roads "
        f"agree; score {best.score:.1f}{cut}"
    )
    return replace(placed, status="located", reason=reason, reason_code=Reason.LOCATED)


def _describe_work(query: Query, found: Sequence[Searched]) -> Location:
    """Return the fields that do not depend on the answer."""
    stats = [one.stats for one in found]
    work = Stats(
        sum(one.tuples_sampled for one in stats),
        sum(one.candidates for one in stats),
        sum(one.hypotheses for one in stats),
        sum(one.verified for one in stats),
        sum(one.work_ms for one in stats),
    )
    match_s, refine_s = sum(one.match_s for one in found), sum(one.refine_s for one in found)
    xy = query.scene.intersections.xy
    return Location(
        query.name,
        "not_located",
        "",
        size=query.scene.size,
        n_intersections=len(xy),
        seconds=replace(query.seconds, match=match_s, refine=refine_s),
        stats=work,
        stopped=_ended_by(found),
        seen=Seen(query.graph, xy),
    )


def _ended_by(found: Sequence[Searched]) -> str:
    """Return why a search of one or more parts ended: an answer, a limit, or nothing left to try."""
    ends = {one.stopped for one in found}
    return next((end for end in ("accepted", "time", "work", "exhausted") if end in ends), "")


def _on(location: Location, index: ReferenceIndex) -> Location:
    """Name the reference of an answer."""
    return replace(location, reference=index.name, attribution=str(index.meta.get("attribution") or ""))


def _pool(found: Sequence[Searched], needed: float) -> list[Hyp]:
    """Return the places of all references, the best first; a place on overlapping parts occurs once.

    Leads compete: a place that leads its own map comes before all that do not. Those that do are ranked by likelihood.
    """
    pool = [place for one in found for place in one.compared]
    leading = _distinct([place for place in pool if place.score >= needed])
    return leading + _distinct([place for place in pool if place.score < needed], leading)


def _distinct(pool: Sequence[Hyp], known: Sequence[Hyp] = ()) -> list[Hyp]:
    """Return the places that are not known, the best first, each once; places of one search are different."""
    distinct = list(known)
    for place in sorted(pool, key=lambda one: (-one.explained, -one.score)):
        if not any(place.index is not other.index and place.same(other) for other in distinct):
            distinct.append(place)
    return distinct[len(known) :]


def _listed(found: Sequence[Searched], candidates: Sequence[Hyp]) -> list[Hyp]:
    """Return the places that an answer lists: the candidates, then others that were verified."""
    if not candidates:
        return []
    further = _distinct([place for one in found for place in one.places[1:]], candidates)
    return [*candidates, *further][:N_PLACES]


def _describe(location: Location, query: Query, listed: Sequence[Hyp], number: int, options: LocateOptions) -> Place:
    """Describe the listed place of this number, from 1, with its footprint; whole, if it may be taken."""
    one = listed[number - 1]
    corners = Homography(one.matrix @ PIXEL_TO_PLANE).everywhere(Frame(*query.scene.size).corners)
    plane, frame = one.index.plane, None
    ring = tuple((lon, lat) for lon, lat in to_lonlat(plane.crs, plane.to_crs(corners)).tolist())
    if options.take is not None and number <= options.take:
        frame = place_frame(_on(location, one.index), query, one, options.match)
    return replace(_seen_from(listed[0], one), footprint_lonlat=ring, frame=frame)


def _seen_from(best: Hyp, rival: Hyp) -> Place:
    """Return the middle of a rival in the CRS of the best place."""
    center = center_of(rival)
    if best.index.is_of_map(rival.index):
        return center
    plane = best.index.plane
    x, y = plane.to_crs(from_lonlat(plane, rival.lonlat[None]))[0]
    return replace(center, x=float(x), y=float(y))


def _against(best: Hyp, rivals: Sequence[Hyp], needed: float) -> Hyp:
    """Return a place with its lead over the places on all references that lead their own."""
    others = [one for one in rivals if one.index is not best.index and one.score >= needed]
    leads = [best.explained - one.explained for one in others]
    return best.but(score=min([best.score, *(lead / best.statement_px for lead in leads)]))


def _equal(best: Hyp, rivals: Sequence[Hyp], needed: float) -> Hyp | None:
    """Return a rival that makes the best place ambiguous, or None.

    If no place would be reported, that is a rival that agrees as well as the best place where streets repeat. Otherwise
    it is a rival without which the best place would be reported.
    """
    if best.score < needed:
        return next((one for one in rivals if _are_alike(best, one)), None)
    return next((one for one in rivals if _against(best, [one], needed).score < needed), None)


def _are_alike(best: Hyp, rival: Hyp) -> bool:
    """Return whether both places agree so well that only repeating streets explain it, whatever their scores."""
    return min(best.agreeing, rival.agreeing) >= _LIKE_THE_TRUTH


def _only_half(placed: Location) -> str:
    """Describe a place whose middle is uncertain by much of the frame; "" for a whole place."""
    error = placed.center_error
    if error is None or placed.gsd_m is None or placed.size is None:
        return ""
    side_m = placed.gsd_m * math.sqrt(placed.size[0] * placed.size[1])
    if error.along_m <= _MOST_UNSURE * side_m:
        return ""
    return (
        f"only half a place is known: the middle lies within +-{2.0 * error.along_m:.0f} m along "
        f"{error.azimuth_deg:.0f} degrees from north and +-{2.0 * error.across_m:.0f} m across (95 %), of a frame of "
        f"{side_m:.0f} m; roads in other directions would tell the rest"
    )


def _two_places(best: Hyp, rival: Hyp) -> str:
    on = ("", "")
    if best.index.name != rival.index.name:
        on = (f" on {best.index.name}", f" on {rival.index.name}")
    return (
        f"two places fit almost equally, for streets repeat there: {best.agreeing:.0%} agrees at one{on[0]}, "
        f"{rival.agreeing:.0%} at another{on[1]}"
    )


def _decide_pairs(location: Location, query: Query, found: Sequence[Searched], options: LocateOptions) -> Location:
    """Report the place that the paper's method found; the method has no scores."""
    best = next((one for one in found if one.places), None)
    if best is None:
        return _refuse(location, query, found, [], options)
    placed = place_frame(_on(location, best.index), query, best.places[0], options.match)
    return replace(placed, status="located", reason=best.said, reason_code=Reason.LOCATED)


# --- refusals ---------------------------------------------------------------------------------------------------------


def _refuse(
    location: Location, query: Query, found: Sequence[Searched], listed: Sequence[Hyp], options: LocateOptions
) -> Location:
    """Describe why nothing is reported, for the reference that came nearest."""
    nearest = next((one for one in found if listed and listed[0].index.is_of_map(one.index)), None)
    nearest = nearest or max(found, key=lambda one: one.n_tried)
    code, reason = _why_nothing(query, nearest, listed, options)
    location = replace(location, reason_code=code)
    distinct = dict.fromkeys(one.index.name for one in found)  # shards bear the name of their map
    if len(distinct) == 1:
        return replace(_on(location, nearest.index), reason=reason)
    names = ", ".join(distinct)
    owed = dict.fromkeys(_on(location, one.index).attribution for one in found)
    cut_short = {one.index.name for one in found if one.stopped != "exhausted"}
    done = f"{len(distinct) - len(cut_short)} of {len(distinct)} maps searched to the end"
    return replace(
        location,
        reference=names,
        attribution="; ".join(filter(None, owed)),
        reason=f"{reason} (looked on {names}; {done})",
    )


def _fits_elsewhere(location: Location, candidates: Sequence[Hyp], options: LocateOptions) -> Location:
    """Refuse what hints led to: the first of the candidates, which they exclude, explains more."""
    better, *told = candidates
    away_m = better.apart_m(told[0]) if told else None
    ways = broken_hints(better, options)
    where = "elsewhere" if away_m is None else _away(away_m)
    reason = f"the roads fit better {where}, {', and '.join(ways)}" if ways else f"the roads fit better {where}"
    return replace(_on(location, better.index), reason=reason, reason_code=Reason.FITS_ELSEWHERE)


def _away(away_m: float) -> str:
    """Say how far, in metres or kilometres."""
    return f"{away_m:.0f} m away" if away_m < 1000.0 else f"{away_m / 1000.0:.1f} km away"


def _why_nothing(query: Query, found: Searched, listed: Sequence[Hyp], options: LocateOptions) -> tuple[Reason, str]:
    """Return why nothing is reported, as a code and as a sentence with the remedy."""
    if len(query.scene.intersections) == 0:
        return Reason.FEW_INTERSECTIONS, "no intersections are seen, at least 1 is needed"
    if found.said:
        return Reason.TIME_LIMIT if found.stopped in ("work", "time") else Reason.NOTHING_STANDS_OUT, found.said
    searched = searched_within(options)
    if found.n_searched == 0 and (options.near is not None or options.match.within is not None):
        given = "around the place given by near" if options.near is not None else "in the area given by within"
        return Reason.FEW_NEAR, f"the map has {counted(found.n_searched, 'intersection')} {given}{searched}"
    score = listed[0].score if listed else -math.inf
    best = _lead(score, options.min_log10_odds) if math.isfinite(score) else "none fits"
    if found.stopped == "work":
        told = f"stopped after as much work as a search may take; of the places tried, {best}{searched}"
        return Reason.TIME_LIMIT, f"{told}; {_how_far(query, found, options)}"
    if found.stopped == "time":
        limit, tracing_s = options.search.time_limit_s, query.seconds.vectorize
        tracing = f", of which tracing the mask took {tracing_s:.1f} s" if tracing_s > limit / 4 else ""
        stopped = f"stopped at the time limit of {limit:g} s{tracing}, {_CUT_SHORT}"
        told = f"{stopped}; of the places tried, {best}{searched}; {_how_far(query, found, options)}"
        return Reason.TIME_LIMIT, told
    return (
        Reason.NOTHING_STANDS_OUT,
        f"no place on this map stands out: {best}{searched}; {_what_may_help(query, listed, options)}",
    )


def _what_may_help(query: Query, listed: Sequence[Hyp], options: LocateOptions) -> str:
    """List what may decide: more to see, and the missing hints, with the number of listed places that each leaves."""
    camera, usual = options.match.camera, CameraOptions()
    views = [pose(one.matrix, query.scene.size) for one in listed]
    turned = [abs((view.rotation_deg - views[0].rotation_deg + 180.0) % 360.0 - 180.0) for view in views]
    scaled = [abs(math.log(view.gsd_m / views[0].gsd_m)) for view in views]
    away = [listed[0].apart_m(one) for one in listed]
    place_lacks = options.near is None and options.match.within is None
    hints = (
        (camera.gsd_m == usual.gsd_m, "the size of a pixel", "5 %", "(--gsd)", scaled, math.log(1.05)),
        (camera.heading is None, "the heading", "5 degrees", "(--heading)", turned, 5.0),
        (place_lacks, "the place", "200 m", "(--near)", away, 200.0),
    )
    helps = []
    for lacks, name, precision, option, apart, most in hints:
        left = f"{sum(gap <= most for gap in apart)} of {len(listed)} places"
        known = f"{name} to {precision} {option} would leave {left}" if len(listed) > 1 else f"{name} {option}"
        helps += [known] * lacks
    helps += ["a search with full effort"] * (options.effort == "quick")
    return f"{', '.join([*helps, 'more roads in view'])} or another map may help"


def _lead(score: float, needed: float) -> str:
    """Describe how far the best place leads."""
    if score < 0.2:
        return "another fits as well as the best"
    return f"the best has a score of {math.floor(10.0 * score) / 10.0:g}, {needed:g} is asked for"


def _how_far(query: Query, found: Searched, options: LocateOptions) -> str:
    """Describe the progress of a search that was cut short, and hints that would shorten it."""
    far = f"{found.n_anchors} of {len(query.scene.intersections)} intersections had been looked for"
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


# --- where the frame lies on Earth, and how it was seen ---------------------------------------------------------------


def place_frame(location: Location, query: Query, fit: Hyp, options: MatchOptions) -> Location:
    """Fill in everything that follows from a fit's homography and its matches."""
    # The corners and the middle in the map's CRS.
    plane, scene = fit.index.plane, query.scene
    frame = Frame(*scene.size)
    level = _level(fit, query)
    homography = plane.to_crs_matrix() @ level.matrix @ PIXEL_TO_PLANE
    ground = Homography(homography).everywhere(np.vstack([frame.corners, frame.center]))
    lonlat = to_lonlat(plane.crs, ground)
    # The view of the camera, and the intersections that support it.
    focal_px = options.camera.focal_px
    camera = pose(level.matrix, scene.size, focal_px)
    north = grid_north(plane, ground[4])
    chosen = fit.matched >= 0
    reference_xy = plane.to_crs(fit.index.xy[fit.matched[chosen]])
    # The camera's covariance comes from all eight parameters: the pose of a camera that looks straight down has six.
    seat = _find_camera(fit, level.matrix, scene.size, focal_px, north)
    odds = 0.0 if math.isnan(fit.score) else fit.score
    return replace(
        location,
        crs=plane.crs,
        homography=homography / homography[2, 2],
        footprint=ground[:4],
        footprint_lonlat=lonlat[:4],
        center=_place(ground[4], lonlat[4], odds),
        fitted="homography" if level is fit else "similarity",
        lens_k1=fit.lens_k1,
        corner_sigma_m=None if level.covariance is None else corner_sigmas(level.covariance),
        corner_covariance_m2=level.covariance,
        lonlat_accuracy_m=exactness(plane.crs, LONLAT, lonlat[4].tolist()).sigma_m,
        gsd_m=camera.gsd_m,
        rotation_deg=(camera.rotation_deg + north + 180.0) % 360.0 - 180.0,
        tilt_deg=camera.tilt_deg if seat is None else seat.tilt_deg,
        tilt_source=camera.source if seat is None else seat.source,
        n_matched=int(chosen.sum()),
        inlier_ratio=float(chosen.mean()),
        log10_odds=None if math.isnan(fit.score) else fit.score,
        camera=seat,
        evidence=Evidence(query.graph, scene.intersections.xy[chosen], reference_xy, fit.matches[1][chosen]),
    )


def _level(fit: Hyp, query: Query) -> Hyp:
    """Return a fit restricted to a camera that looks straight down, unless the roads are inconsistent with it."""
    if fit.refined is None or fit.lens_k1:
        return fit
    scene = query.scene
    found = find_similarity(fit.matrix, scene.corners, fit.refined.corner_covariance_m2)
    if found is None:
        return fit
    matrix, covariance = found.matrix, found.corner_covariance + found.doubt
    # The covariance may be too large. Roads that agreed must still agree.
    sigmas = corner_sigmas(covariance)
    refined = replace(fit.refined, matrix=matrix, corner_covariance_m2=covariance, corner_sigma_m=sigmas)
    level = replace(fit, matrix=matrix, refined=refined)
    return level if level.agreement.forward >= fit.agreement.forward - _LEAST_LOST else fit


def _find_camera(
    fit: Hyp, matrix: FloatArray, size: tuple[int, int], focal_px: float | None, north: float
) -> Camera | None:
    """Return the camera of a fit's `matrix`, levelled or not.

    `north` is the direction of the plane's y axis from true north.
    """
    if fit.covariance is None:
        return None
    found = find_pose(matrix @ PIXEL_TO_PLANE, size, fit.covariance, focal_px)
    if found is None:
        return None
    plane, rotation = fit.index.plane, turned(found.rotation, -north)
    x, y = plane.to_crs(found.position[:2]).tolist()
    lon, lat = to_lonlat(plane.crs, np.array([[x, y]]))[0].tolist()
    heading, pitch, roll = replace(found, rotation=rotation).angles_deg.tolist()
    height = float(found.position[2])
    lens = (found.focal_px, found.focal_sigma_px, found.source)
    return Camera(x, y, lon, lat, height, heading, pitch, roll, *lens, found.covariance, rotation)


def center_of(place: Hyp) -> Place:
    """Return the middle of the frame as a place."""
    return _place(place.index.plane.to_crs(place.center), place.lonlat, place.score)


def _place(xy: FloatArray, lonlat: FloatArray, log10_odds: float) -> Place:
    return Place(float(xy[0]), float(xy[1]), float(lonlat[0]), float(lonlat[1]), log10_odds)
