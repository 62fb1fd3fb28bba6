"""Doubt which road was met: where the map has another one beside it, and the mask does not show both.

Of two carriageways a mask may show the other one, or have made one road of them. Where a corner of the frame hangs on
such a road, it may be off by how far they are apart; the residuals know nothing of that.
"""

from __future__ import annotations

import math

import numpy as np

from roadgeo._arrays import BoolArray, FloatArray
from roadgeo.kernels.parallel_roads import points_beside
from roadgeo.kernels.residuals import road_residuals
from roadgeo.matching.lens_equations import LensEquations, Observed
from roadgeo.matching.refinement import spacing_m

__all__ = ["covariance_of_doubt"]

#: Another road lies at this distance beside the matched one, metres, and runs its way within this angle, degrees.
_BESIDE_M, _GIVE_OR_TAKE_M, _MAX_TURN_DEG = 13.0, 9.0, 12.0
#: The mask shows it where it has a road point within these distances, metres, across and along (or steps of points).
_SHOWN_M, _ALONG_M, _ALONG_STEPS = 5.0, 8.0, 1.2
#: Roads are assumed to be off together that run the same one of these ways and have the other road on the same side.
_WAYS, _FEWEST = 4, 3
#: How likely such roads are the other ones; less where the rest of the frame stands against it: half as likely where
#: the sum of its squares would grow by this amount. Fitted to the corners of training masks.
_LIKELY, _AGAINST = 0.1, 50.0


def covariance_of_doubt(
    equations: LensEquations,
    k1: float,
    seen: Observed,
    used: BoolArray,
    inverse: FloatArray,
    rows: FloatArray,
    weights: FloatArray,
) -> FloatArray:
    """Return the addition to the parameters' covariance (P, P) by doubt about which roads were matched.

    Parameters
    ----------
    seen : Observed
        The roads that were met, of which those `used` (M,) take part.
    inverse : (P, P)
        Of the normal matrix.
    rows, weights : (U, P), (U,)
        Derivatives of the U points that take part, and their weights.
    """
    beside = _unshown(equations, k1, seen)[:, used] / equations.unit
    normals = seen.normals[used]
    way = np.mod(np.floor(np.mod(np.arctan2(normals[:, 1], normals[:, 0]), np.pi) * (_WAYS / np.pi)), _WAYS)
    gained = np.zeros_like(inverse)
    for offsets in beside:
        for number in range(_WAYS):
            there = np.isfinite(offsets) & (way == number)
            if there.sum() < _FEWEST:
                continue
            off = np.where(there, offsets, 0.0)
            pull = rows.T @ (weights * off)
            moved = inverse @ pull
            against = (float(weights @ off**2) - float(pull @ moved)) * (equations.unit / equations.sigma_m) ** 2
            gained += _LIKELY / (1.0 + against / _AGAINST) * np.outer(moved, moved)
    return gained


def _unshown(equations: LensEquations, k1: float, seen: Observed) -> FloatArray:
    """Return how far beside each road that was met lies another one that the mask does not show, (2, M) metres.

    To either side, counted along the normals; NaN where there is none.
    """
    places, _ = equations.rows(k1)
    shown = places * equations.unit + equations.origin
    normals, found = seen.normals, np.empty((2, len(seen.rows)))
    along = np.ascontiguousarray(normals[:, ::-1] * (1.0, -1.0))
    feet = shown[seen.which] + seen.residuals[:, None] * normals
    upwards = np.where(normals[:, 1] < 0.0, -1.0, 1.0)
    reach, min_cos = np.full(len(feet), _GIVE_OR_TAKE_M), math.cos(math.radians(_MAX_TURN_DEG))
    ahead_m = max(_ALONG_M, _ALONG_STEPS * spacing_m(equations.scene, equations.unit))
    way, is_shown = np.empty((len(feet), 3)), np.empty(len(feet), np.bool_)
    for side, beside in zip((-1.0, 1.0), found, strict=True):
        start = np.ascontiguousarray(feet + _BESIDE_M * (side * upwards)[:, None] * normals)
        road_residuals(start, along, reach, min_cos, equations.roads, way)
        beside[:] = ((start + way[:, :1] * way[:, 1:] - feet) * normals).sum(axis=1)
        there = shown[seen.which] + beside[:, None] * normals
        points_beside(there, along, shown, _SHOWN_M, ahead_m, is_shown)
        beside[is_shown] = np.nan
    return found
