import numpy as np

from roadgeo.geometry.frame import Frame


def test_the_points_of_a_frame():
    frame = Frame(4, 3)
    assert frame.corners.tolist() == [[0, 0], [4, 0], [4, 3], [0, 3]]
    assert frame.center.tolist() == [2, 1.5]
    assert frame.half_diagonal == 2.5
    np.testing.assert_array_equal(frame.plane_corners, frame.corners * [1, -1])
    assert frame.plane_center.tolist() == [2, -1.5]
