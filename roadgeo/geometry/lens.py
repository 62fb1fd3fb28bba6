"""Radial distortion by a lens: where a pinhole camera would have put what a lens shows.

One parameter, k1: the image of a pinhole at distance r from the middle of the frame, in halves of its longer side,
moves to r (1 + k1 r^2) in the same direction. k1 < 0 is a barrel, k1 > 0 a pincushion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from roadgeo._arrays import FloatArray

__all__ = ["Lens"]

#: A barrel folds over where r (1 + k1 r^2) no longer grows; nothing is visible beyond.
_UNFOLDED = 0.98
_NEWTON_STEPS = 8


@dataclass(frozen=True)
class Lens:
    """A lens in front of a frame. `center` and points are in any one plane, pixels; `k1` 0 is a pinhole.

    Attributes
    ----------
    center : (x, y)
    half_side : float
        Half of the frame's longer side.
    """

    k1: float
    center: tuple[float, float]
    half_side: float

    @classmethod
    def of(cls, k1: float, size: tuple[int, int], *, y_up: bool = False) -> Lens:
        """Return the lens of a frame of `size` (width, height); in the query plane with `y_up`, else in pixels."""
        width, height = size
        return cls(k1, (width / 2, -height / 2 if y_up else height / 2), max(width, height) / 2)

    def straighten(self, points: FloatArray) -> FloatArray:
        """Take (..., 2) points as the lens shows them to where a pinhole would have put them."""
        if self.k1 == 0.0:
            return np.asarray(points, float)
        offset = (points - self.center) / self.half_side
        distorted = np.hypot(offset[..., 0], offset[..., 1])
        scale = np.divide(self._radius(distorted), distorted, out=np.ones_like(distorted), where=distorted > 0)
        return np.asarray(self.center + self.half_side * offset * scale[..., None])

    def stretch(self, points: FloatArray) -> FloatArray:
        """Return the derivative (..., 2, 2) of `straighten(points)` by the points."""
        offset = (points - self.center) / self.half_side
        distorted = np.hypot(offset[..., 0], offset[..., 1])
        square = self._radius(distorted) ** 2
        radial = np.divide(offset, distorted[..., None], out=np.zeros_like(offset), where=distorted[..., None] > 0)
        across, outwards = 1.0 / (1.0 + self.k1 * square), 1.0 / (1.0 + 3.0 * self.k1 * square)
        along = radial[..., :, None] * radial[..., None, :]
        return np.asarray(across[..., None, None] * np.eye(2) + (outwards - across)[..., None, None] * along)

    def straighten_directions(self, points: FloatArray, directions: FloatArray) -> FloatArray:
        """Take (..., 2) unit vectors at such points along."""
        turned = (self.stretch(points) @ directions[..., None])[..., 0]
        return np.asarray(turned / np.linalg.norm(turned, axis=-1, keepdims=True))

    def bend(self, points: FloatArray) -> FloatArray:
        """Take (..., 2) points where a pinhole would put them to where the lens shows them; the inverse."""
        offset = (points - self.center) / self.half_side
        square = np.minimum((offset**2).sum(axis=-1, keepdims=True), self._farthest() ** 2)
        return np.asarray(self.center + self.half_side * offset * (1.0 + self.k1 * square))

    def _farthest(self) -> float:
        """Return the distance, as a pinhole sees it, up to which the lens does not fold over."""
        return math.inf if self.k1 >= 0.0 else _UNFOLDED / math.sqrt(-3.0 * self.k1)

    def _radius(self, distorted: FloatArray) -> FloatArray:
        """Solve r (1 + k1 r^2) = seen, by Newton's method from where it converges."""
        if self.k1 == 0.0:
            return distorted
        farthest = self._farthest()
        if math.isfinite(farthest):
            distorted = np.minimum(distorted, farthest * (1.0 + self.k1 * farthest**2))
        r = distorted.copy()
        for _ in range(_NEWTON_STEPS):
            r -= (r * (1.0 + self.k1 * r * r) - distorted) / (1.0 + 3.0 * self.k1 * r * r)
        return r
