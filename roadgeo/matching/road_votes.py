"""Proposals from roads: one query intersection and the roads around it, laid on every intersection of the map.

Triples of intersections need three neighbours that are all intact. Where roads are missing, false or few, one intact
intersection and the roads about it still say where they lie: turned so that two branches agree, at each of many scales,
most road points fall on roads of the map in the right place, and few elsewhere. How many would by chance is measured
for each scale, and depends on how dense the map's roads are at the place: without that, scales at which the query
shrinks to a few blocks would crowd out the rest.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from roadgeo._arrays import BoolArray, FloatArray, IntArray
from roadgeo.kernels.road_raster import DIRECTIONS, TILE
from roadgeo.kernels.road_votes import (
    BLOCK,
    NOWHERE,
    TURNS,
    LaidPoints,
    Places,
    RoadPoints,
    Trial,
    chance_rates,
    draw_turns,
    improve_votes,
    lay_points,
    vote,
)
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.road_raster import RasterOptions, RoadRaster, make_raster
from roadgeo.matching.scene import Scene
from roadgeo.roads.intersections import unpack_branches

__all__ = ["VoteOptions", "Voter", "Votes"]

#: Where the map has hardly a road, chance is not less than this.
_LEAST_DENSITY = 0.005
_TURN_STEPS = np.radians([-6.0, -3.0, 0.0, 3.0, 6.0])
_SCALE_STEPS = np.array([0.96, 1.0, 1.04])


@dataclass(frozen=True)
class VoteOptions:
    """How the roads around one intersection are compared.

    Attributes
    ----------
    branch_tolerance_deg : float
        How far the two branches that agree may be apart.
    scale_step : float
        Ratio of one scale to the next.
    inner_m, radius_m, max_points : float, float, int
        Road points between these distances from the intersection are tested, at most so many. `radius_m` is less than
        63 cells of the raster (see `kernels.road_votes.lay_points`).
    own_m, own_cos : float
        Nearer than `own_m`, roads that run straight away from the intersection, with at least this cosine, are left
        out: they are its own branches, which agree by construction. It makes the right place stand out more and wrong
        ones fail sooner.
    least_points : int
        A scale at which fewer points are in reach is not tried.
    hit_rate, patience : float
        Of the sequential test: share of points that meet roads in the right place, and the nats lost before it ends.
    kept : int
        The best so many are judged anew, with points as far as `wide_radius_m`.
    n_chance : int
        Places at which chance is measured.
    """

    raster: RasterOptions = field(default_factory=RasterOptions)
    branch_tolerance_deg: float = 20.0
    scale_step: float = 1.08
    inner_m: float = 15.0
    radius_m: float = 220.0
    max_points: int = 80
    own_m: float = 150.0
    own_cos: float = 0.95
    least_points: int = 15
    hit_rate: float = 0.55
    patience: float = 3.0
    kept: int = 100
    wide_radius_m: float = 260.0
    wide_points: int = 160
    n_chance: int = 60

    def __post_init__(self) -> None:
        if self.radius_m >= (TILE - 1) * self.raster.cell_m:
            raise ValueError(f"radius_m is {self.radius_m:g}; expected less than {TILE - 1} cells of the raster")

    def on(self, coarseness: float) -> VoteOptions:
        """Return them for a coarse map: all lengths are so many times as long."""
        raster = replace(self.raster, cell_m=coarseness * self.raster.cell_m, reach_m=coarseness * self.raster.reach_m)
        lengths = ("inner_m", "radius_m", "own_m", "wide_radius_m")
        return replace(self, raster=raster, **{name: coarseness * getattr(self, name) for name in lengths})


@dataclass(frozen=True)
class Votes:
    """What one query intersection may be. Dimension: M proposals, the best first.

    Attributes
    ----------
    anchor : int
        The query intersection.
    reference : (M,) int64
        Map intersections it may be.
    affine : (M, 4) float64
        The 2 x 2 map (row-major) from query to reference around it.
    ratio : (M,) float64
        Log-likelihood ratio of the road points against chance, nats.
    """

    anchor: int
    reference: IntArray
    affine: FloatArray
    ratio: FloatArray


class _Around(NamedTuple):
    """Road points as seen from one intersection, nearest first: (P, 2) offsets and (P,) distances in pixels.

    `angles` (P,) are directions in units of pi / DIRECTIONS; `radial` (P,) tells which run straight away from it.
    """

    offsets: FloatArray
    away: FloatArray
    angles: FloatArray
    radial: BoolArray
    rng: np.random.Generator


class Voter:
    """Compares the roads around intersections of one scene with one map, within limits on scale and turn."""

    def __init__(
        self,
        scene: Scene,
        index: ReferenceIndex,
        scale: tuple[float, float],
        max_turn: float,
        candidates: IntArray,
        options: VoteOptions,
    ) -> None:
        """`scale` in metres per pixel, `max_turn` of the image's up from north in radians, `candidates` on the map."""
        self.scene, self.index, self.options = scene, index, options
        self.max_turn, self.candidates = max_turn, candidates
        n = math.ceil(math.log(scale[1] / scale[0]) / math.log(options.scale_step)) + 1
        self.scales = np.geomspace(*scale, n)
        self.tolerance = math.radians(options.branch_tolerance_deg)
        self.trial = Trial(options.hit_rate, options.patience)
        self.drawn: RoadRaster = make_raster(index, options.raster)
        density = np.maximum(self.drawn.density_at(index.xy), _LEAST_DENSITY)
        self.places = Places(self.drawn.cells(index.xy), unpack_branches(index.branches), density)

    def votes(self, anchor: int, chunk: int = 20_000) -> Iterator[tuple[int, Votes | None]]:
        """Yield, after each `chunk` of the map's intersections, how many places and turns were tried on it.

        With the last come the best proposals, before it None.
        """
        options = self.options
        rays = self.scene.intersections.rays[anchor]
        rays = rays[np.isfinite(rays)].astype(float)
        around = self._around(anchor)
        points = self._narrow(around)
        chance = self._chance(rays, points, around.rng)
        laid = self._lay(points)
        found, kept, tried = np.empty((options.kept, 5)), 0, 0
        for first in range(0, len(self.candidates), chunk):
            kept, tried = vote(
                self.candidates[first : first + chunk], rays, self.tolerance, self.max_turn, laid, self.places,
                self.drawn.raster, chance, self.trial, found, kept,
            )  # fmt: skip
            if first + chunk < len(self.candidates):
                yield tried, None
        wide = self._wide(around)
        improve_votes(found[:kept], _TURN_STEPS, _SCALE_STEPS, wide, self.places, self.drawn.raster, self.trial)
        best = found[:kept][np.argsort(-found[:kept, 3], kind="stable")]
        c, s = np.cos(best[:, 1]) * best[:, 2], np.sin(best[:, 1]) * best[:, 2]
        yield tried, Votes(anchor, best[:, 0].astype(np.int64), np.stack([c, -s, s, c], axis=1), best[:, 3])

    def _around(self, anchor: int) -> _Around:
        """Return the road points as seen from a query intersection, as far as any scale may reach, nearest first."""
        scene = self.scene
        offsets = scene.dense_points - scene.intersections.xy[anchor]
        away = np.hypot(*offsets.T)
        (near,) = np.nonzero(away < self.options.wide_radius_m / self.scales[0])
        order = near[np.argsort(away[near], kind="stable")]
        offsets, away, directions = offsets[order], away[order], scene.dense_directions[order]
        angles = np.arctan2(directions[:, 1], directions[:, 0]) * (DIRECTIONS / math.pi) + DIRECTIONS
        radial = np.abs((offsets * directions).sum(axis=1)) > self.options.own_cos * away
        return _Around(offsets, away, angles, radial, np.random.default_rng(anchor))

    def _narrow(self, around: _Around) -> RoadPoints:
        """Choose the points that vote at each scale: not those of the intersection's own branches."""
        options = self.options
        reach = np.array([[options.inner_m], [options.own_m], [options.radius_m]]) / self.scales
        low, near, high = np.searchsorted(around.away, reach)
        near = np.maximum(low, near)
        # Up to `near` only those that run across the way to the intersection, beyond it all.
        across = np.flatnonzero(~around.radial)
        first, last = np.searchsorted(across, (low, near))
        n_across = last - first
        starts, scale, at = self._spread(n_across + high - near, options.max_points, around.rng)
        inner = np.append(across, 0)[np.minimum(first[scale] + at, len(across))]
        taken = np.where(at < n_across[scale], inner, near[scale] + at - n_across[scale])
        return RoadPoints(self.scales, starts, around.offsets[taken], around.angles[taken])

    def _wide(self, around: _Around) -> RoadPoints:
        """Choose the points that judge proposals anew: all, further away."""
        ends = np.searchsorted(around.away, self.options.wide_radius_m / self.scales)
        starts, _, taken = self._spread(ends, self.options.wide_points, around.rng)
        return RoadPoints(self.scales, starts, around.offsets[taken], around.angles[taken])

    def _spread(self, usable: IntArray, most: int, rng: np.random.Generator) -> tuple[IntArray, IntArray, IntArray]:
        """Choose at most so many of the `usable` points (S,) of each scale, evenly by distance, in random order.

        Returns where the P points of each scale begin (S + 1,), their scales (P,), and their numbers among the usable.
        """
        n = np.minimum(usable, most)
        n[n < self.options.least_points] = 0
        starts = np.concatenate(([0], np.cumsum(n)))
        scale = np.repeat(np.arange(len(n)), n)
        at = (np.arange(len(scale)) - starts[scale]) * (usable[scale] - 1) // np.maximum(n[scale] - 1, 1)
        return starts, scale, at[np.argsort(scale + rng.random(len(scale)))]

    def _lay(self, points: RoadPoints) -> LaidPoints:
        """Turn and scale points to cells of the raster."""
        counts = np.diff(points.starts)
        n_blocks = -(-int(counts.max(initial=0)) // BLOCK)
        words = np.full((TURNS, n_blocks * len(counts) * BLOCK), NOWHERE, np.uint32)
        lay_points(points, self.drawn.raster.cell, words)
        return LaidPoints(points.scales, counts, words)

    def _chance(self, rays: FloatArray, points: RoadPoints, rng: np.random.Generator) -> FloatArray:
        """Measure the chance rate at each scale, in units of the density at a place, at places drawn at random."""
        n, out = self.options.n_chance, np.empty(len(self.scales))
        some = rng.choice(self.candidates, min(4 * n, len(self.candidates)), replace=False)
        sample, turns = np.empty(n, np.int64), np.empty(n)
        n = draw_turns(some, rng.random(len(some)), rays, self.tolerance, self.places, sample, turns)
        chance_rates(sample[:n], turns[:n], points, self.places, self.drawn.raster, out)
        return out
