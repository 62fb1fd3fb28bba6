"""The last fit of a place that may be reported: to the whole frame, beside no street, and how sure its corners are.

During the search, cells of the frame where few roads are met wait: these roads may be met by chance. At the
right place they are not. And a part of the frame may have settled on the next street: then the fit is too sure of
itself, for nothing in it shows that.
"""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo.geometry.camera import sampling
from roadgeo.geometry.homography import Homography
from roadgeo.matching.carriageways import refine_between, weight_on_roads
from roadgeo.matching.estimator import TripleEstimator
from roadgeo.matching.evidence import agreement
from roadgeo.matching.growing import Hypothesis
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.lens import FEWEST, K1_SIGMA, LensEquations
from roadgeo.matching.refinement import Refined, RefineOptions, corner_covariance, corner_sigmas, refine, robust_rms
from roadgeo.matching.scene import Scene

__all__ = ["measure_corners", "refine_beside", "with_honest_corners"]

#: Where this much of the mask's roads agrees, no cell of the frame was left out; a fit to all cells loses hardly any.
_WHOLE, _LEAST_LOST = 0.9, 0.03
#: How far corners are moved, one by one, to see whether the fit comes back: metres in the middle of the frame, and not
#: less than 8 pixels; by how many road points; and how often at most.
_BESIDE_M, _BESIDE_PX, _N_POINTS, _MOST_ROUNDS = (12.0, 24.0), 8.0, 200, 5
#: A fit has come back that moves no corner by more than this part of the least step. Another one is better where this
#: share of the road points lies on roads in addition.
_BACK, _BETTER = 0.25, 0.006
#: Standard deviation of the place of a lens's middle in each direction, pixels: conventions differ by half of one.
_CENTER_SIGMA_PX = 0.5

#: How errors add up, fitted to the corners of 900 masks, good and bad, and of 34 of a real city. The factor by which
#: residuals overstate them without a lens; over how much more ground errors keep their sign far away, by the reach of a
#: pixel; and the floor that no number of points lowers: a part of the residuals' rms, and the mask's accuracy, pixels,
#: beside that of the map (`RefineOptions.sigma_floor_m`).
_OVERSTATED, _FAR, _FLOOR, _FLOOR_PX = 0.67, 0.5, 0.15, 0.1
#: Residuals end at three standard deviations: roads further off do not pull. Those beyond 2.5 are near the end,
#: many of them where a mask is bent. There the pull falls to nothing, and the fit is held less firmly: each reduces
#: the slope of the pull by this amount. By their number and the pull there it would be 0.6, fitted it is more.
_NEAR_END, _PULL_AT_END = 2.5, 1.1


def measure_corners(estimator: TripleEstimator, best: Hypothesis | None, score: float) -> None:
    """Refine the best place of a map for the last time, and measure how sure its corners are.

    Only one whose `score` may be reported is worth a fit to the whole frame: every part of a map has a best place.
    """
    if best is None or best.refined is None or best.found is None or not estimator.options.lens:
        return
    scene = estimator.scene
    if best.refined.lens_k1 == 0.0:
        doubtful = best.found.forward < _WHOLE and score > 0.0
        if doubtful:
            _fit_whole_frame(estimator, best, best.refined, best.found.forward)
        scene = _lay_between_carriageways(estimator, best, best.refined)
        for _ in range(_MOST_ROUNDS if doubtful else 0):
            found = refine_beside(best.refined, scene, estimator.index, estimator.refinement(best))
            if found is None or not estimator.may_be(found.matrix):
                break
            _take(estimator, best, found)
    best.refined = with_honest_corners(best.refined, scene, estimator.index, estimator.refine_options)


def _fit_whole_frame(estimator: TripleEstimator, best: Hypothesis, refined: Refined, agreeing: float) -> None:
    """Refine a place with all cells of the frame, now that it is known."""
    options = replace(estimator.refinement(best), least_share=0.0)
    found = refine(refined.matrix, estimator.scene, estimator.index, best.matched, options, held=True)
    if found is not None and estimator.may_be(found.matrix):
        _take(estimator, best, found, agreeing - _LEAST_LOST)


def _take(estimator: TripleEstimator, best: Hypothesis, refined: Refined, least: float = 0.0) -> None:
    """Take a new fit for a place, if at least this share of the mask's roads agrees.

    The earlier result stands: the odds rest on it.
    """
    scene = estimator.scene
    gsd = sampling(refined.matrix, scene.size)
    found, matched, distance = agreement(refined.matrix, scene, estimator.index, gsd)
    if found.forward >= least:
        best.refined, best.matrix, best.gsd_m = refined, refined.matrix, gsd
        best.matched, best.distance = matched, distance


def _lay_between_carriageways(estimator: TripleEstimator, best: Hypothesis, refined: Refined) -> Scene:
    """Lay the middle of a mask's two roads on the map's one; return the scene with road points there."""
    scene, index = estimator.scene, estimator.index
    found, seen = refine_between(refined, scene, index, best.matched, estimator.refinement(best))
    if seen is scene or not estimator.may_be(found.matrix):
        return scene
    _take(estimator, best, found)
    return seen


