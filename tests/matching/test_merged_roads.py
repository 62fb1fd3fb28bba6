"""Roads that have merged in a mask: where they are told, and fits that do not rest on them."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from worlds.scenes import mapped, sight_of

from roadgeo.geometry.mask import RoadMask
from roadgeo.matching.index import IndexOptions, build_index
from roadgeo.matching.merged_roads import find_merged, nearest_of, without_merged
from roadgeo.matching.query import trace_query
from roadgeo.matching.refinement import RefineOptions, refine
from roadgeo.roads.graph import RoadGraph


def mask_of(*strips):
    """A mask of 200 x 400 pixels with roads between rows, from a column to another: (top, bottom, left, right)."""
    roads = np.zeros((200, 400), np.bool_)
    for top, bottom, left, right in strips:
        roads[top:bottom, left:right] = True
    return roads


class TestMergedRoads:
    """Two roads side by side, of which the mask shows a line between them."""

    SINGLE = (20, 30, 0, 400)

    def flags(self, merged, line_at, *, spacing=10.0):
        """Flags along a single road at row 25 and along a line at another row, columns 5, 15, ... of each."""
        columns = np.arange(5.0, 400.0, spacing)
        points = np.concatenate([np.stack([columns, np.full(len(columns), -at)], axis=1) for at in (25.0, line_at)])
        directions = np.tile([1.0, 0.0], (len(points), 1))
        found = find_merged(mask_of(self.SINGLE, *merged), points, directions, 10.0)
        return found[: len(columns)], found[len(columns) :]

    @pytest.mark.parametrize("gap", [0, 3, 8])
    def test_their_line_is_told_by_its_width(self, gap):
        """Whether they touch or leave a narrow gap in which the line runs."""
        middle = 110.0
        pair = [(int(middle - gap / 2 - 10), int(middle - gap / 2), 0, 400), (int(middle + gap / 2), 125, 0, 400)]
        alone, together = self.flags(pair, middle)
        assert not alone.any()
        assert together.all()

    def test_two_lines_side_by_side_are_two_roads(self):
        _, one = self.flags([(100, 110, 0, 400), (113, 123, 0, 400)], 105.0)
        assert not one.any()

    def test_roads_are_wide_for_a_while_where_they_cross(self):
        _, crossed = self.flags([(105, 115, 0, 400), (50, 170, 200, 210)], 110.0)
        assert not crossed.any()

    def test_only_where_they_run_together(self):
        _, partly = self.flags([(105, 115, 0, 400), (115, 125, 0, 200)], 113.0)
        assert partly[:18].all()
        assert not partly[22:].any()

    def test_beyond_the_frame_is_no_road(self):
        columns = np.arange(2.0, 400.0, 4.0)
        points = np.stack([columns, np.full(len(columns), -4.0)], axis=1)
        directions = np.tile([1.0, 0.0], (len(points), 1))
        assert not find_merged(mask_of((0, 8, 0, 400)), points, directions, 10.0).any()

    def test_thin_lines_are_no_merged_roads(self):
        """Of lines of a pixel, many have two."""
        rng = np.random.default_rng(3)
        roads = mask_of((50, 51, 0, 400), (51, 52, 100, 300), (150, 151, 0, 400))
        columns = rng.uniform(0.0, 399.0, 200)
        points = np.stack([columns, np.where(columns < 200, -50.5, -150.5)], axis=1)
        assert not find_merged(roads, points, np.tile([1.0, 0.0], (200, 1)), 1.3).any()

    def test_no_points(self):
        nothing = np.empty((0, 2))
        assert find_merged(mask_of(self.SINGLE), nothing, nothing, 10.0).shape == (0,)

    def test_a_traced_mask_knows_them(self):
        mask = RoadMask(mask_of(self.SINGLE, (100, 122, 0, 400), (20, 110, 60, 70), (20, 110, 330, 340)))
        scene, _ = trace_query(mask)
        wide = np.abs(scene.points[:, 1] + 111) < 4
        assert scene.merged[wide].mean() > 0.9
        assert scene.merged[~wide].mean() < 0.1
        low = scene.intersections.xy[:, 1] < -90
        assert low.any()
        assert np.array_equal(scene.merged_at >= 0, low)
        assert scene.merged[scene.merged_at[low]].all()


@given(st.integers(0, 30), st.integers(1, 30), st.floats(0.1, 60.0), st.integers(0, 2**32 - 1))
def test_thenearest_of_some_points(n, m, away, seed):
    rng = np.random.default_rng(seed)
    xy, points = rng.uniform(0, 100, (n, 2)), rng.uniform(0, 100, (m, 2))
    among = np.flatnonzero(rng.random(m) < 0.5)
    found = nearest_of(xy, points, among, away)
    for one, number in zip(xy, found, strict=True):
        distances = np.hypot(*(points[among] - one).T)
        if len(among) and distances.min() < away:
            assert number == among[np.argmin(distances)]
        else:
            assert number == -1


def motorways(network, where, apart_m=14.0, sides=(1, -1)):
    """A network of which each road with its middle where `where` says is two carriageways, or one of them."""
    graph, lines = network.graph, []
    for e in range(graph.n_edges):
        line = graph.coords[graph.offsets[e] : graph.offsets[e + 1]]
        if where(line.mean(axis=0)):
            road = shapely.LineString(line)
            lines += [np.asarray(road.offset_curve(side * apart_m / 2).coords) for side in sides]
        else:
            lines.append(line)
    lines = [line for line in lines if len(line) > 1]
    ends = np.arange(2 * len(lines)).reshape(-1, 2)
    xy = np.concatenate([line[[0, -1]] for line in lines])
    return replace(network, graph=RoadGraph.from_polylines(xy, ends, lines), names=None, kinds=None)


@pytest.fixture(scope="module")
def sight(town):
    """(truth, scene, index): in a quarter of the frame the map has two carriageways for each road of the mask."""
    truth, scene = sight_of(town[0], 10, 10)
    back = np.linalg.inv(truth)

    def has_two(at):
        return bool((mapped(back, np.atleast_2d(at)) > scene.center).all())

    merged = np.array([has_two(at) for at in mapped(truth, scene.points)])
    on_them = (scene.intersections.xy > scene.center).all(axis=1)
    merged_at = np.where(on_them, np.flatnonzero(merged)[0], -1)
    index = build_index(motorways(town[0], has_two), IndexOptions(simplify_m=0.01))
    return truth, replace(scene, merged=merged, merged_at=merged_at), index


def error_of(truth, scene, index, options=None, n_points=None):
    """Root mean square over the inner frame, metres, and what is claimed of its corners."""
    result = refine(truth, scene, index, np.full(len(scene.intersections), -1), options, n_points)
    inner = scene.center + 0.8 * (scene.corners - scene.center)
    gaps = np.hypot(*(mapped(result.matrix, inner) - mapped(truth, inner)).T)
    return float(np.sqrt(np.mean(gaps**2))), float(result.corner_sigma_m.mean())


def test_merged_roads_do_not_bend_the_fit(sight):
    truth, scene, index = sight
    without, _ = error_of(truth, replace(scene, merged=None), index)
    error, claimed = error_of(truth, scene, index)
    assert error < 0.5
    assert error < 0.3 * without
    assert error < 2.0 * claimed


def test_a_quick_look_takes_them_as_they_are(sight):
    truth, scene, index = sight
    assert error_of(truth, scene, index, None, 200) == error_of(truth, replace(scene, merged=None), index, None, 200)


def test_a_fit_that_is_much_less_sure_without_them_rests_on_them(sight):
    truth, scene, index = sight
    without = error_of(truth, replace(scene, merged=None), index)
    assert error_of(truth, scene, index, RefineOptions(most_unsure=1e-6)) == without


def test_what_is_left_out(sight):
    """Points of merged roads with a road of the map beside them, and matches at those."""
    truth, scene, index = sight
    matched = np.arange(len(scene.intersections))
    apart, left = without_merged(truth, scene, index, matched, 25.0)
    n_left_out = len(scene.points) - len(apart.points)
    assert 0.9 * scene.merged.sum() < n_left_out <= scene.merged.sum()
    assert apart.road_length_px / len(apart.points) == pytest.approx(scene.road_length_px / len(scene.points))
    assert set(np.unique(left[scene.merged_at >= 0])) == {-1}
    assert np.array_equal(left[scene.merged_at < 0], matched[scene.merged_at < 0])


@pytest.mark.parametrize("why", ["not known", "none has", "the map has one road", "most have"])
def test_nothing_is_left_out_where(town, sight, why):
    truth, scene, index = sight
    if why == "not known":
        scene = replace(scene, merged=None, merged_at=None)
    elif why == "none has":
        scene = replace(scene, merged=np.zeros_like(scene.merged))
    elif why == "the map has one road":
        index = town[1]
    else:
        index = build_index(motorways(town[0], lambda at: True), IndexOptions())
        scene = replace(scene, merged=np.ones_like(scene.merged))
    matched = np.arange(len(scene.intersections))
    apart, left = without_merged(truth, scene, index, matched, 25.0)
    if why == "the map has one road":  # but for what runs beside another by chance
        assert len(apart.points) > 0.95 * len(scene.points)
    else:
        assert apart is scene
        assert left is matched
