"""Roads as lines in place of a mask: digitised on a picture, surveyed in metres, or inferred from GPS tracks.

They are drawn as a mask would show them, and located like one.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo.errors import MaskError, RoadSourceError
from roadgeo.geometry.homography import shift
from roadgeo.geometry.mask import RoadMask
from roadgeo.geometry.projection import choose_plane, serves_as_plane, to_lonlat, to_plane
from roadgeo.storage.crs import known_crs

__all__ = ["Drawing", "Units", "draw_roads"]

Units = Literal["auto", "pixels", "metres"]

_MOST_PX, _LEAST_PX, _MARGIN_PX = 4000, 400, 24
_ROAD_M, _ROAD_PX = 8.0, 6.0
_MOST_DEGREES = 3.0  # wider than this they are no frame


@dataclass(frozen=True)
class Drawing:
    """Lines drawn as a mask.

    Attributes
    ----------
    to_pixel : (3, 3) float64 or None
        The lines' coordinates to pixels of the mask (column, row; corner convention). None where they came in degrees,
        or in another CRS that is not true to scale: they are drawn in metres.
    unit_m : float or None
        Metres per pixel, where the lines' units determine it.
    north_up : bool
        Whether the units imply that up is north, within a few degrees.
    middle : (lon, lat) or None
        Where they lie by their own CRS.
    """

    mask: RoadMask
    to_pixel: FloatArray | None
    unit_m: float | None
    north_up: bool
    middle: tuple[float, float] | None = None


def draw_roads(
    path: str | os.PathLike[str], units: Units = "auto", layer: str | Sequence[str] | None = None
) -> Drawing:
    """Read the roads of a file as `read_roads` does and draw them: lines, or without lines polygons.

    Parameters
    ----------
    layer : str or sequence of str, optional
        Layers of a file with several.
    units : "auto", "pixels" or "metres"
        Units of their coordinates. By default the units of the CRS that the file names, if they fit it, and pixels of a
        picture where all lie below the x axis, as QGIS digitises on one. Pixels above it are rows, downwards.

    Raises
    ------
    MaskError
        The file holds no lines, or its units are unknown.
    """
    from roadgeo.sources.roads import are_exchanged
    from roadgeo.sources.streams import read_lines, tell_state

    name = os.fspath(path)
    try:
        read = read_lines(Path(path), layer, areas=True)
    except RoadSourceError as error:
        raise MaskError(str(error)) from error
    tell_state(name, read.meta | ({"exchanged": True} if are_exchanged(read) else {}))
    import shapely
    from rasterio.features import rasterize

    is_drawn = len(read.lines) > 0
    shapes = read.lines if is_drawn else read.areas
    coords = shapely.get_coordinates(shapes)
    kind = _tell_units(name, coords, read.crs) if units == "auto" else units
    lonlat = to_lonlat(read.crs, coords) if read.crs is not None and kind != "pixels" and units == "auto" else None
    lonlat = None if lonlat is None or not np.isfinite(lonlat).all() else lonlat
    middle = None if lonlat is None else (float(lonlat[:, 0].mean()), float(lonlat[:, 1].mean()))
    moved = lonlat is not None and not serves_as_plane(str(read.crs), lonlat)
    if lonlat is not None and moved:
        plane = choose_plane(lonlat)
        shapes = shapely.transform(shapes, partial(to_plane, str(read.crs), plane))
        coords = shapely.get_coordinates(shapes)
    # The lines' plane with y up: rows of a picture count downwards.
    downwards = kind == "pixels" and coords[:, 1].max() > 0
    flip = np.diag([1.0, -1.0, 1.0]) if not downwards else np.eye(3)
    low, high = coords.min(axis=0), coords.max(axis=0)
    side = float((high - low).max())
    if not 0 < side < 1e9:
        raise MaskError(f"{name}: its lines cover {side:g} units; expected a frame of roads")
    unit = max(side / _MOST_PX, 1.0) if kind == "pixels" else float(np.clip(1.0, side / _MOST_PX, side / _LEAST_PX))
    corner = _MARGIN_PX - np.array([low[0], low[1] if downwards else -high[1]]) / unit
    to_pixel = shift(*corner) @ np.diag([1.0 / unit, 1.0 / unit, 1.0]) @ flip
    width, height = np.ceil((high - low) / unit).astype(int) + 2 * _MARGIN_PX
    road = _ROAD_PX if kind == "pixels" else float(np.clip(_ROAD_M / unit, 4.0, 12.0))
    shapes = shapely.transform(shapes, lambda xy: xy @ to_pixel[:2, :2].T + to_pixel[:2, 2])
    shapes = shapely.buffer(shapes, road / 2.0, quad_segs=2) if is_drawn else shapes
    roads = rasterize(shapes, (int(height), int(width)), dtype=np.uint8).view(np.bool_)
    mask = RoadMask(roads, name=name)
    return Drawing(mask, None if moved else to_pixel, None if kind == "pixels" else unit, moved, middle)


def _tell_units(name: str, coords: FloatArray, crs: str | None) -> Literal["pixels", "metres", "degrees"]:
    """Return the units of coordinates by their CRS and size."""
    low, high = coords.min(axis=0), coords.max(axis=0)
    if crs is not None:
        resolved = known_crs(crs)
        if not resolved.is_geographic:
            return "metres"
        fits = bool((np.abs(low) <= (180, 90)).all() and (np.abs(high) <= (180, 90)).all())
        if fits and (high - low).max() <= _MOST_DEGREES:
            return "degrees"
    if high[1] <= 0:
        return "pixels"
    raise MaskError(
        f"{name}: does not say what its coordinates are; give --units pixels or --units metres, or save degrees with "
        "their CRS, as GeoPackage"
    )
