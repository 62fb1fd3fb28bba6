"""Variants of a query: mirrored back, with square pixels, or on another grid of pixels.

A scanner, or an array upside down, mirrors a mask; a raster in degrees, or a picture made to fit a page, samples the
ground finer along one side. What is known of that, by hand or by the file, is undone before the search, and the place
is given in pixels of the mask.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, FloatArray, IntArray
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.mask import PIXEL_TO_PLANE, RoadMask
from roadgeo.location import Location
from roadgeo.matching.explanation import Explanation
from roadgeo.matching.options import LocateOptions
from roadgeo.reference.reference import AnyReference
from roadgeo.running.looks import Locate

__all__ = ["Variant", "in_pixels_of", "mirrored", "resampled", "stretched", "undoing"]

#: A camera's pixels are square to this share; what is stretched more has no camera that saw it.
_SQUARE = 0.02


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


def stretched(mask: RoadMask, stretch: float) -> Variant:
    """Return a mask whose pixels are `stretch` times as wide as high with square pixels, of about as many."""
    height, width = mask.shape
    return resampled(mask, (round(height / math.sqrt(stretch)), round(width * math.sqrt(stretch))))


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
    if location.size is None:
        return location
    side = math.sqrt(abs(float(np.linalg.det(matrix))))  # pixels of the variant for each of the query, along a side
    back = Homography(PIXEL_TO_PLANE @ Homography(matrix).inverse().matrix @ PIXEL_TO_PLANE)
    camera, homography, seen, evidence = location.camera, location.homography, location.seen, location.evidence
    order, turns = _order_of_corners(location.size, size, matrix), bool(np.linalg.det(matrix[:2, :2]) < 0.0)
    changed: dict[str, Any] = {"size": size, "mirrored": location.mirrored != turns}
    changed["alternatives"] = tuple(
        replace(
            place,
            footprint_lonlat=place.footprint_lonlat and tuple(place.footprint_lonlat[k] for k in order.tolist()),
            frame=place.frame and in_pixels_of(place.frame, size, matrix),
        )
        for place in location.alternatives
    )
    if homography is not None:
        homography = homography @ matrix
        changed.update(homography=homography / homography[2, 2], **_corners_of(location, order))
    if location.gsd_m is not None:
        changed["gsd_m"] = location.gsd_m * side
    if turns or abs(np.divide(*np.hypot(*matrix[:2, :2])) - 1.0) > _SQUARE:
        changed.update(camera=None, tilt_deg=None)
    elif camera is not None:
        changed["camera"] = replace(
            camera, focal_px=camera.focal_px / side, focal_sigma_px=camera.focal_sigma_px / side
        )
    if seen is not None:
        changed["seen"] = replace(seen, graph=_moved(seen.graph, back), xy=back(seen.xy))
    if evidence is not None:
        graph, xy = _moved(evidence.query_graph, back), back(evidence.query_xy)
        changed["evidence"] = replace(evidence, query_graph=graph, query_xy=xy)
    return replace(location, **changed)


def _order_of_corners(theirs: tuple[int, int], size: tuple[int, int], matrix: FloatArray) -> IntArray:
    """Return which corner of a variant of (width, height) each corner (4,) of the query is."""
    corners = Homography(matrix)(Frame(*size).corners)
    return np.asarray(np.hypot(*(corners[:, None] - Frame(*theirs).corners[None]).transpose(2, 0, 1)).argmin(axis=1))


def _corners_of(location: Location, order: IntArray) -> dict[str, Any]:
    """Return what is known of a variant's corners in the order of the query's."""
    pairs = np.stack([2 * order, 2 * order + 1], axis=1).ravel()
    covariance = location.corner_covariance_m2
    found = {name: getattr(location, name) for name in ("footprint", "footprint_lonlat", "corner_sigma_m")}
    return {
        **{name: None if values is None else values[order] for name, values in found.items()},
        "corner_covariance_m2": None if covariance is None else covariance[np.ix_(pairs, pairs)],
    }


def _moved(graph: Any, move: Homography) -> Any:
    """Return a road graph whose coordinates are moved."""
    return replace(graph, xy=move(graph.xy), coords=move(graph.coords))


def undoing(how: Locate, aspect: float | None, mirror: bool) -> Locate:
    """Return what locates a mask as `how` does, its pixels made square and itself mirrored back before the search.

    Parameters
    ----------
    aspect : float or None
        How many times a pixel is as wide as high; None: once.
    mirror : bool
        The mask is mirrored.
    """
    if aspect in (None, 1.0) and not mirror:
        return how

    def locate(mask: RoadMask, references: Sequence[AnyReference], options: LocateOptions) -> Location | Explanation:
        variant = Variant(mask, np.eye(3)) if aspect is None else stretched(mask, aspect)
        variant = mirrored(variant) if mirror else variant
        answer = how(variant.mask, references, options)
        found = answer.location if isinstance(answer, Explanation) else answer
        found = _stating_pixels(in_pixels_of(found, mask.shape[::-1], variant.matrix), aspect)
        return replace(answer, location=found) if isinstance(answer, Explanation) else found

    return locate


def _stating_pixels(location: Location, aspect: float | None) -> Location:
    """Return a location whose reason states the shape of the pixels on the ground, where they are not square."""
    if location.homography is None or location.size is None or aspect in (None, 1.0):
        return location
    wide, high = np.hypot(*Homography(location.homography).jacobian(Frame(*location.size).center))
    return replace(location, reason=f"{location.reason}; its pixels are {wide / high:.2f} times as wide as high")
