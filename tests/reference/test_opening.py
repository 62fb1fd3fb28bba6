"""Longitude and latitude given the other way round."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from roadgeo.geometry.projection import choose_plane, from_lonlat
from roadgeo.matching.parts import Whole
from roadgeo.reference.opening import swapped_near

#: A map that holds the place (0.02, 0.05) degrees, and ends 500 m west of (0.05, 0.02).
WEST, EAST = (-0.1, -0.1), (0.0455, 0.1)


@pytest.mark.parametrize(
    ("near", "meant"),
    [
        ((0.02, 0.05, 40.0), None),
        ((0.05, 0.02, 40.0), None),  # a frame there shows the edge of the map
        ((0.09, 0.02, 40.0), (0.02, 0.09, 40.0)),
        ((0.09, 0.08, 40.0), None),
    ],
)
def test_a_place_is_exchanged_only_where_no_map_is_near(
    near: tuple[float, float, float], meant: tuple[float, float, float] | None
) -> None:
    plane = choose_plane(np.array([WEST, EAST]))
    index: Any = SimpleNamespace(plane=plane, bounds=from_lonlat(plane, np.array([WEST, EAST])))
    one: Any = SimpleNamespace(parts=[Whole(index)])
    assert swapped_near(near, [one]) == meant
