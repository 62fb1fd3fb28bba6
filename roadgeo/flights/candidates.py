"""Places that earlier frames of a flight proposed, weighed again with all that later ones have shown.

A place that one search finds may be chance; a place that explains all frames, as more of them come, is not. So
each new frame contributes, whether or not the map is searched again, and where streets are alike a flight is found
some frames sooner: the place that explains most is compared with all others that were proposed, and with those around.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo.flights.mosaic import Mosaic
from roadgeo.geometry.camera import judge, sampling
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.mask import PIXEL_TO_PLANE
from roadgeo.location import Location
from roadgeo.matching.evidence import Evidence, agreement, match_intersections
from roadgeo.matching.growing import Hypothesis
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.methods import Fit, Found, search_references
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.refinement import refine
from roadgeo.matching.rivals import N_LAID, similar_places
from roadgeo.matching.scene import Query
from roadgeo.matching.verdict import decide
from roadgeo.reference.reference import Reference

__all__ = ["Candidates", "Look"]


#: Number of times that the places are compared at the scale of the best one, until it stays that.
_MOST_SCALES = 4
#: Best places of each look that are weighed again with the frames to come; of all, those that explain most are kept.
PER_LOOK, MOST = 30, 60


@dataclass(frozen=True)
class Look:
    """Frames laid together, and which they are.

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


@dataclass
class _Candidate:
    """A place.

    Attributes
    ----------
    index : ReferenceIndex
        The map that it was found on.
    whole : ReferenceIndex
        The reference that is part of.
    matrix : (3, 3) float64
        Pixel of the frame `seen_at` to reference plane.
    fit : Fit or None
        Where it was last laid; None before any frame came, and where no camera sees it so.
    """

    index: ReferenceIndex
    whole: ReferenceIndex
    matrix: FloatArray
    seen_at: int
    fit: Fit | None = None

    def lay(self, look: Look, options: LocateOptions) -> None:
        """Refine it on all that was seen; without a fit it can be no place of these frames."""
        whole, match = look.query.scene, options.match
        matrix, self.fit = _lay(self, look), None
        if matrix is None or judge(matrix, whole.size, match.camera, rough=True) is not None:
            return
        matched, _ = match_intersections(matrix, whole, self.index)
        refined = refine(matrix, whole, self.index, matched, match.refine, held=True)
        if refined is None or judge(refined.matrix, whole.size, match.camera) is not None:
            return
        matrix = refined.matrix
        found, matched, distance = agreement(matrix, whole, self.index)
        self.matrix, self.seen_at = matrix @ PIXEL_TO_PLANE @ look.mosaic.to_mosaic[-1], look.numbers[-1]
        self.fit = Fit(
            self.index, matrix, matched, distance, found.forward, -math.inf, found.log10_likelihood,
            refined.corner_sigma_m, refined.corner_covariance_m2,
            agreement=found.mean,
        )  # fmt: skip


