"""Homographies of the plane: x_ref = H x_query.

`H` is scaled so that w > 0 over the image; then det H > 0 means "not mirrored". Estimation lives in `estimator`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roadgeo._arrays import FloatArray

__all__ = ["Homography"]


@dataclass(frozen=True)
class Homography:
    """A 3 x 3 matrix that takes points of one plane to another."""

    matrix: FloatArray

    def __call__(self, xy: FloatArray) -> FloatArray:
        """Map (..., 2) points; those beyond the horizon (w <= 0) become NaN."""
        points = np.asarray(xy, float)
        mapped = points @ self.matrix[:, :2].T + self.matrix[:, 2]
        w = mapped[..., 2:]
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(w > 0, mapped[..., :2] / w, np.nan)

    def inverse(self) -> Homography:
        """Return the map back; where w was positive it is so again, as H^-1 (H x) = x has the third element 1."""
        return Homography(np.asarray(np.linalg.inv(self.matrix), np.float64))

    def __matmul__(self, other: Homography) -> Homography:
        """Compose: (A @ B)(x) = A(B(x))."""
        return Homography(self.matrix @ other.matrix)

    def jacobian(self, xy: FloatArray) -> FloatArray:
        """Return the (..., 2, 2) derivative d(x', y') / d(x, y) at (..., 2) points with w > 0."""
        points = np.asarray(xy, float)
        mapped = points @ self.matrix[:, :2].T + self.matrix[:, 2]
        w = mapped[..., 2]
        image = mapped[..., :2] / w[..., None]
        linear = self.matrix[:2, :2] - image[..., :, None] * self.matrix[2, :2]
        return np.asarray(linear / w[..., None, None])

    def facing(self, xy: FloatArray) -> Homography:
        """Return the same map with its sign chosen so that w > 0 at the point `xy` (2,)."""
        w = float(np.asarray(xy, float) @ self.matrix[2, :2] + self.matrix[2, 2])
        return self if w > 0 else Homography(-self.matrix)

    def normalised(self) -> Homography:
        """Return the same map scaled so that the last element is 1 (where it is not 0), for writing down."""
        last = self.matrix[2, 2]
        return Homography(self.matrix / last) if last != 0 else self
