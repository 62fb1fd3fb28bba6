"""A demonstration that needs neither network nor data: two maps, an aerial photograph, five masks and the truth.

They were made by the programs in `examples/demo`.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from roadgeo._arrays import FloatArray

__all__ = [
    "ATTRIBUTION",
    "PHOTO",
    "ROADS",
    "STREETS",
    "STREETS_ATTRIBUTION",
    "DemoMask",
    "demo_masks",
    "demo_photo",
]

_DATA = Path(__file__).parent / "data"

#: Roads around the centre of Porto, as OpenStreetMap has them.
ROADS = _DATA / "porto_roads.gpkg"
#: The painted photograph from which the mask `drone.png` was made, see `examples/demo`.
PHOTO = _DATA / "drone_photo.jpg"
ATTRIBUTION = "© OpenStreetMap contributors, ODbL 1.0"
#: Centre lines of the streets around the campus in Berkeley, California.
STREETS = _DATA / "berkeley_streets.gpkg"
STREETS_ATTRIBUTION = "City of Berkeley, street centre lines"


@dataclass(frozen=True)
class DemoMask:
    """A mask, or a photograph, whose place is known.

    Attributes
    ----------
    title : str
        Description for people.
    in_map : bool
        Whether its place is on the map; if not it must be refused.
    homography : (3, 3) float64
        From its pixels (column, row; GDAL corner convention) to `crs`.
    known_to_m : float
        A result is right whose middle is no farther off.
    gsd_m : float or None
        Its scale, metres per pixel, where its users know it.
    """

    path: Path
    title: str
    in_map: bool
    crs: str
    homography: FloatArray
    known_to_m: float = 5.0
    gsd_m: float | None = None


def demo_photo() -> DemoMask:
    """Return a real photograph: NAIP, which is in the public domain, of the campus in Berkeley.

    It is a piece of a web map of zoom 17. Its middle is known to the fourth decimal of a degree.
    """
    width, height, pixel, x, y = 1361, 827, 1.194328566955879, -13609843.021, 4561317.147
    homography = np.array([[pixel, 0.0, x - pixel * width / 2], [0.0, -pixel, y + pixel * height / 2], [0.0, 0.0, 1.0]])
    title = "an aerial photograph of a campus, 0.94 m per pixel (NAIP, public domain)"
    return DemoMask(_DATA / "berkeley_photo.jpg", title, True, "EPSG:3857", homography, 15.0, 0.94)


def demo_masks() -> list[DemoMask]:
    """Return the five masks."""
    document = json.loads((_DATA / "truth.json").read_text(encoding="utf-8"))
    return [
        DemoMask(_DATA / mask["mask"], mask["title"], mask["in_map"], mask["crs"], np.array(mask["homography"], float))
        for mask in document["masks"]
    ]