@dataclass
class Candidates:
    """The places that one lost flight may be at.

    Attributes
    ----------
    n_looks : int
        Searches of the map until now: each takes its share off the odds.
    """

    references: Sequence[Reference]
    n_looks: int = 0
    _kept: list[_Candidate] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self._kept)

    def look(self, look: Look, options: LocateOptions) -> Location:
        """Weigh what was proposed, search the map where that is due, and judge both together."""
        for place in self._kept:
            place.lay(look, options)
        self.n_looks += look.searched
        if look.searched and options.effort == "full":
            # A quick search proposes the place nearly as often, in a tenth of the time: it will do where that leads.
            location = self._search(look, replace(options, effort="quick"))
            if location.located:
                return location
        return self._search(look, options)

    def _search(self, look: Look, options: LocateOptions) -> Location:
        """Search the map where that is due, and judge the results together with earlier proposals."""
        found: list[Found] = []
        if look.searched:
            parts = [part for reference in self.references for part in reference.parts]
            found = search_references(look.query, parts, options, options.search.time_limit_s, explained=True)
        for result in found:
            self._take(result, look, options)
        self._kept = [place for place in self._kept if place.fit is not None]
        self._kept = sorted(self._kept, key=_likelihood, reverse=True)[:MOST]
        return decide(look.query, self._judged(found, look, options), options)

    def _judged(self, found: Sequence[Found], look: Look, options: LocateOptions) -> list[Found]:
        """Compare the place that explains most with all others that were proposed, then with those around it.

        Return the results, with that place and its best rival alone. Each look may find a place by chance.
        """
        judged = [replace(result, fits=()) for result in found]
        best = self._best(look)
        if best is None or best.fit is None:
            return judged or [Found(reference.index) for reference in self.references]
        scene, size, fit = look.query.scene, look.query.scene.size, best.fit
        evidence = Evidence(scene, best.index, sampling(fit.matrix, size))
        worth, paid = evidence.weigh(fit.matrix), math.log10(max(self.n_looks, 1))
        others = [place.fit for place in self._kept if place.fit is not None and place is not best]
        rivals = [(self._weigh(look, other, evidence.gsd_m), other) for other in others if _differ(other, fit, size)]
        rival = max(rivals, key=lambda pair: pair[0], default=None)
        most = max(evidence.nearby(fit.matrix), 0.0 if rival is None else rival[0])
        if worth - most - paid >= options.min_log10_odds:
            compare = evidence.compared_with(fit.matrix)
            around = similar_places(fit.matrix, evidence, compare, options.match)[:N_LAID]
            most = max([most, *(other.worth for other in around if not _are_one(other.matrix, fit.matrix, size))])
        lead = worth - max(most, 0.0) - paid
        fits = (replace(fit, log10_odds=lead),) + (() if rival is None else (replace(rival[1], log10_odds=-lead),))
        k = next((k for k, result in enumerate(judged) if result.index is best.whole), len(judged))
        if k == len(judged):
            judged.append(Found(best.whole, n_searched=len(best.whole)))
        judged[k] = replace(judged[k], fits=fits)
        return judged

    def _best(self, look: Look) -> _Candidate | None:
        """Return the place that explains most, all measured at its own scale."""
        best = max(self._kept, key=_likelihood, default=None)
        for _ in range(_MOST_SCALES):
            if best is None or best.fit is None:
                return None
            gsd = sampling(best.fit.matrix, look.query.scene.size)
            weighed = [(self._weigh(look, place.fit, gsd), place) for place in self._kept if place.fit is not None]
            before, best = best, max(weighed, key=lambda pair: pair[0])[1]
            if best is before:
                break
        return best

    def _weigh(self, look: Look, fit: Fit, gsd_m: float) -> float:
        return Evidence(look.query.scene, fit.index, gsd_m).weigh(fit.matrix)

    def _take(self, found: Found, look: Look, options: LocateOptions) -> None:
        """Keep the likeliest places that a search compared with the map, unless they are known."""
        last, to_frame = look.numbers[-1], PIXEL_TO_PLANE @ look.mosaic.to_mosaic[-1]
        size, estimator = look.query.scene.size, found.events.estimator
        if estimator is None:
            return
        best: list[Hypothesis] = []
        for model in sorted(estimator.verified, key=lambda model: -model.log10_likelihood):
            if len(best) < PER_LOOK and not any(estimator.same(model, known) for known in best):
                best.append(model)
        for model in best:
            here = (place for place in self._kept if place.whole is found.index)
            if not any(_are_one(_lay(place, look), model.matrix, size) for place in here):
                new = _Candidate(estimator.index, found.index, model.matrix @ to_frame, last)
                new.lay(look, options)
                self._kept.append(new)


def _likelihood(place: _Candidate) -> float:
    return -math.inf if place.fit is None else place.fit.log10_likelihood


def _differ(fit: Fit, other: Fit, size: tuple[int, int]) -> bool:
    return fit.index is not other.index or not _are_one(fit.matrix, other.matrix, size)


def _lay(place: _Candidate, look: Look) -> FloatArray | None:
    """Return where a place puts the mosaic, query plane to reference plane; None where their frames do not touch."""
    if place.seen_at not in look.numbers:
        return None
    to_mosaic = look.mosaic.to_mosaic[list(look.numbers).index(place.seen_at)]
    matrix = place.matrix @ np.linalg.inv(to_mosaic) @ PIXEL_TO_PLANE
    return np.asarray(matrix / matrix[2, 2])


def _are_one(a: FloatArray | None, b: FloatArray, size: tuple[int, int]) -> bool:
    """Whether two places put the middle of a mosaic within 50 m, or a twentieth of its size, of each other."""
    if a is None:
        return False
    frame = Frame(*size)
    apart = np.hypot(*(Homography(a)(frame.plane_center) - Homography(b)(frame.plane_center)))
    return bool(apart < frame.one_place_m(sampling(b, size)))
