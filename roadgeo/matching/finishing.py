"""The last fit of a place that may be reported: to the whole frame, and with the standard deviation of its corners.

During the search, cells of the frame where few roads are met are left out: these roads may be met by chance. At the
right place they are not. A part of the frame may also have settled on the next street. The standard deviations of such
a fit are too small, and nothing in the fit shows it.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from roadgeo._arrays import BoolArray, FloatArray, IntArray
from roadgeo.geometry.homography import Homography, shift
from roadgeo.geometry.lens import Lens
from roadgeo.matching.estimator import TripleEstimator
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.lens import ENOUGH
from roadgeo.matching.place import Place
from roadgeo.matching.refinement import (
    Equations,
    Refined,
    RefineOptions,
    refine,
    refine_between,
    weight_on_roads,
)
from roadgeo.matching.scene import FEWEST, N_ROUGHLY, NOTICEABLE, Scene, at_least

__all__ = ["measure_corners", "measured", "refine_beside", "with_honest_corners"]

#: Corners are moved one by one by this distance, to see whether the fit comes back, metres in the middle of the frame;
#: and the most rounds.
_BESIDE_M, _MOST_ROUNDS = 24.0, 5
#: A fit has come back if no corner is off by more than this part of the step. Another fit is better if this share of
#: the road points lies on roads in addition.
_BACK, _BETTER = 0.125, 0.006
#: Standard deviation of the place of a lens's middle in each direction, pixels: conventions differ by half of one.
_CENTER_SIGMA_PX = 0.5

#: Road points further apart than this multiple of the usual step lie on different roads. Longer roads are cut into
#: pieces of this number of points: errors are correlated over shorter lengths.
_GAP, _PIECE = 1.5, 12
#: Beyond three standard deviations no road is met: there the influence, 3 / (1 + 3^2), drops to zero. Roads at nearly
#: that distance account for this drop, spread over half a standard deviation: it lowers the slope of the influence.
_NEAR_END, _FALL = 2.5, 0.6
#: Where the slopes leave a fit undetermined, as for a bent mask, all roads hold it with this part of their weights.
_LEAST_SLOPE = 0.17


def measure_corners(estimator: TripleEstimator, best: Place) -> Place:
    """Return the best place of a map refined for the last time, with the covariance of its corners.

    A place is fitted to the whole frame only if its score may be reported: every part of a map has a best place.
    """
    if best.refined is None:
        return best
    scene = estimator.scene
    if best.lens_k1 == 0.0:
        doubtful = best.agreement.forward < ENOUGH and best.score > 0.0
        if doubtful:
            best = _fit_whole_frame(estimator, best)
        best, scene = _fit_between_carriageways(estimator, best)
        for _ in range(_MOST_ROUNDS if doubtful else 0):
            beside = refine_beside(best, scene, estimator.refinement(best))
            if beside is None or not estimator.may_be(beside.matrix):
                break
            best = _moved(best, beside)
    return _with_corners(best, scene, estimator.refine_options)


def measured(estimator: TripleEstimator, place: Place) -> Place:
    """Return a place as it was fitted, with the covariance of its corners."""
    return _with_corners(place, estimator.scene, estimator.refine_options)


def _moved(place: Place, refined: Refined) -> Place:
    """Return a place by a better fit; it keeps the likelihood by which it was compared."""
    return place.at(refined).but(by=place.by)


def _with_corners(place: Place, scene: Scene, options: RefineOptions) -> Place:
    """Return a place with the covariance of its corners; unchanged where it was never refined."""
    if place.refined is None:
        return place
    return place.but(refined=with_honest_corners(place.refined, scene, place.index, options))


def _fit_whole_frame(estimator: TripleEstimator, best: Place) -> Place:
    """Refine a place with all cells of the frame, if about as much of the mask's roads agrees then."""
    options = replace(estimator.refinement(best), least_share=0.0)
    whole = refine(best.matrix, best.scene, best.index, best.matched, options, held=True)
    if whole is None or not estimator.may_be(whole.matrix):
        return best
    moved = _moved(best, whole)
    return moved if moved.agreement.forward >= best.agreement.forward - NOTICEABLE else best


def _fit_between_carriageways(estimator: TripleEstimator, best: Place) -> tuple[Place, Scene]:
    """Fit the middle of a mask's two roads to the map's single road; return the scene with road points there, too."""
    assert best.refined is not None  # noqa: S101 - what is measured was refined
    between, scene = refine_between(best.refined, best.scene, best.index, best.matched, estimator.refinement(best))
    if scene is best.scene or not estimator.may_be(between.matrix):
        return best, best.scene
    return _moved(best, between), scene


