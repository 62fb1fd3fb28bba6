"""How a frame moved against the one before: from a file, from the photographs, or from the roads that both masks show.

A motion is a homography, pixel (column, row; GDAL's corner convention) of a frame to pixel of the frame before.
"""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, FloatArray
from roadgeo.errors import MaskError, RoadSourceError
from roadgeo.flights.pose import FEWEST, FilterOptions, correct, start
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.mask import PIXEL_TO_PLANE, RoadMask
from roadgeo.kernels.roads import road_residuals
from roadgeo.kernels.structs import RoadBuckets
from roadgeo.matching.index import bucket_roads, neighbour_grid
from roadgeo.matching.scene import MIN_COS, Scene, trace_query
from roadgeo.roads.graph import RoadGraph
from roadgeo.storage.tables import read_rows, read_text

__all__ = ["Odometer", "TracedMask", "between_images", "between_masks", "overlay", "read_motion"]

_COLUMNS = [f"h{i}{j}" for i in range(3) for j in range(3)]

#: Photographs are compared at no more than this side; number of features, and of those that must agree on a homography.
_IMAGE_SIDE, _FEATURES, _FEWEST_FEATURES = 1000, 2000, 25

#: Masks are compared roughly at about this side, turned by these angles, and shifted by up to this share of a frame.
_ROUGH_SIDE, _TURNS_DEG, _FARTHEST = 96, (-12.0, -8.0, -4.0, 0.0, 4.0, 8.0, 12.0), 0.7

#: How far a rough motion may be off: shift in pixels of the rough grid, turn, scale and the rest as shares of a frame.
_SHIFT_CELLS, _LINEAR_SIGMA, _CORNER_SIGMA = 3.0, 0.05, 0.008
#: Side of the buckets in which roads of a mask are looked up.
_BUCKET_PX = 32.0
#: The least share of road points in the overlap that must lie on roads of the other mask.
_LEAST_SHARE = 0.6
#: Frames in no order are registered where they share this part: less agrees by chance.
_LEAST_SHARED = 0.3
#: Flights go on as they went: the middle of a frame moves by no more than this share of a frame otherwise than before,
#: and the score of a motion that differs is reduced by this much, per frame's side; unless a jump fits clearly better.
_STEADY, _OTHERWISE = 0.1, 1.28
#: How well a motion must fit (see `_Alignment`) that goes on as the frame's before, and how well any other; by how much
#: it must then lead all others.
_LEAST_AGAIN, _LEAST_FIRST, _LEAD_FIRST = 0.3, 0.55, 0.06
#: How far off a corner may be put by masks, by masks that are equal, and by taking the flight to go on as it went; and
#: how often in a row it is.
_MASKS_PX, _STILL_PX, _HELD_PX, _MOST_HELD = 12.0, 1.0, 30.0, 2
_FILTER = FilterOptions(
    sigma_m=2.0,
    sigma_px=1.0,
    correlation_m=60.0,
    radii=((40.0, 3.0), (25.0, 2.5), (16.0, 2.0), (10.0, 2.0), (8.0, 1.5), (8.0, 1.5)),
    least_radius_m=6.0,
)


def read_motion(path: str | os.PathLike[str]) -> dict[str, FloatArray]:
    """Read motions by the frames' names: a CSV file with the columns `frame` and `h00` ... `h22`, row by row.

    Raises
    ------
    RoadSourceError
        There is no such file, or it is no such table.
    """
    text = read_text(path, "a CSV file of motions")
    try:
        rows = read_rows(text)
        matrices = {row["frame"]: np.array([float(row[name]) for name in _COLUMNS]).reshape(3, 3) for row in rows}
    except (KeyError, ValueError, TypeError, csv.Error) as error:
        raise RoadSourceError(
            f"{path} is no table of motions ({type(error).__name__}: {error}); expected the columns frame, h00 ... h22"
        ) from error
    bad = [name for name, matrix in matrices.items() if not np.isfinite(matrix).all() or not np.linalg.det(matrix)]
    if bad or not matrices:
        what = f"frame {bad[0]} has no homography" if bad else "it has no rows"
        raise RoadSourceError(f"{path} is no table of motions: {what}; expected 3 x 3 numbers that can be inverted")
    return matrices


# --- photographs ------------------------------------------------------------------------------------------------------


