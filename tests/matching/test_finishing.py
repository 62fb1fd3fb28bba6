"""The last fit of a place that may be reported takes the whole frame, and no part of it stays beside a street."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from worlds.scenes import Sight, estimator_of, mapped, sight_of

from roadgeo.matching.estimator import MatchOptions
from roadgeo.matching.evidence import Agreement
from roadgeo.matching.finishing import measure_corners, refine_beside, with_honest_corners
from roadgeo.matching.place import Place, Weight
from roadgeo.matching.refinement import Refined, RefineOptions, refine


@pytest.mark.parametrize(
    ("score", "agreeing", "within", "mended"),
    [(10.0, 0.7, None, True), (10.0, 0.95, None, False), (0.0, 0.7, None, False), (10.0, 0.7, (0, 0, 1, 1), False)],
    ids=["doubtful", "whole", "weak", "elsewhere"],
)
def test_only_places_that_may_be_reported_are_fitted_to_the_whole_frame(town, score, agreeing, within, mended):
    truth, scene = sight_of(town[0], 5, tilt=15, sight=Sight(0.6))
    matrix, nothing = np.array([[1, 0, 3.0], [0, 1, -2.0], [0, 0, 1]]) @ truth, np.full(len(scene.intersections), -1)
    rough, weight = Refined(matrix, 1.0, np.eye(8), 0.0, 0.0, 1.0), Weight(20.0, 480.0)
    compared = Place(scene, town[1], matrix, grown=nothing, refined=rough, score=score, by=weight)
    vars(compared)["agreement"] = Agreement(agreeing, 0.8)
    best = measure_corners(estimator_of(scene, town[1], MatchOptions(within=within)), compared)
    gaps = np.hypot(*(mapped(best.refined.matrix, scene.corners) - mapped(truth, scene.corners)).T)
    assert (gaps.max() < 1.5) == mended
    assert (best.score, best.by) == (score, weight)  # the answer rests on it


def moved(truth, scene, corner, step):
    """A homography that puts one corner elsewhere, metres, and the others where the truth does."""
    places = mapped(truth, scene.corners)
    middle = places.mean(axis=0)
    places[corner] += step
    back = np.array([[1.0, 0.0, middle[0]], [0.0, 1.0, middle[1]], [0.0, 0.0, 1.0]])
    return back @ cv2.getPerspectiveTransform(scene.corners.astype(np.float32), (places - middle).astype(np.float32))


def gaps(matrix, truth, scene):
    return np.hypot(*(mapped(matrix, scene.corners) - mapped(truth, scene.corners)).T)


@pytest.mark.parametrize("corner", range(4))
def test_a_corner_beside_where_it_belongs_comes_back(town, corner):
    truth, scene = sight_of(town[0], 5, tilt=15, sight=Sight(0.6))
    beside = Place(scene, town[1], moved(truth, scene, corner, (14.0, -9.0)))
    found = refine_beside(beside, scene, RefineOptions())
    assert gaps(beside.matrix, truth, scene).max() > 15.0
    assert gaps(found.matrix, truth, scene).max() < 1.5


@pytest.mark.parametrize(("seed", "missing", "share"), [(7, 0.5, 0.2), (9, 0.7, 0.3), (11, 0.5, 0.3), (13, 0.7, 0.2)])
def test_the_far_corner_of_a_steep_view_comes_back_from_far_away(town, seed, missing, share):
    """There a pixel reaches over much ground, and so does what the fit may have settled on."""
    truth, scene = sight_of(town[0], seed, tilt=45, sight=Sight(1.0, missing, 0.5))
    way = mapped(truth, scene.corners) - mapped(truth, scene.corners).mean(axis=0)
    far = int(np.hypot(*way.T).argmax())
    beside = Place(scene, town[1], moved(truth, scene, far, share * way[far]))
    found = refine_beside(beside, scene, RefineOptions())
    assert gaps(beside.matrix, truth, scene).max() > 400.0
    assert gaps(found.matrix, truth, scene).max() < 2.0


def test_where_all_belongs_nothing_better_is_found(town):
    truth, scene = sight_of(town[0], 5, tilt=15, sight=Sight(0.6))
    assert refine_beside(Place(scene, town[1], truth), scene, RefineOptions()) is None


def test_far_from_all_roads_nothing_is_found(town):
    truth, scene = sight_of(town[0], 5)
    nowhere = truth + np.array([[0, 0, 90_000.0], [0, 0, 0], [0, 0, 0]])
    assert refine_beside(Place(scene, town[1], nowhere), scene, RefineOptions()) is None


def test_corners_that_depend_on_one_road_are_as_unsure_as_that_road(town):
    """The mask shows roads in its lower half, and above them one that lies 6 m beside where the map has it."""
    ratios = []
    for seed in range(5, 11):
        truth, whole = sight_of(town[0], seed, tilt=15, sight=Sight(0.6))
        down = -whole.points[:, 1] / whole.size[1]
        above = np.flatnonzero(down < 0.3)
        roads = np.split(above, np.flatnonzero(np.diff(above) != 1) + 1)
        road = max(roads, key=len)[:10]
        points, kept = whole.points.copy(), down > 0.55
        points[road] += 6.0 * whole.directions[road][:, ::-1] * (-1, 1)
        kept[road] = True
        scene = replace(whole, points=points, road_length_px=whole.road_length_px * kept.mean()).of_points(kept)
        nothing = np.full(len(scene.intersections), -1)
        refined = refine(truth, scene, town[1], nothing, held=True)
        claimed = with_honest_corners(refined, scene, town[1], RefineOptions()).corner_sigma_m
        ratios.append(np.mean(gaps(refined.matrix, truth, scene) ** 2) / np.mean(claimed**2))
    assert np.sqrt(np.mean(ratios)) < 2.0  # 9 by the residuals alone
