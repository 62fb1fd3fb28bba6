"""Counts of the attempts of one search, on all of its parts together, and its work."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

__all__ = ["Ledger", "Work"]

# Seconds that each step takes one core of a usual machine, roughly; measured on lattices, where searches are longest.
_ROUND = 2e-3
_TUPLE = 0.5e-6
_PLACE = 1.5e-6
_GROWN = 0.5e-3
_VERIFIED, _VERIFIED_POINT = 1e-3, 3.5e-6


@dataclass
class Ledger:
    """Places tried in one search, on all of its parts together: each of them could have agreed by chance.

    Attributes
    ----------
    n_reference : int
        Intersections of all parts: attempts on them are bounded as on one map of that size.
    n_tried, beside : int, float
        Those, and how many are tried on the whole map for each that is tried here (see `LocateOptions.elsewhere`).
    n_by_triples : int
        Those that triples proposed.
    """

    n_reference: int = 0
    n_tried: int = 0
    n_by_triples: int = 0
    beside: float = 1.0


class Work(NamedTuple):
    """Counts of a search, which measure its work, the same on every machine, busy or idle.

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
