"""A scan whose pixels are not square, or nobody knows: the mask is stretched until it is located.

A facsimile, a film scanned too fast, a picture made to fit a page: along one side the ground is sampled finer than
along the other, by an unknown factor. No camera sees ground so, and the search looks for views of cameras.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from roadgeo.geometry.frame import Frame
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.mask import RoadMask
from roadgeo.location import Location
from roadgeo.matching.options import LocateOptions
from roadgeo.reference.reference import AnyReference
from roadgeo.running.looks import Sighting
from roadgeo.running.regridding import of_own_pixels, on_grid
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
    """Try a refused mask with pixels `aspect` times as wide as high; the first that is located is the answer.

    Each try could agree by chance: together they pay for all of them.
    """
    if sighting.location.located:
        return sighting
    stretches = STRETCHES if aspect == "unknown" else (aspect,)
    paid = replace(options, min_log10_odds=options.min_log10_odds + math.log10(len(stretches)))
    for stretch in stretches:
        found = locate(_stretched(sighting.mask, stretch), references, paid)
        if found.located:
            return replace(sighting, location=_as_it_came(found, sighting.location))
    return sighting


def _stretched(mask: RoadMask, stretch: float) -> RoadMask:
    """Return a mask with square pixels, of about as many."""
    height, width = mask.shape
    return on_grid(mask, (round(height / math.sqrt(stretch)), round(width * math.sqrt(stretch))))


def _as_it_came(found: Location, refused: Location) -> Location:
    """Return the place of a mask that was located stretched, as it is of the mask itself; no camera saw it so."""
    if refused.size is None:
        return found
    own, spent = of_own_pixels(found, refused.size), refused.seconds
    if own.homography is None:
        return own
    wide, high = np.hypot(*Homography(own.homography).jacobian(Frame(*refused.size).center))
    return replace(
        own,
        reason=f"{found.reason}; its pixels are {wide / high:.2f} times as wide as high",
        gsd_m=found.gsd_m,
        camera=None,
        tilt_deg=None,
        seconds=replace(
            found.seconds,
            vectorize=spent.vectorize + found.seconds.vectorize,
            match=spent.match + found.seconds.match,
            refine=spent.refine + found.seconds.refine,
        ),
        seen=refused.seen,
    )
