"""Landscapes: what of a map a camera sees."""

import numpy as np
import pytest
from worlds.towns import lattice_town

from roadgeo.evaluation.landscape import Landscape, visible_intersections, visible_strokes
from roadgeo.geometry.pinhole import make_view
from roadgeo.geometry.projection import LocalPlane
from roadgeo.roads.graph import RoadGraph

PLANE = LocalPlane("EPSG:32619", (0.0, 0.0))


def crossing() -> Landscape:
    """A cross of four streets of 100 m around (0, 0), in order east, north, west, south."""
    xy = np.array([[0, 0], [100, 0], [0, 100], [-100, 0], [0, -100]], float)
    edges = np.array([[0, 1], [0, 2], [0, 3], [0, 4]])
    return Landscape(RoadGraph.from_polylines(xy, edges, [xy[[a, b]] for a, b in edges]), xy[:1], PLANE)


def test_strokes_are_the_roads_seen_through_the_camera():
    view = make_view((0.0, 0.0), (60, 60), 1.0)
    strokes = visible_strokes(crossing(), view, np.random.default_rng(0))
    assert set(strokes.street) == {0, 1, 2, 3}
    points = np.vstack([strokes.start, strokes.end])
    assert (np.isclose(points, 30.0).any(axis=1)).all()  # all on the two axes through the frame's middle
    assert (points > -45).all()
    assert (points < 105).all()
    assert strokes.length.sum() > 4 * 30  # from the middle to beyond the border


def test_pieces_lie_within_one_street():
    strokes = visible_strokes(lattice_town(), make_view((600, 600), (900, 900), 1.0), np.random.default_rng(0))
    streets_of_piece = {}
    for piece, street in zip(strokes.piece, strokes.street, strict=True):
        streets_of_piece.setdefault(piece, set()).add(street)
    assert all(len(streets) == 1 for streets in streets_of_piece.values())
    assert len(streets_of_piece) >= len(set(strokes.street))


def test_nothing_is_seen_off_the_map():
    view = make_view((1e5, 1e5), (60, 60), 1.0)
    assert len(visible_strokes(crossing(), view, np.random.default_rng(0)).start) == 0
    assert visible_intersections(crossing(), view).shape == (0, 2)


def test_intersections_are_seen_in_pixels():
    view = make_view((10.0, 5.0), (60, 60), 1.0)
    assert visible_intersections(crossing(), view) == pytest.approx(np.array([[20.0, 35.0]]))


SQUARE = np.array([[-50, -50], [50, -50], [50, 50], [-50, 50], [-50, -50]], float)


@pytest.mark.parametrize(
    ("coverage", "point", "covered"),
    [
        ((), (0, 0), True),
        ((), (0, 101), False),
        ((SQUARE,), (0, 0), True),
        ((SQUARE,), (60, 0), False),
        ((SQUARE, SQUARE / 5), (0, 0), False),  # a hole
        ((SQUARE, SQUARE / 5), (20, 0), True),
    ],
)
def test_coverage_says_where_roads_are_known(coverage, point, covered):
    landscape = Landscape(crossing().graph, crossing().intersections, PLANE, coverage)
    assert landscape.covers(np.array([point], float)) is covered
