"""How sure a place is: standard deviations of the frame's corners, after all that the fit itself does not know."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np

from roadgeo._arrays import BoolArray
from roadgeo.geometry.camera import sampling
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.lens import LensOptions, straighten_scene
from roadgeo.matching.lens_equations import LensEquations
from roadgeo.matching.other_roads import covariance_of_doubt
from roadgeo.matching.refinement import Refined, RefineOptions, corner_covariance, corner_sigmas, robust_rms
from roadgeo.matching.scene import Scene
from roadgeo.matching.verification import VerifyOptions, map_agreement

__all__ = ["with_honest_corners"]

#: Cells of the frame agree where they have this part of the best one's share of road points on roads; and where those
#: hold less than this share of all points, only a part of the frame may agree. Points count where a pixel reaches up to
#: this many times further than usual: a tilted frame cannot show distant roads well enough to trace.
_LEAST_SHARE, _MOST_OF_FRAME, _AS_NEAR = 0.5, 0.85, 1.5
#: It does where the mask shows less than this part of the map's roads elsewhere, compared with the part shown there.
#: Training masks seen through lenses that were not found: 0.27 to 0.46; with many false roads and many gone: 0.65 and
#: more, which look alike from the mask's side.
_LEAST_SHOWN = 0.55

#: How errors add up, fitted to the corners of 900 masks, good and bad, and of 34 of a real city. The factor by which
#: residuals overstate them without a lens; over how much more ground errors keep their sign far away, by the reach
#: of a pixel; and the floor that no number of points lowers: a part of the residuals' rms, and the mask's accuracy, px,
#: beside that of the map (`RefineOptions.sigma_floor_m`).
_OVERSTATED, _FAR, _FLOOR, _FLOOR_PX = 0.67, 0.5, 0.15, 0.1
#: Residuals end at three standard deviations: roads further off do not pull. Those beyond 2.5 are near the end,
#: many of them where a mask is bent. There the pull falls to nothing, and the fit is held less firmly: each reduces
#: the slope of the pull by this amount. By their number and the pull there it would be 0.6, fitted it is more.
_NEAR_END, _PULL_AT_END = 2.5, 1.1


def with_honest_corners(
    refined: Refined,
    scene: Scene,
    index: ReferenceIndex,
    agreeing: float,
    options: RefineOptions,
    lens: LensOptions,
    verify: VerifyOptions,
) -> Refined:
    """Return a refined homography with the covariance of its corners measured anew.

    The fit takes all residuals for equally uncertain but for how far a pixel reaches. But far away errors keep their
    sign over more ground. The middle of a lens is not known exactly. And where only one part of the frame agrees, the
    rest may be seen through a lens that was not found, or not rightly.

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
        cells = equations.cells(seen.which, lens.n_cells, _LEAST_SHARE)
        inside = cells[equations.cell_of(lens.n_cells)]
        near = reach < _AS_NEAR * np.median(reach[seen.which])
        if inside[near].mean() < _MOST_OF_FRAME and _only_there(refined, scene, index, cells, verify):
            partly, used = True, inside[seen.which]
    if used.sum() < lens.fewest:
        return refined
    reach, by_center = reach[seen.which][used], by_center[seen.which][used]
    everything, cauchy = seen.rows[used], seen.cauchy[used]
    free = 9 if k1 or partly else 8
    rows, weights = everything[:, :free], equations.weight * cauchy / seen.own[used] ** 2
    scaled = weights[:, None] * rows
    normal = scaled.T @ rows + np.diag(equations.prior(lens.sigma)[:free])
    inverse = np.asarray(np.linalg.pinv(normal, hermitian=True), float)
    near_end = np.abs(seen.residuals / seen.sigma)[used] > _NEAR_END
    rms = robust_rms(seen.scaled[used], cauchy, _PULL_AT_END * float(near_end.sum()))
    scatter = rms / equations.unit
    as_long = (1.0 if k1 or partly else _OVERSTATED) * np.maximum(1.0, reach / np.median(reach)) ** _FAR
    # sandwich estimate of an M-estimator's covariance (Huber 1981, 6.3)
    covariance = scatter**2 * inverse @ (scaled.T * as_long**2 @ rows) @ inverse
    covariance = covariance + covariance_of_doubt(equations, k1, seen, used, inverse, rows, weights)
    if partly:  # a lens that is not significant may have any k1 below the limit of significance
        unseen = min(lens.sigma, lens.significance / math.sqrt(3.0) * math.sqrt(covariance[8, 8]))
        by_k1 = covariance[:, 8] / covariance[8, 8]
        covariance = covariance + max(unseen**2 - covariance[8, 8], 0.0) * np.outer(by_k1, by_k1)
    if k1:  # the middle of the lens was not estimated: add its effect on the parameters
        unknown = lens.center_sigma_px * np.einsum("ni,nij->nj", seen.normals[used], by_center)
        moved = inverse @ (scaled.T @ unknown)
        covariance = covariance + moved @ moved.T
    floor_m = math.hypot(options.sigma_floor_m, _FLOOR * rms)
    options = replace(options, sigma_floor_m=floor_m, sigma_floor_px=_FLOOR_PX)
    corners = corner_covariance(equations.p, covariance[:8, :8], scene, equations.unit, options)
    if not np.isfinite(corners).all():
        return refined
    return replace(refined, corner_sigma_m=corner_sigmas(corners), corner_covariance_m2=corners)


def _only_there(refined: Refined, scene: Scene, index: ReferenceIndex, cells: BoolArray, verify: VerifyOptions) -> bool:
    """Whether the mask shows the map's roads in the given cells (n, n) of the frame, and not elsewhere."""
    there = cv2.resize(cells.astype(np.uint8), scene.observed.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
    gsd, k1, shares = sampling(refined.matrix, scene.size), refined.lens_k1, []
    for part in (there, ~there):
        visible = replace(scene, observed=scene.observed & part)
        visible = straighten_scene(visible, k1) if k1 else visible
        n_seen, n_shown = map_agreement(refined.matrix, visible, index, gsd, verify)
        shares.append(n_shown / max(n_seen, 1))
    return shares[1] < _LEAST_SHOWN * shares[0]