def refine_beside(place: Place, scene: Scene, options: RefineOptions) -> Refined | None:
    """Find a homography near a place's that puts more road points of a scene on roads; None if there is no better one.

    Each corner of the frame is moved in turn, while the others stay. A fit that does not come back may be better.
    """
    options, nothing, index = replace(options, least_share=0.0), np.full(len(scene.intersections), -1), place.index
    step_m = at_least(_BESIDE_M, place.gsd_m)

    def stays_away(fit: Refined) -> bool:
        moved = np.hypot(*(Homography(fit.matrix).everywhere(scene.corners) - place.corners).T)
        return bool(moved.max() > _BACK * step_m)

    starts = _beside(place, step_m / place.gsd_m)
    tried = [refine(start, scene, index, nothing, options, N_ROUGHLY, held=True) for start in starts]
    weights = {weight_on_roads(fit.matrix, scene, index): fit for fit in tried if fit is not None and stays_away(fit)}
    better = refine(weights[max(weights)].matrix, scene, index, nothing, options, held=True) if weights else None
    needed = weight_on_roads(place.matrix, scene, index) + _BETTER * len(scene.points)
    return better if better is not None and weight_on_roads(better.matrix, scene, index) > needed else None


def _beside(place: Place, pixels: float) -> list[FloatArray]:
    """Return homographies (3, 3) that move one corner of the frame, and map the others as a place does.

    The corner moves by this many pixels, but not by less ground than in the middle of the frame: distant ground of an
    oblique view may be off by more.
    """
    corners, least_m = place.scene.corners.astype(np.float32), pixels * place.gsd_m
    by_pixel, middle = Homography(place.matrix).jacobian(place.scene.corners), place.corners.mean(axis=0)
    back, beside = shift(*middle), list[FloatArray]()
    for k in range(4):
        for away in pixels * np.array([(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)]) @ by_pixel[k].T:
            there = place.corners - middle
            there[k] += away * max(1.0, least_m / float(np.hypot(*away)))
            beside.append(np.asarray(back @ cv2.getPerspectiveTransform(corners, there.astype(np.float32)), float))
    return beside


def with_honest_corners(refined: Refined, scene: Scene, index: ReferenceIndex, options: RefineOptions) -> Refined:
    """Return a refined homography with the covariance of its corners by the jackknife.

    Each road, or piece of a long road, is left out in turn, and the scatter of the corners is their covariance (a
    jackknife of clusters; Bell and McCaffrey 2002). It assumes nothing about the size of errors, their correlation
    along a road, or wrong matches. A corner is as uncertain as the roads on which it depends.

    The matrix does not change, nor does the covariance if too few roads are met.
    """
    k1 = refined.lens_k1
    equations = Equations(refined.matrix, scene, index, options, k1 or None)
    which = equations.meet()
    if which.sum() < FEWEST:
        return refined
    rows, residuals, sigmas, own, _ = (values[which] for values in equations.met)
    cauchy, free = equations.cauchy[which], rows.shape[1]
    weights = equations.weight * cauchy / own**2
    prior = np.diag(equations.prior[:free]) + 1e-9 * np.eye(free)
    starts = _starts_of_pieces(scene, which)
    squares = rows[:, :, None] * rows[:, None, :]
    at_end = np.abs(residuals / sigmas) > _NEAR_END
    slopes = weights * (2.0 * cauchy - 1.0 - _FALL * at_end / cauchy)
    normals = np.add.reduceat(slopes[:, None, None] * squares, starts)
    weighted = np.add.reduceat(weights[:, None, None] * squares, starts)
    if np.linalg.eigvalsh(normals.sum(axis=0) + prior - _LEAST_SLOPE * (weighted.sum(axis=0) + prior)).min() <= 0.0:
        normals = _LEAST_SLOPE * weighted
    pulls = np.add.reduceat((weights * residuals / equations.unit)[:, None] * rows, starts)
    normal = normals.sum(axis=0) + prior
    moved = np.linalg.solve(normal - normals, pulls[:, :, None])[:, :, 0]
    inverse = np.linalg.inv(normal)
    # Parameters that only the prior holds are as uncertain as the prior.
    covariance = moved.T @ moved + (equations.sigma_m / equations.unit) ** 2 * inverse @ prior @ inverse
    if k1:  # the middle of the lens was not estimated either
        lens, across = Lens.of(k1, scene.size, y_up=True), rows[:, [2, 5]]
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        straight = equations.normalised(lens.straighten(scene.points[which]))
        by_center = (
            equations.homography.jacobian(straight) / scene.half_size @ (np.eye(2) - lens.stretch(scene.points[which]))
        )
        moved = inverse @ ((weights[:, None] * rows).T @ np.einsum("ni,nij->nj", across, by_center))
        covariance = covariance + _CENTER_SIGMA_PX**2 * moved @ moved.T
    corners = equations.corner_covariance(covariance[:8, :8])
    if not np.isfinite(corners).all():
        return refined
    return replace(refined, corner_covariance_m2=corners)


def _starts_of_pieces(scene: Scene, which: BoolArray) -> IntArray:
    """Return where, among the road points of `which` (S,), each piece of road begins."""
    step = scene.road_length_px / len(scene.points)
    first = np.concatenate(([True], np.hypot(*np.diff(scene.points, axis=0).T) > _GAP * step))
    road = np.cumsum(first) - 1
    along = np.arange(len(first)) - np.flatnonzero(first)[road]
    piece = np.cumsum(first | (along % _PIECE == 0))
    return np.unique(piece[which], return_index=True)[1]
