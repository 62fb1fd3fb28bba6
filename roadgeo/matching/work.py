"""The work of a search, measured by counts: the same on every machine, busy or idle."""

from __future__ import annotations

from typing import NamedTuple

__all__ = ["PairWork", "Work"]

# Seconds that each step takes one core of a usual machine, roughly; measured on lattices, where searches are longest.
_ROUND = 2e-3
_TUPLE = 0.5e-6
_PLACE = 1.5e-6
_GROWN = 0.5e-3
_VERIFIED, _VERIFIED_POINT = 1e-3, 3.5e-6

# The same of the paper's search, on masks of Liège; a hypothesis is given up as soon as too many points miss.
_SAMPLE, _TESTED, _COUNTED_POINT = 0.35e-3, 0.1e-6, 0.04e-6


class Work(NamedTuple):
    """Counts of a search.

    Attributes
    ----------
    rounds : int
        Intersections of the query that were tried.
    tuples : int
        Tuples of the map that were like those of the query.
    places : int
        Places that were screened or voted for.
    grown, verified : int
        Hypotheses that were grown, and that were compared with the map.
    points : int
        Road points of the query that each was compared by.
    """

    rounds: int
    tuples: int
    places: int
    grown: int
    verified: int
    points: int

    @property
    def seconds(self) -> float:
        """The time on one core of a usual machine."""
        tried = _ROUND * self.rounds + _TUPLE * self.tuples + _PLACE * self.places + _GROWN * self.grown
        return tried + (_VERIFIED + _VERIFIED_POINT * self.points) * self.verified


class PairWork(NamedTuple):
    """Counts of the paper's search.

    Attributes
    ----------
    samples : int
        Tuples of the query that were drawn.
    tested : int
        Tuples of the map that they were compared with.
    hypotheses : int
        Homographies whose inliers were counted.
    points : int
        Intersections of the query that each was judged by.
    """

    samples: int
    tested: int
    hypotheses: int
    points: int

    @property
    def seconds(self) -> float:
        """The time on one core of a usual machine."""
        return _SAMPLE * self.samples + _TESTED * self.tested + _COUNTED_POINT * self.points * self.hypotheses
