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
        The middle of the frame is known to lie there.
    min_log10_odds : float
        Powers of ten by which a place must explain more than any other place to be reported as located.
    min_margin : float
        The same, against a place that another look at the scene found.
    truths : tuple of (str, lon, lat)
        For explanations: where the middle of the frame of masks whose names end so really lies. The search does not
        look at it.
    effort : "quick" or "full"
        Whether roads alone propose places where triples of intersections lead nowhere: a second or two on the map of a
        city.
    threads : int
        Of the search for one mask. The answer does not depend on it.
    take : int or None
        Where nothing is located: the place, counted from 1 among those that the refusal lists, that is the answer.
    """

    method: Literal["auto", "pair"] = "auto"
    effort: Literal["quick", "full"] = "full"
    near: tuple[float, float, float] | None = None
    min_log10_odds: float = 3.5
    min_margin: float = 2.0
    truths: tuple[tuple[str, float, float], ...] = ()
    threads: int = 1
    take: int | None = None
    match: MatchOptions = field(default_factory=MatchOptions)
    search: SearchOptions = field(default_factory=SearchOptions)
    pair: PairOptions = field(default_factory=PairOptions)
