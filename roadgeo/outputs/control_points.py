"""Control points of a result: the picture's own pixels with points that other programs fit a place through.

GDAL, QGIS and OpenDroneMap read pixels in their stored order, even if EXIF gives another orientation.
"""

from __future__ import annotations

import math
import os
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from roadgeo._text import visible
from roadgeo.errors import OutputError
from roadgeo.geometry.projection import to_lonlat
from roadgeo.outputs.names import name_for_odm, table_text
from roadgeo.outputs.subject import Subject
from roadgeo.storage.crs import known_crs

__all__ = [
    "georeferencer_points",
    "write_gcps",
    "write_match_points",
    "write_matches",
    "write_odm",
    "write_points",
    "write_vrt",
]


def write_gcps(path: Path, subject: Subject) -> None:
    """Write the picture's own pixels with control points, as GeoTIFF.

    GDAL draws it by a transformation fitted to the points: `gdalwarp -tps` comes closest, and from version 3.11
    on a homography.
    """
    import rasterio.shutil

    from roadgeo.storage.rasters import open_raster, writing_raster

    with TemporaryDirectory(dir=path.parent, prefix=".roadgeo-") as folder:
        vrt = Path(folder) / "gcps.vrt"
        _write_vrt(vrt, subject, Path(folder))
        with open_raster(vrt, is_ours=True) as source, writing_raster(path):
            rasterio.shutil.copy(source, path, driver="GTiff", compress="DEFLATE", tiled=True, bigtiff="IF_SAFER")


def write_vrt(path: Path, subject: Subject) -> None:
    """Write the control points as a GDAL virtual raster, which refers to the picture where it lies."""
    _write_vrt(path, subject, subject.paths.folder)  # `path` itself is staged in another folder


def _write_vrt(path: Path, subject: Subject, folder: Path) -> None:
    """Write the virtual raster as it is read in a folder."""
    import rasterio.shutil

    from roadgeo.storage.rasters import open_raster, writing_raster

    with open_raster(subject.picture.absolute(), upright=False) as source:
        if source.driver == "MEM":
            raise OutputError(f"{subject.picture}: GDAL does not read it where it lies; save it as GeoTIFF")
    with open_raster(subject.picture.absolute(), upright=False) as source, writing_raster(path):
        rasterio.shutil.copy(source, path, driver="VRT")
    if visible(subject.picture.name) != subject.picture.name:
        raise OutputError(f"{subject.picture}: XML holds no such name; rename the picture")
    document = ET.parse(path)  # noqa: S314 (GDAL wrote it just now)
    root = document.getroot()
    for source in root.iter("SourceFilename"):
        source.text, relative = _from_here(subject.picture, folder)
        source.set("relativeToVRT", relative)
    for name in ("SRS", "GeoTransform", "GCPList"):
        for element in root.findall(name):
            root.remove(element)
    wkt = known_crs(subject.place.crs).to_wkt("WKT1_GDAL")
    points = ET.Element("GCPList", Projection=wkt)
    for i, (column, row, x, y) in enumerate(subject.control_points()):
        where = {"Id": str(i + 1), "Pixel": repr(column), "Line": repr(row), "X": repr(x), "Y": repr(y)}
        ET.SubElement(points, "GCP", where)
    root.insert(0, points)
    document.write(path, encoding="unicode")


def _from_here(picture: Path, folder: Path) -> tuple[str, str]:
    """Return where a picture lies as seen from a folder, and "1"; on another drive its own path and "0"."""
    there = Path(os.path.realpath(picture.parent), picture.name)
    try:
        return os.path.relpath(there, os.path.realpath(folder)), "1"
    except ValueError:
        return str(there), "0"


def write_points(path: Path, subject: Subject) -> None:
    """Write control points for the QGIS Georeferencer, whose projective transformation reproduces the homography."""
    path.write_text(georeferencer_points(subject.place.crs, subject.control_points()), encoding="utf-8")


def georeferencer_points(crs: str, points: Iterable[Sequence[float]]) -> str:
    """Return points as the QGIS Georeferencer reads them: column, row, x, y of each, and from where a fit has it.

    That is by default nothing: dx, dy, their length, in pixels with y up.
    """
    lines = [f"#CRS: {known_crs(crs).to_wkt()}", "mapX,mapY,sourceX,sourceY,enable,dX,dY,residual"]
    for column, row, x, y, *apart in points:
        # QGIS places a picture without georeference below the x axis.
        lines.append(",".join(map(repr, (x, y, column, -row, 1, *(apart or (0, 0, 0))))))
    return "\n".join(lines) + "\n"


def write_match_points(path: Path, subject: Subject) -> None:
    """Write the matched intersections as measured, for the QGIS Georeferencer; `write_points` writes exact points."""
    points = []
    for match in subject.matches():
        pixels = np.array([[match.column, match.row], [match.fitted_column, match.fitted_row]])
        (column, row), (fitted_column, fitted_row) = subject.stored(pixels).tolist()
        # QGIS's residuals are in pixels of the source, from the point to where the transformation has it.
        dx, dy = fitted_column - column, row - fitted_row
        points.append((column, row, match.x, match.y, dx, dy, math.hypot(dx, dy)))
    path.write_text(georeferencer_points(subject.place.crs, points), encoding="utf-8")


def write_matches(path: Path, subject: Subject) -> None:
    """Write the matched intersections as a table: where the picture shows them, where the map has them, how far apart.

    `column`, `row` are pixels of the picture from the corner of its first pixel; `x`, `y` the map's coordinates in
    `crs`; `dx_m`, `dy_m` lead from where the homography puts the picture's intersection to the map's.
    """
    matches = subject.matches()
    lonlat = to_lonlat(subject.place.crs, np.array([(match.x, match.y) for match in matches], float).reshape(-1, 2))
    rows: list[list[object]] = [["id", "column", "row", "x", "y", "lon", "lat", "dx_m", "dy_m", "residual_m", "crs"]]
    for number, (match, (lon, lat)) in enumerate(zip(matches, lonlat.tolist(), strict=True), 1):
        where = [match.column, match.row, match.x, match.y, f"{lon:.9f}", f"{lat:.9f}"]
        apart = [match.dx_m, match.dy_m, math.hypot(match.dx_m, match.dy_m)]
        rows.append([number, *where, *apart, subject.place.crs])
    path.write_text(table_text(rows), encoding="utf-8", newline="")


def write_odm(path: Path, subject: Subject) -> None:
    """Write control points as OpenDroneMap's gcp_list.txt; the map knows no heights, so all are 0."""
    lines = [_odm_crs(subject.place.crs)]
    name = name_for_odm(subject.picture.name)
    lines += [f"{x!r} {y!r} 0 {column!r} {row!r} {name}" for column, row, x, y in subject.control_points()]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _odm_crs(crs: str) -> str:
    """Return a CRS as OpenDroneMap reads it: an EPSG code, else a PROJ string, for it knows no WKT."""
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a PROJ string lacks names; of our own planes nothing else
        return crs if crs.upper().startswith("EPSG:") else str(known_crs(crs).to_proj4())
