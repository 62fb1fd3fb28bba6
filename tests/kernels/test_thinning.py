"""Thinning keeps every connection, and nothing that could go."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from naive import thinning as naive
from scipy import ndimage

from roadgeo.kernels.thinning import GROUND, ROAD, SOLID, shallow_first, thin

#: Steps to neighbours are unsigned, modulo 2**64; without compilation numpy warns where they wrap.
pytestmark = pytest.mark.filterwarnings("ignore:overflow encountered in scalar add:RuntimeWarning")


def framed(picture: str) -> np.ndarray:
    """States of a drawing: "#" road, "." ground, "x" solid; with a ring of solid around it."""
    rows = [line.strip() for line in picture.split()]
    inner = np.array([[{".": GROUND, "#": ROAD, "x": SOLID}[c] for c in row] for row in rows], np.uint8)
    return np.pad(inner, 1, constant_values=SOLID)


def depth(states: np.ndarray) -> np.ndarray:
    return cv2.distanceTransform((states != GROUND).view(np.uint8), cv2.DIST_L2, 5)


def thin_all(states: np.ndarray, min_end_depth: float) -> np.ndarray:
    """Thin all roads, in place; return the pixels left."""
    return thin(states, depth(states), shallow_first(states, depth(states)), min_end_depth, True)


def thinned(states: np.ndarray, min_end_depth: float = 1.0) -> np.ndarray:
    left = states.copy()
    pixels = thin_all(left, min_end_depth)
    assert sorted(pixels) == np.flatnonzero(left == ROAD).tolist()
    return left


@st.composite
def random_states(draw: st.DrawFn) -> np.ndarray:
    """Blobs of any shape, some with unobserved ground."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    size = draw(st.tuples(st.integers(1, 24), st.integers(1, 24)))
    smooth = ndimage.gaussian_filter(rng.standard_normal(size), draw(st.sampled_from([0.0, 0.7, 1.5])))
    states = (smooth > np.quantile(smooth, draw(st.sampled_from([0.3, 0.6, 0.8])))).astype(np.uint8)
    if draw(st.booleans()):
        states[ndimage.gaussian_filter(rng.standard_normal(size), 3.0) > 0.1] = SOLID
    return np.pad(states, 1, constant_values=SOLID)


@given(random_states(), st.sampled_from([0.0, 1.0, 1.5, 3.0]))
def test_thin_equals_its_slow_twin(states: np.ndarray, min_end_depth: float) -> None:
    expected = states.copy()
    left = naive.thin(expected, depth(states), min_end_depth)
    actual = states.copy()
    assert sorted(thin_all(actual, min_end_depth)) == sorted(left)
    np.testing.assert_array_equal(actual, expected)


@pytest.mark.parametrize(
    ("picture", "expected"),
    [
        ("..... ..... ..#.. ..... .....", "..... ..... ..#.. ..... ....."),  # a lone pixel stays: there is a road
        ("......... ......... ..#####.. ......... .........", "......... ......... ..#####.. ......... ........."),
        ("....... ####### ####### ####### .......", "....... ....... ####### ....... ......."),  # meets the frame
        ("#....", "....."),  # part of what lies beyond the frame
        ("xx#.. xx##. xx#..", "xx... xx... xx..."),
        ("", ""),
    ],
)
def test_small_pictures(picture: str, expected: str) -> None:
    if picture:
        np.testing.assert_array_equal(thinned(framed(picture)), framed(expected))
    else:
        assert len(thin_all(np.full((2, 2), SOLID, np.uint8), 1.0)) == 0


def test_a_bump_leaves_no_hair_but_a_road_keeps_its_end() -> None:
    states = np.full((42, 62), SOLID, np.uint8)
    states[1:-1, 1:-1] = GROUND
    states[18:25, 8:54] = ROAD  # a road 7 wide
    states[14:18, 30:32] = ROAD  # a bump 2 wide
    left = thinned(states, 0.25 * 7)
    rows, columns = np.nonzero(left == ROAD)
    assert set(rows[(columns > 12) & (columns < 49)]) == {21}
    assert len(rows) == np.ptp(columns) + 1
    assert columns.min() <= 11
    assert columns.max() >= 50


@pytest.mark.parametrize("width", range(2, 10))
@pytest.mark.parametrize("turns", range(4))
def test_a_road_of_even_width_is_not_eaten_from_its_end(width: int, turns: int) -> None:
    states = np.full((42, 42), SOLID, np.uint8)
    states[1:-1, 1:-1] = GROUND
    states[20 : 20 + width, 10:41] = ROAD  # from the frame to a free end
    left = thinned(np.ascontiguousarray(np.rot90(states, turns)), 0.25 * width)
    assert 31 - width / 2 - 1 <= np.count_nonzero(left == ROAD) <= 31


def test_stale_and_repeated_pixels_are_taken() -> None:
    states = framed("..... .###. ..#.. .....")
    pixels = np.flatnonzero(states == ROAD).astype(np.int32)
    states.ravel()[pixels[0]] = GROUND
    left = thin(states, depth(states), np.concatenate((pixels, pixels)), 0.0, False)
    assert set(left) == set(np.flatnonzero(states == ROAD))
