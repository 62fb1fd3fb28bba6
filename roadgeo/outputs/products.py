"""A result in the forms that other programs ask for: control points, world file, GeoJSON, STAC, KML."""

from __future__ import annotations

import html
import json
import xml.etree.ElementTree as ET
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, FloatArray
from roadgeo.errors import OutputError
from roadgeo.geometry.antimeridian import bounds_of, cut_ring, unwrap_ring
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.mask import RoadMask
from roadgeo.geometry.warping import MapGrid
from roadgeo.location import Location
from roadgeo.outputs.paths import OutputPaths, Placement, attributes

__all__ = ["PRODUCTS", "Product", "Subject"]

#: Control points lie on a grid of so many rows and columns, from corner to corner.
_GRID = 5
#: Pixels of a picture for Google Earth, and the colour (red, green, blue) of a mask's roads there.
_KMZ_PIXELS, _KMZ_ROAD = 4_000_000, (228, 87, 46)
#: 11 km from a pole a picture in degrees is as wide as it is deformed.
_KMZ_LATITUDE = 89.9
#: No photograph from the air is older: what stands for an unknown date.
_FIRST_AERIAL_PHOTOGRAPH = "1858-01-01T00:00:00Z"


@dataclass(frozen=True)
class Subject:
    """What the products show.

    Attributes
    ----------
    picture : Path
        The photograph, or else the mask, as it came.
    size : (int, int)
        Its width and height.
    homography : (3, 3) float64
        From its pixels (column, row; GDAL corner convention) to the place's CRS.
    grid, crs : MapGrid, str
        Of the warped raster.
    mask : RoadMask or None
        Given where `picture` is the mask itself.
    """

    location: Location
    place: Placement
    picture: Path
    size: tuple[int, int]
    homography: FloatArray
    grid: MapGrid
    crs: str
    paths: OutputPaths
    mask: RoadMask | None = None

    def control_points(self) -> list[tuple[float, float, float, float]]:
        """Column, row, x, y of 25 points on a grid over the picture."""
        columns, rows = np.meshgrid(np.linspace(0, self.size[0], _GRID), np.linspace(0, self.size[1], _GRID))
        pixels = np.stack([columns.ravel(), rows.ravel()], axis=1)
        points: list[tuple[float, float, float, float]]
        points = [tuple(point) for point in np.hstack([pixels, Homography(self.homography)(pixels)]).tolist()]
        return points

    def outline(self) -> FloatArray:
        """Ring (32, 2) of longitude and latitude around the footprint, counterclockwise; see `roadgeo.degrees`."""
        from roadgeo.geometry.projection import to_lonlat

        width, height = self.size
        corners = np.array([[0, 0], [0, height], [width, height], [width, 0]], float)
        sides = zip(corners, np.roll(corners, -1, axis=0), strict=True)
        pixels = np.concatenate([np.linspace(a, b, 8, endpoint=False) for a, b in sides])
        return to_lonlat(self.place.crs, Homography(self.homography)(pixels))


@dataclass(frozen=True)
class Product:
    """One form of the result.

    Attributes
    ----------
    ending : str
        What the file's name ends with, after the result's stem; "{picture}" stands for the picture's own name instead.
    write : callable
        Writes the file.
    summary : str
        What it is for.
    """

    ending: str
    write: Callable[[Path, Subject], None]
    summary: str

    def path(self, folder: Path, stem: str, picture: str) -> Path:
        """Name the file."""
        return folder / (self.ending.replace("{picture}", picture) if "{" in self.ending else stem + self.ending)


# --- control points ---------------------------------------------------------------------------------------------------


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


def write_world_file(path: Path, subject: Subject) -> None:
    """Write the world file of the warped raster: a homography does not fit into one, so the picture itself has none."""
    grid, half = subject.grid, subject.grid.resolution / 2
    values = (grid.resolution, 0.0, 0.0, -grid.resolution, grid.west + half, grid.north - half)
    path.write_text("".join(f"{value!r}\n" for value in values), encoding="ascii")


# --- outlines ---------------------------------------------------------------------------------------------------------


