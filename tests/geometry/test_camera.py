"""Cameras whose pose is known."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from worlds.scenes import camera

from roadgeo.geometry.camera import _USUAL_FOCAL, CameraFault, CameraOptions, judge, pose, sampling

SIZE = (1200, 900)
OPTIONS = CameraOptions()

tilts = st.floats(0, 50)
turns = st.floats(0, 360)


def angle_between(a, b):
    return abs((a - b + 180) % 360 - 180)


@given(gsd=st.floats(0.25, 4.5), heading=turns, focal=st.floats(600, 5000))
def test_straight_down(gsd, heading, focal):
    seen = pose(camera((500, 700), SIZE, gsd, 0.0, 0.0, heading, focal), SIZE)
    assert seen.gsd_m == pytest.approx(gsd)
    assert angle_between(seen.rotation_deg, heading) < 1e-6
    assert seen.tilt_deg < 1e-3
    assert seen.skew < 1e-9
    assert judge(camera((500, 700), SIZE, gsd, 0.0, 0.0, heading, focal), SIZE, OPTIONS) is None


@given(tilt=st.floats(0.5, 60), azimuth=turns, heading=turns, focal=st.floats(700, 4000), gsd=st.floats(0.3, 4))
def test_tilt_of_a_known_focal_length(tilt, azimuth, heading, focal, gsd):
    seen = pose(camera((-3000, 90), SIZE, gsd, tilt, azimuth, heading, focal), SIZE, focal)
    assert seen.tilt_deg == pytest.approx(tilt, abs=1e-3)
    assert seen.focal_px == focal
    assert seen.skew < 1e-6
    # Across the axis a pixel covers `gsd`, along it 1 / cos(tilt) more: the root of the area lies between.
    assert seen.gsd_m == pytest.approx(gsd / np.sqrt(np.cos(np.radians(tilt))), rel=1e-6)


@pytest.mark.parametrize("focal", [700.0, 1200.0, 2500.0])
@pytest.mark.parametrize("tilt", [20.0, 35.0, 50.0])
def test_tilt_and_focal_length_where_neither_is_known(tilt, focal):
    errors = []
    for azimuth in (10, 130, 250):
        matrix = camera((0, 0), SIZE, 1.0, tilt, azimuth, 77.0, focal)
        seen = pose(matrix, SIZE)
        errors.append(abs(seen.tilt_deg - tilt))
        assert seen.focal_px == pytest.approx(focal, rel=0.12)
        assert seen.skew < 0.05
    assert max(errors) < 3


def test_near_the_nadir_a_lens_is_assumed():
    assert pose(camera((0, 0), SIZE, 1.0, 3.0, 10.0, 20.0, 1000.0), SIZE).source == "assumed"
    assert pose(camera((0, 0), SIZE, 1.0, 35.0, 10.0, 20.0, 1000.0), SIZE).source == "homography"
    assert pose(camera((0, 0), SIZE, 1.0, 35.0, 10.0, 20.0, 1000.0), SIZE, 1000.0).source == "camera"


@given(scale=st.floats(-50, 50).filter(lambda s: abs(s) > 1e-3), tilt=tilts, azimuth=turns)
def test_a_homography_and_its_multiples_are_the_same(scale, tilt, azimuth):
    matrix = camera((100, 50), SIZE, 1.2, tilt, azimuth, 30.0, 1500.0)
    first, other = pose(matrix, SIZE), pose(scale * matrix, SIZE)
    assert first.gsd_m == pytest.approx(other.gsd_m)
    assert first.tilt_deg == pytest.approx(other.tilt_deg, abs=1e-3)
    assert angle_between(first.rotation_deg, other.rotation_deg) < 1e-6
    assert judge(scale * matrix, SIZE, OPTIONS) is judge(matrix, SIZE, OPTIONS) is None


@given(tilt=st.floats(0, 60), azimuth=turns, heading=turns, focal=st.floats(0.8, 6), gsd=st.floats(0.25, 3))
def test_every_camera_within_the_options_is_plausible(tilt, azimuth, heading, focal, gsd):
    half_angle = np.degrees(np.arctan(0.5 * np.hypot(*SIZE) / (focal * SIZE[0])))
    if tilt + half_angle < 85:
        matrix = camera((10, 20), SIZE, gsd, tilt, azimuth, heading, focal * SIZE[0])
        assert judge(matrix, SIZE, OPTIONS) is None
        assert judge(matrix, SIZE, replace(OPTIONS, focal_px=focal * SIZE[0])) is None


def test_what_is_not_plausible():
    matrix = camera((0, 0), SIZE, 1.0, 30.0, 40.0, 50.0, 1200.0)
    mirror = np.array([[-1, 0, SIZE[0]], [0, 1, 0], [0, 0, 1.0]])
    stretch = np.array([[1, 0, 0], [0, 2.2, 0], [0, 0, 1.0]])
    assert judge(matrix @ mirror, SIZE, OPTIONS) is CameraFault.MIRRORED
    assert judge(-matrix @ mirror, SIZE, OPTIONS) is CameraFault.MIRRORED
    assert judge(camera((0, 0), SIZE, 1.0, 75.0, 0.0, 0.0, 1000.0), SIZE, OPTIONS) is CameraFault.HORIZON
    assert judge(camera((0, 0), SIZE, 15.0), SIZE, OPTIONS) is CameraFault.SAMPLING
    assert judge(camera((0, 0), SIZE, 0.05), SIZE, OPTIONS) is CameraFault.SAMPLING
    assert judge(stretch @ camera((0, 0), SIZE, 0.7), SIZE, OPTIONS) is CameraFault.SKEW
    assert judge(camera((0, 0), SIZE, 1.0, 50.0, 0.0, 0.0, 4000.0), SIZE, CameraOptions(max_tilt_deg=30.0)) is (
        CameraFault.TILT
    )


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf])
def test_what_is_no_homography(value):
    assert judge(np.full((3, 3), value), SIZE, OPTIONS) is CameraFault.DEGENERATE
    assert judge(np.array([[1.0, 0, 0], [1, 0, 0], [0, 0, 1]]), SIZE, OPTIONS) is not None


def test_a_known_focal_length_refuses_what_another_lens_saw():
    matrix = camera((0, 0), SIZE, 1.0, 45.0, 0.0, 0.0, 900.0)
    assert judge(matrix, SIZE, replace(OPTIONS, focal_px=900.0)) is None
    assert judge(matrix, SIZE, replace(OPTIONS, focal_px=9000.0)) is CameraFault.SKEW


@pytest.mark.parametrize("focal", [600.0, 1500.0, 6000.0])
def test_a_vertical_view_is_within_any_tilt_whatever_the_lens(focal):
    """Near the nadir every focal length fits, and a long one makes tilt of any error: no bound may hang on it."""
    rng = np.random.default_rng(int(focal))
    for _ in range(20):
        matrix = camera((0, 0), SIZE, 1.0, 2.0, rng.uniform(0, 360), rng.uniform(0, 360), focal)
        matrix = matrix / matrix[2, 2]
        matrix[2, :2] += rng.normal(0.0, 2e-5, 2)  # corners off by some metres
        assert judge(matrix, SIZE, CameraOptions(max_tilt_deg=5.0)) is None


@pytest.mark.parametrize(("rough", "slack_deg", "slack"), [(False, 5.0, 1.0), (True, 15.0, 1.25)])
def test_limits_are_where_they_are_said_to_be(rough, slack_deg, slack):
    def fault(matrix, **options):
        return judge(matrix, SIZE, CameraOptions(**options), rough)

    for tilt, expected in [(30.0 + slack_deg - 0.2, None), (30.0 + slack_deg + 0.2, CameraFault.TILT)]:
        seen = camera((0, 0), SIZE, 1.0, tilt, 20.0, 60.0, 3000.0)
        assert fault(seen, max_tilt_deg=30.0, focal_px=3000.0) is expected
    for gsd in (0.5 / slack * 0.99, 1.5 * slack * 1.01):
        assert fault(camera((0, 0), SIZE, gsd), gsd_m=(0.5, 1.5)) is CameraFault.SAMPLING
    for gsd in (0.5 / slack * 1.01, 1.5 * slack * 0.99):
        assert fault(camera((0, 0), SIZE, gsd), gsd_m=(0.5, 1.5)) is None
    for heading, expected in [(slack_deg - 0.1, None), (slack_deg + 0.1, CameraFault.HEADING)]:
        assert fault(camera((0, 0), SIZE, 1.0, 0.0, 0.0, heading), north_up=True) is expected
        assert fault(camera((0, 0), SIZE, 1.0, 0.0, 0.0, -heading), north_up=True) is expected
    for stretch, expected in [(0.34, None), (0.36, None if rough else CameraFault.SKEW)]:
        assert fault(np.diag([1.0, np.exp(stretch), 1.0])) is expected


@pytest.mark.parametrize("lean", [(-1, 0), (1, 0), (0, -1), (0, 1), (-0.5, -0.5), (-0.5, 0.5), (0.5, -0.5), (0.5, 0.5)])
def test_the_horizon_must_not_come_too_near_to_a_corner(lean):
    """The least w over the frame is at least a twentieth of that in its middle."""
    for least, too_near in [(0.049, True), (0.051, False)]:
        about_middle = np.eye(3)
        about_middle[2, :2] = 2.0 * np.array(lean) * (1.0 - least) / np.array(SIZE)  # w = 1 in the middle
        matrix = about_middle @ np.array([[1.0, 0, -SIZE[0] / 2], [0, 1, SIZE[1] / 2], [0, 0, 1]])
        assert (judge(matrix, SIZE, OPTIONS) is CameraFault.HORIZON) is too_near


def test_a_middle_on_the_horizon_is_degenerate():
    assert judge(np.array([[1.0, 0, 0], [0, 1, 0], [1, 0, -600]]), SIZE, OPTIONS) is CameraFault.DEGENERATE


@pytest.mark.parametrize("rough", [False, True])
def test_a_frame_that_has_shrunk_to_a_point_is_degenerate_for_every_camera(rough):
    anything = CameraOptions(gsd_m=(0.0, np.inf), max_tilt_deg=180.0, max_skew=np.inf)
    point = np.array([[4e-17, 8e-17, -3171.0], [-7e-17, -6e-17, -231.0], [0.0, 0.0, 1.0]])
    assert judge(point, SIZE, anything, rough) is CameraFault.DEGENERATE
    assert judge(np.diag([1e-2, 1e-2, 1.0]), SIZE, anything, rough) is None


def test_skew_is_the_greater_of_shear_and_stretch():
    assert pose(np.diag([1.0, 2.2, 1.0]), SIZE).skew == pytest.approx(np.log(2.2))
    assert pose(np.diag([2.2, 1.0, 1.0]), SIZE).skew == pytest.approx(np.log(2.2))
    sheared = pose(np.array([[1.0, 0.3, 0], [0, 1, 0], [0, 0, 1]]), SIZE)
    assert sheared.skew == pytest.approx(0.3 / np.sqrt(1.09))
    assert sheared.gsd_m == pytest.approx(1.0)


def test_a_lens_is_assumed_to_be_a_usual_one():
    usual = pose(camera((0, 0), SIZE, 1.0), SIZE)
    assert usual.source == "assumed"
    assert usual.focal_px == pytest.approx(_USUAL_FOCAL * np.hypot(*SIZE) / 2, rel=0.1)


def test_what_is_known_of_the_tilt_in_figures():
    assert CameraOptions(max_tilt_deg=0.0).min_shape_ratio == pytest.approx(0.85 * np.cos(np.radians(25.0)))
    assert CameraOptions(max_tilt_deg=30.0).min_shape_ratio == pytest.approx(0.85 * np.cos(np.radians(55.0)))
    assert CameraOptions(max_tilt_deg=89.0).min_shape_ratio == 0.33
    assert CameraOptions(max_tilt_deg=5.0).perspective_sigma(9.0) == pytest.approx(0.03 + 0.7 * np.tan(np.radians(5)))
    assert CameraOptions(max_tilt_deg=89.0).perspective_sigma(9.0) == pytest.approx(0.03 + 0.7 * np.tan(np.radians(80)))


@given(tilt=tilts, azimuth=turns, heading=turns)
def test_up_and_sampling_are_those_in_the_middle_of_the_frame(tilt, azimuth, heading):
    matrix = camera((0, 0), SIZE, 1.0, tilt, azimuth, heading, 1000.0)
    middle = np.array([SIZE[0] / 2, -SIZE[1] / 2])
    ends = [matrix @ (*(middle + step), 1.0) for step in ((0.0, -1e-3), (0.0, 1e-3), (-1e-3, 0.0), (1e-3, 0.0))]
    down, up, left, right = (end[:2] / end[2] for end in ends)
    seen = pose(matrix, SIZE)
    assert angle_between(seen.rotation_deg, np.degrees(np.arctan2(*(up - down)))) < 1e-3
    area = abs(np.linalg.det([(right - left) / 2e-3, (up - down) / 2e-3]))
    assert seen.gsd_m == pytest.approx(np.sqrt(area), rel=1e-5)
    assert sampling(matrix, SIZE) == seen.gsd_m
