"""The frame of an image: its size, and the points that everything asks of it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from roadgeo._arrays import FloatArray

__all__ = ["Frame", "polygon_area"]


@dataclass(frozen=True)
class Frame:
    """Width and height of an image, pixels. Positions are (column, row) in GDAL's corner convention."""

    width: float
    height: float

    @property
    def corners(self) -> FloatArray:
        """(4, 2) pixel positions of the corners TL, TR, BR, BL."""
        return np.array([[0.0, 0.0], [self.width, 0.0], [self.width, self.height], [0.0, self.height]])

    def grid(self, n: int, margin: float = 0.0) -> FloatArray:
        """Return (n * n, 2) pixel positions on a grid over the frame, but for a margin that is a share of each side."""
        along = np.linspace(margin, 1.0 - margin, n)
        return np.stack(np.meshgrid(along * self.width, along * self.height), axis=-1).reshape(-1, 2)

    def outline(self, n: int = 8) -> FloatArray:
        """Return (4 n, 2) pixel positions along the sides, clockwise from the top left corner."""
        corners = self.corners
        return np.linspace(corners, np.roll(corners, -1, axis=0), n, endpoint=False, axis=1).reshape(-1, 2)

    @property
    def center(self) -> FloatArray:
        """(2,) pixel position of the middle."""
        return np.array([self.width / 2, self.height / 2])

    @property
    def half_diagonal(self) -> float:
        """Distance from the middle to a corner, pixels."""
        return math.hypot(self.width, self.height) / 2

    def one_place_m(self, gsd_m: float) -> float:
        """Return how near two places of a frame of `gsd_m` metres per pixel lie, by their middles, that are one."""
        return max(50.0, 0.05 * gsd_m * self.half_diagonal)

    @property
    def plane_corners(self) -> FloatArray:
        """(4, 2) corners TL, TR, BR, BL on the query plane: y up (see `geometry.mask`)."""
        return self.corners * (1.0, -1.0)

    @property
    def plane_center(self) -> FloatArray:
        """(2,) the middle on the query plane: y up."""
        return self.center * (1.0, -1.0)


def polygon_area(corners: FloatArray) -> float:
    """Compute the area of a simple polygon (K, 2), whichever way round it goes, closed or not."""
    x, y = (corners - corners.mean(axis=0)).T
    return abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1))) / 2
