"""A query mask on its pixel grid: which pixels are road, and which were observed at all.

Frames. A pixel position is (column, row) in GDAL's corner convention: the centre of the top-left pixel is (0.5, 0.5).
The *query plane* is (x, y) = (column, -row), y up, in pixels: rows are flipped once, here and nowhere else, so that
"counterclockwise" means the same on query and reference and an image taken from above is never mirrored.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from roadgeo._arrays import AnyArray, BoolArray, FloatArray
from roadgeo.geometry.frame import Frame

__all__ = [
    "PIXEL_TO_PLANE",
    "PROBABILITY_SURE",
    "PROBABILITY_UNKNOWN",
    "RoadMask",
    "extent",
    "pixel_to_plane",
    "plane_to_pixel",
]

#: 3 x 3 homography that takes pixels (column, row) to the query plane (x, y). It is its own inverse.
PIXEL_TO_PLANE: FloatArray = np.diag([1.0, -1.0, 1.0])
PIXEL_TO_PLANE.setflags(write=False)

#: Values of `RoadMask.probability` where there is road for sure, and where nothing is known.
PROBABILITY_SURE, PROBABILITY_UNKNOWN = 254, 255


def pixel_to_plane(pixels: FloatArray) -> FloatArray:
    """Take (..., 2) pixel positions (column, row) to the query plane (x, y), y up."""
    return np.asarray(pixels, float) * (1.0, -1.0)


def plane_to_pixel(xy: FloatArray) -> FloatArray:
    """Take (..., 2) positions of the query plane to pixels (column, row)."""
    return np.asarray(xy, float) * (1.0, -1.0)


def extent(shown: BoolArray) -> tuple[slice, slice]:
    """Return the rows and columns of (H, W) from the first to the last in which something is shown."""
    at = (np.flatnonzero(shown.any(axis=axis)) for axis in (1, 0))
    rows, columns = (slice(int(line[0]), int(line[-1]) + 1) for line in at)
    return rows, columns


@dataclass(frozen=True)
class RoadMask:
    """Road pixels of an image, and the pixels that were observed.

    Dimensions: H rows, W columns.

    Attributes
    ----------
    roads : (H, W) bool
        True where the image shows road. False wherever `observed` is False.
    observed : (H, W) bool or None
        False where nothing is known (nodata, alpha 0, the black corners of a warped image). None: all observed.
    name : str
        Name for messages (the path as given).
    probability : (H, W) uint8 or None
        254 times the probability of road, where the mask was made of that; 255 where nothing is known.
    """

    roads: BoolArray
    observed: BoolArray | None = None
    name: str = ""
    probability: AnyArray | None = None

    def __repr__(self) -> str:
        """Describe the mask in one line."""
        height, width = self.roads.shape
        return f"<RoadMask {self.name!r}: {width} x {height} pixels, {self.roads.mean():.1%} road>"

    def mirrored(self) -> RoadMask:
        """Return it mirrored, left to right."""
        more = (self.observed, self.probability)
        observed, probability = (None if array is None else array[:, ::-1].copy() for array in more)
        return replace(self, roads=self.roads[:, ::-1].copy(), observed=observed, probability=probability)

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W)."""
        return self.roads.shape[0], self.roads.shape[1]

    @property
    def corners(self) -> FloatArray:
        """(4, 2) pixel positions of the frame's corners TL, TR, BR, BL."""
        height, width = self.shape
        return Frame(width, height).corners
