"""The report of `verify`: an image with the map's roads as its georeference puts them, and as they belong."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo._text import in_html
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.georeference import Georeference
from roadgeo.geometry.homography import Homography
from roadgeo.matching.index import ReferenceIndex
from roadgeo.outputs.drawing.layers import Bitmap, Layer, Lines
from roadgeo.outputs.drawing.svg import join_segments, thin_lines
from roadgeo.outputs.drawing.views import touching
from roadgeo.outputs.names import bare_name
from roadgeo.outputs.orthophoto import read_preview
from roadgeo.outputs.report.page import label_values, render_page, section
from roadgeo.outputs.report.viewer import draw_viewer
from roadgeo.storage.files import write_text

__all__ = ["write_verification"]

#: Side and bytes of the picture, and vertices of each of the two drawings of the map's roads.
_PICTURE_PX, _PICTURE_BYTES, _MOST_VERTICES = 1400, 300_000, 40_000
#: How each verdict is coloured, and shown.
_STATUS = {
    "agrees": ("located", "✓ agrees"),
    "off": ("ambiguous", "≠ off"),
    "unknown": ("not_located", "? unknown"),
    "error": ("error", "! failed"),
}


def write_verification(
    path: Path,
    document: Mapping[str, Any],
    sentence: str,
    place: Georeference | None = None,
    corrected: Georeference | None = None,
    index: ReferenceIndex | None = None,
) -> None:
    """Write a page of its own about one image.

    Parameters
    ----------
    document : mapping
        Result of schema roadgeo.verification/1.
    sentence : str
        The answer in a sentence.
    place, corrected : Georeference or None
        The place that the image states, and the place by the roads if that is another.
    index : ReferenceIndex or None
        The map that it was held against.

    Raises
    ------
    MaskError
        The image cannot be read.
    OutputError
        The page cannot be written.
    """
    name, verdict = bare_name(document["image"]), document["verdict"]
    view = "" if place is None else _draw(document["image"], name, place, corrected, index)
    rows = [(label, in_html(value)) for label, value in _numbers(document) if value]
    parts = [section("Numbers", label_values(rows) if rows else "")]
    credit = str(document.get("attribution") or "")
    write_text(path, render_page(name, sentence, view, parts, credit, _STATUS[verdict]))


def _draw(
    image: str, name: str, place: Georeference, corrected: Georeference | None, index: ReferenceIndex | None
) -> str:
    """Draw the image, and the map's roads in its pixels."""
    width, height = place.size
    box = (0.0, 0.0, float(width), float(height))
    layers = [Layer("picture", "image", [Bitmap(read_preview(Path(image), _PICTURE_PX), box, _PICTURE_BYTES)])]
    if index is not None:
        given = "the map's roads, as the image has them" if corrected else "roads of the map"
        layers.append(Layer("map-roads" if corrected else "query-roads", given, _roads_in(place, index)))
        if corrected is not None:
            layers.append(Layer("query-roads", "the map's roads, corrected", _roads_in(corrected, index)))
    return draw_viewer(f"The image {name}, with the roads of the map", box, layers)


def _roads_in(place: Georeference, index: ReferenceIndex) -> list[Lines]:
    """Return the map's roads where they lie in an image by one of its places."""
    frame = Frame(*place.size)
    there = Homography(place.on_plane(index.plane)).facing(frame.center)
    corners: FloatArray = there(frame.corners)
    ends = index.segments.reshape(-1, 2, 2).astype(float)
    near = ends[touching(ends, corners.min(axis=0), corners.max(axis=0))]
    if len(near) == 0:
        return []
    back = there.inverse()
    pixels = np.asarray(back(near.reshape(-1, 2))).reshape(-1, 2, 2)
    kept = touching(pixels, np.zeros(2), np.array(place.size, float))
    return [Lines(thin_lines(join_segments(pixels[kept]), _MOST_VERTICES))]


def _numbers(document: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Label and value of all that is known."""
    offset, center = document.get("displacement"), document.get("center")
    rows = []
    if offset is not None:
        rows += [
            ("Move it", f"{offset['east_m']:+.2f} m east, {offset['north_m']:+.2f} m north"),
            ("Turn it", f"{offset['turn_deg']:+.3f}° clockwise"),
            ("Scale it by", f"{offset['scale']:.5f}"),
        ]
        if "off_m" in offset:
            rows.append(("Off, mean of the frame", f"{offset['off_m']:.2f} ± {offset['sigma_m']:.2f} m"))
    if document.get("agreeing") is not None:
        rows.append(("Roads that agree", f"{document['agreeing']:.0%}, as it is {document['agreeing_as_given']:.0%}"))
    if document.get("log10_lead") is not None:
        rows.append(("Score", f"{document['log10_lead']:.1f}"))
    if center is not None:
        rows.append(("Middle, as it says", f"{center['lon']:.6f}, {center['lat']:.6f} (longitude, latitude)"))
        rows.append(("Its place is told by", str(document.get("georeference", ""))))
    rows += [("Map", str(document.get("reference", "")))]
    return rows
