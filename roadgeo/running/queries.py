"""The input of a search: a mask, a soft map of roads, roads as lines, or a photograph."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from roadgeo._arrays import AnyArray
from roadgeo._progress import Say, say_nothing
from roadgeo._text import log_of
from roadgeo.errors import MaskError
from roadgeo.geometry.camera import CameraOptions
from roadgeo.geometry.mask import RoadMask
from roadgeo.matching.options import LocateOptions
from roadgeo.reference.opening import AnyReference, swapped_near
from roadgeo.running.options import ReadOptions
from roadgeo.running.passes import Locate, PassRoads, Sighting, locate_passes
from roadgeo.running.photographs import Pass, call_segmenter, locate_photograph, open_segmented, plugin_of
from roadgeo.running.pictures import as_file
from roadgeo.running.variants import Judge, undoing
from roadgeo.sources.drawn_roads import draw_roads
from roadgeo.sources.georeference import Stated, read_stated
from roadgeo.sources.masks import MaskSource, is_photograph, open_mask
from roadgeo.sources.segmentation.probability import ProbabilityMap
from roadgeo.sources.streams import EXCHANGED, QUERY_ENDINGS, TABLE_ENDINGS
from roadgeo.workflows import locate

__all__ = ["QueryRoads", "locate_query", "read_roads"]

_LOG = log_of(__name__)

#: Name in results of a picture that is no file.
_ARRAY = "array"
#: Scale of roads given as lines in metres, a factor either way, and their tilt, degrees: they were measured on the
#: ground, or on a map.
_SCALED, _TILTED_DEG = 1.05, 10.0


def locate_query(
    path: str | AnyArray,
    references: Sequence[AnyReference],
    options: LocateOptions | None = None,
    reading: ReadOptions | None = None,
    *,
    how: Locate = locate,
    judge: Judge | None = None,
    say: Say = say_nothing,
) -> Sighting:
    """Locate a mask or a photograph; an array, (H, W) or (H, W, bands), is a mask.

    Parameters
    ----------
    how, judge : callable
        See `undoing`.

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
    with open_query(path, reading) as query:
        how = undoing(how, query.aspect, query.mirrored, judge)
        sighting = _locate(query, references, options, reading, how, say)
    if query.mirrored and reading.mirror is None:
        location = sighting.location.saying("the georeference of the file mirrors it, which was undone")
        sighting = sighting.answering(location)
    if isinstance(path, str):
        sighting = sighting.showing(stated=query.middle)
    return sighting


@dataclass(frozen=True)
class OpenQuery:
    """A path or an array, and the kind of its content.

    Attributes
    ----------
    kind : "lines", "mask" or "photograph"
        A map of probability is a mask.
    aspect : float or None
        How many times a pixel is as wide as high; None: once.
    mirrored : bool
    middle : (float, float) or None
        Longitude and latitude that the file states (see `Stated`).
    mask : MaskSource or None
        The mask, open.
    """

    path: str | AnyArray
    kind: Literal["lines", "mask", "photograph"]
    aspect: float | None = None
    mirrored: bool = False
    middle: tuple[float, float] | None = None
    mask: MaskSource | None = None


@contextmanager
def open_query(path: str | AnyArray, reading: ReadOptions) -> Iterator[OpenQuery]:
    """Look into a path or an array: roads as lines by its ending, a mask or a photograph by its values.

    Raises
    ------
    MaskError
        It cannot be read, or is a photograph where only masks are asked for.
    """
    if isinstance(path, str) and path.lower().endswith((*QUERY_ENDINGS, *TABLE_ENDINGS)):
        yield OpenQuery(path, "lines", mirrored=bool(reading.mirror))
        return
    by_values = reading.may_be_mask and not (_is_chosen_by_values(reading) and is_photograph(path))
    with open_mask(path, choice=reading.choice, threshold=reading.threshold) if by_values else nullcontext() as mask:
        if mask is not None and mask.photograph and reading.segment == "auto":
            mask = None
        stated = read_stated(path) if isinstance(path, str) else Stated()
        yield OpenQuery(
            path,
            "photograph" if mask is None else "mask",
            stated.aspect if reading.aspect is None else reading.aspect,
            stated.mirrored if reading.mirror is None else reading.mirror,
            stated.middle,
            mask,
        )


def _locate(
    query: OpenQuery,
    references: Sequence[AnyReference],
    options: LocateOptions,
    reading: ReadOptions,
    how: Locate,
    say: Say,
) -> Sighting:
    """Locate what a query holds."""
    if query.kind == "lines":
        return _locate_lines(str(query.path), references, options, reading, how)
    if query.mask is not None:
        sighting = locate_passes(query.mask.thresholds, _roads_at(query.mask), references, options, how)
        return sighting.showing(part=query.mask.part)
    with as_file(query.path) as file:
        sighting = locate_photograph(file, references, options, reading, how, say)
        if not isinstance(query.path, str):
            reason = sighting.location.reason.replace(file, _ARRAY)
            sighting = sighting.answering(replace(sighting.location, query=_ARRAY, reason=reason))
    return sighting.showing(kind="photograph")


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
    part : str
        What is read of a file that holds more, for people.
    """

    mask: RoadMask
    coarser: float = 1.0
    probability: ProbabilityMap | None = None
    of_photograph: bool = False
    part: str = ""


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
    with open_query(path, reading) as query:
        if query.mask is not None:
            return QueryRoads(query.mask.read(query.mask.thresholds[0]), part=query.mask.part)
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
            probability, part = probability.resized(segmented.own), segmented.photograph.page
            return QueryRoads(roads, segmented.coarser, probability, of_photograph=True, part=part)


def _is_chosen_by_values(reading: ReadOptions) -> bool:
    """Whether values decide what a path holds, though a threshold or a class is given."""
    is_read = reading.threshold is not None or reading.choice.road_class is not None
    return reading.segment == "auto" and is_read and reading.band is None


def _roads_at(mask: MaskSource) -> Callable[[float], PassRoads]:
    """Return what shows a mask at a threshold."""
    return lambda threshold: PassRoads(f"threshold {threshold:.3g}", mask.read(threshold))


def _locate_lines(
    path: str, references: Sequence[AnyReference], options: LocateOptions, reading: ReadOptions, how: Locate
) -> Sighting:
    """Locate roads given as lines; their units restrict scale and north unless the user gives narrower limits."""
    drawing, camera = draw_roads(path, reading.units, reading.layer or None), options.match.camera
    if drawing.middle is not None and swapped_near((*drawing.middle, 1000.0), references) is not None:
        _LOG.warning("%s: its coordinates lie on none of the maps; %s", path, EXCHANGED)
    if drawing.unit_m is not None and camera.gsd_m == CameraOptions().gsd_m:
        scale = (drawing.unit_m / _SCALED, drawing.unit_m * _SCALED)
        tilt = min(camera.max_tilt_deg, _TILTED_DEG)
        camera = replace(camera, gsd_m=scale, max_tilt_deg=tilt, north_up=camera.north_up or drawing.north_up)
    options = replace(options, match=replace(options.match, camera=camera))
    sighting = locate_passes([drawing.mask], lambda mask: PassRoads("its lines", mask), references, options, how)
    return sighting.showing(lines_to_pixels=drawing.to_pixel)
