"""At which scale a photograph is shown to a model, where nobody says how large its pixels are.

A few scales are tried on the middle of the photograph. At the right one many intersections are seen with confidence;
at coarser ones roads run into each other, at finer ones they fall apart and the model is in doubt.
"""

from __future__ import annotations

import math

import numpy as np

from roadgeo._arrays import AnyArray, BoolArray
from roadgeo.errors import MaskError
from roadgeo.roads.vectorization import vectorize
from roadgeo.sources.segmentation.network import Network
from roadgeo.sources.segmentation.photograph import Photograph
from roadgeo.sources.segmentation.probability import NODATA, ProbabilityMap
from roadgeo.sources.segmentation.tiling import MAX_MAP_PIXELS, map_shape, segment

__all__ = ["PYRAMID", "rank_scales", "scale_of", "score"]

#: Pixels shown to the model for each of the photograph's, along a side; steps that a model of many scales bridges.
PYRAMID = (1.0, 0.5, 2.0, 0.25, 0.125)

_DEFAULT_RESOLUTION_M = 1.0
_MIN_SIDE, _MAX_ENLARGED = 192, 4096  # pixels at the model's scale
_TRIED_TILES = 1.9  # side of the part that is tried, tiles: 2 x 2 of them cover it
_DOUBT = 4  # power of the share of probability that lies on roads


def scale_of(gsd_m: float, network: Network) -> float:
    """Return the scale that shows a model ground of its own resolution."""
    return gsd_m / (network.card.resolution_m or _DEFAULT_RESOLUTION_M)


def rank_scales(photograph: Photograph, network: Network) -> list[float]:
    """Return the scales at which anything like roads is seen in the middle of a photograph, the best first."""
    scored: list[tuple[float, int, float]] = []
    for scale in PYRAMID:
        shape = map_shape(photograph, scale)
        if min(shape) < _MIN_SIDE or math.prod(shape) > MAX_MAP_PIXELS or (scale > 1 and max(shape) > _MAX_ENLARGED):
            continue
        try:
            part = _middle(photograph, network.card.tile, scale)
            found = score(segment(part, network, scale)) / (part.width * part.height)
        except MaskError:  # no ground in the middle
            found = 0.0
        scored.append((found, -len(scored), scale))
    if not scored:
        return [min(1.0, math.sqrt(MAX_MAP_PIXELS / (photograph.width * photograph.height)))]
    return [scale for _, _, scale in sorted(scored, reverse=True)]


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
