"""Fixtures shared by all tests."""

import os
import signal
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import settings

if TYPE_CHECKING:
    from roadgeo.matching.index import ReferenceIndex
    from roadgeo.roads.network import RoadNetwork

# Whoever starts the tests in the background hands down an ignored SIGINT, and with it children that Ctrl-C cannot stop.
signal.signal(signal.SIGINT, signal.default_int_handler)
# The same examples in every run: what a random one finds once is no reason for another change to fail.
settings.register_profile("steady", derandomize=True, deadline=None)
settings.load_profile("steady")


#: Folders whose tests start programs, draw masks or run whole commands: they take most of the time.
SLOW = ("accept", "cli", "docs", "evaluation", "examples", "flights", "outputs", "qgis", "running", "serving")
SLOW += ("workflows",)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark what is slow by its folder, and what reads real data, so that no new test there is forgotten.

    Where several processes share the tests, slow ones come first: none is to wait for another's long file in the end.
    """
    here = Path(__file__).parent
    for item in items:
        if item.path.relative_to(here).parts[0] in SLOW or item.get_closest_marker("realdata"):
            item.add_marker(pytest.mark.slow)
    if hasattr(config, "workerinput"):
        items.sort(key=lambda item: item.get_closest_marker("slow") is None)


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The development data, for tests marked `realdata`; they skip where it is absent."""
    folder = os.environ.get("ROADGEO_DATA")
    if not folder or not Path(folder).is_dir():
        pytest.skip("ROADGEO_DATA is not set: no development data here")
    return Path(folder)


@pytest.fixture(scope="session")
def town() -> "tuple[RoadNetwork, ReferenceIndex]":
    """A made-up town of 4 x 4 km, 730 intersections, and its index; see `worlds.scenes`."""
    from worlds.scenes import random_network

    from roadgeo.matching.index import build_index

    network = random_network(1, 4000.0)
    return network, build_index(network)


@pytest.fixture(scope="session")
def porto(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The reference of the demonstration's roads, with its attribution; not to be changed."""
    from roadgeo.evaluation.demo import ATTRIBUTION, ROADS
    from roadgeo.sources.roads import read_roads
    from roadgeo.workflows import build_reference

    path = tmp_path_factory.mktemp("reference") / "porto.gpkg"
    build_reference(read_roads(ROADS, attribution=ATTRIBUTION), "porto", path=path)
    return path
