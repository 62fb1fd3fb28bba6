"""Proposals are screened by the roads around them, and grown outwards, intersection by intersection."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from roadgeo._arrays import IntArray
from roadgeo.geometry.camera import CameraOptions
from roadgeo.kernels.growth import grow_each
from roadgeo.kernels.roads import screen
from roadgeo.kernels.structs import GrowthLimits, GrowthQuery
from roadgeo.matching.hypothesis import Hypothesis
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.scene import Scene
from roadgeo.matching.triples import Proposals

__all__ = ["GrowOptions", "grow_proposals", "screen_proposals"]


@dataclass(frozen=True)
class GrowOptions:
    """How proposals are screened and grown (see `kernels.roads.screen`, `kernels.growth.grow`).

    Lengths have a part in metres, the map's, and one in pixels, the mask's.

    Attributes
    ----------
    max_scale_ratio : float
        Away from the middle of a tilted frame the ground sampling may differ from that at the middle by this factor.
    screen_points, screen_radius_m, screen_radius_px, screen_share
        Of this number of road points near the anchor, this share must lie within these radii of roads of the map.
    max_screened, max_grown, max_verified : int
        Bounds of one anchor's work: proposals screened, grown, and grown ones scored.
    sigma_m, sigma_px, radius_m, radius_px
        Standard deviation of an intersection's place, and the greatest search radius.
    perspective_sigma : float
        Prior standard deviation of the two perspective parameters.
    hit_rate, chance_rate, patience : float
        Of the sequential test: share of intersections that match if true and if not, and the nats lost before it
        gives up.
    min_matched : int
        Least matches besides the seeds.
    max_points : int
        Of more intersections, those nearest to the anchor decide how well a hypothesis grows.
    """

    max_scale_ratio: float = 2.0
    screen_points: int = 40
    screen_radius_m: float = 8.0
    screen_radius_px: float = 4.0
    screen_share: float = 0.6
    max_screened: int = 600
    sigma_m: float = 3.5
    sigma_px: float = 1.5
    radius_m: float = 20.0
    radius_px: float = 5.0
    ray_tolerance_deg: float = 25.0
    perspective_sigma: float = 0.4
    hit_rate: float = 0.45
    chance_rate: float = 0.08
    patience: float = 6.0
    min_matched: int = 2
    max_points: int = 1000
    max_grown: int = 150
    max_verified: int = 3


def screen_proposals(
    scene: Scene, index: ReferenceIndex, proposals: Proposals, looked_at: IntArray, options: GrowOptions
) -> IntArray:
    """Return those of the proposals `looked_at` that put roads around the anchor on roads of the map, best first."""
    if len(looked_at) == 0:
        return looked_at
    anchor = scene.intersections.xy[proposals.anchor]
    away = np.hypot(*(scene.points - anchor).T)
    last = scene.neighbours[proposals.anchor]
    reach = np.hypot(*(scene.intersections.xy[last[last >= 0]] - anchor).T).max(initial=0.0)
    near = np.argsort(away, kind="stable")[: options.screen_points]
    near = near[away[near] < reach]
    shares = np.zeros(len(looked_at))
    screen(
        proposals.reference[looked_at], proposals.affine[looked_at], anchor,
        index.xy, scene.points[near], scene.directions[near],
        options.screen_radius_m, options.screen_radius_px, math.cos(math.radians(options.ray_tolerance_deg)),
        options.screen_share, index.road_buckets, shares,
    )  # fmt: skip
    good = shares >= options.screen_share
    kept, shares = looked_at[good], shares[good]
    return np.asarray(kept[np.argsort(-(proposals.placed[kept] + shares), kind="stable")])


def grow_proposals(
    scene: Scene,
    index: ReferenceIndex,
    proposals: Proposals,
    chosen: IntArray,
    options: GrowOptions,
    camera: CameraOptions,
) -> list[Hypothesis]:
    """Grow the chosen proposals of one anchor; return those that did not wither, the best supported first."""
    if len(chosen) == 0:
        return []
    # The query: intersections outwards from the anchor, and which of its neighbours each proposal is made of.
    xy, anchor = scene.intersections.xy, proposals.anchor
    order = np.argsort(np.hypot(*(xy - xy[anchor]).T), kind="stable")[: options.max_points]
    partners = np.ascontiguousarray(proposals.partners[chosen])
    neighbours = np.ascontiguousarray(scene.neighbours[:, : partners.shape[1]])
    matched = np.empty((len(chosen), len(xy)), np.int64)
    matrices = np.empty((len(chosen), 3, 3))
    ratios = np.empty(len(chosen))
    limits = GrowthLimits(
        (options.sigma_m, options.sigma_px), (options.radius_m, options.radius_px),
        math.cos(math.radians(options.ray_tolerance_deg)), camera.perspective_sigma(options.perspective_sigma),
        options.hit_rate, options.chance_rate, options.patience,
    )  # fmt: skip
    grow_each(
        GrowthQuery(xy, scene.branches, neighbours, order, scene.half_size, anchor),
        proposals.reference[chosen], proposals.affine[chosen], partners,
        index.point_buckets, limits, options.min_matched, matched, matrices, ratios,
    )  # fmt: skip
    # A ratio that is not finite marks one that withered; the seeds are the anchor and the neighbours it is made with.
    best = np.argsort(-ratios, kind="stable")[: np.isfinite(ratios).sum()]
    seeds = [np.append(neighbours[anchor][partners[m] >= 0], anchor) for m in best]
    return [
        Hypothesis(matrices[m] / matrices[m, 2, 2], made_of, float(ratios[m]), matched[m])
        for m, made_of in zip(best, seeds, strict=True)
    ]
