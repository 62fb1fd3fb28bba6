"""Where a frame lies, as the places of its corners with their covariance: predicted by motion, corrected by roads.

An extended Kalman filter. Its state is a frame's four corners on the reference plane in metres, eight numbers
equivalent to a homography, and the focal length, which all frames share. Measurements are the distances of the frame's
road points from roads of the map, and that a pinhole with square pixels sees the plane so: motions that are free
homographies bend the frames, and within a dozen of them they drift four times as far.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.mask import PIXEL_TO_PLANE
from roadgeo.geometry.pose import USUAL_FOCAL, USUAL_SIGMA
from roadgeo.kernels.roads import road_residuals
from roadgeo.kernels.structs import RoadBuckets
from roadgeo.matching.scene import MIN_COS, Scene

__all__ = ["FEWEST", "FilterOptions", "FramePose", "correct", "predict", "start"]

#: Standard deviation of a real camera's skews above real ground, and of the log of its focal length between frames.
#: The map of a slope of 10 % has a skew of 0.005.
_SKEW, _REFOCUSING = 0.005, 0.002
#: With fewer road points on roads a frame is not corrected.
FEWEST = 20


@dataclass(frozen=True)
class FilterOptions:
    """How motion and roads are weighed.

    Attributes
    ----------
    sigma_m, sigma_px : float
        Standard deviation of a road point across the road: the map's and the mask's.
    correlation_m : float
        Errors of the map and of the mask keep their sign over about this length of road.
    radii : tuple of (float, float)
        Search radius of each step of the adjustment in metres, and in standard deviations of the
        prediction, away; the lesser of the two counts.
    least_radius_m : float
        They are always searched within this radius.
    """

    sigma_m: float = 1.2
    sigma_px: float = 0.9
    correlation_m: float = 30.0
    radii: tuple[tuple[float, float], ...] = ((25.0, 3.0), (18.0, 2.5), (12.0, 2.0), (8.0, 1.5), (6.0, 1.5))
    least_radius_m: float = 5.0


@dataclass(frozen=True)
class FramePose:
    """A frame's place.

    Attributes
    ----------
    corners : (4, 2) float64
        TL, TR, BR, BL on the reference plane, metres.
    covariance : (9, 9) float64
        Covariance of the corners x0 y0 x1 y1 ..., metres, and of `log_focal`.
    frame : Frame
    log_focal : float
        Log of the focal length in halves of the frame's diagonal.
    """

    corners: FloatArray
    covariance: FloatArray
    frame: Frame
    log_focal: float

    @property
    def homography(self) -> Homography:
        """Pixel (column, row) to the reference plane."""
        local = _Local.of(self)
        return Homography(local.matrix(local.parameters(self.corners)) @ PIXEL_TO_PLANE)

    @property
    def center(self) -> FloatArray:
        """(2,) where the middle of the frame lies."""
        return self.homography(self.frame.center)

    @property
    def gsd_m(self) -> float:
        """Metres per pixel in the middle of the frame."""
        return math.sqrt(abs(self.homography.area_scale(*self.frame.center.tolist())))

    @property
    def sigma_m(self) -> float:
        """Standard deviation of the middle's place: root mean square of its distance from the truth."""
        row = _rows(_Local.of(self), self.corners, np.zeros((1, 2)))
        return math.sqrt(float(np.trace(row @ self.covariance[:8, :8] @ row.T)))

    @property
    def corner_sigma_m(self) -> FloatArray:
        """(4,) the same of the corners."""
        return np.asarray(np.sqrt(self.covariance.diagonal()[:8].reshape(4, 2).sum(axis=1)))


def loosened(pose: FramePose, shift_m: float) -> FramePose:
    """Return a frame that may lie this far away as a whole besides: root mean square of the distance."""
    covariance = pose.covariance.copy()
    covariance[:8, :8] += 0.5 * shift_m**2 * np.tile(np.eye(2), (4, 4))
    return replace(pose, covariance=covariance)


