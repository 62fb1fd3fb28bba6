"""Drawing: masks of a view, clean and worn."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from worlds.towns import lattice_town

from roadgeo.evaluation.noise import NOISE_MODELS, NoiseModel, draw_mask
from roadgeo.geometry.pinhole import make_view

TOWN = lattice_town()
VIEW = make_view((550.0, 550.0), (800, 800), 1.0, 20.0, 40.0, 130.0)


def draw(noise, seed=0):
    return draw_mask(TOWN, VIEW, noise, (8.0, 11.0), np.random.default_rng(seed))


def test_a_clean_mask_shows_road_where_the_map_has_it():
    mask, drawn = draw(NOISE_MODELS["clean"])
    assert mask.dtype == np.uint8
    assert mask.shape == (800, 800)
    assert set(np.unique(mask)) == {0, 255}
    pixels = VIEW.homography.inverse()(TOWN.intersections)
    inside = pixels[((pixels > 0) & (pixels < 800)).all(axis=1)]
    assert (mask[inside[:, 1].astype(int), inside[:, 0].astype(int)] == 255).all()
    assert drawn["n_intersections"] >= 0.9 * len(inside) - 6  # but those at the border
    assert drawn["missing"] == drawn["false_roads"] == drawn["outdated"] == 0


@pytest.mark.parametrize("name", NOISE_MODELS)
def test_the_same_seed_draws_the_same_mask(name):
    mask, drawn = draw(NOISE_MODELS[name], 7)
    again, drawn_again = draw(NOISE_MODELS[name], 7)
    assert np.array_equal(mask, again)
    assert drawn == drawn_again
    assert not np.array_equal(mask, draw(NOISE_MODELS[name], 8)[0])


@pytest.mark.parametrize("name", ["missing", "false_roads", "outdated"])
def test_shares_come_out_as_asked(name):
    _, drawn = draw(replace(NoiseModel(), **{name: (0.2, 0.2)}))
    wanted = 0.4 if name == "outdated" else 0.2  # outdated goes both ways
    assert drawn[name] == pytest.approx(wanted, abs=0.06)


def test_missing_roads_take_their_intersections_along():
    _, whole = draw(NoiseModel())
    _, torn = draw(NoiseModel(missing=(0.6, 0.6)))
    assert torn["n_intersections"] < 0.5 * whole["n_intersections"]
    assert torn["road_share"] < 0.6 * whole["road_share"]


@pytest.mark.parametrize(
    "noise",
    [
        NoiseModel(blobs=(50, 50)),
        NoiseModel(holes=(50, 50)),
        NoiseModel(occlusions=(20, 20)),
        NoiseModel(warp_px=2.0),
        NoiseModel(raggedness=0.2),
        NoiseModel(distortion=(0.01, 0.01)),
    ],
    ids=str,
)
def test_each_kind_of_wear_changes_a_little(noise):
    clean, _ = draw(NoiseModel())
    worn, _ = draw(noise)
    assert 0.0005 < np.mean(clean != worn) < 0.1


def test_the_lens_moves_the_corner_by_its_share():
    wide = make_view((550.0, 550.0), (800, 800), 1.0)
    mask, _ = draw_mask(TOWN, wide, NoiseModel(distortion=(0.02, 0.02)), (8.0, 11.0), np.random.default_rng(3))
    clean, _ = draw_mask(TOWN, wide, NoiseModel(), (8.0, 11.0), np.random.default_rng(3))
    middle = slice(380, 420)
    assert np.mean(mask[middle, middle] != clean[middle, middle]) < 0.02
    assert np.mean(mask != clean) > 0.05


def test_a_view_without_roads_is_black():
    mask, drawn = draw_mask(TOWN, make_view((1e5, 1e5), (50, 60), 1.0), NoiseModel(), (8, 11), np.random.default_rng(0))
    assert mask.shape == (60, 50)
    assert not mask.any()
    assert drawn["n_intersections"] == 0


@pytest.mark.parametrize(("in_pixels", "low", "high"), [(False, 1.3, 3.0), (True, 0.9, 1.1)])
def test_roads_grow_narrower_farther_off_unless_asked_otherwise(in_pixels, low, high):
    steep = make_view((550.0, 550.0), (600, 600), 1.0, 40.0)
    mask, _ = draw_mask(TOWN, steep, NoiseModel(), (10.0, 10.0), np.random.default_rng(0), in_pixels)
    depth = cv2.distanceTransform(mask, cv2.DIST_L2, 5)
    far, near = (float(np.mean(half[half > 0])) for half in (depth[:250], depth[350:]))
    assert low < near / far < high
