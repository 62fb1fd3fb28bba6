"""A photograph, or several of one frame, shown to segmenters at some scales, in some ways, and located by their roads.

Probability maps are kept. They are looked at with several thresholds and, where the size of a pixel is unknown, at
several scales.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from roadgeo._progress import Say
from roadgeo.errors import MaskError, PhotographError, PluginError
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.mask import RoadMask
from roadgeo.location import Location, Reason
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.verdict import searched_within
from roadgeo.plugins import SEGMENTERS, call_plugin
from roadgeo.reference.reference import AnyReference
from roadgeo.roads.thresholds import spread_probability
from roadgeo.running.looks import Locate, Seen, Sighting, locate_looks
from roadgeo.running.options import ReadOptions, is_model
from roadgeo.running.variants import in_pixels_of, resampled
from roadgeo.sources.exif import estimate_gsd
from roadgeo.sources.masks import read_mask
from roadgeo.sources.segmentation.network import DEFAULT_MODEL, Network, load_network
from roadgeo.sources.segmentation.photograph import Photograph, open_photograph
from roadgeo.sources.segmentation.probability import NODATA, ProbabilityMap, fuse
from roadgeo.sources.segmentation.scales import rank_scales, scale_of, try_scales
from roadgeo.sources.segmentation.tiling import MAX_MAP_PIXELS, map_shape, segment

__all__ = ["Frame", "Look", "call_segmenter", "load_model", "locate_photograph", "only_plugin", "open_frame"]

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
class Look:
    """One look at a photograph through segmenters.

    Attributes
    ----------
    rank : int
        Rank of its scale among the scales worth trying, the most promising first.
    finer : float
        How many times finer than that the photograph is shown.
    ways : int or None
        Number of ways in which a model sees it; None: the number on each model's card.
    as_shown : bool
        In one way, where it was shown at that scale already, but not at the next finer one.
    lower : bool
        At a threshold lower than the model's own.
    note : str
        What distinguishes it from other looks at that scale, for people.
    """

    rank: int = 0
    finer: float = 1.0
    ways: int | None = None
    as_shown: bool = False
    lower: bool = False
    note: str = ""


class Frame:
    """A photograph, or several of one frame, open to be shown to segmenters.

    Attributes
    ----------
    own : (H, W)
        Size of the photograph, or of its mask where it is large.
    grid : (H, W)
        On which roads are traced.
    coarser : float
        Pixels of the photograph for each of the grid, along a side.
    n_scales : int
        Number of scales worth trying.
    """

    def __init__(
        self,
        paths: Sequence[str],
        photographs: dict[str, Photograph],
        masks: dict[str, RoadMask],
        reading: ReadOptions,
        gsd_m: tuple[float, float],
        say: Say,
    ) -> None:
        """Choose the grid and the scales; where no scale is known, the photograph is shown to the model for that."""
        self.paths, self.photographs, self.masks, self.first = paths, photographs, masks, photographs[paths[0]]
        self.reading, self.gsd_m, self.say = reading, gsd_m, say
        self.names = reading.segmenters or ("",)
        self.networks = {
            name: load_model(name, reading.class_name, reading.threads) for name in self.names if not _is_plugin(name)
        }
        #: Probability of road by photograph, segmenter, scale and number of ways.
        self._seen: dict[tuple[str, str, float, int], ProbabilityMap] = {}
        k = max(1, math.ceil(math.sqrt(self.first.width * self.first.height / _MAX_GRID_PIXELS)))
        self.own = round(self.first.height / k), round(self.first.width / k)
        self._scales, self.n_scales = self._known_scales()
        finer = _how_much_finer(self.own, self.scale(0))
        self.grid, self.coarser = (round(finer * self.own[0]), round(finer * self.own[1])), k / finer

    def _known_scales(self) -> tuple[list[float], int]:
        """Return the scales that are known, and how many there are with others: one where a pixel's size is known."""
        if not self.networks:
            return [1.0], 1
        network, (low, high) = next(iter(self.networks.values())), self.gsd_m
        if high <= _KNOWN_SPAN * low:
            return [scale_of(math.sqrt(low * high), network)], 1
        stated = estimate_gsd(self.first.name)
        known = [scale_of(stated, network)] if stated is not None and low <= stated <= high else []
        return known, min(_MAX_SCALES, len(known) + len(try_scales(self.first, network, self.gsd_m)))

    def scale(self, rank: int) -> float:
        """Return a scale worth trying; where it is not known, the photograph is shown to the model at many."""
        if rank >= len(self._scales):
            self.say(f"looking for the scale of {self.first.name}")
            name, network = next(iter(self.networks.items()))
            found = rank_scales(self.first, network, self.gsd_m)
            whole = {scale: seen for scale, seen in found.items() if seen is not None}
            self._seen.update({(self.first.name, name, scale, 1): seen for scale, seen in whole.items()})
            self._scales += found
        return self._scales[rank]

    def looks(self) -> list[Look]:
        """Return the best scale's look, other scales, the photograph in more ways, and a lower threshold at the best.

        A model is shown it in one way first where that was done already, but not at the next finer scale, and where
        there is much to show. Beyond scales that were tried it is shown in more ways only if its card asks for fewer:
        of 60 photographs whose scale was unknown none was located so, and it was half of a refusal's time. Where one
        scale is known, the two scales that were shown together are looked at alone as well.
        """
        best = self.scale(0)
        has_models = bool(self.networks) and not self.masks.keys() >= set(self.paths)
        in_one = has_models and (self._was_shown_alone(best) or math.prod(self._shape_at(best)) > _MANY_PIXELS)
        has_more = in_one and self.n_scales == 1
        has_more |= has_models and min(network.card.ways for network in self.networks.values()) < _WAYS
        looks = [Look(ways=1 if in_one else None)]
        most = _WAYS if has_more else looks[0].ways
        looks += [Look(rank, as_shown=True) for rank in range(1, self.n_scales)]
        if has_more:
            looks.append(Look(ways=most, note=f", shown {most} ways"))
        if self.reading.threshold is None:
            looks.append(Look(ways=most, lower=True, note=", a lower threshold"))
        if has_models and not has_more and self.n_scales == 1 and self._may_be_finer(best):
            looks += [Look(finer=finer, ways=1, note=", shown alone") for finer in (1.0, _FINER)]
        return looks

    def look(self, look: Look) -> Seen:
        """Return the roads seen in one look, on the grid.

        Raises
        ------
        MaskError
            It shows no roads.
        """
        scale = look.finer * self.scale(look.rank)
        seen = self.see(scale, 1 if look.as_shown and self._was_shown_alone(scale) else look.ways)
        threshold = seen.threshold if self.reading.threshold is None else self.reading.threshold
        return Seen(f"scale {scale:.3g}{look.note}", seen.mask(spread_probability(threshold)[look.lower]), seen)

    def see(self, scale: float, ways: int | None) -> ProbabilityMap:
        """Return the probability of road on the grid, of all photographs and segmenters together."""
        maps = [self._see(path, name, scale, ways) for path in self.paths for name in self.names]
        maps = [seen.resized(self.grid) for seen in maps]
        return maps[0] if len(maps) == 1 else fuse(maps)

    def _see(self, path: str, name: str, scale: float, ways: int | None) -> ProbabilityMap:
        """Return what a segmenter sees in a photograph, not much finer than the grid."""
        network = self.networks.get(name)
        if network is None:
            key = (path, name, 1.0, 1)
            if key not in self._seen:
                self._seen[key] = _of_mask(call_segmenter(name, path, self.reading.threshold), name)
            return self._seen[key]
        if path in self.masks:
            return _of_mask(self.masks[path], "mask")
        ways = ways or network.card.ways
        if ways > 1 and self._may_be_finer(scale):
            parts = (_FINER * scale, ways // 2), (scale, ways - ways // 2)
            seen_in = [self._see(path, name, *part) for part in parts]
            rows = self.grid[0]
            return fuse([seen.resized(self.grid) if seen.values.shape[0] > rows else seen for seen in seen_in])
        key = (path, name, scale, ways)
        if key not in self._seen or self._seen[key].values.shape[0] >= 2 * self.grid[0]:
            photograph = self.photographs[path]
            step = max(1, int(map_shape(photograph, scale)[0] / self.grid[0]))
            self._seen[key] = segment(photograph, network, scale, self.say, step=step, ways=ways)
        return self._seen[key]

    def _was_shown_alone(self, scale: float) -> bool:
        """Whether a model was shown the photograph at a scale, and not at the next finer one that it would go with."""
        shown = {scale for _, _, scale, _ in self._seen}
        return scale in shown and not (self._may_be_finer(scale) and _FINER * scale in shown)

    def _shape_at(self, scale: float) -> tuple[float, float]:
        """Return (H, W) of the photograph at a scale."""
        return self.first.height * scale, self.first.width * scale

    def _may_be_finer(self, scale: float) -> bool:
        shown = _FINER * scale
        return shown <= _ENLARGED and math.prod(self._shape_at(shown)) <= MAX_MAP_PIXELS


@contextmanager
def open_frame(paths: Sequence[str], reading: ReadOptions, gsd_m: tuple[float, float], say: Say) -> Iterator[Frame]:
    """Open a photograph, or several of one frame, some of which may be masks already.

    Parameters
    ----------
    gsd_m : (low, high)
        Metres per pixel, as far as they are known.

    Raises
    ------
    MaskError
        One cannot be read.
    ModelError
        There is no model, or it cannot be run.
    """
    masks = {}
    if reading.segment == "auto" and reading.fused_with:
        for path in paths:
            with suppress(PhotographError):
                masks[path] = read_mask(path, band=reading.band, threshold=reading.threshold)
    with ExitStack() as stack:
        photographs = {
            path: stack.enter_context(open_photograph(path, reading.bands))
            for path in dict.fromkeys(paths)
            if path == paths[0] or path not in masks
        }
        yield Frame(paths, photographs, masks, reading, gsd_m, say)


def locate_photograph(
    paths: Sequence[str],
    references: Sequence[AnyReference],
    options: LocateOptions,
    reading: ReadOptions,
    how: Locate,
    say: Say,
) -> Sighting:
    """Locate a photograph, or several of one frame, by the roads that segmenters see.

    Raises
    ------
    MaskError, ModelError
        As of `open_frame`.
    PluginError
        A segmenter fails.
    """
    plugin = only_plugin(reading)
    if plugin and len(paths) == 1:
        seen = Seen("the segmenter's own threshold", call_segmenter(plugin, paths[0], reading.threshold))
        return locate_looks([Look()], lambda _: seen, references, options, how)
    with open_frame(paths, reading, options.match.camera.gsd_m, say) as frame:
        on_grid, looks = _on_grid(options, frame.coarser), frame.looks()
        try:
            found = locate_looks(looks, frame.look, references, on_grid, how)
        except MaskError as error:
            ways = max((look.ways for look in looks if look.ways), default=None)
            return _see_hardly_a_road(frame, ways, error, references)
    sighting = _in_own_pixels(found, frame.own)
    reason = sighting.location.reason.replace(searched_within(on_grid), searched_within(options))
    return replace(sighting, location=replace(sighting.location, reason=reason, part_read=frame.first.page))


def _see_hardly_a_road(
    frame: Frame, ways: int | None, error: MaskError, references: Sequence[AnyReference]
) -> Sighting:
    """Return the refusal of a photograph in which no look shows roads that can be traced."""
    name, (height, width) = frame.first.name, frame.own
    location = Location(
        name,
        "not_located",
        f"hardly a road is seen in the photograph ({error})",
        ", ".join(reference.name for reference in references),
        size=(width, height),
        reason_code=Reason.FEW_ROADS,
    )
    seen = frame.see(frame.scale(0), ways).resized(frame.own)
    return Sighting(location, RoadMask(np.zeros(frame.own, np.bool_), name=name), probability=seen)


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
    """Return what was found on a finer grid in a photograph's own pixels, (H, W)."""
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


def only_plugin(reading: ReadOptions) -> str:
    """Return the name of the plugin that alone finds roads; nothing where there is a model too, or neither."""
    return reading.segmenters[0] if len(reading.segmenters) == 1 and _is_plugin(reading.segmenters[0]) else ""


def _is_plugin(segmenter: str) -> bool:
    """Whether a segmenter is the name of a plugin: neither the file of a model, nor "", the model that ships."""
    return bool(segmenter) and not is_model(segmenter)


def call_segmenter(name: str, path: str, threshold: float | None) -> RoadMask:
    """Have a plugin find the roads in a photograph.

    Raises
    ------
    PluginError
        It fails, or returns something else.
    """
    seen = call_plugin(SEGMENTERS, name, path)
    if isinstance(seen, RoadMask):
        return replace(seen, name=os.fspath(path))
    if not isinstance(seen, np.ndarray):
        kind = type(seen).__name__
        raise PluginError(f"the segmenter {name!r} returned a {kind}, expected a RoadMask or an array")
    return read_mask(seen, threshold=threshold, name=os.fspath(path))


def _of_mask(mask: RoadMask, model: str) -> ProbabilityMap:
    """Return a mask as a map of probabilities 0.9 and 0.1, for it has none of its own."""
    values = np.where(mask.roads, 229, 25).astype(np.uint8) if mask.probability is None else mask.probability.copy()
    if mask.observed is not None:
        values[~mask.observed] = NODATA
    return ProbabilityMap(values, 0.5, mask.name, model)
