"""The second straight line: a mask to a place on a reference (the first is `references`)."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, FloatArray, IntArray
from roadgeo.errors import RoadSourceError
from roadgeo.geometry.camera import CameraOptions, pose
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.mask import PIXEL_TO_PLANE, RoadMask
from roadgeo.geometry.projection import LocalPlane
from roadgeo.location import Evidence, Location, Place, Seconds, Seen, Stats
from roadgeo.matching.estimator import Hypothesis, MatchOptions, TripleEstimator
from roadgeo.matching.explanation import Explanation, Needed, Story, WatchedEstimator, tell
from roadgeo.matching.index import ReferenceIndex, crop, unpack_tangents
from roadgeo.matching.paper import PairIndex, PairOptions, build_pair_index, match_pairs
from roadgeo.matching.query import QueryOptions, trace_query
from roadgeo.matching.scene import Scene
from roadgeo.matching.search import SearchOptions, SearchResult, search
from roadgeo.reference.reference import Reference
from roadgeo.roads.graph import RoadGraph
from roadgeo.roads.intersections import Intersections

__all__ = ["LocateOptions", "explain", "locate"]


@dataclass(frozen=True)
class LocateOptions:
    """Options of all stages of locating a mask.

    Attributes
    ----------
    method : "auto" or "pair"
        Triples of intersections, or the paper's pairs.
    near : (lon, lat, radius in metres) or None
        The middle of the frame is known to lie there.
    min_log10_odds : float
        Places with less are not reported as located.
    min_margin : float
        Log10 odds by which the best place must lead any other; otherwise the answer is "ambiguous".
    min_intersections : int
        Masks with fewer are not searched.
    """

    method: Literal["auto", "pair"] = "auto"
    near: tuple[float, float, float] | None = None
    min_log10_odds: float = 3.5
    min_margin: float = 2.0
    min_intersections: int = 6
    query: QueryOptions = field(default_factory=QueryOptions)
    match: MatchOptions = field(default_factory=MatchOptions)
    search: SearchOptions = field(default_factory=SearchOptions)
    pair: PairOptions = field(default_factory=PairOptions)


def locate(
    mask: RoadMask | AnyArray | str | Path,
    reference: Reference | Sequence[Reference],
    options: LocateOptions | None = None,
) -> Location:
    """Find where a road mask lies on one of the references.

    Pure: no file is written. A mask that is not found is a `Location` with a reason, not an error.

    Raises
    ------
    MaskError
        The mask cannot be read or shows no roads.
    """
    options = options or LocateOptions()
    return _search_all(_read_query(mask, options), reference, options)


def explain(
    mask: RoadMask | AnyArray | str | Path,
    reference: Reference | Sequence[Reference],
    options: LocateOptions | None = None,
) -> Explanation:
    """Locate a mask as `locate` does, and tell how far the search got, what it rejected and what was missing.

    Raises
    ------
    MaskError
        The mask cannot be read or shows no roads.
    """
    options = options or LocateOptions()
    query = _read_query(mask, options)
    stories: list[Story] = []
    location = _search_all(query, reference, options, stories)
    return Explanation(location, query.scene, query.graph, tuple(stories))


@dataclass(frozen=True)
class _Query:
    """A mask that was read and traced."""

    name: str
    scene: Scene
    graph: RoadGraph
    seconds: Seconds


def _read_query(mask: RoadMask | AnyArray | str | Path, options: LocateOptions) -> _Query:
    _rehearse_tracing()
    started = time.perf_counter()
    road_mask = _as_mask(mask)
    read = time.perf_counter()
    scene, graph = trace_query(road_mask, options.query)
    return _Query(road_mask.name, scene, graph, Seconds(read=read - started, vectorize=time.perf_counter() - read))


def _search_all(
    query: _Query,
    reference: Reference | Sequence[Reference],
    options: LocateOptions,
    stories: list[Story] | None = None,
) -> Location:
    """Search one reference after another within the time limit, and return the best answer."""
    references = [reference] if isinstance(reference, Reference) else list(reference)
    if not references:
        raise RoadSourceError("no reference to search: build one with `roadgeo index`")
    left = options.search.time_limit_s - query.seconds.vectorize
    found: list[Location] = []
    for one in references:
        share = max(left, 0.0) / (len(references) - len(found))
        found.append(_locate_on(query, one.index, options, share, stories))
        left -= found[-1].seconds.match + found[-1].seconds.refine
    return _best_of(found, options)


def _as_mask(mask: RoadMask | AnyArray | str | Path) -> RoadMask:
    if isinstance(mask, RoadMask):
        return mask
    from roadgeo.sources.masks import read_mask

    return read_mask(mask)


@lru_cache(maxsize=1)
def _rehearse_tracing() -> None:
    """Compile or load the kernels that trace a mask, once a process, before a time limit counts."""
    canvas = np.zeros((160, 160), np.uint8)
    for k in range(11):  # crossings, forks, near parallels: each kernel has its turn
        cv2.line(canvas, (7, 3 + 15 * k), (150, 97 * k % 160), 1, 3)
    trace_query(RoadMask(canvas > 0))


_rehearsed = False


def _rehearse_once(estimator: TripleEstimator) -> None:
    """Compile or load the kernels, once a process, before a time limit counts."""
    global _rehearsed
    if not _rehearsed:
        estimator.rehearse()
        _rehearsed = True


def _locate_on(
    query: _Query, index: ReferenceIndex, options: LocateOptions, time_limit_s: float, stories: list[Story] | None
) -> Location:
    """Match, judge and describe one query on one reference; `time_limit_s` is what is left for that."""
    scene, graph, seconds = query.scene, query.graph, query.seconds
    n = len(scene.intersections)
    seen = Seen(graph, scene.intersections.xy)
    location = Location(
        query.name,
        "not_located",
        "",
        index.name,
        str(index.meta.get("attribution") or ""),
        size=scene.size,
        n_intersections=n,
        seconds=seconds,
        seen=seen,
    )
    needed = Needed(options.min_log10_odds, options.min_margin, options.min_intersections)

    def tell_at_once(location: Location) -> Location:
        if stories is not None:
            stories.append(tell(location, scene, index, needed))
        return location

    if n < needed.intersections:
        reason = f"only {n} intersections are seen, at least {needed.intersections} are needed"
        return tell_at_once(replace(location, reason=reason))
    if options.method == "pair":
        return tell_at_once(_locate_by_pairs(location, scene, graph, index, options, time_limit_s))
    near, started = _near(index, options.near), time.perf_counter()
    if near is not None:
        index = _part(index, near[:2], near[2] + 2.0 * scene.half_size * options.match.camera.gsd_m[1])
        if len(index) < needed.intersections:
            few = f"the map has {len(index)} intersections around the place given by near{_searched(options)}"
            return tell_at_once(replace(location, reason=few))
    cropping_s = time.perf_counter() - started
    watch = TripleEstimator if stories is None else WatchedEstimator
    estimator = watch(scene, index, _match_options(options), near)
    _rehearse_once(estimator)
    started = time.perf_counter() - cropping_s
    result = search(estimator, replace(options.search, time_limit_s=time_limit_s - cropping_s))
    stats = Stats(estimator.n_tuples, estimator.n_candidates, estimator.n_hypotheses, estimator.n_verified)
    seconds = replace(seconds, match=time.perf_counter() - started - estimator.refine_s, refine=estimator.refine_s)
    location = replace(location, seconds=seconds, stats=stats)
    location = _describe(location, scene, graph, index, result, estimator, options)
    if stories is not None and isinstance(estimator, WatchedEstimator):
        stories.append(tell(location, scene, index, needed, estimator, result))
    return location


def _match_options(options: LocateOptions) -> MatchOptions:
    """Call every place promising that may be reported, or come within the margin of one that is."""
    least = options.min_log10_odds - options.min_margin
    verify = replace(options.match.verify, promising=min(options.match.verify.promising, least))
    return replace(options.match, verify=verify)


@lru_cache(maxsize=4)
def _part(index: ReferenceIndex, center: tuple[float, float], radius_m: float) -> ReferenceIndex:
    """Crop a reference to a circle, unless it hardly reaches beyond: made once for a batch."""
    inside = np.hypot(*(index.xy - center).T) <= radius_m
    return crop(index, center, radius_m) if inside.mean() < 0.7 else index


@lru_cache(maxsize=4)
def _pair_index(index: ReferenceIndex, options: PairOptions) -> tuple[Intersections, PairIndex]:
    """Build the paper's tables for a reference: too large to store with it, kept for a batch."""
    n = len(index)
    vectors = index.branches.astype(np.float32)
    rays = np.where(vectors.any(axis=2), np.arctan2(vectors[..., 1], vectors[..., 0]), np.nan)
    found = Intersections(index.xy, rays, unpack_tangents(index.tangents), np.zeros(n, np.float32), np.arange(n))
    return found, build_pair_index(found, options)


