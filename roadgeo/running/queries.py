"""The input of a search: a mask, a soft map of roads, a photograph, or several looks at one scene.

A photograph is recognised and its roads are segmented; the probability of road is kept, and looked at with several
thresholds and, where the size of a pixel is unknown, at several scales (`looks`).
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import Literal

import numpy as np

from roadgeo._arrays import AnyArray
from roadgeo._progress import Say, say_nothing
from roadgeo.errors import MaskError, PhotographError, PluginError
from roadgeo.geometry.camera import CameraOptions
from roadgeo.geometry.mask import RoadMask
from roadgeo.location import Location, Reason
from roadgeo.matching.options import LocateOptions
from roadgeo.plugins import SEGMENTERS, call_plugin
from roadgeo.reference.reference import AnyReference
from roadgeo.roads.thresholds import spread_probability
from roadgeo.running.looks import Later, Locate, Look, Sighting, locate_looks
from roadgeo.running.mirroring import ask_mirrored
from roadgeo.running.pictures import as_file
from roadgeo.running.regridding import of_own_pixels, on_grid
from roadgeo.running.stretching import ask_stretched
from roadgeo.sources.drawn_roads import Units, draw_roads
from roadgeo.sources.exif import estimate_gsd
from roadgeo.sources.masks import open_mask, read_mask
from roadgeo.sources.segmentation.network import DEFAULT_MODEL, Network, load_network
from roadgeo.sources.segmentation.photograph import open_photograph
from roadgeo.sources.segmentation.probability import NODATA, ProbabilityMap, fuse
from roadgeo.sources.segmentation.scales import rank_scales, scale_of, try_scales
from roadgeo.sources.segmentation.tiling import MAX_MAP_PIXELS, map_shape, segment
from roadgeo.sources.streams import QUERY_ENDINGS
from roadgeo.workflows import locate

__all__ = ["FirstLook", "QueryOptions", "is_model", "load_model", "locate_query", "look_once"]

#: The mask of a larger photograph is reduced, so that time and memory are bounded.
_MAX_GRID_PIXELS = 64_000_000
_MAX_SCALES = 3
#: Roads of a photograph whose pixels are coarser than a model's are traced on the model's, but at most this many
#: times its own along a side: narrow gaps between roads close on coarse ones.
_MOST_FINER, _LEAST_FINER = 2.0, 1.25
#: Name in results of a picture that is no file.
_ARRAY = "array"
#: In a second way a model is shown a photograph twice as fine, a step of the scales that are tried blind, and the mean
#: of the log odds counts. Of labelled tiles of Boston and Miami F1 within 4 m is .914 and .867 at 1 m per pixel, .950
#: and .869 at 0.5 m, .949 and .892 of both (turned by half instead: .923 and .878). Where its pixels are not as fine it
#: is turned by half.
_FINER, _WAYS, _ENLARGED = 2.0, 2, 1.1
_MANY_PIXELS = 4_000_000  # shown to a model in one way first: so large a scene is mostly located by that
_KNOWN_SPAN = 1.7  # a range of pixel sizes narrower than this is one scale


@dataclass(frozen=True)
class QueryOptions:
    """How what is given is read.

    Attributes
    ----------
    threshold : float or None
        Values of a mask, or probabilities, above it are road. Default: by the histogram of the values.
    band : int or None
        The band that holds a mask, counted from 1.
    segment : "auto", "always" or "never"
        Whether photographs are recognised, everything is taken for one, or nothing.
    segmenters : tuple of str
        Plugins, and files of models (.onnx); several are fused. None: the model that ships.
    class_name : str or None
        The class of a model that is road. Default: by the names of its classes.
    fused_with : tuple of str
        Further looks at the same frame, fused with each query.
    threads : int
        Of a model; fixed, so that results are the same on every run.
    mirror : "tell", "never" or "allow"
        For a refused mask that would be located turned over: whether that is mentioned, not tried, or the answer.
    units : "auto", "pixels" or "metres"
        Of roads that come as lines (see `sources.drawn_roads`).
    layer : str or None
        Of a file of such roads that has several.
    aspect : float, "unknown" or None
        How many times a pixel of a mask is as wide as high; None: once.
    bands : (3,) tuple of int, or None
        The red, green and blue band of a photograph, counted from 1. Default: by their names, or the first three.
    """

    threshold: float | None = None
    band: int | None = None
    segment: Literal["auto", "always", "never"] = "auto"
    segmenters: tuple[str, ...] = ()
    class_name: str | None = None
    fused_with: tuple[str, ...] = ()
    threads: int = 1
    mirror: Literal["tell", "never", "allow"] = "tell"
    units: Units = "auto"
    layer: str | None = None
    aspect: float | Literal["unknown"] | None = None
    bands: tuple[int, int, int] | None = None

    @property
    def may_be_mask(self) -> bool:
        """Whether it is looked for a mask first; plugins are shown all that is given."""
        return self.segment == "never" or (self.segment == "auto" and all(map(is_model, self.segmenters)))


def locate_query(
    path: str | AnyArray,
    references: Sequence[AnyReference],
    options: LocateOptions | None = None,
    query: QueryOptions | None = None,
    *,
    how: Locate = locate,
    say: Say = say_nothing,
) -> Sighting:
    """Locate a mask or a photograph; an array, (H, W) or (H, W, bands), is a mask.

    Raises
    ------
    MaskError
        It cannot be read, or is a mask without roads.
    ModelError
        There is no model, or it cannot be run.
    PluginError
        A segmenter fails.
    """
    options, query = options or LocateOptions(), query or QueryOptions()
    if isinstance(path, str) and path.lower().endswith(QUERY_ENDINGS):
        return _locate_lines(path, references, options, query, how)
    if query.may_be_mask and not query.fused_with:
        try:
            sighting = _locate_mask(path, references, options, query, how)
            if query.aspect is not None:
                return ask_stretched(sighting, references, options, query.aspect)
            asked = query.mirror != "never"
            return ask_mirrored(sighting, references, options, query.mirror == "allow") if asked else sighting
        except PhotographError:
            if query.segment == "never":
                raise
    with as_file(path) as file:
        sighting = _locate_photograph((file, *query.fused_with), references, options, query, how, say)
        if not isinstance(path, str):
            location = sighting.location
            told = location.reason.replace(file, _ARRAY)
            sighting = replace(sighting, location=replace(location, query=_ARRAY, reason=told))
    return replace(sighting, of_photograph=True)


@dataclass(frozen=True)
class FirstLook:
    """The roads seen in a query before it is compared with any map.

    Attributes
    ----------
    mask : RoadMask
        Its roads, on the grid that they are traced on; of a photograph there may be none.
    coarser : float
        Pixels of the query for each of the mask, along a side: above 1 for a large photograph, below for a coarse one.
    probability : ProbabilityMap or None
        Of a photograph, in its own pixels (those of its mask, where it is large).
    """

    mask: RoadMask
    coarser: float = 1.0
    probability: ProbabilityMap | None = None


def look_once(
    path: str | AnyArray, gsd_m: tuple[float, float] | None, query: QueryOptions, say: Say = say_nothing
) -> FirstLook:
    """Read a mask, or find the roads of a photograph, as `locate_query` does, in as many ways as the model's card asks.

    Parameters
    ----------
    path : str, or (H, W) or (H, W, bands) array
    gsd_m : (2,) or None
        Metres per pixel, if known: photographs are shown to the model at its own.

    Raises
    ------
    MaskError, ModelError, PluginError
        As of `locate_query`.
    """
    if query.may_be_mask:
        try:
            with open_mask(path, band=query.band, threshold=query.threshold) as opened:
                return FirstLook(opened.read(opened.thresholds[0]))
        except PhotographError:
            if query.segment == "never":
                raise
    with as_file(path) as file:
        return _look_at_photograph(file, gsd_m, query, say)


def _look_at_photograph(path: str, gsd_m: tuple[float, float] | None, query: QueryOptions, say: Say) -> FirstLook:
    plugin = _only_plugin(query)
    if plugin:
        return FirstLook(_call_segmenter(plugin, path, query.threshold))
    camera = CameraOptions() if gsd_m is None else CameraOptions(gsd_m=gsd_m)
    frame = _open_frame([path], query, camera, say)
    seen = frame.see(frame.scales[0], None)
    try:
        mask = _look_at(lambda: seen, frame.scales[0], query).make()
    except MaskError:  # the roads seen are worth a look all the same
        mask = RoadMask(np.zeros(seen.values.shape, np.bool_), name=path)
    return FirstLook(mask, frame.coarser, seen.resized(frame.own))


def is_model(segmenter: str) -> bool:
    """Whether a segmenter is the file of a model, not the name of a plugin."""
    return segmenter.lower().endswith(".onnx")


def _locate_lines(
    path: str, references: Sequence[AnyReference], options: LocateOptions, query: QueryOptions, how: Locate
) -> Sighting:
    """Locate roads given as lines; their units restrict scale and north unless the user gives narrower limits."""
    drawing, camera = draw_roads(path, query.units, query.layer), options.match.camera
    if drawing.unit_m is not None and camera.gsd_m == CameraOptions().gsd_m:
        known = (drawing.unit_m / 1.05, drawing.unit_m * 1.05)
        tilt = min(camera.max_tilt_deg, 10.0)  # they were measured on the ground, or on a map
        camera = replace(camera, gsd_m=known, max_tilt_deg=tilt, north_up=camera.north_up or drawing.north_up)
    options = replace(options, match=replace(options.match, camera=camera))
    sighting = locate_looks([Look("its lines", lambda: drawing.mask)], references, options, how)
    sighting = ask_mirrored(sighting, references, options, query.mirror == "allow")
    return replace(sighting, location=replace(sighting.location, query_to_pixel=drawing.to_pixel))


def _locate_mask(
    path: str | AnyArray, references: Sequence[AnyReference], options: LocateOptions, query: QueryOptions, how: Locate
) -> Sighting:
    """Locate a mask, or a soft map of roads at the thresholds that its values suggest."""
    with open_mask(path, band=query.band, threshold=query.threshold) as opened:

        def look(threshold: float) -> Look:
            return Look(f"threshold {threshold:.3g}", lambda: opened.read(threshold))

        return locate_looks([look(threshold) for threshold in opened.thresholds], references, options, how)


def _locate_photograph(
    paths: Sequence[str],
    references: Sequence[AnyReference],
    options: LocateOptions,
    query: QueryOptions,
    how: Locate,
    say: Say,
) -> Sighting:
    """Segment a photograph, or several of one frame, and locate what is seen."""
    plugin = _only_plugin(query)
    if plugin and len(paths) == 1:
        mask = _call_segmenter(plugin, paths[0], query.threshold)
        return locate_looks([Look("the segmenter's own threshold", lambda: mask)], references, options, how)
    frame = _open_frame(paths, query, options.match.camera, say)
    own, options = frame.own, _on_grid(options, frame.coarser)
    try:
        return _of_own_pixels(locate_looks(_plan_looks(frame, query), references, options, how), own)
    except MaskError as error:
        where = ", ".join(one.name for one in references)
        reason = f"hardly a road is seen in the photograph ({error})"
        location = Location(paths[0], "not_located", reason, where, size=(own[1], own[0]), reason_code=Reason.FEW_ROADS)
        seen = frame.see(frame.scales[0], frame.most_ways).resized(own)
        return Sighting(location, RoadMask(np.zeros(own, np.bool_), name=paths[0]), probability=seen)


def _plan_looks(frame: _Frame, query: QueryOptions) -> Later[Look]:
    """Return the best scale's look, the photograph in more ways, other scales, and a lower threshold at the best.

    Where one scale is known, what was shown at two scales together is looked at alone, too.
    """

    def look(i: int, ways: int | None = None, further: int = 0) -> Look:
        return _look_at(partial(frame.see, frame.scales[i], ways), frame.scales[i], query, further)

    def look_more_ways() -> Look:
        one = look(0, frame.most_ways)
        return replace(one, what=f"{one.what}, shown {frame.most_ways} ways")

    def look_alone(scale: float) -> Look:
        one = _look_at(partial(frame.see, scale, 1), scale, query)
        return replace(one, what=f"{one.what}, shown alone")

    makers: list[Callable[[], Look]] = [partial(look, 0, frame.first_ways)]
    makers += [look_more_ways] if frame.most_ways else []
    makers += [partial(look, i) for i in range(1, len(frame.scales))]
    if query.threshold is None:
        makers += [partial(look, 0, frame.most_ways, 1)]
    makers += [partial(look_alone, scale) for scale in frame.alone]
    return Later(makers)


@dataclass(frozen=True)
class _Frame:
    """A photograph, or several of one frame, to be shown to segmenters.

    Attributes
    ----------
    own : (H, W)
        Of the photograph; of its mask, where it is large.
    coarser : float
        Pixels of the photograph for each that roads are traced on, along a side.
    scales : sequence of float
        Those worth trying, the most promising first.
    first_ways, most_ways : int or None
        In how many ways a model is shown the photograph at the best scale, first and at most (see `see`): first in 1
        where that was seen already, but not the next finer scale, and where there is much to show; `most_ways` is
        None where there are no more.
    alone : tuple of float
        Where one scale is known: those that the first look shows together.
    see : callable
        `see(scale, ways)` returns the probability of road, on the grid that roads are traced on; kept for another call.
        Where `ways` is None the number in each model's card applies.
    """

    own: tuple[int, int]
    coarser: float
    scales: Sequence[float]
    first_ways: int | None
    most_ways: int | None
    alone: tuple[float, ...]
    see: Callable[[float, int | None], ProbabilityMap]


def _open_frame(paths: Sequence[str], query: QueryOptions, camera: CameraOptions, say: Say) -> _Frame:
    """Choose the grid and the scales of a photograph, or of several of one frame."""
    with open_photograph(paths[0], query.bands) as photograph:
        k = max(1, int(np.ceil(np.sqrt(photograph.width * photograph.height / _MAX_GRID_PIXELS))))
        own = round(photograph.height / k), round(photograph.width / k)
    tried: _Tried = {}
    scales = _choose_scales(paths[0], query, camera, say, tried)
    finer = _how_much_finer(own, scales[0])
    grid = round(finer * own[0]), round(finer * own[1])
    names = query.segmenters or ("",)
    ways_by_card = {name: _network_of(name, query).card.ways for name in names if not _is_plugin(name)}
    masks = {path: read for path in paths if (read := _fused_mask(path, query)) is not None}

    def may_be_finer(scale: float) -> bool:
        shown = _FINER * scale
        return shown <= _ENLARGED and math.prod(own) * (k * shown) ** 2 <= MAX_MAP_PIXELS

    def see_one(path: str, name: str, scale: float, ways: int | None) -> ProbabilityMap:
        if path in masks and not _is_plugin(name):
            return _of_mask(masks[path], "mask")
        ways = ways or ways_by_card.get(name, 1)
        if ways > 1 and name in ways_by_card and may_be_finer(scale):
            parts = (_FINER * scale, ways // 2), (scale, ways - ways // 2)
            seen_in = [see_one(path, name, *part) for part in parts]
            return fuse([one.resized(grid) if one.values.shape[0] > grid[0] else one for one in seen_in])
        known = tried.get((path, name, scale)) if ways == 1 else None
        if known is not None and known.values.shape[0] < 2 * grid[0]:
            return known
        seen = _see(path, name, scale, grid, query, say, ways)
        if ways == 1:
            tried[path, name, scale] = seen
        return seen

    @lru_cache(_MAX_SCALES + 1)
    def see(scale: float, ways: int | None) -> ProbabilityMap:
        maps = [see_one(path, name, scale, ways).resized(grid) for path in paths for name in names]
        return maps[0] if len(maps) == 1 else fuse(maps)

    only_masks = masks.keys() >= set(paths)
    shown = {scale for *_, scale in tried}
    in_one = scales[0] in shown and not (may_be_finer(scales[0]) and _FINER * scales[0] in shown)
    in_one = bool(ways_by_card) and not only_masks and (in_one or math.prod(own) * (k * scales[0]) ** 2 > _MANY_PIXELS)
    least = min(ways_by_card.values(), default=_WAYS)
    has_more = not only_masks and (in_one or least < _WAYS)
    together = len(scales) == 1 and bool(ways_by_card) and not (only_masks or has_more) and may_be_finer(scales[0])
    alone = (scales[0], _FINER * scales[0]) if together else ()
    return _Frame(own, k / finer, scales, 1 if in_one else None, _WAYS if has_more else None, alone, see)


def _how_much_finer(own: tuple[int, int], scale: float) -> float:
    """Return how many times finer than a photograph's own (H, W) pixels its roads are traced."""
    finer = min(scale, _MOST_FINER, math.sqrt(_MAX_GRID_PIXELS / math.prod(own)))
    return finer if finer >= _LEAST_FINER else 1.0


