"""The last fit of a place that may be reported: to the whole frame, and not beside where it belongs.

While places are looked for, cells of the frame where few roads are met wait: what is met there may be chance. At the
right place it is none. And a part of the frame may have settled on the next street, or on the other carriageway: then
the fit is too sure of itself, for nothing in it knows of that.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo.geometry.camera import sampling
from roadgeo.geometry.homography import Homography
from roadgeo.matching.accuracy import with_honest_corners
from roadgeo.matching.carriageways import refine_between, weight_on_roads
from roadgeo.matching.estimator import TripleEstimator
from roadgeo.matching.hypothesis import MINIMAL, Hypothesis
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.refinement import Refined, RefineOptions, refine
from roadgeo.matching.scene import Scene
from roadgeo.matching.verification import agreement

__all__ = ["measure_corners", "refine_beside"]

#: Where so much of the mask's roads agrees, no cell of the frame was left out, and nothing has settled beside where it
#: belongs; a fit to all cells loses hardly any of them.
_WHOLE, _LEAST_LOST = 0.9, 0.03
#: How far corners are moved, one by one, to see whether the fit comes back, as carriageways are apart: metres in the
#: middle of the frame, of so many pixels at least; road points to see by; and how often at most.
_BESIDE_M, _BESIDE_PX, _N_POINTS, _MOST_ROUNDS = (12.0, 24.0), 8.0, 200, 5
_WAYS = np.array([(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)])
#: A fit has come back that puts no corner further off than this part of the least step.
_BACK = 0.25
#: Another fit is better where so much more of the road points lies on roads. Training masks: three of five hundred.
_BETTER = 0.006


def measure_corners(estimator: TripleEstimator, best: Hypothesis | None, score: float) -> None:
    """Refine the best place of a map for the last time, and measure how sure its corners are.

    Only one whose `score` may be reported is worth a fit to the whole frame: every part of a map has a best place.
    """
    lens, verify = estimator.options.lens, estimator.options.verify
    if best is None or best.refined is None or best.found is None or lens is None:
        return
    scene, agreeing = estimator.scene, best.found.forward
    if best.refined.lens_k1 == 0.0:
        doubtful = agreeing < _WHOLE and score > 0.0
        if doubtful:
            _fit_whole_frame(estimator, best, best.refined, agreeing)
        scene = _lay_between_carriageways(estimator, best, best.refined)
        if doubtful:
            agreeing = _look_beside(estimator, best, best.refined, scene, agreeing)
    options = estimator.refine_options
    best.refined = with_honest_corners(best.refined, scene, estimator.index, agreeing, options, lens, verify)


def _fit_whole_frame(estimator: TripleEstimator, best: Hypothesis, refined: Refined, agreeing: float) -> None:
    """Refine a place with all cells of the frame, now that it is known."""
    options = replace(estimator.refinement(best), least_share=0.0)
    found = refine(refined.matrix, estimator.scene, estimator.index, best.matched, options, held=True)
    if found is not None and estimator.may_be(found.matrix):
        _take(estimator, best, found, agreeing - _LEAST_LOST)


def _look_beside(
    estimator: TripleEstimator, best: Hypothesis, refined: Refined, scene: Scene, agreeing: float
) -> float:
    """Where a part of the frame has settled beside where it belongs, find that, and go on from there.

    Return how much of the mask's roads agrees then: as much as before where nothing was found.
    """
    for _ in range(_MOST_ROUNDS):
        found = refine_beside(refined, scene, estimator.index, estimator.refinement(best))
        if found is None or not estimator.may_be(found.matrix):
            break
        refined, agreeing = found, _take(estimator, best, found)
    return agreeing


def _take(estimator: TripleEstimator, best: Hypothesis, refined: Refined, least: float = 0.0) -> float:
    """Take a new fit for a place, if at least so much of the mask's roads agrees; return how much does.

    What was found before stands: the odds rest on it.
    """
    scene, seeds = estimator.scene, best.seeds[-MINIMAL:]
    gsd = sampling(refined.matrix, scene.size)
    found, matched, distance = agreement(refined.matrix, scene, estimator.index, gsd, seeds, estimator.options.verify)
    if found.forward >= least:
        best.refined, best.matrix, best.gsd_m = refined, refined.matrix, gsd
        best.matched, best.distance = matched, distance
    return found.forward


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
    places = Homography(refined.matrix).everywhere(scene.corners)
    back_m = _BACK * _steps_m(refined.matrix, scene)[0]

    def weight(one: Refined) -> float:
        return weight_on_roads(one.matrix, scene, index, options)

    def stays_away(one: Refined) -> bool:
        return bool(np.hypot(*(Homography(one.matrix).everywhere(scene.corners) - places).T).max() > back_m)

    tried = [
        refine(start, scene, index, nothing, options, _N_POINTS, held=True) for start in _beside(refined.matrix, scene)
    ]
    away = [one for one in tried if one is not None and stays_away(one)]
    found = refine(max(away, key=weight).matrix, scene, index, nothing, options, held=True) if away else None
    if found is None or weight(found) <= weight(refined) + _BETTER * len(scene.points):
        return None
    return found


def _steps_m(matrix: FloatArray, scene: Scene) -> list[float]:
    """Return how far corners are moved, metres in the middle of the frame: further where pixels are large."""
    least_m = _BESIDE_PX * sampling(matrix, scene.size)
    return [max(step, least_m) for step in _BESIDE_M]


def _beside(matrix: FloatArray, scene: Scene) -> list[FloatArray]:
    """Return homographies (3, 3) that put one corner of the frame elsewhere, and the others where `matrix` does.

    By as many pixels in each corner, and not by less ground than in the middle of the frame: what a steep view shows
    far away may be off by more.
    """
    corners, gsd = scene.corners.astype(np.float32), sampling(matrix, scene.size)
    places, by_pixel = Homography(matrix).everywhere(scene.corners), Homography(matrix).jacobian(scene.corners)
    middle = places.mean(axis=0)
    back = np.array([[1.0, 0.0, middle[0]], [0.0, 1.0, middle[1]], [0.0, 0.0, 1.0]])
    found = []
    for k in range(4):
        for step in _steps_m(matrix, scene):
            for away in step / gsd * _WAYS @ by_pixel[k].T:
                there = places - middle
                there[k] += away * max(1.0, step / float(np.hypot(*away)))
                found.append(np.asarray(back @ cv2.getPerspectiveTransform(corners, there.astype(np.float32)), float))
    return found
