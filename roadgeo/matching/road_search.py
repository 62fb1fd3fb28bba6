"""The search by roads: intersections spread over the frame vote for places, and what they propose grows by roads."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import NamedTuple

import numpy as np

from roadgeo._arrays import IntArray
from roadgeo.geometry.camera import CameraOptions
from roadgeo.matching.ahead import ALONE, Ahead
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.refinement import RefineOptions
from roadgeo.matching.road_growth import Grown, RoadGrower, RoadGrowOptions
from roadgeo.matching.road_votes import VoteOptions, Voter, Votes
from roadgeo.matching.scene import Scene
from roadgeo.matching.triples import farthest_first, larger

__all__ = ["COARSE_PIXEL_M", "RoadRound", "RoadSearch", "RoadSearchOptions", "Turnout"]

#: The smallest pixels that are looked for on a map of coarseness 1; of a coarse map so many times as large.
COARSE_PIXEL_M = 0.35

#: How far a proposal, made of two branches, may turn the image's up from where it points.
_ROUGHLY_DEG = 25.0


@dataclass(frozen=True)
class RoadSearchOptions:
    """How much is tried.

    Attributes
    ----------
    max_anchors : int
        So many intersections of the query vote, spread over the frame from its middle outwards.
    max_tried, least_anchors : int
        Fewer vote, but at least so many, once so many places and turns were tried on a map of 15,000 intersections, and
        on a larger one more by the root of the ratio; of a map in parts, on all of them together. In a lattice every
        crossing can be turned four ways.
    max_grown, max_kept : int
        So many of an anchor's proposals grow, and so many of what grew are compared with the map, where all anchors
        vote; where a mask has fewer intersections, more of each (see `each_of`).
    scale_slack : float
        Around an anchor the ground sampling may differ by this factor from that at the middle of the frame.
    least_share : float
        As of `RefineOptions`, where false roads abound.
    road_width_m, telling_width_px : (low, high), float
        Where roads are drawn at least so many pixels wide, they are no thin lines, and only scales are tried at which
        they are so wide on the ground.
    far_m : float
        Pixels that are greater hardly show what is around an intersection: a place given by near is not looked for
        further away than frames of such pixels reach.
    least_gsd_m : float
        Smaller pixels are not tried: they show more than a coarse map.
    """

    votes: VoteOptions = field(default_factory=VoteOptions)
    grow: RoadGrowOptions = field(default_factory=RoadGrowOptions)
    max_anchors: int = 30
    max_tried: int = 400_000
    least_anchors: int = 8
    max_grown: int = 20
    max_kept: int = 2
    scale_slack: float = 1.2
    least_share: float = 0.2
    road_width_m: tuple[float, float] = (2.0, 75.0)
    telling_width_px: float = 6.0
    far_m: float = 5.0
    least_gsd_m: float = 0.0

    def on(self, coarseness: float) -> RoadSearchOptions:
        """Return them for a map of some coarseness: on a coarse one more lies around an intersection."""
        if coarseness == 1.0:
            return self
        far_m, least_gsd_m = coarseness * self.far_m, coarseness * COARSE_PIXEL_M
        return replace(self, votes=self.votes.on(coarseness), far_m=far_m, least_gsd_m=least_gsd_m)

    def scales(self, camera: CameraOptions, road_width_px: float) -> tuple[float, float]:
        """Return the least and greatest ground sampling around an intersection to try."""
        low, high = camera.gsd_m
        low, high = max(low / self.scale_slack, self.least_gsd_m), high * self.scale_slack
        high = max(high, low)
        if road_width_px < self.telling_width_px:
            return low, high
        least, most = (width / road_width_px for width in self.road_width_m)
        return (max(low, least), min(high, most)) if least < high and most > low else (low, high)

    def each_of(self, n_voters: int) -> RoadSearchOptions:
        """Return them for so many intersections that vote: as many proposals are followed in all as of `max_anchors`.

        Up to five times as many of each: a mask of few intersections has few chances.
        """
        more = max(1, min(5, self.max_anchors // max(n_voters, 1)))
        go_on = tuple(more * n for n in self.grow.go_on)
        grow = replace(self.grow, go_on=(go_on[0], go_on[1], go_on[2]))
        votes = replace(self.votes, kept=more * self.votes.kept)
        return replace(self, votes=votes, grow=grow, max_grown=more * self.max_grown, max_kept=more * self.max_kept)

    def refinement(self, usual: RefineOptions) -> RefineOptions:
        """Return how what grew by roads is refined."""
        return replace(usual, least_share=self.least_share)


@dataclass
class Turnout:
    """How many intersections of a query vote: as many on each part of a map, until enough was tried on all together.

    Attributes
    ----------
    n_map : int
        Intersections of all parts.
    n_tried : int
        Places and turns tried on them so far.
    last : int or None
        How many vote in the end, once that is known.
    """

    options: RoadSearchOptions
    n_map: int
    n_tried: int = 0
    last: int | None = None
    _asked: int = field(default=0, init=False)

    def includes(self, n: int) -> bool:
        """Whether the n-th votes, from 0; the part that comes to it first decides for all."""
        options = self.options
        if self.last is None and n >= self._asked:
            self._asked = n + 1
            if n >= options.least_anchors and self.n_tried >= options.max_tried * larger(self.n_map):
                self.last = n
        return self.last is None or n < self.last


class RoadRound(NamedTuple):
    """What came of one query intersection: how many proposals were to grow, and those that did.

    The anchor is -1 where only a part of a large map was looked at.
    """

    anchor: int
    n_proposed: int
    grown: list[Grown]


class RoadSearch:
    """Proposes places for a scene on a map by roads alone.

    Attributes
    ----------
    n_tried : int
        Places and turns tried so far.
    """

    def __init__(
        self,
        scene: Scene,
        index: ReferenceIndex,
        camera: CameraOptions,
        options: RoadSearchOptions,
        near: tuple[float, float, float] | None = None,
        ahead: Ahead = ALONE,
        turnout: Turnout | None = None,
    ) -> None:
        """`near` = (x, y, radius) in plane metres restricts where the middle of the frame may lie.

        Parts that are searched together share the `turnout`.
        """
        options = options.each_of(len(scene.intersections))
        self.scene, self.options, self.ahead = scene, options, ahead
        self.n_tried = 0
        self.turnout = turnout or Turnout(options, len(index))
        scale = options.scales(camera, scene.road_width_px)
        center, off = camera.heading or (0.0, 180.0)
        max_turn = min(math.radians(abs(center) + off + _ROUGHLY_DEG), math.pi)
        candidates = _within(index, near, scene.half_size * min(scale[1], max(options.far_m, scale[0])))
        self.voter = Voter(scene, index, scale, max_turn, candidates, options.votes)
        self._tried: set[int] = set()
        perspective = camera.perspective_sigma(options.grow.perspective_sigma)
        self.grower = RoadGrower(scene, index, replace(options.grow, perspective_sigma=perspective))

    def rounds(self, only: Sequence[int] | None = None) -> Iterator[RoadRound]:
        """Yield what grew of one anchor's proposals after another; between parts of a large map nothing.

        `only` names the anchors to try. None is tried twice.
        """
        xy, options = self.scene.intersections.xy, self.options
        anchors = islice(farthest_first(xy, np.arange(len(xy))), options.max_anchors) if only is None else only
        for n, (anchor, steps) in enumerate(self.ahead.map(self._vote, anchors)):
            if only is None and not self.turnout.includes(n):
                return
            if anchor in self._tried:
                continue
            self._tried.add(anchor)
            for tried, votes in steps:
                self.n_tried += tried
                self.turnout.n_tried += tried
                if votes is None:
                    yield RoadRound(-1, 0, [])
                    continue
                best = slice(options.max_grown)
                grown = self.grower.grow(anchor, votes.reference[best], votes.affine[best])
                some = sorted(grown, key=lambda one: -one.closeness)
                yield RoadRound(anchor, len(votes.reference[best]), some[: options.max_kept])

    def _vote(self, anchor: int) -> tuple[int, Iterable[tuple[int, Votes | None]]]:
        """Return an anchor and its votes, step by step; in threads all of them are there at once."""
        steps = self.voter.votes(anchor)
        return anchor, steps if self.ahead.threads == 1 else list(steps)


def _within(index: ReferenceIndex, near: tuple[float, float, float] | None, reach_m: float) -> IntArray:
    """Return the map's intersections that a frame around a place in the circle may show."""
    if near is None:
        return np.arange(len(index))
    return np.flatnonzero(np.hypot(*(index.xy - near[:2]).T) < near[2] + reach_m)
