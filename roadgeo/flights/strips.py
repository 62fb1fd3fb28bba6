"""Strips of an archive: frames that overlap, in no order, are solved together and placed together.

Each pair of frames is registered, by features of their pictures or by their roads. The resulting links make
one or more nets; in each, all frames are adjusted at once, so that every link agrees with the others, and the mosaic of
all is located like one mask. There each frame is fitted to the roads of the map by itself.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from roadgeo._arrays import AnyArray, FloatArray
from roadgeo.flights.mosaic import draw_mosaic, road_px
from roadgeo.flights.motion import TracedMask, between_images, overlay
from roadgeo.flights.tracker import AROUND, FlightFrame, Tracked, Tracker, TrackOptions, why_refused
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.homography import Homography, map_each
from roadgeo.geometry.mask import PIXEL_TO_PLANE
from roadgeo.matching.checking import check_place
from roadgeo.matching.scene import read_query
from roadgeo.reference.reference import Reference
from roadgeo.workflows import locate

__all__ = ["Link", "adjust", "find_links", "find_nets", "place_strips"]


#: Standard deviation of a frame in a located mosaic, and of where a link puts a corner.
_START_SIGMA_M, _LINK_PX = 8.0, 12.0
#: Log10 odds against places nearby by which a frame agrees with the map.
_LEAST_ODDS = 1.0
#: A link is left out if it puts a frame's corners this share of its half diagonal off where the others put them.
_MOST_GAP = 0.25


@dataclass(frozen=True)
class Link:
    """Two frames that overlap.

    Attributes
    ----------
    first, other : int
    motion : (3, 3) float64
        Pixel of `other` to pixel of `first`.
    weight : float
        How sure it is.
    """

    first: int
    other: int
    motion: FloatArray
    weight: float


def place_strips(
    frames: Sequence[tuple[FlightFrame, AnyArray | None]],
    references: Sequence[Reference],
    options: TrackOptions | None = None,
) -> list[Tracked]:
    """Place frames of one or more strips; return a row for each, in the order in which they lie beside another.

    Parameters
    ----------
    frames : sequence of (FlightFrame, (H, W) uint8 or None)
        Their motion is not looked at; beside each its picture in grey, where there is one.
    """
    options = replace(options or TrackOptions(), start_sigma_m=_START_SIGMA_M, least_odds=_LEAST_ODDS)
    stills = [frame for frame, _ in frames]
    links = find_links(stills, [grey for _, grey in frames])
    placed: list[Tracked] = []
    for net, matrices in find_nets([still.frame for still in stills], links):
        order = _along(matrices, stills[net[0]].frame, [stills[k].name for k in net])
        members = [replace(stills[net[k]], number=n, time_s=stills[n].time_s) for n, k in enumerate(order, len(placed))]
        of_net = _Net(members, matrices[order], _within([net[k] for k in order], links), options)
        placed += of_net.place(references)
    return placed


@dataclass(frozen=True)
class _Net:
    """Frames that hang together: (K, 3, 3) from the pixels of each to one plane, and the links between them."""

    frames: Sequence[FlightFrame]
    matrices: FloatArray
    links: Sequence[Link]
    options: TrackOptions

    def place(self, references: Sequence[Reference]) -> list[Tracked]:
        """Locate all of them as one mosaic, or else each alone; from the surest the others are placed, link by link."""
        tracker, why = Tracker(references, self.options), "no roads are seen"
        for chosen in [range(len(self.frames)), *([k] for k in range(len(self.frames)) if len(self.frames) > 1)]:
            placed, said = self._locate(tracker, list(chosen), references)
            placed = [tracked for tracked in placed if self._stands(tracked)]
            if placed:
                surest = max(placed, key=lambda tracked: tracked.log10_odds)
                return self._spread(tracker, self.frames.index(surest.frame), surest)
            why = said if len(chosen) > 1 or len(self.frames) == 1 else why
        return [Tracked(frame, "lost", why, frame.number) for frame in self.frames]

    def _locate(
        self, tracker: Tracker, chosen: Sequence[int], references: Sequence[Reference]
    ) -> tuple[list[Tracked], str]:
        """Return the frames that were placed by the mosaic of some; none, and why."""
        frames = [self.frames[k] for k in chosen]
        masks = [frame.mask for frame in frames]
        if not any(mask.roads.any() for mask in masks):
            return [], "no roads are seen"
        mosaic = draw_mosaic(masks, self.matrices[list(chosen)], road_px(masks))
        if mosaic is None:
            return [], "the frames do not fit together on one plane"
        options = tracker.search_options(mosaic, masks)
        paid = math.log10(1 + len(self.frames))  # one search each: any could agree by chance
        location = locate(
            mosaic.mask, references, replace(options, min_log10_odds=round(options.min_log10_odds + paid, 1))
        )
        if not location.located:
            why = why_refused(location)
            return [], f"{len(frames)} frames together: {why}" if len(frames) > 1 else why
        placed = [tracked for tracked in tracker.place(location, mosaic, frames) if tracked.status == "located"]
        return placed, "a place was found, but the frames by themselves do not agree"

    def _spread(self, tracker: Tracker, first: int, surest: Tracked) -> list[Tracked]:
        """Place frames beside those that are placed, along the surest links first."""
        placed = {first: surest}
        left = sorted(self.links, key=lambda link: -link.weight)
        while (
            link := next((link for link in left if (link.first in placed) != (link.other in placed)), None)
        ) is not None:
            left.remove(link)
            at, to = (link.first, link.other) if link.first in placed else (link.other, link.first)
            motion = link.motion if at == link.first else np.asarray(np.linalg.inv(link.motion), float)
            frame = replace(self.frames[to], motion=motion, motion_px=_LINK_PX)
            beside = tracker.place_beside(placed[at], frame)
            if self._stands(beside):
                placed[to] = beside
        why = "its roads do not agree with the map where its neighbours put it"
        return [placed.get(k, Tracked(frame, "lost", why, frame.number)) for k, frame in enumerate(self.frames)]

    def _stands(self, tracked: Tracked) -> bool:
        """Whether a frame is where it was put, and not a block beside; a frame without roads is."""
        if tracked.status == "predicted":
            return math.isnan(tracked.log10_odds)
        if tracked.status != "located" or tracked.pose is None or tracked.reference is None:
            return False
        query = read_query(tracked.frame.mask)
        start = tracked.pose.homography.matrix @ PIXEL_TO_PLANE
        checked = check_place(start / start[2, 2], query, tracked.reference.index, AROUND, beyond=False)
        return checked.verdict == "agrees"


def find_links(frames: Sequence[FlightFrame], greys: Sequence[AnyArray | None]) -> list[Link]:
    """Lay each frame on each other: by their pictures where both have one, otherwise by their roads."""
    traced = [TracedMask.of(frame.mask) if grey is None else None for frame, grey in zip(frames, greys, strict=True)]
    links = []
    for i, j in combinations(range(len(frames)), 2):
        if frames[i].mask.shape != frames[j].mask.shape:
            continue
        links += [Link(i, j, *measured) for measured in _link(traced[i], traced[j], greys[i], greys[j])]
    return links


def _link(
    first: TracedMask | None, other: TracedMask | None, grey: AnyArray | None, other_grey: AnyArray | None
) -> list[tuple[FloatArray, float]]:
    if grey is not None and other_grey is not None:
        motion = between_images(grey, other_grey)
        return [] if motion is None else [(motion, 1.0)]
    return [] if first is None or other is None else overlay(first, other)


def find_nets(frames: Sequence[Frame], links: Sequence[Link]) -> list[tuple[list[int], FloatArray]]:
    """Return the nets that links make, the largest first: its frames, and (K, 3, 3) from their pixels to one plane."""
    nets = [[k] for k in range(len(frames))]
    at: list[FloatArray] = [np.eye(3) for _ in frames]
    kept: list[Link] = []
    for link in sorted(links, key=lambda link: -link.weight):
        mine = next(net for net in nets if link.first in net)
        theirs = next(net for net in nets if link.other in net)
        if mine is not theirs:  # the surest links join nets: those join as rigid wholes
            move = at[link.first] @ link.motion @ np.linalg.inv(at[link.other])
            for k in theirs:
                at[k] = move @ at[k]
                at[k] = at[k] / np.cbrt(np.linalg.det(at[k]))
            mine += theirs
            nets.remove(theirs)
        elif _gap(at[link.first] @ link.motion, at[link.other], frames[link.other]) > _MOST_GAP:
            continue
        kept.append(link)
    nets.sort(key=len, reverse=True)
    return [(net, adjust([at[k] for k in net], frames[net[0]], _within(net, kept))) for net in nets]


def _within(net: Sequence[int], links: Sequence[Link]) -> list[Link]:
    """Return the links of a net, numbered in it."""
    number = {k: n for n, k in enumerate(net)}
    return [replace(link, first=number[link.first], other=number[link.other]) for link in links if link.first in number]


def _gap(a: FloatArray, b: FloatArray, frame: Frame) -> float:
    """Return how far apart two homographies put a frame's corners, in half diagonals of where the second puts them."""
    there, here = (Homography(matrix).facing(frame.center)(frame.corners) for matrix in (a, b))
    size = np.hypot(*(here[2:] - here[:2]).T).mean() / 2.0
    gap = np.hypot(*(there - here).T).max() / size
    return float(gap) if np.isfinite(gap) else np.inf


