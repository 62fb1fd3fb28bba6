"""Simulated flights."""

from dataclasses import replace

import numpy as np
import pytest
from worlds.towns import lattice_town

from examples.simulated_flights import FlightOptions, simulate_flight
from roadgeo.errors import RoadSourceError
from roadgeo.geometry.homography import Homography

TOWN = lattice_town(20)
OPTIONS = FlightOptions(size_px=(320, 240), n_frames=(4, 6), gsd_m=(0.8, 1.0), turn_deg=1.0, intersections=(1, 12))


def test_a_flight_is_always_the_same_and_others_are_others():
    ours, again, other = (simulate_flight(TOWN, OPTIONS, k) for k in (0, 0, 1))
    assert np.array_equal(next(ours.masks()), next(again.masks()))
    assert np.array_equal(ours.motion, again.motion)
    assert not np.allclose(ours.views[0].homography.matrix, other.views[0].homography.matrix)


def test_frames_overlap_and_the_motion_is_that_between_them():
    flight = simulate_flight(TOWN, replace(OPTIONS, motion_px=0.0), 0)
    middle = np.array(OPTIONS.size_px) / 2
    for k in range(1, len(flight.views)):
        seen = Homography(flight.motion[k])(middle)
        exact = flight.views[k - 1].homography.inverse()(flight.views[k].homography(middle))
        assert np.allclose(seen, exact, atol=0.05)
        assert 0.3 * 240 < middle[1] - seen[1] < 0.5 * 240


def test_tilt_stays_within_its_bounds():
    flight = simulate_flight(TOWN, replace(OPTIONS, tilt_deg=(18.0, 20.0)), 2)
    assert max(view.tilt_deg for view in flight.views) <= 20.0


def test_no_room_is_told():
    with pytest.raises(RoadSourceError, match="no flight"):
        simulate_flight(lattice_town(3), replace(OPTIONS, n_frames=(200, 200)), 0)
