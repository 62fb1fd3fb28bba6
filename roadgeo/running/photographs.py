"""A photograph, shown to a segmenter at some scales, in some ways, and located by its roads.

Probability maps are kept. They are looked at with several thresholds and, where the size of a pixel is unknown, at
several scales.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from roadgeo._progress import Say
from roadgeo.errors import MaskError, PluginError
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.mask import RoadMask
from roadgeo.location import Content, Location, Reason
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.verdict import searched_within
from roadgeo.plugins import SEGMENTERS, call_plugin
from roadgeo.reference.opening import AnyReference
from roadgeo.roads.thresholds import spread_probability
from roadgeo.running.options import ReadOptions, is_model
from roadgeo.running.passes import Locate, PassRoads, Sighting, locate_passes
from roadgeo.running.variants import in_pixels_of, resampled
from roadgeo.sources.camera import estimate_gsd
from roadgeo.sources.masks import read_mask
from roadgeo.sources.segmentation.network import DEFAULT_MODEL, Network, load_network
from roadgeo.sources.segmentation.photograph import Photograph, open_photograph
from roadgeo.sources.segmentation.probability import ProbabilityMap, mean_of
from roadgeo.sources.segmentation.scales import rank_scales, scale_of, try_scales
from roadgeo.sources.segmentation.tiling import MAX_MAP_PIXELS, map_shape, segment

__all__ = [
    "Pass",
    "SegmentedPhotograph",
    "call_segmenter",
    "load_model",
    "locate_photograph",
    "open_segmented",
    "plugin_of",
]

#: The mask of a larger photograph is reduced, so that time and memory are bounded.
_MAX_GRID_PIXELS = 64_000_000
_MAX_SCALES = 3
#: Roads of a photograph whose pixels are coarser than a model's are traced on the model's, but at most this many
#: times its own along a side: narrow gaps between roads close on coarse ones.
_MOST_FINER, _LEAST_FINER = 2.0, 1.25
#: In a second way a model is shown a photograph twice as fine, a step of the scales that are tried blind, and the mean
#: of the log odds counts. On labelled tiles of Boston and Miami F1 within 4 m is .914 and .867 at 1 m per pixel, .950
#: and .869 at 0.5 m, .949 and .892 of both (turned by half instead: .923 and .878). Where its pixels are not as fine it
#: is turned by half.
_FINER, _WAYS, _ENLARGED = 2.0, 2, 1.1
_MANY_PIXELS = 4_000_000  # shown to a model in one way first: a scene of that size is mostly located so
_KNOWN_SPAN = 1.7  # a range of pixel sizes narrower than this is one scale


@dataclass(frozen=True)
class Pass:
    """One pass over a photograph through a model.

    Attributes
    ----------
    rank : int
        Rank of its scale among the scales to try, the most promising first.
    finer : float
        How many times finer than that the photograph is shown.
    ways : int or None
        Number of ways in which a model sees it; None: two for the model that ships, one for others.
    as_shown : bool
        In one way, where it was shown at that scale already, but not at the next finer one.
    lower : bool
        At a threshold lower than the model's own.
    note : str
        What distinguishes it from other passes at that scale, for people.
    """

    rank: int = 0
    finer: float = 1.0
    ways: int | None = None
    as_shown: bool = False
    lower: bool = False
    note: str = ""


class SegmentedPhotograph:
    """A photograph, open to be shown to a model.

    Attributes
    ----------
    own : (H, W)
        Size of the photograph, or of its mask where it is large.
    grid : (H, W)
        On which roads are traced.
    coarser : float
        Pixels of the photograph for each of the grid, along a side.
    n_scales, n_further : int
        Number of scales to try; and of the ones beyond a given scale. That states how large the ground is, not
        at which scale the model sees it best.
    """

    def __init__(self, photograph: Photograph, reading: ReadOptions, gsd_m: tuple[float, float], say: Say) -> None:
        """Choose the grid and the scales; where no scale is known, the photograph is shown to the model for that."""
        self.photograph, self.reading, self.gsd_m, self.say = photograph, reading, gsd_m, say
        self.network = load_model(reading.segmenter, reading.class_name, reading.threads)
        self.ways = 1 if reading.segmenter else _WAYS
        #: Probability of road by scale and number of ways.
        self._shown: dict[tuple[float, int], ProbabilityMap] = {}
        k = max(1, math.ceil(math.sqrt(photograph.width * photograph.height / _MAX_GRID_PIXELS)))
        self.own = round(photograph.height / k), round(photograph.width / k)
        self._scales, self.n_scales, self.n_further = self._known_scales()
        finer = _how_much_finer(self.own, self.scale(0))
        self.grid, self.coarser = (round(finer * self.own[0]), round(finer * self.own[1])), k / finer

    def _known_scales(self) -> tuple[list[float], int, int]:
        """Return the scales that are known, the number of scales to try, and of further ones.

        Where the size of a pixel is known there is one, and further ones come last.
        """
        low, high = self.gsd_m
        if high <= _KNOWN_SPAN * low:
            own = scale_of(math.sqrt(low * high), self.network)
            further = [scale for scale in try_scales(self.photograph, self.network) if scale != own]
            return [own], 1, min(_MAX_SCALES, len(further))
        stated = estimate_gsd(self.photograph.name)
        stated_scales = [scale_of(stated, self.network)] if stated is not None and low <= stated <= high else []
        n_scales = len(stated_scales) + len(try_scales(self.photograph, self.network, self.gsd_m))
        return stated_scales, min(_MAX_SCALES, n_scales), 0

    def scale(self, rank: int) -> float:
        """Return a scale to try; where none is known, the photograph is shown to the model at many."""
        if rank >= len(self._scales):
            self.say(f"looking for the scale of {self.photograph.name}")
            ranked = rank_scales(self.photograph, self.network, *() if self.n_further else (self.gsd_m,))
            self._shown.update({(scale, 1): shown for scale, shown in ranked.items() if shown is not None})
            self._scales += [scale for scale in ranked if not self.n_further or scale not in self._scales]
        return self._scales[rank]

    def passes(self) -> list[Pass]:
        """Return the best scale's pass, other scales, the photograph in more ways, and a lower threshold at the best.

        The model is shown it in one way first where that was done already, but not at the next finer scale, and where
        there is much to show. Beyond scales that were tried a model of others is shown it in more ways:
        of 60 photographs whose scale was unknown none was located so, and it was half of a refusal's time. Where one
        scale is known, the two scales that were shown together are looked at alone as well, and the scales of a
        photograph whose scale is unknown last.
        """
        best = self.scale(0)
        in_one = self._was_shown_alone(best) or math.prod(self._shape_at(best)) > _MANY_PIXELS
        has_more = (in_one and self.n_scales == 1) or self.ways < _WAYS
        passes = [Pass(ways=1 if in_one else None)]
        most = _WAYS if has_more else passes[0].ways
        passes += [Pass(rank, as_shown=True) for rank in range(1, self.n_scales)]
        if has_more:
            passes.append(Pass(ways=most, note=f", shown {most} ways"))
        if self.reading.threshold is None:
            passes.append(Pass(ways=most, lower=True, note=", a lower threshold"))
        if not has_more and self.n_scales == 1 and self._may_be_finer(best):
            passes += [Pass(finer=finer, ways=1, note=", shown alone") for finer in (1.0, _FINER)]
        return passes + [Pass(rank, as_shown=True) for rank in range(1, 1 + self.n_further)]

    def roads(self, one: Pass) -> PassRoads:
        """Return the roads that one pass shows, on the grid.

        Raises
        ------
        MaskError
            It shows no roads.
        """
        scale = one.finer * self.scale(one.rank)
        probability = self.probability(scale, 1 if one.as_shown and self._was_shown_alone(scale) else one.ways)
        threshold = probability.threshold if self.reading.threshold is None else self.reading.threshold
        mask = probability.mask(spread_probability(threshold)[one.lower])
        return PassRoads(f"scale {scale:.3g}{one.note}", mask, probability)

    def probability(self, scale: float, ways: int | None) -> ProbabilityMap:
        """Return the probability of road on the grid."""
        return self._probability(scale, ways or self.ways).resized(self.grid)

    def _probability(self, scale: float, ways: int) -> ProbabilityMap:
        """Return what the model sees, not much finer than the grid."""
        if ways > 1 and self._may_be_finer(scale):
            parts = [self._probability(_FINER * scale, ways // 2), self._probability(scale, ways - ways // 2)]
            return mean_of([part.resized(self.grid) if part.values.shape[0] > self.grid[0] else part for part in parts])
        key = (scale, ways)
        if key not in self._shown or self._shown[key].values.shape[0] >= 2 * self.grid[0]:
            step = max(1, int(map_shape(self.photograph, scale)[0] / self.grid[0]))
            self._shown[key] = segment(self.photograph, self.network, scale, self.say, step=step, ways=ways)
        return self._shown[key]

    def _was_shown_alone(self, scale: float) -> bool:
        """Whether a model was shown the photograph at a scale, and not at the next finer one that it would go with."""
        shown = {scale for scale, _ in self._shown}
        return scale in shown and not (self._may_be_finer(scale) and _FINER * scale in shown)

    def _shape_at(self, scale: float) -> tuple[float, float]:
        """Return (H, W) of the photograph at a scale."""
        return self.photograph.height * scale, self.photograph.width * scale

    def _may_be_finer(self, scale: float) -> bool:
        shown = _FINER * scale
        return shown <= _ENLARGED and math.prod(self._shape_at(shown)) <= MAX_MAP_PIXELS


@contextmanager
def open_segmented(
    path: str, reading: ReadOptions, gsd_m: tuple[float, float], say: Say
) -> Iterator[SegmentedPhotograph]:
    """Open a photograph.

    Parameters
    ----------
    gsd_m : (low, high)
        Metres per pixel, as far as they are known.

    Raises
    ------
    MaskError
        It cannot be read.
    ModelError
        There is no model, or it cannot be run.
    """
    with open_photograph(path, reading.bands) as photograph:
        yield SegmentedPhotograph(photograph, reading, gsd_m, say)


def locate_photograph(
    path: str,
    references: Sequence[AnyReference],
    options: LocateOptions,
    reading: ReadOptions,
    how: Locate,
    say: Say,
) -> Sighting:
    """Locate a photograph by the roads that a segmenter sees.

    Raises
    ------
    MaskError, ModelError
        As of `open_segmented`.
    PluginError
        The segmenter fails.
    """
    plugin = plugin_of(reading)
    if plugin:
        roads = PassRoads("the segmenter's own threshold", call_segmenter(plugin, path, reading.threshold))
        return locate_passes([Pass()], lambda _: roads, references, options, how)
    with open_segmented(path, reading, options.match.camera.gsd_m, say) as segmented:
        on_grid, passes = _on_grid(options, segmented.coarser), segmented.passes()
        try:
            sighting = locate_passes(passes, segmented.roads, references, on_grid, how)
        except MaskError as error:
            ways = max((one.ways for one in passes if one.ways), default=None)
            return _refuse_without_roads(segmented, ways, error, references)
    sighting = _in_own_pixels(sighting, segmented.own)
    reason = sighting.location.reason.replace(searched_within(on_grid), searched_within(options))
    return sighting.answering(replace(sighting.location, reason=reason)).showing(part=segmented.photograph.page)


def _refuse_without_roads(
    segmented: SegmentedPhotograph, ways: int | None, error: MaskError, references: Sequence[AnyReference]
) -> Sighting:
    """Return the refusal of a photograph in which no pass shows roads that can be traced."""
    name, (height, width) = segmented.photograph.name, segmented.own
    location = Location(
        name,
        "not_located",
        f"hardly a road is seen in the photograph ({error})",
        ", ".join(reference.name for reference in references),
        content=Content((width, height)),
        reason_code=Reason.FEW_ROADS,
    )
    probability = segmented.probability(segmented.scale(0), ways).resized(segmented.own)
    return Sighting(location, RoadMask(np.zeros(segmented.own, np.bool_), name=name), probability=probability)


def _how_much_finer(own: tuple[int, int], scale: float) -> float:
    """Return how many times finer than a photograph's own (H, W) pixels its roads are traced."""
    finer = min(scale, _MOST_FINER, math.sqrt(_MAX_GRID_PIXELS / math.prod(own)))
    return finer if finer >= _LEAST_FINER else 1.0


