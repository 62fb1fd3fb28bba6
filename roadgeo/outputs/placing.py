"""A picture of a frame, and its roads, placed on the map."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, FloatArray
from roadgeo.errors import OutputError
from roadgeo.geometry.mask import plane_to_pixel
from roadgeo.geometry.placement import Placement
from roadgeo.geometry.warping import MapGrid, Transform, cover, warp
from roadgeo.location import Location
from roadgeo.roads.graph import RoadGraph

__all__ = ["map_roads", "placement_of", "warp_picture"]


def placement_of(location: Location) -> Placement:
    """Return the place of a location that has one.

    Raises
    ------
    OutputError
        It has none.
    """
    if location.place is None:
        raise OutputError(f"{location.query} has no place on the map to draw: it is {location.status}")
    return location.place


def warp_picture(
    place: Placement,
    image: AnyArray,
    size: tuple[int, int],
    max_pixels: int,
    ways: Sequence[Transform] = (None, None),
    smooth: bool = True,
) -> tuple[AnyArray, MapGrid]:
    """Draw a picture of the frame, whose mask has `size` (width, height), on a grid of its own.

    `ways` lead to the CRS of the grid, and back (see `orthophoto.Target`).
    """
    shown = image.shape[1], image.shape[0]
    to_crs = place.homography @ np.diag([size[0] / shown[0], size[1] / shown[1], 1.0])
    grid = cover(shown, to_crs, None, max_pixels, ways[0])
    interpolation = cv2.INTER_LINEAR if smooth else cv2.INTER_NEAREST
    return warp(image, to_crs, grid, ways[1], interpolation, place.lens(shown)), grid


def map_roads(place: Placement, graph: RoadGraph) -> list[FloatArray]:
    """Lay the mask's roads (query plane) on the map: (V, 2) each, but for those that reach beyond the horizon.

    A homography keeps lines straight, so mapping their vertices is exact.
    """
    if graph.n_edges == 0:
        return []
    mapped = place.to_crs(plane_to_pixel(graph.coords))
    whole = np.logical_and.reduceat(np.isfinite(mapped).all(axis=1), graph.offsets[:-1])
    parts = zip(graph.offsets[:-1].tolist(), graph.offsets[1:].tolist(), strict=True)
    return [mapped[first:last] for (first, last), ahead in zip(parts, whole.tolist(), strict=True) if ahead]
