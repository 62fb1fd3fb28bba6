"""Passes over a query's intersections that propose places by triples: how many, and how widely they look."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Protocol

from roadgeo.matching.ahead import ALONE, Ahead
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.scene import Scene
from roadgeo.matching.triples import Proposals, TripleOptions, propose, smaller

__all__ = ["BEFORE_ROADS", "WITHOUT_ROADS", "Source", "Sweep"]


class Source(Protocol):
    """Where hypotheses come from: `Sweep` makes them of triples."""

    def proposals(
        self,
        scene: Scene,
        indexes: Sequence[ReferenceIndex],
        scale: tuple[float, float],
        min_ratio: float,
        ahead: Ahead = ALONE,
    ) -> Iterator[list[Proposals]]:
        """Yield proposals for one query intersection after another on each index, the most promising first.

        `scale` = (least, greatest) root of the determinant of a proposed map, metres per pixel; `min_ratio` is the
        least ratio of its singular values. `ahead` looks for the next intersections meanwhile.
        """


@dataclass(frozen=True)
class Sweep:
    """One pass over the query's anchors: how many, and how widely their triples are looked up.

    Attributes
    ----------
    triples : TripleOptions
    max_anchors : int
        On a map of 15,000 intersections or more; on a smaller one, where each takes less time, more.
    most_more : float
        At most by this factor.
    """

    triples: TripleOptions
    max_anchors: int
    most_more: float = 3.0

    def proposals(
        self,
        scene: Scene,
        indexes: Sequence[ReferenceIndex],
        scale: tuple[float, float],
        min_ratio: float,
        ahead: Ahead = ALONE,
    ) -> Iterator[list[Proposals]]:
        """Yield the proposals of the anchors (see `Source`)."""
        anchors = propose(scene, indexes, scale, min_ratio, self.triples, ahead)
        more = min(smaller(sum(map(len, indexes))), self.most_more)
        return islice(anchors, int(self.max_anchors * more))


#: Where the rarest triples lead nowhere, more neighbours are taken, all over the frame.
_FURTHER = TripleOptions(n_neighbours=12, max_hits=20_000, max_compared=500_000, spread=True, angle_tolerance_deg=7.5)
_SECOND = Sweep(_FURTHER, 30)


#: The sweeps that follow one another where roads propose after them: of the rarest triples few intersections suffice.
BEFORE_ROADS: tuple[Source, ...] = (Sweep(TripleOptions(), 12), _SECOND)
#: Those where roads propose nothing.
WITHOUT_ROADS: tuple[Source, ...] = (
    Sweep(TripleOptions(), 40),
    _SECOND,
    Sweep(replace(_FURTHER, angle_tolerance_deg=10.0), 20),
)
