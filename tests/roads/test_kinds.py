import numpy as np
import pytest

from roadgeo.roads.kinds import ROAD_KINDS, drives, highways, main_ranks


def column(*values):
    array = np.empty(len(values), object)
    array[:] = values
    return array


@pytest.mark.parametrize(
    ("value", "least"),
    [
        ("motorway", "main"),
        ("tertiary_link", "main"),
        ("residential", "drivable"),
        ("living_street", "drivable"),
        ("service;residential", "drivable"),
        ("footway;tertiary", "main"),
        ("service", "vehicles"),
        ("track_grade2", "vehicles"),
        ("footway", "all"),
        ("something_new", "all"),
        ("", "drivable"),
        ("construction", None),
        ("platform", None),
    ],
)
def test_kinds_nest(value, least):
    passed = [kind for kind in ROAD_KINDS if drives(column(value), kind)[0]]
    assert passed == ([] if least is None else list(ROAD_KINDS[ROAD_KINDS.index(least) :]))


def test_kinds_list_their_values():
    assert "motorway_link" in highways("main")
    assert set(highways("main")) < set(highways("drivable")) < set(highways("vehicles"))
    assert highways("all") is None


def test_main_roads_have_ranks():
    values = column("motorway_link", "trunk", "residential", "tertiary;primary", "secondary", "", "motorway")
    assert main_ranks(values).tolist() == [0, 1, -1, 2, 3, -1, 0]
