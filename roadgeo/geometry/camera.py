"""Is a homography what a camera could have seen? Tilt, focal length and ground sampling of a plane under a pinhole."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from typing import Literal

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.homography import Homography

__all__ = ["CameraFault", "CameraOptions", "CameraPose", "judge", "pose", "sampling"]

_FOCAL_STEPS = np.geomspace(0.35, 8.0, 25)
#: A frame that covers less ground than this, square metres, has shrunk to a point, whatever camera is allowed.
_LEAST_AREA = 1e-6
#: Focal length that is taken where none fits better: in halves of the frame's diagonal, as a usual lens has it.
_USUAL_FOCAL = 1.5
#: How much more skew a usual focal length may leave than one e times as long.
_FOCAL_PRIOR = 0.01
#: Focal lengths whose skews differ by less than the errors of homographies are indistinguishable; where the longest
#: of them exceeds the shortest by this factor, the homography does not determine the lens.
_TOLD_APART, _ALIKE = 0.02, 4.0


class CameraFault(Enum):
    """Why no camera within the options can have seen a homography; the value is the text for people."""

    DEGENERATE = "degenerate"
    HORIZON = "horizon in the frame"
    MIRRORED = "mirrored"
    SAMPLING = "ground sampling out of range"
    SKEW = "no camera sees a plane so"
    TILT = "tilt out of range"
    HEADING = "heading out of range"


@dataclass(frozen=True)
class CameraOptions:
    """Prior knowledge of the camera.

    Attributes
    ----------
    gsd_m : (low, high)
        Ground sampling at the middle of the frame, metres per pixel.
    max_tilt_deg : float
        Greatest angle between the optical axis and the vertical.
    focal_px : float or None
        Focal length, where it is known.
    max_skew : float
        How far the homography may be from one of a pinhole with square pixels whose axis meets the middle of the
        frame: the greater of the absolute cosine of the angle between the images of two perpendicular unit vectors and
        the logarithm of the ratio of their lengths. A crop or lens distortion moves it from 0.
    north_up : bool
        The image's up is north, within 5 degrees.
    heading_deg : (float, float) or None
        Direction of the image's up, clockwise from grid north, and by how much it may be off.
    """

    gsd_m: tuple[float, float] = (0.1, 12.0)
    max_tilt_deg: float = 60.0
    focal_px: float | None = None
    max_skew: float = 0.35
    north_up: bool = False
    heading_deg: tuple[float, float] | None = None

    @property
    def heading(self) -> tuple[float, float] | None:
        """Direction of the image's up, and by how much it may be off, degrees; None where it is not known."""
        return self.heading_deg or ((0.0, 0.0) if self.north_up else None)

    def turned_off(self, east: FloatArray, north: FloatArray) -> FloatArray:
        """Return by how many degrees more than it may be the image's up is turned; its direction is east, north."""
        if self.heading is None:
            return np.zeros_like(np.asarray(east, float))
        turn = np.degrees(np.arctan2(east, north)) - self.heading[0]
        return np.asarray(np.abs((turn + 180.0) % 360.0 - 180.0) - self.heading[1])

    @property
    def min_shape_ratio(self) -> float:
        """Least ratio of the singular values of a map around an intersection that three crossings may propose.

        A camera tilted by a sees 1 : 1 / cos a, the rays at its frame's edge still less; triangles are not exact.
        """
        return max(0.33, 0.85 * math.cos(math.radians(min(self.max_tilt_deg + 25.0, 85.0))))

    def perspective_sigma(self, usual: float) -> float:
        """Return the prior standard deviation of the perspective parameters, in units of 1 / half the frame's diagonal.

        It is `usual` unless the greatest tilt allowed requires less.
        """
        return min(usual, 0.03 + 0.7 * math.tan(math.radians(min(self.max_tilt_deg, 80.0))))


@dataclass(frozen=True)
class CameraPose:
    """The camera as estimated from a homography.

    Attributes
    ----------
    gsd_m : float
        Ground sampling at the middle of the frame, metres per pixel.
    rotation_deg : float
        Direction of the image's up there, clockwise from north.
    tilt_deg, focal_px : float
        Angle from the vertical of the axis of the pinhole that fits best. Ill determined near the nadir.
    source : str
        Origin of the focal length: the given "camera", the "homography", or a usual lens "assumed" where the homography
        fits too wide a range of focal lengths about as well.
    skew : float
        How badly even that one fits (see `CameraOptions.max_skew`).
    """

    gsd_m: float
    rotation_deg: float
    tilt_deg: float
    focal_px: float
    skew: float
    source: Literal["camera", "homography", "assumed"] = "homography"


def sampling(matrix: FloatArray, size: tuple[int, int]) -> float:
    """Return the ground sampling at the middle of the frame, metres per pixel."""
    width, height = size
    return math.sqrt(abs(Homography(matrix).area_scale(width / 2, -height / 2)))


@dataclass(frozen=True)
class _Pinholes:
    """How well pinholes of several focal lengths fit a homography: focal lengths in pixels, skew and tilt of each."""

    focal_px: FloatArray
    skew: FloatArray
    tilt_deg: FloatArray


