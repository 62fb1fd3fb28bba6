"""What a search tells while it runs, to whoever explains it afterwards; by default to nobody."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from roadgeo._arrays import BoolArray, FloatArray, IntArray
    from roadgeo.geometry.camera import CameraFault
    from roadgeo.matching.estimator import TripleEstimator
    from roadgeo.matching.hypothesis import Hypothesis
    from roadgeo.matching.search import SearchResult
    from roadgeo.matching.triples import Proposals

__all__ = ["NO_TRACE", "NoTrace", "Trace"]


class Trace(Protocol):
    """Told of each stage of a search. It only listens: a traced search finds the same."""

    def began(self, estimator: TripleEstimator) -> None:
        """Note what is going to search."""

    def screened(self, proposals: Proposals, allowed: BoolArray, kept: IntArray) -> None:
        """Note one anchor's proposals: which the user's hints allow, and which put roads on roads."""

    def voted(self, anchor: int, n_proposed: int) -> None:
        """Note that an intersection and the roads around it proposed so many places that were to grow."""

    def grown(self, hypotheses: Sequence[Hypothesis]) -> None:
        """Note what grew from one anchor's proposals."""

    def refused(self, fault: CameraFault, matrix: FloatArray) -> None:
        """Note a grown homography that no camera can have seen."""

    def scored(self, model: Hypothesis) -> None:
        """Note a hypothesis that was refined and compared with the map."""

    def finished(self, estimator: TripleEstimator, result: SearchResult[Hypothesis]) -> None:
        """Note how the search ended."""


class NoTrace:
    """Listens to nothing."""

    def began(self, estimator: TripleEstimator) -> None:
        """Do nothing."""

    def screened(self, proposals: Proposals, allowed: BoolArray, kept: IntArray) -> None:
        """Do nothing."""

    def voted(self, anchor: int, n_proposed: int) -> None:
        """Do nothing."""

    def grown(self, hypotheses: Sequence[Hypothesis]) -> None:
        """Do nothing."""

    def refused(self, fault: CameraFault, matrix: FloatArray) -> None:
        """Do nothing."""

    def scored(self, model: Hypothesis) -> None:
        """Do nothing."""

    def finished(self, estimator: TripleEstimator, result: SearchResult[Hypothesis]) -> None:
        """Do nothing."""


NO_TRACE = NoTrace()