def _locate_by_pairs(
    location: Location,
    scene: Scene,
    graph: RoadGraph,
    index: ReferenceIndex,
    options: LocateOptions,
    time_limit_s: float,
) -> Location:
    """Run the paper's method: what it finds is reported as found, with no odds, for it knows none."""
    reference, table = _pair_index(index, options.pair)
    pair = replace(options.pair, time_limit_s=time_limit_s)
    match = match_pairs(scene.intersections, reference, table, scene.corners, pair)
    location = replace(
        location,
        reason=match.reason,
        seconds=replace(location.seconds, match=match.seconds),
        stats=Stats(match.n_samples, match.candidates, match.hypotheses, match.hypotheses),
    )
    if match.homography is None:
        return location
    matched = np.full(len(scene.intersections), -1, np.int64)
    matched[match.matches[:, 0]] = match.matches[:, 1]
    chosen = matched >= 0
    gap = Homography(match.homography)(scene.intersections.xy[chosen]) - index.xy[matched[chosen]]
    distance = np.zeros(len(matched))
    distance[chosen] = np.hypot(*gap.T)
    placed = place_scene(location, scene, graph, index, match.homography, matched, distance)
    center = replace(placed.center, log10_odds=0.0) if placed.center else None
    return replace(placed, status="located", center=center, inlier_ratio=match.inlier_ratio)