def between_images(before: AnyArray, image: AnyArray) -> FloatArray | None:
    """Return the motion between two grey photographs (H, W) uint8; None where hardly anything is seen in both."""
    scale = min(1.0, _IMAGE_SIDE / max(*image.shape, *before.shape))
    finder = cv2.ORB_create(_FEATURES)  # type: ignore[attr-defined]
    features = [
        finder.detectAndCompute(cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), None)
        for grey in (before, image)
    ]
    if any(descriptors is None or len(points) < _FEWEST_FEATURES for points, descriptors in features):
        return None
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(features[1][1], features[0][1])
    if len(pairs) < _FEWEST_FEATURES:
        return None
    source = np.array([features[1][0][pair.queryIdx].pt for pair in pairs])
    target = np.array([features[0][0][pair.trainIdx].pt for pair in pairs])
    matrix, agree = cv2.findHomography(source, target, cv2.USAC_MAGSAC, 2.0, maxIters=5000, confidence=0.999)
    if matrix is None or int(agree.sum()) < _FEWEST_FEATURES:
        return None
    # OpenCV counts from pixel centres, and of the reduced pictures.
    shrink = np.array([[scale, 0.0, -0.5], [0.0, scale, -0.5], [0.0, 0.0, 1.0]])
    return np.asarray(np.linalg.inv(shrink) @ matrix @ shrink)


def _half_turn(frame: Frame) -> FloatArray:
    return np.array([[-1.0, 0.0, frame.width], [0.0, -1.0, frame.height], [0.0, 0.0, 1.0]])


# --- masks ------------------------------------------------------------------------------------------------------------


@dataclass
class Odometer:
    """Estimates how each mask of a flight moved; where masks do not show it, it goes on as it went, a frame or two.

    A mask that equals the one before did not move: the link stood still, and the flight goes on after it.
    """

    _traced: TracedMask | None = None
    _motion: FloatArray | None = None
    _held: int = 0

    def move(self, before: RoadMask, mask: RoadMask) -> tuple[FloatArray | None, float]:
        """Return the motion of a mask against the one before, None where it is unknown; and its standard deviation.

        Returns
        -------
        (3, 3) float64 or None
        float
            Standard deviation of a corner, pixels.
        """
        if mask.roads.any() and np.array_equal(before.roads, mask.roads):
            return np.eye(3), _STILL_PX
        previous = self._traced if self._traced is not None and self._traced.mask is before else TracedMask.of(before)
        self._traced = TracedMask.of(mask)
        motion = (
            None if previous is None or self._traced is None else between_masks(previous, self._traced, self._motion)
        )
        if motion is not None:
            self._motion, self._held = motion, 0
            return motion, _MASKS_PX
        self._held += 1
        if self._held > _MOST_HELD:
            self._motion = None
        return self._motion, _HELD_PX


class _Alignment(NamedTuple):
    """A mask registered to another: how, the shares of either's roads that agree, and of the frame that both see.

    Where frames share less, less can disagree: the quality is the agreement, times the root of the shared part.
    """

    motion: FloatArray
    there: float
    back: float
    shared: float

    @property
    def agreement(self) -> float:
        return 0.5 * (self.there + self.back)

    @property
    def fit(self) -> float:
        return self.agreement * math.sqrt(self.shared)

    def rivals(self, other: _Alignment) -> bool:
        """Whether it fits, or agrees where enough is shared, about as well: streets that repeat do."""
        agrees = self.shared >= _LEAST_SHARED and self.agreement > other.agreement - _LEAD_FIRST
        return agrees or self.fit > other.fit - _LEAD_FIRST


def between_masks(first: TracedMask, other: TracedMask, last: FloatArray | None = None) -> FloatArray | None:
    """Return the motion (3, 3) of `other` against `first` by the roads that both show; None where those do not fix it.

    Parameters
    ----------
    last : (3, 3) float64, optional
        The motion of the frame before: flights go on as they went, unless the roads clearly show another motion.
    """
    height, width = other.mask.shape
    frame = Frame(width, height)
    guesses = [*([] if last is None else [last]), *_rough_motions(first.mask, other.mask, 2 * len(_TURNS_DEG))]
    alignments = [alignment for guess in guesses if (alignment := _lay(guess, frame, first, other)) is not None]
    steady = None if last is None else _steadiest(alignments, last, frame)
    if steady is not None and all(steady.rivals(other) for other in alignments):
        return steady.motion
    surest = _surest(alignments, frame)
    return None if surest is None else surest.motion


def _surest(alignments: Sequence[_Alignment], frame: Frame) -> _Alignment | None:
    """Return the alignment that fits best; None where that is little, or another one fits as well."""
    best = max(alignments, key=lambda alignment: alignment.fit, default=None)
    if best is None or best.fit < _LEAST_FIRST:
        return None
    others = (other for other in alignments if not _is_same_motion(other.motion, best.motion, frame))
    return None if any(other.rivals(best) for other in others) else best