def write_geojson(path: Path, subject: Subject) -> None:
    """Write the footprint as GeoJSON as of RFC 7946: degrees, counterclockwise, cut at 180 degrees."""
    feature = {
        "type": "Feature",
        "bbox": _bounds(subject.outline()),
        "geometry": _geometry(subject.outline()),
        "properties": attributes(subject.location),
    }
    path.write_text(json.dumps(feature, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def write_stac(path: Path, subject: Subject) -> None:
    """Write a STAC 1.0 Item that describes the warped raster, with the projection extension."""
    location, grid, paths = subject.location, subject.grid, subject.paths
    taken = datetime.fromtimestamp(subject.picture.stat().st_mtime, UTC)
    own = {f"roadgeo:{key}": value for key, value in attributes(location).items() if value is not None}
    code = subject.crs if subject.crs.upper().startswith("EPSG:") else None
    projection = {"proj:code": code} if code else {"proj:code": None, "proj:wkt2": subject.crs}
    item = {
        "type": "Feature",
        "stac_version": "1.0.0",
        "stac_extensions": ["https://stac-extensions.github.io/projection/v2.0.0/schema.json"],
        "id": paths.stem,
        "bbox": _bounds(subject.outline()),
        "geometry": _geometry(subject.outline()),
        "properties": {
            # When it was taken nobody told: some time before the file was last written.
            "datetime": None,
            "start_datetime": _FIRST_AERIAL_PHOTOGRAPH,
            "end_datetime": taken.strftime("%Y-%m-%dT%H:%M:%SZ"),
            "gsd": location.gsd_m,
            **projection,
            "proj:shape": [grid.height, grid.width],
            "proj:transform": [grid.resolution, 0.0, grid.west, 0.0, -grid.resolution, grid.north, 0.0, 0.0, 1.0],
            **own,
        },
        "links": [],
        "assets": {
            "footprint": _asset(paths.footprint, "image/tiff; application=geotiff; profile=cloud-optimized", "data"),
            "location": _asset(paths.json, "application/json", "metadata"),
            "matches": _asset(paths.geopackage, "application/geopackage+sqlite3", "metadata"),
        },
    }
    path.write_text(json.dumps(item, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def write_kmz(path: Path, subject: Subject) -> None:
    """Write a ground overlay for Google Earth: the picture in degrees, or the mask's roads, and the footprint."""
    if np.abs(subject.outline()[:, 1]).max() > _KMZ_LATITUDE:
        raise OutputError(f"cannot write {path}: so near a pole there is no picture in degrees; leave out kmz")
    with TemporaryDirectory(dir=path.parent, prefix=".roadgeo-") as folder:
        overlay, grid = _draw_in_degrees(subject, Path(folder))
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("doc.kml", _kml(subject, grid))
        archive.writestr("overlay.png", overlay, zipfile.ZIP_STORED)


# --- their parts ------------------------------------------------------------------------------------------------------


def _geometry(ring: FloatArray) -> dict[str, Any]:
    """Return a GeoJSON polygon, or where the ring lies astride 180 degrees two."""
    polygons = [[np.round(part, 7).tolist()] for part in cut_ring(ring)]
    if len(polygons) == 1:
        return {"type": "Polygon", "coordinates": polygons[0]}
    return {"type": "MultiPolygon", "coordinates": polygons}


def _bounds(ring: FloatArray) -> list[float]:
    """Return west, south, east, north as RFC 7946 wants them."""
    return [round(value, 7) for value in bounds_of(ring)]


def _asset(path: Path, media_type: str, role: str) -> dict[str, Any]:
    return {"href": f"./{path.name}", "type": media_type, "roles": [role]}


def _draw_in_degrees(subject: Subject, folder: Path) -> tuple[bytes, MapGrid]:
    """Draw the picture, or the mask's roads, in degrees around its own longitude: PNG and grid."""
    import rasterio

    from roadgeo.outputs.orthophoto import ImageOptions, warp_image

    source = subject.picture
    if subject.mask is not None:
        source = folder / "mask.png"
        drawn = np.zeros((*subject.mask.shape, 4), np.uint8)
        drawn[subject.mask.roads] = (*_KMZ_ROAD[::-1], 255)
        cv2.imwrite(str(source), drawn)
    middle = float(unwrap_ring(subject.outline())[:-1, 0].mean())
    crs = f"+proj=longlat +datum=WGS84 +lon_wrap={middle:.6f} +no_defs"
    warped = folder / "degrees.tif"
    options = ImageOptions(crs, resampling="bilinear", max_pixels=_KMZ_PIXELS)
    grid = warp_image(source, warped, subject.place, subject.homography, {}, options)
    with rasterio.open(warped) as raster:
        bands, known = raster.read(), raster.dataset_mask()
        colors = bands[: raster.count - 1] if raster.dtypes[0] in {"uint8", "uint16"} else bands
    colors = _to_bytes(colors[[0, 0, 0] if len(colors) < 3 else [0, 1, 2]], known)
    picture = np.concatenate([colors[::-1], known[None]]).transpose(1, 2, 0)
    return cv2.imencode(".png", np.ascontiguousarray(picture))[1].tobytes(), grid


def _to_bytes(colors: AnyArray, known: AnyArray) -> AnyArray:
    """Stretch deeper values to 8 bit, between the darkest and the brightest hundredth."""
    if colors.dtype == np.uint8:
        return np.asarray(colors)
    low, high = np.percentile(colors[:, known > 0], (1, 99))
    stretched = (np.nan_to_num(colors.astype(float)) - low) * (255.0 / max(float(high - low), 1e-9))
    return np.asarray(np.clip(stretched, 0, 255), np.uint8)


_KML_POLYGON = """<Polygon><tessellate>1</tessellate>
<outerBoundaryIs><LinearRing><coordinates>{}</coordinates></LinearRing></outerBoundaryIs>
</Polygon>"""


def _kml(subject: Subject, grid: MapGrid) -> str:
    west = (grid.west + 180.0) % 360.0 - 180.0
    east = west + grid.width * grid.resolution  # beyond 180, as KML wants it of what lies astride
    south = grid.north - grid.height * grid.resolution
    rings = [" ".join(f"{lon:.7f},{lat:.7f},0" for lon, lat in ring) for ring in cut_ring(subject.outline())]
    polygons = "\n".join(map(_KML_POLYGON.format, rings))
    name = html.escape(subject.paths.stem)
    said = html.escape(f"{subject.location.reason}. {subject.location.attribution}".strip())
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<kml xmlns="http://www.opengis.net/kml/2.2">
<Document><name>{name}</name><description>{said}</description>
<Style id="footprint">
<LineStyle><color>ffb46f1f</color><width>3</width></LineStyle><PolyStyle><fill>0</fill></PolyStyle>
</Style>
<GroundOverlay><name>{name}</name><Icon><href>overlay.png</href></Icon>
<LatLonBox>
<north>{grid.north:.9f}</north><south>{south:.9f}</south><east>{east:.9f}</east><west>{west:.9f}</west>
</LatLonBox>
</GroundOverlay>
<Placemark><name>footprint</name><styleUrl>#footprint</styleUrl>
<MultiGeometry>
{polygons}
</MultiGeometry>
</Placemark>
</Document>
</kml>
"""


GCPS = Product("_gcps.tif", write_gcps, "the picture's own pixels with 25 control points, GeoTIFF")
VRT = Product("_gcps.vrt", write_vrt, "the same as a GDAL virtual raster: no pixels are copied")
POINTS = Product("{picture}.points", write_points, "control points for the QGIS Georeferencer")
ODM = Product("_gcp_list.txt", write_odm, "control points for OpenDroneMap")
WORLD_FILE = Product("_footprint.tfw", write_world_file, "world file of the warped raster")
GEOJSON = Product("_footprint.geojson", write_geojson, "footprint as GeoJSON (RFC 7946)")
STAC = Product("_stac.json", write_stac, "STAC Item of the warped raster")
KMZ = Product("_overlay.kmz", write_kmz, "ground overlay for Google Earth")

#: Our own outputs by the names under which pyproject.toml registers them (see `roadgeo.plugins`).
PRODUCTS = {
    "gcps": GCPS,
    "vrt": VRT,
    "points": POINTS,
    "odm": ODM,
    "worldfile": WORLD_FILE,
    "geojson": GEOJSON,
    "stac": STAC,
    "kmz": KMZ,
}
