"""The search by roads: intersections spread over the frame vote for places, and their proposals grow by roads."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import NamedTuple

import numpy as np

from roadgeo._arrays import FloatArray, IntArray
from roadgeo.geometry.camera import CameraOptions
from roadgeo.kernels.road_growth import Stages, grow_by_roads
from roadgeo.matching.ahead import ALONE, Ahead
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.road_votes import Voter, Votes
from roadgeo.matching.scene import MIN_COS, Scene
from roadgeo.matching.triples import farthest_first, larger

__all__ = ["COARSE_PIXEL_M", "Grown", "RoadGrower", "RoadRound", "RoadSearch", "Turnout", "followed_more", "scales"]

#: Road points used, and the part of half the frame's diagonal up to which an affine map will do.
_MAX_POINTS, _AFFINE_UNTIL = 700, 0.45
#: A proposal withers where fewer of the points around it lie on roads. Wrong ones end at 0.3 to 0.4, masks of which
#: 40 % are gone and 40 % false at 0.5 and more.
_LEAST_SHARE = 0.3
#: Points within the sum of metres and pixels of a road lie on it.
_TOLERANCE_M, _TOLERANCE_PX = 7.0, 2.0
#: Prior standard deviation of the two perspective parameters.
_PERSPECTIVE_SIGMA = 0.4
#: After each of the first stages this number of an intersection's proposals go on, those that lie closest to roads, and
#: those that had most votes. Of 396 intersections of which one of 40 proposals led to the place of a broken mask 395 do
#: so still, at half the time; in lattices 255 of 266, at a quarter.
_GO_ON, _SURE = (16, 6, 3), 2


@dataclass(frozen=True)
class Grown:
    """A grown proposal: query plane to reference plane (3, 3), and how close to roads the road points lie, 0 to 1."""

    anchor: int
    matrix: FloatArray
    closeness: float


class RoadGrower:
    """Grows proposals of one scene on one map."""

    def __init__(self, scene: Scene, index: ReferenceIndex, camera: CameraOptions, more: int = 1) -> None:
        """`more` times as many proposals as usual go on after each stage."""
        self.scene, self.index = scene, index
        first, second, third = (more * n for n in _GO_ON)
        perspective = camera.perspective_sigma(_PERSPECTIVE_SIGMA)
        self._stages = Stages(_AFFINE_UNTIL, _LEAST_SHARE, perspective, MIN_COS, (first, second, third), _SURE)
        thin = max(1, len(scene.dense_points) // _MAX_POINTS)
        self.points, self.directions = scene.dense_points[::thin], scene.dense_directions[::thin]
        self._anchor, self._outwards = -1, (self.points, self.directions)

    def grow(self, anchor: int, references: IntArray, affines: FloatArray) -> list[Grown]:
        """Grow proposals of query intersection `anchor`; return those that did not wither, in their order.

        `references` (M,) are the map intersections that it is laid on, `affines` (M, 4) how: 2 x 2, row-major.
        """
        half_size = self.scene.half_size
        at = self.scene.intersections.xy[anchor]
        points, directions = self._outwards_from(anchor)
        j00, j01, j10, j11 = np.asarray(affines, float).T
        gsd = np.sqrt(j00 * j11 - j01 * j10)
        zero = np.zeros_like(gsd)
        ps = np.stack([j00 / gsd, j01 / gsd, zero, j10 / gsd, j11 / gsd, zero, zero, zero], axis=1)
        units, origins = half_size * gsd, self.index.xy[references]
        tolerances = _TOLERANCE_M + _TOLERANCE_PX * gsd
        closeness = np.empty(len(gsd))
        roads = self.index.road_buckets
        grow_by_roads(ps, units, origins, tolerances, points, directions, self._stages, roads, closeness)
        from_query = np.array([[1.0, 0.0, -at[0]], [0.0, 1.0, -at[1]], [0.0, 0.0, half_size]])
        grown = []
        for k in np.flatnonzero(closeness >= 0.0):
            (x, y), unit = origins[k], units[k]
            to_reference = np.array([[unit, 0.0, x], [0.0, unit, y], [0.0, 0.0, 1.0]])
            matrix = to_reference @ np.append(ps[k], 1.0).reshape(3, 3) @ from_query
            matrix = matrix / (matrix[2] @ np.append(self.scene.center, 1.0))
            grown.append(Grown(anchor, np.asarray(matrix), float(closeness[k])))
        return grown

    def _outwards_from(self, anchor: int) -> tuple[FloatArray, FloatArray]:
        """Return the road points around an intersection, the nearest first, normalised, and the roads' directions.

        Kept: an intersection makes many proposals.
        """
        if anchor != self._anchor:
            away = self.points - self.scene.intersections.xy[anchor]
            order = np.argsort(np.hypot(*away.T), kind="stable")
            self._anchor, self._outwards = anchor, (away[order] / self.scene.half_size, self.directions[order])
        return self._outwards


#: The smallest pixels that are tried on a map of coarseness 1; a coarse map multiplies them by its coarseness.
COARSE_PIXEL_M = 0.35

#: How far a proposal, made of two branches, may turn the image's up from where it points.
_ROUGHLY_DEG = 25.0
#: Number of intersections of the query that vote, spread over the frame from its middle outwards.
_MAX_ANCHORS = 30
#: Fewer vote, but at least the second number, once the first number of places was tried on 15,000 intersections, on a
#: larger map more by the root of the ratio; of a map in parts, on all of them together. In a lattice every crossing can
#: be turned four ways.
_MAX_TRIED, _LEAST_ANCHORS = 400_000, 8
#: Number of an anchor's proposals that grow, and of those that are then compared with the map, where all vote; a
#: mask of few intersections has few chances: up to the third number of times as many then.
_MAX_GROWN, _MAX_KEPT, _MOST_MORE = 20, 2, 5
#: Around an anchor the ground sampling may differ by this factor from that at the middle of the frame.
_SCALE_SLACK = 1.2
#: Roads drawn at least this many pixels wide are no thin lines, and only scales are tried at which their
#: width on the ground lies in this range, metres.
_TELLING_WIDTH_PX, _ROAD_WIDTH_M = 6.0, (2.0, 75.0)
#: Greater pixels hardly show the surroundings of an intersection: a place given by near is not searched further
#: away than frames of such pixels reach.
_FAR_M = 5.0


def scales(camera: CameraOptions, road_width_px: float, coarseness: float = 1.0) -> tuple[float, float]:
    """Return the least and greatest ground sampling around an intersection to try.

    Small pixels show more than a coarse map.
    """
    low, high = camera.gsd_m
    low, high = low / _SCALE_SLACK, high * _SCALE_SLACK
    if coarseness != 1.0:
        low = max(low, coarseness * COARSE_PIXEL_M)
    high = max(high, low)
    if road_width_px < _TELLING_WIDTH_PX:
        return low, high
    least, most = (width / road_width_px for width in _ROAD_WIDTH_M)
    return (max(low, least), min(high, most)) if least < high and most > low else (low, high)


def followed_more(n_voters: int) -> int:
    """Return how many times more proposals of each intersection are followed: in all, as many as usual."""
    return max(1, min(_MOST_MORE, _MAX_ANCHORS // max(n_voters, 1)))


@dataclass
class Turnout:
    """How many intersections of a query vote: as many on each part of a map, until enough was tried on all together.

    Attributes
    ----------
    n_map : int
        Intersections of all parts.
    n_tried : int
        Places and turns tried on them until now.
    last : int or None
        How many vote in the end, once that is known.
    """

    n_map: int
    n_tried: int = 0
    last: int | None = None
    _asked: int = field(default=0, init=False)

    def includes(self, n: int) -> bool:
        """Whether the n-th votes, from 0; the part that comes to it first decides for all."""
        if self.last is None and n >= self._asked:
            self._asked = n + 1
            if n >= _LEAST_ANCHORS and self.n_tried >= _MAX_TRIED * larger(self.n_map):
                self.last = n
        return self.last is None or n < self.last


class RoadRound(NamedTuple):
    """The results of one query intersection: how many proposals were to grow, and those that did.

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
        Places and turns tried until now.
    """

    def __init__(
        self,
        scene: Scene,
        index: ReferenceIndex,
        camera: CameraOptions,
        near: tuple[float, float, float] | None = None,
        ahead: Ahead = ALONE,
        turnout: Turnout | None = None,
    ) -> None:
        """`near` = (x, y, radius) in plane metres restricts where the middle of the frame may lie.

        Parts that are searched together share the `turnout`.
        """
        more, coarseness = followed_more(len(scene.intersections)), index.coarseness
        self.scene, self.ahead = scene, ahead
        self.n_tried, self._max_grown, self._max_kept = 0, more * _MAX_GROWN, more * _MAX_KEPT
        self.turnout = turnout or Turnout(len(index))
        scale = scales(camera, scene.road_width_px, coarseness)
        center, off = camera.heading or (0.0, 180.0)
        max_turn = min(math.radians(abs(center) + off + _ROUGHLY_DEG), math.pi)
        candidates = _within(index, near, scene.half_size * min(scale[1], max(coarseness * _FAR_M, scale[0])))
        self.voter = Voter(scene, index, scale, max_turn, candidates, more)
        self._tried: set[int] = set()
        self.grower = RoadGrower(scene, index, camera, more)

    def rounds(self, only: Sequence[int] | None = None) -> Iterator[RoadRound]:
        """Yield the places that grew of one anchor's proposals after another; between parts of a large map nothing.

        `only` names the anchors to try. None is tried twice.
        """
        xy = self.scene.intersections.xy
        anchors = islice(farthest_first(xy, np.arange(len(xy))), _MAX_ANCHORS) if only is None else only
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
                best = slice(self._max_grown)
                grown = self.grower.grow(anchor, votes.reference[best], votes.affine[best])
                some = sorted(grown, key=lambda one: -one.closeness)
                yield RoadRound(anchor, len(votes.reference[best]), some[: self._max_kept])

    def _vote(self, anchor: int) -> tuple[int, Iterable[tuple[int, Votes | None]]]:
        """Return an anchor and its votes, step by step; in threads all of them are there at once."""
        steps = self.voter.votes(anchor)
        return anchor, steps if self.ahead.threads == 1 else list(steps)


def _within(index: ReferenceIndex, near: tuple[float, float, float] | None, reach_m: float) -> IntArray:
    """Return the map's intersections that a frame around a place in the circle may show."""
    if near is None:
        return np.arange(len(index))
    return np.flatnonzero(np.hypot(*(index.xy - near[:2]).T) < near[2] + reach_m)
