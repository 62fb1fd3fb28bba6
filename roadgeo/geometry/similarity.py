"""Did the camera look straight down? Then it saw the ground turned, scaled and moved, and nothing else.

A homography has eight parameters, a similarity four. Where an image shows few roads, the other four are noise, and
where it shows none they bend the frame by metres. They are kept only if they are significant by the corners'
covariance. Where they nearly are, they may be real even so, and the uncertainty of the result includes them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.whitening import whitener

__all__ = ["Similarity", "find_similarity", "fit_similarity"]

#: 99 % of chi-squared with four degrees of freedom. Views straight down: 0.2 to 3.3; tilted by 0.1 to 2 degrees, of
#: masks as a segmenter makes them: 24 and more.
_MOST = 13.28


class Similarity(NamedTuple):
    """A similarity as a homography (3, 3), and the covariance (8, 8) of where it puts the corners.

    `by_tilt` (8, 8) is added to that where the camera may not have looked straight down: the parameters set aside
    counts as an error, weighed by the share of level views of which less has to be. Among 958 frames tilted by up to 60
    degrees five were taken for level, and without it were off by two to ten times what was claimed.
    """

    matrix: FloatArray
    corner_covariance: FloatArray
    by_tilt: FloatArray


def find_similarity(homography: FloatArray, corners: FloatArray, corner_covariance: FloatArray) -> Similarity | None:
    """Return the similarity that is consistent with a homography; None without one.

    Generalised least squares of the corners' places on the four parameters; the weighted sum of squared residuals is
    chi-squared with four degrees of freedom if the camera looked straight down.

    Parameters
    ----------
    homography : (3, 3) float64
        Does not mirror.
    corners : (4, 2) float64
        Corners of the frame.
    corner_covariance : (8, 8) float64
        Covariance of their places: x and y of the first, then of the second, and so on.
    """
    if not np.isfinite(corner_covariance).all():
        return None
    places = Homography(homography).everywhere(corners)
    (a, b, *place), covariance, set_aside = fit_similarity(corners, places, corner_covariance)
    square = float(np.sum((whitener(corner_covariance) @ set_aside) ** 2))
    if not square <= _MOST:
        return None
    less = 1.0 - math.exp(-square / 2.0) * (1.0 + square / 2.0)  # chi-squared with four degrees of freedom
    matrix = np.array([[a, -b, 0.0], [b, a, 0.0], [0.0, 0.0, 1.0]])
    middle, design = corners.mean(axis=0), _design(corners)
    matrix[:2, 2] = place - matrix[:2, :2] @ middle
    return Similarity(matrix, np.asarray(design @ covariance @ design.T), less * np.outer(set_aside, set_aside))


def fit_similarity(
    points: FloatArray, places: FloatArray, covariance: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Fit the similarity that takes the corners (4, 2) of a frame to their places, by generalised least squares.

    Corners that are hardly determined, such as the far ones of a frame with roads on one side only, hardly count.

    Parameters
    ----------
    covariance : (8, 8) float64
        Covariance of x and y of the places in turn; positive definite.

    Returns
    -------
    parameters : (4,) float64
        a, b, X, Y of (a x - b y + X, b x + a y + Y), x and y counted from the middle of the corners.
    covariance : (4, 4) float64
        Their covariance.
    left : (8,) float64
        The residuals.
    """
    design, weights, origin = _design(points), whitener(covariance), places.mean(axis=0)
    observed = (places - origin).ravel()
    inverse = np.asarray(np.linalg.inv((weights @ design).T @ (weights @ design)))
    parameters = inverse @ (weights @ design).T @ (weights @ observed)
    return parameters + np.append([0.0, 0.0], origin), inverse, observed - design @ parameters


def _design(points: FloatArray) -> FloatArray:
    """Return the derivative (8, 4) of the places of corners by the parameters of a similarity."""
    (x, y), zero, ones = (points - points.mean(axis=0)).T, np.zeros(4), np.ones(4)
    return np.stack([np.c_[x, -y, ones, zero], np.c_[y, x, zero, ones]], axis=1).reshape(8, 4)
