"""roadgeo: locate an aerial image from its roads alone.

>>> import roadgeo
>>> reference = roadgeo.index("porto_roads.gpkg")  # or "Boston, MA", lines ...; later roadgeo.open_reference(path)
>>> answer = roadgeo.locate("drone.png", reference, gsd=0.8)  # or a photograph, an array, a PIL image ...
>>> answer.status, round(answer.center.lon, 2), round(answer.center.lat, 2)
('located', -8.61, 41.15)
>>> files = answer.write("found", also=["report"])

Names are imported when they are first used, so that `import roadgeo` costs nothing.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from roadgeo._version import __version__

if TYPE_CHECKING:
    from roadgeo.api import Answer, fence, index, locate, track, vectorize, verify
    from roadgeo.errors import RoadgeoError
    from roadgeo.geometry.mask import RoadMask
    from roadgeo.location import Location
    from roadgeo.matching.options import LocateOptions
    from roadgeo.outputs.schemas import read_schema
    from roadgeo.reference.opening import open_reference
    from roadgeo.reference.reference import BuildOptions, Reference
    from roadgeo.reference.shards import ShardedReference
    from roadgeo.workflows import explain

__all__ = [
    "Answer",
    "BuildOptions",
    "LocateOptions",
    "Location",
    "Reference",
    "RoadMask",
    "RoadgeoError",
    "ShardedReference",
    "__version__",
    "explain",
    "fence",
    "index",
    "locate",
    "open_reference",
    "read_schema",
    "track",
    "vectorize",
    "verify",
]

_HOMES = {
    "Answer": "api",
    "BuildOptions": "reference.reference",
    "LocateOptions": "matching.options",
    "Location": "location",
    "Reference": "reference.reference",
    "RoadMask": "geometry.mask",
    "RoadgeoError": "errors",
    "ShardedReference": "reference.shards",
    "explain": "workflows",
    "fence": "api",
    "index": "api",
    "locate": "api",
    "open_reference": "reference.opening",
    "read_schema": "outputs.schemas",
    "track": "api",
    "vectorize": "api",
    "verify": "api",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'roadgeo' has no attribute {name!r}")
    return getattr(importlib.import_module(f"roadgeo.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