def _of_own_pixels(sighting: Sighting, own: tuple[int, int]) -> Sighting:
    """Return the probability found on a finer grid at a photograph's own pixels, (H, W)."""
    if sighting.mask.shape == own:
        return sighting
    probability = None if sighting.probability is None else sighting.probability.resized(own)
    location, mask = of_own_pixels(sighting.location, own[::-1]), on_grid(sighting.mask, own)
    return replace(sighting, location=location, mask=mask, probability=probability)


def _look_at(see: Callable[[], ProbabilityMap], scale: float, query: QueryOptions, further: int = 0) -> Look:
    """Return a look at a probability map, at the model's threshold or a further one."""

    def threshold() -> float:
        return spread_probability(see().threshold if query.threshold is None else query.threshold)[further]

    what = f"scale {scale:.3g}" + (", a lower threshold" if further else "")
    return Look(what, lambda: see().mask(threshold()), see)


#: Probabilities of whole photographs: by photograph, segmenter and scale.
_Tried = dict[tuple[str, str, float], ProbabilityMap]


def _choose_scales(path: str, query: QueryOptions, camera: CameraOptions, say: Say, tried: _Tried) -> Later[float]:
    """Return the scales to try: one where the size of a pixel is known; else the one that the file states comes first.

    The photograph is shown to the model when one of the others is asked for; the result is put into `tried`.
    """
    models = [name for name in query.segmenters if is_model(name)] or ([] if query.segmenters else [""])
    if not models:
        return Later([lambda: 1.0])
    network = _network_of(models[0], query)
    low, high = camera.gsd_m
    if high <= _KNOWN_SPAN * low:
        return Later([partial(scale_of, float(np.sqrt(low * high)), network)])

    @cache
    def ranked() -> list[float]:
        say(f"looking for the scale of {path}")
        with open_photograph(path, query.bands) as photograph:
            found = rank_scales(photograph, network, camera.gsd_m)
        tried.update({(path, models[0], scale): seen for scale, seen in found.items() if seen is not None})
        return list(found)

    with open_photograph(path, query.bands) as photograph:
        n_ranked = len(try_scales(photograph, network, camera.gsd_m))
    stated = estimate_gsd(path)
    makers = [partial(lambda i: ranked()[i], i) for i in range(n_ranked)]
    if stated is not None and low <= stated <= high:
        makers.insert(0, partial(scale_of, stated, network))
    return Later(makers[:_MAX_SCALES])


