"""Pixels and the query plane."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from roadgeo.geometry.homography import Homography
from roadgeo.geometry.mask import PIXEL_TO_PLANE, RoadMask, pixel_to_plane, plane_to_pixel

pairs = st.lists(st.tuples(st.floats(-1e5, 1e5), st.floats(-1e5, 1e5)), max_size=5)


@given(pairs)
def test_there_and_back(pixels):
    xy = np.array(pixels, float).reshape(-1, 2)
    assert np.array_equal(plane_to_pixel(pixel_to_plane(xy)), xy)
    assert np.allclose(Homography(PIXEL_TO_PLANE)(xy), pixel_to_plane(xy))


def test_rows_run_down_and_y_runs_up():
    assert pixel_to_plane(np.array([3.5, 10.5])).tolist() == [3.5, -10.5]
    assert np.array_equal(PIXEL_TO_PLANE @ PIXEL_TO_PLANE, np.eye(3))
    assert not PIXEL_TO_PLANE.flags.writeable


def test_a_mask_knows_its_frame():
    mask = RoadMask(np.zeros((20, 30), bool))
    assert mask.shape == (20, 30)
    assert mask.corners.tolist() == [[0, 0], [30, 0], [30, 20], [0, 20]]
