"""A mask that was mirrored, by a scanner or an array upside down, has no place: whether it is that is tried once.

Where the user allows it, the place of the mask turned over is the answer, in pixels of the mask as given.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from roadgeo.location import Location, Reason
from roadgeo.matching.options import LocateOptions
from roadgeo.outputs.wording import format_lonlat
from roadgeo.reference.reference import AnyReference
from roadgeo.roads.graph import RoadGraph
from roadgeo.running.looks import Sighting
from roadgeo.workflows import locate

__all__ = ["ask_mirrored"]

#: Limits of a try, of the first sweep alone: a mask that is merely turned over is mostly found in a tenth of it.
_WORK_LIMIT_S = 1.0
_WORTH_A_TRY = {Reason.NOTHING_STANDS_OUT, Reason.TIME_LIMIT}


def ask_mirrored(
    sighting: Sighting, references: Sequence[AnyReference], options: LocateOptions, allowed: bool = False
) -> Sighting:
    """Try a refused mask turned over, left to right; where that is located, the refusal mentions it.

    It stays refused, unless mirrored masks are `allowed`: a mirrored image has no place, and only its owner knows how
    it came about. Where they are, the search for it is as thorough as for any other.
    """
    refused = sighting.location
    if refused.status != "not_located" or refused.reason_code not in _WORTH_A_TRY or options.method == "pair":
        return sighting
    turned = sighting.mask.mirrored()
    if not allowed:
        search = replace(options.search, work_limit_s=min(_WORK_LIMIT_S, options.search.work_limit_s))
        match = replace(options.match, without_roads=options.match.without_roads[:1])
        options = replace(options, effort="quick", search=search, match=match)
    found = locate(turned, references, options)
    if allowed and found.located:
        return replace(sighting, location=_turned_back(found, sighting.location))
    return replace(sighting, location=_told(refused, found))


def _turned_back(found: Location, refused: Location) -> Location:
    """Return the place of a mask that was located turned over, as it is of the mask itself.

    The camera saw no mirrored ground, so the answer has none.
    """
    if found.size is None or found.homography is None or found.footprint is None or found.footprint_lonlat is None:
        return refused
    width = found.size[0]
    flip = np.array([[-1.0, 0.0, width], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    order = [1, 0, 3, 2]  # its top right corner was the mask's top left
    pairs = [2 * corner + axis for corner in order for axis in (0, 1)]
    evidence, seen, spent = found.evidence, found.seen, refused.seconds
    covariance, sigma = found.corner_covariance_m2, found.corner_sigma_m
    homography = found.homography @ flip
    return replace(
        found,
        reason=f"{found.reason}; the mask is mirrored: it was turned over, left to right",
        mirrored=True,
        homography=homography / homography[2, 2],
        footprint=found.footprint[order],
        footprint_lonlat=found.footprint_lonlat[order],
        corner_sigma_m=None if sigma is None else sigma[order],
        corner_covariance_m2=None if covariance is None else covariance[np.ix_(pairs, pairs)],
        camera=None,
        seconds=replace(
            found.seconds,
            vectorize=spent.vectorize + found.seconds.vectorize,
            match=spent.match + found.seconds.match,
            refine=spent.refine + found.seconds.refine,
        ),
        evidence=None
        if evidence is None
        else replace(
            evidence,
            query_graph=_flipped(evidence.query_graph, width),
            query_xy=evidence.query_xy * (-1.0, 1.0) + (width, 0.0),
        ),
        seen=None
        if seen is None
        else replace(seen, graph=_flipped(seen.graph, width), xy=seen.xy * (-1.0, 1.0) + (width, 0.0)),
    )


def _flipped(graph: RoadGraph, width: float) -> RoadGraph:
    """Return the roads of a mask of this width, turned over left to right."""
    sides = np.array([-1.0, 1.0])
    return replace(graph, xy=graph.xy * sides + (width, 0.0), coords=graph.coords * sides + (width, 0.0))


def _told(refused: Location, found: Location) -> Location:
    """Return the refusal with the time and the result of the try."""
    spent, more = refused.seconds, found.seconds
    seconds = replace(
        spent,
        vectorize=spent.vectorize + more.vectorize,
        match=spent.match + more.match,
        refine=spent.refine + more.refine,
    )
    if not found.located or found.center is None:
        return replace(refused, seconds=seconds)
    where = format_lonlat(found.center.lon, found.center.lat)
    reason = (
        f"the mask is mirrored: turned over, left to right, it lies at {where} on {found.reference}; "
        "flip the image and locate it again"
    )
    return replace(refused, reason=reason, reason_code=Reason.MIRRORED, seconds=seconds)
