"""A refusal is no dead end: the user may take one of the places that it lists."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from roadgeo.errors import NotLocatedError
from roadgeo.geometry.projection import transform
from roadgeo.location import Location, Place, Reason
from roadgeo.matching.options import LocateOptions

__all__ = ["choose_place"]


def choose_place(location: Location, options: LocateOptions) -> Location:
    """Return the place that the user takes, where nothing is located; its score stays as it is.

    Raises
    ------
    NotLocatedError
        The answer lists no such place.
    """
    number, places = options.take, location.places
    if number is None or location.located:
        return location
    if number > len(places):
        listed = {0: "none is listed", 1: "1 is listed"}.get(len(places), f"{len(places)} are listed")
        raise NotLocatedError(f"{location.query}: there is no place {number}: {listed} ({location.reason})")
    place = places[number - 1]
    frame = place.frame
    center = None if frame is None else frame.center
    if frame is None or center is None:
        raise NotLocatedError(f"{location.query}: place {number} is known by its middle only; take another")
    # Where the likeliest place leads nothing, the odds of another are given against that one alone.
    odds = min(place.log10_odds, places[0].log10_odds)
    others = tuple(_in_crs_of(frame, other) for k, other in enumerate(places, 1) if k != number)
    return replace(
        frame,
        query=location.query,
        status="chosen",
        reason=f"chosen by you: place {number} of {len(places)}; the score is {odds:z.1f},"
        f" {options.min_log10_odds:g} is asked for",
        reason_code=Reason.CHOSEN,
        log10_odds=odds,
        center=replace(center, log10_odds=odds),
        runner_up=others[0] if others else None,
        alternatives=others,
        seconds=location.seconds,
        stats=location.stats,
        stopped=location.stopped,
        query_to_pixel=location.query_to_pixel,
    )


def _in_crs_of(frame: Location, place: Place) -> Place:
    """Return a place in the CRS of the one that is taken; it cannot be taken any more."""
    x, y = transform("EPSG:4326", str(frame.crs), np.array([[place.lon, place.lat]]))[0].tolist()
    return replace(place, x=x, y=y, frame=None)
