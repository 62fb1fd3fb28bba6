"""Proposals from roads: one query intersection and the roads around it, laid on every intersection of the map.

Triples of intersections need three neighbours that are all intact. Where roads are missing, false or few, one intact
intersection and the roads about it still say where they lie: turned so that two branches agree, at each of many scales,
most road points fall on roads of the map in the right place, and few elsewhere. How many would by chance depends on the
scale and on how dense the map's roads are at the place: without that, scales at which the query shrinks to a few blocks
would crowd out the rest.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from roadgeo._arrays import AnyArray, BoolArray, FloatArray, IntArray
from roadgeo.kernels.road_raster import DIRECTIONS
from roadgeo.kernels.road_rings import WORDS, mark_rings
from roadgeo.kernels.road_votes import WHOLE_TURN, Places, RoadPoints, Trial, improve_votes, vote
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.road_raster import RasterOptions, RoadRaster, make_raster
from roadgeo.matching.scene import Scene
from roadgeo.roads.intersections import unpack_branches

__all__ = ["VoteOptions", "Voter", "Votes"]

#: Where the map has hardly a road, chance is not less than this.
_LEAST_DENSITY = 0.005
_PER_RADIAN = WHOLE_TURN / (2.0 * math.pi)
_TURN_STEPS = np.radians([-6.0, -3.0, 0.0, 3.0, 6.0])
_SCALE_STEPS = np.array([0.96, 1.0, 1.04])


@dataclass(frozen=True)
class VoteOptions:
    """How the roads around one intersection are compared.

    Attributes
    ----------
    raster : RasterOptions
        Road points in its rings vote, at scales that are a ring apart.
    branch_tolerance_deg : float
        How far branches that agree may be apart.
    own_m, own_cos : float
        Nearer than `own_m`, roads that run straight away from the intersection, with at least this cosine, are left
        out: they are its own branches, which agree by construction. It makes the right place stand out more.
    least_points : int
        A scale at which fewer points are in reach is not tried.
    kept : int
        The best so many are judged anew, with at most `wide_points` road points as far as `wide_radius_m`.
    hit_rate, chance : float
        Share of those that meet roads in the right place, and by chance, in units of the density of roads there: they
        crowd around intersections.
    """

    raster: RasterOptions = field(default_factory=RasterOptions)
    branch_tolerance_deg: float = 20.0
    own_m: float = 150.0
    own_cos: float = 0.95
    least_points: int = 15
    kept: int = 100
    wide_radius_m: float = 260.0
    wide_points: int = 160
    hit_rate: float = 0.55
    chance: float = 1.5

    def on(self, coarseness: float) -> VoteOptions:
        """Return them for a coarse map: all lengths are so many times as long."""
        lengths = {name: coarseness * getattr(self, name) for name in ("own_m", "wide_radius_m")}
        return replace(self, raster=self.raster.on(coarseness), **lengths)


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
        step = options.raster.ring_step
        n = int(math.log(scale[1] / scale[0]) / math.log(step)) + 1  # between the limits, half a step from them at most
        self.scales = np.asarray(math.sqrt(scale[0] * scale[1]) * step ** (np.arange(n) - (n - 1) / 2))
        self.tolerance = round(math.radians(options.branch_tolerance_deg) * _PER_RADIAN)
        self.trial = Trial(options.hit_rate, options.chance)
        self.drawn: RoadRaster = make_raster(index, options.raster)
        cells, rays = self.drawn.cells(index.xy), unpack_branches(index.branches)
        self.drawn.draw_rings_of(cells, candidates)
        density = np.maximum(self.drawn.density_at(index.xy), _LEAST_DENSITY)
        counts = np.isfinite(rays).sum(axis=1)
        self.places = Places(cells, _whole(rays).astype(np.int32), counts, density, self.drawn.rings)

    def votes(self, anchor: int, chunk: int = 20_000) -> Iterator[tuple[int, Votes | None]]:
        """Yield, after each `chunk` of the map's intersections, how many places and turns were tried on it.

        With the last come the best proposals, before it None.
        """
        options = self.options
        rays = self.scene.intersections.rays[anchor]
        rays = _whole(rays[np.isfinite(rays)])
        around = self._around(anchor)
        points = self._mark(around)
        max_turn = round(self.max_turn * _PER_RADIAN)
        found, kept, tried = np.empty((options.kept, 4)), 0, 0
        for first in range(0, len(self.candidates), chunk):
            kept, tried = vote(
                self.candidates[first : first + chunk], rays, self.tolerance, max_turn, self.scales, points,
                options.least_points, self.places, found, kept,
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
        return _Around(offsets, away, angles, radial)

    def _mark(self, around: _Around) -> AnyArray:
        """Return the rings of the query at each scale, (S, WORDS)."""
        raster = self.options.raster
        bearings = np.arctan2(around.offsets[:, 1], around.offsets[:, 0])
        across = np.abs(np.sin(around.angles * (math.pi / DIRECTIONS) - bearings)) > math.sqrt(0.5)
        words = np.zeros((len(self.scales), WORDS), np.uint64)
        rings, own = raster.ring_of(around.away * self.scales[0]), around.radial.astype(np.int64)
        mark_rings(rings, bearings, 1 - across, own, int(raster.ring_of(self.options.own_m)), words)
        return words

    def _wide(self, around: _Around) -> RoadPoints:
        """Choose the points that judge proposals anew at each scale, evenly by distance."""
        usable = np.searchsorted(around.away, self.options.wide_radius_m / self.scales)
        n = np.minimum(usable, self.options.wide_points)
        starts = np.concatenate(([0], np.cumsum(n)))
        scale = np.repeat(np.arange(len(n)), n)
        taken = (np.arange(len(scale)) - starts[scale]) * (usable[scale] - 1) // np.maximum(n[scale] - 1, 1)
        return RoadPoints(self.scales, starts, around.offsets[taken], around.angles[taken])


def _whole(angles: AnyArray) -> IntArray:
    """Return radians as whole numbers (see `kernels.road_votes.WHOLE_TURN`); NaN becomes 0."""
    turns = np.nan_to_num(np.asarray(angles, float)) * _PER_RADIAN
    whole: IntArray = np.round(turns).astype(np.int64)
    return whole.clip(-WHOLE_TURN // 2, WHOLE_TURN // 2 - 1)
