"""The roads that roadgeo sees in a mask, for inspection: a GeoPackage in pixel coordinates, and a picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from roadgeo._arrays import AnyArray
from roadgeo.geometry.mask import RoadMask, plane_to_pixel
from roadgeo.outputs.drawing import layers as drawn
from roadgeo.outputs.drawing.layers import Bitmap, Color, Dots, Lines
from roadgeo.outputs.drawing.raster import Canvas, write_png
from roadgeo.outputs.drawing.views import mask_picture
from roadgeo.outputs.orthophoto import read_preview
from roadgeo.outputs.registry import VECTORIZED
from roadgeo.roads.graph import RoadGraph
from roadgeo.roads.intersections import Intersections
from roadgeo.storage.files import make_folder, replacing
from roadgeo.storage.geopackage import PIXELS, FeatureTable, write_layers
from roadgeo.storage.qml import draw_line, draw_marker

__all__ = ["draw_vectorized", "write_vectorized"]

_MAX_SIDE = 6000  # of the picture; larger masks are drawn reduced

#: Over a photograph: how much of it is left, and where the mask has roads.
_PALER = 0.35
_SEEN: Color = (200, 60, 200)
_GREY: Color = (206, 208, 210)


def write_vectorized(
    out_dir: str | Path,
    stem: str,
    mask: RoadMask,
    graph: RoadGraph,
    intersections: Intersections,
    *,
    coarser: float = 1.0,
    photo: str | None = None,
) -> list[Path]:
    """Write `STEM_vectorized.gpkg` and `STEM_vectorized.png` into a folder, which is made if need be.

    The GeoPackage's layers `roads` and `intersections` lie on no place on Earth (undefined Cartesian): x is the column,
    y the negative row, in pixels of the mask, as QGIS places an image without georeference. So the layers lie on the
    mask when both are opened together.

    Parameters
    ----------
    out_dir : path
    stem : str
        Start of the files' names.
    mask : RoadMask
    graph : RoadGraph
        In the query plane (see `geometry.mask`).
    intersections : Intersections
        Found on `graph`.
    coarser : float
        Pixels of the image, which the layers are to lie on, for each of the mask.
    photo : path, optional
        A photograph of the frame, to draw the roads over.

    Returns
    -------
    list of Path

    Raises
    ------
    OutputError
        A file cannot be written.
    """
    make_folder(out_dir)
    package, picture = (Path(out_dir) / f"{stem}{VECTORIZED}{suffix}" for suffix in (".gpkg", ".png"))
    write_layers(package, _layers(graph, intersections, coarser))
    ground = None if photo is None else read_preview(photo, _MAX_SIDE)
    with replacing(picture) as temporary:
        write_png(temporary, draw_vectorized(mask, graph, intersections, ground))
    return [package, picture]


def _layers(graph: RoadGraph, intersections: Intersections, coarser: float) -> list[FeatureTable]:
    """Return the two layers, styled. From a corner of the frame, where both planes have their origin, all is scaled."""
    roads = FeatureTable(
        "roads",
        "LINESTRING",
        [coarser * line for line in graph.polylines()],
        {
            "id": np.arange(graph.n_edges),
            "from_node": graph.edges[:, 0],
            "to_node": graph.edges[:, 1],
            "length_px": coarser * graph.edge_lengths(),
        },
        PIXELS,
        draw_line("255,190,40", 0.5),
        "Centre lines of the roads; x = column, y = -row, pixels",
    )
    nodes = FeatureTable(
        "intersections",
        "POINT",
        coarser * intersections.xy,
        {
            "id": np.arange(len(intersections)),
            "node": intersections.node,
            "branches": intersections.n_branches,
            "tangents": intersections.n_tangents,
            "residual_px": coarser * intersections.residual.astype(np.float64),
        },
        PIXELS,
        draw_marker("255,90,90", 2.2),
        "Intersections with their branches and tangents counted; x = column, y = -row, pixels",
    )
    return [roads, nodes]


def draw_vectorized(
    mask: RoadMask, graph: RoadGraph, intersections: Intersections, ground: AnyArray | None = None
) -> AnyArray:
    """Draw roads and intersections over the mask, (H, W, 3) uint8, red, green, blue; reduced if it is large.

    `ground` is a photograph of the frame, (h, w, 4) of any size, to draw them over.
    """
    height, width = mask.shape
    scale = min(1.0, _MAX_SIDE / max(mask.shape))
    box = (0.0, 0.0, float(width), float(height))
    directions = np.stack((np.cos(intersections.rays), np.sin(intersections.rays)), axis=-1)
    tips = intersections.xy[:, None] + 12.0 / scale * directions
    rays = [np.stack((intersections.xy[i], tips[i, k])) for i, k in np.argwhere(np.isfinite(intersections.rays))]
    canvas = Canvas.of(box, 0, 0, scale)
    if ground is not None:
        paler = ground.copy()
        paler[..., 3] = (paler[..., 3] * (1.0 - _PALER)).astype(np.uint8)
        canvas.draw([drawn.Layer("picture", "", [Bitmap(paler, box)])])
    picture = mask_picture(mask, _GREY if ground is None else _SEEN, _MAX_SIDE)
    if ground is not None:
        picture[..., 3] //= 3
    canvas.draw(
        [
            drawn.Layer("picture", "", [Bitmap(picture, box)]),
            drawn.Layer("query-roads", "", [Lines([plane_to_pixel(line) for line in graph.polylines()])]),
            drawn.Layer("branches", "", [Lines([plane_to_pixel(ray) for ray in rays])]),
            drawn.Layer("matches", "", [Dots(plane_to_pixel(intersections.xy))]),
        ]
    )
    return canvas.image
