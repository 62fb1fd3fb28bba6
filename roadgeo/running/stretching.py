"""A scan whose pixels are not square, or nobody knows: the mask is stretched until it is located.

A facsimile, a film scanned too fast, a picture made to fit a page: along one side the ground is sampled finer than
along the other, by a factor that nobody wrote down. No camera sees ground so, and the search looks for what one sees.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, FloatArray
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.mask import RoadMask
from roadgeo.location import Location
from roadgeo.matching.options import LocateOptions
from roadgeo.reference.reference import AnyReference
from roadgeo.roads.graph import RoadGraph
from roadgeo.running.looks import Sighting
from roadgeo.workflows import locate

__all__ = ["STRETCHES", "ask_stretched"]

#: Widths of a pixel, in heights, that are tried where it is not known; between two of them the search finds its way.
STRETCHES = (0.83, 1.2, 0.7, 1.43, 0.58, 1.72, 0.5, 2.0)


def ask_stretched(
    sighting: Sighting,
    references: Sequence[AnyReference],
    options: LocateOptions,
    aspect: float | Literal["unknown"] = "unknown",
) -> Sighting:
    """Try a mask that is not located with pixels `aspect` times as wide as high; what is located first is the answer.

    Each try could agree by chance: together they pay for all of them.
    """
    if sighting.location.located:
        return sighting
    stretches = STRETCHES if aspect == "unknown" else (aspect,)
    paid = replace(options, min_log10_odds=options.min_log10_odds + math.log10(len(stretches)))
    for stretch in stretches:
        mask, to_stretched = _stretched(sighting.mask, stretch)
        found = locate(mask, references, paid)
        if found.located:
            return replace(sighting, location=_as_it_came(found, sighting.location, to_stretched))
    return sighting


def _stretched(mask: RoadMask, stretch: float) -> tuple[RoadMask, FloatArray]:
    """Return a mask with square pixels, of about as many, and (3, 3) from its pixels to those."""
    height, width = mask.shape
    new_width, new_height = round(width * math.sqrt(stretch)), round(height / math.sqrt(stretch))

    def resize(values: AnyArray) -> AnyArray:
        scaled = cv2.resize(values.astype(np.float32), (new_width, new_height), interpolation=cv2.INTER_LINEAR)
        return np.asarray(scaled > 0.5)

    observed, probability = None if mask.observed is None else resize(mask.observed), mask.probability
    if probability is not None:
        probability = cv2.resize(probability, (new_width, new_height), interpolation=cv2.INTER_NEAREST)
    to_stretched = np.diag([new_width / width, new_height / height, 1.0])
    return replace(mask, roads=resize(mask.roads), observed=observed, probability=probability), to_stretched


def _as_it_came(found: Location, refused: Location, to_stretched: FloatArray) -> Location:
    """Return the place of a mask that was located stretched, as it is of the mask itself; no camera saw it so."""
    if found.homography is None or refused.size is None or found.evidence is None:
        return found
    homography = found.homography @ to_stretched
    homography = homography / homography[2, 2]
    jacobian = Homography(homography).jacobian(Frame(*refused.size).center)
    wide, high = np.hypot(*jacobian)
    from_stretched, spent = 1.0 / to_stretched[[0, 1], [0, 1]], refused.seconds
    return replace(
        found,
        reason=f"{found.reason}; its pixels are {wide / high:.2f} times as wide as high",
        size=refused.size,
        homography=homography,
        camera=None,
        tilt_deg=None,
        seconds=replace(
            found.seconds,
            vectorize=spent.vectorize + found.seconds.vectorize,
            match=spent.match + found.seconds.match,
            refine=spent.refine + found.seconds.refine,
        ),
        evidence=replace(
            found.evidence,
            query_graph=_scaled(found.evidence.query_graph, from_stretched),
            query_xy=found.evidence.query_xy * from_stretched,
        ),
        seen=refused.seen,
    )


def _scaled(graph: RoadGraph, factors: FloatArray) -> RoadGraph:
    return replace(graph, xy=graph.xy * factors, coords=graph.coords * factors)
