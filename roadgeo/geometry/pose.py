"""Where the camera was and how it pointed, from where the corners of its frame lie on the ground, with covariance.

Four points determine a homography, so the corners of a frame and their covariance hold all information on the camera.
A pinhole with square pixels whose axis meets the middle of the frame, above level ground, has six unknowns, or seven
with its focal length. They are fitted to the corners by least squares, each corner weighed as its errors demand.

Looking straight down, focal length and height cannot be separated: a lens half as long at half the height sees the
same. So an unknown focal length has a prior from usual lenses; where the homography does not determine it, it keeps
the prior's width, and so does the height. The parameters are chosen so that a focal length that is hardly determined
changes without the others: where the axis meets the ground, metres per pixel there, and tilt per focal length. With
position and angles themselves the sum of squares has a long, bent valley, in which an adjustment hardly moves.

Camera axes: x to the right, y to the image's top, z backwards, so that a camera without rotation looks straight down
with its top to the north.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.homography import Homography, shift
from roadgeo.geometry.whitening import whitener

__all__ = ["USUAL_FOCAL", "USUAL_SIGMA", "Pose", "find_pose", "turned"]

#: Focal length of usual lenses, in halves of the frame's diagonal, and the standard deviation of its log: between 35
#: and 85 degrees across the diagonal.
USUAL_FOCAL, USUAL_SIGMA = 1.5, 0.45
#: The homography counts as determining the focal length if its log has this standard deviation or less.
_DETERMINED = 0.15
#: Focal lengths that an adjustment may start from, in usual ones; its steps.
_FACTORS, _STEPS = (0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 3.0), 30


@dataclass(frozen=True)
class Pose:
    """A camera above the plane.

    Attributes
    ----------
    position : (3,) float64
        x, y on the plane and height above it, metres.
    rotation : (3, 3) float64
        Camera axes to x, y of the plane and up.
    covariance : (6, 6) float64
        Covariance of the position, metres, and of heading, pitch and roll, degrees.
    focal_px, focal_sigma_px : float
        Focal length and its standard deviation: 0 where it was given.
    source : str
        Origin of the focal length: the given "camera", the "homography", or a usual lens that is "assumed".
    """

    position: FloatArray
    rotation: FloatArray
    covariance: FloatArray
    focal_px: float
    focal_sigma_px: float
    source: Literal["camera", "homography", "assumed"]

    @property
    def angles_deg(self) -> FloatArray:
        """Heading, pitch, roll of an aircraft that looks straight down from its belly, its nose at the image's top.

        Heading clockwise from the plane's y axis, pitch positive with the nose up, roll with the right wing down.
        """
        return _angles(self.rotation)

    @property
    def tilt_deg(self) -> float:
        """Angle of the optical axis from the vertical."""
        return math.degrees(math.acos(min(1.0, float(self.rotation[2, 2]))))


def find_pose(
    homography: FloatArray, size: tuple[int, int], corner_covariance: FloatArray, focal_px: float | None = None
) -> Pose | None:
    """Find the camera behind a homography; None where no camera above the ground sees it.

    Parameters
    ----------
    homography : (3, 3) float64
        Pixel (column, row; corner convention) to plane metres, x east and y north.
    corner_covariance : (8, 8) float64
        Covariance of the corners' x and y on the plane, square metres (see `Location.corner_covariance_m2`).
    focal_px : float, optional
        Focal length, pixels of the frame, where it is known.
    """
    frame = Frame(*size)
    corners = Homography(homography).facing(frame.center)(frame.corners)
    if not np.isfinite(corners).all():
        return None
    origin = np.append(corners.mean(axis=0), 0.0)  # eastings and northings are large numbers
    homography, corners = shift(-origin[0], -origin[1]) @ homography, corners - origin[:2]
    usual = USUAL_FOCAL * frame.half_diagonal
    tried = [focal_px] if focal_px else [usual * factor for factor in _FACTORS]
    prior = math.log(focal_px or usual), 1e-6 if focal_px else USUAL_SIGMA
    targets = CornerTargets((frame.corners - frame.center) * (1.0, -1.0), corners, whitener(corner_covariance), *prior)
    fitted = fit_pinhole(_starts(homography, frame, np.array(tried), targets.log_focal), targets)
    if fitted is None:
        return None
    pose = _describe(*fitted, targets.log_focal, bool(focal_px))
    return replace(pose, position=pose.position + origin)


class CornerTargets(NamedTuple):
    """The corners fitted to, and the prior on the focal length.

    `pixels` (4, 2) are the corners from the middle of the frame, y up; `ground` (4, 2) where they lie, metres;
    `weights` (8, 8) whiten how far off they are; `log_focal` and its standard deviation come from usual lenses.
    """

    pixels: FloatArray
    ground: FloatArray
    weights: FloatArray
    log_focal: float
    log_focal_sigma: float


def fit_pinhole(
    starts: FloatArray, targets: CornerTargets, n_iterations: int = _STEPS
) -> tuple[FloatArray, FloatArray] | None:
    """Fit a pinhole by Levenberg and Marquardt, from the start (S, 7) that is nearest; None where that fails.

    Return its parameters (7,) and their covariance (7, 7).
    """

    def off(p: FloatArray) -> FloatArray:
        return pinhole_residuals(p, targets)

    sums = (off(starts) ** 2).sum(axis=-1)
    if not np.isfinite(sums).any():
        return None
    p = starts[int(sums.argmin())]
    r, least, damping = off(p), float(sums.min()), 1e-3
    scale = np.array([math.exp(p[2] + p[6])] * 2 + [1.0] * 5)
    for _ in range(n_iterations):
        jacobian = _differentiate(off, p, scale)
        if not np.isfinite(jacobian).all():
            return None
        normal = jacobian.T @ jacobian
        step = -np.linalg.pinv(normal + damping * np.diag(np.diag(normal)), hermitian=True) @ (jacobian.T @ r)
        longest = float(np.abs(step / scale).max())
        moved = p + step / max(longest, 1.0)  # no further than by its height, or a radian
        tried = off(moved)
        now = float(tried @ tried)
        if not now <= least:
            if longest < 1e-9:
                break
            damping *= 10.0
            continue
        done = least - now < 1e-9 * least + 1e-12
        p, r, least, damping = moved, tried, now, damping / 10.0
        if done:
            break
    jacobian = _differentiate(off, p, scale)
    if not np.isfinite(jacobian).all() or np.linalg.matrix_rank(jacobian / np.linalg.norm(jacobian, axis=0)) < 7:
        return None
    (_, _, height), _ = _place(p, targets.log_focal)
    return (p, np.asarray(np.linalg.inv(jacobian.T @ jacobian))) if height > 0.0 else None


def pinhole_residuals(p: FloatArray, targets: CornerTargets) -> FloatArray:
    """Return how far off corners are, whitened, and the focal length from usual ones, (..., 9) of parameters (..., 7).

    The parameters are x and y where the axis meets the ground, log metres per pixel there, the heading, the tilt about
    two axes were the focal length as in `log_focal`, and the log of the focal length, with which the tilt grows in
    proportion. Infinite where a corner does not lie below the horizon.
    """
    positions, rotations = _place(p, targets.log_focal)
    corners = np.broadcast_to(targets.pixels, (*p.shape[:-1], 4, 2))
    focal = np.broadcast_to(-np.exp(p[..., 6])[..., None, None], (*p.shape[:-1], 4, 1))
    rays = np.concatenate((corners, focal), axis=-1) @ np.swapaxes(rotations, -1, -2)
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = positions[..., 2, None] / rays[..., 2]
        away = positions[..., None, :2] - reach[..., None] * rays[..., :2] - targets.ground
    whitened = away.reshape(*p.shape[:-1], 8) @ targets.weights.T
    prior = (p[..., 6:] - targets.log_focal) / targets.log_focal_sigma
    below = np.asarray((rays[..., 2] < 0.0).all(axis=-1))[..., None]
    return np.asarray(np.where(below, np.concatenate((whitened, prior), axis=-1), np.inf))


def _starts(homography: FloatArray, frame: Frame, focals: FloatArray, log_focal: float) -> FloatArray:
    """Return parameters (S, 7) of pinholes of some focal lengths that nearly see a homography, above the ground.

    They are as in `pinhole_residuals`.
    """
    middle = frame.center
    to_middle = np.array([[1.0, 0.0, -middle[0]], [0.0, -1.0, middle[1]], [0.0, 0.0, 1.0]])
    seen_by = to_middle @ Homography(homography).facing(middle).inverse().matrix
    rotations, positions = _take_apart(seen_by, focals)
    above = (positions[:, 2] > 0.0) & (rotations[:, 2, 2] > 1e-3)
    rotations, positions, focals = rotations[above], positions[above], focals[above]
    up = rotations[:, :, 2]
    reach = positions[:, 2:] / up[:, 2:]
    tilt = _tilts_to(up)
    right = (np.swapaxes(_rotation(tilt), 1, 2) @ rotations)[:, :, 0]
    ground, lean = (positions - reach * up)[:, :2], tilt[:, :2] / np.exp(np.log(focals) - log_focal)[:, None]
    logs, heading = np.log(reach[:, 0] / focals), np.arctan2(right[:, 1], right[:, 0])
    return np.column_stack([ground, logs, heading, lean, np.log(focals)])


def _take_apart(seen_by: FloatArray, focals: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Take the plane's homography to pixels, from the middle, y up, apart for (F,) focal lengths (Zhang 2000, 3.1).

    Returns
    -------
    rotations : (F, 3, 3) float64
        Their rows are the plane's axes in the camera's.
    positions : (F, 3) float64
    """
    m = np.stack([1.0 / focals, 1.0 / focals, -np.ones_like(focals)], axis=1)[:, :, None] * seen_by
    lengths = np.linalg.norm(m, axis=1)
    m = m / np.sqrt(lengths[:, 0] * lengths[:, 1])[:, None, None]
    u, _, vt = np.linalg.svd(m[:, :, :2], full_matrices=False)
    axes = np.swapaxes(u @ vt, 1, 2)
    rotations = np.concatenate((axes, np.cross(axes[:, :1], axes[:, 1:])), axis=1)
    return rotations, -np.einsum("fij,fj->fi", rotations, m[:, :, 2])


