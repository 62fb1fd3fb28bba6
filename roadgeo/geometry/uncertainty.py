"""How far the middle of a frame may be off, by the covariance of its corners."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from roadgeo._arrays import FloatArray

__all__ = ["CenterError", "corner_sigmas"]


class CenterError(NamedTuple):
    """How far the middle of a frame may be off.

    Attributes
    ----------
    along_m, across_m : float
        Greatest standard deviation of all directions, and that at right angles to it.
    azimuth_deg : float
        Direction of the greatest, clockwise from the north of the CRS, 0 to 180.
    """

    along_m: float
    across_m: float
    azimuth_deg: float

    @classmethod
    def of(cls, covariance: FloatArray) -> CenterError:
        """Compute it from the covariance (8, 8) of the corners' x and y: the middle is taken for their mean."""
        mean = np.tile(np.eye(2), 4) / 4.0
        (across, along), axes = np.linalg.eigh(mean @ covariance @ mean.T)
        east, north = axes[:, 1]
        azimuth = math.degrees(math.atan2(east, north)) % 180.0
        return cls(math.sqrt(max(along, 0.0)), math.sqrt(max(across, 0.0)), azimuth)


def corner_sigmas(covariance: FloatArray) -> FloatArray:
    """Return the standard deviations (4,) of corners from the covariance (8, 8) of their x and y."""
    return np.asarray(np.sqrt(np.diag(covariance).reshape(4, 2).sum(axis=1)))
