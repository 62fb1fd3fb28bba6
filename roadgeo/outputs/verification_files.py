"""Outputs of `roadgeo verify`: corrected copies, control points, one table of all, and offsets for map editors.

Editors of OpenStreetMap move imagery by metres of the Mercator map, which are longer than those on the ground by about
1 / cos(latitude): JOSM as bookmarks in its preferences (`imagery.offsetbookmarks`, in EPSG:3857), which it imports from
a file of commands whose root is `config`; iD and Rapid as `offset=east,north` in the fragment of the URL. Both move the
imagery to the east and north where the numbers are positive.
"""

from __future__ import annotations

import csv
import io
import math
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from roadgeo._text import visible
from roadgeo.errors import OutputError
from roadgeo.outputs.names import bare_names, table_cell, without_folders
from roadgeo.storage.crs import known_crs
from roadgeo.storage.files import replacing, write_text
from roadgeo.storage.orientation import read_orientation

if TYPE_CHECKING:
    from roadgeo.geometry.georeference import Georeference

__all__ = ["editor_offset", "id_fragment", "write_fixed", "write_in_place", "write_josm", "write_points", "write_table"]

_COLUMNS = (
    "image", "verdict", "reason", "reference", "east_m", "north_m", "turn_deg", "scale", "sigma_m", "off_m",
    "residual_m", "log10_lead", "agreeing", "agreeing_as_given", "lon", "lat", "mercator_east", "mercator_north", "id",
)  # fmt: skip

#: Radii of WGS 84.
_EQUATORIAL_M, _POLAR_M = 6378137.0, 6356752.314245


def editor_offset(east_m: float, north_m: float, lat: float) -> tuple[float, float]:
    """Return a shift on the ground as metres of the Mercator map, which draws the ellipsoid's latitudes on a sphere."""
    stretch = 1.0 / math.cos(math.radians(lat))
    flat = (_POLAR_M / _EQUATORIAL_M) ** 2
    round_ = math.sqrt(1.0 - (1.0 - flat) * math.sin(math.radians(lat)) ** 2)
    # The radii of curvature are a / round_ to the east and a flat / round_^3 to the north.
    return east_m * stretch * round_, north_m * stretch * round_**3 / flat


def id_fragment(lon: float, lat: float, offset: tuple[float, float]) -> str:
    """Return the fragment of a URL that opens iD or Rapid there with its imagery moved by metres of the Mercator map.

    Both take a metre to the north for one of a globe whose meridian has the polar radius.
    """
    east, north = offset[0], offset[1] * _POLAR_M / _EQUATORIAL_M
    return f"#map=17/{lat:.5f}/{lon:.5f}&offset={east:.2f},{north:.2f}"


def write_table(path: Path, documents: Sequence[Mapping[str, Any]]) -> None:
    """Write one row for each image as CSV."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_COLUMNS)
    names = bare_names([str(document["image"]) for document in documents])
    for document, image in zip(documents, names, strict=True):
        reason = without_folders(str(document.get("reason") or ""), str(document["image"]))
        writer.writerow([_cell({**document, "image": image, "reason": reason}, name) for name in _COLUMNS])
    write_text(path, text.getvalue())


def _cell(document: Mapping[str, Any], name: str) -> Any:
    parts = (document, document.get("displacement") or {}, document.get("editors") or {}, document.get("center") or {})
    found = next((part[name] for part in parts if part.get(name) is not None), "")
    return table_cell(found) if isinstance(found, str) else found


def write_josm(path: Path, documents: Sequence[Mapping[str, Any]]) -> None:
    """Write the offsets of images that are off as bookmarks that JOSM adds to those it has."""
    root = ET.Element("config")
    preferences = ET.SubElement(root, "preferences", operation="append")
    bookmarks = ET.SubElement(preferences, "maps", key="imagery.offsetbookmarks")
    for document in documents:
        if document["verdict"] != "off":
            continue
        entry = ET.SubElement(bookmarks, "map")
        values = {
            "projection_code": "EPSG:3857",
            "imagery_name": _plain(Path(document["image"]).name),
            "name": f"roadgeo {_plain(Path(document['image']).stem)}",
            "dx": f"{document['editors']['mercator_east']:.3f}",
            "dy": f"{document['editors']['mercator_north']:.3f}",
            "center_lon": f"{document['center']['lon']:.7f}",
            "center_lat": f"{document['center']['lat']:.7f}",
        }
        for key, value in values.items():
            ET.SubElement(entry, "tag", key=key, value=value)
    ET.indent(root)
    write_text(path, ET.tostring(root, encoding="unicode", xml_declaration=True) + "\n")


def _plain(name: str) -> str:
    """Return a name that is safe in JOSM, which runs text in ${} as a program; XML has no control characters."""
    return visible(name).replace("${", "$(")


def write_points(path: Path, place: Georeference) -> None:
    """Write 25 control points of a corrected place, for the QGIS Georeferencer."""
    rows = [f"#CRS: {known_crs(place.crs).to_wkt()}"]
    rows.append("mapX,mapY,sourceX,sourceY,enable,dX,dY,residual")
    for (column, row), (x, y) in zip(*(array.tolist() for array in place.control_points()), strict=True):
        rows.append(f"{x!r},{y!r},{column!r},{-row!r},1,0,0,0")
    write_text(path, "\n".join(rows) + "\n")


def write_fixed(image: Path, path: Path, place: Georeference) -> None:
    """Write a copy of a raster, its pixels untouched, with a corrected georeference: GeoTIFF.

    Raises
    ------
    OutputError
        It would overwrite the image itself, or cannot be written.
    """
    import rasterio.shutil

    from roadgeo.storage.rasters import open_raster

    if path.resolve() == image.resolve():
        raise OutputError(f"{path}: is the image itself; choose another --out-dir, or --in-place to overwrite it")
    with replacing(path) as temporary:
        with open_raster(image, upright=False) as source:
            rasterio.shutil.copy(source, temporary, driver="GTiff", compress="DEFLATE", tiled=True, bigtiff="IF_SAFER")
        _set_place(temporary, place.of_stored(read_orientation(image)))


def write_in_place(image: Path, place: Georeference) -> None:
    """Overwrite the georeference of a GeoTIFF.

    Raises
    ------
    OutputError
        It is of another format, or not writable.
    """
    from roadgeo.storage.rasters import open_raster

    with open_raster(image, upright=False) as source:
        driver = source.driver
    if driver != "GTiff":
        raise OutputError(f"{image}: only GeoTIFFs can be corrected in place; use --fix, which writes one")
    _set_place(image, place.of_stored(read_orientation(image)))


def _set_place(path: Path, place: Georeference) -> None:
    """Replace the georeference of a GeoTIFF."""
    import rasterio
    from rasterio.control import GroundControlPoint
    from rasterio.errors import NotGeoreferencedWarning, RasterioError

    try:
        with warnings.catch_warnings(), ExitStack() as files:
            warnings.simplefilter("ignore", NotGeoreferencedWarning)  # it is about to be
            raster = files.enter_context(rasterio.open(path, "r+"))
            if np.allclose(place.matrix[2], (0, 0, 1), atol=1e-15):
                raster.crs, raster.transform = place.crs, rasterio.Affine(*place.matrix[:2].ravel())
            else:
                points = zip(*(array.tolist() for array in place.control_points()), strict=True)
                raster.gcps = [GroundControlPoint(p[1], p[0], q[0], q[1]) for p, q in points], place.crs
    except RasterioError as error:
        raise OutputError(f"cannot write {path}: {error}") from error
