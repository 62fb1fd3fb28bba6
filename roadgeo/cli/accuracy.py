"""One message on the accuracy of places in other coordinates than the map's own."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from roadgeo.cli.printing import echo, is_set

__all__ = ["tell_accuracy"]


def tell_accuracy(documents: Iterable[Mapping[str, Any]], drawn_in: str | None = None) -> None:
    """Report where PROJ lacks a grid for longitude and latitude of results, or for the CRS that they are drawn in.

    With --quiet nothing is asked of PROJ.
    """
    from roadgeo.geometry.transformation import LONLAT, Exactness, exactness

    if is_set("quiet"):
        return
    targets = {LONLAT: "longitude and latitude"}
    if drawn_in is not None:
        targets.setdefault(drawn_in, f"places in {drawn_in}" if len(drawn_in) < 20 else "places in the CRS asked for")
    shared: dict[Exactness, dict[str, None]] = {}  # the references that share each
    for document in documents:
        crs, center = document.get("crs"), document.get("center")
        if crs and center:
            for target, name in targets.items():
                shared.setdefault(exactness(crs, target, (center["lon"], center["lat"])), {})[name] = None
    for way, names in shared.items():
        line = way.told(", ".join(names))
        if line:
            echo(f"  {line}", err=True)
