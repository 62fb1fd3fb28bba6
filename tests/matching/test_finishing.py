"""The last fit of a place that may be reported takes the whole frame."""

import numpy as np
import pytest
from worlds.scenes import Sight, mapped, sight_of

from roadgeo.geometry.camera import sampling
from roadgeo.matching.estimator import MatchOptions, TripleEstimator
from roadgeo.matching.finishing import measure_corners
from roadgeo.matching.hypothesis import Hypothesis
from roadgeo.matching.refinement import Refined
from roadgeo.matching.verification import Agreement


@pytest.mark.parametrize(
    ("score", "agreeing", "within", "mended"),
    [(10.0, 0.7, None, True), (10.0, 0.95, None, False), (0.0, 0.7, None, False), (10.0, 0.7, (0, 0, 1, 1), False)],
    ids=["doubtful", "whole", "weak", "elsewhere"],
)
def test_only_places_that_may_be_reported_are_fitted_to_the_whole_frame(town, score, agreeing, within, mended):
    truth, scene = sight_of(town[0], 5, tilt=15, sight=Sight(0.6))
    matrix, nothing = np.array([[1, 0, 3.0], [0, 1, -2.0], [0, 0, 1]]) @ truth, np.full(len(scene.intersections), -1)
    rough, found = Refined(matrix, np.ones(4), 1.0, np.eye(8)), Agreement(0, 10, agreeing, 0.8)
    gsd = sampling(matrix, scene.size)
    best = Hypothesis(matrix, nothing[:0], 1.0, nothing, refined=rough, found=found, gsd_m=gsd)
    measure_corners(TripleEstimator(scene, town[1], MatchOptions(within=within)), best, score)
    gaps = np.hypot(*(mapped(best.refined.matrix, scene.corners) - mapped(truth, scene.corners)).T)
    assert (gaps.max() < 1.5) == mended
    assert best.found is found  # the odds rest on it
