import numpy as np
import pytest

from roadgeo.roads.kinds import ROAD_KINDS, drives, highways, in_tunnel, main_ranks


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
        ("['living_street', 'residential']", "drivable"),
        (["footway", "residential"], "drivable"),
        (np.array(["tertiary", "service"], object), "main"),
        ("service;residential", "drivable"),
        ("Residential", "drivable"),
        ("service", "vehicles"),
        ("track_grade2", "vehicles"),
        ("footway", "all"),
        ("something_new", "all"),
        (None, "drivable"),
        (float("nan"), "drivable"),
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


@pytest.mark.parametrize(
    ("value", "tunnel"),
    [
        ("yes", True),
        ("no", False),
        (None, False),
        ("building_passage", False),
        ("T", True),
        ("F", False),
        (True, True),
        (1, True),
        ("['yes', 'no']", False),
        (["yes", "yes"], True),
        ("avalanche_protector", True),
        ("", False),
    ],
)
def test_tunnels(value, tunnel):
    assert in_tunnel(column(value))[0] == tunnel


def test_main_roads_have_ranks():
    values = column("motorway_link", "trunk", "residential", None, "tertiary;primary", ["secondary"], "", "motorway")
    assert main_ranks(values).tolist() == [0, 1, -1, -1, 2, 3, -1, 0]


@pytest.mark.parametrize("value", [np.True_, np.int64(3), np.float64("nan"), np.str_("primary"), b"primary", 1j])
def test_values_of_any_type_are_no_fault(value):
    """Tables of strangers hold what they like: a column of yes and no was one that no test had."""
    kinds = np.array([value, None], object)
    assert drives(kinds, "all").shape == in_tunnel(kinds).shape == (2,)
