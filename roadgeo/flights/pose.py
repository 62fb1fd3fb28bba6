"""Where a frame lies, as the places of its corners with their covariance: predicted by motion, corrected by roads.

An extended Kalman filter. Its state is a homography, as uncertain as the places of the frame's four corners, and the
focal length, which all frames share. Measurements are the distances of the frame's road points from roads of the map,
and that a pinhole with square pixels sees the plane so: motions that are free homographies bend the frames, and within
a dozen of them they drift four times as far.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.homography import Homography, shift
from roadgeo.geometry.mask import PIXEL_TO_PLANE
from roadgeo.geometry.pose import USUAL_FOCAL, USUAL_SIGMA
from roadgeo.kernels.structs import RoadBuckets
from roadgeo.matching.refinement import NO_PAIRS, NOT_HELD, Equations, RefineOptions, denormalise, normalise
from roadgeo.matching.scene import Scene

__all__ = ["FEWEST", "Pose", "correct", "predict", "start"]

#: Standard deviation of a real camera's skews above real ground, and of the log of its focal length between frames.
#: The map of a slope of 10 % has a skew of 0.005.
_SKEW, _REFOCUSING = 0.005, 0.002
#: With fewer road points on roads a frame is not corrected. All points take part, however unsure their places are: the
#: fit does not grow from a part of the frame, for all of it was predicted.
FEWEST, _REFINEMENT = 20, RefineOptions(least_share=0.0, max_radius=(math.inf, 0.0), correlation_m=30.0)


@dataclass(frozen=True)
class Pose:
    """A frame's place.

    Attributes
    ----------
    matrix : (3, 3) float64
        Query plane to reference plane, metres.
    covariance : (9, 9) float64
        Covariance of where it puts the corners, x0 y0 x1 y1 ..., metres, and of `log_focal`.
    frame : Frame
    log_focal : float
        Log of the focal length in halves of the frame's diagonal.
    """

    matrix: FloatArray
    covariance: FloatArray
    frame: Frame
    log_focal: float

    @property
    def homography(self) -> Homography:
        """Pixel to the reference plane."""
        return Homography(self.matrix @ PIXEL_TO_PLANE)

    @property
    def corners(self) -> FloatArray:
        """(4, 2) TL, TR, BR, BL on the reference plane, metres."""
        return self.homography(self.frame.corners)

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
        row = _Local.of(self).by_corners(np.zeros((1, 2)))
        return math.sqrt(float(np.trace(row @ self.covariance[:8, :8] @ row.T)))

    @property
    def corner_sigma_m(self) -> FloatArray:
        """(4,) the same of the corners."""
        return np.asarray(np.sqrt(self.covariance.diagonal()[:8].reshape(4, 2).sum(axis=1)))


def loosened(pose: Pose, shift_m: float) -> Pose:
    """Return a frame that may lie this far away as a whole besides: root mean square of the distance."""
    covariance = pose.covariance.copy()
    covariance[:8, :8] += 0.5 * shift_m**2 * np.tile(np.eye(2), (4, 4))
    return replace(pose, covariance=covariance)


@dataclass(frozen=True)
class _Local:
    """A pose's homography in normalised coordinates (see `matching.refinement.normalise`): p (8,), origin and unit."""

    frame: Frame
    p: FloatArray
    origin: FloatArray
    unit: float

    @classmethod
    def of(cls, pose: Pose) -> _Local:
        return cls(pose.frame, *normalise(pose.matrix, pose.frame.plane_center, pose.frame.half_diagonal))

    @property
    def matrix(self) -> FloatArray:
        """Query plane to reference plane."""
        return denormalise(self.p, self.frame.plane_center, self.frame.half_diagonal, self.origin, self.unit)

    @property
    def corners(self) -> FloatArray:
        """(4, 2) the frame's corners, normalised."""
        return self.query(self.frame.corners)

    def query(self, pixels: FloatArray) -> FloatArray:
        """Normalise pixels (N, 2)."""
        return np.asarray((pixels - self.frame.center) * (1.0, -1.0) / self.frame.half_diagonal)

    def sees(self, uv: FloatArray) -> bool:
        """Whether normalised points (N, 2) lie clearly below the horizon."""
        return bool((1.0 + uv @ self.p[6:] >= 0.05).all())

    def derivative(self, uv: FloatArray) -> FloatArray:
        """Return the derivative (2N, 8) of places of normalised points, metres, by p."""
        return np.asarray(self.unit * Homography(np.append(self.p, 1.0).reshape(3, 3)).by_elements(uv).reshape(-1, 8))

    def by_corners(self, uv: FloatArray) -> FloatArray:
        """Return the derivative (2N, 8) of places of normalised points by the places of the frame's corners."""
        return np.asarray(self.derivative(uv) @ np.linalg.inv(self.derivative(self.corners)))


