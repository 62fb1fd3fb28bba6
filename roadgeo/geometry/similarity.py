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

__all__ = ["Similarity", "find_similarity"]

#: 99 % of chi-squared with four degrees of freedom. Views straight down: 0.2 to 3.3; tilted by 0.1 to 2 degrees, of
#: masks as a segmenter makes them: 24 and more.
_MOST = 13.28


class Similarity(NamedTuple):
    """A similarity as a homography (3, 3), and the covariance (8, 8) of where it puts the corners.

    `doubt` (8, 8) is added to that where the camera may not have looked straight down: the parameters set aside
    counts as an error, weighed by the share of level views of which less has to be. Among 958 frames tilted by up to 60
    degrees five were taken for level, and without it were off by two to ten times what was claimed.
    """

    matrix: FloatArray
    corner_covariance: FloatArray
    doubt: FloatArray


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
    places, middle = Homography(homography).everywhere(corners), corners.mean(axis=0)
    origin = places.mean(axis=0)
    # X = a x - b y + X0, Y = b x + a y + Y0
    (x, y), zero, ones = (corners - middle).T, np.zeros(4), np.ones(4)
    design = np.stack([np.c_[x, -y, ones, zero], np.c_[y, x, zero, ones]], axis=1).reshape(8, 4)
    weights, observed = whitener(corner_covariance), (places - origin).ravel()
    covariance = np.linalg.inv((weights @ design).T @ (weights @ design))
    parameters = covariance @ (weights @ design).T @ (weights @ observed)
    set_aside = observed - design @ parameters
    square = float(np.sum((weights @ set_aside) ** 2))
    if not square <= _MOST:
        return None
    less = 1.0 - math.exp(-square / 2.0) * (1.0 + square / 2.0)  # chi-squared with four degrees of freedom
    a, b = parameters[:2]
    matrix = np.array([[a, -b, 0.0], [b, a, 0.0], [0.0, 0.0, 1.0]])
    matrix[:2, 2] = origin + parameters[2:] - matrix[:2, :2] @ middle
    return Similarity(matrix, np.asarray(design @ covariance @ design.T), less * np.outer(set_aside, set_aside))