def _differentiate(function: Callable[[FloatArray], FloatArray], p: FloatArray, scale: FloatArray) -> FloatArray:
    """Differentiate a vector of values by the parameters, from both sides; the function takes many at once."""
    steps = np.diag(1e-6 * scale)
    after, before = function(p + np.stack((steps, -steps)))
    return np.asarray((after - before).T / (2e-6 * scale))


def _place(parameters: FloatArray, log_focal: float) -> tuple[FloatArray, FloatArray]:
    """Return positions (..., 3) and rotations (..., 3, 3) of pinholes (..., 7)."""
    nothing = np.zeros_like(parameters[..., :1])
    tilt = np.concatenate((parameters[..., 4:6] * np.exp(parameters[..., 6:] - log_focal), nothing), axis=-1)
    heading = np.concatenate((nothing, nothing, parameters[..., 3:4]), axis=-1)
    tilted, turned_by = _rotation(np.stack((tilt, heading)))
    rotations = tilted @ turned_by
    reach = np.exp(parameters[..., 2:3] + parameters[..., 6:])
    ground = np.concatenate((parameters[..., :2], nothing), axis=-1)
    return ground + reach * rotations[..., 2], rotations


def _describe(p: FloatArray, covariance: FloatArray, log_focal: float, is_given: bool) -> Pose:
    """Take parameters and their covariance to position and angles and their covariance.

    `is_given`: the focal length is the camera's own.
    """
    position, rotation = _place(p, log_focal)

    def placed(parameters: FloatArray) -> FloatArray:
        positions, rotations = _place(parameters, log_focal)
        away = (_angles(rotations) - _angles(rotation) + 180.0) % 360.0 - 180.0
        return np.concatenate((positions, away), axis=-1)

    reach = math.exp(p[2] + p[6])
    to = _differentiate(placed, p, np.array([reach, reach] + [1.0] * 5))
    focal, sigma = math.exp(p[6]), math.sqrt(covariance[6, 6])
    source: Literal["camera", "homography", "assumed"] = "homography" if sigma < _DETERMINED else "assumed"
    if is_given:
        source, sigma = "camera", 0.0
    return Pose(position, rotation, to @ covariance @ to.T, focal, focal * sigma, source)


