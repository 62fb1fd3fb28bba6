"""Answers that were made up, and answers whose place was changed."""

from dataclasses import replace

import numpy as np

from roadgeo.geometry.homography import shift
from roadgeo.geometry.placement import Placement
from roadgeo.geometry.projection import LocalPlane
from roadgeo.location import Location


def placed(homography: np.ndarray, crs: str = "EPSG:32629", size: tuple[int, int] = (400, 300), **known) -> Placement:
    """A place by its homography from pixels to a CRS."""
    origin = np.round(homography[:2, 2] / homography[2, 2], -3)
    return Placement(size, LocalPlane(crs, tuple(origin.tolist())), shift(*-origin) @ homography, **known)


def moved(place: Placement, east_m: float, north_m: float, **known) -> Placement:
    """The same somewhere else."""
    return replace(place, matrix=shift(east_m, north_m) @ place.matrix, **known)


def with_place(location: Location, **changes) -> Location:
    """The same answer with another place."""
    return replace(location, places=(replace(location.places[0], **changes), *location.places[1:]))


def sure_to(*sigma_m: float) -> np.ndarray:
    """The covariance of corners that are sure to so many metres each."""
    return np.diag(np.repeat(np.square(sigma_m), 2) / 2.0)