def _steadiest(alignments: Sequence[_Alignment], last: FloatArray, frame: Frame) -> _Alignment | None:
    """Return the alignment that fits best, and goes on as the motion before; None where that is little."""
    ranked = [
        (alignment.fit - _OTHERWISE * off, alignment)
        for alignment in alignments
        if (off := _otherwise(alignment.motion, last, frame)) < _STEADY
    ]
    fit, best = max(ranked, key=lambda pair: pair[0], default=(0.0, None))
    return best if fit >= _LEAST_AGAIN else None


def _lay(guess: FloatArray, frame: Frame, first: TracedMask, other: TracedMask) -> _Alignment | None:
    """Lay a mask on another, near a rough motion; None where they hardly share a road."""
    corners = Homography(guess).facing(frame.center)(frame.corners)
    if not np.isfinite(corners).all():
        return None
    pose = start(corners * (1.0, -1.0), frame, _rough_covariance(frame))
    placed = correct(pose, other.scene, first.roads, _FILTER)
    if placed is None:
        return None
    motion = PIXEL_TO_PLANE @ placed.homography.matrix
    motion = np.asarray(motion / motion[2, 2])
    there = _agreement(motion, frame, other.scene, first.roads)
    back = _agreement(np.asarray(np.linalg.inv(motion), float), frame, first.scene, other.roads)
    return _Alignment(motion, there, back, _shared(motion, frame))


@dataclass(frozen=True)
class TracedMask:
    """A mask, traced, that is registered to many others."""

    mask: RoadMask
    scene: Scene
    roads: RoadBuckets

    @classmethod
    def of(cls, mask: RoadMask) -> TracedMask | None:
        """Trace a mask; None where it shows no roads."""
        try:
            scene, graph = trace_query(mask)
        except MaskError:
            return None
        return cls(mask, scene, _buckets(graph))


def overlay(first: TracedMask, other: TracedMask) -> list[tuple[FloatArray, float]]:
    """Register a mask to another that was taken anywhere near, either way up, where their roads agree.

    Where streets are alike there may be two such places, a block apart; none means that they do not overlap.

    Returns
    -------
    list of ((3, 3) float64, float)
        Pixel of `other` to pixel of `first`, and how sure that is: the share of roads that agree, of the mask that has
        less, times the share of the frame that both see. The surest first.
    """
    height, width = other.mask.shape
    frame = Frame(width, height)
    alignments: list[_Alignment | None] = []
    for turn in (np.eye(3), _half_turn(frame)):
        shown = other.mask if turn[0, 0] > 0 else replace(other.mask, roads=other.mask.roads[::-1, ::-1].copy())
        alignments += [_lay(guess @ turn, frame, first, other) for guess in _rough_motions(first.mask, shown, 4)]
    overlaps = [
        (alignment.motion, min(alignment.there, alignment.back) * alignment.shared)
        for alignment in alignments
        if alignment is not None
        and min(alignment.there, alignment.back) >= _LEAST_SHARE
        and alignment.shared >= _LEAST_SHARED
    ]
    distinct: list[tuple[FloatArray, float]] = []
    for motion, sure in sorted(overlaps, key=lambda pair: -pair[1]):
        if not any(_is_same_motion(motion, chosen, frame) for chosen, _ in distinct):
            distinct.append((motion, sure))
    return distinct[:3]


def _is_same_motion(a: FloatArray, b: FloatArray, frame: Frame) -> bool:
    apart = Homography(a)(frame.center) - Homography(b)(frame.center)
    return bool(np.hypot(*apart) < 0.05 * frame.half_diagonal)


def _shared(motion: FloatArray, frame: Frame) -> float:
    """Return the share of a frame that the other one sees, too."""
    there = Homography(motion).facing(frame.center)(frame.grid(10, 0.05))
    return float(((there > 0) & (there < (frame.width, frame.height))).all(axis=1).mean())


def _otherwise(motion: FloatArray, last: FloatArray, frame: Frame) -> float:
    """Return by how much the middle of a frame moved otherwise than before, as a share of the frame's longer side."""
    moved, before = (Homography(matrix)(frame.center) for matrix in (motion, last))
    return float(np.hypot(*(moved - before)) / max(frame.width, frame.height))