@dataclass(frozen=True)
class _Local:
    """Normalised coordinates: of a frame, (0, 0) is its middle; of the plane, `origin`, in units of `unit` metres."""

    frame: Frame
    origin: FloatArray
    unit: float

    @classmethod
    def of(cls, pose: FramePose) -> _Local:
        diagonals = np.hypot(*(pose.corners[2:] - pose.corners[:2]).T)
        return cls(pose.frame, pose.corners.mean(axis=0), float(diagonals.mean()) / 2.0)

    @property
    def corners(self) -> FloatArray:
        """(4, 2) the frame's corners, y up."""
        return self.query(self.frame.plane_corners)

    def query(self, xy: FloatArray) -> FloatArray:
        """Take (..., 2) points of the query plane to normalised ones."""
        return np.asarray((xy - self.frame.plane_center) / self.frame.half_diagonal)

    def parameters(self, corners: FloatArray) -> FloatArray:
        """Return p (8,) of the map that takes the frame's corners to these (4, 2), metres."""
        uv, xy = self.corners, (corners - self.origin) / self.unit
        system = np.zeros((8, 8))
        system[0::2, 0:2], system[0::2, 2] = uv, 1.0
        system[1::2, 3:5], system[1::2, 5] = uv, 1.0
        system[0::2, 6:], system[1::2, 6:] = -xy[:, :1] * uv, -xy[:, 1:] * uv
        return np.asarray(np.linalg.solve(system, xy.ravel()))

    def places(self, p: FloatArray, uv: FloatArray) -> FloatArray:
        """Return where p puts (N, 2) normalised points, metres."""
        return np.asarray(self.origin + self.unit * Homography(np.append(p, 1.0).reshape(3, 3)).everywhere(uv))

    def matrix(self, p: FloatArray) -> FloatArray:
        """Return p as a map from the query plane, pixels, to the reference plane, metres; w is 1 in the middle."""
        half, (x, y) = self.frame.half_diagonal, self.frame.plane_center
        from_query = np.array([[1.0, 0.0, -x], [0.0, 1.0, -y], [0.0, 0.0, half]]) / half
        to_plane = np.array([[self.unit, 0.0, self.origin[0]], [0.0, self.unit, self.origin[1]], [0.0, 0.0, 1.0]])
        return np.asarray(to_plane @ np.append(p, 1.0).reshape(3, 3) @ from_query)

    def derivative(self, p: FloatArray, uv: FloatArray) -> FloatArray:
        """Return the derivative (2N, 8) of places, metres, by p."""
        return np.asarray(self.unit * Homography(np.append(p, 1.0).reshape(3, 3)).by_elements(uv).reshape(-1, 8))


def _rows(local: _Local, corners: FloatArray, uv: FloatArray) -> FloatArray:
    """Return the derivative (2N, 8) of places of normalised points by the places of the frame's corners."""
    p = local.parameters(corners)
    return np.asarray(local.derivative(p, uv) @ np.linalg.inv(local.derivative(p, local.corners)))


def start(corners: FloatArray, frame: Frame, covariance: FloatArray) -> FramePose:
    """Return the pose of a frame whose corners (4, 2) are known, with their covariance (8, 8), and of a usual lens."""
    return FramePose(corners, _beside_focal(covariance, USUAL_SIGMA**2), frame, math.log(USUAL_FOCAL))


def predict(pose: FramePose, motion: FloatArray, sigma_px: float) -> FramePose | None:
    """Return where the next frame lies by its motion, as a camera sees it; None where that cannot be.

    Parameters
    ----------
    motion : (3, 3) float64
        Pixel of the next frame to pixel of this one.
    sigma_px : float
        Standard deviation of where the motion puts a corner.
    """
    local = _Local.of(pose)
    before = Homography(motion).facing(pose.frame.center)(pose.frame.corners)
    if not np.isfinite(before).all():
        return None
    uv = local.query(before * (1.0, -1.0))
    p = local.parameters(pose.corners)
    if (np.c_[uv, np.ones(4)] @ np.append(p[6:], 1.0) < 0.05).any():
        return None
    move = _beside_focal(_rows(local, pose.corners, uv))
    noise = np.diag([(pose.gsd_m * sigma_px) ** 2 / 2.0] * 8 + [_REFOCUSING**2])
    moved = replace(pose, corners=local.places(p, uv), covariance=move @ pose.covariance @ move.T + noise)
    return _as_cameras_see(moved)


def _beside_focal(matrix: FloatArray, focal: float = 1.0) -> FloatArray:
    """Return a matrix (8, 8) of the corners with a number of the focal length beside it, (9, 9)."""
    return np.block([[matrix, np.zeros((8, 1))], [np.zeros((1, 8)), focal]])


def _as_cameras_see(pose: FramePose) -> FramePose:
    """Correct a pose by a measurement: both skews of a pinhole, of a focal length that is unknown too, are 0."""
    local = _Local.of(pose)
    corners, p = local.corners, local.parameters(pose.corners)
    to_state = _beside_focal(np.asarray(np.linalg.inv(local.derivative(p, corners)), float))
    spread = to_state @ pose.covariance @ to_state.T
    given = state = np.append(p, pose.log_focal)
    for _ in range(3):
        off, rows = _skews(state)
        gain = np.linalg.solve(rows @ spread @ rows.T + _SKEW**2 * np.eye(2), rows @ spread).T
        state = given - gain @ (off + rows @ (given - state))
    if not np.isfinite(state).all() or (np.c_[corners, np.ones(4)] @ np.append(state[6:8], 1.0) < 0.05).any():
        return pose
    back = _beside_focal(local.derivative(state[:8], corners))
    covariance = back @ (spread - gain @ rows @ spread) @ back.T
    return FramePose(local.places(state[:8], corners), (covariance + covariance.T) / 2.0, pose.frame, float(state[8]))


