"""Proposals are screened by the roads around them, and grown outwards, intersection by intersection."""

from __future__ import annotations

import numpy as np

from roadgeo._arrays import IntArray
from roadgeo.geometry.camera import CameraOptions
from roadgeo.kernels.growth import grow_each
from roadgeo.kernels.roads import screen
from roadgeo.kernels.structs import GrowthLimits, GrowthQuery
from roadgeo.matching.hypothesis import Hypothesis
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.scene import MIN_COS, Scene
from roadgeo.matching.triples import Proposals

__all__ = ["MAX_GROWN", "MAX_SCALE_RATIO", "MAX_SCREENED", "MAX_VERIFIED", "grow_proposals", "screen_proposals"]


#: Away from the middle of a tilted frame the ground sampling may differ from that at the middle by this factor.
MAX_SCALE_RATIO = 2.0
#: Bounds of one anchor's work: proposals screened, grown, and grown ones scored.
MAX_SCREENED, MAX_GROWN, MAX_VERIFIED = 600, 150, 3
#: Of this number of road points near the anchor, this share must lie within these radii of roads: lengths have a
#: part in metres, the map's, and one in pixels, the mask's.
_SCREEN_POINTS, _SCREEN_SHARE, _SCREEN_RADIUS = 40, 0.6, (8.0, 4.0)
#: Standard deviation of an intersection's place, and the greatest search radius, likewise.
_SIGMA, _RADIUS = (3.5, 1.5), (20.0, 5.0)
#: Prior standard deviation of the two perspective parameters.
_PERSPECTIVE_SIGMA = 0.4
#: Of the sequential test: share of intersections that match if true and if not, and the nats lost before it gives up.
_HIT_RATE, _CHANCE_RATE, _PATIENCE = 0.45, 0.08, 6.0
#: Least matches besides the seeds; of more intersections, those nearest to the anchor decide how well one grows.
_MIN_MATCHED, _MAX_POINTS = 2, 1000


def screen_proposals(scene: Scene, index: ReferenceIndex, proposals: Proposals, looked_at: IntArray) -> IntArray:
    """Return those of the proposals `looked_at` that put roads around the anchor on roads of the map, best first."""
    if len(looked_at) == 0:
        return looked_at
    anchor = scene.intersections.xy[proposals.anchor]
    away = np.hypot(*(scene.points - anchor).T)
    last = scene.neighbours[proposals.anchor]
    reach = np.hypot(*(scene.intersections.xy[last[last >= 0]] - anchor).T).max(initial=0.0)
    near = np.argsort(away, kind="stable")[:_SCREEN_POINTS]
    near = near[away[near] < reach]
    shares = np.zeros(len(looked_at))
    screen(
        proposals.reference[looked_at], proposals.affine[looked_at], anchor,
        index.xy, scene.points[near], scene.directions[near],
        *_SCREEN_RADIUS, MIN_COS, _SCREEN_SHARE, index.road_buckets, shares,
    )  # fmt: skip
    good = shares >= _SCREEN_SHARE
    kept, shares = looked_at[good], shares[good]
    return np.asarray(kept[np.argsort(-(proposals.placed[kept] + shares), kind="stable")])


def grow_proposals(
    scene: Scene,
    index: ReferenceIndex,
    proposals: Proposals,
    chosen: IntArray,
    camera: CameraOptions,
) -> list[Hypothesis]:
    """Grow the chosen proposals of one anchor; return those that did not wither, the best supported first."""
    if len(chosen) == 0:
        return []
    # The query: intersections outwards from the anchor, and which of its neighbours each proposal is made of.
    xy, anchor = scene.intersections.xy, proposals.anchor
    order = np.argsort(np.hypot(*(xy - xy[anchor]).T), kind="stable")[:_MAX_POINTS]
    partners = np.ascontiguousarray(proposals.partners[chosen])
    neighbours = np.ascontiguousarray(scene.neighbours[:, : partners.shape[1]])
    matched = np.empty((len(chosen), len(xy)), np.int64)
    matrices = np.empty((len(chosen), 3, 3))
    ratios = np.empty(len(chosen))
    perspective = camera.perspective_sigma(_PERSPECTIVE_SIGMA)
    limits = GrowthLimits(_SIGMA, _RADIUS, MIN_COS, perspective, _HIT_RATE, _CHANCE_RATE, _PATIENCE)
    grow_each(
        GrowthQuery(xy, scene.branches, neighbours, order, scene.half_size, anchor),
        proposals.reference[chosen], proposals.affine[chosen], partners,
        index.point_buckets, limits, _MIN_MATCHED, matched, matrices, ratios,
    )  # fmt: skip
    # A ratio that is not finite marks one that withered; the seeds are the anchor and the neighbours it is made with.
    best = np.argsort(-ratios, kind="stable")[: np.isfinite(ratios).sum()]
    seeds = [np.append(neighbours[anchor][partners[m] >= 0], anchor) for m in best]
    return [
        Hypothesis(matrices[m] / matrices[m, 2, 2], made_of, float(ratios[m]), matched[m])
        for m, made_of in zip(best, seeds, strict=True)
    ]
