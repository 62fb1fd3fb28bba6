"""Accuracy of transformations between CRS: a change of datum is an estimate, with an accuracy that PROJ states.

The best transformations need grids, which pyproj's wheels do not bring. Without them PROJ silently uses a coarser one.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

from roadgeo.storage.crs import known_crs

__all__ = ["LONLAT", "Exactness", "exactness"]

#: Longitude and latitude.
LONLAT = "EPSG:4326"

_CELL_DEG = 0.5  # positions this near have the same best way
_AROUND_DEG = 0.05


class Exactness(NamedTuple):
    """How exact the best way at hand between two CRS is.

    Attributes
    ----------
    sigma_m : float
        Metres; 0 where both have one datum, NaN where PROJ does not know.
    grids : tuple of str
        Those that are missing for a better way.
    better_m : float
        How exact that would be.
    """

    sigma_m: float
    grids: tuple[str, ...] = ()
    better_m: float = math.nan

    def told(self, what: str) -> str:
        """Return a sentence on the accuracy of `what`, and the remedy; "" where nothing is missing."""
        if not self.grids:
            return f"{what} are not known how exact: PROJ knows no way from datum to datum" * math.isnan(self.sigma_m)
        named, alone = " and ".join(self.grids), len(self.grids) == 1
        sync = " && ".join(f"pyproj sync --file {grid}" for grid in self.grids)
        accuracy = "not known how exact" if math.isnan(self.sigma_m) else f"good to {self.sigma_m:g} m only"
        return (
            f"{what} are {accuracy}: PROJ lacks the grid{'' if alone else 's'} {named}, with which they are good to "
            f"{self.better_m:g} m; get {'it' if alone else 'them'} by `{sync}`, or set PROJ_NETWORK=ON"
        )


def exactness(source: str, target: str, lonlat: Sequence[float]) -> Exactness:
    """Return how exactly positions around a place, longitude and latitude, are taken from one CRS to another.

    Raises
    ------
    CrsError, pyproj.exceptions.CRSError
        There is no such CRS.
    """
    if source == target or not all(math.isfinite(degrees) for degrees in lonlat):
        return Exactness(0.0)
    lon, lat = (round(degrees / _CELL_DEG) * _CELL_DEG for degrees in lonlat)
    return _exactness(source, target, lon, lat)


@lru_cache(maxsize=256)
def _exactness(source: str, target: str, lon: float, lat: float) -> Exactness:
    first, other = known_crs(source), known_crs(target)
    if first.geodetic_crs and first.geodetic_crs.equals(other.geodetic_crs, ignore_axis_order=True):
        return Exactness(0.0)
    from pyproj.transformer import AreaOfInterest, TransformerGroup

    south, north = max(lat - _AROUND_DEG, -90.0), min(lat + _AROUND_DEG, 90.0)
    around = AreaOfInterest(lon - _AROUND_DEG, south, lon + _AROUND_DEG, north)
    with warnings.catch_warnings(action="ignore"):  # our own message on the missing grid is clearer
        group = TransformerGroup(first, other, always_xy=True, area_of_interest=around)
    best = group.transformers[0].accuracy if group.transformers else -1.0
    sigma = best if best >= 0.0 else math.nan
    if not group.best_available:
        for way in group.unavailable_operations:
            missing = tuple(_file(grid) for grid in way.grids if not grid.available)
            if missing and way.accuracy >= 0.0 and not way.accuracy >= sigma:
                return Exactness(sigma, missing, way.accuracy)
    return Exactness(sigma)


def _file(grid: Any) -> str:
    return str(grid.short_name or grid.full_name)
