"""The search for a place, on made-up towns with known homographies."""

from dataclasses import replace

import numpy as np
import pytest
from worlds.scenes import Sight, camera, estimator_of, look, mapped, random_network, scene_of, search

from roadgeo.geometry.camera import CameraOptions
from roadgeo.matching import growing
from roadgeo.matching.estimator import MatchOptions
from roadgeo.matching.events import Ledger
from roadgeo.matching.scene import query_neighbours
from roadgeo.matching.search import Search, SearchOptions, search_together
from roadgeo.matching.triples import WITHOUT_ROADS, Sweep, TripleOptions

ACCEPT = SearchOptions().accept


def locate(scene, index, options=None, near=None, limits=None):
    estimator = estimator_of(scene, index, options, near)
    return search(estimator, limits), estimator


def gap(result, truth, scene):
    """Largest error of a corner, metres."""
    return np.hypot(*(mapped(result.best.refined.matrix, scene.corners) - mapped(truth, scene.corners)).T).max()


@pytest.mark.parametrize("tilt", [0, 15, 30, 45])
@pytest.mark.parametrize(
    "sight",
    [Sight(0.5), Sight(1.5, missing=0.1, false=0.1), Sight(1.0, missing=0.2, false=0.2)],
    ids=["sharp", "noisy", "gaps"],
)
def test_finds_where_a_camera_looked(town, tilt, sight):
    network, index = town
    for seed in range(2):
        rng = np.random.default_rng([tilt, seed])
        truth = camera(
            tuple(rng.uniform(1300, 2700, 2)), (1000, 1000), rng.uniform(0.8, 1.4), tilt, *rng.uniform(0, 360, 2)
        )
        scene = scene_of(look(network, truth, sight=sight, seed=seed))
        result, estimator = locate(scene, index)
        assert result.score >= ACCEPT
        assert result.stopped == "accepted"
        assert gap(result, truth, scene) < 6
        assert np.hypot(*(result.best.center - mapped(truth, scene.center[None])[0])) < 2
        assert estimator.n_tuples >= estimator.n_verified > 0


TRUTH = camera((2100, 1900), (1000, 1000), 1.0, 10.0, 20.0, 70.0)


@pytest.fixture(scope="module")
def scene(town):
    """A view of the town."""
    return scene_of(look(town[0], TRUTH, sight=Sight(0.8, missing=0.05)))


class TestNear:
    def test_a_circle_around_the_place_changes_nothing(self, town, scene):
        x, y = mapped(TRUTH, scene.center[None])[0]
        result, _ = locate(scene, town[1], near=(x + 80, y, 150.0))
        assert result.score >= ACCEPT
        assert gap(result, TRUTH, scene) < 5


class TestCamera:
    def test_a_known_camera_is_found(self, town, scene):
        known = MatchOptions(camera=CameraOptions(gsd_m=(0.9, 1.1), max_tilt_deg=15.0, focal_px=1000.0))
        assert gap(locate(scene, town[1], known)[0], TRUTH, scene) < 5


@pytest.mark.parametrize("n", [0, 1, 2, 3, 5])
def test_little_to_see(town, scene, n):
    found = scene.intersections
    few = replace(found, xy=found.xy[:n], rays=found.rays[:n], tangents=found.tangents[:n])
    neighbours = query_neighbours(few.xy, 8) if n else np.empty((0, 8), np.int32)
    little = replace(scene, intersections=few, branches=scene.branches[:n], neighbours=neighbours)
    result, _ = locate(little, town[1], MatchOptions(without_roads=WITHOUT_ROADS[:2], roads=False))
    assert result.score < 6
    by_roads, _ = locate(little, town[1])
    assert (by_roads.score > 6) == (n > 0)  # one intersection and all the roads are enough


def test_road_points_far_from_the_anchor(town, scene):
    sparse = replace(scene, points=scene.points[:0], directions=scene.directions[:0], weights=scene.weights[:0])
    locate(sparse, town[1], limits=SearchOptions(time_limit_s=0.5))


@pytest.mark.parametrize("most", [0, 300])
def test_places_are_bounded(town, most):
    stranger = scene_of(look(random_network(3, 2000.0), camera((1000, 1000)), sight=Sight(0.5)))
    options = MatchOptions(max_places=most, without_roads=WITHOUT_ROADS[:2], roads=False)
    result, estimator = locate(stranger, town[1], options)
    assert result.stopped == "exhausted"
    assert estimator.n_screened <= most + growing.MAX_SCREENED


def test_places_on_many_maps_are_bounded_as_on_one(town):
    stranger = scene_of(look(random_network(3, 2000.0), camera((1000, 1000)), sight=Sight(0.5)))
    options = MatchOptions(max_places=40, without_roads=WITHOUT_ROADS[:2], roads=False)
    ledger = Ledger(n_reference=3 * len(town[1]))
    parts = [estimator_of(stranger, town[1], options, ledger=ledger) for _ in range(3)]
    search_together([Search(part) for part in parts], SearchOptions(time_limit_s=60.0))
    assert ledger.tried.total() == ledger.tried["triples"] == sum(part.n_screened for part in parts)
    assert 40 <= ledger.tried.total() < 40 + max(part.n_screened for part in parts)


def test_more_anchors_are_tried_on_a_small_map(town, scene):
    index = town[1]

    def n_anchors(most_more):
        sweep = Sweep(TripleOptions(), 5, most_more)
        return len(list(sweep.proposals(scene, [index], (0.1, 10.0), 0.33)))

    assert n_anchors(1.0) == 5
    assert n_anchors(1.0) < n_anchors(3.0) <= 15
