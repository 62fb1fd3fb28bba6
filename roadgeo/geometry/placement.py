"""A place as it leaves: the homography from the image's pixels to a CRS, and all that follows from it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo.geometry.camera import CameraPose, pose
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.lens import Lens
from roadgeo.geometry.mask import PIXEL_TO_PLANE
from roadgeo.geometry.pose import find_pose, turned
from roadgeo.geometry.projection import LocalPlane, grid_north, to_lonlat, transform
from roadgeo.geometry.transformation import LONLAT, exactness
from roadgeo.geometry.uncertainty import CenterError, corner_sigmas

__all__ = ["Camera", "Center", "Matches", "Placement"]

#: A camera's pixels are square to this share; no camera saw an image that is stretched more.
_SQUARE = 0.02


class Center(NamedTuple):
    """The middle of a frame: x and y in a CRS, longitude and latitude."""

    x: float
    y: float
    lon: float
    lat: float


@dataclass(frozen=True, eq=False)
class Matches:
    """The intersections that an image shares with the map. Dimension: M.

    Attributes
    ----------
    query_xy : (M, 2) float64
        Query plane, pixels (see `geometry.mask`).
    reference_xy : (M, 2) float64
        Their counterparts on the map, in the placement's CRS.
    residual_m : (M,) float64
        Distances between the mapped query intersections and their counterparts.
    """

    query_xy: FloatArray
    reference_xy: FloatArray
    residual_m: FloatArray

    def __len__(self) -> int:
        """M."""
        return len(self.query_xy)


@dataclass(frozen=True)
class Camera:
    """Where the camera was, and how it pointed (see `geometry.pose`).

    Attributes
    ----------
    x, y : float
        In the location's CRS.
    height_m : float
        Above the ground in the frame, taken for level.
    heading_deg, pitch_deg, roll_deg : float
        Angles of an aircraft that looks straight down from its belly, its nose at the image's top: heading clockwise
        from true north, pitch positive with the nose up, roll with the right wing down.
    focal_px, focal_sigma_px : float
        Focal length in pixels of the mask, and its standard deviation: 0 where it was given.
    source : str
        Origin of the focal length, as in `Location.tilt_source`.
    covariance : (6, 6) float64
        Covariance of x, y and height, metres, and of the three angles, degrees.
    rotation : (3, 3) float64
        Axes of the camera (x right, y to the image's top, z backwards) to east, north and up.
    ground_m, ground_spread_m : float or None
        Mean height of the ground in the frame by a terrain model, and its standard deviation; None: none was given.
    """

    x: float
    y: float
    lon: float
    lat: float
    height_m: float
    heading_deg: float
    pitch_deg: float
    roll_deg: float
    focal_px: float
    focal_sigma_px: float
    source: str
    covariance: FloatArray = field(repr=False)
    rotation: FloatArray = field(repr=False)
    ground_m: float | None = None
    ground_spread_m: float | None = None

    @property
    def tilt_deg(self) -> float:
        """Angle of the optical axis from the vertical."""
        return float(np.degrees(np.arccos(min(1.0, float(self.rotation[2, 2])))))

    @property
    def altitude_m(self) -> float | None:
        """Height in the terrain model's system; None without one."""
        return None if self.ground_m is None else self.ground_m + self.height_m

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        sigma = np.sqrt(np.diag(self.covariance)).tolist()
        names = ("x_m", "y_m", "height_m", "heading_deg", "pitch_deg", "roll_deg")
        plain = ("x", "y", "lon", "lat", *names[2:], "ground_m", "ground_spread_m", "altitude_m", "focal_px", "source")
        return {
            **{name: getattr(self, name) for name in plain},
            "sigma": {**dict(zip(names, sigma, strict=True)), "focal_px": self.focal_sigma_px},
            "covariance": self.covariance.tolist(),
            "rotation": self.rotation.tolist(),
        }


@dataclass(frozen=True, eq=False)
class Placement:
    """An image placed on the ground; equal to itself only.

    Attributes
    ----------
    size : (width, height)
        Size of the image, pixels.
    plane : LocalPlane
        The CRS, and an origin near the place.
    matrix : (3, 3) float64
        Pixel (column, row; GDAL corner convention) to that plane, metres.
    score : float
        By how many powers of ten it explains more than any other place; NaN: the method knows no scores.
    reference, attribution : str
        Name of the map, and whom its licence asks to name.
    corner_covariance_m2 : (8, 8) float64 or None
        Covariance of the corners' x and y in the CRS: x, y of TL, then of TR, BR, BL; None: not known.
    lens_k1 : float
        Radial distortion by the lens (see `geometry.lens`): the matrix is of the frame as a pinhole would have seen it.
    fitted : str
        "similarity" where the roads are consistent with a camera that looked straight down, else "homography".
    focal_px : float or None
        Focal length, where it was given.
    is_pinhole : bool
        A camera can have seen it: pixels are square, and nothing is mirrored.
    ground_m : (float, float) or None
        Mean height of the ground in the frame, and its standard deviation, where a terrain model gives them.
    matches : Matches or None
        None where they are not known.
    rival : Placement or None
        The best other place.
    """

    size: tuple[int, int]
    plane: LocalPlane
    matrix: FloatArray = field(repr=False)
    score: float = math.nan
    reference: str = ""
    attribution: str = ""
    corner_covariance_m2: FloatArray | None = field(default=None, repr=False)
    lens_k1: float = 0.0
    fitted: str = "homography"
    focal_px: float | None = None
    is_pinhole: bool = True
    ground_m: tuple[float, float] | None = None
    matches: Matches | None = field(default=None, repr=False)
    rival: Placement | None = field(default=None, repr=False)

    # --- where it lies ------------------------------------------------------------------------------------------------

    @property
    def crs(self) -> str:
        """The CRS: "EPSG:n" where there is a code, else WKT2."""
        return self.plane.crs

    @cached_property
    def homography(self) -> FloatArray:
        """(3, 3) pixel to CRS, its last element 1."""
        matrix = self.plane.to_crs_matrix() @ self.matrix
        return np.asarray(matrix / matrix[2, 2])

    @cached_property
    def footprint(self) -> FloatArray:
        """(4, 2) corners TL, TR, BR, BL of the frame in the CRS."""
        return self.plane.to_crs(Homography(self.matrix).everywhere(Frame(*self.size).corners))

    @cached_property
    def footprint_lonlat(self) -> FloatArray:
        """(4, 2) the same as longitude and latitude."""
        return to_lonlat(self.crs, self.footprint)

    @cached_property
    def center(self) -> Center:
        """The middle of the frame."""
        xy = self.plane.to_crs(Homography(self.matrix).everywhere(Frame(*self.size).center))
        return Center(*xy.tolist(), *to_lonlat(self.crs, xy[None])[0].tolist())

    def center_in(self, crs: str) -> Center:
        """Return the middle of the frame, its x and y in another CRS."""
        if crs == self.crs:
            return self.center
        x, y = transform(LONLAT, crs, np.array([self.center[2:]]))[0].tolist()
        return self.center._replace(x=x, y=y)

    @cached_property
    def lonlat_accuracy_m(self) -> float:
        """How exactly PROJ takes the CRS to longitude and latitude here (see `geometry.transformation`).

        0 where both have one datum, NaN where it does not know.
        """
        return exactness(self.crs, LONLAT, self.center[2:]).sigma_m

    @property
    def corner_sigma_m(self) -> FloatArray | None:
        """(4,) standard deviations of the corners' positions: root mean squares of their distances from the truth."""
        return None if self.corner_covariance_m2 is None else corner_sigmas(self.corner_covariance_m2)

    @property
    def lonlat_sigma_m(self) -> FloatArray | None:
        """Standard deviations (4,) of the corners' longitude and latitude, in metres; None where they are not known."""
        if self.corner_sigma_m is None or np.isnan(self.lonlat_accuracy_m):
            return None
        return np.hypot(self.corner_sigma_m, self.lonlat_accuracy_m)

    @property
    def center_error(self) -> CenterError | None:
        """How far the middle may be off; None where that is not known."""
        return None if self.corner_covariance_m2 is None else CenterError.of(self.corner_covariance_m2)

    # --- pixels and ground --------------------------------------------------------------------------------------------

    def lens(self, size: tuple[int, int] | None = None) -> Lens | None:
        """Return the lens in front of a picture of the frame, of `size` (width, height); None without one."""
        return Lens.of(self.lens_k1, size or self.size) if self.lens_k1 else None

    def to_crs(self, pixels: FloatArray) -> FloatArray:
        """Take (..., 2) pixels (column, row) to the CRS; NaN beyond the horizon."""
        lens = self.lens()
        return self.plane.to_crs(self._facing(pixels if lens is None else lens.straighten(pixels)))

    def to_pixels(self, xy: FloatArray) -> FloatArray:
        """Take (..., 2) coordinates of the CRS to pixels (column, row); NaN beyond the horizon."""
        lens, pixels = self.lens(), self._facing.inverse()(self.plane.from_crs(xy))
        return pixels if lens is None else lens.bend(pixels)

    @cached_property
    def _facing(self) -> Homography:
        return Homography(self.matrix).facing(Frame(*self.size).center)

    def in_pixels(self, size: tuple[int, int], matrix: FloatArray) -> Placement:
        """Return the placement of another image of the frame.

        Parameters
        ----------
        size : (width, height)
            Size of the other image.
        matrix : (3, 3) float64
            Affine map from its pixels to this image's.
        """
        covariance, matches, rival = self.corner_covariance_m2, self.matches, self.rival
        corners = Frame(*self.size).corners, Homography(matrix)(Frame(*size).corners)
        by_elements = [Homography(self.matrix).by_elements(each).reshape(8, -1)[:, :8] for each in corners]
        by_corners = by_elements[1] @ np.linalg.inv(by_elements[0])  # (8, 8) how the other's corners move with these
        wide, high = np.hypot(*matrix[:2, :2])
        stays = bool(np.linalg.det(matrix[:2, :2]) > 0.0 and abs(wide / high - 1.0) <= _SQUARE)
        back = Homography(PIXEL_TO_PLANE @ np.linalg.inv(matrix) @ PIXEL_TO_PLANE)
        return replace(
            self,
            size=size,
            matrix=self.matrix @ matrix,
            corner_covariance_m2=None if covariance is None else by_corners @ covariance @ by_corners.T,
            focal_px=None if self.focal_px is None else self.focal_px / math.sqrt(wide * high),
            is_pinhole=self.is_pinhole and stays,
            matches=None if matches is None else replace(matches, query_xy=back(matches.query_xy)),
            rival=None if rival is None else rival.in_pixels(size, matrix),
        )

    # --- how it was seen ----------------------------------------------------------------------------------------------

    @cached_property
    def _view(self) -> CameraPose:
        return pose(self.matrix @ PIXEL_TO_PLANE, self.size, self.focal_px)

    @property
    def gsd_m(self) -> float:
        """Ground sampling at the middle, metres per pixel."""
        return self._view.gsd_m

    @cached_property
    def _north_deg(self) -> float:
        """Direction of the plane's y axis from true north."""
        return grid_north(self.plane, np.array(self.center[:2]))

    @property
    def rotation_deg(self) -> float:
        """Direction of the image's up at its centre, clockwise from true north."""
        return (self._view.rotation_deg + self._north_deg + 180.0) % 360.0 - 180.0

    @property
    def mirrored(self) -> bool:
        """Whether the homography mirrors: the image was mirrored, left to right."""
        return bool(np.linalg.det(Homography(self.matrix).jacobian(Frame(*self.size).center)) > 0.0)

    @cached_property
    def camera(self) -> Camera | None:
        """Where the camera was; None where no camera above the ground would see the frame so."""
        if self.corner_covariance_m2 is None or not self.is_pinhole:
            return None
        seat = find_pose(self.matrix, self.size, self.corner_covariance_m2, self.focal_px)
        if seat is None:
            return None
        rotation = turned(seat.rotation, -self._north_deg)
        x, y = self.plane.to_crs(seat.position[:2]).tolist()
        lon, lat = to_lonlat(self.crs, np.array([[x, y]]))[0].tolist()
        heading, pitch, roll = replace(seat, rotation=rotation).angles_deg.tolist()
        optics = (seat.focal_px, seat.focal_sigma_px, seat.source)
        ground = self.ground_m or (None, None)
        height = float(seat.position[2])
        return Camera(x, y, lon, lat, height, heading, pitch, roll, *optics, seat.covariance, rotation, *ground)

    @property
    def tilt_deg(self) -> float | None:
        """Angle of the camera's axis from the vertical; None where there is no such camera."""
        if not self.is_pinhole:
            return None
        return self._view.tilt_deg if self.camera is None else self.camera.tilt_deg

    @property
    def tilt_source(self) -> str | None:
        """Origin of the focal length: the given "camera", the "homography", or a usual lens that is "assumed"."""
        if not self.is_pinhole:
            return None
        return self._view.source if self.camera is None else self.camera.source

    def rmse(self) -> tuple[float, float] | None:
        """Root mean square distance of the matched intersections from where the map has them: metres, pixels."""
        if self.matches is None or not len(self.matches):
            return None
        lens, there = self.lens(), self.plane.from_crs(self.matches.reference_xy)
        pixels = Homography(PIXEL_TO_PLANE)(self.matches.query_xy)
        pixels = pixels if lens is None else lens.straighten(pixels)
        errors = (self._facing(pixels) - there, pixels - self._facing.inverse()(there))
        metres, px = (float(np.sqrt(np.mean(np.sum(error**2, axis=1)))) for error in errors)
        return (metres, px) if np.isfinite([metres, px]).all() else None
