"""Poses of simulated cameras whose place is known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from roadgeo.geometry.pinhole import make_view
from roadgeo.geometry.pose import CornerTargets, Pose, find_pose, fit_pinhole, pinhole_residuals, turned

SIZE = (1200, 900)
FOCAL = 1000.0


def view_of(tilt: float, azimuth: float = 70.0, heading: float = 30.0, gsd: float = 0.5):
    """(homography, camera position, optical axis) of a view: the axis leaves the eye `FOCAL` pixels from the middle."""
    view = make_view((500.0, -300.0), SIZE, gsd, tilt, azimuth, heading, FOCAL)
    lean, way = np.radians([tilt, azimuth])
    axis = np.array([np.sin(lean) * np.sin(way), np.sin(lean) * np.cos(way), -np.cos(lean)])
    return view.homography.matrix, np.array([500.0, -300.0, 0.0]) - FOCAL * gsd * axis, axis


@pytest.mark.parametrize("tilt", [0.0, 5.0, 20.0, 45.0])
@pytest.mark.parametrize("heading", [-170.0, 10.0])
def test_a_known_camera_is_found_exactly(tilt: float, heading: float) -> None:
    homography, position, axis = view_of(tilt, heading=heading)
    found = find_pose(homography, SIZE, 0.04 * np.eye(8), FOCAL)
    assert found is not None
    assert found.source == "camera"
    assert found.position == pytest.approx(position, abs=1e-3)
    assert found.rotation @ (0, 0, -1) == pytest.approx(axis, abs=1e-6)
    assert found.tilt_deg == pytest.approx(tilt, abs=1e-4)
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)


@pytest.mark.parametrize("tilt", [20.0, 35.0, 50.0])
def test_tilt_tells_an_unknown_focal_length(tilt: float) -> None:
    homography, position, _ = view_of(tilt)
    found = find_pose(homography, SIZE, 1e-4 * np.eye(8))
    assert found is not None
    assert found.source == "homography"
    assert found.focal_px == pytest.approx(FOCAL, rel=0.01)
    assert found.position == pytest.approx(position, abs=6.0)


def test_straight_down_an_unknown_focal_length_is_assumed_and_the_height_is_as_unsure() -> None:
    homography, position, _ = view_of(0.0)
    found = find_pose(homography, SIZE, 0.04 * np.eye(8))
    assert found is not None
    assert found.source == "assumed"
    assert found.focal_sigma_px / found.focal_px == pytest.approx(0.45, rel=0.1)
    assert np.sqrt(found.covariance[2, 2]) / found.position[2] == pytest.approx(0.45, rel=0.1)
    assert found.position[:2] == pytest.approx(position[:2], abs=1e-2)


@pytest.mark.parametrize("tilt", [0.0, 0.5, 3.0])
@pytest.mark.parametrize("spread", [0.01, 0.3])
def test_a_focal_length_that_the_homography_does_not_tell_is_the_usual_one(tilt: float, spread: float) -> None:
    homography, position, _ = view_of(tilt)
    found = find_pose(homography, SIZE, spread**2 * np.eye(8))
    assert found is not None
    away = (np.log(FOCAL) - np.log(found.focal_px)) / (found.focal_sigma_px / found.focal_px)
    assert abs(away) < 1.0  # 1125, usual here, is a quarter of a standard deviation away
    if tilt == 0.0:
        assert found.focal_px == pytest.approx(1125.0, rel=1e-3)
        assert found.position[2] == pytest.approx(position[2] * 1.125, rel=1e-3)


@pytest.mark.parametrize("focal_px", [FOCAL, None])
def test_its_covariance_is_that_of_many_trials(focal_px: float | None) -> None:
    homography, position, _ = view_of(35.0)
    import cv2

    from roadgeo.geometry.frame import Frame
    from roadgeo.geometry.homography import Homography

    rng = np.random.default_rng(0)
    corners, spread = Homography(homography)(Frame(*SIZE).corners), 0.2
    errors = []
    for _ in range(40):
        shaken = corners + rng.normal(0, spread, (4, 2)) - corners[0]
        matrix = cv2.getPerspectiveTransform(Frame(*SIZE).corners.astype(np.float32), shaken.astype(np.float32))
        matrix = np.array([[1, 0, corners[0, 0]], [0, 1, corners[0, 1]], [0, 0, 1]]) @ matrix
        found = find_pose(matrix, SIZE, spread**2 * np.eye(8), focal_px)
        assert found is not None
        errors.append((found.position - position) / np.sqrt(np.diag(found.covariance)[:3]))
    assert 0.75 < np.sqrt(np.mean(np.square(errors))) < 1.3


def pose_of(heading: float, pitch: float, roll: float) -> Pose:
    """A camera under an aircraft of these angles: scipy turns north, east, down."""
    body = Rotation.from_euler("ZYX", [heading, pitch, roll], degrees=True).as_matrix()
    to_enu = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    to_body = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])  # the image's top is ahead, its right is right
    return Pose(np.zeros(3), to_enu @ body @ to_body, np.eye(6), 1.0, 0.0, "camera")


@pytest.mark.parametrize("angles", [(0, 0, 0), (100, 10, -20), (-50, -40, 5), (179, 5, 44)])
def test_angles_are_those_of_scipy(angles: tuple[float, float, float]) -> None:
    pose = pose_of(*angles)
    assert pose.angles_deg == pytest.approx(angles, abs=1e-9)


def test_another_north_changes_the_heading_only() -> None:
    pose = pose_of(100.0, 10.0, -20.0)
    moved = Pose(pose.position, turned(pose.rotation, 3.0), pose.covariance, 1.0, 0.0, "camera")
    assert moved.angles_deg == pytest.approx((97.0, 10.0, -20.0), abs=1e-9)


def test_no_camera_sees_a_mirrored_or_broken_frame() -> None:
    homography, _, _ = view_of(20.0)
    assert find_pose(np.diag([-1.0, 1.0, 1.0]) @ homography, SIZE, np.eye(8), FOCAL) is None


def test_a_pinhole_that_sees_the_sky_is_no_start() -> None:
    corners = np.array([[-600.0, 450.0], [600.0, 450.0], [600.0, -450.0], [-600.0, -450.0]])
    seen = CornerTargets(corners, np.zeros((4, 2)), np.eye(8), np.log(FOCAL), 0.45)
    sky, ground = ([0.0, 0.0, 0.0, 0.0, tilt, 0.0, np.log(FOCAL)] for tilt in (1.5, 0.3))
    assert np.isinf(pinhole_residuals(np.array(sky), seen)).all()
    assert fit_pinhole(np.array([sky]), seen) is None
    assert fit_pinhole(np.array([sky, ground]), seen) is not None
