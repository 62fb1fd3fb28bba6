"""The input of a search: a mask, a soft map of roads, roads as lines, or a photograph."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from roadgeo._arrays import AnyArray
from roadgeo._progress import Say, say_nothing
from roadgeo._text import visible
from roadgeo.errors import MaskError, PhotographError
from roadgeo.geometry.camera import CameraOptions
from roadgeo.geometry.mask import RoadMask
from roadgeo.location import Location
from roadgeo.matching.explanation import Explanation
from roadgeo.matching.options import LocateOptions
from roadgeo.reference.opening import AnyReference, swapped_near
from roadgeo.running.options import ReadOptions
from roadgeo.running.passes import Locate, PassRoads, Sighting, locate_passes
from roadgeo.running.photographs import Pass, call_segmenter, locate_photograph, open_segmented, plugin_of
from roadgeo.running.pictures import as_file
from roadgeo.running.variants import undoing
from roadgeo.sources.drawn_roads import draw_roads
from roadgeo.sources.georeference import read_pixel_shape
from roadgeo.sources.masks import MaskSource, open_mask
from roadgeo.sources.segmentation.probability import ProbabilityMap
from roadgeo.sources.streams import EXCHANGED, QUERY_ENDINGS
from roadgeo.workflows import locate

__all__ = ["QueryRoads", "locate_query", "read_roads"]

_LOG = logging.getLogger(__name__)

#: Name in results of a picture that is no file.
_ARRAY = "array"


def locate_query(
    path: str | AnyArray,
    references: Sequence[AnyReference],
    options: LocateOptions | None = None,
    reading: ReadOptions | None = None,
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
    options, reading = options or LocateOptions(), reading or ReadOptions()
    if isinstance(path, str) and path.lower().endswith(QUERY_ENDINGS):
        return _locate_lines(path, references, options, reading, undoing(how, None, bool(reading.mirror)))
    stated = cache(lambda: read_pixel_shape(path) if isinstance(path, str) else (None, False))

    def upright(mask: RoadMask, references: Sequence[AnyReference], options: LocateOptions) -> Location | Explanation:
        aspect, is_mirrored = stated()  # now that the file was found to be a picture
        aspect = aspect if reading.aspect is None else reading.aspect
        mirror = is_mirrored if reading.mirror is None else reading.mirror
        return undoing(how, aspect, mirror)(mask, references, options)

    sighting = _look_at(path, references, options, reading, upright, say)
    if reading.mirror is None and stated()[1]:
        sighting = sighting.answering(
            sighting.location.saying("the georeference of the file mirrors it, which was undone")
        )
    return sighting


def _look_at(
    path: str | AnyArray,
    references: Sequence[AnyReference],
    options: LocateOptions,
    reading: ReadOptions,
    how: Locate,
    say: Say,
) -> Sighting:
    """Locate a mask, or a photograph."""
    with _open_as_mask(path, reading) as mask:
        if mask is not None:
            sighting = locate_passes(mask.thresholds, _looks_at(mask), references, options, how)
            return sighting.showing(part=mask.part)
    with as_file(path) as file:
        sighting = locate_photograph(file, references, options, reading, how, say)
        if not isinstance(path, str):
            reason = sighting.location.reason.replace(file, _ARRAY)
            sighting = sighting.answering(replace(sighting.location, query=_ARRAY, reason=reason))
    return replace(sighting, of_photograph=True)


@dataclass(frozen=True)
class QueryRoads:
    """The roads seen in a query before it is compared with any map.

    Attributes
    ----------
    mask : RoadMask
        Its roads, on the grid that they are traced on; of a photograph there may be none.
    coarser : float
        Pixels of the query for each of the mask, along a side: above 1 for a large photograph, below for a coarse one.
    probability : ProbabilityMap or None
        What a segmenter sees in a photograph, in its own pixels, or in its mask's where it is large.
    """

    mask: RoadMask
    coarser: float = 1.0
    probability: ProbabilityMap | None = None
    of_photograph: bool = False


def read_roads(
    path: str | AnyArray, gsd_m: tuple[float, float] | None, reading: ReadOptions, say: Say = say_nothing
) -> QueryRoads:
    """Read a mask, or find the roads of a photograph, as `locate_query` does, in as many ways as in its first pass.

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
    with _open_as_mask(path, reading) as mask:
        if mask is not None:
            return QueryRoads(mask.read(mask.thresholds[0]))
    with as_file(path) as file:
        plugin = plugin_of(reading)
        if plugin:
            return QueryRoads(call_segmenter(plugin, file, reading.threshold), of_photograph=True)
        with open_segmented(file, reading, gsd_m or CameraOptions().gsd_m, say) as segmented:
            probability = segmented.probability(segmented.scale(0), None)
            try:
                roads = segmented.roads(Pass()).mask
            except MaskError:  # the roads seen are worth a look all the same
                roads = RoadMask(np.zeros(segmented.grid, np.bool_), name=file)
            return QueryRoads(roads, segmented.coarser, probability.resized(segmented.own), of_photograph=True)


@contextmanager
def _open_as_mask(path: str | AnyArray, reading: ReadOptions) -> Iterator[MaskSource | None]:
    """Open a mask, or a soft map of roads; None where the path holds a photograph.

    Raises
    ------
    MaskError
        It cannot be read, or is a photograph where only masks are asked for.
    """
    with ExitStack() as stack:
        source = None
        if reading.may_be_mask and not (_is_chosen_by_values(reading) and _is_photograph(path)):
            try:
                source = stack.enter_context(open_mask(path, choice=reading.choice, threshold=reading.threshold))
            except PhotographError:
                if reading.segment == "never":
                    raise
        yield source


def _is_chosen_by_values(reading: ReadOptions) -> bool:
    """Whether values decide what a path holds, though a threshold or a class is given."""
    is_read = reading.threshold is not None or reading.choice.road_class is not None
    return reading.segment == "auto" and is_read and reading.band is None


def _is_photograph(path: str | AnyArray) -> bool:
    """Whether the values of a path look like a photograph's."""
    try:
        with open_mask(path):
            return False
    except MaskError as error:
        return isinstance(error, PhotographError)


def _looks_at(mask: MaskSource) -> Callable[[float], PassRoads]:
    """Return what shows a mask at a threshold."""
    return lambda threshold: PassRoads(f"threshold {threshold:.3g}", mask.read(threshold))


def _locate_lines(
    path: str, references: Sequence[AnyReference], options: LocateOptions, reading: ReadOptions, how: Locate
) -> Sighting:
    """Locate roads given as lines; their units restrict scale and north unless the user gives narrower limits."""
    drawing, camera = draw_roads(path, reading.units, reading.layer or None), options.match.camera
    if drawing.middle is not None and swapped_near((*drawing.middle, 1000.0), references) is not None:
        _LOG.warning("%s: its coordinates lie on none of the maps; %s", visible(path), EXCHANGED)
    if drawing.unit_m is not None and camera.gsd_m == CameraOptions().gsd_m:
        known = (drawing.unit_m / 1.05, drawing.unit_m * 1.05)
        tilt = min(camera.max_tilt_deg, 10.0)  # they were measured on the ground, or on a map
        camera = replace(camera, gsd_m=known, max_tilt_deg=tilt, north_up=camera.north_up or drawing.north_up)
    options = replace(options, match=replace(options.match, camera=camera))
    sighting = locate_passes([drawing.mask], lambda mask: PassRoads("its lines", mask), references, options, how)
    return sighting.showing(lines_to_pixels=drawing.to_pixel)
