"""Variants of a query: mirrored back, with square pixels, or on another grid of pixels.

A scanner, or an array upside down, mirrors a mask; a raster in degrees, or a picture made to fit a page, samples the
ground finer along one side. The part that is known, by hand or by the file, is undone before the search, and the place
is given in pixels of the mask.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, FloatArray
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.homography import Homography, shift
from roadgeo.geometry.mask import PIXEL_TO_PLANE, RoadMask, extent
from roadgeo.location import Location
from roadgeo.matching.explanation import Explanation
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.veto import without_hints
from roadgeo.reference.opening import AnyReference
from roadgeo.running.passes import Locate

__all__ = ["Judge", "Variant", "in_pixels_of", "mirrored", "resampled", "stretched", "trimmed", "undoing"]

_MIN_SIDE = 32  # pixels, of a part that is located by itself


@dataclass(frozen=True)
class Variant:
    """Another image of the ground that a mask shows.

    Attributes
    ----------
    mask : RoadMask
    matrix : (3, 3)
        Affine map from the query's pixels to the variant's.
    """

    mask: RoadMask
    matrix: FloatArray


def mirrored(variant: Variant) -> Variant:
    """Return a variant mirrored, left to right."""
    over = np.array([[-1.0, 0.0, variant.mask.shape[1]], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    return Variant(variant.mask.mirrored(), over @ variant.matrix)


def trimmed(mask: RoadMask) -> Variant:
    """Return a mask without the margins that were not observed: a place is judged over its whole frame."""
    variant = Variant(mask, np.eye(3))
    if mask.observed is None or not mask.observed.any():
        return variant
    part = rows, columns = extent(mask.observed)
    observed = mask.observed[part].copy()
    if min(observed.shape) < _MIN_SIDE or observed.size == mask.observed.size:
        return variant
    probability = None if mask.probability is None else mask.probability[part].copy()
    shown = RoadMask(mask.roads[part].copy(), None if observed.all() else observed, mask.name, probability)
    return Variant(shown, shift(-columns.start, -rows.start))


def stretched(variant: Variant, stretch: float) -> Variant:
    """Return a variant whose pixels are `stretch` times as wide as high with square pixels, of about as many."""
    height, width = variant.mask.shape
    square = resampled(variant.mask, (round(height / math.sqrt(stretch)), round(width * math.sqrt(stretch))))
    return Variant(square.mask, square.matrix @ variant.matrix)


def resampled(mask: RoadMask, shape: tuple[int, int]) -> Variant:
    """Return a mask on a grid of (H, W) pixels over the same frame."""
    size = shape[::-1]

    def resize(values: AnyArray) -> AnyArray:
        return np.asarray(cv2.resize(values.astype(np.float32), size, interpolation=cv2.INTER_LINEAR) > 0.5)

    observed, probability = None if mask.observed is None else resize(mask.observed), mask.probability
    if probability is not None:
        probability = cv2.resize(probability, size, interpolation=cv2.INTER_NEAREST)
    matrix = np.diag([shape[1] / mask.shape[1], shape[0] / mask.shape[0], 1.0])
    return Variant(replace(mask, roads=resize(mask.roads), observed=observed, probability=probability), matrix)


def in_pixels_of(location: Location, size: tuple[int, int], matrix: FloatArray) -> Location:
    """Return a variant's location in pixels of a query of (width, height), which `matrix` takes to the variant's."""
    places, content = tuple(place.in_pixels(size, matrix) for place in location.places), location.content
    if content is not None:
        back = Homography(PIXEL_TO_PLANE @ np.linalg.inv(matrix) @ PIXEL_TO_PLANE)
        graph = content.graph
        moved = None if graph is None else replace(graph, xy=back(graph.xy), coords=back(graph.coords))
        content = replace(content, size=size, graph=moved, xy=back(content.xy))
    return replace(location, places=places, content=content)


#: What places a variant of a mask of (H, W).
Judge = Callable[[Variant, tuple[int, int]], Location]


def undoing(how: Locate, aspect: float | None, mirror: bool, judge: Judge | None = None) -> Locate:
    """Return what locates a mask as `how` does: without margins, with square pixels, and mirrored back.

    Margins stay where hints are given: these are of the middle of the whole frame.

    Parameters
    ----------
    how : callable
        Unless there is a `judge`, which knows how the variant lies in the mask.
    aspect : float or None
        How many times a pixel is as wide as high; None: once.
    mirror : bool
        The mask is mirrored.
    """

    def locate(mask: RoadMask, references: Sequence[AnyReference], options: LocateOptions) -> Location | Explanation:
        def place(variant: Variant) -> Location | Explanation:
            return how(variant.mask, references, options) if judge is None else judge(variant, mask.shape)

        is_hinted = judge is None and without_hints(options) is not None  # of the middle of the whole frame
        part = Variant(mask, np.eye(3)) if is_hinted else trimmed(mask)
        variant = undone(part)
        answer = place(variant)
        if part.mask is not mask and any(one.lens_k1 for one in _location_of(answer).places):
            variant = undone(Variant(mask, np.eye(3)))  # a lens bends around the middle of the whole frame
            answer = place(variant)
        if variant.mask is mask:
            return answer
        located = _stating_pixels(in_pixels_of(_location_of(answer), mask.shape[::-1], variant.matrix), aspect)
        return replace(answer, location=located) if isinstance(answer, Explanation) else located

    def undone(variant: Variant) -> Variant:
        square = variant if aspect in (None, 1.0) else stretched(variant, aspect)
        return mirrored(square) if mirror else square

    return locate


def _location_of(answer: Location | Explanation) -> Location:
    return answer.location if isinstance(answer, Explanation) else answer


def _stating_pixels(location: Location, aspect: float | None) -> Location:
    """Return a location whose reason states the shape of the pixels on the ground, where they are not square."""
    place = location.place
    if place is None or aspect in (None, 1.0):
        return location
    wide, high = np.hypot(*Homography(place.matrix).jacobian(Frame(*place.size).center))
    return location.saying(f"its pixels are {wide / high:.2f} times as wide as high")
