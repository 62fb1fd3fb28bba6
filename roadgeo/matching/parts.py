"""The parts of a search: whole references and shards of larger ones, opened when they are needed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo.geometry.areas import Box, overlap
from roadgeo.geometry.camera import sampling
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.projection import from_lonlat, transformer
from roadgeo.matching.index import ReferenceIndex

__all__ = ["Near", "Part", "Whole", "same_within_m", "touches"]

#: Longitude, latitude and a radius in metres.
Near: TypeAlias = tuple[float, float, float]

#: Metres of a degree of latitude, a little too few.
_DEGREE_M = 110_500.0


class Part(Protocol):
    """A map, or a piece of a map, that is searched together with others."""

    def may_hold(self, near: Near, frame_m: float = 0.0) -> bool:
        """Return whether a frame of at most this size, its middle in a circle, may show the part; opens nothing."""

    def touches(self, box: Box) -> bool:
        """Whether the middle of a frame that it shows may lie in a box; it is not opened."""

    @property
    def coarseness(self) -> float:
        """Coarseness of the index, which is not opened."""

    def open(self) -> ReferenceIndex:
        """Return its index."""


@dataclass(frozen=True)
class Whole:
    """A reference in one piece, which is open already."""

    index: ReferenceIndex

    def may_hold(self, near: Near, frame_m: float = 0.0) -> bool:
        """Whether the circle, widened by the frame, touches the bounds of its intersections."""
        center = from_lonlat(self.index.plane, np.array([near[:2]], float))[0]
        low, high = self.index.bounds
        beyond = np.maximum(low - center, center - high)
        return bool((beyond <= near[2] + frame_m).all())

    def touches(self, box: Box) -> bool:
        """Whether the bounds of its intersections share ground with a box."""
        plane = self.index.plane
        ends = plane.to_crs(np.array(self.index.bounds)).ravel()
        return overlap(box, transformer(plane.crs, "EPSG:4326").transform_bounds(*ends))

    @property
    def coarseness(self) -> float:
        """Coarseness of the index."""
        return self.index.coarseness

    def open(self) -> ReferenceIndex:
        """Return its index."""
        return self.index


def touches(box: tuple[float, float, float, float], near: Near) -> bool:
    """Whether a circle may touch a box of (west, south, east, north) degrees."""
    west, south, east, north = box
    lon, lat, radius = near
    reach = radius / _DEGREE_M
    if not south - reach <= lat <= north + reach:
        return False
    widest = min(max(abs(south), abs(north), abs(lat)) + reach, 89.9)
    beyond = reach / math.cos(math.radians(widest))
    return any(west - beyond <= lon + turn <= east + beyond for turn in (-360.0, 0.0, 360.0))


def same_within_m(first: ReferenceIndex, other: ReferenceIndex, matrix: FloatArray, size: tuple[int, int]) -> float:
    """Return the greatest distance, metres, at which places on two parts are the same place.

    Shards of a map agree as well as a map with itself, as in `TripleEstimator.same`. Different maps may differ a
    little: there, places within half a frame are the same.
    """
    gsd_m = sampling(matrix, size)
    shard_of = first.meta.get("shard_of")
    if shard_of and shard_of == other.meta.get("shard_of"):
        return Frame(*size).one_place_m(gsd_m)
    return 0.5 * gsd_m * max(size)
