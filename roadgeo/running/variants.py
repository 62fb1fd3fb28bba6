"""Variants of a query that no camera sees: mirrored, with pixels that are not square, or on another grid of pixels.

A scanner, or an array upside down, mirrors a mask; a facsimile, or a picture made to fit a page, samples the ground
finer along one side, by an unknown factor. Variants of a refused mask are tried, and the place of a variant that is
located is given in pixels of the mask.
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
from roadgeo.location import Location, Reason
from roadgeo.matching.explanation import Explanation
from roadgeo.matching.options import LocateOptions
from roadgeo.outputs.wording import format_lonlat
from roadgeo.reference.reference import AnyReference
from roadgeo.running.looks import Locate, Sighting, total_seconds
from roadgeo.running.options import ReadOptions

__all__ = ["STRETCHES", "Variant", "in_pixels_of", "mirrored", "resampled", "stretched", "try_variants"]

#: Limits of a try that is only mentioned: a mask that is merely turned over is mostly found in a tenth of it.
_WORK_LIMIT_S = 1.0
_WORTH_A_TRY = {Reason.NOTHING_STANDS_OUT, Reason.TIME_LIMIT}
#: Widths of a pixel, in heights, that are tried where it is not known; between two of them the search finds its way.
STRETCHES = (0.83, 1.2, 0.7, 1.43, 0.58, 1.72, 0.5, 2.0)


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


def mirrored(mask: RoadMask) -> Variant:
    """Return a mask turned over, left to right."""
    return _turned_over(Variant(mask, np.eye(3)))


def _turned_over(variant: Variant) -> Variant:
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
    order = _order_of_corners(location.size, size, matrix)
    changed: dict[str, Any] = {"size": size}
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
    if camera is not None:
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


# --- trying them ------------------------------------------------------------------------------------------------------


def try_variants(
    sighting: Sighting, references: Sequence[AnyReference], options: LocateOptions, reading: ReadOptions, how: Locate
) -> Sighting:
    """Try the variants of a refused mask; the first that is located is the answer, where the user allows for it.

    Stretched masks are tried where `reading.aspect` is given, and turned over where that is allowed. Else the mask is
    turned over, and a refusal mentions
    where it lies then: a mirrored image has no place, and only its owner knows how it came about. Where mirrored masks
    are allowed the search is as thorough as any. Each try could agree by chance: together they pay for all of them.
    """
    refused, may_mirror = sighting.location, reading.mirror == "allow"
    allowed = reading.aspect is not None or may_mirror
    if reading.aspect is not None:
        stretches = STRETCHES if reading.aspect == "unknown" else (reading.aspect,)
        asked, n_variants = not refused.located, len(stretches) * (1 + may_mirror)
        upright = (stretched(sighting.mask, stretch) for stretch in stretches)
        variants = (v for variant in upright for v in (variant, _turned_over(variant))[: 1 + may_mirror])
    else:
        asked = reading.mirror != "never" and refused.status == "not_located" and options.method != "pair"
        asked, n_variants = asked and refused.reason_code in _WORTH_A_TRY, 1
        variants = (mirrored(mask) for mask in [sighting.mask])
    if not asked:
        return sighting
    options = replace(options, min_log10_odds=options.min_log10_odds + math.log10(n_variants))
    if not allowed:
        options = _briefly(options)
    spent = refused.seconds
    for variant in variants:
        answer = how(variant.mask, references, options)
        found = answer.location if isinstance(answer, Explanation) else answer
        spent = total_seconds(spent, found.seconds)
        if found.located:
            location = _as_answer(found, variant, sighting.mask) if allowed else _mentioned(refused, found)
            return replace(sighting, location=replace(location, seconds=spent))
    return replace(sighting, location=replace(refused, seconds=spent))


def _briefly(options: LocateOptions) -> LocateOptions:
    """Return the options of a first sweep alone."""
    search = replace(options.search, work_limit_s=min(_WORK_LIMIT_S, options.search.work_limit_s))
    match = replace(options.match, without_roads=options.match.without_roads[:1])
    return replace(options, effort="quick", search=search, match=match)


def _as_answer(found: Location, variant: Variant, mask: RoadMask) -> Location:
    """Return the place of a variant as it is of the mask; no camera saw the ground so."""
    location = replace(in_pixels_of(found, mask.shape[::-1], variant.matrix), camera=None)
    if np.linalg.det(variant.matrix) < 0.0:
        reason = f"{found.reason}; the mask is mirrored, or the map is: it was turned over, left to right"
        return replace(location, reason=reason, mirrored=True)
    if location.homography is None:
        return location
    wide, high = np.hypot(*Homography(location.homography).jacobian(Frame(*mask.shape[::-1]).center))
    reason = f"{found.reason}; its pixels are {wide / high:.2f} times as wide as high"
    return replace(location, reason=reason, tilt_deg=None)


def _mentioned(refused: Location, found: Location) -> Location:
    """Return a refusal that mentions where the mask lies turned over."""
    if found.center is None:
        return refused
    where = format_lonlat(found.center.lon, found.center.lat)
    reason = (
        f"the mask is mirrored: turned over, left to right, it lies at {where} on {found.reference}; "
        "flip the image and locate it again. Or the map is mirrored, its x and y exchanged"
    )
    return replace(refused, reason=reason, reason_code=Reason.MIRRORED)
