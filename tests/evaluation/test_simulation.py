"""Simulated query sets."""

from dataclasses import replace

import numpy as np
import pytest
from worlds.towns import lattice_town

from roadgeo.errors import RoadSourceError
from roadgeo.evaluation.noise import NOISE_MODELS
from roadgeo.evaluation.simulation import SimulationOptions, ViewOptions, simulate, simulate_query
from roadgeo.geometry.homography import Homography

TOWN = lattice_town()
VIEW = ViewOptions(
    size_px=(400, 300), gsd_m=(0.8, 1.2), tilt_deg=(0.0, 30.0), heading_deg=(0.0, 360.0), intersections=(5, 40)
)
OPTIONS = SimulationOptions(VIEW, NOISE_MODELS["segmented"], "segmented", seed=3)


def test_the_kth_query_is_the_same_however_it_is_drawn():
    queries = list(simulate(TOWN, OPTIONS, 3))
    alone = simulate_query(TOWN, OPTIONS, 2)
    assert np.array_equal(queries[2].mask, alone.mask)
    assert queries[2].truth.properties == alone.truth.properties
    assert not np.array_equal(queries[0].mask, queries[1].mask)


@pytest.mark.parametrize("change", [{"seed": 4}, {"kind": "other"}])
def test_seeds_and_kinds_draw_other_places(change):
    ours, other = simulate_query(TOWN, OPTIONS, 0), simulate_query(TOWN, replace(OPTIONS, **change), 0)
    assert not np.allclose(ours.truth.homography, other.truth.homography)


def test_queries_keep_to_their_options():
    for query in simulate(TOWN, OPTIONS, 8):
        properties = query.truth.properties
        assert query.mask.shape == (300, 400)
        assert 0.8 <= properties["gsd_m"] <= 1.2
        assert 0 <= properties["tilt_deg"] <= 30
        assert 5 <= properties["n_intersections"] <= 40
        low, high = TOWN.bounds + TOWN.plane.origin
        assert ((query.truth.footprint >= low) & (query.truth.footprint <= high)).all()


def test_the_truth_takes_roads_of_the_mask_to_the_map():
    query = simulate_query(TOWN, replace(OPTIONS, noise=NOISE_MODELS["clean"]), 0)
    to_pixel = Homography(query.truth.homography).inverse()
    pixels = to_pixel(TOWN.plane.to_crs(TOWN.intersections))
    inside = pixels[((pixels > 0) & (pixels < (400, 300))).all(axis=1)]
    assert len(inside) >= 5
    assert (query.mask[inside[:, 1].astype(int), inside[:, 0].astype(int)] == 255).all()


def test_a_window_fixes_the_side_on_the_ground():
    view = replace(VIEW, window_m=300.0, tilt_deg=(0.0, 0.0))
    for query in simulate(TOWN, replace(OPTIONS, view=view), 3):
        side = np.hypot(*(query.truth.footprint[1] - query.truth.footprint[0]))
        assert side == pytest.approx(300.0, abs=1.0)


def test_queries_can_be_placed():
    center = (330.0, 440.0)
    query = simulate_query(TOWN, OPTIONS, 5, center)
    assert query.truth.center == pytest.approx(TOWN.plane.to_crs(np.array(center)))
    assert np.array_equal(query.mask, simulate_query(TOWN, OPTIONS, 5, center).mask)
    off_the_map = simulate_query(TOWN, replace(OPTIONS, noise=NOISE_MODELS["clean"]), 5, (1e5, 1e5))
    assert not off_the_map.mask.any()


def test_mirrored_masks_have_no_place():
    query = simulate_query(TOWN, OPTIONS, 0)
    mirrored = simulate_query(TOWN, replace(OPTIONS, mirrored=True), 0)
    assert np.array_equal(mirrored.mask, query.mask[:, ::-1])
    assert query.truth.on_map
    assert not mirrored.truth.on_map


@pytest.mark.parametrize("change", [{"intersections": (500, 600)}, {"gsd_m": (50.0, 60.0)}])
def test_what_the_map_cannot_show_is_an_error(change, monkeypatch):
    monkeypatch.setattr("roadgeo.evaluation.simulation.MAX_TRIES", 20)
    with pytest.raises(RoadSourceError, match="ask for fewer"):
        simulate_query(TOWN, replace(OPTIONS, view=replace(VIEW, **change)), 0)