def _pinholes(matrix: FloatArray, size: tuple[int, int], focal_px: float | None) -> _Pinholes:
    """Fit pinholes to a homography from the query plane to a metric plane.

    For each focal length f the columns of diag(1/f, 1/f, 1) G, G the inverse map with the frame's middle as origin,
    should be perpendicular and equally long (Hartley & Zisserman, 8.1.1).
    """
    (a, b, c), (d, e, f), (g, h, i) = matrix.tolist()
    x, y = size[0] / 2.0, -size[1] / 2.0
    # The columns of the inverse, but for a factor, and the frame's middle taken off.
    u0, v0, w0 = e * i - f * h, f * g - d * i, d * h - e * g
    u1, v1, w1 = c * h - b * i, a * i - c * g, b * g - a * h
    u0, v0, u1, v1 = u0 - x * w0, v0 - y * w0, u1 - x * w1, v1 - y * w1
    focal = np.array([focal_px]) if focal_px else _FOCAL_STEPS * math.hypot(*size) / 2.0
    # columns of diag(1/f, 1/f, 1) G, up to the factor 1/f
    square = focal**2
    aa = u0 * u0 + v0 * v0 + square * (w0 * w0)
    bb = u1 * u1 + v1 * v1 + square * (w1 * w1)
    ab = u0 * u1 + v0 * v1 + square * (w0 * w1)
    product = aa * bb
    skew = np.maximum(np.abs(ab) / np.sqrt(product), 0.5 * np.abs(np.log(aa / bb)))
    vertical = u0 * v1 - v0 * u1  # z of their cross product, whose length is sqrt(aa bb - ab^2)
    cosine = abs(vertical) / np.sqrt(np.maximum(product - ab**2, 1e-300))
    return _Pinholes(focal, skew, np.degrees(np.arccos(np.minimum(1.0, cosine))))


def pose(matrix: FloatArray, size: tuple[int, int], focal_px: float | None = None) -> CameraPose:
    """Describe the camera behind a homography from the query plane (pixels, y up) to a metric plane.

    The focal length belongs to the pinhole that fits best, or to a usual lens where all fit alike, as near the nadir.
    """
    jacobian = Homography(matrix).jacobian(Frame(*size).plane_center)
    gsd = sampling(matrix, size)
    rotation = math.degrees(math.atan2(jacobian[0, 1], jacobian[1, 1]))
    fits = _pinholes(matrix, size, focal_px)
    usual = _USUAL_FOCAL * math.hypot(*size) / 2.0
    best = int(np.argmin(fits.skew + _FOCAL_PRIOR * np.abs(np.log(fits.focal_px / usual))))
    alike = fits.focal_px[fits.skew <= fits.skew.min() + _TOLD_APART]
    source: Literal["camera", "homography", "assumed"] = "homography" if alike[-1] < _ALIKE * alike[0] else "assumed"
    if focal_px:
        source = "camera"
    tilt, focal, skew = (float(values[best]) for values in (fits.tilt_deg, fits.focal_px, fits.skew))
    return CameraPose(gsd, rotation, tilt, focal, skew, source)


def judge(matrix: FloatArray, size: tuple[int, int], options: CameraOptions, rough: bool = False) -> CameraFault | None:
    """Return why a homography is not plausible, or None if it is.

    Some camera within the options must fit about as well as any. A `rough` homography, of a few matches or of a part of
    the frame, may still become plausible: its bounds are wider, and it may be skewed. Two of 16
    lost steep views were refused for that and fit once refined.
    """
    if not np.isfinite(matrix).all():
        return CameraFault.DEGENERATE
    (width, height), homography = size, Homography(matrix)
    g, h, i = matrix[2].tolist()
    middle = g * width / 2 - h * height / 2 + i
    if middle == 0.0:
        return CameraFault.DEGENERATE
    if any((g * x - h * y + i) / middle < 0.05 for x in (0.0, width) for y in (0.0, height)):
        return CameraFault.HORIZON
    area = homography.area_scale(width / 2, -height / 2)
    if not abs(area) >= _LEAST_AREA:
        return CameraFault.DEGENERATE
    if area < 0.0:
        return CameraFault.MIRRORED
    slack_deg, slack, further = (15.0, 1.25, 0.2) if rough else (5.0, 1.0, 0.1)
    if not options.gsd_m[0] / slack <= math.sqrt(area) <= options.gsd_m[1] * slack:
        return CameraFault.SAMPLING
    fits = _pinholes(matrix, size, options.focal_px)
    if not rough and fits.skew.min() > options.max_skew:
        return CameraFault.SKEW
    if fits.tilt_deg[fits.skew <= fits.skew.min() + further].min() > options.max_tilt_deg + slack_deg:
        return CameraFault.TILT
    if options.heading is not None:
        jacobian = homography.jacobian(Frame(*size).plane_center)
        if options.turned_off(jacobian[0, 1], jacobian[1, 1]) > slack_deg:
            return CameraFault.HEADING
    return None
