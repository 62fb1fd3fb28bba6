"""A pinhole above level ground, fitted to where the corners of its frame lie (see `geometry.pose`).

Its parameters p are x and y where its axis meets the ground, log metres per pixel there, its heading, its tilt about
two axes were its focal length that of `log_focal`, and the log of its focal length, with which the tilt grows in
proportion.
"""

import math
from typing import NamedTuple

import numpy as np

from roadgeo.kernels.arrays import Floats1, Floats2, Floats3
from roadgeo.kernels.compilation import kernel
from roadgeo.kernels.homography_fit import cholesky, solve_cholesky

__all__ = ["SeenCorners", "fit_pinhole", "pinhole_residuals", "place_pinholes"]

N_PARAMETERS, N_RESIDUALS = 7, 9


class SeenCorners(NamedTuple):
    """What is fitted to, and the prior on the focal length.

    `pixels` (4, 2) are the corners from the middle of the frame, y up; `ground` (4, 2) where they lie, metres;
    `weights` (8, 8) whiten how far off they are; `log_focal` and its standard deviation are those of usual lenses.
    """

    pixels: Floats2
    ground: Floats2
    weights: Floats2
    log_focal: float
    log_focal_sigma: float


@kernel()
def _place(p: Floats1, log_focal: float, position: Floats1, rotation: Floats2) -> None:
    """Fill position (3,) and rotation (3, 3), camera axes to x, y and up, of parameters (7,)."""
    grown = math.exp(p[6] - log_focal)
    a, b = p[4] * grown, p[5] * grown
    angle = math.hypot(a, b)
    # Rodrigues: sin(angle) / angle and (1 - cos) / angle^2, also where that is 0 / 0
    s = math.sin(angle) / angle if angle > 1e-8 else 1.0
    h = 0.5 * (math.sin(0.5 * angle) / (0.5 * angle)) ** 2 if angle > 1e-8 else 0.5
    cos, sin = math.cos(p[3]), math.sin(p[3])
    rows = (
        (1.0 - h * b * b, h * a * b, s * b),
        (h * a * b, 1.0 - h * a * a, -s * a),
        (-s * b, s * a, 1.0 - h * (a * a + b * b)),
    )
    reach = math.exp(p[2] + p[6])
    for k in range(3):
        x, y, z = rows[k]
        rotation[k, 0], rotation[k, 1], rotation[k, 2] = x * cos + y * sin, y * cos - x * sin, z
        position[k] = reach * z + (p[k] if k < 2 else 0.0)


@kernel(writes=("positions", "rotations"))
def place_pinholes(parameters: Floats2, log_focal: float, positions: Floats2, rotations: Floats3) -> None:
    """Tell where pinholes are and how they point.

    Parameters
    ----------
    parameters : (N, 7) float64
    positions : (N, 3) float64
        Filled, metres.
    rotations : (N, 3, 3) float64
        Filled: camera axes to x, y and up.
    """
    for n in range(parameters.shape[0]):
        _place(parameters[n], log_focal, positions[n], rotations[n])


@kernel(writes=("out",))
def pinhole_residuals(p: Floats1, corners: SeenCorners, out: Floats1) -> bool:
    """Fill how far the corners are from where they are seen, whitened, and the focal length from usual ones, (9,).

    Returns whether all corners lie below the horizon; otherwise nothing is filled.
    """
    position, rotation, away = np.empty(3), np.empty((3, 3)), np.empty(8)
    _place(p, corners.log_focal, position, rotation)
    focal = math.exp(p[6])
    for i in range(4):
        u, v = corners.pixels[i, 0], corners.pixels[i, 1]
        down = rotation[2, 0] * u + rotation[2, 1] * v - rotation[2, 2] * focal
        if not down < 0.0:
            return False
        reach = -position[2] / down
        for k in range(2):
            ray = rotation[k, 0] * u + rotation[k, 1] * v - rotation[k, 2] * focal
            away[2 * i + k] = position[k] + reach * ray - corners.ground[i, k]
    for i in range(8):
        out[i] = 0.0
        for k in range(8):
            out[i] += corners.weights[i, k] * away[k]
    out[8] = (p[6] - corners.log_focal) / corners.log_focal_sigma
    return True


