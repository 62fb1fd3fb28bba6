"""The reference index: what its arrays promise, and what is refused when read."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from naive import kernels as naive
from worlds.scenes import PLANE

from roadgeo.errors import IndexFormatError, RoadSourceError
from roadgeo.kernels.roads import bin_segments
from roadgeo.kernels.triple_codes import TABLE
from roadgeo.matching.index import (
    IndexOptions,
    ReferenceIndex,
    build_index,
    check_table,
    crop,
    neighbour_grid,
    pack_tangents,
    sort_by_bucket,
)
from roadgeo.roads.graph import RoadGraph
from roadgeo.roads.intersections import Intersections
from roadgeo.roads.network import RoadNetwork, build_network

coordinates = st.floats(-1e6, 1e6)
points = st.lists(st.tuples(coordinates, coordinates), min_size=1, max_size=30).map(lambda p: np.array(p, float))


@given(points, st.floats(0.5, 1e4))
def test_grids_cover_their_points_with_few_buckets(xy, least):
    (x0, y0, size), (columns, rows) = neighbour_grid(xy, least)
    assert size >= least
    assert columns * rows <= 16 * len(xy) + 1
    assert (xy >= (x0, y0)).all()
    assert (xy <= np.array([x0 + columns * size, y0 + rows * size]) + 1e-6 * size).all()


@given(points, st.floats(0.5, 1e4))
def test_buckets_hold_what_lies_in_them(xy, least):
    grid, shape = neighbour_grid(xy, least)
    order, starts = sort_by_bucket(xy, grid, shape)
    assert sorted(order.tolist()) == list(range(len(xy)))
    assert starts[0] == 0
    assert starts[-1] == len(xy)
    for bucket, (start, stop) in enumerate(pairwise(starts.tolist())):
        corner = np.array(grid[:2]) + grid[2] * np.array([bucket % shape[0], bucket // shape[0]])
        inside = xy[order[start:stop]]
        assert (inside >= corner - 1e-9 * (1 + np.abs(corner))).all()
        assert (inside <= corner + grid[2] + 1e-9 * (1 + np.abs(corner))).all()


def test_tangents_are_stored_to_a_hundredth_of_a_degree():
    angles = np.array([[0.0, 1.0, 3.1415], [np.nan, np.nan, np.nan]], np.float32)
    stored = pack_tangents(angles)
    assert stored.dtype == np.int16
    assert stored[0] * np.pi / 32767 == pytest.approx(angles[0], abs=1e-4)
    assert (stored[1] == -1).all()


class TestBuildIndex:
    def test_rows_are_those_of_the_network(self, town):
        network, index = town
        found = network.intersections
        assert sorted(index.source.tolist()) == list(range(len(found)))
        assert np.array_equal(index.xy, found.xy[index.source])
        columns = index.tangents.shape[1]
        assert columns >= found.n_branches.max()
        assert np.array_equal(index.branches, found.branches()[index.source, :columns])
        assert np.array_equal(index.tangents, pack_tangents(found.tangents[index.source, :columns]))

    def test_neighbours_are_the_nearest(self, town):
        index = town[1]
        distance = np.hypot(*(index.xy[index.neighbours] - index.xy[:, None]).transpose(2, 0, 1))
        assert (index.neighbours >= 0).all()
        assert np.allclose(distance, naive.nearest_neighbours(index.xy, index.neighbours.shape[1]))

    def test_segments_are_the_roads(self, town):
        network, index = town
        roads = shapely.multilinestrings([shapely.LineString(line) for line in network.graph.polylines()])
        drawn = shapely.multilinestrings(shapely.linestrings(index.segments.astype(float).reshape(-1, 2, 2)))
        assert drawn.length == pytest.approx(roads.length, rel=1e-3)
        assert drawn.hausdorff_distance(roads) <= IndexOptions().simplify_m + 1e-3

    def test_an_index_of_an_earlier_version_has_wider_buckets_of_roads(self, town):
        index = town[1]
        counts = np.zeros(index.shape[0] * index.shape[1] + 1, np.int64)
        total = bin_segments(index.segments, index.grid, index.shape, counts, np.empty(0, np.int32))
        starts, ids = np.cumsum(counts), np.empty(total, np.int32)
        bin_segments(index.segments, index.grid, index.shape, starts.copy(), ids)
        old = index.arrays() | {"segment_starts": starts.astype(np.int32), "segment_ids": ids}
        roads = ReferenceIndex.from_parts(index.meta, old).road_buckets
        assert roads.grid == index.grid
        assert roads.shape == index.shape

    def test_table_entries_are_triples_that_exist(self, town):
        index = town[1]
        check_table(index)
        entries = index.table_entries
        assert len(entries) == index.table_starts[-1] > 10 * len(index)
        anchor = (entries >> np.uint64(40)).astype(np.int64)
        b, c = (index.neighbours[anchor, (entries >> np.uint64(s) & np.uint64(7)).astype(int)] for s in (37, 34))
        assert (np.diff(np.sort(np.stack([anchor, b, c], axis=1), axis=1), axis=1) > 0).all()
        ab, ac = index.xy[b] - index.xy[anchor], index.xy[c] - index.xy[anchor]
        assert (ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0] > 0).all()

    def test_arrays_cannot_be_written(self, town):
        assert not any(array.flags.writeable for array in town[1].arrays().values())

    def test_meta_is_plain(self, town):
        network, index = town
        assert index.name == network.meta["name"]
        assert index.plane == PLANE
        assert index.meta["n_intersections"] == len(index) == len(network.intersections)
        assert index.meta["index_options"]["n_neighbours"] == index.neighbours.shape[1]

    @pytest.mark.parametrize("n", [0, 1, 2])
    def test_too_few_intersections(self, town, n):
        few = town[0].intersections
        few = Intersections(few.xy[:n], few.rays[:n], few.tangents[:n], few.residual[:n], few.node[:n])
        with pytest.raises(RoadSourceError, match="at least 3"):
            build_index(replace(town[0], intersections=few))

    def test_a_network_of_three_intersections(self):
        cross = [[(0, -200), (0, 900)], [(300, -200), (310, 900)], [(-200, 0), (500, 10)], [(-200, 600), (250, 610)]]
        network = build_network([shapely.LineString(line) for line in cross], PLANE, {})
        index = build_index(network)
        assert len(index) == 3
        assert (index.neighbours[:, 2:] == -1).all()
        assert ReferenceIndex.from_parts(index.meta, index.arrays()).neighbours is index.neighbours

    def test_intersections_in_one_place(self, town):
        found = town[0].intersections
        same = np.zeros(5, int)
        piled = Intersections(
            found.xy[same], found.rays[same], found.tangents[same], found.residual[same], found.node[:5]
        )
        nothing = RoadGraph.from_polylines(np.empty((0, 2)), np.empty((0, 2)), [])
        index = build_index(RoadNetwork(nothing, piled, PLANE))
        assert len(index.table_entries) == 0
        assert len(index.segments) == len(index.segment_ids) == 0


class TestFromParts:
    def test_gives_the_index_back(self, town):
        index = town[1]
        again = ReferenceIndex.from_parts(index.meta, index.arrays(), "town.gpkg")
        assert again.path == "town.gpkg"
        assert all(again.arrays()[name] is array for name, array in index.arrays().items())

    def refuse(self, index, match, meta=None, **arrays):
        with pytest.raises(IndexFormatError, match=match) as caught:
            ReferenceIndex.from_parts({**index.meta, **(meta or {})}, {**index.arrays(), **arrays}, "town.index")
        assert "town.index" in str(caught.value)
        assert "roadgeo index" in str(caught.value)
        assert "\n" not in str(caught.value)

    NAMES = (
        "xy", "branches", "tangents", "neighbours", "point_starts", "segments", "segment_starts", "segment_ids",
        "table_starts", "table_entries", "source",
    )  # fmt: skip

    def test_names(self, town):
        assert set(town[1].arrays()) == set(self.NAMES)

    @pytest.mark.parametrize("name", NAMES)
    def test_a_missing_array(self, town, name):
        arrays = {key: array for key, array in town[1].arrays().items() if key != name}
        with pytest.raises(IndexFormatError, match=f"{name}.*missing"):
            ReferenceIndex.from_parts(town[1].meta, arrays)

    @pytest.mark.parametrize("name", NAMES)
    @pytest.mark.parametrize("dtype", [">f8", "<f2", "<i8", "<u4", "bool"])
    def test_another_type(self, town, name, dtype):
        self.refuse(town[1], f"{name}.*type or shape", **{name: np.zeros(getattr(town[1], name).shape, dtype)})

    @pytest.mark.parametrize("name", NAMES)
    def test_another_number_of_dimensions(self, town, name):
        self.refuse(town[1], f"{name}.*type or shape", **{name: getattr(town[1], name)[None]})

    @pytest.mark.parametrize("name", [n for n in NAMES if n != "segments"])
    def test_an_array_cut_short(self, town, name):
        self.refuse(town[1], ".", **{name: getattr(town[1], name)[:-1]})

    def test_segments_cut_short(self, town):
        index = town[1]
        self.refuse(index, "segment id", segments=index.segments[: int(index.segment_ids.max())])

    @pytest.mark.parametrize("name", ["xy", "branches", "tangents", "segments"])
    def test_columns_missing(self, town, name):
        self.refuse(town[1], "bad", **{name: getattr(town[1], name)[:, :-1]})

    def test_branches_with_three_components(self, town):
        branches = town[1].branches
        self.refuse(town[1], "bad branches", branches=np.concatenate([branches, branches[..., :1]], axis=2))

    @pytest.mark.parametrize("columns", [1, *range(9, 33)])
    def test_columns_that_no_index_has(self, town, columns):
        """The paper's method copies them into arrays of eight: more of them were written beyond its end."""
        n = len(town[1])
        wide = {"tangents": np.zeros((n, columns), np.int16), "branches": np.zeros((n, columns, 2), np.int8)}
        self.refuse(town[1], "bad tangents", **wide)

    @pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e9, -1e9])
    @pytest.mark.parametrize("name", ["xy", "segments"])
    def test_places_that_are_nowhere(self, town, name, value):
        array = getattr(town[1], name).copy()
        array.flat[array.size // 2] = value
        self.refuse(town[1], "bad positions" if name == "xy" else "bad segments", **{name: array})

    def test_segments_that_take_forever_to_walk_along(self, town):
        """Each within bounds, but listed so often that a query would sample a million kilometres of them."""
        segments = town[1].segments.copy()
        segments[:, 2] = segments[:, 0] + 9e5
        self.refuse(town[1], "bad segments", segments=segments)
        segments[:, 2] = segments[:, 0] + 2e6
        self.refuse(town[1], "bad segments", segments=segments[:1], segment_ids=town[1].segment_ids * 0)

    @pytest.mark.parametrize("columns", [0, 17])
    def test_too_few_or_too_many_neighbours(self, town, columns):
        self.refuse(town[1], "bad neighbours", neighbours=np.zeros((len(town[1]), columns), np.int32))

    @pytest.mark.parametrize(
        ("name", "value", "match"),
        [
            ("neighbours", -2, "neighbour is out of range"),
            ("neighbours", 2**31 - 1, "neighbour is out of range"),
            ("segment_ids", -1, "segment id is out of range"),
            ("segment_ids", 2**31 - 1, "segment id is out of range"),
            ("point_starts", -1, "not ascending"),
            ("segment_starts", 2**31 - 1, "not ascending"),
            ("table_starts", -(2**31), "not ascending"),
        ],
    )
    def test_a_number_out_of_range(self, town, name, value, match):
        array = getattr(town[1], name).copy()
        array.flat[array.size // 2] = value
        self.refuse(town[1], match, **{name: array})

    @pytest.mark.parametrize("name", ["point_starts", "segment_starts", "table_starts"])
    @pytest.mark.parametrize("end", [0, -1])
    def test_starts_that_do_not_cover_their_array(self, town, name, end):
        array = getattr(town[1], name).copy()
        array[end] += 1
        self.refuse(town[1], "does not cover", **{name: array})

    @pytest.mark.parametrize(
        ("key", "values", "match"),
        [
            ("grid", [None, [], [0, 0], [0, 0, 0], [0, 0, -1], [0, 0, np.nan], [0, np.inf, 9], ["a", 0, 9], "grid",
                      [10**400, 0, 9]], "bad grid"),
            ("origin", [None, [0], [0, np.nan], [0, "b"], {}, [0, -(10**400)]], "bad origin"),
            ("shape", [None, [5], [5, 5.0], [0, 9], [-3, -3], [2**20, 2**20], [True, True], "55"], "bad"),
            ("crs", [None, 4326, b"EPSG:4326"], "no CRS"),
        ],
    )  # fmt: skip
    def test_meta_that_makes_no_sense(self, town, key, values, match):
        for value in values:
            self.refuse(town[1], match, meta={key: value})

    def test_another_grid_shape(self, town):
        self.refuse(town[1], "wrong length", meta={"shape": [town[1].shape[0] + 1, town[1].shape[1]]})

    def test_an_empty_index_is_one(self, town):
        empty = {name: array[:0] for name, array in town[1].arrays().items()}
        starts = {"point_starts": np.zeros(2, np.int32), "segment_starts": np.zeros(2, np.int32)}
        empty |= {**starts, "table_starts": np.zeros(TABLE + 1, np.int32)}
        assert len(ReferenceIndex.from_parts({**town[1].meta, "shape": [1, 1]}, empty)) == 0


class TestCheckTable:
    def test_entries_that_point_nowhere(self, town):
        entries = town[1].table_entries.copy()
        entries[7] = 2**63
        with pytest.raises(IndexFormatError, match="out of range"):
            check_table(replace(town[1], table_entries=entries))

    def test_entries_that_point_to_missing_neighbours(self, town):
        index = town[1]
        neighbours = index.neighbours.copy()
        neighbours[:, -1] = -1
        with pytest.raises(IndexFormatError, match="out of range"):
            check_table(replace(index, neighbours=neighbours))

    def test_no_entries(self, town):
        check_table(replace(town[1], table_entries=town[1].table_entries[:0]))


class TestCrop:
    def test_what_lies_within_and_how_it_is_found(self, town):
        index = town[1]
        center = index.xy.mean(axis=0)
        away = np.hypot(*(index.xy - center).T)
        radius = float(np.median(away))
        part = crop(index, tuple(center), radius)
        assert len(part) == int((away <= radius).sum())
        assert np.array_equal(part.xy, index.xy[away <= radius])
        assert np.array_equal(part.source, index.source[away <= radius])
        assert part.segments is index.segments
        check_table(part)
        ReferenceIndex.from_parts(part.meta, part.arrays())
        # Far from the circle's rim neighbours are what they were.
        deep = np.flatnonzero(away[away <= radius] < 0.5 * radius)[0]
        was = np.flatnonzero(away <= radius)[deep]
        assert np.array_equal(part.xy[part.neighbours[deep]], index.xy[index.neighbours[was]])

    def test_the_options_are_those_of_the_whole(self, town):
        options = IndexOptions(n_neighbours=5, min_shape=0.15, codes_per_vertex=1)
        index = build_index(town[0], options)
        part = crop(index, tuple(index.xy[0]), 1e6)
        assert len(part.table_entries) == len(index.table_entries)

    def test_the_whole_and_nothing(self, town):
        index = town[1]
        whole = crop(index, tuple(index.xy[0]), 1e6)
        assert len(whole.table_entries) == len(index.table_entries)
        assert len(crop(index, (1e7, 1e7), 1.0)) == 0


def test_within_a_cell_entries_come_from_all_parts_of_the_map(town):
    """Where a look-up is cut short it must not have seen the south only."""
    index = town[1]
    anchors = (index.table_entries >> np.uint64(40)).astype(np.int64)
    northing = index.xy[anchors, 1]
    cells = np.repeat(np.arange(len(index.table_starts) - 1), np.diff(index.table_starts))
    inside = cells[1:] == cells[:-1]
    later = northing[1:][inside] - northing[:-1][inside]
    assert abs((later > 0).mean() - (later < 0).mean()) < 0.05


def test_within_a_cell_entries_are_sorted_by_their_sides(town):
    index = town[1]
    cells = np.repeat(np.arange(len(index.table_starts) - 1), np.diff(index.table_starts))
    sides = (index.table_entries >> np.uint64(24)).astype(np.int64) & 1023
    assert (np.diff(cells * 1024 + sides) >= 0).all()
    check_table(index)
    mixed = replace(index, table_entries=index.table_entries[np.lexsort((-sides, cells))])
    with pytest.raises(IndexFormatError, match="not in order"):
        check_table(mixed)


@pytest.mark.parametrize("reach_m", [1.0, 90.0, 640.0, 1e5])
@pytest.mark.parametrize("away_m", [(0.0, 0.0), (350.0, -900.0), (-1e5, 40.0), (3e4, np.nan)])
def test_what_lies_near_is_found_in_the_buckets_there(town, reach_m, away_m):
    index = town[1]
    middle = index.xy.mean(axis=0) + away_m
    slowly = index.xy[np.abs(index.xy - middle).max(axis=1) < reach_m]
    assert np.array_equal(index.within(middle, reach_m), slowly)


@pytest.mark.parametrize("beyond", [0.0, 1e6])
def test_the_roads_within_a_box_are_those_whose_bounds_touch_it(town, beyond):
    index, rng = town[1], np.random.default_rng(7)
    a, b = index.segments[:, :2], index.segments[:, 2:]
    for _ in range(5):
        low = rng.uniform(-200.0, 3800.0, 2) + beyond
        high = low + rng.uniform(1.0, 900.0, 2)
        touches = ((np.minimum(a, b) <= high) & (np.maximum(a, b) >= low)).all(axis=1)
        np.testing.assert_array_equal(index.segments_within(low, high), index.segments[touches])
