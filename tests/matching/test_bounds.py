"""Time and memory hold on any mask: grids, noise, mazes and blobs, small and large."""

import re
import subprocess
import sys
import time
from dataclasses import replace

import cv2
import numpy as np
import pytest
import shapely
from worlds.scenes import PLANE, random_lines, random_network, scene_of

from roadgeo.errors import MaskError
from roadgeo.geometry.mask import RoadMask
from roadgeo.kernels.compilation import Kernel
from roadgeo.kernels.warmup import warm_up
from roadgeo.matching import scene
from roadgeo.matching.index import build_index
from roadgeo.matching.search import SearchOptions
from roadgeo.reference.reference import Reference
from roadgeo.roads.network import build_network
from roadgeo.sources.masks import read_mask
from roadgeo.workflows import LocateOptions, locate


def grid_mask(side, step, width, jitter=0.0):
    rng = np.random.default_rng(1)
    at = np.stack(np.meshgrid(*[np.arange(step // 2, side, step)] * 2), -1)
    at = np.rint(at + rng.uniform(-jitter, jitter, at.shape)).astype(np.int32)
    mask = np.zeros((side, side), np.uint8)
    cv2.polylines(mask, [np.ascontiguousarray(line) for line in (*at, *at.transpose(1, 0, 2))], False, 1, width)
    return mask


def maze_mask(side, cell, width):
    mask = np.zeros((side, side), np.uint8)
    for i, row in enumerate(np.random.default_rng(2).random((side // cell, side // cell)) < 0.5):
        for j, rises in enumerate(row):
            (x, y), up = (j * cell, i * cell), cell * int(rises)
            cv2.line(mask, (x, y + up), (x + cell, y + cell - up), 1, width)
    return mask


def noise_mask(side, share):
    return (np.random.default_rng(3).random((side, side), np.float32) < share).view(np.uint8)


MASKS = {
    "4,900 crossings": lambda: grid_mask(3500, 50, 8),
    "10,000 crossings": lambda: grid_mask(3500, 35, 6, 8.0),
    "small grid": lambda: grid_mask(1500, 30, 6),
    "maze": lambda: maze_mask(2000, 30, 6),
    "noise": lambda: noise_mask(1000, 0.3),
    "specks": lambda: noise_mask(1500, 0.03),
    "checks": lambda: (np.indices((1500, 1500)).sum(axis=0) // 4 % 2).astype(np.uint8),
    "comb": lambda: np.tile(np.repeat(np.uint8([1, 0]), [2, 4]), (1500, 250)),
}


@pytest.fixture(scope="module")
def lattice():
    """Blocks like one another as far as the map goes: every proposal grows, nothing is given up early."""
    at = np.arange(60) * 90.0
    ways = [shapely.LineString([(x, 0), (x, at[-1])]) for x in at]
    ways += [shapely.LineString([(0, y), (at[-1], y)]) for y in at]
    return warmed(build_network(ways, PLANE, {"name": "lattice"}))


@pytest.fixture(scope="module")
def town():
    return warmed(random_network(4))


def warmed(network):
    """A map; kernels are compiled and its tables are made before a clock runs."""
    reference = Reference(build_index(network), network)
    warm_up()
    locate(grid_mask(200, 40, 5), reference, LocateOptions(search=SearchOptions(time_limit_s=0.1)))
    return reference


@pytest.mark.parametrize("name", MASKS)
@pytest.mark.parametrize("place", ["lattice", "town"])
def test_the_time_limit_holds(request, place, name):
    reference = request.getfixturevalue(place)
    options = LocateOptions(search=SearchOptions(time_limit_s=0.2))
    mask = RoadMask(MASKS[name]() > 0)
    started = time.process_time()  # what others do on this machine does not count
    location = locate(mask, reference, options)
    assert time.process_time() - started < 3.6  # a round may be under way, and the machine busy
    assert location.status != "located"
    assert location.reason


def test_many_intersections_leave_no_kernel_to_numba(lattice, monkeypatch):
    """An array that is not contiguous is: it is compiled for seconds, in the middle of a search."""
    monkeypatch.setattr(Kernel, "by_numba", property(lambda kernel: pytest.fail(kernel.name)))
    mask = RoadMask(MASKS["4,900 crossings"]() > 0)
    assert not locate(mask, lattice, LocateOptions(search=SearchOptions(time_limit_s=0.8))).located


def test_the_limit_holds_for_all_references_together(lattice, town):
    mask = RoadMask(grid_mask(1500, 45, 6, 8.0) > 0)
    options = LocateOptions(search=SearchOptions(time_limit_s=1.0))
    started = time.process_time()
    location = locate(mask, [lattice, town] * 4, options)
    assert time.process_time() - started < 5.0
    assert not location.located
    assert sum(vars(location.seconds).values()) < 2.5


def test_the_reason_says_what_took_the_time(lattice):
    mask = RoadMask(grid_mask(1500, 30, 6) > 0)
    options = LocateOptions(search=SearchOptions(time_limit_s=0.05))
    location = locate(mask, lattice, options)
    assert re.match(r"time limit of 0\.05 s reached, of which tracing the mask took \d+\.\d s, ", location.reason)
    assert " intersections had been looked for; a pixel size known to 30 % (--gsd) leaves 11%" in location.reason


def test_of_many_intersections_those_around_the_middle_are_kept(monkeypatch):
    graph = build_network(random_lines(5, 2000.0), PLANE, {}).graph
    shifted = replace(graph, xy=graph.xy - (0.0, 2000.0), coords=graph.coords - (0.0, 2000.0))
    whole = scene_of(shifted, (2000, 2000))
    monkeypatch.setattr(scene, "_MAX_INTERSECTIONS", 60)
    part = scene_of(shifted, (2000, 2000))
    away = np.hypot(*(whole.intersections.xy - (1000.0, -1000.0)).T)
    nearest = np.argsort(away, kind="stable")[:60]
    assert len(whole.intersections) > 100
    assert np.array_equal(part.intersections.xy, whole.intersections.xy[np.sort(nearest)])
    assert len(part.branches) == len(part.neighbours) == len(part.intersections.rays) == 60
    assert part.n_edges == whole.n_edges


@pytest.mark.parametrize("side", [400, 4000])
def test_a_blob_is_no_road(side, town):
    mask = np.zeros((side, side), np.uint8)
    cv2.circle(mask, (side // 2, side // 2), side * 2 // 5, 255, -1)
    started = time.process_time()
    with pytest.raises(MaskError):
        locate(read_mask(mask), town)
    assert time.process_time() - started < 5.0


MEASURE = """
import resource, sys
import numpy as np
from roadgeo.errors import MaskError
from roadgeo.geometry.mask import RoadMask
from roadgeo.matching.scene import trace_query
roads = np.random.default_rng(0).random((4500, 4500), np.float32) < 0.3
try:
    trace_query(RoadMask(roads))
except MaskError as error:
    print(error)
if sys.platform == "linux":  # what getrusage tells there began with that of the process which started this one
    told = open("/proc/self/status").read().split("VmHWM:")[1].split()[0]
    print(int(told) / (1 << 20))
else:
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1 << 30))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="no such measure there")
def test_noise_is_refused_by_name_before_it_takes_all_memory():
    ran = subprocess.run([sys.executable, "-c", MEASURE], capture_output=True, text=True, check=True)
    refusal, gigabytes = ran.stdout.splitlines()
    assert re.fullmatch(r"mask: its roads have [\d,]+ corners, expected at most 3,000,000: .*", refusal)
    assert float(gigabytes) < 1.5
