"""The course of a search as one list of events, for later explanation; by default nothing is kept."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from roadgeo.geometry.camera import CameraFault
    from roadgeo.matching.estimator import TripleEstimator
    from roadgeo.matching.hypothesis import Hypothesis
    from roadgeo.matching.search import SearchResult

__all__ = ["Events", "Scored"]


class Scored(NamedTuple):
    """A hypothesis that was verified, its odds, and the camera's objection if that ended it."""

    model: Hypothesis
    log10_odds: float
    fault: CameraFault | None = None


@dataclass
class Events:
    """The events in the search of one part of a map, in order. Keeping them changes nothing.

    An event is its kind and its values:

    - "screened": one anchor's `Proposals`, which the user's hints allow (M,), and which put roads on roads (K,);
    - "voted": an intersection, and how many places it and the roads around it proposed that were to grow;
    - "grown": homographies (3, 3) that grew;
    - "refused": the camera's objection, and a homography that grew and that no camera can have seen;
    - "scored": a `Scored`.

    Attributes
    ----------
    kept : bool
    estimator, result
        The estimator, and its result; None where nothing is kept, or nothing was searched.
    """

    kept: bool = False
    estimator: TripleEstimator | None = None
    result: SearchResult[Hypothesis] | None = None
    items: list[tuple[Any, ...]] = field(default_factory=list)

    def note(self, kind: str, *what: Any) -> None:
        """Note an event."""
        if self.kept:
            self.items.append((kind, *what))

    def of(self, kind: str) -> list[Any]:
        """Return the values of the events of a kind: alone, or as a tuple of several."""
        found = [what for name, *what in self.items if name == kind]
        return [what[0] if len(what) == 1 else tuple(what) for what in found]
