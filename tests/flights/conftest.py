"""A flight over the town."""

import pytest

from examples.simulated_flights import FlightOptions, simulate_flight
from roadgeo.evaluation.landscape import Landscape
from roadgeo.geometry.mask import RoadMask
from roadgeo.reference.reference import Reference

OPTIONS = FlightOptions(size_px=(400, 300), n_frames=(9, 9), gsd_m=(1.0, 1.2), turn_deg=1.0, intersections=(2, 30))


@pytest.fixture(scope="session")
def flown(town):
    """Nine low frames, their masks, and the reference."""
    network, index = town
    flight = simulate_flight(Landscape.from_network(network), OPTIONS, 1)
    return flight, [RoadMask(mask > 127) for mask in flight.masks()], Reference(index, network)
