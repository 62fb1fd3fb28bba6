"""The foreground of a steep view: which ground it is, and what it is worth where nothing behind it can be traced."""

from dataclasses import replace

import numpy as np
import pytest
from worlds.scenes import Sight, camera, look, scene_of

from roadgeo.geometry.camera import sampling
from roadgeo.geometry.homography import Homography
from roadgeo.matching.exactness import exact_log10_odds
from roadgeo.matching.foreground import before, foreground
from roadgeo.matching.hypothesis import Hypothesis
from roadgeo.matching.verification import VerifyOptions, agreement, chance_agreement, log10_odds

SIZE = (1000, 1000)
OPTIONS = VerifyOptions()
NO_SEEDS = np.array([], int)
STEEP = camera((2000, 1900), SIZE, 1.0, 54.0, 50.0, 130.0, 1200.0)
LEVEL = camera((2000, 1900), SIZE, 1.0, 5.0, 50.0, 130.0, 1200.0)


def verified(matrix, scene, index, seeds=NO_SEEDS):
    gsd = sampling(matrix, scene.size)
    found, matched, _ = agreement(matrix, scene, index, gsd, seeds, OPTIONS)
    chance = chance_agreement(matrix, scene, index, gsd, OPTIONS)
    odds = log10_odds(found, chance, scene.n_statements, 1, OPTIONS)
    return Hypothesis(matrix, seeds, 1.0, matched, found=found, chance=chance, gsd_m=gsd, log10_odds=odds)


def pixel_m(matrix, xy):
    return np.sqrt(np.abs([np.linalg.det(Homography(matrix).jacobian(one)) for one in xy]))


@pytest.fixture(scope="module")
def scene(town):
    return scene_of(look(town[0], STEEP, SIZE, Sight(0.5)))


def test_it_is_the_ground_whose_pixels_are_not_much_coarser(town, scene):
    model = verified(STEEP, scene, town[1])
    part = foreground(model, scene, 1.6, 0.65)
    limit = 1.6 * sampling(STEEP, SIZE)
    for every, kept in [
        (scene.points, part.scene.points),
        (scene.dense_points, part.scene.dense_points),
        (scene.intersections.xy, part.scene.intersections.xy),
    ]:
        near = pixel_m(STEEP, every) <= limit
        assert 0 < near.sum() < len(every)
        assert np.array_equal(kept, every[near])
        assert np.array_equal(before(every, STEEP, scene, 1.6), near)
    rows, columns = np.indices(scene.observed.shape)
    cells = np.stack([columns + 0.5, -rows - 0.5], axis=-1).reshape(-1, 2) * scene.field_scale
    assert np.array_equal(part.scene.observed.ravel(), pixel_m(STEEP, cells) <= limit)
    assert part.scene.neighbours.max() < len(part.scene.intersections)
    share = len(part.scene.points) / len(scene.points)
    assert part.scene.road_length_px == pytest.approx(share * scene.road_length_px)
    assert part.scene.n_edges == pytest.approx(share * scene.n_edges, abs=0.5)


def test_seeds_keep_their_intersections(town, scene):
    near = np.flatnonzero(before(scene.intersections.xy, STEEP, scene, 1.6))
    far = np.setdiff1d(np.arange(len(scene.intersections)), near)
    model = verified(STEEP, scene, town[1], np.array([near[-1], far[0], near[3]]))
    part = foreground(model, scene, 1.6, 0.65)
    assert np.array_equal(part.scene.intersections.xy[part.seeds], scene.intersections.xy[[near[-1], near[3]]])


def test_a_level_view_has_none(town):
    scene = scene_of(look(town[0], LEVEL, SIZE, Sight(0.5)))
    assert foreground(verified(LEVEL, scene, town[1]), scene, 1.6, 0.65) is None


def test_none_is_looked_at_where_it_cannot_agree(town, scene):
    model = verified(STEEP, scene, town[1])
    lost = replace(model, found=replace(model.found, forward=0.1))
    assert foreground(lost, scene, 1.6, 0.65) is None
    assert foreground(Hypothesis(STEEP, NO_SEEDS, 1.0, NO_SEEDS), scene, 1.6, 0.65) is None
    few = replace(scene, points=scene.points[:20], directions=scene.directions[:20], weights=scene.weights[:20])
    assert foreground(verified(STEEP, few, town[1]), few, 1.6, 0.65) is None


@pytest.fixture(scope="module")
def merged(town, scene):
    """Behind the foreground the mask shows other roads than there are."""
    graph, other = (
        look(town[0], at, SIZE, Sight(0.5)) for at in (STEEP, camera((1500, 2600), SIZE, 1.0, 54.0, 20.0, 30.0, 1200.0))
    )
    right, wrong = scene_of(graph), scene_of(other)
    near, far = before(right.points, STEEP, right, 1.6), ~before(wrong.points, STEEP, right, 1.6)
    crossings = before(right.intersections.xy, STEEP, right, 1.6)
    rows, columns = np.indices(right.observed.shape)
    cells = np.stack([columns + 0.5, -rows - 0.5], axis=-1).reshape(-1, 2) * right.field_scale
    shown = before(cells, STEEP, right, 1.6).reshape(right.observed.shape)
    joined = {
        name: np.concatenate([getattr(right, name)[near], getattr(wrong, name)[far]])
        for name in ("points", "directions", "weights")
    }
    return replace(
        right,
        **joined,
        field=np.where(shown, right.field, wrong.field),
        intersections=right.intersections.only(np.flatnonzero(crossings)),
        branches=right.branches[crossings],
    )


def test_a_place_counts_by_its_foreground_where_the_rest_is_lost(town, merged):
    model = verified(STEEP, merged, town[1])
    without = exact_log10_odds(model, merged, town[1], 1, replace(OPTIONS, foreground=1e9), 1e3)
    assert exact_log10_odds(model, merged, town[1], 1, OPTIONS, 1e3) > max(without, 0.0) + 10.0


@pytest.mark.parametrize("refused", [True, False])
def test_what_was_refused_stays_refused(town, merged, refused):
    """A camera, or where the frame may lie, ruled it out after it had been compared with the map."""
    model = verified(STEEP, merged, town[1])
    if refused:
        model.log10_odds = -np.inf
    assert np.isfinite(exact_log10_odds(model, merged, town[1], 1, OPTIONS, 1e3)) != refused


def test_a_wrong_place_gains_nothing(town, merged):
    away = np.array([[1, 0, 260.0], [0, 1, -140.0], [0, 0, 1]]) @ STEEP
    model = verified(away, merged, town[1])
    assert exact_log10_odds(model, merged, town[1], 1, OPTIONS, 1e3) < 0.0