def _near(index: ReferenceIndex, near: tuple[float, float, float] | None) -> tuple[float, float, float] | None:
    """Take (lon, lat, radius) to the plane."""
    if near is None:
        return None
    from roadgeo.geometry.projection import from_lonlat

    x, y = from_lonlat(index.plane, np.array([near[:2]]))[0]
    return float(x), float(y), near[2]


def _describe(
    location: Location,
    scene: Scene,
    graph: RoadGraph,
    index: ReferenceIndex,
    result: SearchResult[Hypothesis],
    estimator: TripleEstimator,
    options: LocateOptions,
) -> Location:
    """Turn the search's result into a `Location`: located, ambiguous, or refused with a reason."""
    best = result.best
    if best is None or best.refined is None or best.found is None or result.score < options.min_log10_odds:
        return replace(location, reason=_refusal(result, options, location.seconds.vectorize))
    lead = result.score - max(result.runner_up_score, -99.0)
    runner_up = None
    if result.runner_up is not None and math.isfinite(result.runner_up_score):
        runner_up = _place(index.plane, estimator.center(result.runner_up), result.runner_up_score)
    placed = place_scene(location, scene, graph, index, best.refined.matrix, best.matched, best.distance)
    placed = replace(
        placed,
        center=replace(placed.center, log10_odds=result.score) if placed.center else None,
        corner_sigma_m=best.refined.corner_sigma_m,
        log10_odds=result.score,
        runner_up=runner_up,
    )
    if lead < options.min_margin:
        reason = f"two places fit almost equally: log10 odds {result.score:.1f} and {result.runner_up_score:.1f}"
        return replace(placed, status="ambiguous", reason=reason)
    seen = (
        f"{placed.n_matched} of {placed.n_intersections} intersections and {best.found.forward:.0%} of the roads agree"
    )
    reason = f"{seen}; odds 10^{result.score:.1f} against chance"
    return replace(placed, status="located", reason=reason)


def _refusal(result: SearchResult[Hypothesis], options: LocateOptions, tracing_s: float) -> str:
    """Say why nothing is reported, and what may help."""
    needed, searched = options.min_log10_odds, _searched(options)
    if math.isfinite(result.score):
        best = f"the best has log10 odds {result.score:.1f}, {needed:g} are needed"
    else:
        best = "none passed the tests"
    if result.stopped == "time":
        limit = options.search.time_limit_s
        tracing = f", of which tracing the mask took {tracing_s:.1f} s" if tracing_s > limit / 4 else ""
        return f"stopped at the time limit of {limit:g} s{tracing}; of the places tried, {best}{searched}"
    nothing = f"no place on this map stands out: {best}{searched}"
    if searched:
        return f"{nothing}: more roads in view or a wider search may help"
    return f"{nothing}; more roads in view or another map may help"


def _searched(options: LocateOptions) -> str:
    """Name the limits that the search was given, to end a sentence; "" for none."""
    camera, usual = options.match.camera, CameraOptions()
    limits = []
    if options.near is not None:
        lon, lat, radius = options.near
        reach = f"{radius:g} m" if radius < 1000 else f"{radius / 1000:g} km"
        limits.append(f"within {reach} of {lon:.9g},{lat:.9g}")
    if camera.gsd_m != usual.gsd_m:
        limits.append(f"at {camera.gsd_m[0]:g} to {camera.gsd_m[1]:g} m per pixel")
    if camera.max_tilt_deg != usual.max_tilt_deg:
        limits.append(f"tilted by up to {camera.max_tilt_deg:g} degrees")
    if camera.north_up:
        limits.append("north up")
    if camera.focal_px is not None:
        limits.append(f"with a focal length of {camera.focal_px:.5g} pixels")
    return f"; searched {', '.join(limits)}" if limits else ""


