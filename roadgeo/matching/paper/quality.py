"""Which intersections of a map are good enough for the paper's method (section 4.2)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from roadgeo._arrays import BoolArray
from roadgeo.kernels.residuals import road_residuals
from roadgeo.matching.index import ReferenceIndex

__all__ = ["QualityOptions", "well_fitted"]


@dataclass(frozen=True)
class QualityOptions:
    """What is asked of every branch of an intersection; the paper's map has pixels of 1 m.

    Attributes
    ----------
    length_m : float
        The paper picks 15 pixels of every branch and discards intersections with a branch that has fewer.
    max_error_m : float
        It discards those whose average distance from the fitted tangent is greater than half a pixel.
    skip_m : float
        Where a branch begins, as `IntersectionOptions.skip_length`: roads bend into an intersection.
    step_m, reach_m, max_turn_deg : float
        Each branch is looked at in such steps; roads further from it, or turned from it by more, are others.
    """

    length_m: float = 15.0
    max_error_m: float = 0.5
    skip_m: float = 8.0
    step_m: float = 3.0
    reach_m: float = 6.0
    max_turn_deg: float = 25.0


def well_fitted(index: ReferenceIndex, options: QualityOptions | None = None) -> BoolArray:
    """Tell which intersections (N,) have branches that are all long and straight enough."""
    options = options or QualityOptions()
    vectors = index.branches.astype(float) / 127.0
    at, column = np.nonzero(vectors.any(axis=2))
    ahead = vectors[at, column]
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    steps = options.skip_m + np.arange(0.0, options.length_m + 1e-9, options.step_m)
    points = (index.xy[at, None] + steps[:, None] * ahead[:, None]).reshape(-1, 2)
    along = np.repeat(ahead, len(steps), axis=0)
    out = np.empty((len(points), 3))
    reach = np.full(len(points), options.reach_m)
    road_residuals(points, along, reach, math.cos(math.radians(options.max_turn_deg)), index.road_buckets, out)
    across = np.column_stack([-along[:, 1], along[:, 0]])
    offsets = (out[:, 0] * (out[:, 1:] * across).sum(axis=1)).reshape(-1, len(steps))
    # What is left beside the line fitted to a branch, which need not meet the intersection; NaN: it is too short.
    basis = np.linalg.qr(np.column_stack([np.ones(len(steps)), steps]))[0]
    error = np.abs(offsets - offsets @ basis @ basis.T).mean(axis=1)
    good = np.ones(len(index), bool)
    good[at[~(error <= options.max_error_m)]] = False
    return good
