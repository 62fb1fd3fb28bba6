"""Scenes: what the search sees of a query."""

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from naive import kernels as naive
from worlds.scenes import camera, look, scene_of

from roadgeo.matching import scene as scenes
from roadgeo.matching.scene import (
    prepare_scene,
    query_neighbours,
    sample_roads,
)
from roadgeo.roads.graph import RoadGraph
from roadgeo.roads.intersections import find_intersections


def graph_of(*lines):
    ends = np.array([[2 * e, 2 * e + 1] for e in range(len(lines))]).reshape(-1, 2)
    lines = [np.array(line, float) for line in lines]
    xy = np.concatenate([line[[0, -1]] for line in lines]) if lines else np.empty((0, 2))
    return RoadGraph.from_polylines(xy, ends, lines)


NOTHING = graph_of()
CROSS = graph_of([(0, -50), (200, -50)], [(40, 0), (40, -100)])


class TestSampleRoads:
    def test_a_straight_road(self):
        points, directions = sample_roads(graph_of([(0, 0), (40, 0)]), 10.0)
        assert points.tolist() == [[5, 0], [15, 0], [25, 0], [35, 0]]
        assert directions.tolist() == [[1, 0]] * 4

    @pytest.mark.parametrize("spacing", [3.0, 7.5, 1000.0])
    def test_spacing_runs_on_from_edge_to_edge(self, spacing):
        graph = graph_of([(0, 0), (30, 40)], [(500, 500), (500, 450), (520, 450)], [(0, 9), (0, 9), (7, 9)])
        points, directions = sample_roads(graph, spacing)
        total = graph.edge_lengths().sum()
        assert len(points) == len(directions) == max(0, int(np.ceil(total / spacing - 0.5)))
        roads = shapely.multilinestrings([shapely.LineString(line) for line in graph.polylines()])
        assert shapely.distance(shapely.points(points), roads) == pytest.approx(0, abs=1e-9)
        assert np.hypot(*directions.T) == pytest.approx(1)

    def test_directions_follow_the_bends(self):
        points, directions = sample_roads(graph_of([(0, 0), (30, 0), (30, -30)]), 10.0)
        assert directions.tolist() == [[1, 0]] * 3 + [[0, -1]] * 3
        assert points[3:, 0].tolist() == [30] * 3

    @pytest.mark.parametrize(("spacing", "length"), [(23.07, 23.07 * 186.5), (15.39, 15.39 * 15.5)])
    def test_a_road_that_ends_on_a_point(self, spacing, length):
        points, _ = sample_roads(graph_of([(0, 0), (length, 0)]), spacing)
        assert points[-1, 0] < length

    def test_no_roads(self):
        points, directions = sample_roads(NOTHING, 5.0)
        assert points.shape == directions.shape == (0, 2)


@given(st.lists(st.tuples(st.floats(0, 900), st.floats(-900, 0)), min_size=1, max_size=25), st.integers(1, 9))
def test_neighbours_in_the_order_of_the_points(points, k):
    xy = np.array(points)
    found = query_neighbours(xy, k)
    distance = np.where(found >= 0, np.hypot(*(xy[found] - xy[:, None]).transpose(2, 0, 1)), np.nan)
    assert np.allclose(distance, naive.nearest_neighbours(xy, k), equal_nan=True)


class TestPrepareScene:
    def test_a_crossing(self):
        scene = prepare_scene(CROSS, find_intersections(CROSS), (200, 100))
        assert scene.center.tolist() == [100, -50]
        assert scene.corners.tolist() == [[0, 0], [200, 0], [200, -100], [0, -100]]
        assert scene.half_size == pytest.approx(np.hypot(100, 50))
        assert scene.road_length_px == pytest.approx(300)
        assert scene.n_edges == 2
        assert len(scene.points) == 100
        assert scene.neighbours.shape == (0, 12)

    def test_field_is_the_distance_to_the_nearest_road(self):
        scene = prepare_scene(CROSS, find_intersections(CROSS), (200, 100))
        assert scene.field.shape == (100, 200)
        assert scene.field_scale == 1.0
        row, column = np.mgrid[:100, :200] + 0.5
        roads = shapely.multilinestrings([shapely.LineString(line) for line in CROSS.polylines()])
        truth = shapely.distance(shapely.points(column, -row), roads)
        assert np.abs(scene.field - truth).max() < 0.06 * truth.max() + 0.8

    @pytest.mark.parametrize(("size", "cells"), [((1000, 500), (200, 400)), ((30, 20000), (400, 1)), ((1, 1), (1, 1))])
    def test_large_frames_are_reduced(self, size, cells):
        scene = prepare_scene(NOTHING, find_intersections(NOTHING), size)
        assert scene.field.shape == scene.observed.shape == cells
        assert scene.field_scale == max(1.0, max(size) / 400)
        assert scene.field.dtype == np.float32

    def test_a_road_is_found_in_the_reduced_field(self):
        graph = graph_of([(0, -1234), (4000, -1234)])
        scene = prepare_scene(graph, find_intersections(graph), (4000, 3000))
        assert (scene.field.argmin(axis=0) == int(1234 / scene.field_scale)).all()

    def test_what_was_observed(self, monkeypatch):
        monkeypatch.setattr(scenes, "_FIELD_CELLS", 50)
        seen = np.ones((100, 200), bool)
        seen[:, :80] = False
        scene = prepare_scene(CROSS, find_intersections(CROSS), (200, 100), seen)
        assert scene.observed.shape == (25, 50)
        assert not scene.observed[:, :20].any()
        assert scene.observed[:, 20:].all()
        assert prepare_scene(CROSS, find_intersections(CROSS), (200, 100)).observed.all()

    def test_roads_count_by_their_probability(self):
        plain = prepare_scene(CROSS, find_intersections(CROSS), (200, 100))
        assert (plain.weights == 1.0).all()
        probability = np.full((100, 200), 127, np.uint8)
        probability[:, 100:] = 254
        probability[:40] = 255  # nothing is known there
        scene = prepare_scene(CROSS, find_intersections(CROSS), (200, 100), probability=probability)
        column, row = scene.points.T * [[1], [-1]]
        sure = (np.abs(column - 100) > 2) & (np.abs(row - 40) > 2)  # a pixel away from each
        expected = np.select([row < 40, column < 100], [0.0, 0.5], 1.0)
        np.testing.assert_allclose(scene.weights[sure], expected[sure])

    def test_a_query_without_roads(self):
        scene = prepare_scene(NOTHING, find_intersections(NOTHING), (300, 200))
        assert len(scene.points) == len(scene.intersections) == scene.n_edges == 0
        assert scene.field.min() > 100

    def test_points_are_bounded(self, town):
        scene = scene_of(look(town[0], camera((2000, 2000))))
        assert 300 < len(scene.points) <= 600
        assert len(scene.branches) == len(scene.neighbours) == len(scene.intersections) > 30
        assert (np.hypot(*np.diff(scene.points, axis=0).T) > 0).all()


@pytest.mark.parametrize("kept", [slice(None, None, 3), np.arange(600) % 2 == 0])
def test_some_of_the_points_keep_all_that_is_known_of_them(town, kept):
    scene = scene_of(look(town[0], camera((2000, 1900), (1000, 1000), 1.0)))
    kept = kept if isinstance(kept, slice) else kept[: len(scene.points)]
    some = scene.of_points(kept)
    for name in ("points", "directions", "weights"):
        assert np.array_equal(getattr(some, name), getattr(scene, name)[kept])
    assert some.intersections is scene.intersections
