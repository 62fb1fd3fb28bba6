"""Options of all stages of locating a mask."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from roadgeo.matching.estimator import MatchOptions
from roadgeo.matching.paper import PairOptions
from roadgeo.matching.search import SearchOptions

__all__ = ["LocateOptions"]


@dataclass(frozen=True)
class LocateOptions:
    """Options of all stages of locating a mask.

    Attributes
    ----------
    method : "auto" or "pair"
        Triples of intersections, or the paper's pairs.
    near : (lon, lat, radius in metres) or None
        Circle that is known to contain the middle of the frame.
    min_log10_odds : float
        Score (log10) by which a place must lead any other place to be reported as located.
    truths : tuple of (str, lon, lat)
        For explanations: true middle of the frame of masks whose names end with the text. The search does not use it.
    effort : "quick" or "full"
        "full": roads alone propose places if triples of intersections lead to none, in a second or two on the map of a
        city. "quick": they do not.
    threads : int
        Threads of the search for a mask. The answer does not depend on their number.
    """

    method: Literal["auto", "pair"] = "auto"
    effort: Literal["quick", "full"] = "full"
    near: tuple[float, float, float] | None = None
    min_log10_odds: float = 3.5
    truths: tuple[tuple[str, float, float], ...] = ()
    threads: int = 1
    match: MatchOptions = field(default_factory=MatchOptions)
    search: SearchOptions = field(default_factory=SearchOptions)
    pair: PairOptions = field(default_factory=PairOptions)
