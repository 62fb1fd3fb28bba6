"""From a mask to a graph."""

import cv2
import numpy as np
import pytest

from roadgeo.errors import MaskError
from roadgeo.grid import RoadMask
from roadgeo.vectorization import Vectorization, vectorize


def drawn(lines: list[list[tuple[float, float]]], width: int, size: int = 200) -> RoadMask:
    """Draw polylines given in pixels (column, row), corner convention."""
    image = np.zeros((size, size), np.uint8)
    for line in lines:
        points = np.round((np.array(line) - 0.5) * 16).astype(np.int32).reshape(-1, 1, 2)
        cv2.polylines(image, [points], False, 255, width, cv2.LINE_8, 4)
    return RoadMask(image > 0)


def junctions(result: Vectorization) -> np.ndarray:
    return result.graph.xy[result.graph.degree() >= 3]


@pytest.mark.parametrize("width", [3, 5, 7, 10, 15, 25])
def test_a_crossing_is_found_at_its_place(width: int) -> None:
    result = vectorize(drawn([[(-50, 100), (250, 110)], [(90, -50), (110, 250)]], width))
    graph = result.graph
    assert abs(result.road_width_px - width) < 0.25 * width + 1
    assert result.is_open.sum() == 4
    assert (graph.degree() == 1).sum() == 4
    truth = (100.33, -105.01)
    assert np.hypot(*(junctions(result).mean(axis=0) - truth)) < 0.2 * width + 0.5


def test_no_road_is_an_error() -> None:
    with pytest.raises(MaskError, match="no road"):
        vectorize(RoadMask(np.zeros((50, 50), bool)))