def adjust(start: Sequence[FloatArray], frame: Frame, links: Sequence[Link]) -> FloatArray:
    """Adjust homographies (K, 3, 3) of frames of one size to one plane, so that all links agree as well as they can.

    The first stays. Minimised is the distance between the places of an overlap's corners by the two frames of a link.
    """
    matrices = np.stack(start)
    if len(matrices) < 3 or not links:
        return matrices
    unit = np.array([[frame.half_diagonal, 0.0, frame.center[0]], [0.0, frame.half_diagonal, frame.center[1]]])
    to_pixel = np.vstack((unit, (0.0, 0.0, 1.0)))
    local = matrices @ to_pixel
    local = local / local[:, 2:, 2:]
    scale = np.abs(local[0, :2, :2]).max()
    base = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * 0.6
    points = np.stack([Homography(np.linalg.inv(to_pixel) @ link.motion @ to_pixel)(base) for link in links])
    firsts, others = (np.array([getattr(link, name) for link in links]) for name in ("first", "other"))
    weight = np.sqrt([link.weight for link in links])[:, None, None] / scale

    def residuals(free: FloatArray) -> FloatArray:
        moved = local.copy()
        moved[1:].reshape(-1, 9)[:, :8] += free.reshape(-1, 8) * step
        gap = map_each(moved[firsts], points) - map_each(moved[others], np.broadcast_to(base, points.shape))
        return np.asarray((weight * gap).ravel())

    step = np.array([1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0 / scale, 1.0 / scale]) * scale
    from scipy.optimize import least_squares

    free = least_squares(residuals, np.zeros(8 * (len(local) - 1)), loss="soft_l1", f_scale=0.02, max_nfev=30).x
    local[1:].reshape(-1, 9)[:, :8] += free.reshape(-1, 8) * step
    return np.asarray(local @ np.linalg.inv(to_pixel))


def _along(matrices: FloatArray, frame: Frame, names: Sequence[str]) -> list[int]:
    """Return the order of frames along the line on which they lie, from the end whose name comes first."""
    middles = np.stack([Homography(matrix).facing(frame.center)(frame.center) for matrix in matrices])
    away = middles - middles.mean(axis=0)
    axis = np.linalg.svd(away)[2][0]
    order: list[int] = np.argsort(away @ axis, kind="stable").tolist()
    return order if names[order[0]] <= names[order[-1]] else order[::-1]
