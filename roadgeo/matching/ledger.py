"""Counts of the attempts of one search, on all of its parts together."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Ledger"]


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
