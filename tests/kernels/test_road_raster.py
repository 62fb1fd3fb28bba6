"""Roads as direction bits."""

import math

import numpy as np
import pytest
from naive import road_votes as naive

from roadgeo.kernels.road_raster import (
    DIRECTIONS,
    TILE,
    Raster,
    mark_tiles,
    measure_tiles,
    paint_roads,
    passes,
    passing,
)

X0, Y0, CELL, REACH, TURN = -700.0, 300.0, 5.0, 7.0, math.radians(20)


def drawn(segments, tiles=(4, 5)):
    """Draw segments on a raster of some tiles."""
    segments = np.asarray(segments, np.float32).reshape(-1, 4)
    tile_of = np.full(tiles, 99, np.int32)
    n = mark_tiles(segments, X0, Y0, CELL, REACH, tile_of)
    bits = np.zeros((n + 1, TILE, TILE), np.uint16)
    paint_roads(segments, X0, Y0, CELL, REACH, TURN, tile_of, bits)
    return segments, Raster(tile_of, bits, CELL)


def town(seed, n=12):
    rng = np.random.default_rng(seed)
    low, high = (X0 + 350, Y0 + 350), (X0 + 4 * 320, Y0 + 3 * 320)
    return drawn(rng.uniform(low, high, (n, 2, 2)).reshape(n, 4))


@pytest.mark.parametrize("seed", range(3))
def test_cells_near_a_road_hold_its_direction(seed):
    segments, raster = town(seed)
    rng = np.random.default_rng(seed)
    near = segments[rng.integers(len(segments), size=200), :2] + rng.uniform(-20, 20, (200, 2))
    cells = np.concatenate([((near - (X0, Y0)) / CELL).astype(int), rng.integers(0, (320, 256), (200, 2))])
    for column, row in cells:
        expected = naive.bits_at(row, column, segments, X0, Y0, CELL, REACH, TURN)
        assert naive.word_at(row, column, raster.tile_of, raster.bits) == expected
        assert passing(column + 0.3, row + 0.9, raster) == expected
        for d in range(DIRECTIONS):
            assert passes(column + 0.3, row + 0.9, d, raster) == expected >> d & 1


def test_only_tiles_with_roads_are_stored():
    _, raster = drawn([X0 + 400, Y0 + 400, X0 + 500, Y0 + 400])
    assert sorted(raster.tile_of.ravel()) == [0] * 19 + [1]
    assert len(raster.bits) == 2
    assert not raster.bits[0].any()


def test_no_roads():
    _, raster = drawn(np.empty((0, 4)))
    assert not raster.tile_of.any()
    assert not passes(100.0, 100.0, 3, raster)


def test_a_segment_of_no_length_has_no_direction():
    assert not drawn([X0 + 400, Y0 + 400, X0 + 400, Y0 + 400])[1].bits.any()


def test_density_is_the_share_of_bits_around():
    _, raster = town(1)
    out = np.empty(raster.tile_of.shape, np.float32)
    measure_tiles(raster, out)
    whole = raster.bits[raster.tile_of].transpose(0, 2, 1, 3).reshape(4 * TILE, 5 * TILE)
    around = whole[0 : 3 * TILE, TILE : 4 * TILE]
    assert out[1, 2] == pytest.approx(np.bitwise_count(around).sum() / around.size / DIRECTIONS, rel=1e-5)
    corner = whole[: 2 * TILE, : 2 * TILE]
    assert out[0, 0] == pytest.approx(np.bitwise_count(corner).sum() / corner.size / DIRECTIONS, rel=1e-5)