def start(corners: FloatArray, frame: Frame, covariance: FloatArray) -> Pose:
    """Return the pose of a frame whose corners (4, 2) are known, with their covariance (8, 8), and of a usual lens."""
    middle = corners.mean(axis=0)
    there = (corners - middle).astype(np.float32)  # eastings and northings are large numbers
    matrix = shift(*middle) @ cv2.getPerspectiveTransform(frame.plane_corners.astype(np.float32), there)
    return Pose(matrix, _beside_focal(covariance, USUAL_SIGMA**2), frame, math.log(USUAL_FOCAL))


def predict(pose: Pose, motion: FloatArray, sigma_px: float) -> Pose | None:
    """Return where the next frame lies by its motion, as a camera sees it; None where that cannot be.

    Parameters
    ----------
    motion : (3, 3) float64
        Pixel of the next frame to pixel of this one.
    sigma_px : float
        Standard deviation of where the motion puts a corner.
    """
    local, motion = _Local.of(pose), Homography(motion).facing(pose.frame.center).matrix
    seen = local.query(Homography(motion)(pose.frame.corners))
    if not local.sees(seen):  # NaN neither
        return None
    move = _beside_focal(local.by_corners(seen))
    noise = np.diag([(pose.gsd_m * sigma_px) ** 2 / 2.0] * 8 + [_REFOCUSING**2])
    matrix, covariance = pose.homography.matrix @ motion @ PIXEL_TO_PLANE, move @ pose.covariance @ move.T + noise
    return _as_cameras_see(replace(pose, matrix=matrix, covariance=covariance))


def _beside_focal(matrix: FloatArray, focal: float = 1.0) -> FloatArray:
    """Return a matrix (8, 8) of the corners with a number of the focal length beside it, (9, 9)."""
    return np.block([[matrix, np.zeros((8, 1))], [np.zeros((1, 8)), focal]])


def _as_cameras_see(pose: Pose) -> Pose:
    """Correct a pose by a measurement: both skews of a pinhole, of a focal length that is unknown too, are 0."""
    local = _Local.of(pose)
    to_state = np.linalg.inv(_beside_focal(local.derivative(local.corners)))
    spread = to_state @ pose.covariance @ to_state.T
    given = state = np.append(local.p, pose.log_focal)
    for _ in range(3):
        off, rows = _skews(state)
        gain = np.linalg.solve(rows @ spread @ rows.T + _SKEW**2 * np.eye(2), rows @ spread).T
        state = given - gain @ (off + rows @ (given - state))
    seen = replace(local, p=state[:8])
    if not np.isfinite(state).all() or not seen.sees(local.corners):
        return pose
    back = _beside_focal(seen.derivative(local.corners))
    covariance = back @ (spread - gain @ rows @ spread) @ back.T
    return Pose(seen.matrix, (covariance + covariance.T) / 2.0, pose.frame, float(state[8]))


def _skews(state: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return both skews (2,) of a state, p of `_Local` and log of the focal length, and derivatives (2, 9).

    Two unit vectors on the plane are perpendicular and equally long; how far a camera sees them from that.
    """
    near = state + 1e-6 * np.vstack((np.zeros(9), np.eye(9), -np.eye(9)))
    seen = np.linalg.inv(np.insert(near[:, :8], 8, 1.0, axis=1).reshape(-1, 3, 3))[:, :, :2]
    seen[:, :2] /= np.exp(near[:, 8])[:, None, None]
    (aa, ab), (_, bb) = np.moveaxis(np.swapaxes(seen, 1, 2) @ seen, 0, -1)
    skews = np.stack((ab / np.sqrt(aa * bb), 0.5 * np.log(aa / bb)))
    return skews[:, 0], (skews[:, 1:10] - skews[:, 10:]) / 2e-6


def correct(pose: Pose, scene: Scene, roads: RoadBuckets) -> Pose | None:
    """Lay a frame's roads on the map's, starting from a predicted pose; None where there are too few."""
    begun, before = pose.matrix / pose.matrix[2, 2], pose.covariance[:8, :8]
    refined = Equations(begun, scene, roads, _REFINEMENT, known=before).adjust(NO_PAIRS, NOT_HELD)
    if refined is None or refined.share * len(scene.points) < FEWEST:
        return None
    placed = replace(pose, matrix=Homography(refined.matrix).facing(scene.center).matrix)
    if not np.isfinite(placed.corners).all():
        return None
    # The focal length follows the corners as far as it depended on them.
    follows = np.linalg.solve(before, pose.covariance[:8, 8])
    both = np.vstack((np.eye(8), follows))
    joint = both @ refined.corner_covariance_m2 @ both.T
    joint[8, 8] += pose.covariance[8, 8] - follows @ before @ follows
    log_focal = pose.log_focal + float(follows @ (placed.corners - pose.corners).ravel())
    return replace(placed, covariance=(joint + joint.T) / 2.0, log_focal=log_focal)
