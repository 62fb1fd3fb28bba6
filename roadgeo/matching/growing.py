"""Proposals are screened by the roads around them, and grown outwards, intersection by intersection."""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterator, Sequence
from typing import Protocol, TypeAlias

import numpy as np

from roadgeo._arrays import BoolArray, IntArray
from roadgeo.geometry.camera import CameraOptions
from roadgeo.kernels.growth import grow_each
from roadgeo.kernels.roads import screen
from roadgeo.kernels.structs import GrowthLimits, GrowthQuery
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.place import Place
from roadgeo.matching.refinement import RefineOptions
from roadgeo.matching.scene import MAX_COSTLY, MIN_COS, Scene, and_pixels
from roadgeo.matching.search import ALONE, Ahead
from roadgeo.matching.triples import Proposals, Sweep

__all__ = [
    "MAX_GROWN",
    "MAX_SCALE_RATIO",
    "MAX_SCREENED",
    "MAX_VERIFIED",
    "Member",
    "SharedSweeps",
    "grow_proposals",
    "screen_proposals",
]


#: Greatest factor between the ground sampling anywhere in a tilted frame and in its middle.
MAX_SCALE_RATIO = 2.0
#: Bounds of an anchor's work: proposals screened, proposals grown, and grown places verified.
MAX_SCREENED, MAX_GROWN, MAX_VERIFIED = 600, 150, 3
#: Number of road points near the anchor, the share of them that must lie near roads, and the radius: the map's part in
#: metres, and the mask's in pixels.
_SCREEN_POINTS, _SCREEN_SHARE, _SCREEN_RADIUS = 40, 0.6, and_pixels(8.0)
#: Standard deviation of an intersection's place, and the greatest search radius, each in metres and in pixels.
_SIGMA, _RADIUS = and_pixels(3.5), and_pixels(20.0)
#: Sequential test: share of intersections that match at a right place and at a wrong place, and the nats lost before it
#: gives up.
_HIT_RATE, _CHANCE_RATE, _PATIENCE = 0.45, 0.08, 6.0
#: Least matches besides the seeds.
_MIN_MATCHED = 2


def screen_proposals(scene: Scene, index: ReferenceIndex, proposals: Proposals, looked_at: IntArray) -> IntArray:
    """Return the proposals among `looked_at` that put roads around the anchor on roads of the map, best first."""
    if len(looked_at) == 0:
        return looked_at
    anchor = scene.intersections.xy[proposals.anchor]
    away = np.hypot(*(scene.points - anchor).T)
    last = scene.neighbours[proposals.anchor]
    reach = np.hypot(*(scene.intersections.xy[last[last >= 0]] - anchor).T).max(initial=0.0)
    near = np.argsort(away, kind="stable")[:_SCREEN_POINTS]
    near = near[away[near] < reach]
    shares = np.zeros(len(looked_at))
    screen(
        proposals.reference[looked_at], proposals.affine[looked_at], anchor,
        index.xy, scene.points[near], scene.directions[near],
        *_SCREEN_RADIUS, MIN_COS, _SCREEN_SHARE, index.road_buckets, shares,
    )  # fmt: skip
    good = shares >= _SCREEN_SHARE
    kept, shares = looked_at[good], shares[good]
    return np.asarray(kept[np.argsort(-(proposals.placed[kept] + shares), kind="stable")])


def grow_proposals(
    scene: Scene,
    index: ReferenceIndex,
    proposals: Proposals,
    chosen: IntArray,
    camera: CameraOptions,
) -> list[Place]:
    """Grow the chosen proposals of an anchor; return those that were not given up, the best supported first."""
    if len(chosen) == 0:
        return []
    # The query: intersections outwards from the anchor, and the neighbours on which each proposal is based.
    xy, anchor = scene.intersections.xy, proposals.anchor
    order = np.argsort(np.hypot(*(xy - xy[anchor]).T), kind="stable")[:MAX_COSTLY]  # the nearest to the anchor
    partners = np.ascontiguousarray(proposals.partners[chosen])
    neighbours = np.ascontiguousarray(scene.neighbours[:, : partners.shape[1]])
    matched = np.empty((len(chosen), len(xy)), np.int64)
    matrices = np.empty((len(chosen), 3, 3))
    ratios = np.empty(len(chosen))
    perspective = camera.perspective_sigma(RefineOptions.perspective_sigma)
    limits = GrowthLimits(_SIGMA, _RADIUS, MIN_COS, perspective, _HIT_RATE, _CHANCE_RATE, _PATIENCE)
    grow_each(
        GrowthQuery(xy, scene.branches, neighbours, order, scene.half_size, anchor),
        proposals.reference[chosen], proposals.affine[chosen], partners,
        index.point_buckets, limits, _MIN_MATCHED, matched, matrices, ratios,
    )  # fmt: skip
    best = np.argsort(-ratios, kind="stable")[: np.isfinite(ratios).sum()]  # others were given up
    return [Place(scene, index, matrices[m] / matrices[m, 2, 2], float(ratios[m]), False, matched[m]) for m in best]