def _rough_covariance(frame: Frame) -> FloatArray:
    """Return how unsure a rough motion is: (8, 8) of the corners, which mostly shift, turn and grow together."""
    unit = frame.half_diagonal
    x, y = ((frame.plane_corners - frame.plane_center) / unit).T
    zeros, ones = np.zeros(4), np.ones(4)
    modes = np.stack([np.stack(pair, axis=1).ravel() for pair in ((ones, zeros), (zeros, ones), (x, y), (-y, x))])
    sigmas = np.array([_SHIFT_CELLS * max(frame.width, frame.height) / _ROUGH_SIDE] * 2 + [_LINEAR_SIGMA * unit] * 2)
    return np.asarray((modes.T * sigmas**2) @ modes + np.eye(8) * (_CORNER_SIGMA * unit) ** 2)


def _agreement(motion: FloatArray, frame: Frame, scene: Scene, roads: RoadBuckets) -> float:
    """Return the share of road points inside the other frame that lie on its roads; 0 where hardly any are inside."""
    pixels = Homography(motion)(scene.points * (1.0, -1.0))
    inside = np.asarray(((pixels > 0) & (pixels < (frame.width, frame.height))).all(axis=1))
    if inside.sum() < 0.1 * len(inside) or inside.sum() < FEWEST:
        return 0.0
    matrix = PIXEL_TO_PLANE @ motion @ PIXEL_TO_PLANE
    points, along = (np.ascontiguousarray(array[inside]) for array in (scene.points, scene.directions))
    radii, ways = np.full(len(points), 6.0), np.empty((len(points), 3))
    return road_residuals(matrix, points, along, radii, MIN_COS, roads, ways) / len(points)


def _buckets(graph: RoadGraph) -> RoadBuckets:
    """Sort the roads of a traced mask into buckets, so that they can be looked up like a map's."""
    parts = [np.hstack([line[:-1], line[1:]]) for line in graph.polylines()]
    segments = np.ascontiguousarray(np.concatenate(parts), np.float32)
    return bucket_roads(segments, *neighbour_grid(segments.reshape(-1, 2).astype(float), _BUCKET_PX))


def _rough_motions(before: RoadMask, mask: RoadMask, count: int) -> list[FloatArray]:
    """Return the shifts at which the roads of two masks cover each other most, of the two best of each turn."""
    height, width = mask.shape
    scale = _ROUGH_SIDE / max(height, width)
    size = (round(width * scale), round(height * scale))
    grown = (2 * size[1], 2 * size[0])
    fixed = np.conj(np.fft.rfft2(_soft(before.roads, size), grown))
    center, motions = np.array([width, height]) / 2.0, []
    reduced = _soft(mask.roads, size)
    for degrees in _TURNS_DEG:
        turn = cv2.getRotationMatrix2D(((size[0] - 1) / 2.0, (size[1] - 1) / 2.0), degrees, 1.0)
        moved = np.fft.rfft2(cv2.warpAffine(reduced, turn, size), grown)
        cover = np.fft.irfft2(np.conj(fixed * moved), grown)
        rows, columns = (np.fft.fftfreq(n, 1.0 / n) for n in grown)
        far = (np.abs(rows)[:, None] > _FARTHEST * size[1]) | (np.abs(columns)[None] > _FARTHEST * size[0])
        # Where frames overlap less, less can agree.
        shared = (1.0 - np.abs(rows)[:, None] / size[1]).clip(0.1) * (1.0 - np.abs(columns)[None] / size[0]).clip(0.1)
        rating = np.where(far, -np.inf, cover / np.sqrt(shared))
        angle = math.radians(degrees)
        # OpenCV's angles turn counterclockwise as seen, in pixels with rows downwards.
        rotation = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
        for _ in range(2):
            row, column = np.unravel_index(int(np.argmax(rating)), rating.shape)
            shift = np.array([columns[column], rows[row]]) / scale
            motion = np.eye(3)
            motion[:2, :2], motion[:2, 2] = rotation, center - rotation @ center + shift
            motions.append((float(rating[row, column]), motion))
            around = (np.abs(rows - rows[row]) < 8)[:, None] & (np.abs(columns - columns[column]) < 8)[None]
            rating[around] = -np.inf
    motions.sort(key=lambda pair: -pair[0])
    return [motion for _, motion in motions[:count]]


def _soft(roads: AnyArray, size: tuple[int, int]) -> AnyArray:
    """Reduce a mask (H, W) bool to a size (width, height), blurred, with mean 0."""
    soft = cv2.GaussianBlur(cv2.resize(roads.astype(np.float32), size, interpolation=cv2.INTER_AREA), (0, 0), 1.0)
    return np.asarray(soft - soft.mean(), np.float32)
