"""Control points of a result: the picture's own pixels with points that other programs fit a place through."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path
from tempfile import TemporaryDirectory

from roadgeo.outputs.subject import Subject

__all__ = ["write_gcps", "write_odm", "write_points", "write_vrt"]


def write_gcps(path: Path, subject: Subject) -> None:
    """Write the picture's own pixels with control points, as GeoTIFF.

    GDAL draws it on the map with what it fits through the points: `gdalwarp -tps` comes closest, and from version 3.11
    on a homography.
    """
    import rasterio.shutil

    from roadgeo.storage.rasters import open_raster

    with TemporaryDirectory(dir=path.parent, prefix=".roadgeo-") as folder:
        vrt = Path(folder) / "gcps.vrt"
        write_vrt(vrt, subject)
        with open_raster(vrt, is_ours=True) as source:
            rasterio.shutil.copy(source, path, driver="GTiff", compress="DEFLATE", tiled=True, bigtiff="IF_SAFER")


def write_vrt(path: Path, subject: Subject) -> None:
    """Write the control points as a GDAL virtual raster, which refers to the picture where it lies."""
    import pyproj
    import rasterio.shutil

    from roadgeo.storage.rasters import open_raster

    with open_raster(subject.picture.absolute()) as source:
        rasterio.shutil.copy(source, path, driver="VRT")
    document = ET.parse(path)  # noqa: S314 (GDAL wrote it just now)
    root = document.getroot()
    for name in ("SRS", "GeoTransform", "GCPList"):
        for element in root.findall(name):
            root.remove(element)
    wkt = pyproj.CRS.from_user_input(subject.place.crs).to_wkt("WKT1_GDAL")
    points = ET.Element("GCPList", Projection=wkt)
    for i, (column, row, x, y) in enumerate(subject.control_points()):
        where = {"Id": str(i + 1), "Pixel": repr(column), "Line": repr(row), "X": repr(x), "Y": repr(y)}
        ET.SubElement(points, "GCP", where)
    root.insert(0, points)
    document.write(path, encoding="unicode")


def write_points(path: Path, subject: Subject) -> None:
    """Write control points for the QGIS Georeferencer, whose projective transformation reproduces the homography."""
    import pyproj

    wkt = pyproj.CRS.from_user_input(subject.place.crs).to_wkt()
    lines = [f"#CRS: {wkt}", "mapX,mapY,sourceX,sourceY,enable,dX,dY,residual"]
    # QGIS places a picture without georeference below the x axis.
    lines += [f"{x!r},{y!r},{column!r},{-row!r},1,0,0,0" for column, row, x, y in subject.control_points()]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_odm(path: Path, subject: Subject) -> None:
    """Write control points as OpenDroneMap's gcp_list.txt; the map knows no heights, so all are 0."""
    lines = [_odm_crs(subject.place.crs)]
    lines += [
        f"{x!r} {y!r} 0 {column!r} {row!r} {subject.picture.name}" for column, row, x, y in subject.control_points()
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _odm_crs(crs: str) -> str:
    """Return a CRS as OpenDroneMap reads it: an EPSG code, else a PROJ string, for it knows no WKT."""
    import warnings

    import pyproj

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a PROJ string lacks names; of our own planes nothing else
        return crs if crs.upper().startswith("EPSG:") else str(pyproj.CRS.from_user_input(crs).to_proj4())
