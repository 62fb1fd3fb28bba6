"""Rings of bits around places, against slow twins."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from naive import road_votes as naive

from roadgeo.kernels.road_raster import TILE, Raster
from roadgeo.kernels.road_rings import BEARINGS, RINGS, WORDS, count_bits, draw_rings, mark_rings, turn_bits

words = st.integers(0, 2**64 - 1)


@given(words)
def test_bits_are_counted(word):
    with np.errstate(over="ignore"):
        assert count_bits.function(np.uint64(word)) == word.bit_count()


@given(words, st.integers(-200, 200))
def test_turning_moves_every_bit(word, n):
    expected = {(b + n) % BEARINGS for b in range(BEARINGS) if word >> b & 1}
    found = int(turn_bits.function(np.uint64(word), n))
    assert {b for b in range(BEARINGS) if found >> b & 1} == expected


@pytest.mark.parametrize("seed", range(3))
def test_rings_are_drawn_like_the_twin(seed):
    rng = np.random.default_rng(seed)
    bits = rng.integers(0, 2**16, (5, TILE, TILE), np.uint16) & rng.integers(0, 2**16, (5, TILE, TILE), np.uint16)
    bits[0] = 0
    tile_of = np.array([[0, 1, 2, 0], [3, 4, 0, 1], [1, 2, 3, 4], [0, 1, 4, 2]], np.int32)
    cells, radii = rng.uniform(64, 192, (3, 2)), np.geomspace(3, 60, RINGS)
    found = np.full((3, WORDS), 7, np.uint64)
    raster = Raster(tile_of, bits, 5.0)
    draw_rings(cells, np.array([2, 0]), radii, raster, found)
    assert (found[1] == 7).all()  # it was not asked for
    for j in (0, 2):
        assert np.array_equal(naive.bits_of(found[j]), naive.rings_around(*cells[j], radii, raster))


def test_points_are_marked_where_they_lie():
    rings, bearings = np.array([-3, 0, 5, RINGS - 1]), np.array([0.01, -0.01, 3.0, -3.0])
    along, own = np.array([1, 0, 1, 0]), np.array([0, 0, 1, 0])
    out = np.zeros((4, WORDS), np.uint64)
    mark_rings(rings, bearings, along, own, 7, out)
    for s in range(4):
        assert np.array_equal(naive.bits_of(out[s]), naive.marks_of(rings + s, bearings, along, own, 7, RINGS))
    assert naive.bits_of(out[3]).sum() == 3  # one came in, one went out
