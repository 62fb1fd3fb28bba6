"""The view of a pinhole camera above a plane."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, FloatArray
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.homography import Homography, shift

__all__ = ["View", "make_view", "sees_ground", "warp_mask"]

#: A ray further than this from the vertical meets the ground too far away to be worth drawing.
MAX_RAY_DEG = 85.0


@dataclass(frozen=True)
class View:
    """A camera's view of the plane.

    Attributes
    ----------
    homography : Homography
        Pixel (column, row; GDAL's corner convention) to plane metres, w = 1 at the frame's centre.
    tilt_azimuth_deg : float
        Direction that the optical axis leans to, clockwise from north.
    """

    homography: Homography
    size_px: tuple[int, int]
    gsd_m: float
    tilt_deg: float
    tilt_azimuth_deg: float
    heading_deg: float
    focal_px: float

    @property
    def corners(self) -> FloatArray:
        """(4, 2) pixel positions of the frame's corners TL, TR, BR, BL."""
        return Frame(*self.size_px).corners

    @property
    def footprint(self) -> FloatArray:
        """(4, 2) the corners on the plane."""
        return self.homography(self.corners)

    def sampling(self, pixels: FloatArray) -> FloatArray:
        """(...,) metres per pixel at (..., 2) pixels: the root of the area that a pixel covers."""
        matrix = self.homography.matrix
        w = pixels @ matrix[2, :2] + matrix[2, 2]
        return np.asarray(np.sqrt(np.abs(np.linalg.det(matrix)) / np.maximum(w, 1e-9) ** 3))


def make_view(
    center: tuple[float, float],
    size_px: tuple[int, int],
    gsd_m: float,
    tilt_deg: float = 0.0,
    tilt_azimuth_deg: float = 0.0,
    heading_deg: float = 0.0,
    focal_px: float | None = None,
) -> View:
    """Look at a point of the plane with a pinhole camera.

    Parameters
    ----------
    center : (float, float)
        Plane position in the middle of the frame, where the optical axis meets the ground.

    Returns
    -------
    View
        Its homography is NaN-free even where the frame holds the horizon; see `sees_ground`.
    """
    focal = float(max(size_px)) if focal_px is None else focal_px
    straight = _camera_homography(center, size_px, gsd_m, tilt_deg, tilt_azimuth_deg, 0.0, focal)
    # Turn the camera about its axis until the image's up points to the heading on the ground.
    heading = np.radians(heading_deg)
    ahead = np.linalg.solve(straight.jacobian(np.array(size_px) / 2), [np.sin(heading), np.cos(heading)])
    roll = float(np.arctan2(ahead[0], -ahead[1]))
    homography = _camera_homography(center, size_px, gsd_m, tilt_deg, tilt_azimuth_deg, roll, focal)
    return View(homography, size_px, gsd_m, tilt_deg, tilt_azimuth_deg, heading_deg, focal)


def sees_ground(view: View) -> bool:
    """Whether every ray of the frame goes down steeply enough (`MAX_RAY_DEG`)."""
    radius = np.hypot(*(view.corners - np.array(view.size_px) / 2).T)
    # w is 1 at the centre, so w * focal * cos(tilt) is the downward part of a ray of length hypot(focal, radius).
    w = view.corners @ view.homography.matrix[2, :2] + view.homography.matrix[2, 2]
    down = w * view.focal_px * np.cos(np.radians(view.tilt_deg)) / np.hypot(view.focal_px, radius)
    return bool(down.min() > np.cos(np.radians(MAX_RAY_DEG)))


def warp_mask(
    mask: AnyArray, tilt_deg: float, tilt_azimuth_deg: float, heading_deg: float
) -> tuple[AnyArray, FloatArray]:
    """Look at a mask, laid flat on the ground, with a tilted camera of the same sampling.

    The corners of the frame that the mask does not reach stay black: such is an image warped for an experiment.

    Returns
    -------
    warped : (H, W) uint8
    matrix : (3, 3) float64
        Pixel of `warped` to pixel of `mask`, both in GDAL's corner convention.
    """
    height, width = mask.shape[:2]
    view = make_view((width / 2, -height / 2), (width, height), 1.0, tilt_deg, tilt_azimuth_deg, heading_deg)
    matrix = np.diag([1.0, -1.0, 1.0]) @ view.homography.matrix
    source = shift(-0.5, -0.5) @ matrix @ shift(0.5, 0.5)  # OpenCV counts from pixel centres
    warped = cv2.warpPerspective(mask, source, (width, height), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    return np.where(warped > 127, 255, 0).astype(np.uint8), matrix


def _camera_homography(
    center: tuple[float, float],
    size_px: tuple[int, int],
    gsd_m: float,
    tilt_deg: float,
    tilt_azimuth_deg: float,
    roll: float,
    focal: float,
) -> Homography:
    """Pixel to plane of a camera whose axis meets the plane z = 0 at `center`, rolled about its axis by `roll` rad."""
    tilt, azimuth = np.radians(tilt_deg), np.radians(tilt_azimuth_deg)
    axis = np.array([np.sin(tilt) * np.sin(azimuth), np.sin(tilt) * np.cos(azimuth), -np.cos(tilt)])
    level = np.array([np.cos(azimuth), -np.sin(azimuth), 0.0])
    steep = np.array([-axis[2] * level[1], axis[2] * level[0], axis[0] * level[1] - axis[1] * level[0]])
    right = np.cos(roll) * level + np.sin(roll) * steep
    down = np.cos(roll) * steep - np.sin(roll) * level
    # A pixel's ray is rays @ (column, row, 1).
    offset = axis * focal - right * size_px[0] / 2 - down * size_px[1] / 2
    rays = np.array([right, down, offset]).T
    camera = -axis * focal * gsd_m
    ground = np.array([camera[2] * rays[0] - camera[0] * rays[2], camera[2] * rays[1] - camera[1] * rays[2], -rays[2]])
    ground /= focal * np.cos(tilt)
    return Homography(shift(*center) @ ground)
