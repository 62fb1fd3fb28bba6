"""The scale at which a photograph is shown to a model, where the size of its pixels is unknown.

At the right scale many intersections are seen with confidence; where a photograph is shown too small roads run into
each other, too large they fall apart and the model is in doubt. The larger it is shown, the less of it: from scale to
scale the part where most roads were seen before; results on the same ground are compared.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np

from roadgeo.errors import MaskError
from roadgeo.geometry.mask import PROBABILITY_SURE
from roadgeo.roads.vectorization import vectorize
from roadgeo.sources.segmentation.network import Network
from roadgeo.sources.segmentation.photograph import Photograph
from roadgeo.sources.segmentation.probability import NODATA, ProbabilityMap
from roadgeo.sources.segmentation.tiling import MAX_MAP_PIXELS, map_shape, segment

__all__ = ["PYRAMID", "rank_scales", "scale_of", "score", "try_scales"]

#: Pixels shown to the model for each of the photograph's, along a side; steps that a model of many scales bridges.
PYRAMID = (1.0, 0.5, 2.0, 0.25, 0.125)
_BRIDGED = 1.5  # a little more than half a step

_DEFAULT_RESOLUTION_M = 1.0
_MIN_SIDE, _MAX_ENLARGED = 192, 4096 * 4096  # pixels at the model's scale: a side, an area
_MOST_ENLARGED = 4.0  # along a side; beyond it time grows, and no more roads are seen
_TRIED_TILES = 1.875  # side of the part that is tried, tiles: 2 x 2 of them, overlapping by an eighth, cover it
_CERTAINTY_POWER = 4  # power of the share of probability that lies on roads
#: Pixels shown to a model in the time of a search. A scale at which it is still to be shown all of the
#: photograph must promise more.
_COST_OF_SEARCH = 2_000_000


def scale_of(gsd_m: float, network: Network) -> float:
    """Return the scale that shows a model ground of its own resolution, or as near to it as enlarging helps."""
    return min(gsd_m / (network.card.resolution_m or _DEFAULT_RESOLUTION_M), _MOST_ENLARGED)


def try_scales(
    photograph: Photograph, network: Network, gsd_m: tuple[float, float] = (0.0, math.inf)
) -> tuple[float, ...]:
    """Return the scales to try on a photograph of this size, whose pixels cover this many metres, in no order."""
    low, high = scale_of(gsd_m[0], network) / _BRIDGED, scale_of(gsd_m[1], network) * _BRIDGED
    fitting = [scale for scale in PYRAMID if _fits(map_shape(photograph, scale), scale)]
    if not fitting:
        return (min(1.0, math.sqrt(MAX_MAP_PIXELS / (photograph.width * photograph.height))),)
    allowed = tuple(scale for scale in fitting if low <= scale <= high)
    return allowed or (min(fitting, key=lambda scale: max(low / scale, scale / high)),)


def _fits(shape: tuple[int, int], scale: float) -> bool:
    return min(shape) >= _MIN_SIDE and math.prod(shape) <= (_MAX_ENLARGED if scale > 1 else MAX_MAP_PIXELS)


def rank_scales(
    photograph: Photograph, network: Network, gsd_m: tuple[float, float] = (0.0, math.inf)
) -> dict[float, ProbabilityMap | None]:
    """Return the scales of `try_scales`, those most worth a look first.

    With each comes what the model saw at it, where that is all of the photograph: it need not be shown again.
    """
    scales = sorted(try_scales(photograph, network, gsd_m))
    if len(scales) == 1:
        return {scales[0]: None}
    maps: dict[float, ProbabilityMap | None] = {}
    ranking: dict[float, float] = {}
    part, before, promise = _Crop(0, 0, photograph.width, photograph.height), None, 1.0
    most, most_intersections, hopeless = 0.0, 0.0, False
    for scale in scales:
        if hopeless:
            maps[scale], ranking[scale] = None, -scale
            continue
        part, same_ground = _most_roads(part, before, [round(_TRIED_TILES * side / scale) for side in network.seen])
        before, shown = None, photograph.cut(*part)
        with suppress(MaskError):  # no ground
            before = segment(shown, network, scale)
        intersections = score(before)
        promise *= (intersections + 1.0) / (score(same_ground) + 1.0)
        is_whole = (part.height, part.width) == (photograph.height, photograph.width)
        maps[scale] = before if is_whole else None
        cost = _COST_OF_SEARCH + (0 if is_whole else math.prod(map_shape(photograph, scale)))
        ranking[scale] = promise / math.sqrt(cost)
        most_intersections = max(most_intersections, intersections)
        # Finer scales are not tried beyond one that promises clearly less than the best: there roads fall apart. Those
        # of which only a part would be shown, the dearest, are tried only if the last one promises clearly more.
        is_dear = any(
            2 * scale * side > _TRIED_TILES * tile for side, tile in zip(part[:1:-1], network.seen, strict=True)
        )
        falls = promise < most + math.sqrt(most) if is_dear else promise + math.sqrt(promise) < most
        most, hopeless = max(most, promise), most_intersections >= 1.0 and falls
    if most_intersections < 1.0:  # narrow roads are seen at the finest scale first
        return {scale: maps[scale] for scale in reversed(scales)}
    return {scale: maps[scale] for scale in sorted(scales, key=ranking.__getitem__, reverse=True)}


def score(probability: ProbabilityMap | None) -> float:
    """Return how much a map looks like roads: its intersections, weighted down where the model is in doubt."""
    if probability is None:
        return 0.0
    observed = probability.values != NODATA
    p = np.where(observed, probability.values, 0).astype(np.float32) / 254
    try:
        graph = vectorize(probability.mask(probability.threshold)).graph
    except MaskError:
        return 0.0
    degrees = np.bincount(np.asarray(graph.edges).ravel(), minlength=1)
    sure = float(p[p > probability.threshold].sum() / p.sum())
    return float(np.count_nonzero(degrees >= 3)) * sure**_CERTAINTY_POWER


class _Crop(NamedTuple):
    """A part of a photograph, pixels."""

    left: int
    top: int
    width: int
    height: int


def _most_roads(
    part: _Crop, probability: ProbabilityMap | None, size: Sequence[int]
) -> tuple[_Crop, ProbabilityMap | None]:
    """Return the (height, width) at most of a part where most roads were seen, and the probability there."""
    height, width = (min(side, most) for side, most in zip((part.height, part.width), size, strict=True))
    if probability is None or (height, width) == (part.height, part.width):
        left, top = part.left + (part.width - width) // 2, part.top + (part.height - height) // 2
        return _Crop(left, top, width, height), probability
    rows, columns = probability.values.shape
    y_scale, x_scale = rows / part.height, columns / part.width
    h, w = max(1, round(height * y_scale)), max(1, round(width * x_scale))
    roads = (probability.values != NODATA) & (probability.values > PROBABILITY_SURE * probability.threshold)
    sums = cv2.integral(roads.view(np.uint8))
    inside = sums[h:, w:] - sums[:-h, w:] - sums[h:, :-w] + sums[:-h, :-w]
    y, x = np.unravel_index(inside.argmax(), inside.shape) if inside.any() else (n // 2 for n in inside.shape)
    left = part.left + min(round(float(x) / x_scale), part.width - width)
    top = part.top + min(round(float(y) / y_scale), part.height - height)
    values = np.ascontiguousarray(probability.values[y : y + h, x : x + w])
    return _Crop(left, top, width, height), replace(probability, values=values)