def refine_beside(refined: Refined, scene: Scene, index: ReferenceIndex, options: RefineOptions) -> Refined | None:
    """Find a homography beside a refined one that lays more of the roads on roads; None where there is none.

    Each corner of the frame in turn is put elsewhere, the others stay; where the fit does not come back, it may have
    found something better.
    """
    options, nothing = replace(options, least_share=0.0), np.full(len(scene.intersections), -1)
    places, gsd = Homography(refined.matrix).everywhere(scene.corners), sampling(refined.matrix, scene.size)
    steps_m = [max(step, _BESIDE_PX * gsd) for step in _BESIDE_M]

    def stays_away(one: Refined) -> bool:
        moved = np.hypot(*(Homography(one.matrix).everywhere(scene.corners) - places).T)
        return bool(moved.max() > _BACK * steps_m[0])

    starts = [start for step in steps_m for start in _beside(refined.matrix, scene, step / gsd)]
    tried = [refine(start, scene, index, nothing, options, _N_POINTS, held=True) for start in starts]
    weights = {weight_on_roads(one.matrix, scene, index): one for one in tried if one is not None and stays_away(one)}
    found = refine(weights[max(weights)].matrix, scene, index, nothing, options, held=True) if weights else None
    needed = weight_on_roads(refined.matrix, scene, index) + _BETTER * len(scene.points)
    return found if found is not None and weight_on_roads(found.matrix, scene, index) > needed else None


def _beside(matrix: FloatArray, scene: Scene, pixels: float) -> list[FloatArray]:
    """Return homographies (3, 3) that put one corner of the frame elsewhere, and the others where `matrix` does.

    By this many pixels in each corner, and not by less ground than in the middle of the frame: what a steep view shows
    far away may be off by more.
    """
    corners, least_m = scene.corners.astype(np.float32), pixels * sampling(matrix, scene.size)
    places, by_pixel = Homography(matrix).everywhere(scene.corners), Homography(matrix).jacobian(scene.corners)
    middle = places.mean(axis=0)
    back = np.array([[1.0, 0.0, middle[0]], [0.0, 1.0, middle[1]], [0.0, 0.0, 1.0]])
    found = []
    for k in range(4):
        for away in pixels * np.array([(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)]) @ by_pixel[k].T:
            there = places - middle
            there[k] += away * max(1.0, least_m / float(np.hypot(*away)))
            found.append(np.asarray(back @ cv2.getPerspectiveTransform(corners, there.astype(np.float32)), float))
    return found


def with_honest_corners(refined: Refined, scene: Scene, index: ReferenceIndex, options: RefineOptions) -> Refined:
    """Return a refined homography with the covariance of its corners measured anew.

    The fit takes all residuals for equally uncertain but for how far a pixel reaches. But far away errors keep their
    sign over more ground, and the middle of a lens is not known exactly.

    The matrix stays as it is, and so does the covariance where too few roads are met.
    """
    equations, k1 = LensEquations(refined.matrix, scene, index, options), refined.lens_k1
    seen = equations.observe(k1, np.zeros((9, 9)))
    if len(seen.rows) < FEWEST:
        return refined
    reach, by_center = (array[seen.which] for array in equations.local_scale(k1))
    free = 9 if k1 else 8
    rows, weights = seen.rows[:, :free], equations.weight * seen.cauchy / seen.own**2
    scaled = weights[:, None] * rows
    normal = scaled.T @ rows + np.diag(equations.prior(K1_SIGMA)[:free])
    inverse = np.asarray(np.linalg.pinv(normal, hermitian=True), float)
    near_end = np.abs(seen.residuals / seen.sigma) > _NEAR_END
    rms = robust_rms(seen.scaled, seen.cauchy, _PULL_AT_END * float(near_end.sum()))
    as_long = (1.0 if k1 else _OVERSTATED) * np.maximum(1.0, reach / np.median(reach)) ** _FAR
    # sandwich estimate of an M-estimator's covariance (Huber 1981, 6.3)
    covariance = (rms / equations.unit) ** 2 * inverse @ (scaled.T * as_long**2 @ rows) @ inverse
    if k1:  # the middle of the lens was not estimated: add its effect on the parameters
        unknown = _CENTER_SIGMA_PX * np.einsum("ni,nij->nj", seen.normals, by_center)
        moved = inverse @ (scaled.T @ unknown)
        covariance = covariance + moved @ moved.T
    floor_m = math.hypot(options.sigma_floor_m, _FLOOR * rms)
    options = replace(options, sigma_floor_m=floor_m, sigma_floor_px=_FLOOR_PX)
    corners = corner_covariance(equations.p, covariance[:8, :8], scene, equations.unit, options)
    if not np.isfinite(corners).all():
        return refined
    return replace(refined, corner_sigma_m=corner_sigmas(corners), corner_covariance_m2=corners)