def _on_grid(options: LocateOptions, k: float) -> LocateOptions:
    """Return the camera's limits in pixels of a grid k times as coarse as the photograph."""
    camera = options.match.camera
    focal = None if camera.focal_px is None else camera.focal_px / k
    camera = replace(camera, gsd_m=(k * camera.gsd_m[0], k * camera.gsd_m[1]), focal_px=focal)
    return replace(options, match=replace(options.match, camera=camera))


def _in_own_pixels(sighting: Sighting, own: tuple[int, int]) -> Sighting:
    """Return a sighting on a finer grid in a photograph's own pixels, (H, W)."""
    if sighting.mask.shape == own:
        return sighting
    probability = None if sighting.probability is None else sighting.probability.resized(own)
    variant = resampled(sighting.mask, own)
    location = in_pixels_of(sighting.location, own[::-1], Homography(variant.matrix).inverse().matrix)
    return replace(sighting, location=location, mask=variant.mask, probability=probability)


# --- segmenters -------------------------------------------------------------------------------------------------------


@lru_cache(maxsize=4)
def load_model(path: str = "", class_name: str | None = None, threads: int = 1) -> Network:
    """Load a model, by default the one that ships, once for a batch.

    Raises
    ------
    ModelError
        It cannot be used, or what runs models is not installed.
    """
    return load_network(Path(path) if path else DEFAULT_MODEL, class_name=class_name, threads=threads)


def plugin_of(reading: ReadOptions) -> str:
    """Return the name of the plugin that finds roads; nothing where a model does."""
    return "" if is_model(reading.segmenter) else reading.segmenter


def call_segmenter(name: str, path: str, threshold: float | None) -> RoadMask:
    """Have a plugin find the roads in a photograph.

    Raises
    ------
    PluginError
        It fails, or returns something else.
    """
    roads = call_plugin(SEGMENTERS, name, path)
    if isinstance(roads, RoadMask):
        return replace(roads, name=os.fspath(path))
    if not isinstance(roads, np.ndarray):
        kind = type(roads).__name__
        raise PluginError(f"the segmenter {name!r} returned a {kind}, expected a RoadMask or an array")
    return read_mask(roads, threshold=threshold, name=os.fspath(path))
