"""A refusal is no dead end: the user may take one of the places that it lists. Taking one searches nothing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo.errors import MaskError, NotLocatedError
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.georeference import fit_place
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.placement import Placement
from roadgeo.geometry.projection import choose_plane, from_lonlat, metres_apart
from roadgeo.location import Content, Location, Reason
from roadgeo.matching.hints import Taken
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.options import LocateOptions
from roadgeo.matching.scene import Scene, trace_query
from roadgeo.matching.verdict import match_again
from roadgeo.reference.opening import AnyReference
from roadgeo.running.options import ReadOptions
from roadgeo.running.passes import Sighting
from roadgeo.running.probability_files import is_ours
from roadgeo.running.queries import read_roads
from roadgeo.running.variants import resampled

__all__ = ["place_by_points", "take_again", "take_place"]

#: Points that spread less across than this share of what they spread along say nothing of one direction.
_LINE = 0.03
#: So many points determine the map that is fitted to them: an affine map three, a homography four.
_EXACT = 4
_UNCHECKED = ": nothing checks them, for so few fit any picture exactly; give five or more"


def take_place(location: Location, taken: Taken, options: LocateOptions | None = None) -> Location:
    """Return an answer with one of its places as the one that the user takes; its score stays as it is.

    Raises
    ------
    NotLocatedError
        The answer lists no such place.
    """
    places = location.places
    if not places:
        raise NotLocatedError(f"{location.query}: no place is listed that could be taken ({location.reason})")
    number = taken if isinstance(taken, int | np.integer) else _nearest(location, taken)
    if not 1 <= number <= len(places):
        listed = "1 is listed" if len(places) == 1 else f"{len(places)} are listed"
        raise NotLocatedError(f"{location.query}: there is no place {number}: {listed} ({location.reason})")
    if location.located and number == 1:
        return location
    needed = (options or LocateOptions()).min_log10_odds
    # Where the likeliest place leads nothing, the score of another is against that one alone.
    score = min(places[number - 1].score, places[0].score)
    others = tuple(replace(place, rival=None) for k, place in enumerate(places, 1) if k != number)
    chosen = replace(places[number - 1], score=score, rival=others[0] if others else None)
    excluded = number == 1 and location.reason_code is Reason.FITS_ELSEWHERE
    which = f"place {number} of {len(places)}" + ", which the hints exclude" * excluded
    asked = f", {needed:g} is asked for" * (score < needed)
    return replace(
        location,
        status="chosen",
        reason=f"chosen by you: {which}; the score is {score:z.1f}{asked}",
        reason_code=Reason.CHOSEN,
        places=(chosen, *others),
        reference=chosen.reference,
        attribution=chosen.attribution,
    )


def place_by_points(location: Location, points: FloatArray, references: Sequence[AnyReference]) -> Location:
    """Return an answer with its image where points put it: by an affine map if three, else by a homography.

    Parameters
    ----------
    points : (N, 4) float64
        Column, row, longitude and latitude of three or more.

    Raises
    ------
    MaskError
        They lie on a line, or no camera above the ground saw them so.
    """
    size = location.size or (1, 1)
    pixels, lonlat = points[:, :2], points[:, 2:]
    plane = choose_plane(lonlat)
    xy = from_lonlat(plane, lonlat)
    for side in (pixels, xy):
        along, across = np.linalg.svd(side - side.mean(axis=0), compute_uv=False)
        if across < _LINE * along or along == 0.0:
            raise MaskError("the points lie on a line; give some all over the picture")
    matrix = Homography(fit_place(pixels, xy, projective=len(points) > 3)).facing(Frame(*size).center)
    corners = matrix.everywhere(Frame(*size).corners)
    east, north = (np.roll(corners, -1, axis=0) - corners).T
    if not (matrix.ahead(Frame(*size).corners).all() and np.all(east * np.roll(north, -1) < north * np.roll(east, -1))):
        raise MaskError("no camera above the ground sees the points so; has one been exchanged for another?")
    off_m = float(np.sqrt(np.mean(np.sum((matrix.everywhere(pixels) - xy) ** 2, axis=1))))
    fit = f"; they are off by {off_m:.1f} m (root mean square)" if len(points) > _EXACT else _UNCHECKED
    lon, lat = lonlat.mean(axis=0).tolist()
    index = min(
        (index for reference in references for index in reference.indexes_at([(lon, lat)])),
        key=lambda index: float(np.hypot(*(from_lonlat(index.plane, lonlat[:1])[0] - index.xy.mean(axis=0)))),
        default=None,
    )
    name, owed = ("", "") if index is None else (index.name, str(index.meta.get("attribution") or ""))
    place = Placement(size, plane, matrix.matrix, math.nan, name, owed, is_pinhole=len(points) > 3)
    return replace(
        location,
        status="chosen",
        reason=f"placed by {len(points)} points, as given{fit}",
        reason_code=Reason.CHOSEN,
        places=(place,),
        reference=name,
        attribution=owed,
    )


def take_again(
    answer: Location,
    taken: Taken,
    image: str,
    kept: Path,
    references: Sequence[AnyReference],
    reading: ReadOptions,
    options: LocateOptions,
) -> Sighting:
    """Take a place of an earlier answer: its image is read again for drawing it, and searched for nowhere.

    Parameters
    ----------
    kept : Path
        Where the probability of road in a photograph lies, if it was kept.

    Raises
    ------
    NotLocatedError
        The answer lists no such place.
    MaskError, ModelError
        The image cannot be read.
    """
    location = take_place(answer, taken, options)
    place, is_kept = location.places[0], is_ours(kept)
    first = read_roads(str(kept) if is_kept else image, (place.gsd_m, place.gsd_m), reading)
    content = Content(place.size, kind="photograph" if is_kept or first.of_photograph else "mask")
    height_width = place.size[::-1]
    mask = first.mask if first.mask.shape == height_width else resampled(first.mask, height_width).mask
    mask = replace(mask, name=image)
    try:
        scene, graph = trace_query(mask)
    except MaskError:  # the photograph shows hardly a road
        return Sighting(replace(location, content=content), mask)
    content = replace(content, graph=graph, xy=scene.intersections.xy)
    place = _matched(place, scene, [reference.index_of(location) for reference in references])
    location = replace(location, content=content, places=(place, *location.places[1:]))
    return Sighting(location, mask)


def _matched(place: Placement, scene: Scene, indexes: Sequence[ReferenceIndex]) -> Placement:
    """Return a place with the intersections that match there, where its map is among those that are open."""
    index = next((one for one in indexes if one.name == place.reference and one.plane.crs == place.crs), None)
    return place if index is None else replace(place, matches=match_again(place, scene, index))


def _nearest(location: Location, lonlat: tuple[float, float]) -> int:
    """Return the number of the listed place whose middle is nearest to longitude and latitude.

    Raises
    ------
    NotLocatedError
        None lies within a frame's width, or it is no point.
    """
    if np.shape(lonlat) != (2,):
        raise NotLocatedError(f"{lonlat!r} is no place; expected its number, from 1, or longitude and latitude")
    away = [metres_apart(np.array(place.center[2:]), np.array(lonlat)) for place in location.places]
    nearest = int(np.argmin(away))
    place = location.places[nearest]
    reach_m = place.gsd_m * max(place.size)
    if away[nearest] > reach_m:
        raise NotLocatedError(
            f"{location.query}: no listed place lies within {reach_m:.0f} m of {lonlat[0]:g},{lonlat[1]:g}; the "
            f"nearest is place {nearest + 1}, {away[nearest]:.0f} m away"
        )
    return nearest + 1
