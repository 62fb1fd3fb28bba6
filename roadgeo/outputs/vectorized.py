"""The roads that roadgeo sees in a mask, for inspection: a GeoPackage in pixel coordinates, and a picture."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, FloatArray
from roadgeo.errors import OutputError
from roadgeo.geometry.mask import RoadMask, plane_to_pixel
from roadgeo.outputs.orthophoto import read_preview
from roadgeo.outputs.registry import VECTORIZED
from roadgeo.roads.graph import RoadGraph
from roadgeo.roads.intersections import Intersections
from roadgeo.storage.files import write_bytes
from roadgeo.storage.geopackage import PIXELS, Layer, write_layers
from roadgeo.storage.qml import draw_line, draw_marker

__all__ = ["draw_vectorized", "write_vectorized"]

_MAX_SIDE = 6000  # of the picture; larger masks are drawn reduced
_STRIP_ROWS = 256

# Colours as OpenCV orders them: blue, green, red.
_SEEN = np.array((200, 60, 200))  # over a photograph
_PALER, _TINT = 0.8, 0.4
_GROUND, _ROAD, _UNSEEN = (30, 24, 20), (110, 104, 98), (70, 40, 40)
_LINE, _RAY, _CENTRE = (40, 190, 255), (90, 90, 255), (255, 255, 255)


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
    folder = Path(out_dir)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"cannot make the folder {folder}: {error.strerror}; choose one that you may write to"
        ) from error
    package, picture = (folder / f"{stem}{VECTORIZED}{suffix}" for suffix in (".gpkg", ".png"))
    write_layers(package, _layers(graph, intersections, coarser))
    ground = None if photo is None else read_preview(photo, _MAX_SIDE)[..., 2::-1]
    encoded, content = cv2.imencode(".png", draw_vectorized(mask, graph, intersections, ground))
    if not encoded:
        raise OutputError(f"cannot encode {picture}")
    write_bytes(picture, content.tobytes())
    return [package, picture]


def _layers(graph: RoadGraph, intersections: Intersections, coarser: float) -> list[Layer]:
    """Return the two layers, styled. From a corner of the frame, where both planes have their origin, all is scaled."""
    roads = Layer(
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
    nodes = Layer(
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
    """Draw roads and intersections over the mask, (H, W, 3) uint8, blue, green, red; reduced if it is large.

    `ground` is a photograph of the frame, of any size, to draw them over instead.
    """
    scale = min(1.0, _MAX_SIDE / max(mask.shape))
    roads = mask.roads.view(np.uint8) * np.uint8(255)
    size = (max(round(mask.shape[1] * scale), 1), max(round(mask.shape[0] * scale), 1))
    share = cv2.resize(roads, size, interpolation=cv2.INTER_AREA)
    shown = None if ground is None else cv2.resize(ground, size, interpolation=cv2.INTER_AREA)
    over, tint = (np.array(_ROAD), 1.0) if shown is None else (_SEEN, _TINT)
    picture = np.empty((*share.shape, 3), np.uint8)
    for top in range(0, len(share), _STRIP_ROWS):  # floating-point numbers of all of it would take gigabytes
        strip = slice(top, top + _STRIP_ROWS)
        below = np.array(_GROUND) if shown is None else _PALER * shown[strip]
        picture[strip] = np.rint(below + tint * (share[strip, :, None] / 255.0) * (over - below))
    if mask.observed is not None:
        seen = cv2.resize(mask.observed.view(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        picture[seen == 0] = _UNSEEN
    cv2.polylines(picture, [_fixed(line, scale) for line in graph.polylines()], False, _LINE, 1, cv2.LINE_AA, 4)
    directions = np.stack((np.cos(intersections.rays), np.sin(intersections.rays)), axis=-1)
    tips = intersections.xy[:, None] + 12.0 / scale * directions
    rays = [np.stack((intersections.xy[i], tips[i, k])) for i, k in np.argwhere(np.isfinite(intersections.rays))]
    cv2.polylines(picture, [_fixed(ray, scale) for ray in rays], False, _RAY, 1, cv2.LINE_AA, 4)
    for column, row in _fixed(intersections.xy, scale)[:, 0].tolist():
        cv2.circle(picture, (column, row), 3 * 16, _CENTRE, cv2.FILLED, cv2.LINE_AA, 4)
    return np.asarray(picture)


def _fixed(xy: FloatArray, scale: float) -> AnyArray:
    """Take (V, 2) points of the query plane to OpenCV's (V, 1, 2) pixels from pixel centres, in sixteenths."""
    sixteenths = np.rint((plane_to_pixel(xy) * scale - 0.5) * 16)
    return np.asarray(sixteenths, np.int32)[:, None]
