"""From a mask to a graph."""

import numpy as np
import pytest
import shapely

from roadgeo.errors import MaskError
from roadgeo.grid import RoadMask
from roadgeo.vectorization import Vectorization, vectorize


def drawn(lines: list[list[tuple[float, float]]], width: float, size: int = 200) -> RoadMask:
    """Mark the pixels whose centres lie within half a width of polylines given in pixels (column, row)."""
    centres = shapely.points(*(np.mgrid[0:size, 0:size][::-1] + 0.5))
    return RoadMask(shapely.dwithin(centres, shapely.MultiLineString(lines), width / 2))


def junctions(result: Vectorization) -> np.ndarray:
    return result.graph.xy[result.graph.degree() >= 3]


@pytest.mark.parametrize("width", [3, 5, 7, 10, 15, 25])
def test_a_crossing_is_found_at_its_place(width: int) -> None:
    result = vectorize(drawn([[(-50, 100), (250, 110)], [(90, -50), (110, 250)]], width))
    graph = result.graph
    assert result.road_width_px == pytest.approx(width, rel=0.15, abs=0.6)
    assert result.is_open.sum() == 4
    assert (graph.degree() == 1).sum() == 4
    truth = (100.33, -105.01)
    assert np.hypot(*(junctions(result).mean(axis=0) - truth)) < 0.2 * width + 0.5


def test_no_road_is_an_error() -> None:
    with pytest.raises(MaskError, match="no road"):
        vectorize(RoadMask(np.zeros((50, 50), bool)))
