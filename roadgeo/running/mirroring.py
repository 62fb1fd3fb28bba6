"""A mask that was mirrored, by a scanner or an array upside down, has no place: whether it is that is tried once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from roadgeo.location import Location, Reason
from roadgeo.matching.options import LocateOptions
from roadgeo.outputs.wording import format_lonlat
from roadgeo.reference.reference import AnyReference
from roadgeo.running.looks import Sighting
from roadgeo.workflows import locate

__all__ = ["ask_mirrored"]

#: What a try may take; a mask that is merely turned over is found at once.
_TIME_LIMIT_S = 2.0
_WORTH_A_TRY = {Reason.NOTHING_STANDS_OUT, Reason.TIME_LIMIT}


def ask_mirrored(sighting: Sighting, references: Sequence[AnyReference], options: LocateOptions) -> Sighting:
    """Try a refused mask turned over, left to right; where that is located, the refusal says so.

    It stays refused: a mirrored image has no place, and only its owner knows how it came about.
    """
    refused = sighting.location
    if refused.status != "not_located" or refused.reason_code not in _WORTH_A_TRY or options.method == "pair":
        return sighting
    mask = sighting.mask
    observed = None if mask.observed is None else mask.observed[:, ::-1].copy()
    turned = replace(mask, roads=mask.roads[:, ::-1].copy(), observed=observed)
    search = replace(options.search, time_limit_s=min(_TIME_LIMIT_S, options.search.time_limit_s))
    found = locate(turned, references, replace(options, effort="quick", search=search))
    return replace(sighting, location=_told(refused, found))


def _told(refused: Location, found: Location) -> Location:
    """Return the refusal with the time that the try took, and with what it found."""
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
