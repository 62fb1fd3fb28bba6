"""roadgeo in QGIS: a Processing provider that runs the roadgeo executable. Imported by QGIS, not by roadgeo."""

from __future__ import annotations

from typing import Any

__all__ = ["classFactory"]


def classFactory(iface: Any) -> Any:
    """Make the plugin, as QGIS asks for it."""
    from .provider import RoadgeoPlugin

    return RoadgeoPlugin(iface)
