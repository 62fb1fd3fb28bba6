"""A pinhole above level ground by scipy's rotations and least squares."""

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation


def place_pinholes(p, log_focal):
    """Position (3,) and rotation (3, 3) of one pinhole (7,)."""
    tilt = np.array([*p[4:6], 0.0]) * np.exp(p[6] - log_focal)
    rotation = (Rotation.from_rotvec(tilt) * Rotation.from_rotvec([0.0, 0.0, p[3]])).as_matrix()
    return np.array([p[0], p[1], 0.0]) + np.exp(p[2] + p[6]) * rotation[:, 2], rotation


def pinhole_residuals(p, corners):
    """Residuals (9,), or None where a corner lies above the horizon."""
    position, rotation = place_pinholes(p, corners.log_focal)
    rays = np.column_stack([corners.pixels, np.full(4, -np.exp(p[6]))]) @ rotation.T
    if (rays[:, 2] >= 0).any():
        return None
    ground = position + rays * (-position[2] / rays[:, 2:])
    away = corners.weights @ (ground[:, :2] - corners.ground).ravel()
    return np.append(away, (p[6] - corners.log_focal) / corners.log_focal_sigma)


def fit_pinhole(start, corners, reach):
    """Parameters (7,) and their covariance (7, 7), begun from one start; `reach` scales positions, metres."""
    scale = np.array([reach, reach, 1, 1, 1, 1, 1])
    found = least_squares(
        lambda q: pinhole_residuals(q * scale, corners), start / scale, method="lm", xtol=1e-14, ftol=1e-14
    )
    return found.x * scale, np.linalg.inv(found.jac.T @ found.jac) * np.outer(scale, scale)