def _fused_mask(path: str, query: QueryOptions) -> RoadMask | None:
    """Return one of several looks at a frame that is a mask already; None for a photograph."""
    if query.segment == "auto" and query.fused_with:
        with suppress(PhotographError):
            return read_mask(path, band=query.band, threshold=query.threshold)
    return None


def _see(
    path: str, segmenter: str, scale: float, grid: tuple[int, int], query: QueryOptions, say: Say, ways: int
) -> ProbabilityMap:
    """Return a segmenter's probability for one photograph, not much finer than a grid."""
    if _is_plugin(segmenter):
        return _of_mask(_call_segmenter(segmenter, path, query.threshold), segmenter)
    with open_photograph(path, query.bands) as photograph:
        step = max(1, int(map_shape(photograph, scale)[0] / grid[0]))
        return segment(photograph, _network_of(segmenter, query), scale, say, step=step, ways=ways)


def _of_mask(mask: RoadMask, model: str) -> ProbabilityMap:
    """Return a mask as a map of probabilities 0.9 and 0.1, for it has none of its own."""
    values = np.where(mask.roads, 229, 25).astype(np.uint8) if mask.probability is None else mask.probability.copy()
    if mask.observed is not None:
        values[~mask.observed] = NODATA
    return ProbabilityMap(values, 0.5, mask.name, model)


