"""The likelihood of a place by the picture: what it favours, what says nothing, and the correlation of all shifts."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import map_coordinates, uniform_filter
from worlds.scenes import Sight, camera, look, scene_of, soft

from roadgeo.geometry.camera import pose
from roadgeo.geometry.homography import Homography
from roadgeo.matching import picture as pictures
from roadgeo.matching.evidence import SHARES
from roadgeo.matching.picture import Picture
from roadgeo.matching.shifts import Shift, move_about, shifted

SIZE = (900, 700)
TRUTH = camera((2000.0, 1900.0), SIZE, 1.0, heading_deg=15.0)


@pytest.fixture(scope="module")
def scene(town):
    return scene_of(look(town[0], TRUTH, SIZE, Sight(1.0, missing=0.1, false=0.05)), SIZE)


def naive_weigh(picture, matrix, usual_m=300.0):
    """Add up the formula of the module cell by cell, as log10; pixels of the picture are 1 m wide."""
    scene, cell_m = picture.scene, 4.0
    p, scale = scene.probability, scene.field_scale
    usual = p.mean()
    side = 2 * round(usual_m / scale / 2) + 1
    sums, counts = (uniform_filter(cells, side, mode="constant") for cells in (p.astype(float), np.ones(p.shape)))
    nearby = sums / counts
    odds = p / (1.0 - p) * (1.0 - nearby) / nearby * usual / (1.0 - usual)
    p = odds / (1.0 + odds)
    corners = Homography(matrix).everywhere(scene.corners)
    low = corners.min(axis=0)
    ground = pictures.draw_roads(picture.index, low, corners.max(axis=0), cell_m)
    rows, columns = ground.roads.shape
    back = Homography(np.linalg.inv(matrix))
    middles = low + (np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1) + 0.5) * cell_m
    column, row = np.moveaxis(back.everywhere(middles.reshape(-1, 2)) * (1, -1) / scale - 0.5, -1, 0)
    sampled = map_coordinates(p, [row, column], order=1, mode="nearest")
    inside = (column >= 0) & (row >= 0) & (column <= p.shape[1] - 1) & (row <= p.shape[0] - 1)
    road, other = sampled / usual, (1.0 - sampled) / (1.0 - usual)
    share = ground.roads.ravel()
    unit = cell_m / 2.0 / picture.statement_px  # roads are two cells wide, pixels are 1 m wide
    nats = []
    for m in SHARES:
        for f in SHARES:
            on = np.log((1.0 - m) * road + m * other)
            off = np.log((1.0 - f * usual) * other + f * usual * road)
            nats.append(unit * (share * on + (1.0 - share) * off)[inside].sum())
    return np.log10(np.mean(np.exp(nats)))


def test_it_adds_up_what_the_formula_says_of_each_cell(town, scene):
    picture = Picture(soft(scene), town[1], 1.0)
    for east in (0.0, 40.0, 300.0):
        matrix = shifted(TRUTH, east, 0.0)
        assert picture.weigh(matrix) == pytest.approx(naive_weigh(picture, matrix), abs=0.4)


def test_what_is_usual_is_what_is_usual_within_some_300_m(town, scene):
    """A town beside fields: with one mean for all of it, any dense roads under the town would gain."""
    seen = soft(scene, 0.4)
    cells = np.arange(seen.probability.shape[1]) * seen.field_scale
    clutter = 0.25 * (1.0 + np.sin(cells / 350.0 * 2.0 * np.pi))
    p = (1.0 - (1.0 - seen.probability) * (1.0 - clutter)).astype(np.float32)
    picture = Picture(replace(seen, probability=p), town[1], 1.0)
    worth, by_side = picture.weigh(TRUTH), {m: naive_weigh(picture, TRUTH, m) for m in (150.0, 300.0, 600.0)}
    assert worth == pytest.approx(by_side[300.0], abs=0.4)
    assert worth != pytest.approx(by_side[150.0], abs=0.4)
    assert worth != pytest.approx(by_side[600.0], abs=0.4)


@pytest.mark.parametrize("strength", [1.0, 0.4], ids=["soft", "weak"])
def test_it_favours_the_place_its_scale_and_its_heading(town, scene, strength):
    picture = Picture(soft(scene, strength), town[1], 1.0)
    there = picture.weigh(TRUTH)
    assert there > 3.0
    middle = Homography(TRUTH).everywhere(scene.center)
    for factor in (0.6, 0.8, 1.25, 1.6):
        scaled = np.array([[factor, 0.0, 0.0], [0.0, factor, 0.0], [0.0, 0.0, 1.0]])
        about = shifted(scaled @ shifted(np.eye(3), *-middle), *middle) @ TRUTH
        assert picture.weigh(about) < 0.3 * there
    for turn_deg in (10.0, 90.0, 180.0):
        assert picture.weigh(move_about(middle, Shift(0.0, 0.0, turn_deg, 1.0, 0.0)) @ TRUTH) < 0.3 * there


def test_places_that_have_nothing_to_do_with_it_are_seldom_likely(town, scene):
    """It is a likelihood ratio against the picture's own distribution: a tenfold one is met one time in ten at most."""
    picture, rng = Picture(soft(scene), town[1], 1.0), np.random.default_rng(3)
    elsewhere = [
        camera(tuple(rng.uniform(700, 3300, 2)), SIZE, rng.uniform(0.6, 1.6), heading_deg=rng.uniform(100, 300))
        for _ in range(60)
    ]
    worths = np.array([picture.weigh(matrix) for matrix in elsewhere])
    assert (worths > 1.0).mean() <= 0.1


