"""How much work a search has done, told by counts: the same on every machine, busy or idle."""

from __future__ import annotations

from typing import NamedTuple

__all__ = ["Work"]

# Seconds that each step takes one core of a usual machine, roughly; measured on lattices, where searches are longest.
_ROUND = 2e-3
_TUPLE = 0.5e-6
_PLACE = 1.5e-6
_GROWN = 0.5e-3
_VERIFIED, _VERIFIED_POINT = 1e-3, 3.5e-6


class Work(NamedTuple):
    """Counts of what a search did.

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
        """What it takes one core of a usual machine."""
        tried = _ROUND * self.rounds + _TUPLE * self.tuples + _PLACE * self.places + _GROWN * self.grown
        return tried + (_VERIFIED + _VERIFIED_POINT * self.points) * self.verified
