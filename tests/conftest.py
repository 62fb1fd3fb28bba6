"""Fixtures shared by all tests."""

import gc
import json
import os
import signal
import sys
from collections import Counter
from collections.abc import Generator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import settings

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

if TYPE_CHECKING:
    from roadgeo.matching.index import ReferenceIndex
    from roadgeo.roads.network import RoadNetwork

# Whoever starts the tests in the background hands down an ignored SIGINT, and with it children that Ctrl-C cannot stop.
signal.signal(signal.SIGINT, signal.default_int_handler)
# Where a machine keeps no compiled modules, each program that a test starts would compile them all anew.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
# The same examples in every run: what a random one finds once is no reason for another change to fail.
settings.register_profile("steady", derandomize=True, deadline=None, max_examples=30)
settings.load_profile("steady")


#: Seconds of processors of each slow test, of its programs, too; `--measure` renews it.
SECONDS = Path(__file__).with_name("seconds.json")
SLOW_S = 2.0

#: Left to the night, with all that is slow or needs one of the fixtures below: how the names of these tests begin.
NIGHTLY = (
    "tests/cli/test_fence.py",
    "tests/cli/test_traces.py",
    "tests/docs/test_docs.py::test_a_page_does_what_it_says[docs/",
    "tests/docs/test_docs.py::test_the_commands_for_qgis",
    "tests/examples/",
    "tests/outputs/test_page_widths.py",
    "tests/qgis/",
    "tests/running/test_cluster.py",
    "tests/running/test_divided.py",
    "tests/serving/test_workers.py::test_neither_processes",
    "tests/test_endurance.py",
)
#: Never left, however slow: what a user meets first, kernels and their twins, and what killed writers leave behind.
DAILY = (
    "tests/accept/",
    "tests/cli/",
    "tests/docs/test_docs.py::test_a_page_does_what_it_says[README.md]",
    "tests/docs/test_docs.py::test_a_page_does_what_it_says[docs/tutorial.md]",
    "tests/kernels/",
    "tests/reference/test_files.py",
    "tests/test_corpus.py",
)
#: A test that combines lists of parameters into more cases leaves two thirds to the night; each parameter stays.
MOST_CASES = 24
#: A browser, QGIS and the development data.
NIGHTLY_FIXTURES = {"browser", "chromium", "data_dir", "qgis"}


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--measure", action="store_true", help=f"write what slow tests take to {SECONDS.name}")


def names_files(config: pytest.Config) -> bool:
    return any(".py" in name for name in config.args)


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int | None:
    """Files that are named are run by this process alone."""
    return 0 if names_files(config) else None


def pytest_configure(config: pytest.Config) -> None:
    if names_files(config) and leaves_out(config):
        config.option.markexpr = ""  # and whole
    if config.getoption("measure") and not hasattr(config, "workerinput"):
        config.pluginmanager.register(Measure())


def leaves_out(config: pytest.Config) -> bool:
    """Whether what is nightly is left out."""
    return config.option.markexpr == "not nightly"


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Files whose tests are all nightly are not even read."""
    path = f"{collection_path.relative_to(config.rootpath).as_posix()}{'/' if collection_path.is_dir() else ''}"
    return True if path in NIGHTLY and leaves_out(config) else None


def pytest_report_header() -> str:
    left = f"two thirds of more than {MOST_CASES} cases, slow ones but {', '.join(DAILY)}"
    return f"nightly (-m ''): {left}; {', '.join((*NIGHTLY, *sorted(NIGHTLY_FIXTURES)))}"


def is_of_the_third(item: pytest.Item, number: int) -> bool:
    """Whether a case is of the third that stays, in which each parameter of each list occurs, by its number."""
    lists = [len(mark.args[1]) for mark in item.iter_markers("parametrize")]  # the last one is gone through first
    places = []
    for length in reversed(lists):
        number, place = divmod(number, length)
        places.append(place)
    return len(lists) < 2 or sum(places) % 3 == 0


def is_nightly(item: pytest.Item, is_slow: bool, is_left: bool) -> bool:
    """Whether a test is left out: of two beginnings that fit its name the longer one decides."""
    daily, nightly = (max(len(start) * item.nodeid.startswith(start) for start in names) for names in (DAILY, NIGHTLY))
    needs = NIGHTLY_FIXTURES.intersection(getattr(item, "fixturenames", ()))
    return bool(needs) or nightly > daily or ((is_slow or is_left) and not daily)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark what is slow, as measured, and what is nightly.

    Where several processes share the tests, files that take longest come first: none is left to one process in the end.
    """
    seconds = json.loads(SECONDS.read_text("utf-8"))
    cases: dict[str, list[pytest.Item]] = {}
    for item in items:
        cases.setdefault(item.nodeid.partition("[")[0], []).append(item)
    for test in cases.values():
        for number, item in enumerate(test):
            if is_slow := item.nodeid in seconds:
                item.add_marker(pytest.mark.slow)
            if is_nightly(item, is_slow, len(test) > MOST_CASES and not is_of_the_third(item, number)):
                item.add_marker(pytest.mark.nightly)
    if hasattr(config, "workerinput"):
        files = Counter()
        for name, took in seconds.items():
            files[name.partition("::")[0]] += took
        items.sort(key=lambda item: -files[item.nodeid.partition("::")[0]])


def of_processors() -> float:
    """Seconds that this process and those that it started and outlived have taken so far."""
    return sum(os.times()[:4])


def pytest_runtest_logstart() -> None:
    """Start the clock of a test."""
    _started.append(of_processors())


_started: list[float] = []


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Keep the garbage collector from going through all modules and tests again and again: they stay to the end."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Generator[None, object, object]:
    """Add the seconds of a test to the last of its reports."""
    if call.when == "teardown":
        item.user_properties.append(("seconds", of_processors() - _started.pop()))
    return (yield)


class Measure:
    """Keeps what the tests that ran took."""

    def __init__(self) -> None:
        self.kept: dict[str, float] = json.loads(SECONDS.read_text("utf-8"))

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when == "teardown":
            self.kept[report.nodeid] = round(dict(report.user_properties)["seconds"], 1)

    def pytest_sessionfinish(self) -> None:
        slow = {name: took for name, took in sorted(self.kept.items()) if took > SLOW_S}
        SECONDS.write_text(json.dumps(slow, indent=0, ensure_ascii=False) + "\n", "utf-8")


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The development data; tests that need them skip where they are absent."""
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

    base = tmp_path_factory.getbasetemp()
    is_shared = fcntl is not None and "PYTEST_XDIST_WORKER" in os.environ  # by all processes; the first builds it
    path = (base.parent if is_shared else base) / "reference" / "porto.gpkg"
    path.parent.mkdir(exist_ok=True)
    with path.with_suffix(".lock").open("w") as lock:
        if is_shared:
            fcntl.flock(lock, fcntl.LOCK_EX)
        if not path.with_suffix(".index").exists():
            build_reference(read_roads(ROADS, attribution=ATTRIBUTION), "porto", path=path)
    return path