class Member(Protocol):
    """A part of a search, as the sweeps that it shares with others know it (see `estimator.Member`)."""

    index: ReferenceIndex
    whole: list[Place]  # that fit the whole frame

    def allow(self, proposals: Proposals) -> BoolArray:
        """Return which proposals (M,) the hints allow."""

    def screen(self, proposals: Proposals, allowed: BoolArray, most: int) -> IntArray:
        """Return the proposals, of the `most` best placed, that put roads on roads."""

    def follow_up(self, proposals: Proposals, chosen: IntArray) -> Iterator[Place]:
        """Yield the different places that grow from the chosen proposals, the best supported first."""

    def enough(self) -> bool:
        """Return whether enough places were screened."""


#: The places that grew from an anchor's proposals and are not taken yet, by the identity of their part.
_Grown: TypeAlias = dict[int, list[Place]]


class SharedSweeps:
    """The sweeps shared by the parts of a search; each part takes its own places from them.

    Attributes
    ----------
    members : list
        The parts; all must join before the first takes a place.
    """

    def __init__(self, scene: Scene, camera: CameraOptions, ahead: Ahead = ALONE) -> None:
        """Begin without parts."""
        self.scene, self.camera, self.ahead = scene, camera, ahead
        self.members: list[Member] = []
        self._rounds: dict[int, Iterator[_Grown]] = {}  # by the identity of a sweep
        self._done: dict[int, list[_Grown]] = {}

    def rounds(self, member: Member, sweep: Sweep) -> Iterator[list[Place]]:
        """Yield the places that grew on a part from each anchor's proposals, until enough were screened."""
        rounds = self._rounds.setdefault(id(sweep), self._work(sweep))
        done = self._done.setdefault(id(sweep), [])
        n = 0
        while True:
            if n == len(done):
                grown = next(rounds, None)
                if grown is None:
                    return
                done.append(grown)
            yield done[n].pop(id(member), [])
            n += 1

    def end(self) -> None:
        """Drop the parts: each refers to this object, and the cycle would keep their maps open for a while."""
        self.members.clear()
        self._rounds.clear()
        self._done.clear()

    def _work(self, sweep: Sweep) -> Iterator[_Grown]:
        low, high = self.camera.gsd_m
        scale = (low / MAX_SCALE_RATIO, high * MAX_SCALE_RATIO)
        if self.members[0].enough():
            return
        indexes = [member.index for member in self.members]
        for proposals in sweep.proposals(self.scene, indexes, scale, self.camera.min_shape_ratio, self.ahead):
            if self.members[0].enough():
                return
            yield self._grow(proposals)

    def _grow(self, proposals: Sequence[Proposals]) -> _Grown:
        """Grow an anchor's proposals on all parts; return the best places that grew, by the part's identity."""
        members = self.members
        allowed = [member.allow(own) for member, own in zip(members, proposals, strict=True)]
        # The best placed are screened ...
        placed = [own.placed[may] for own, may in zip(proposals, allowed, strict=True)]
        kept = [
            member.screen(own, may, most)
            for member, own, may, most in zip(members, proposals, allowed, _best(placed, MAX_SCREENED), strict=True)
        ]
        # ... an even share of those that lie on roads grows ...
        share = min(MAX_GROWN / max(sum(map(len, kept)), 1), 1.0)
        grown = [
            _owned(member, member.follow_up(own, rows[: math.ceil(share * len(rows))]))
            for member, own, rows in zip(members, proposals, kept, strict=True)
            if len(rows)
        ]
        # ... and the best of these are verified.
        best: list[tuple[Member, Place]] = []
        for member, place in heapq.merge(*grown, key=lambda pair: -pair[1].support):
            if not self._is_met(place, best):
                best.append((member, place))
                if len(best) == MAX_VERIFIED:
                    break
        return {id(member): [place for owner, place in best if owner is member] for member, _ in best}

    def _is_met(self, place: Place, best: Sequence[tuple[Member, Place]]) -> bool:
        """Return whether another shard that overlaps this one has the same place."""
        met = [*(other for _, other in best), *(other for member in self.members for other in member.whole)]
        beside = (other for other in met if other.index is not place.index and other.index.is_shard_beside(place.index))
        return any(other.same(place) for other in beside)


def _owned(member: Member, grown: Iterator[Place]) -> Iterator[tuple[Member, Place]]:
    """Yield the places that grew, each with its part."""
    return ((member, place) for place in grown)


def _best(placed: Sequence[IntArray], most: int) -> IntArray:
    """Return how many of each part's proposals, the best placed first, are among the best `most` of all.

    Parts take turns where proposals are equal.
    """
    counts = np.array([len(own) for own in placed])
    if counts.sum() <= most:
        return counts
    owners = np.repeat(np.arange(len(placed)), counts)
    all_placed = np.concatenate(placed)
    turns = np.concatenate([np.arange(len(own)) - np.searchsorted(-own, -own) for own in placed])
    chosen = np.lexsort((turns, -all_placed))[:most]
    return np.bincount(owners[chosen], minlength=len(placed))
