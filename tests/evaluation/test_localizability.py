"""Maps of where masks would be located."""

import math

import numpy as np
import pytest
from worlds.towns import lattice_town

from roadgeo.evaluation.localizability import (
    AMBIGUOUS,
    LOCATED,
    TOO_FEW,
    UNKNOWN,
    draw_localizability,
    lay_grid,
    map_localizability,
    to_geotiff,
)
from roadgeo.roads.intersections import Intersections
from roadgeo.roads.network import RoadNetwork

TOWN = lattice_town(20)  # 2 km of it
EMPTY_SIDE = 4000.0


def network(coverage=()):
    """The town, with 2 km of empty land in the east that one road crosses."""
    from dataclasses import replace

    graph = TOWN.graph
    road = np.array([[1900.0, 950.0], [EMPTY_SIDE, 950.0]])
    longer = replace(
        graph,
        xy=np.vstack([graph.xy, road]),
        edges=np.vstack([graph.edges, [[graph.n_nodes, graph.n_nodes + 1]]]).astype(np.int32),
        coords=np.vstack([graph.coords, road]),
        offsets=np.append(graph.offsets, len(graph.coords) + 2),
    )
    xy = TOWN.intersections
    n = len(xy)
    tangents = np.full((n, 8), np.nan, np.float32)
    tangents[:, 0], tangents[:, 1] = 0.1, 1.6
    found = Intersections(xy, tangents, tangents, np.zeros(n, np.float32), np.arange(n))
    return RoadNetwork(longer, found, TOWN.plane, coverage)


def trials(grid, rng, count=400):
    """Masks are located where they show 12 intersections or more, with some luck on either side."""
    places = grid.draw(count, np.ones(grid.covered.shape, bool), rng)
    row = ((grid.cells.north - places[:, 1]) / grid.cells.resolution).astype(int)
    column = ((places[:, 0] - grid.cells.west) / grid.cells.resolution).astype(int)
    return places, grid.counts[row, column] + rng.normal(0, 1.5, count) >= 12


def test_cells_count_the_intersections_around_them():
    grid = lay_grid(network(), math.pi * 200.0**2)
    cells = grid.cells
    row, column = int((cells.north - 950.0) / cells.resolution), int((950.0 - cells.west) / cells.resolution)
    around = np.hypot(*(TOWN.intersections - (950.0, 950.0)).T) < 200.0
    assert grid.counts[row, column] == pytest.approx(around.sum(), abs=2)
    assert grid.counts[row, -1] == 0
    assert grid.covered.all()


def test_the_map_tells_where_masks_are_located():
    rng = np.random.default_rng(0)
    grid = lay_grid(network(), 400.0**2)
    found = map_localizability(grid, *trials(grid, rng, 1000))
    places, located = trials(grid, rng, 2000)
    classes = found.at(places)
    assert located[classes == LOCATED].mean() >= 0.95
    assert located[classes != LOCATED].mean() <= 0.3
    assert located[classes == TOO_FEW].mean() < 0.05
    assert (found.classes == LOCATED).mean() > 0.25


@pytest.mark.parametrize("outcome", [True, False])
def test_trials_that_all_agree_are_learnt_from(outcome):
    grid = lay_grid(network(), 400.0**2)
    places = grid.draw(100, grid.counts > 5, np.random.default_rng(0))
    found = map_localizability(grid, places, np.full(100, outcome))
    assert (found.at(places) == LOCATED).all() == outcome
    assert np.isfinite(found.probability).all()


def test_few_trials_support_no_promise():
    grid = lay_grid(network(), 400.0**2)
    places = grid.draw(4, grid.counts > 5, np.random.default_rng(0))
    found = map_localizability(grid, places, np.full(4, True))
    assert not (found.classes == LOCATED).any()
    assert set(np.unique(found.classes)) <= {AMBIGUOUS, TOO_FEW}


def test_ground_with_hardly_a_crossing_is_promised_nothing():
    """Trials lie where there are crossings: what they tell does not hold where there are none."""
    grid = lay_grid(network(), 400.0**2)
    places = grid.draw(100, grid.counts > 8, np.random.default_rng(0))
    found = map_localizability(grid, places, np.full(100, True))
    bare = grid.covered & (grid.counts < 6)
    assert bare.any()
    assert (found.classes[bare] == TOO_FEW).all()
    assert (found.classes[grid.counts > 8] == LOCATED).all()


def test_ground_without_known_roads_is_left_out():
    ring = np.array([[0, 0], [1000, 0], [1000, 1000], [0, 1000], [0, 0]], float)
    hole = np.array([[400, 400], [600, 400], [600, 600], [400, 600], [400, 400]], float)
    grid = lay_grid(network((ring, hole)), 400.0**2)
    found = map_localizability(grid, *trials(grid, np.random.default_rng(0)))
    inside, in_hole, outside, beyond = found.at(np.array([[200, 200], [500, 500], [1500, 500], [1e6, 0]], float))
    assert inside != UNKNOWN
    assert in_hole == outside == beyond == UNKNOWN
    assert np.isnan(found.probability[found.classes == UNKNOWN]).all()
    drawn = grid.draw(200, np.ones(grid.covered.shape, bool), np.random.default_rng(1))
    assert (found.at(drawn) != UNKNOWN).all()


def test_outputs_are_where_they_belong():
    import rasterio

    grid = lay_grid(network(), 400.0**2)
    found = map_localizability(grid, *trials(grid, np.random.default_rng(0)))
    with rasterio.MemoryFile(to_geotiff(found)) as memory, memory.open() as raster:
        assert raster.crs.to_epsg() == 32619
        cells = grid.cells
        assert raster.res == (cells.resolution, cells.resolution)
        assert (raster.bounds.left, raster.bounds.top) == pytest.approx((300000 + cells.west, 4600000 + cells.north))
        assert np.array_equal(raster.read(1), found.classes)
        assert raster.read(2).max() <= 100
        assert raster.count == 2
    assert draw_localizability(network(), found, "Town").std() > 10
