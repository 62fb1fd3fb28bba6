"""A result for Google Earth: a ground overlay in degrees, with the footprint (KMZ)."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from roadgeo._text import in_html
from roadgeo.errors import OutputError
from roadgeo.geometry.antimeridian import cut_ring, unwrap_ring
from roadgeo.geometry.warping import MapGrid
from roadgeo.outputs.drawing.layers import rgb
from roadgeo.outputs.drawing.raster import encode
from roadgeo.outputs.drawing.views import mask_picture
from roadgeo.outputs.options import ImageOptions
from roadgeo.outputs.orthophoto import choose_target, read_preview
from roadgeo.outputs.placing import warp_picture
from roadgeo.outputs.subject import Subject

__all__ = ["write_kmz"]

#: Pixels of the picture, and the longer side of its source.
_PIXELS, _SIDE = 4_000_000, 2500

#: 11 km from a pole a picture in degrees is as wide as it is deformed.
_MAX_LATITUDE = 89.9


def write_kmz(path: Path, subject: Subject) -> None:
    """Write a ground overlay for Google Earth: the picture in degrees, or the mask's roads, and the footprint."""
    if np.abs(subject.outline()[:, 1]).max() > _MAX_LATITUDE:
        raise OutputError(
            f"{subject.location.query}: so near a pole there is no picture in degrees; leave out --also kmz"
        )
    overlay, grid = _draw_in_degrees(subject)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("doc.kml", _kml(subject, grid))
        archive.writestr("overlay.png", overlay, zipfile.ZIP_STORED)


def _draw_in_degrees(subject: Subject) -> tuple[bytes, MapGrid]:
    """Draw the picture, or the mask's roads, in degrees around its own longitude: PNG and grid."""
    photo, place = subject.photo, subject.place
    image = mask_picture(subject.mask, rgb("query"), _SIDE) if photo is None else read_preview(photo, _SIDE)
    middle = float(unwrap_ring(subject.outline())[:-1, 0].mean())
    crs = f"+proj=longlat +datum=WGS84 +lon_wrap={middle:.6f} +no_defs"
    _, *ways = choose_target(place, ImageOptions(crs))
    warped, grid = warp_picture(place, image, subject.mask.shape[::-1], _PIXELS, ways)
    return encode(warped, ".png"), grid


_KML_POLYGON = """<Polygon><tessellate>1</tessellate>
<outerBoundaryIs><LinearRing><coordinates>{}</coordinates></LinearRing></outerBoundaryIs>
</Polygon>"""


def _kml(subject: Subject, grid: MapGrid) -> str:
    west = (grid.west + 180.0) % 360.0 - 180.0
    east = west + grid.width * grid.resolution  # beyond 180, as KML requires across the antimeridian
    south = grid.north - grid.height * grid.resolution
    rings = [" ".join(f"{lon:.7f},{lat:.7f},0" for lon, lat in ring) for ring in cut_ring(subject.outline())]
    polygons = "\n".join(map(_KML_POLYGON.format, rings))
    name = in_html(subject.paths.stem)
    text = in_html(f"{subject.location.reason}. {subject.location.attribution}".strip())
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<kml xmlns="http://www.opengis.net/kml/2.2">
<Document><name>{name}</name><description>{text}</description>
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