def _skews(state: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return both skews (2,) of a state, parameters of `_Local` and log of the focal length, and derivatives (2, 9).

    Two unit vectors on the plane are perpendicular and equally long; how far a camera sees them from that.
    """
    near = state + 1e-6 * np.vstack((np.zeros(9), np.eye(9), -np.eye(9)))
    inverse = np.linalg.inv(np.insert(near[:, :8], 8, 1.0, axis=1).reshape(-1, 3, 3))[:, :, :2]
    inverse[:, :2] /= np.exp(near[:, 8])[:, None, None]
    (aa, ab), (_, bb) = np.moveaxis(np.swapaxes(inverse, 1, 2) @ inverse, 0, -1)
    skews = np.stack((ab / np.sqrt(aa * bb), 0.5 * np.log(aa / bb)))
    return skews[:, 0], (skews[:, 1:10] - skews[:, 10:]) / 2e-6


def correct(pose: FramePose, scene: Scene, roads: RoadBuckets, options: FilterOptions) -> FramePose | None:
    """Lay a frame's roads on the map's, starting from a predicted pose; None where there are too few."""
    local, gsd = _Local.of(pose), pose.gsd_m
    p = local.parameters(pose.corners)
    corners = local.corners
    before = pose.covariance[:8, :8]
    weight = np.linalg.inv(before)
    sigma = math.hypot(options.sigma_m, options.sigma_px * gsd)
    spacing = scene.road_length_px * gsd / max(len(scene.points), 1)
    share = min(1.0, spacing / options.correlation_m)  # points closer than that are no independent observations
    unsure = float(pose.corner_sigma_m.mean())
    for most_m, deviations in options.radii:
        radius = max(min(most_m, deviations * unsure), options.least_radius_m)
        normal, right, met = _road_equations(local, p, scene, radius, max(sigma, radius / 3.0), roads)
        if met < FEWEST:
            return None
        jacobian = local.derivative(p, corners)
        scale = share * (local.unit / sigma) ** 2
        pulled = (pose.corners - local.places(p, corners)).ravel()
        step = np.linalg.solve(
            scale * normal + jacobian.T @ weight @ jacobian, scale * right + jacobian.T @ weight @ pulled
        )
        p = p + step
        if (np.c_[corners, np.ones(4)] @ np.append(p[6:], 1.0) < 0.05).any() or not np.isfinite(p).all():
            return None
    jacobian = local.derivative(p, corners)
    information = scale * normal + jacobian.T @ weight @ jacobian
    covariance = jacobian @ np.linalg.inv(information) @ jacobian.T
    # The focal length follows the corners as far as it depended on them.
    placed, follows = local.places(p, corners), pose.covariance[8, :8] @ weight
    both = np.vstack((np.eye(8), follows))
    joint = both @ covariance @ both.T + np.diag([0.0] * 8 + [pose.covariance[8, 8] - follows @ before @ follows])
    log_focal = pose.log_focal + float(follows @ (placed - pose.corners).ravel())
    return FramePose(placed, (joint + joint.T) / 2.0, pose.frame, log_focal)


def _road_equations(
    local: _Local, p: FloatArray, scene: Scene, radius: float, sigma: float, roads: RoadBuckets
) -> tuple[FloatArray, FloatArray, int]:
    """Return normal (8, 8) and right (8,) sides of normal dp = right, of all points that meet a road, and how many.

    Residuals lie across the roads nearer than `radius` metres, in normalised units, with Cauchy weights by `sigma`.
    """
    ways, radii = np.empty((len(scene.points), 3)), np.full(len(scene.points), radius)
    road_residuals(local.matrix(p), scene.points, scene.directions, radii, MIN_COS, roads, ways)
    uv = local.query(scene.points)
    met = np.isfinite(ways[:, 0]) & (1.0 + uv @ p[6:] >= 0.05)
    away, normals = ways[met, 0], ways[met, 1:]
    rows = np.einsum("ni,nij->nj", normals, local.derivative(p, uv[met]).reshape(-1, 2, 8)) / local.unit
    weighted = rows / (1.0 + (away / sigma) ** 2)[:, None]
    return weighted.T @ rows, weighted.T @ (away / local.unit), int(met.sum())
