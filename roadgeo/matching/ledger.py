"""What one search has tried, on all of its parts together."""

from __future__ import annotations

from dataclasses import dataclass, field

__all__ = ["Ledger"]


@dataclass
class Ledger:
    """Places tried in one search, on all of its parts together: each of them could have agreed by chance.

    Attributes
    ----------
    n_reference : int
        Intersections of all parts: what is tried on them is bounded as on one map of that size.
    n_tried, beside : int, float
        Those, and how many are tried on the whole map for each that is tried here (see `LocateOptions.elsewhere`).
    tried_by : dict of int to int
        As many had been tried when a stage, by its number, was last at work.
    n_by_triples : int
        Those that triples proposed.
    """

    n_reference: int = 0
    n_tried: int = 0
    tried_by: dict[int, int] = field(default_factory=dict)
    n_by_triples: int = 0
    beside: float = 1.0
