"""A demonstration that needs neither network nor data: a piece of Porto, five masks and the truth.

They were made by the programs in `examples/demo`.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from roadgeo._arrays import FloatArray

__all__ = ["ATTRIBUTION", "PHOTO", "ROADS", "DemoMask", "demo_masks"]

_DATA = Path(__file__).parent / "data"

#: Roads around the centre of Porto, as OpenStreetMap has them.
ROADS = _DATA / "porto_roads.gpkg"
#: The painted photograph from which the mask `drone.png` was made, see `examples/demo`.
PHOTO = _DATA / "drone_photo.jpg"
ATTRIBUTION = "© OpenStreetMap contributors, ODbL 1.0"


@dataclass(frozen=True)
class DemoMask:
    """A mask whose place is known.

    Attributes
    ----------
    title : str
        Description for people.
    in_map : bool
        Whether its place is on the map; if not it must be refused.
    homography : (3, 3) float64
        From its pixels (column, row; GDAL corner convention) to `crs`.
    """

    path: Path
    title: str
    in_map: bool
    crs: str
    homography: FloatArray


def demo_masks() -> list[DemoMask]:
    """Return the five masks."""
    document = json.loads((_DATA / "truth.json").read_text(encoding="utf-8"))
    return [
        DemoMask(_DATA / mask["mask"], mask["title"], mask["in_map"], mask["crs"], np.array(mask["homography"], float))
        for mask in document["masks"]
    ]
