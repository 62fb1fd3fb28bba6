"""Sweeps over all parts of one search: an intersection of the query is looked for on all of them at a time.

Its proposals are bounded as on one map: of all parts together the best proposals are screened, of those that lie on
roads as many are grown, and of these the best are verified. So a search of many parts takes little longer than that
of one, and the place has to be better than chance on each of them only once.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

from roadgeo._arrays import IntArray
from roadgeo.geometry.camera import CameraOptions
from roadgeo.matching import growing
from roadgeo.matching.ahead import ALONE, Ahead
from roadgeo.matching.hypothesis import Hypothesis
from roadgeo.matching.road_search import Turnout
from roadgeo.matching.scene import Scene
from roadgeo.matching.triples import Proposals, Sweep

if TYPE_CHECKING:
    from roadgeo.matching.estimator import TripleEstimator

__all__ = ["SharedSweeps", "Stage"]


class Stage(NamedTuple):
    """A sweep: its number among the stages of a search, and where its proposals come from."""

    number: int
    source: Sweep


#: Whether hypotheses on two parts are one place of one map, which is cut into overlapping pieces.
SamePlace: TypeAlias = "Callable[[TripleEstimator, Hypothesis, TripleEstimator, Hypothesis], bool]"


class SharedSweeps:
    """The sweeps of the parts of one search; each part takes from them what concerns it.

    Attributes
    ----------
    members : list
        The parts; all have joined before the first takes anything.
    """

    def __init__(
        self,
        scene: Scene,
        camera: CameraOptions,
        same_place: SamePlace | None = None,
        ahead: Ahead = ALONE,
    ) -> None:
        """Begin without parts. `same_place` is asked of hypotheses on different parts."""
        self.scene, self.camera, self.same_place, self.ahead = scene, camera, same_place, ahead
        self.members: list[TripleEstimator] = []
        self._rounds: dict[int, Iterator[_Round]] = {}
        self._done: dict[int, list[_Round]] = {}
        self._turnouts: dict[float, Turnout] = {}

    def rounds(self, member: TripleEstimator, stage: Stage) -> Iterator[list[Hypothesis]]:
        """Yield places that grew on a part from the proposals of one anchor after another, until enough were seen."""
        rounds = self._rounds.setdefault(stage.number, self._work(stage))
        done = self._done.setdefault(stage.number, [])
        n = 0
        while True:
            if n == len(done):
                one = next(rounds, None)
                if one is None:
                    return
                done.append(one)
            yield done[n].grown.pop(id(member), [])
            n += 1

    def pending(self, member: TripleEstimator, stage: int, anchor: int) -> list[Hypothesis]:
        """Return places that grew on a part from an anchor and were not taken yet."""
        found = (one.grown.pop(id(member), []) for one in self._done.get(stage, []) if one.anchor == anchor)
        return next(found, [])

    def turnout(self, coarseness: float) -> Turnout:
        """Return how many intersections of the scene vote, on all parts of some coarseness alike."""
        n_map = sum(len(member.index) for member in self.members if member.index.coarseness == coarseness)
        return self._turnouts.setdefault(coarseness, Turnout(n_map))

    def end(self) -> None:
        """Let go of the parts: each holds on to this, and a cycle would keep their maps open for a while."""
        self.members.clear()
        self._rounds.clear()
        self._done.clear()

    def _work(self, stage: Stage) -> Iterator[_Round]:
        low, high = self.camera.gsd_m
        scale = (low / growing.MAX_SCALE_RATIO, high * growing.MAX_SCALE_RATIO)
        if self.members[0].enough():
            return
        indexes = [member.index for member in self.members]
        for proposals in stage.source.proposals(self.scene, indexes, scale, self.camera.min_shape_ratio, self.ahead):
            if self.members[0].enough():
                return
            yield _Round(proposals[0].anchor, self._grow(proposals, stage))

    def _grow(self, proposals: Sequence[Proposals], stage: Stage) -> dict[int, list[Hypothesis]]:
        """Follow one anchor's proposals on all parts; return the best places that grew, by the part's identity."""
        members = self.members
        # The best placed are screened ...
        allowed = [member.allow(one) for member, one in zip(members, proposals, strict=True)]
        placed = [one.placed[may] for one, may in zip(proposals, allowed, strict=True)]
        kept = [
            member.screen(one, may, most, stage)
            for member, one, may, most in zip(
                members, proposals, allowed, _best(placed, growing.MAX_SCREENED), strict=True
            )
        ]
        # ... an even share of those that lie on roads grows ...
        share = min(growing.MAX_GROWN / max(sum(map(len, kept)), 1), 1.0)
        grown = [
            _owned(member, member.follow_up(one, rows[: math.ceil(share * len(rows))], stage))
            for member, one, rows in zip(members, proposals, kept, strict=True)
            if len(rows)
        ]
        # ... and the best of these are verified.
        best: list[tuple[TripleEstimator, Hypothesis]] = []
        for member, hypothesis in heapq.merge(*grown, key=lambda pair: -pair[1].support):
            if not self._is_met(member, hypothesis, best):
                best.append((member, hypothesis))
                if len(best) == growing.MAX_VERIFIED:
                    break
        return {id(member): [one for owner, one in best if owner is member] for member, _ in best}

    def _is_met(
        self, member: TripleEstimator, hypothesis: Hypothesis, best: Sequence[tuple[TripleEstimator, Hypothesis]]
    ) -> bool:
        """Whether another part that overlaps this one has the same place."""
        if self.same_place is None:
            return False
        known = [(other, one) for other in self.members for one in other.known_places()]
        return any(
            other is not member and self.same_place(member, hypothesis, other, one) for other, one in (*best, *known)
        )


def _owned(member: TripleEstimator, grown: Iterator[Hypothesis]) -> Iterator[tuple[TripleEstimator, Hypothesis]]:
    """Yield the places that grew, each with its part."""
    return ((member, hypothesis) for hypothesis in grown)


class _Round(NamedTuple):
    """The places that grew from an anchor's proposals, by the identity of their part; without those taken."""

    anchor: int
    grown: dict[int, list[Hypothesis]]


def _best(placed: Sequence[IntArray], most: int) -> IntArray:
    """Return how many of each part's proposals, the best placed first, are among the best `most` of all.

    Of equals each part gives one in turn.
    """
    counts = np.array([len(one) for one in placed])
    if counts.sum() <= most:
        return counts
    owners = np.repeat(np.arange(len(placed)), counts)
    all_placed = np.concatenate(placed)
    turns = np.concatenate([np.arange(len(one)) - np.searchsorted(-one, -one) for one in placed])
    chosen = np.lexsort((turns, -all_placed))[:most]
    return np.bincount(owners[chosen], minlength=len(placed))
