"""How far a frame was moved on the ground: a shift, a turn and a change of scale, with their covariance."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo.geometry.similarity import fit_similarity

__all__ = ["Displacement", "measure"]


@dataclass(frozen=True)
class Displacement:
    """The similarity that moves points of the plane from where they were put to where they belong.

    Attributes
    ----------
    about : (2,) float64
        The point that it turns about, on the plane; it moves by the shift alone.
    east_m, north_m : float
        The shift along the plane's axes, metres.
    turn_deg : float
        Clockwise.
    scale : float
        1 where lengths were right.
    covariance : (4, 4) float64
        Covariance of east and north (metres), the turn counter-clockwise (radians) and the scale.
    residual_m : float
        Root mean square of its residuals at the corners: a distortion that is no similarity.
    """

    about: FloatArray
    east_m: float
    north_m: float
    turn_deg: float
    scale: float
    covariance: FloatArray
    residual_m: float

    @property
    def matrix(self) -> FloatArray:
        """(3, 3) affine map of the plane."""
        turn = -math.radians(self.turn_deg)
        a, b = self.scale * math.cos(turn), self.scale * math.sin(turn)
        linear = np.array([[a, -b], [b, a]])
        shift = self.about - linear @ self.about + np.array([self.east_m, self.north_m])
        return np.array([[*linear[0], shift[0]], [*linear[1], shift[1]], [0.0, 0.0, 1.0]])

    def over(self, corners: FloatArray) -> float:
        """Return the root mean square distance, metres, that it moves points of a frame with these corners (4, 2)."""
        return math.sqrt(self._squares(corners) @ self._parameters**2)

    def sigma_over(self, corners: FloatArray) -> float:
        """Return the standard deviation of the displacement of points of such a frame due to its errors, metres."""
        return math.sqrt(self._squares(corners) @ np.diag(self.covariance))

    @property
    def significance(self) -> float:
        """Squares of shift, turn and scale in units of their own errors: chi-square, 4 degrees, if nothing moved."""
        return float(self._parameters @ np.linalg.solve(self.covariance, self._parameters))

    @property
    def _parameters(self) -> FloatArray:
        return np.array([self.east_m, self.north_m, -math.radians(self.turn_deg), self.scale - 1.0])

    def _squares(self, corners: FloatArray) -> FloatArray:
        """Mean squares that unit parameters move points by: of a filled frame, a third of its corners'."""
        spread = float(np.mean(np.sum((corners - self.about) ** 2, axis=1))) / 3.0
        return np.array([1.0, 1.0, spread, spread])


def measure(start: FloatArray, end: FloatArray, end_covariance: FloatArray) -> Displacement:
    """Fit the similarity that takes the corners (4, 2) of a frame from `start` to `end` (see `fit_similarity`).

    Parameters
    ----------
    end_covariance : (8, 8)
        Covariance of x and y of the corners in turn, square metres; positive definite.
    """
    (a, b, *middle), covariance, left = fit_similarity(start, end, end_covariance)
    about, order = start.mean(axis=0), [2, 3, 1, 0]
    east, north = (middle - about).tolist()
    turn_deg, scale = -math.degrees(math.atan2(b, a)), math.hypot(a, b)
    off = float(np.sqrt(np.mean(np.sum(left.reshape(4, 2) ** 2, axis=1))))
    return Displacement(about, east, north, turn_deg, scale, covariance[np.ix_(order, order)], off)
