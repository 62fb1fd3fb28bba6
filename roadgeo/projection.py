"""The metric plane of a reference: which CRS, and the local origin that keeps numbers small."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roadgeo.typing import FloatArray

__all__ = ["LocalPlane"]


@dataclass(frozen=True)
class LocalPlane:
    """A metric CRS and an origin in it: plane (x, y) = CRS (easting, northing) - origin, metres, y up.

    Attributes
    ----------
    crs : str
        "EPSG:n" where there is a code, else WKT2.
    origin : (float, float)
        Easting and northing of the plane's (0, 0): UTM northings of 4.7e6 squared would ruin a linear solve.
    """

    crs: str
    origin: tuple[float, float]

    def to_crs(self, xy: FloatArray) -> FloatArray:
        """Plane metres (..., 2) to CRS coordinates."""
        return np.asarray(xy, float) + self.origin

    def from_crs(self, en: FloatArray) -> FloatArray:
        """CRS coordinates (..., 2) to plane metres."""
        return np.asarray(en, float) - self.origin

    def to_crs_matrix(self) -> FloatArray:
        """(3, 3) homography from the plane to the CRS."""
        return np.array([[1.0, 0.0, self.origin[0]], [0.0, 1.0, self.origin[1]], [0.0, 0.0, 1.0]])
