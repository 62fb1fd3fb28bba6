"""Places that earlier frames of a flight proposed, weighed again with all that later ones have shown.

A place that one search finds may be chance; a place that explains all frames, as more of them come, is not. So
each new frame contributes, whether or not the map is searched again, and where streets are alike a flight is found
some frames sooner: the place that explains most is compared with all others that were proposed, and with those around.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo.flights.mosaic import Mosaic
from roadgeo.geometry.mask import PIXEL_TO_PLANE
from roadgeo.location import Location
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.methods import Proposed, Searched, search_references
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.place import Place
from roadgeo.matching.scene import Query
from roadgeo.matching.verdict import decide
from roadgeo.matching.veto import contest
from roadgeo.reference.reference import Reference

__all__ = ["Candidates", "MosaicQuery"]


#: Places that explain most: they are weighed again with the frames to come.
MOST = 60


@dataclass(frozen=True)
class MosaicQuery:
    """Stitched frames, and which they are.

    Attributes
    ----------
    numbers : sequence of int
        Number of each frame.
    searched : bool
        Whether the map is searched for them; otherwise only what was proposed is weighed.
    """

    query: Query
    mosaic: Mosaic
    numbers: Sequence[int]
    searched: bool


@dataclass(frozen=True)
class _Candidate:
    """A place.

    Attributes
    ----------
    index : ReferenceIndex
        The map that it was found on.
    matrix : (3, 3) float64
        Pixel of the frame `frame_number` to reference plane.
    log10_likelihood : float
        As it was last weighed.
    """

    index: ReferenceIndex
    matrix: FloatArray
    frame_number: int
    log10_likelihood: float

    def under(self, frames: MosaicQuery) -> FloatArray:
        """Return where it puts the mosaic, query plane to reference plane."""
        to_mosaic = frames.mosaic.to_mosaic[list(frames.numbers).index(self.frame_number)]
        matrix = self.matrix @ np.linalg.inv(to_mosaic) @ PIXEL_TO_PLANE
        return np.asarray(matrix / matrix[2, 2])


@dataclass
class Candidates:
    """The places that one lost flight may be at.

    Attributes
    ----------
    n_searches : int
        Searches of the map until now: each takes its share off the odds.
    """

    references: Sequence[Reference]
    n_searches: int = 0
    _kept: list[_Candidate] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self._kept)

    def decide(self, frames: MosaicQuery, options: LocateOptions) -> Location:
        """Weigh what was proposed, search the map where that is due, and judge both together."""
        self.n_searches += frames.searched
        if frames.searched and options.effort == "full":
            # A quick search proposes the place nearly as often, in a tenth of the time: it will do where that leads.
            location = self._search(frames, replace(options, effort="quick"))
            if location.located:
                return location
        return self._search(frames, options)

    def _search(self, frames: MosaicQuery, options: LocateOptions) -> Location:
        """Search the map where that is due; places that were proposed before are among those that the search meets."""
        hinted = options
        if not frames.searched:
            options = replace(options, match=replace(options.match, sweeps=(), without_roads=(), roads=False))
        proposed: list[Proposed] = [
            (kept.index, kept.under(frames)) for kept in self._kept if kept.frame_number in frames.numbers
        ]
        parts = [part for reference in self.references for part in reference.parts]
        results = search_references(
            frames.query, parts, options, options.search.time_limit_s, explained=True, proposed=proposed
        )
        kept = [candidate for result in results for candidate in _proposed(result, frames)]
        self._kept = sorted(kept, key=lambda kept: -kept.log10_likelihood)[:MOST]
        paid = math.log10(max(self.n_searches, 1))  # each search may find a place by chance
        results = [result.less_likely(paid) for result in results]
        contested = contest(frames.query, results, parts, hinted, options.search.time_limit_s)
        return decide(frames.query, contested, options)


def _proposed(searched: Searched, frames: MosaicQuery) -> Iterable[_Candidate]:
    """Yield the likeliest places that a search compared with the map."""
    best: list[Place] = []
    if searched.estimator is None:
        return
    for place in sorted(searched.estimator.verified, key=lambda place: -place.log10_likelihood):
        if len(best) < MOST and not any(place.same(other) for other in best):
            best.append(place)
            matrix = place.matrix @ PIXEL_TO_PLANE @ frames.mosaic.to_mosaic[-1]
            yield _Candidate(searched.index, matrix, frames.numbers[-1], place.log10_likelihood)