def _is_plugin(segmenter: str) -> bool:
    """Whether a segmenter is the name of a plugin: neither the file of a model, nor "", the model that ships."""
    return bool(segmenter) and not is_model(segmenter)


def _network_of(segmenter: str, query: QueryOptions) -> Network:
    return load_model(segmenter, query.class_name, query.threads)


@lru_cache(maxsize=4)
def load_model(path: str = "", class_name: str | None = None, threads: int = 1) -> Network:
    """Load a model, by default the one that ships, once for a batch.

    Raises
    ------
    ModelError
        It is none that can be used, or what runs models is not installed.
    """
    return load_network(Path(path) if path else DEFAULT_MODEL, class_name=class_name, threads=threads)


def _only_plugin(query: QueryOptions) -> str:
    """Return the name of the plugin that alone finds roads; nothing where there is a model too, or none of both."""
    return query.segmenters[0] if len(query.segmenters) == 1 and not is_model(query.segmenters[0]) else ""


def _call_segmenter(name: str, path: str, threshold: float | None) -> RoadMask:
    """Have a plugin find the roads in a photograph."""
    seen = call_plugin(SEGMENTERS, name, path)
    if isinstance(seen, RoadMask):
        return replace(seen, name=os.fspath(path))
    if not isinstance(seen, np.ndarray):
        kind = type(seen).__name__
        raise PluginError(f"the segmenter {name!r} returned a {kind}, expected a RoadMask or an array")
    return read_mask(seen, threshold=threshold, name=os.fspath(path))


def _on_grid(options: LocateOptions, k: float) -> LocateOptions:
    """Return the camera's limits in pixels of a grid k times as coarse as the photograph."""
    camera = options.match.camera
    focal = None if camera.focal_px is None else camera.focal_px / k
    camera = replace(camera, gsd_m=(k * camera.gsd_m[0], k * camera.gsd_m[1]), focal_px=focal)
    return replace(options, match=replace(options.match, camera=camera))
