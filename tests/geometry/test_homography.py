"""Homographies: algebra as properties."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from roadgeo.geometry.homography import Homography, map_each

POINTS = np.array([[0.0, 0.0], [1.0, 2.0], [-1.5, 0.5], [2.0, -2.0]])


@st.composite
def homographies(draw):
    """Regular ones with w > 0 over POINTS."""
    numbers = st.floats(-2, 2)
    matrix = np.array([draw(numbers) for _ in range(9)]).reshape(3, 3) * np.array([[1], [1], [0.15]])
    matrix[2, 2] = draw(st.floats(1.5, 3))
    assume(abs(np.linalg.det(matrix)) > 0.1)
    return Homography(matrix)


@given(homographies())
def test_the_inverse_undoes(H):
    assert np.allclose(H.inverse()(H(POINTS)), POINTS, atol=1e-6)
    assert np.allclose((H.inverse() @ H).matrix, np.eye(3), atol=1e-9)


@given(homographies(), homographies())
def test_composition_is_one_after_the_other(A, B):
    between = B(POINTS)
    inside = between @ A.matrix[2, :2] + A.matrix[2, 2] > 0.05
    assert np.allclose((A @ B)(POINTS)[inside], A(between)[inside], rtol=1e-6, atol=1e-6)


@given(homographies())
def test_the_jacobian_is_the_limit_of_differences(H):
    step = 1e-5
    for k, move in enumerate(step * np.eye(2)):
        difference = (H(POINTS + move) - H(POINTS - move)) / (2 * step)
        assert np.allclose(H.jacobian(POINTS)[..., k], difference, rtol=1e-4, atol=1e-4)


@given(homographies(), st.floats(-3, 3).filter(lambda s: abs(s) > 0.1))
def test_multiples_are_the_same_map(H, scale):
    facing = Homography(scale * H.matrix).facing(POINTS[0])
    assert np.allclose(facing(POINTS), H(POINTS))
    assert np.allclose(Homography(scale * H.matrix).normalised().matrix, H.normalised().matrix)
    assert H.normalised().matrix[2, 2] == pytest.approx(1)


def test_shapes_are_kept():
    H = Homography(np.eye(3))
    for shape in [(2,), (0, 2), (4, 2), (3, 5, 2)]:
        assert H(np.zeros(shape)).shape == shape
        assert H.jacobian(np.zeros(shape)).shape == (*shape, 2)


@pytest.mark.parametrize("w", [0.0, -1.0])
def test_beyond_the_horizon_there_is_no_image(w):
    mapped = Homography(np.array([[1, 0, 0], [0, 1, 0], [0, 1.0, w]]))(np.array([[3.0, 0.0], [3.0, 2.0]]))
    assert np.isnan(mapped[0]).all()
    assert np.isnan(mapped[1]).all() == (2.0 + w <= 0)


def test_a_last_element_of_zero_is_left_alone():
    matrix = np.array([[1.0, 0, 0], [0, 1, 0], [0, 1, 0]])
    assert np.array_equal(Homography(matrix).normalised().matrix, matrix)


@given(homographies())
def test_derivatives_by_elements_are_the_limits_of_differences(H):
    step = 1e-6
    derivatives = H.by_elements(POINTS)
    assert derivatives.shape == (len(POINTS), 2, 8)
    for k in range(8):
        moved = step * np.eye(9)[k].reshape(3, 3)
        difference = (Homography(H.matrix + moved)(POINTS) - Homography(H.matrix - moved)(POINTS)) / (2 * step)
        assert np.allclose(derivatives[..., k], difference, rtol=1e-3, atol=1e-3)


def test_everywhere_maps_what_lies_beyond_the_horizon_too():
    H = Homography(np.array([[2.0, 0, 0], [0, 1, 0], [0, 1, -1]]))
    points = np.array([[3.0, 0.0], [3.0, 3.0]])
    assert H.everywhere(points).tolist() == [[-6.0, 0.0], [3.0, 1.5]]
    assert H.ahead(points).tolist() == [False, True]
    assert H.facing(points[0]).matrix.tolist() == (-H.matrix).tolist()
    assert H.facing(points[1]) is H


@given(homographies(), homographies())
def test_each_maps_its_own_points(A, B):
    points = np.stack([POINTS, POINTS[::-1]])
    mapped = map_each(np.stack([A.matrix, B.matrix]), points)
    assert np.allclose(mapped, [A(points[0]), B(points[1])])


def test_areas_become_larger_by_the_determinant_of_the_jacobian():
    matrix = np.array([[1.5, 0.2, 3.0], [-0.4, 0.8, 1.0], [0.001, -0.002, 1.0]])
    expected = np.linalg.det(Homography(matrix).jacobian(np.array([40.0, -30.0])))
    assert Homography(matrix).area_scale(40.0, -30.0) == pytest.approx(expected)
    assert Homography(matrix @ np.diag([1.0, -1.0, 1.0])).area_scale(40.0, 30.0) == pytest.approx(-expected)
    assert Homography(np.diag([1.0, 1.0, 0.0])).area_scale(0.0, 0.0) == np.inf
