"""The page's view of an answer, and the files that it offers: made by the process that located, kept beside it."""

from __future__ import annotations

import gzip
import json
import pickle
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo.errors import MaskError, OutputError
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.mask import plane_to_pixel
from roadgeo.geometry.placement import Placement
from roadgeo.geometry.projection import to_lonlat
from roadgeo.outputs.drawing.layers import rgb
from roadgeo.outputs.drawing.raster import encode
from roadgeo.outputs.drawing.views import draw_picture
from roadgeo.outputs.options import ImageOptions
from roadgeo.outputs.orthophoto import choose_target, read_preview
from roadgeo.outputs.paths import output_paths
from roadgeo.outputs.placing import warp_picture
from roadgeo.outputs.registry import ALSO, FOOTPRINT, GEOPACKAGE, JSON, OVERLAY, REPORT, VRT, Output
from roadgeo.outputs.subject import Subject, ViewLimits
from roadgeo.reference.opening import AnyReference
from roadgeo.running.passes import Sighting
from roadgeo.serving.tiles import street_at
from roadgeo.storage.files import replacing

__all__ = [
    "KEPT",
    "OFFERED",
    "OWN",
    "PICTURE",
    "SEEN",
    "SENT",
    "VIEW",
    "WARPED",
    "read_sighting",
    "safe_stem",
    "write_output",
    "write_view",
]

#: Folders of a job: the image as it was sent, files of our own, and outputs that were asked for. Apart from each other,
#: for senders choose names.
SENT, OWN, _OUTPUTS = "sent", "own", "outputs"
#: Names of files of our own: the picture reduced, the same on the map, all else that is shown,
#: and of a photograph the probability of road.
PICTURE, WARPED, VIEW, SEEN = "picture.jpg", "warped.webp", "view.json", "seen.tif"
KEPT = "kept.pickle.gz"

#: Outputs that an answer offers. A virtual raster would lead to a file that its reader has not.
OFFERED: dict[str, Output] = {
    output.name: output
    for output in (FOOTPRINT, GEOPACKAGE, JSON, REPORT, OVERLAY, *ALSO.values())
    if output is not VRT
}

#: Longer side of the picture, and on the map, pixels; their quality; side of the CRS in which web maps draw, metres.
_SIDE, _MAP_SIDE, _QUALITY, _WORLD_M = 1600, 1280, 82, 2 * 20037508.342789244
_WEB = "EPSG:3857"


def safe_stem(name: str) -> str:
    """Return the safe part of a sender's file name."""
    stem = re.sub(r"[^\w-]+", "_", Path(name.replace("\\", "/")).stem)[:50].strip("_")
    return stem or "image"


def write_view(path: Path, sighting: Sighting, references: Sequence[AnyReference]) -> None:
    """Write the page's view of an answer for the image at `path`, and keep the inputs of its files."""
    location, folder = sighting.location, path.parent.with_name(OWN)
    folder.mkdir(exist_ok=True)
    indexes = [reference.index_of(location) for reference in references]
    photo = path if sighting.of_photograph else None
    views = ViewLimits(picture_px=_SIDE)
    shown = Subject(location, sighting.mask, output_paths(folder, ""), photo=photo, indexes=indexes, views=views)
    picture = read_preview(path, _SIDE)[..., :3]
    (folder / PICTURE).write_bytes(encode(picture, Path(PICTURE).suffix, cv2.IMWRITE_JPEG_QUALITY, _QUALITY))
    view: dict[str, Any] = {"size": shown.mask_size, "roads": [], "place": None}
    view["is_photograph"] = sighting.of_photograph
    view["streets"] = [] if location.on_map else [_street(place, references) for place in location.places]
    with suppress(MaskError):  # there is not a road in it
        view["roads"] = [_rounded(line, 1) for line in shown.lines]
        view["place"] = _show_place(folder, shown) if shown.has_place else None
    if sighting.probability is not None:
        sighting.probability.write(folder / SEEN)
    (folder / VIEW).write_text(json.dumps(view, allow_nan=False), encoding="utf-8")
    with gzip.open(folder / KEPT, "wb", compresslevel=1) as file:
        pickle.dump(replace(sighting, explanation=None, probability=None), file)


