"""Is a homography what a camera could have seen? Tilt, focal length and ground sampling of a plane under a pinhole."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from roadgeo.typing import FloatArray

__all__ = ["CameraOptions", "CameraPose", "judge", "pose", "sampling"]

_FOCAL_STEPS = np.geomspace(0.35, 8.0, 25)


@dataclass(frozen=True)
class CameraOptions:
    """What is known of the camera.

    Attributes
    ----------
    gsd_m : (low, high)
        Ground sampling at the middle of the frame, metres per pixel.
    max_tilt_deg : float
        Greatest angle between the optical axis and the vertical.
    focal_px : float or None
        Focal length, where it is known.
    max_skew : float
        How far the homography may be from that of any pinhole with square pixels whose axis meets the middle of the
        frame: the greater of |cos| of the angle between the images of two perpendicular unit vectors and the log of
        their lengths' ratio. A crop or a lens's distortion moves it from 0.
    north_up : bool
        The image's up is north, within 5 degrees.
    """

    gsd_m: tuple[float, float] = (0.2, 5.0)
    max_tilt_deg: float = 60.0
    focal_px: float | None = None
    max_skew: float = 0.35
    north_up: bool = False


@dataclass(frozen=True)
class CameraPose:
    """What a homography says of the camera.

    Attributes
    ----------
    gsd_m : float
        Ground sampling at the middle of the frame, metres per pixel.
    rotation_deg : float
        Direction of the image's up there, clockwise from north.
    tilt_deg, focal_px : float
        Of the pinhole that fits best: the angle of its axis from the vertical. Ill determined near the nadir.
    skew : float
        How badly even that one fits (see `CameraOptions.max_skew`).
    """

    gsd_m: float
    rotation_deg: float
    tilt_deg: float
    focal_px: float
    skew: float


def _jacobian(matrix: FloatArray, xy: FloatArray) -> FloatArray:
    mapped = matrix @ (xy[0], xy[1], 1.0)
    image = mapped[:2] / mapped[2]
    return np.asarray((matrix[:2, :2] - np.outer(image, matrix[2, :2])) / mapped[2])


def sampling(matrix: FloatArray, size: tuple[int, int]) -> float:
    """Return the ground sampling at the middle of the frame, metres per pixel."""
    jacobian = _jacobian(matrix, np.array([size[0] / 2.0, -size[1] / 2.0]))
    return math.sqrt(abs(jacobian[0, 0] * jacobian[1, 1] - jacobian[0, 1] * jacobian[1, 0]))


def pose(matrix: FloatArray, size: tuple[int, int], focal_px: float | None = None) -> CameraPose:
    """Describe the camera behind a homography from the query plane (pixels, y up) to a metric plane.

    For each focal length f the columns of diag(1/f, 1/f, 1) G, G the inverse map with the frame's middle as origin,
    should be perpendicular and equally long (Hartley & Zisserman, 8.1.1); the f that comes nearest is taken.
    """
    center = np.array([size[0] / 2.0, -size[1] / 2.0])
    jacobian = _jacobian(matrix, center)
    gsd = sampling(matrix, size)
    rotation = math.degrees(math.atan2(jacobian[0, 1], jacobian[1, 1]))
    shift = np.array([[1.0, 0.0, -center[0]], [0.0, 1.0, -center[1]], [0.0, 0.0, 1.0]])
    g = shift @ np.linalg.inv(matrix)
    focal = np.array([focal_px]) if focal_px else _FOCAL_STEPS * np.hypot(*size) / 2.0
    # columns of diag(1/f, 1/f, 1) G, up to the factor 1/f
    aa = g[0, 0] ** 2 + g[1, 0] ** 2 + (focal * g[2, 0]) ** 2
    bb = g[0, 1] ** 2 + g[1, 1] ** 2 + (focal * g[2, 1]) ** 2
    ab = g[0, 0] * g[0, 1] + g[1, 0] * g[1, 1] + focal**2 * g[2, 0] * g[2, 1]
    skew = np.maximum(np.abs(ab) / np.sqrt(aa * bb), 0.5 * np.abs(np.log(aa / bb)))
    best = int(np.argmin(skew))
    vertical = g[0, 0] * g[1, 1] - g[1, 0] * g[0, 1]  # z of their cross product, whose length is sqrt(aa bb - ab^2)
    cos_tilt = abs(vertical) / math.sqrt(max(aa[best] * bb[best] - ab[best] ** 2, 1e-300))
    tilt = math.degrees(math.acos(min(1.0, cos_tilt)))
    return CameraPose(gsd, rotation, tilt, float(focal[best]), float(skew[best]))


def judge(matrix: FloatArray, size: tuple[int, int], options: CameraOptions) -> str:
    """Return why a homography is not plausible, or "" if it is."""
    if not np.isfinite(matrix).all():
        return "degenerate"
    width, height = size
    corners = np.array([[0, 0, 1], [width, 0, 1], [width, -height, 1], [0, -height, 1]], float)
    middle = float(matrix[2] @ (width / 2.0, -height / 2.0, 1.0))
    if middle == 0.0:
        return "degenerate"
    if (corners @ matrix[2] / middle < 0.05).any():
        return "horizon in the frame"
    if np.linalg.det(matrix) / middle**3 <= 0:
        return "mirrored"
    camera = pose(matrix, size, options.focal_px)
    if not options.gsd_m[0] <= camera.gsd_m <= options.gsd_m[1]:
        return "ground sampling out of range"
    if camera.skew > options.max_skew:
        return "no camera sees a plane so"
    if camera.tilt_deg > options.max_tilt_deg + 5.0:
        return "tilt out of range"
    if options.north_up and abs(camera.rotation_deg) > 5.0:
        return "not north up"
    return ""
