"""The course of a search: its events, for later explanation, and its counts and work, which bound it."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

__all__ = ["Events", "Ledger"]


@dataclass
class Events:
    """The events in the search of one part of a map, in order. Keeping them changes nothing.

    An event is its kind and its values:

    - "screened": an anchor's `Proposals`, which of them the user's hints allow (M,), and which put roads on roads (K,);
    - "voted": an intersection, and the number of places to grow that it and the roads around it proposed;
    - "grown": homographies (3, 3) that grew;
    - "refused": the camera's objection, and a grown homography that no camera can have seen;
    - "settled": a `Place` that was verified, or refused for its `fault`.
    """

    kept: bool = False
    items: list[tuple[Any, ...]] = field(default_factory=list)

    def note(self, kind: str, *what: Any) -> None:
        """Note an event."""
        if self.kept:
            self.items.append((kind, *what))

    def of(self, kind: str) -> list[Any]:
        """Return the values of the events of a kind: alone, or as a tuple of several."""
        events = [what for name, *what in self.items if name == kind]
        return [what[0] if len(what) == 1 else tuple(what) for what in events]


@dataclass
class Ledger:
    """Places tried in one search, on all of its parts together: each of them could have agreed by chance.

    Attributes
    ----------
    n_reference : int
        Intersections of all parts: attempts are bounded as on one map of that size.
    tried : Counter
        The places, by their source: "triples" or "roads".
    """

    n_reference: int
    tried: Counter[str] = field(default_factory=Counter)