def test_ground_that_was_not_observed_and_a_map_without_roads_say_nothing(town, scene):
    seen = soft(scene)
    nothing = replace(seen, observed=np.zeros_like(seen.observed))
    assert Picture(nothing, town[1], 1.0).weigh(TRUTH) == pytest.approx(0.0, abs=1e-6)
    away = Picture(seen, town[1], 1.0).weigh(shifted(TRUTH, 1e5, 0.0))
    assert away <= 0.0
    half = seen.observed.copy()
    half[:, : half.shape[1] // 2] = False
    blank = np.where(half, seen.probability, np.float32(0.9))
    one, other = (Picture(replace(seen, observed=half, probability=p), town[1], 1.0) for p in (seen.probability, blank))
    assert one.weigh(TRUTH) == pytest.approx(other.weigh(TRUTH), abs=0.05)


def test_correlation_finds_the_place_among_all_shifts_and_turns(town, scene):
    picture = Picture(soft(scene), town[1], 1.0)
    middle = Homography(TRUTH).everywhere(scene.center)
    start = move_about(middle, Shift(0.0, 0.0, 90.0, 1.0, 0.0)) @ shifted(TRUTH, 250.0, -120.0)
    peaks = picture.correlate(start, 600.0, (0.0, 90.0, 180.0, 270.0), 5, 30.0)
    assert [peak.log10_likelihood for peak in peaks] == sorted((peak.log10_likelihood for peak in peaks), reverse=True)
    best = picture.settle(peaks[0])
    turned = pose(peaks[0].matrix, SIZE).rotation_deg - pose(start, SIZE).rotation_deg
    assert turned % 360.0 == pytest.approx(270.0)
    assert np.hypot(*(Homography(best.matrix).everywhere(scene.center) - middle)) < 6.0
    assert best.log10_likelihood == pytest.approx(picture.weigh(best.matrix), rel=0.01)
    assert best.log10_likelihood > 2.0 * picture.settle(peaks[1]).log10_likelihood
    assert best.log10_likelihood >= picture.weigh(peaks[0].matrix)


@pytest.mark.parametrize("reach_m", [8000.0, 16000.0])
def test_however_far_it_reaches_the_ground_has_about_a_thousand_cells_a_side(town, scene, monkeypatch, reach_m):
    picture, drawn, draw = Picture(soft(scene), town[1], 1.0), [], pictures.draw_roads
    monkeypatch.setattr(pictures, "draw_roads", lambda *of: drawn.append(draw(*of)) or drawn[-1])
    picture.correlate(TRUTH, reach_m, (0.0,), 1, 30.0)
    assert 800 < max(drawn[-1].roads.shape) < 1500


def test_a_frame_too_large_for_the_ground_weighs_nothing(town, scene):
    picture = Picture(soft(scene), town[1], 1.0)
    with np.errstate(all="ignore"):
        assert picture.weigh(np.diag([400.0, 1.0, 1.0]) @ TRUTH) == 0.0


@pytest.mark.parametrize(
    ("worth", "rival", "lead"), [(8.0, 3.0, 5.0), (100.0, 80.0, 2.0), (5.0, -3.0, 5.0), (-1.0, -2.0, -1.0)]
)
def test_of_a_large_frame_only_the_part_that_the_rival_lacks_counts(worth, rival, lead):
    assert Picture.lead(worth, rival) == pytest.approx(lead)
