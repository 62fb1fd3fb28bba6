"""Twins on a lattice: a block beside fits nearly as well, and piece by piece it does not."""

import numpy as np
import pytest
import shapely
from worlds.scenes import Sight, camera, look, scene_of

from roadgeo.geometry.homography import Homography
from roadgeo.geometry.projection import LocalPlane
from roadgeo.matching.estimator import MatchOptions
from roadgeo.matching.index import build_index
from roadgeo.matching.local_search import Shift, move_about
from roadgeo.matching.pieces import log10_lead
from roadgeo.matching.twins import Contest
from roadgeo.workflows import build_network

BLOCK = (110, 90)
SIZE = (700, 500)


def lattice(kept: float):
    """Equal blocks over 3.3 by 3.2 km, of which some are not parted by a street."""
    rng, (width, height) = np.random.default_rng(5), BLOCK
    lines = [
        shapely.LineString([a, b])
        for x in range(0, 30 * width, width)
        for y in range(0, 35 * height, height)
        for a, b in (((x, y), (x + width, y)), ((x, y), (x, y + height)))
        if rng.random() < kept
    ]
    network = build_network(lines, LocalPlane("EPSG:32619", (330000.0, 4690000.0)), {"name": "lattice"})
    return network, build_index(network)


def contest(kept: float):
    """Return the true place, the map, and places of a view of it that are compared."""
    network, index = lattice(kept)
    low, high = network.graph.xy.min(axis=0), network.graph.xy.max(axis=0)
    truth = camera(tuple(((low + high) / 2).tolist()), SIZE, 1.0, heading_deg=15.0)
    scene = scene_of(look(network, truth, SIZE, Sight(sigma_m=1.0, missing=0.15, false=0.05), 2), SIZE)
    return truth, index, Contest(scene, 1.0, MatchOptions())


@pytest.fixture(scope="module")
def broken():
    return contest(0.8)


def beside(truth, among):
    shift = Shift(float(BLOCK[0]), 0.0, 0.0, 1.0, 0.0)
    return move_about(Homography(truth)(among.scene.center), shift) @ truth


def test_the_place_leads_a_block_beside_by_the_streets_that_are_missing_there(broken):
    truth, index, among = broken
    here, there = (among.weigh(matrix, index) for matrix in (truth, beside(truth, among)))
    assert log10_lead(here - there) > 2.0
    assert log10_lead(there - here) == 0.0


def test_twins_are_found_all_over_the_lattice_and_laid_on_its_streets(broken):
    truth, index, among = broken
    twins = among.twins_of(beside(truth, among), index)
    away = [np.hypot(*(Homography(one)(among.scene.center) - Homography(truth)(among.scene.center))) for one in twins]
    assert min(away) < 3.0  # from a block beside, the place itself is among its twins
    assert sum(distance > 500.0 for distance in away) > 5
    here = among.weigh(truth, index)
    leads = [log10_lead(here - among.weigh(one, index)) for one, far in zip(twins, away, strict=True) if far > 50.0]
    assert min(leads) > 1.0


def test_where_all_blocks_are_equal_nothing_leads():
    truth, index, among = contest(1.0)
    here = among.weigh(truth, index)
    twins = among.twins_of(truth, index)
    assert min(log10_lead(here - among.weigh(one, index)) for one in twins) < 1.0
