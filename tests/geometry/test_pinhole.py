"""Pinhole views: where rays meet the ground."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from roadgeo.geometry.frame import polygon_area
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.pinhole import make_view, sees_ground, warp_mask

CENTER = (1000.0, 2000.0)


def test_a_view_from_above_is_a_scaled_north_up_map():
    view = make_view(CENTER, (200, 100), 0.5)
    assert view.footprint == pytest.approx(np.array([[950, 2025], [1050, 2025], [1050, 1975], [950, 1975]]))
    assert view.homography(np.array([0.5, 0.5])) == pytest.approx([950.25, 2024.75])


@pytest.mark.parametrize(("heading", "up"), [(0, (0, 1)), (90, (1, 0)), (180, (0, -1)), (270, (-1, 0))])
def test_the_image_up_points_to_the_heading(heading, up):
    view = make_view(CENTER, (100, 100), 1.0, heading_deg=heading)
    step = view.homography(np.array([50.0, 49.0])) - CENTER
    assert step == pytest.approx(up, abs=1e-9)


angles = st.floats(0, 360)


@given(tilt=st.floats(0, 60), azimuth=angles, heading=angles, gsd=st.floats(0.1, 5), focal=st.floats(100, 1000))
def test_a_view_is_the_projection_of_its_camera(tilt, azimuth, heading, gsd, focal):
    view = make_view(CENTER, (120, 80), gsd, tilt, azimuth, heading, focal)
    middle = np.array([60.0, 40.0])
    assert view.homography(middle) == pytest.approx(CENTER)
    jacobian = view.homography.jacobian(middle)
    assert np.linalg.det(jacobian) < 0  # pixel rows run down
    # Across the axis a pixel covers gsd metres, along the tilt gsd / cos(tilt).
    assert np.linalg.svd(jacobian, compute_uv=False) == pytest.approx([gsd / np.cos(np.radians(tilt)), gsd])
    ahead = jacobian @ [0, -1]
    assert ahead / np.hypot(*ahead) == pytest.approx(
        [np.sin(np.radians(heading)), np.cos(np.radians(heading))], abs=1e-9
    )
    assert float(view.sampling(middle)) == pytest.approx(gsd / np.sqrt(np.cos(np.radians(tilt))))


def test_a_warped_mask_shows_what_its_matrix_says():
    mask = np.zeros((200, 300), np.uint8)
    mask[80:100, 180:200] = 255
    warped, matrix = warp_mask(mask, 25.0, 70.0, 30.0)
    rows, columns = np.nonzero(warped)
    source = np.column_stack([columns + 0.5, rows + 0.5, np.ones(len(rows))]) @ matrix.T
    source = source[:, :2] / source[:, 2:]
    assert source.min(axis=0) == pytest.approx([180, 80], abs=1.5)
    assert source.max(axis=0) == pytest.approx([200, 100], abs=1.5)


@pytest.mark.parametrize(
    ("heading", "up"), [(0, (0, -1)), (90, (1, 0)), (180, (0, 1)), (270, (-1, 0)), (30, (0.5, -0.866))]
)
def test_a_mask_is_warped_as_a_camera_sees_it(heading, up):
    """From the middle of the frame, its up runs over the mask towards the heading; the tilt sees farther."""
    _, matrix = warp_mask(np.zeros((200, 300), np.uint8), 25.0, 70.0, heading)
    view, middle = Homography(matrix), np.array([150.0, 100.0])
    assert view(middle) == pytest.approx(middle)
    jacobian = view.jacobian(middle)
    ahead = jacobian @ [0, -1]
    assert ahead / np.hypot(*ahead) == pytest.approx(up, abs=1e-3)
    assert np.linalg.det(jacobian) > 0  # not mirrored
    assert np.linalg.svd(jacobian, compute_uv=False) == pytest.approx([1 / np.cos(np.radians(25)), 1])


def test_a_mask_warped_by_nothing_stays():
    mask = np.where(np.arange(60 * 40).reshape(40, 60) % 7 == 0, 255, 0).astype(np.uint8)
    warped, matrix = warp_mask(mask, 0.0, 0.0, 0.0)
    assert np.array_equal(warped, mask)
    assert matrix / matrix[2, 2] == pytest.approx(np.eye(3), abs=1e-12)


def test_the_ray_to_the_corner_decides_whether_the_ground_is_seen():
    """A corner 50 pixels up and aside of a lens of 100: its ray is 85 degrees from the vertical at 57.96 of tilt."""
    assert sees_ground(make_view(CENTER, (100, 100), 1.0, 57.8))
    assert not sees_ground(make_view(CENTER, (100, 100), 1.0, 58.1))


def test_w_is_one_in_the_middle_and_the_lens_as_long_as_the_frame():
    view = make_view(CENTER, (120, 80), 0.7, 35.0, 20.0, 50.0)
    assert view.focal_px == 120.0
    assert view.homography.matrix[2] @ (60.0, 40.0, 1.0) == pytest.approx(1.0)
    pixel = np.array([20.0, 70.0])
    area = abs(np.linalg.det(view.homography.jacobian(pixel)))
    assert float(view.sampling(pixel)) == pytest.approx(np.sqrt(area))


def test_areas_of_polygons():
    triangle = np.array([[1.0, 1.0], [5.0, 1.0], [1.0, 4.0]])
    assert polygon_area(triangle) == polygon_area(triangle[::-1]) == 6.0
    assert polygon_area(np.array([[0, 0], [4, 0], [4, 3], [0, 3], [0, 0]]) + 1e6) == 12
