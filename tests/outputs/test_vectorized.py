"""What was seen in a mask can be looked at."""

import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest

from roadgeo.geometry.mask import RoadMask
from roadgeo.outputs.drawing.layers import rgb
from roadgeo.outputs.vectorized import draw_vectorized, write_vectorized
from roadgeo.roads.graph import RoadGraph
from roadgeo.roads.intersections import find_intersections
from roadgeo.roads.vectorization import vectorize
from roadgeo.storage.geopackage import layer_names, read_layer


@pytest.fixture
def mask() -> RoadMask:
    roads = np.zeros((80, 120), bool)
    roads[38:43] = True
    roads[:, 58:63] = True
    observed = np.ones_like(roads)
    observed[:, 100:] = False
    return RoadMask(roads & observed, observed, "crossing")


def test_both_files_show_the_crossing(tmp_path: Path, mask: RoadMask) -> None:
    graph = vectorize(mask).graph
    found = find_intersections(graph)
    paths = write_vectorized(tmp_path / "new" / "folder", "a.b", mask, graph, found)
    assert [path.name for path in paths] == ["a.b_vectorized.gpkg", "a.b_vectorized.png"]
    assert {"intersections", "roads"} <= set(layer_names(paths[0]))
    points, columns = read_layer(paths[0], "intersections")
    np.testing.assert_allclose(points[0], (60.5, -40.5), atol=0.2)
    assert columns["branches"] == [4]
    assert columns["tangents"] == [2]
    lines, columns = read_layer(paths[0], "roads")
    assert len(lines) == graph.n_edges == 4
    np.testing.assert_allclose(columns["length_px"], graph.edge_lengths())
    picture = cv2.imread(str(paths[1]))
    assert picture.shape == (80, 120, 3)
    assert (picture[40, 60, ::-1] == rgb("match")).all()  # the intersection
    assert (picture[40, 110] == picture[5, 110]).all()  # not observed


def test_a_mask_without_intersections(tmp_path: Path, mask: RoadMask) -> None:
    empty = RoadGraph.from_polylines(np.empty((0, 2)), np.empty((0, 2), np.int32), [])
    package, picture = write_vectorized(tmp_path, "none", mask, empty, find_intersections(empty))
    assert read_layer(package, "roads")[0] == []
    number = picture.stat().st_ino
    write_vectorized(tmp_path, "none", mask, empty, find_intersections(empty))
    assert picture.stat().st_ino != number  # it took the other's place, whole


def test_a_large_mask_is_drawn_reduced(mask: RoadMask, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("roadgeo.outputs.vectorized._MAX_SIDE", 60)
    graph = vectorize(mask).graph
    assert draw_vectorized(mask, graph, find_intersections(graph)).shape == (40, 60, 3)


def test_a_large_picture_takes_little_more_memory_than_itself() -> None:
    roads = np.zeros((2000, 2000), np.bool_)
    roads[::200], roads[:, ::200] = True, True
    mask = RoadMask(roads)
    graph = vectorize(mask).graph
    ground = np.full((2000, 2000, 4), 90, np.uint8)
    tracemalloc.start()
    picture = draw_vectorized(mask, graph, find_intersections(graph), ground)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 12 * picture.nbytes  # with numbers of eight bytes for all of it, it was 30 times that