def place_scene(
    location: Location,
    scene: Scene,
    graph: RoadGraph,
    index: ReferenceIndex,
    matrix: FloatArray,
    matched: IntArray,
    distance: FloatArray | None,
) -> Location:
    """Fill in everything that follows from a homography (query plane to reference plane) and its matches."""
    from roadgeo.geometry.projection import grid_north, to_lonlat

    plane = index.plane
    homography = plane.to_crs_matrix() @ matrix @ PIXEL_TO_PLANE
    width, height = scene.size
    pixels = np.array([[0, 0, 1], [width, 0, 1], [width, height, 1], [0, height, 1], [width / 2, height / 2, 1]], float)
    ground = pixels @ homography.T
    ground = ground[:, :2] / ground[:, 2:]
    lonlat = to_lonlat(plane.crs, ground)
    camera = pose(matrix, scene.size)
    north = grid_north(plane, ground[4])
    chosen = matched >= 0
    residual = np.zeros(int(chosen.sum())) if distance is None else distance[chosen]
    return replace(
        location,
        crs=plane.crs,
        homography=homography / homography[2, 2],
        footprint=ground[:4],
        footprint_lonlat=lonlat[:4],
        center=Place(float(ground[4, 0]), float(ground[4, 1]), float(lonlat[4, 0]), float(lonlat[4, 1]), math.nan),
        gsd_m=camera.gsd_m,
        rotation_deg=(camera.rotation_deg + north + 180.0) % 360.0 - 180.0,
        tilt_deg=camera.tilt_deg,
        tilt_source="homography",
        n_matched=int(chosen.sum()),
        inlier_ratio=float(chosen.mean()),
        evidence=Evidence(graph, scene.intersections.xy[chosen], plane.to_crs(index.xy[matched[chosen]]), residual),
    )


def _place(plane: LocalPlane, xy: FloatArray, log10_odds: float) -> Place:
    from roadgeo.geometry.projection import to_lonlat

    ground = plane.to_crs(xy[None])
    lonlat = to_lonlat(plane.crs, ground)
    return Place(float(ground[0, 0]), float(ground[0, 1]), float(lonlat[0, 0]), float(lonlat[0, 1]), log10_odds)


def _best_of(found: Sequence[Location], options: LocateOptions) -> Location:
    """Return the best answer of several references; two places far apart that are almost equally sure are ambiguous."""
    rank = {"located": 2, "ambiguous": 1, "not_located": 0}
    ranked = sorted(found, key=lambda one: (-rank[one.status], -(one.log10_odds or -math.inf)))
    best = ranked[0]
    seconds = replace(
        best.seconds,
        match=sum(one.seconds.match for one in found),
        refine=sum(one.seconds.refine for one in found),
    )
    if best.status == "not_located" and len(found) > 1:
        names = ", ".join(one.reference for one in found)
        owed = "; ".join(dict.fromkeys(one.attribution for one in found if one.attribution))
        reason = f"{best.reason} (looked on {names})"
        return replace(best, seconds=seconds, reference=names, attribution=owed, reason=reason)
    rivals = [one for one in ranked[1:] if one.status == "located" and _far_apart(one, best)]
    if (
        rivals
        and best.status == "located"
        and (best.log10_odds or 0.0) - (rivals[0].log10_odds or 0.0) < options.min_margin
    ):
        rival = rivals[0]
        reason = (
            f"two places fit almost equally: log10 odds {best.log10_odds:.1f} on {best.reference} and "
            f"{rival.log10_odds:.1f} on {rival.reference}"
        )
        return replace(best, status="ambiguous", reason=reason, runner_up=rival.center, seconds=seconds)
    return replace(best, seconds=seconds)


def _far_apart(a: Location, b: Location) -> bool:
    """Whether two locations on different maps mean different places: their middles are more than half a frame apart."""
    if a.center is None or b.center is None or b.gsd_m is None or b.size is None:
        return False
    east = math.radians(a.center.lon - b.center.lon) * math.cos(math.radians(b.center.lat))
    north = math.radians(a.center.lat - b.center.lat)
    return 6.371e6 * math.hypot(east, north) > 0.5 * b.gsd_m * max(b.size)
