"""Twins of a place: where else the streets would fit, and by how much the place agrees better than all of them.

Where streets form a lattice chance nearby is another block, and hardly less than the place itself: by shares alone they
are alike. Piece by piece they are not: what both explain tells nothing, and what only one explains speaks for that one.
So the place is compared with all others that the roads would fit, on the whole map around it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from roadgeo._arrays import FloatArray, IntArray
from roadgeo.geometry.camera import judge, sampling
from roadgeo.geometry.homography import Homography
from roadgeo.matching.estimator import MatchOptions
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.local_search import LocalSearchOptions, Shift, move_about, search_nearby
from roadgeo.matching.pieces import Pieces, log10_lead, sample_roads, share_won
from roadgeo.matching.refinement import refine
from roadgeo.matching.scene import Scene
from roadgeo.matching.verification import agreement

__all__ = ["Contest", "Twin", "TwinOptions", "best_twin", "loses_part"]

_NO_SEEDS: IntArray = np.array([], np.int64)

#: Streets that cross at right angles fit themselves when they are turned by one.
_TURNS_DEG = (0.0, 90.0, 180.0, 270.0)


@dataclass(frozen=True)
class TwinOptions:
    """Where twins are looked for, and how places are compared.

    Attributes
    ----------
    certain : float
        A place that has these log10 odds is not compared.
    agreeing : float
        A place of too low odds is compared as well where so much agrees, the mean of the shares of intersections, of
        the query's roads and of the map's: chance nearby is other blocks of a lattice, and its lead may yet prove it.
        Of 315 masks without a place, in seven cities of which most are lattices, none leads by more than 10^0.4;
        another one did (see `least_won`).
    weak, least_won : float
        Where neither the odds of a place nor its lead reach `weak`, so much of the roads must lie where most of them
        agree, of the frame cut into 36 pieces: a quarter of Portland is like its own mirror image but for a corner
        (10^4.5, a lead of 10^6.9, 0.88 won). Of 36 right places of worn masks 2 lose by it, of 63 of other masks none.
    repeating : float
        Nor is one where chance puts less than this share of the mask's roads on roads: streets do not repeat there.
    piece_m : float
        Roads agree or not over about this length; pieces are independent.
    unseen : float
        What a road of the map that the query lacks weighs against one of the query's that the map lacks: masks miss
        roads more often than they invent them.
    n_places : int
        So many places that most road points fit are compared.
    n_points : int
        Road points that each of them is laid by.
    apart : float
        Middles of two places lie further from each other than this share of half the frame's diagonal.
    """

    certain: float = MatchOptions.certain
    agreeing: float = 0.7
    weak: float = 10.0
    least_won: float = 0.93
    repeating: float = 0.35
    piece_m: float = 60.0
    unseen: float = 0.5
    n_places: int = 40
    n_points: int = 200
    apart: float = 0.04
    search: LocalSearchOptions = field(
        default_factory=lambda: LocalSearchOptions(
            reach_m=8000.0, turn_deg=0.0, cell_m=10.0, road_m=20.0, max_points=200, n_places=40
        )
    )

    @classmethod
    def nearby(cls, reach_m: float, n_places: int) -> TwinOptions:
        """Return the usual options with another reach: the time that a comparison takes grows with its square."""
        usual = cls()
        return replace(usual, n_places=n_places, search=replace(usual.search, reach_m=reach_m))


class Twin(NamedTuple):
    """Another place that the roads would fit, query plane to reference plane (3, 3); log10 odds that it is worse."""

    matrix: FloatArray
    log10_lead: float


def best_twin(
    matrix: FloatArray,
    scene: Scene,
    index: ReferenceIndex,
    match: MatchOptions,
    options: TwinOptions,
    within: tuple[float, float, float] | None = None,
    known: Sequence[FloatArray] = (),
) -> Twin | None:
    """Return the other place that the roads would fit best, piece by piece; None where nothing else can be meant.

    Parameters
    ----------
    within : (x, y, radius), optional
        Plane metres: the middle of the frame is known to lie there.
    known : sequence of (3, 3) float64
        Other places that a search has met.
    """
    contest = Contest(scene, sampling(matrix, scene.size), match, options)
    worth, here = contest.weigh(matrix, index), Homography(matrix)(scene.center)
    frame_m = scene.half_size * contest.gsd_m
    best: Twin | None = None
    for twin in [*contest.twins_of(matrix, index), *known]:
        there = Homography(twin)(scene.center)
        if np.hypot(*(there - here)) < options.apart * frame_m or judge(twin, scene.size, match.camera) is not None:
            continue
        if within is not None and np.hypot(*(there - within[:2])) > within[2]:
            continue
        lead = log10_lead(worth - contest.weigh(twin, index))
        if best is None or lead < best.log10_lead:
            best = Twin(twin, lead)
    return best


def loses_part(
    matrix: FloatArray, scene: Scene, index: ReferenceIndex, match: MatchOptions, options: TwinOptions
) -> bool:
    """Whether too much of the roads lies in pieces of the frame where most of them do not agree."""
    return share_won(matrix, scene, index, sampling(matrix, scene.size), match.verify, n=6) < options.least_won


class Contest:
    """Places of one scene, compared piece by piece.

    Attributes
    ----------
    gsd_m : float
        Metres per pixel at which roads are measured, and how near they must be to agree, at all places.
    """

    def __init__(self, scene: Scene, gsd_m: float, match: MatchOptions, options: TwinOptions | None = None) -> None:
        self.scene, self.gsd_m, self.match, self.options = scene, gsd_m, match, options or TwinOptions()

    def weigh(self, matrix: FloatArray, index: ReferenceIndex) -> FloatArray:
        """Return what each piece of the frame says for a place, (P,) pieces: the places' differences are evidence."""
        pieces = Pieces(self.scene, index, self.gsd_m, self.options.piece_m, self.match.verify)
        ground = Homography(matrix).everywhere(self.scene.corners)
        samples = sample_roads(index, ground.min(axis=0), ground.max(axis=0), pieces.step_m)
        scale = sampling(matrix, self.scene.size) / self.gsd_m
        return pieces.count(matrix, samples, scale).worth(self.options.unseen) / self.options.piece_m

    def twins_of(self, matrix: FloatArray, index: ReferenceIndex) -> list[FloatArray]:
        """Return other places (3, 3) that most of the roads would fit, each laid on the map as well as it can be."""
        center, options = Homography(matrix).everywhere(self.scene.center), self.options
        found: list[tuple[float, FloatArray]] = []
        for turn in _TURNS_DEG:
            turned = move_about(center, Shift(0.0, 0.0, turn, 1.0, 0.0)) @ matrix
            shifts = search_nearby(turned, self.scene, index, options.search)
            found += [(shift.share, move_about(center, shift) @ turned) for shift in shifts]
        found.sort(key=lambda one: -one[0])
        return [self._lay(start, index) for _, start in found[: options.n_places]]

    def _lay(self, start: FloatArray, index: ReferenceIndex) -> FloatArray:
        """Refine a place; where it loses its way, it stays as it is."""
        scene, match, matrix = self.scene, self.match, start
        for n_points in (self.options.n_points, None):
            gsd = sampling(matrix, scene.size)
            _, matched, _ = agreement(matrix, scene, index, gsd, _NO_SEEDS, match.verify)
            refined = refine(matrix, scene, index, matched, match.refine, n_points, held=True)
            if refined is None or judge(refined.matrix, scene.size, match.camera) is not None:
                break
            if abs(math.log(sampling(refined.matrix, scene.size) / sampling(start, scene.size))) > math.log(1.1):
                break
            matrix = refined.matrix
        return matrix
