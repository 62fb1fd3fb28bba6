"""How sure a place is: standard deviations of the frame's corners, after all that the fit itself does not know."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.lens import LensOptions
from roadgeo.matching.lens_equations import LensEquations
from roadgeo.matching.refinement import Refined, RefineOptions, corner_covariance, corner_sigmas, robust_rms
from roadgeo.matching.scene import Scene

__all__ = ["with_honest_corners"]

#: Cells of the frame agree where they have this part of the best one's share of road points on roads; and where those
#: hold less than this share of all points, only a part of the frame agrees. Points count where a pixel reaches up to so
#: many times further than usual: what a tilted frame shows far away cannot be traced. Training masks seen through
#: lenses that were not found: 0.44 to 0.83, tilted ones 0.87 and more.
_LEAST_SHARE, _MOST_OF_FRAME, _AS_NEAR = 0.5, 0.85, 1.5

#: What residuals say too much where no lens was found; fitted to the corners of 390 masks, good ones and bad ones.
_OVERSTATED = 0.9


def with_honest_corners(
    refined: Refined, scene: Scene, index: ReferenceIndex, agreeing: float, options: RefineOptions, lens: LensOptions
) -> Refined:
    """Return a refined homography with the covariance of its corners measured anew.

    The fit takes all residuals for equally uncertain. But a pixel far out in a tilted frame, or near a lens's edge,
    reaches further on the ground: how residuals grow with it is measured. The middle of a lens is not known exactly.
    And where only one part of the frame agrees, the rest may be seen through a lens that was not found,
    or not rightly.

    The matrix stays as it is, and so does the covariance where too few roads are met.
    """
    equations, k1 = LensEquations(refined.matrix, scene, index, options), refined.lens_k1
    seen = equations.observe(k1, np.zeros((9, 9)))
    if len(seen.rows) < lens.fewest:
        return refined
    reach, by_center = equations.local_scale(k1)
    used = np.ones(len(seen.rows), bool)
    partly = False
    if agreeing < lens.enough:
        _, inside = equations.core(k1, lens.n_cells, _LEAST_SHARE)
        if partly := bool(inside[reach < _AS_NEAR * np.median(reach[seen.which])].mean() < _MOST_OF_FRAME):
            used = inside[seen.which]
    if used.sum() < lens.fewest:
        return refined
    reach, by_center = reach[seen.which][used], by_center[seen.which][used]
    everything, residuals, sigma = seen.rows[used], seen.residuals[used], seen.sigma[used]
    free = 9 if k1 or partly else 8
    rows = everything[:, :free]
    # sandwich estimate of an M-estimator's covariance (Huber 1981, 6.3)
    weights = 1.0 / (1.0 + (residuals / sigma) ** 2)
    scaled = equations.weight * weights[:, None] * rows
    inverse = np.linalg.pinv(scaled.T @ rows + np.diag(equations.prior(lens.sigma)[:free]), hermitian=True)
    scatter = _scatter(residuals, weights, reach, options.usual_rms * equations.sigma_m) / equations.unit
    scatter *= 1.0 if k1 else _OVERSTATED
    covariance = inverse @ ((rows * (equations.weight * scatter**2)[:, None]).T @ rows) @ inverse
    if partly:  # a lens that is told from none where k1 is so many times its deviation may be anything below that
        unseen = min(lens.sigma, lens.significance / math.sqrt(3.0) * math.sqrt(covariance[8, 8]))
        by_k1 = covariance[:, 8] / covariance[8, 8]
        covariance = covariance + max(unseen**2 - covariance[8, 8], 0.0) * np.outer(by_k1, by_k1)
    if k1:  # the middle of the lens, which was not estimated, by what it would do to what was
        across = everything[:, [2, 5]] / np.linalg.norm(everything[:, [2, 5]], axis=1, keepdims=True)
        unknown = lens.center_sigma_px * np.einsum("ni,nij->nj", across, by_center)
        moved = inverse @ (scaled.T @ unknown)
        covariance = covariance + moved @ moved.T
    corners = corner_covariance(equations.p, covariance[:8, :8], scene, equations.unit, options)
    if not np.isfinite(corners).all():
        return refined
    return replace(refined, corner_sigma_m=corner_sigmas(corners), corner_covariance_m2=corners)


def _scatter(residuals: FloatArray, weights: FloatArray, reach: FloatArray, usual: float) -> FloatArray:
    """Return what each residual (M,) counts as in the covariance of an M-estimate, metres.

    The square of what it is weighted by grows with that of how far a pixel reaches, `reach`; far away errors keep their
    sign over more ground, too. Where residuals are more than `usual` the mask is bent, and they keep it as much further
    (see `RefineOptions.usual_rms`).
    """
    square, far = (weights * residuals) ** 2, reach**2
    (floor, slope), *_ = np.linalg.lstsq(np.stack([1.0 / far, np.ones_like(far)], axis=1), square / far, rcond=None)
    if floor < 0.0:
        floor, slope = 0.0, float((square / far).mean())
    elif slope < 0.0:
        floor, slope = float(square.mean()), 0.0
    rms = robust_rms(residuals, weights)
    by_weights = rms / math.sqrt(max(float(square.mean()), 1e-12))
    as_long = math.sqrt(max(1.0, rms / usual)) * np.maximum(1.0, reach / np.median(reach)) ** 0.25
    return np.asarray(np.sqrt(floor + slope * far) * by_weights * as_long)