@kernel()
def _normal_equations(
    p: Floats1, r: Floats1, scale: Floats1, corners: SeenCorners, normal: Floats2, gradient: Floats1
) -> bool:
    """Fill J^T J (7, 7) and J^T r (7,), differentiated from both sides; return whether all of that is seen."""
    jacobian, moved = np.empty((N_RESIDUALS, N_PARAMETERS)), p.copy()
    after, before = np.empty(N_RESIDUALS), np.empty(N_RESIDUALS)
    for k in range(N_PARAMETERS):
        step = 1e-6 * scale[k]
        moved[k] = p[k] + step
        seen = pinhole_residuals(moved, corners, after)
        moved[k] = p[k] - step
        if not (pinhole_residuals(moved, corners, before) and seen):
            return False
        moved[k] = p[k]
        for i in range(N_RESIDUALS):
            jacobian[i, k] = (after[i] - before[i]) / (2.0 * step)
    for a in range(N_PARAMETERS):
        gradient[a] = 0.0
        for i in range(N_RESIDUALS):
            gradient[a] += jacobian[i, a] * r[i]
        for b in range(N_PARAMETERS):
            normal[a, b] = 0.0
            for i in range(N_RESIDUALS):
                normal[a, b] += jacobian[i, a] * jacobian[i, b]
    return True


@kernel()
def _squares(values: Floats1) -> float:
    total = 0.0
    for value in values:
        total += value * value
    return total


@kernel()
def _copy(source: Floats1, to: Floats1) -> None:
    for k in range(to.shape[0]):
        to[k] = source[k]


@kernel(writes=("p", "covariance"))
def fit_pinhole(starts: Floats2, corners: SeenCorners, n_iterations: int, p: Floats1, covariance: Floats2) -> bool:
    """Fit a pinhole by Levenberg and Marquardt, from the start that is nearest; return whether that worked.

    Parameters
    ----------
    starts : (S, 7) float64
    p : (7,) float64
        Filled.
    covariance : (7, 7) float64
        Filled: of p.
    """
    r, tried, moved = np.empty(N_RESIDUALS), np.empty(N_RESIDUALS), np.empty(N_PARAMETERS)
    least = np.inf
    for s in range(starts.shape[0]):
        if pinhole_residuals(starts[s], corners, tried) and _squares(tried) < least:
            least = _squares(tried)
            _copy(starts[s], p)
            _copy(tried, r)
    if not least < np.inf:
        return False
    scale, normal, gradient = np.ones(N_PARAMETERS), np.empty((N_PARAMETERS, N_PARAMETERS)), np.empty(N_PARAMETERS)
    scale[0] = scale[1] = math.exp(p[2] + p[6])
    damped, factor, step = np.empty_like(normal), np.empty_like(normal), np.empty(N_PARAMETERS)
    damping = 1e-3
    for _ in range(n_iterations):
        if not _normal_equations(p, r, scale, corners, normal, gradient):
            return False
        for k in range(N_PARAMETERS):
            _copy(normal[k], damped[k])
            damped[k, k] *= 1.0 + damping
            step[k] = -gradient[k]
        if not cholesky(damped, factor):
            return False
        solve_cholesky(factor, step)
        longest = 0.0
        for k in range(N_PARAMETERS):
            longest = max(longest, abs(step[k] / scale[k]))
        for k in range(N_PARAMETERS):
            moved[k] = p[k] + step[k] / max(longest, 1.0)  # no further than by its height, or a radian
        now = _squares(tried) if pinhole_residuals(moved, corners, tried) else np.inf
        if not now <= least:
            if longest < 1e-9:
                break
            damping *= 10.0
            continue
        done = least - now < 1e-9 * least + 1e-12
        _copy(moved, p)
        _copy(tried, r)
        least, damping = now, damping / 10.0
        if done:
            break
    if not (_normal_equations(p, r, scale, corners, normal, gradient) and cholesky(normal, factor)):
        return False
    for k in range(N_PARAMETERS):
        for i in range(N_PARAMETERS):
            covariance[k, i] = 1.0 if i == k else 0.0
        solve_cholesky(factor, covariance[k])
    position, rotation = np.empty(3), np.empty((3, 3))
    _place(p, corners.log_focal, position, rotation)
    return bool(position[2] > 0.0)
