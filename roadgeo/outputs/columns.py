"""The attributes of a result in every table: footprints in GeoPackage, GeoJSON and STAC, the summary, its CSV.

To add a column, list it here.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from roadgeo.outputs.names import bare_name, without_folders

__all__ = ["NUMBERS", "WORDS", "attributes"]

#: Columns that every mask has a value in, located or not.
WORDS = ("query", "status", "reason", "reference", "attribution")
#: Columns of measured values; empty where there is no place.
NUMBERS = (
    "gsd_m",
    "rotation_deg",
    "tilt_deg",
    "n_intersections",
    "n_matched",
    "inlier_ratio",
    "log10_odds",
    "max_corner_sigma_m",
    "max_lonlat_sigma_m",
)


def attributes(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return the value of every column: plain, or None; files without their folders.

    Parameters
    ----------
    document : mapping
        `Location.to_dict`, its JSON read back, or what stands for a mask that failed.
    """
    sigma, lonlat_sigma = document.get("corner_sigma_m"), document.get("lonlat_sigma_m")
    query, reason = str(document.get("query") or ""), str(document.get("reason") or "")
    derived = {
        "max_corner_sigma_m": max(sigma) if sigma else None,
        "max_lonlat_sigma_m": max(lonlat_sigma) if lonlat_sigma else None,
        "query": bare_name(query),
        "reason": without_folders(reason, query),
    }
    return {name: derived.get(name, document.get(name)) for name in (*WORDS, *NUMBERS)}
