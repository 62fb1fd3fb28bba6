"""A town that is served, and what a camera above it sees."""

from pathlib import Path

import cv2
import pytest

from roadgeo.evaluation.landscape import Landscape
from roadgeo.evaluation.noise import NOISE_MODELS
from roadgeo.evaluation.simulation import SimulationOptions, ViewOptions, simulate_query
from roadgeo.evaluation.truth import Truth
from roadgeo.reference.reference import Reference

VIEW = ViewOptions(size_px=(900, 900), gsd_m=(1.0, 1.0), heading_deg=(0.0, 360.0), intersections=(25, 1000))


@pytest.fixture(scope="session")
def place(town, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Truth]:
    """A reference on disk, and a mask of it."""
    network, index = town
    folder = tmp_path_factory.mktemp("served")
    Reference(index, network).save(folder / "town.gpkg")
    query = simulate_query(Landscape.from_network(network), SimulationOptions(VIEW, NOISE_MODELS["clean"]), 0)
    cv2.imwrite(str(folder / "mask.png"), query.mask)
    return folder, query.truth
