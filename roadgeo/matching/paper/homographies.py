"""The homography that a hypothesis of the paper stands for, and its refinement on matched points."""

from __future__ import annotations

import math

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo.geometry.homography import Homography

__all__ = ["fit_points", "pair_homography", "to_pair_frame"]


def to_pair_frame(xy: FloatArray, first: FloatArray, second: FloatArray) -> FloatArray:
    """Take (N, 2) points to the frame where `first` is (0, 0) and `second` is (1, 0), turned and scaled alike."""
    dx, dy = (second - first) / np.sum((second - first) ** 2)
    return np.asarray((xy - first) @ np.array([[dx, -dy], [dy, dx]]))


def pair_homography(model: FloatArray, first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the (3, 3) homography of a hypothesis (see `kernels.pairs.evaluate_pairs`) on the query plane."""
    alpha_1, beta_1, alpha_2, beta_2, x, y, dx, dy = model
    from_pair_frame = np.array([[dx, -dy, x], [dy, dx, y], [0.0, 0.0, 1.0]])
    in_pair_frame = np.array([[alpha_1, beta_1, 0.0], [0.0, 1.0, 0.0], [alpha_1 - alpha_2, beta_1 - beta_2, alpha_2]])
    ex, ey = (second - first) / np.sum((second - first) ** 2)
    to_pair_frame = np.array(
        [[ex, ey, -ex * first[0] - ey * first[1]], [-ey, ex, ey * first[0] - ex * first[1]], [0, 0, 1]]
    )
    return np.asarray(from_pair_frame @ in_pair_frame @ to_pair_frame)


def fit_points(homography: FloatArray, query_xy: FloatArray, reference_xy: FloatArray) -> FloatArray:
    """Minimise the squared distances |H x - x'| over all pairs of points by Gauss-Newton, from a given homography.

    Gold standard for errors in the reference plane only (Hartley & Zisserman, section 4.2). Both planes are moved and
    scaled to mean 0 and unit spread first. Returns the given homography where the points cannot carry eight parameters.
    """
    if len(query_xy) < 4:
        return homography
    to_query, to_reference = _normalising(query_xy), _normalising(reference_xy)
    p = query_xy * to_query[0, 0] + to_query[:2, 2]
    target = reference_xy * to_reference[0, 0] + to_reference[:2, 2]
    h = to_reference @ homography @ np.linalg.inv(to_query)
    cost, best = np.inf, h
    for _ in range(10):
        h = h / h[2, 2]
        image = Homography(h).everywhere(p)
        residual = target - image
        if not np.sum(residual**2) < cost * (1 - 1e-12):
            break
        cost, best = float(np.sum(residual**2)), h
        # the rows of x, then those of y
        jacobian = Homography(h).by_elements(p).transpose(1, 0, 2).reshape(-1, 8)
        step = np.linalg.lstsq(jacobian, residual.T.ravel(), rcond=None)[0]
        h = h + np.append(step, 0.0).reshape(3, 3)
    return np.asarray(np.linalg.inv(to_reference) @ best @ to_query)


def _normalising(xy: FloatArray) -> FloatArray:
    """Return the (3, 3) similarity that gives points mean 0 and rms distance sqrt 2 (Hartley & Zisserman 4.4.4)."""
    mean = xy.mean(axis=0)
    spread = math.sqrt(np.mean(np.sum((xy - mean) ** 2, axis=1)) / 2)
    scale = 1.0 / spread if spread > 0 else 1.0
    return np.array([[scale, 0.0, -scale * mean[0]], [0.0, scale, -scale * mean[1]], [0.0, 0.0, 1.0]])
