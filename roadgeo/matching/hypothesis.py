"""A hypothesis: a homography that grew from proposals, and its results."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple, TypeAlias

import numpy as np

from roadgeo._arrays import FloatArray, IntArray
from roadgeo.geometry.camera import CameraFault, sampling
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.homography import Homography
from roadgeo.matching.lens import LensFit
from roadgeo.matching.refinement import Refined
from roadgeo.matching.verification import Agreement

__all__ = ["MINIMAL", "Hypothesis", "Lead", "Spot"]

#: Matches that determine a homography; that many seeds are excluded from the evidence.
MINIMAL = 4

#: Origin of a hypothesis: number of the stage, and intersection of the query.
Lead: TypeAlias = tuple[int, int]


class Spot(NamedTuple):
    """Where the middle of a frame lies by a hypothesis.

    `x`, `y`: plane metres; `reach_m`: nearer middles mean the same place, 50 m or a twentieth of the frame's size;
    `matrix`, `laid`: the homographies that it was computed of, before and after refinement.
    """

    matrix: FloatArray
    laid: FloatArray
    x: float
    y: float
    reach_m: float


@dataclass
class Hypothesis:
    """A grown hypothesis and its results.

    `by_roads`: it grew by roads over the whole frame; `leads`: the intersections of the query that proposed it, each
    with the number of the stage in which it did; `log10_likelihood`, `nearby`: that of the place, and that of the best
    place nearby (see `evidence`); `n_tried`: places tried when it was scored; `fault`: the camera's last
    objection, None where it had none; `lens`: how it fits when it is grown anew behind a lens.
    """

    matrix: FloatArray
    seeds: IntArray
    support: float
    matched: IntArray
    refined: Refined | None = None
    found: Agreement | None = None
    log10_likelihood: float = -np.inf
    nearby: float = 0.0
    distance: FloatArray | None = None
    gsd_m: float = np.nan
    log10_odds: float = -np.inf
    n_tried: int = 1
    fault: CameraFault | None = None
    by_roads: bool = False
    lens: LensFit | None = None
    leads: list[Lead] = field(default_factory=list)
    _spot: Spot | None = field(default=None, repr=False)

    @property
    def laid(self) -> FloatArray:
        """The homography (3, 3), refined if it was."""
        return self.matrix if self.refined is None else self.refined.matrix

    def spot(self, size: tuple[int, int]) -> Spot:
        """Return where the middle of a frame of that size lies; kept, for in a lattice it is asked for without end."""
        laid, kept = self.laid, self._spot
        if kept is None or kept.matrix is not self.matrix or kept.laid is not laid:
            frame = Frame(*size)
            x, y = Homography(laid).everywhere(frame.plane_center).tolist()
            reach_m = frame.one_place_m(sampling(self.matrix, size))
            kept = self._spot = Spot(self.matrix, laid, x, y, reach_m)
        return kept

    @property
    def n_found(self) -> int:
        """Number of intersections of the query that proposed it."""
        return len(self.leads)