def _street(place: Placement, references: Sequence[AnyReference]) -> str:
    """Name the street at the middle of a place."""
    lonlat = place.center.lon, place.center.lat
    maps = (reference for reference in references if reference.name == place.reference)
    return street_at([index for reference in maps for index in reference.indexes_at([lonlat])], lonlat)


def read_sighting(path: Path) -> Sighting | None:
    """Return the answer that is kept for the image at `path`; None where none is."""
    kept = path.parent.with_name(OWN) / KEPT
    if not kept.is_file():
        return None
    with gzip.open(kept, "rb") as file:  # our own, in a folder that is ours alone
        sighting: Sighting = pickle.load(file)  # noqa: S301
    return sighting


def write_output(path: Path, name: str, references: Sequence[AnyReference]) -> Path:
    """Write one of the files that are offered of the answer for the image at `path`; return where it lies.

    Raises
    ------
    OutputError, MaskError, CrsError
        It cannot be made.
    """
    sighting = read_sighting(path)
    if sighting is None:
        raise OutputError("its answer is not kept any more: send the image again")
    location, mask, of_photograph = sighting.location, sighting.mask, sighting.of_photograph
    folder = path.parent.with_name(_OUTPUTS)
    output, paths = OFFERED[name], output_paths(folder, path.stem)
    if not output.suits(location.on_map, location.camera is not None):
        raise OutputError("there is no place on the map to show, or no camera above the ground would see the frame so")
    indexes = [reference.index_of(location) for reference in references]
    subject = Subject(
        location, mask, paths, ImageOptions(max_pixels=64_000_000), path if of_photograph else None, indexes
    )
    folder.mkdir(exist_ok=True)
    target = paths.of(output, path.name)
    with replacing(target, sync=False) as written:
        output.write(written, subject)
    return target


# --- the place --------------------------------------------------------------------------------------------------------


def _show_place(folder: Path, shown: Subject) -> dict[str, Any]:
    """Return the layers on the map, in longitude and latitude, and draw the picture there."""
    place = shown.place

    def lay(pixels: FloatArray) -> FloatArray:
        return to_lonlat(place.crs, place.to_crs(pixels))

    roads = [line for line in (lay(item) for item in shown.lines) if np.isfinite(line).all()]
    matches, values = shown.largest_residuals(), []
    if matches is not None:
        at_pixels, there = lay(plane_to_pixel(matches.query_xy)), to_lonlat(place.crs, matches.reference_xy)
        values = [
            {"seen": _rounded(a, 7), "map": _rounded(b, 7), "residual_m": round(float(residual), 2)}
            for a, b, residual in zip(at_pixels, there, matches.residual_m, strict=True)
            if np.isfinite([*a, *b]).all()
        ]
    outline = Frame(*shown.mask_size).outline()
    return {
        "outline": _rounded(lay(np.vstack([outline, outline[:1]])), 7),
        "warped": _draw_on_map(folder / WARPED, shown),
        "roads": [_rounded(line, 7) for line in roads],
        "matches": values,
    }


def _draw_on_map(path: Path, shown: Subject) -> list[list[float]] | None:
    """Draw the picture as web maps are drawn; return where its corners lie, from the top left; None where nowhere."""
    _, *ways = choose_target(shown.place, ImageOptions(crs=_WEB))
    image, smooth = draw_picture(shown, rgb("query")), shown.photo is not None
    warped, grid = warp_picture(shown.place, image, shown.mask_size, _MAP_SIDE**2, ways, smooth)
    if grid.width == 0 or grid.width * grid.resolution > _WORLD_M / 4:
        return None
    path.write_bytes(encode(warped, path.suffix, cv2.IMWRITE_WEBP_QUALITY, _QUALITY))
    box = np.array([(0, 0), (grid.width, 0), (grid.width, grid.height), (0, grid.height)], float)
    corners: list[list[float]] = _rounded(to_lonlat(_WEB, Homography(grid.to_crs_matrix())(box)), 8)
    return corners


def _rounded(values: FloatArray, digits: int) -> Any:
    return np.round(values, digits).tolist()
