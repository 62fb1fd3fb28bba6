"""A result for Google Earth: a ground overlay in degrees, with the footprint (KMZ)."""

from __future__ import annotations

import html
import zipfile
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from roadgeo._arrays import AnyArray
from roadgeo.errors import OutputError
from roadgeo.geometry.antimeridian import cut_ring, unwrap_ring
from roadgeo.geometry.warping import MapGrid
from roadgeo.outputs.subject import Subject

__all__ = ["write_kmz"]

#: Pixels of the picture, and the colour (red, green, blue) of a mask's roads.
_PIXELS, _ROAD = 4_000_000, (228, 87, 46)
#: 11 km from a pole a picture in degrees is as wide as it is deformed.
_MAX_LATITUDE = 89.9


def write_kmz(path: Path, subject: Subject) -> None:
    """Write a ground overlay for Google Earth: the picture in degrees, or the mask's roads, and the footprint."""
    if np.abs(subject.outline()[:, 1]).max() > _MAX_LATITUDE:
        raise OutputError(
            f"{subject.location.query}: so near a pole there is no picture in degrees; leave out --also kmz"
        )
    with TemporaryDirectory(dir=path.parent, prefix=".roadgeo-") as folder:
        overlay, grid = _draw_in_degrees(subject, Path(folder))
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("doc.kml", _kml(subject, grid))
        archive.writestr("overlay.png", overlay, zipfile.ZIP_STORED)


def _draw_in_degrees(subject: Subject, folder: Path) -> tuple[bytes, MapGrid]:
    """Draw the picture, or the mask's roads, in degrees around its own longitude: PNG and grid."""
    import rasterio

    from roadgeo.outputs.orthophoto import ImageOptions, warp_image

    source = subject.picture
    if subject.photo is None:
        source = folder / "mask.png"
        drawn = np.zeros((*subject.mask.shape, 4), np.uint8)
        drawn[subject.mask.roads] = (*_ROAD[::-1], 255)
        source.write_bytes(_png(drawn))
    middle = float(unwrap_ring(subject.outline())[:-1, 0].mean())
    crs = f"+proj=longlat +datum=WGS84 +lon_wrap={middle:.6f} +no_defs"
    warped = folder / "degrees.tif"
    options = ImageOptions(crs, resampling="bilinear", max_pixels=_PIXELS, compression="zstd")
    grid = warp_image(source, warped, subject.place, subject.homography, {}, options)
    with rasterio.open(warped) as raster:
        bands, known = raster.read(), raster.dataset_mask()
        colors = bands[: raster.count - 1] if raster.dtypes[0] in {"uint8", "uint16"} else bands
    colors = _to_bytes(colors[[0, 0, 0] if len(colors) < 3 else [0, 1, 2]], known)
    picture = np.concatenate([colors[::-1], known[None]]).transpose(1, 2, 0)
    return _png(np.ascontiguousarray(picture)), grid


def _png(picture: AnyArray) -> bytes:
    encoded, content = cv2.imencode(".png", picture)
    if not encoded:
        raise OutputError("OpenCV did not encode the picture of the KMZ; use a smaller one")
    return content.tobytes()


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
    east = west + grid.width * grid.resolution  # beyond 180, as KML requires across the antimeridian
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
