"""Paint the demonstration's photograph: the streets of Porto that the mask `drone.png` shows, between invented houses.

    python examples/demo/paint_photo.py

Aerial photographs that anyone may pass on are rare, so this one is painted. The streets come from OpenStreetMap, as
the camera of the mask sees them; roofs, gardens, trees and cars only look the part.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeAlias

import cv2
import geopandas as gpd
import numpy as np
import shapely
from make_demo import WIDTH_M

from roadgeo._arrays import AnyArray
from roadgeo.evaluation.demo import PHOTO, ROADS, demo_masks
from roadgeo.geometry.homography import Homography

__all__ = ["paint_photo"]

Color: TypeAlias = tuple[int, int, int]

# Blue, green, red.
GRASS, PAVEMENT, ASPHALT, SHADOW = (72, 112, 98), (172, 178, 184), (128, 126, 124), (52, 56, 58)
ROOFS = ((62, 96, 168), (54, 84, 148), (76, 112, 182), (70, 90, 140), (150, 160, 172), (196, 200, 206))
TREES = ((44, 78, 58), (52, 92, 70), (40, 70, 48))
CARS = ((235, 235, 235), (40, 40, 42), (120, 60, 40), (50, 50, 160), (170, 170, 172))
SIZE, FINE = (1280, 960), 3
SUN_M = (4.0, -3.0)  # where the shadow of an eave falls, east and north of it


def paint_photo(path: Path) -> None:
    """Write the photograph as JPEG."""
    rng = np.random.default_rng(7)
    to_pixel = Homography(next(mask.homography for mask in demo_masks() if mask.path.stem == "drone")).inverse()
    canvas = np.full((SIZE[1] * FINE, SIZE[0] * FINE, 3), GRASS, np.uint8)
    canvas = _rough(canvas, 40 * FINE, 9.0, rng)
    streets, pavements, lines = _streets(to_pixel)
    roofs, trees = _houses(shapely.difference(_ground(to_pixel), pavements), rng)

    def fill(shapes: Any, color: Color) -> None:
        for part in shapely.get_parts(shapes):
            if part.geom_type == "Polygon" and not part.is_empty:
                rings = [to_pixel(np.asarray(ring.coords)) * FINE * 16 for ring in (part.exterior, *part.interiors)]
                cv2.fillPoly(canvas, [np.rint(ring).astype(np.int32) for ring in rings], color, cv2.LINE_AA, 4)

    fill(pavements, PAVEMENT)
    fill(streets, ASPHALT)
    for tree in trees:
        fill(tree, TREES[rng.integers(len(TREES))])
    for car in _cars(lines, rng):
        fill(car, CARS[rng.integers(len(CARS))])
    for roof in roofs:
        fill(shapely.transform(roof, lambda xy: xy + SUN_M), SHADOW)
    for roof in roofs:
        shade = np.array(ROOFS[rng.choice(len(ROOFS), p=(0.26, 0.22, 0.2, 0.12, 0.12, 0.08))]) * rng.uniform(0.9, 1.08)
        fill(roof, tuple(np.clip(shade, 0, 255).astype(int).tolist()))
    photo = cv2.resize(_rough(canvas, 3 * FINE, 6.0, rng), SIZE, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(path), photo, [cv2.IMWRITE_JPEG_QUALITY, 70])


def _ground(to_pixel: Homography) -> Any:
    """Return the polygon that the frame and a margin around it cover, metres."""
    width, height = SIZE
    frame = np.array([[-40, -40], [width + 40, -40], [width + 40, height + 40], [-40, height + 40]], float)
    return shapely.Polygon(to_pixel.inverse()(frame))


def _streets(to_pixel: Homography) -> tuple[Any, Any, Any]:
    """Return the carriageways, the same with their pavements, and the streets' middles, on the ground."""
    roads = gpd.read_file(ROADS).to_crs(demo_masks()[1].crs)
    roads = roads[~roads.tunnel.isin(["yes", "building_passage"]) & roads.intersects(_ground(to_pixel))]
    half = roads.highway.map(WIDTH_M).to_numpy() / 2
    lines = roads.geometry.to_numpy()
    wide = shapely.union_all(shapely.buffer(lines, half + np.where(half > 2.5, 2.0, 0.5)))
    return shapely.union_all(shapely.buffer(lines, half)), wide, lines[half > 3]


def _houses(blocks: Any, rng: np.random.Generator) -> tuple[list[Any], list[Any]]:
    """Return a roof for each house along the blocks' edges, and trees in the courts within."""
    roofs: list[Any] = []
    trees: list[Any] = []
    for block in shapely.get_parts(blocks):
        yard = block.buffer(-15)
        row = block.difference(yard)
        walls = np.arange(0, block.exterior.length, 1.0)
        walls = walls[rng.uniform(size=len(walls)) < 0.09]
        if len(walls) > 3 and block.area < 120_000:
            middles = shapely.multipoints(shapely.line_interpolate_point(block.exterior, walls))
            for plot in shapely.get_parts(shapely.voronoi_polygons(middles, extend_to=block)):
                if rng.uniform() < 0.9:
                    roofs += [part for part in shapely.get_parts(plot.intersection(row)) if part.area > 15]
        west, south, east, north = block.bounds
        spots = shapely.points(rng.uniform((west, south), (east, north), (int(block.area / 90), 2)))
        inside = spots[shapely.contains(yard, spots)]
        trees += list(shapely.buffer(inside, rng.uniform(1.5, 5.0, len(inside)), quad_segs=4))
    return roofs, trees


def _cars(lines: Any, rng: np.random.Generator) -> list[Any]:
    """Return rectangles of 4.4 x 1.8 m on the right of the streets."""
    cars = []
    for line in lines:
        for along in np.arange(5, line.length - 5, 9.0):
            if rng.uniform() < 0.35:
                a, b = (np.array(line.interpolate(along + step).coords[0]) for step in (-2.2, 2.2))
                ahead = (b - a) / max(float(np.hypot(*(b - a))), 1e-9)
                right = np.array([ahead[1], -ahead[0]])
                cars.append(shapely.Polygon([a + 1.6 * right, b + 1.6 * right, b + 3.4 * right, a + 3.4 * right]))
    return cars


def _rough(picture: AnyArray, grain: int, strength: float, rng: np.random.Generator) -> AnyArray:
    """Make a picture uneven: brighter and darker in spots of `grain` pixels."""
    height, width = picture.shape[:2]
    coarse = rng.normal(0, strength, (height // grain + 2, width // grain + 2)).astype(np.float32)
    spots = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.asarray(np.clip(picture + spots[..., None], 0, 255).astype(np.uint8))


if __name__ == "__main__":
    paint_photo(PHOTO)
