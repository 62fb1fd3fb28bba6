"""At which scale a photograph is shown to a model, where nobody says how large its pixels are.

A few scales are tried on the middle of the photograph. At the right one many intersections are seen with confidence;
at coarser ones roads run into each other, at finer ones they fall apart and the model is in doubt.
"""

from __future__ import annotations

import math
from contextlib import suppress

import numpy as np

from roadgeo._arrays import AnyArray, BoolArray
from roadgeo.errors import MaskError
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
_MIN_SIDE, _MAX_ENLARGED = 192, 4096  # pixels at the model's scale
_TRIED_TILES = 1.9  # side of the part that is tried, tiles: 2 x 2 of them cover it
_DOUBT = 4  # power of the share of probability that lies on roads


def scale_of(gsd_m: float, network: Network) -> float:
    """Return the scale that shows a model ground of its own resolution."""
    return gsd_m / (network.card.resolution_m or _DEFAULT_RESOLUTION_M)


def try_scales(
    photograph: Photograph, network: Network, gsd_m: tuple[float, float] = (0.0, math.inf)
) -> tuple[float, ...]:
    """Return the scales to try on a photograph of this size, whose pixels cover so many metres, in no order."""
    low, high = scale_of(gsd_m[0], network) / _BRIDGED, scale_of(gsd_m[1], network) * _BRIDGED
    fitting = [scale for scale in PYRAMID if _fits(map_shape(photograph, scale), scale)]
    if not fitting:
        return (min(1.0, math.sqrt(MAX_MAP_PIXELS / (photograph.width * photograph.height))),)
    known = tuple(scale for scale in fitting if low <= scale <= high)
    return known or (min(fitting, key=lambda scale: max(low / scale, scale / high)),)


def _fits(shape: tuple[int, int], scale: float) -> bool:
    too_large = math.prod(shape) > MAX_MAP_PIXELS or (scale > 1 and max(shape) > _MAX_ENLARGED)
    return min(shape) >= _MIN_SIDE and not too_large


def rank_scales(
    photograph: Photograph, network: Network, gsd_m: tuple[float, float] = (0.0, math.inf)
) -> dict[float, ProbabilityMap | None]:
    """Return the scales of `try_scales`, the best first.

    With each comes what the model saw at it, where that is all of the photograph: it need not be shown again.
    """
    scales = try_scales(photograph, network, gsd_m)
    if len(scales) == 1:
        return {scales[0]: None}
    seen: dict[float, ProbabilityMap | None] = {}
    scores = {}
    for scale in scales:
        part = _middle(photograph, network.card.tile, scale)
        seen[scale], scores[scale] = None, 0.0
        with suppress(MaskError):  # no ground in the middle
            found = segment(part, network, scale)
            scores[scale] = score(found) / (part.width * part.height)
            if (part.width, part.height) == (photograph.width, photograph.height):
                seen[scale] = found
    return {scale: seen[scale] for scale in sorted(scales, key=scores.__getitem__, reverse=True)}


def score(seen: ProbabilityMap) -> float:
    """Say how much a map looks like roads: its intersections, weighted down where the model is in doubt."""
    known = seen.values != NODATA
    p = np.where(known, seen.values, 0).astype(np.float32) / 254
    try:
        graph = vectorize(seen.mask(seen.threshold)).graph
    except MaskError:
        return 0.0
    degrees = np.bincount(np.asarray(graph.edges).ravel(), minlength=1)
    sure = float(p[p > seen.threshold].sum() / p.sum())
    return float(np.count_nonzero(degrees >= 3)) * sure**_DOUBT


def _middle(photograph: Photograph, tile: tuple[int, int], scale: float) -> Photograph:
    """Return the part in the middle of a photograph that fills a few tiles at a scale."""
    width = min(photograph.width, max(1, round(_TRIED_TILES * tile[1] / scale)))
    height = min(photograph.height, max(1, round(_TRIED_TILES * tile[0] / scale)))
    left, top = (photograph.width - width) // 2, (photograph.height - height) // 2

    def read(x: float, y: float, w: float, h: float, shape: tuple[int, int]) -> tuple[AnyArray, BoolArray]:
        return photograph.read(left + x, top + y, w, h, shape)

    return Photograph(photograph.name, width, height, read)
