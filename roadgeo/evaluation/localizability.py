"""Where on a map would masks be located? A map of the odds, learnt from masks tried at random places of it.

The odds depend on how many intersections a mask shows, how many of them stand clear of others (at interchanges they
merge), how much their streets differ in direction (a lattice has few directions and looks alike everywhere), and how
well this reference, this camera and this quality of masks go together. All but the last is known at every place of the
map; the weights are fitted to the trials by logistic regression.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, BoolArray, FloatArray
from roadgeo.evaluation.scoring import share
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.projection import LocalPlane
from roadgeo.geometry.warping import MapGrid
from roadgeo.outputs.drawing.layers import Bitmap, Layer, Lines, rgb
from roadgeo.outputs.drawing.raster import FAINT, Canvas, below, beside, blank, draw_scale_bar, framed, line
from roadgeo.roads.network import RoadNetwork

__all__ = [
    "AMBIGUOUS",
    "LOCATED",
    "PALETTE",
    "TOO_FEW",
    "UNKNOWN",
    "LocalizabilityMap",
    "PlaceGrid",
    "draw_localizability",
    "lay_grid",
    "map_localizability",
    "to_geotiff",
]

UNKNOWN, LOCATED, AMBIGUOUS, TOO_FEW = 0, 1, 2, 3

#: Value: colour, alpha and meaning.
PALETTE = {
    UNKNOWN: ("#000000", 0, "off the map"),
    LOCATED: ("#2e8b57", 150, "would be located"),
    AMBIGUOUS: ("#e08a1e", 150, "may be ambiguous or refused"),
    TOO_FEW: ("#a9324a", 150, "too few intersections"),
}

_DIRECTIONS = 12

#: Intersections with no other nearer than this are clear.
CLEAR_M = 40.0

#: Places are marked as located where, of the trials at places that promise as much or more, surely (at the lower end of
#: the interval of this number of standard errors) this share was located; and where they promise this probability
#: themselves.
_LOCATED_SHARE, _Z, _MIN_PROBABILITY = 0.95, 1.5, 0.95
#: Places with fewer intersections around them hold too few, whatever the trials were: `locate` refuses such masks.
_MIN_INTERSECTIONS = 6
#: Cells along the side of a window; they are larger where the map would have more than this number along a side.
_CELLS_PER_WINDOW, _MAX_CELLS = 10.0, 2000

_LONGER_PX = 1400  # side of the picture


@dataclass(frozen=True)
class PlaceGrid:
    """Places of a map and their properties. Dimensions: R rows from north, C columns from west.

    Attributes
    ----------
    cells : MapGrid
        On the plane.
    covered : (R, C) bool
        Where the map knows the roads.
    footprint_m2 : float
        Ground that a mask shows.
    counts : (R, C) float32
        Intersections within the footprint of a mask (a disc of its area).
    features : (R, C, 3) float64
        log(1 + count), the entropy of the directions of the streets there, and log(1 + count of clear intersections).
    """

    plane: LocalPlane
    cells: MapGrid
    footprint_m2: float
    covered: BoolArray
    counts: AnyArray
    features: FloatArray

    def draw(self, count: int, where: BoolArray, rng: np.random.Generator) -> FloatArray:
        """Draw (count, 2) positions, uniform over the covered cells that `where` (R, C) allows, or over all if none."""
        cells = np.argwhere(self.covered & where)
        cells = cells if len(cells) else np.argwhere(self.covered)
        at = cells[rng.integers(len(cells), size=count)] + rng.random((count, 2))
        return Homography(self.cells.to_crs_matrix())(at[:, ::-1])


@dataclass(frozen=True)
class LocalizabilityMap:
    """Expected results of masks centred in the cells of a grid (R, C).

    Attributes
    ----------
    classes : (R, C) uint8
        `LOCATED`, `AMBIGUOUS`, `TOO_FEW`, or `UNKNOWN` off the map.
    probability : (R, C) float32
        Probability of being located, as fitted; NaN off the map.
    threshold : float
        Probability from which cells are marked as located; infinite where the trials support none.
    """

    grid: PlaceGrid
    classes: AnyArray
    probability: AnyArray
    threshold: float

    def at(self, xy: FloatArray) -> AnyArray:
        """Classes at (K, 2) plane positions."""
        row, column = _at(xy, self.grid.cells)
        inside = (row >= 0) & (row < self.classes.shape[0]) & (column >= 0) & (column < self.classes.shape[1])
        values = np.full(len(xy), UNKNOWN, np.uint8)
        values[inside] = self.classes[row[inside], column[inside]]
        return values


def lay_grid(network: RoadNetwork, footprint_m2: float) -> PlaceGrid:
    """Describe every place of a map for masks of this area on the ground."""
    coords = network.graph.coords
    (west, south), (east, north) = coords.min(axis=0), coords.max(axis=0)
    cell = max(math.sqrt(footprint_m2) / _CELLS_PER_WINDOW, max(east - west, north - south) / _MAX_CELLS)
    cells = MapGrid(float(west), float(north), cell, math.ceil((east - west) / cell), math.ceil((north - south) / cell))
    counts, features = _features(network, cells, math.sqrt(footprint_m2 / math.pi))
    return PlaceGrid(network.plane, cells, footprint_m2, _covered(network, cells), counts, features)


def map_localizability(grid: PlaceGrid, places: FloatArray, located: BoolArray) -> LocalizabilityMap:
    """Learn from trials where masks are located, and predict it for the whole map.

    Parameters
    ----------
    places : (T, 2) float64
        Where masks were tried: the middles of their frames, plane metres.
    located : (T,) bool
        Which of them were located.
    """
    row, column = _near(places, grid.cells)
    intercept, *weights = _fit(grid.features[row, column], located)
    probability = _logistic(grid.features @ weights + intercept)
    threshold = _threshold(probability[row, column], located)
    none = grid.counts < _MIN_INTERSECTIONS
    # The least number of intersections with which any mask is rather located than not.
    few = none | (grid.counts < grid.counts[probability >= 0.5].min(initial=np.inf))
    classes = np.where((probability >= threshold) & ~none, LOCATED, np.where(few, TOO_FEW, AMBIGUOUS))
    return LocalizabilityMap(
        grid,
        np.where(grid.covered, classes, UNKNOWN).astype(np.uint8),
        np.where(grid.covered, probability, np.nan).astype(np.float32),
        threshold,
    )


# --- learning ---------------------------------------------------------------------------------------------------------


def _at(xy: FloatArray, cells: MapGrid) -> tuple[AnyArray, AnyArray]:
    """Rows and columns of the cells that (K, 2) positions lie in."""
    column, row = np.floor((xy - (cells.west, cells.north)) * (1.0, -1.0) / cells.resolution).astype(int).T
    return row, column


def _near(xy: FloatArray, cells: MapGrid) -> tuple[AnyArray, AnyArray]:
    """Rows and columns of the cells that lie nearest to (K, 2) positions."""
    row, column = _at(xy, cells)
    return np.clip(row, 0, cells.height - 1), np.clip(column, 0, cells.width - 1)


def _features(network: RoadNetwork, cells: MapGrid, radius: float) -> tuple[AnyArray, FloatArray]:
    """Count intersections within `radius` of every cell, and make the features of a `PlaceGrid`."""
    points = network.intersections
    reach = round(radius / cells.resolution)
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    disc = (np.hypot(x, y) * cells.resolution <= radius).astype(np.float32)

    def spread(xy: FloatArray) -> AnyArray:
        layer = np.zeros((cells.height, cells.width), np.float32)
        np.add.at(layer, _near(xy, cells), 1.0)
        return np.maximum(cv2.filter2D(layer, -1, disc, borderType=cv2.BORDER_CONSTANT), 0.0)

    counts = np.round(spread(points.xy))
    clear = np.round(spread(points.xy[_clear(points.xy)]))
    has_tangent = np.isfinite(points.tangents)
    owner, _ = np.nonzero(has_tangent)
    direction = np.floor(points.tangents[has_tangent] / math.pi * _DIRECTIONS).astype(int) % _DIRECTIONS
    layers = np.stack([spread(points.xy[owner[direction == d]]) for d in range(_DIRECTIONS)], axis=-1)
    shares = layers / np.maximum(layers.sum(axis=-1, keepdims=True), 1.0)
    entropy = -(shares * np.log(np.maximum(shares, 1e-9))).sum(axis=-1)
    return counts, np.stack([np.log1p(counts), entropy, np.log1p(clear)], axis=-1)


def _clear(xy: FloatArray) -> BoolArray:
    """(N,) whether points have no other within `CLEAR_M`."""
    from scipy.spatial import cKDTree

    distance, _ = cKDTree(xy).query(xy, k=2)
    return np.asarray(distance[:, 1] > CLEAR_M)


def _fit(features: FloatArray, located: BoolArray, ridge: float = 0.01) -> FloatArray:
    """Fit a logistic regression with an intercept, (T, F) features to (T,) outcomes; (1 + F,) weights.

    The weights of standardized features are drawn to 0 by `ridge`: without that, trials that all went the same way
    would have no finite optimum.
    """
    from scipy.optimize import minimize

    mean, scale = features.mean(axis=0), features.std(axis=0) + 1e-9
    design = np.column_stack([np.ones(len(features)), (features - mean) / scale])
    signs = np.where(located, -1.0, 1.0)

    def loss(weights: FloatArray) -> float:
        return float(np.logaddexp(0.0, signs * (design @ weights)).sum() + ridge * (weights @ weights) / 2)

    def slope(weights: FloatArray) -> FloatArray:
        return np.asarray(design.T @ (_logistic(design @ weights) - located) + ridge * weights)

    weights = minimize(loss, np.zeros(design.shape[1]), jac=slope, method="BFGS").x
    return np.concatenate(([weights[0] - (weights[1:] * mean / scale).sum()], weights[1:] / scale))


def _logistic(x: FloatArray) -> FloatArray:
    return np.asarray(1.0 / (1.0 + np.exp(-np.clip(x, -500.0, 500.0))))


def _threshold(probability: FloatArray, located: BoolArray) -> float:
    """Lowest probability above which the trials were surely located as often as asked."""
    order = np.argsort(-probability, kind="stable")
    hits = np.cumsum(located[order])
    sure = [share(int(hits[k]), k + 1, _Z).low >= _LOCATED_SHARE for k in range(len(order))]
    last = np.flatnonzero(sure)
    return max(float(probability[order[last[-1]]]), _MIN_PROBABILITY) if len(last) else math.inf


def _covered(network: RoadNetwork, cells: MapGrid) -> BoolArray:
    """(R, C) whether the map knows the roads of a cell."""
    inside = np.full((cells.height, cells.width), not network.coverage, np.uint8)
    scale, corner = (16.0 / cells.resolution) * np.array([1.0, -1.0]), (cells.west, cells.north)
    rings = [np.rint((ring - corner) * scale).astype(np.int32) for ring in network.coverage]
    cv2.fillPoly(inside, rings, 1, cv2.LINE_8, 4)  # rings within rings are holes
    return inside.astype(bool)


# --- outputs ----------------------------------------------------------------------------------------------------------


def to_geotiff(raster_map: LocalizabilityMap) -> bytes:
    """Write the classes (band 1, with a colour table) and the probability in percent (band 2) as a GeoTIFF."""
    import rasterio

    grid, cells = raster_map.grid, raster_map.grid.cells
    x, y = grid.plane.to_crs(np.array([cells.west, cells.north]))
    height, width = raster_map.classes.shape
    place = {"crs": grid.plane.crs, "transform": rasterio.Affine(cells.resolution, 0.0, x, 0.0, -cells.resolution, y)}
    kind = {"compress": "deflate", "interleave": "band", "photometric": "minisblack"}
    percent = np.where(np.isnan(raster_map.probability), 255, np.nan_to_num(raster_map.probability) * 100).round()
    with rasterio.MemoryFile() as memory:
        with memory.open(driver="GTiff", width=width, height=height, count=2, dtype="uint8", **place, **kind) as raster:
            raster.write(raster_map.classes, 1)
            raster.write(percent.astype(np.uint8), 2)
            raster.set_band_description(
                1, "class: " + ", ".join(f"{v} {label}" for v, (_, _, label) in PALETTE.items())
            )
            raster.set_band_description(2, "probability of being located, percent (255: off the map)")
        return bytes(memory.read())


def draw_localizability(network: RoadNetwork, drawn_map: LocalizabilityMap, title: str) -> AnyArray:
    """Draw the map over its roads, with legend and scale: (height, width, 3) uint8, red, green, blue."""
    cells, colors = drawn_map.grid.cells, {value: (*rgb(color), alpha) for value, (color, alpha, _) in PALETTE.items()}
    rows, columns = drawn_map.classes.shape
    box = (0.0, 0.0, columns * cells.resolution, rows * cells.resolution)
    canvas = Canvas.of(box, _LONGER_PX, _LONGER_PX)
    lines = [(line - (cells.west, cells.north)) * (1.0, -1.0) for line in network.graph.polylines()]
    classes = np.array([colors[value] for value in range(len(PALETTE))], np.uint8)[drawn_map.classes]
    canvas.draw([Layer("picture", "", [Bitmap(classes, box)]), Layer("streets", "", [Lines(lines)])])
    draw_scale_bar(canvas, 22)
    legend = []
    for value, (_, alpha, label) in list(PALETTE.items())[1:]:
        red, green, blue = (round((alpha * part + (255 - alpha) * 255) / 255) for part in colors[value][:3])
        legend.append(beside(blank(22, 22, (red, green, blue)), line(label, 17), gap=8))
    credit = line(str(network.meta.get("attribution") or ""), 16, FAINT)
    return framed(below(line(title, 24, bold=True), beside(*legend, gap=28), canvas.image, credit, gap=8), 10)