# --- rotations --------------------------------------------------------------------------------------------------------


def _rotation(vector: FloatArray) -> FloatArray:
    """Return the rotations (..., 3, 3) about vectors (..., 3) by their length, radians (Rodrigues)."""
    angle = np.linalg.norm(vector, axis=-1)[..., None, None]
    x, y, z = np.moveaxis(vector, -1, 0)
    none = np.zeros_like(x)
    cross = np.stack((none, -z, y, z, none, -x, -y, x, none), axis=-1).reshape(*vector.shape[:-1], 3, 3)
    half = 0.5 * np.sinc(angle / (2.0 * math.pi)) ** 2  # (1 - cos) / angle^2, also where that is 0 / 0
    return np.asarray(np.eye(3) + np.sinc(angle / math.pi) * cross + half * (cross @ cross))


def _tilts_to(up: FloatArray) -> FloatArray:
    """Return the level vectors (S, 3), turns by their length, radians, that take (0, 0, 1) to directions (S, 3)."""
    level = np.hypot(up[:, 0], up[:, 1])
    by = np.divide(np.arctan2(level, up[:, 2]), level, out=np.zeros_like(level), where=level > 0.0)
    return np.column_stack([-up[:, 1] * by, up[:, 0] * by, np.zeros_like(by)])


def _angles(rotation: FloatArray) -> FloatArray:
    """Return heading, pitch and roll (..., 3) of rotations (..., 3, 3); see `Pose.angles_deg`."""
    right, ahead, up = np.moveaxis(rotation, -1, 0)
    heading = np.arctan2(ahead[..., 0], ahead[..., 1])
    pitch = np.arcsin(np.clip(ahead[..., 2], -1.0, 1.0))
    return np.asarray(np.degrees(np.stack((heading, pitch, np.arctan2(-right[..., 2], up[..., 2])), axis=-1)))


def turned(rotation: FloatArray, clockwise_deg: float) -> FloatArray:
    """Return a rotation counted from a north that lies this angle clockwise of the plane's y axis."""
    return _rotation(np.array([0.0, 0.0, math.radians(clockwise_deg)])) @ rotation
