"""Homographies of the plane: x_ref = H x_query.

`H` is scaled so that w > 0 over the image; then det H > 0 means "not mirrored". Estimation lives in `matching`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from roadgeo._arrays import BoolArray, FloatArray

__all__ = ["Homography", "map_each", "shift"]


@dataclass(frozen=True)
class Homography:
    """A 3 x 3 matrix that takes points of one plane to another."""

    matrix: FloatArray

    def __call__(self, xy: FloatArray) -> FloatArray:
        """Map (..., 2) points; those beyond the horizon (w <= 0) become NaN."""
        with np.errstate(divide="ignore", invalid="ignore"):
            mapped = self._homogeneous(xy)
            return np.where(mapped[..., 2:] > 0, mapped[..., :2] / mapped[..., 2:], np.nan)

    def everywhere(self, xy: FloatArray) -> FloatArray:
        """Map (..., 2) points, also beyond the horizon: quicker where no point lies there (w > 0 over the image)."""
        mapped = self._homogeneous(xy)
        return np.asarray(mapped[..., :2] / mapped[..., 2:])

    def ahead(self, xy: FloatArray) -> BoolArray:
        """Return which of (..., 2) points lie on this side of the horizon."""
        return np.asarray(self.w(xy) > 0)

    def w(self, xy: FloatArray) -> FloatArray:
        """Return the denominators w of the images of (..., 2) points, (...,)."""
        return np.asarray(self._homogeneous(xy)[..., 2])

    def _homogeneous(self, xy: FloatArray) -> FloatArray:
        """Return (..., 3) homogeneous coordinates of where points (..., 2) come to lie."""
        return np.asarray(np.asarray(xy, float) @ self.matrix[:, :2].T + self.matrix[:, 2])

    def inverse(self) -> Homography:
        """Return the map back; where w was positive it is so again, as H^-1 (H x) = x has the third element 1."""
        return Homography(np.asarray(np.linalg.inv(self.matrix), np.float64))

    def __matmul__(self, other: Homography) -> Homography:
        """Compose: (A @ B)(x) = A(B(x))."""
        return Homography(self.matrix @ other.matrix)

    def jacobian(self, xy: FloatArray) -> FloatArray:
        """Return the (..., 2, 2) derivative d(x', y') / d(x, y) at (..., 2) points with w > 0."""
        w = self.w(xy)
        image = self.everywhere(xy)
        linear = self.matrix[:2, :2] - image[..., :, None] * self.matrix[2, :2]
        return np.asarray(linear / w[..., None, None])

    def area_scale(self, x: float, y: float) -> float:
        """Return how many times larger areas become around a point, det H / w^3; negative where they are mirrored."""
        (a, b, c), (d, e, f), (g, h, i) = self.matrix.tolist()
        w = g * x + h * y + i
        determinant = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
        cube = w * w * w
        return float(determinant / cube) if cube else math.inf

    def by_elements(self, xy: FloatArray) -> FloatArray:
        """Return the (N, 2, 8) derivative of mapped points by the matrix's elements but the last, at (N, 2) points."""
        mapped, rows = self._homogeneous(xy), np.ones((len(xy), 3))
        rows[:, :2] = xy
        rows /= mapped[:, 2:]
        image, derivative = mapped[:, :2] / mapped[:, 2:], np.zeros((len(xy), 2, 8))
        derivative[:, 0, 0:3] = derivative[:, 1, 3:6] = rows
        derivative[:, :, 6:8] = -image[:, :, None] * rows[:, None, :2]
        return derivative

    def facing(self, xy: FloatArray) -> Homography:
        """Return the same map with its sign chosen so that w > 0 at the point `xy` (2,)."""
        return self if self.ahead(xy) else Homography(-self.matrix)

    def normalised(self) -> Homography:
        """Return the same map scaled so that the last element is 1 (where it is not 0), for writing down."""
        last = self.matrix[2, 2]
        return Homography(self.matrix / last) if last != 0 else self


def shift(x: float, y: float) -> FloatArray:
    """Return the (3, 3) matrix that moves points by x and y."""
    return np.array([[1.0, 0.0, x], [0.0, 1.0, y], [0.0, 0.0, 1.0]])


def map_each(matrices: FloatArray, xy: FloatArray) -> FloatArray:
    """Map (K, N, 2) points, N for each of K homographies (K, 3, 3); also beyond the horizon."""
    mapped = np.einsum("kij,knj->kni", matrices, np.concatenate((xy, np.ones((*xy.shape[:2], 1))), axis=2))
    return np.asarray(mapped[..., :2] / mapped[..., 2:])
