"""The likelihood of a place by the picture: the probability of road under the map's roads, and beside them.

A cell of the frame shows p, the probability of road; pi is its mean over the ground around, `_USUAL_M` metres along a
side. Against the picture's own distribution there, road shows p with the ratio s = p / pi, other ground with
b = (1 - p) / (1 - pi). Under a place H

    log L(H) = sum over the map's roads     log[ (1 - m) s + m b ]
             + sum over the other ground    log[ (1 - f pi) b + f pi s ]

with m the share of the map's roads that the picture lacks, and f the density of roads that the map lacks, in parts of
the picture's own. Both are marginalised over a small grid. A place without evidence has log L = 0. Neighbouring cells
agree together, so `_STATEMENT_M` metres of road count once.

All shifts of a place are compared at once: the rectified picture is correlated with the map by FFT.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, Float32Array, FloatArray
from roadgeo.geometry.camera import sampling
from roadgeo.geometry.homography import Homography
from roadgeo.matching.evidence import SHARES
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.place import Place, Weight
from roadgeo.matching.scene import Scene, in_pixels
from roadgeo.matching.shifts import Shift, move_about, shifted

__all__ = ["Picture", "by_picture"]

#: Levels of log odds: this number for each nat, up to this log odds either way.
_FINE, _SUREST = 16.0, 5.5
#: Side of the ground over which the usual probability of road is taken, metres. A frame of some kilometres shows town
#: and field: with one for all of it, any dense roads under the town gain. Five crops of 1.6 to 3.2 km, truth and best
#: wrong place: 116 and 114, 95 and 45, 56 and 186, 60 and 146, 35 and 9 with one for all; 100 and 31, 73 and 6, 40 and
#: 100, 56 and 120, 31 and 9 with 1,200 m; 84 and 8, 63 and 1, 26 and 24, 48 and 18, 26 and 6 with 300 m.
_USUAL_M = 300.0
#: Width of the map's roads, as they are drawn, metres.
_ROAD_M = 8.0
#: This length of the map's roads counts as one independent statement, metres. Without a place, the lead of the best
#: place over the next falls off like an exponential: with this length a lead of 1 is met one time in ten.
_STATEMENT_M = 250.0
#: A greater log10 likelihood counts as this one (see `Picture.lead`).
_MOST_LIKELIHOOD = 10.0
#: Most cells along a side of the ground on which all shifts of a place are compared.
_MOST_CELLS = 1100
#: Steps by which a place is moved, cells.
_STEPS = np.vstack([np.eye(2), -np.eye(2)])


class Ground(NamedTuple):
    """The map's roads as a raster, rows northwards: the share of each cell (rows, columns), its corner, its cell."""

    roads: Float32Array
    corner: FloatArray
    cell_m: float


class _Levels(NamedTuple):
    """The picture in levels of log odds (h, w), pixels per cell, its neutral level, and log ratios (share, level)."""

    cells: AnyArray
    scale: float
    neutral: int
    on: FloatArray
    off: FloatArray


class Picture:
    """Weighs places of one scene with a probability on one map, by one yardstick; see `Evidence` for `gsd_m`."""

    def __init__(self, scene: Scene, index: ReferenceIndex, gsd_m: float) -> None:
        self.scene, self.index, self.gsd_m = scene, index, gsd_m
        self.statement_px = in_pixels(_STATEMENT_M, gsd_m)

    def weigh(self, matrix: FloatArray, ground: Ground | None = None) -> float:
        """Return log10 L of a place, query plane to reference plane (3, 3)."""
        nats = self._nats(matrix, ground)
        most = float(nats.max())
        return (most + math.log(float(np.exp(nats - most).mean()))) / math.log(10.0)

    def _nats(self, matrix: FloatArray, ground: Ground | None = None) -> FloatArray:
        """Return log L by (missing, false)."""
        gsd_m = self._gsd_m(matrix)
        ground = ground or self._around(matrix, self._fine_cell_m(matrix), 0.0)
        rectified = self._rectify(matrix, ground)
        if rectified is None:
            return np.zeros((len(SHARES), len(SHARES)))
        levels, template, (column, row) = rectified
        n, (rows, columns) = levels.on.shape[1], ground.roads.shape
        top, left = max(row, 0), max(column, 0)
        bottom, right = min(row + template.shape[0], rows), min(column + template.shape[1], columns)
        whole, under = np.bincount(template.ravel(), minlength=n), np.zeros(n)
        if top < bottom and left < right:
            cut = template[top - row : bottom - row, left - column : right - column]
            under += np.bincount(cut.ravel(), ground.roads[top:bottom, left:right].ravel(), n)
        unit = _length_px(ground.cell_m, gsd_m) / self.statement_px
        return np.asarray(unit * ((levels.on @ under)[:, None] + levels.off @ (whole - under)))

    @staticmethod
    def lead(likelihood: float, rival: float) -> float:
        """Return the log10 lead of a place over a rival, from the log10 L of each.

        In a grid that resembles its mirror image, a wrong place leads by a constant part of its likelihood, and so by
        more the larger the frame. A likelihood beyond `_MOST_LIKELIHOOD` counts by the part that the rival lacks.
        """
        return (likelihood - max(rival, 0.0)) * min(1.0, _MOST_LIKELIHOOD / max(likelihood, 1e-9))

    def place(self, matrix: FloatArray, log10_likelihood: float) -> Place:
        """Return a place by its homography (3, 3), with its likelihood by the picture."""
        return Place(self.scene, self.index, matrix, by=Weight(log10_likelihood, self.statement_px))

    def settle(self, place: Place) -> Place:
        """Return a place found on coarse cells moved by steps of a fine cell to where it is likeliest."""
        cell_m = self._fine_cell_m(place.matrix)
        ground = self._around(place.matrix, cell_m, 5.0 * cell_m)
        best = self.place(place.matrix, self.weigh(place.matrix, ground))
        for _ in range(4):
            moved = [shifted(best.matrix, *step) for step in cell_m * _STEPS]
            places = (self.place(matrix, self.weigh(matrix, ground)) for matrix in moved)
            better = max(places, key=lambda place: place.log10_likelihood)
            if better.log10_likelihood <= best.log10_likelihood:
                break
            best = better
        return best

    def correlate(
        self, matrix: FloatArray, reach_m: float, turns_deg: Sequence[float], most: int, apart_m: float
    ) -> list[Place]:
        """Return other places around a place where the picture correlates with the map, the best first.

        Parameters
        ----------
        matrix : (3, 3) float64
            Query plane to reference plane: the picture is rectified by it.
        reach_m : float
            Greatest shift, east and north.
        turns_deg : sequence of float
            By which the place is turned about its middle.
        most : int
            Number of places for each turn.
        apart_m : float
            Least distance between two places of a turn, and from the place itself.
        """
        scene, gsd_m = self.scene, self._gsd_m(matrix)
        missing, false = divmod(int(self._nats(matrix).argmax()), len(SHARES))
        center, corners = (Homography(matrix).everywhere(points) for points in (scene.center, scene.corners))
        radius_m = float(np.hypot(*(corners - center).T).max())
        cell_m = max(_ROAD_M, self._fine_cell_m(matrix), 2.0 * (reach_m + radius_m) / _MOST_CELLS)
        side = cv2.getOptimalDFTSize(math.ceil(2.0 * (reach_m + radius_m) / cell_m))
        low = center - side * cell_m / 2.0
        ground = draw_roads(self.index, low, low + (side - 0.5) * cell_m, cell_m)
        spectrum = cv2.dft(ground.roads)
        unit = _length_px(cell_m, gsd_m) / self.statement_px / math.log(10.0)
        places: list[Place] = []
        reach, apart = int(reach_m / cell_m), max(int(apart_m / cell_m), 1)
        for turn_deg in turns_deg:
            turned = move_about(center, Shift(0.0, 0.0, turn_deg, 1.0, 0.0)) @ matrix
            rectified = self._rectify(turned, ground)
            if rectified is None:
                continue
            levels, template, (column, row) = rectified
            padded = np.zeros_like(ground.roads)
            padded[: template.shape[0], : template.shape[1]] = (levels.on[missing] - levels.off[false])[template]
            product = cv2.mulSpectrums(spectrum, cv2.dft(padded), 0, conjB=True)
            sums = cv2.idft(product, flags=cv2.DFT_SCALE | cv2.DFT_REAL_OUTPUT)
            top, left = max(row - reach, 0), max(column - reach, 0)
            near = np.ascontiguousarray(sums[top : row + reach + 1, left : column + reach + 1])
            peaks = near == cv2.dilate(near, np.ones((2 * apart + 1, 2 * apart + 1), np.uint8))
            rows, columns = np.nonzero(peaks)
            order = np.argsort(-near[rows, columns])[:most]
            for r, c in zip(rows[order].tolist(), columns[order].tolist(), strict=True):
                east_m, north_m = (c + left - column) * cell_m, (r + top - row) * cell_m
                if turn_deg != 0.0 or math.hypot(east_m, north_m) >= apart_m:
                    places.append(self.place(shifted(turned, east_m, north_m), float(near[r, c]) * unit))
        return sorted(places, key=lambda place: -place.log10_likelihood)

    def _gsd_m(self, matrix: FloatArray) -> float:
        """Return a place's ground sampling, metres per pixel."""
        return sampling(matrix, self.scene.size)

    def _fine_cell_m(self, matrix: FloatArray) -> float:
        """Return the cells by which a place is weighed, metres, no finer than the reduced frame's."""
        return max(_ROAD_M / 2.0, self.scene.field_scale * self._gsd_m(matrix))

    def _around(self, matrix: FloatArray, cell_m: float, reach_m: float) -> Ground:
        """Draw the map's roads around a place."""
        places = Homography(matrix).everywhere(self.scene.corners)
        return draw_roads(self.index, places.min(axis=0) - reach_m, places.max(axis=0) + reach_m, cell_m)

    def _rectify(self, matrix: FloatArray, ground: Ground) -> tuple[_Levels, AnyArray, tuple[int, int]] | None:
        """Return the picture's levels on the ground's grid, and its first cell's (column, row); None if too large."""
        scene, cell_m = self.scene, ground.cell_m
        gsd_m = self._gsd_m(matrix)
        places = (Homography(matrix).everywhere(scene.corners) - ground.corner) / cell_m
        low = np.floor(places.min(axis=0)).astype(int) - 1
        columns, rows = np.ceil(places.max(axis=0)).astype(int) + 1 - low
        if not 0 < max(columns, rows) < 4000:
            return None
        smaller = max(1, int(cell_m / (gsd_m * scene.field_scale)))
        usual_cells = round(_USUAL_M / (self.gsd_m * scene.field_scale * smaller))
        levels = _levels(scene, smaller, 2 * (usual_cells // 2) + 1)
        to_cells = np.array([[1, 0, -ground.corner[0]], [0, 1, -ground.corner[1]], [0, 0, cell_m]]) / cell_m
        to_cells[:2] -= np.outer(low, to_cells[2])
        to_plane = np.diag([levels.scale, -levels.scale, 1.0])
        half = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])
        warp = np.linalg.inv(half) @ to_cells @ matrix @ to_plane @ half
        template = cv2.warpPerspective(
            levels.cells, warp, (int(columns), int(rows)), flags=cv2.INTER_LINEAR, borderValue=levels.neutral
        )
        return levels, template, (int(low[0]), int(low[1]))


def by_picture(place: Place, gsd_m: float) -> Place:
    """Return a place with its likelihood by its scene's picture, at these metres per pixel."""
    picture = Picture(place.scene, place.index, gsd_m)
    return place.but(by=Weight(picture.weigh(place.matrix), picture.statement_px))


@lru_cache(maxsize=16)
def _levels(scene: Scene, smaller: int, around: int) -> _Levels:
    """Return the picture on cells `smaller` times coarser.

    The log odds of each cell are shifted so that what is usual `around` it, in cells, is usual in the picture.
    """
    probability: AnyArray = np.asarray(scene.probability)
    observed: AnyArray = scene.observed.astype(np.float32)
    if smaller > 1:
        height, width = (max(n // smaller, 1) for n in observed.shape)
        cut = np.s_[: height * smaller, : width * smaller]
        probability, observed = (
            cv2.resize(cells[cut], (width, height), interpolation=cv2.INTER_AREA) for cells in (probability, observed)
        )
    shown = observed > 0.5
    surest = 1.0 / (1.0 + math.exp(_SUREST))
    usual = float(np.clip(probability[shown].mean() if shown.any() else 0.5, 2 * surest, 1.0 - 2 * surest))
    nearby = np.clip(_mean_around(probability, shown, around), 2 * surest, 1.0 - 2 * surest)
    odds = np.arange(int(2 * _SUREST * _FINE) + 1) / _FINE - _SUREST
    p = 1.0 / (1.0 + np.exp(-odds))
    road, other = p / usual, (1.0 - p) / (1.0 - usual)
    neutral = round((math.log(usual / (1.0 - usual)) + _SUREST) * _FINE)
    road, other = (np.where(np.arange(len(p)) == neutral, 1.0, ratio) for ratio in (road, other))
    sure = np.clip(probability, surest, 1.0 - surest)
    seen_odds = np.log(sure / (1.0 - sure)) - np.log(nearby / (1.0 - nearby)) + math.log(usual / (1.0 - usual))
    cells = np.round((np.clip(seen_odds, -_SUREST, _SUREST) + _SUREST) * _FINE).astype(np.uint8)
    missing, false = SHARES[:, None], usual * SHARES[:, None]
    on_road = np.log((1.0 - missing) * road + missing * other)
    elsewhere = np.log((1.0 - false) * other + false * road)
    return _Levels(np.where(shown, cells, np.uint8(neutral)), scene.field_scale * smaller, neutral, on_road, elsewhere)


def _mean_around(probability: AnyArray, shown: AnyArray, around: int) -> AnyArray:
    """Return the mean of the probability over the ground observed `around` each cell, an odd number of cells."""
    sums, counts = (
        cv2.boxFilter(cells, cv2.CV_32F, (around, around), normalize=False, borderType=cv2.BORDER_CONSTANT)
        for cells in (np.where(shown, probability, 0.0).astype(np.float32), shown.astype(np.float32))
    )
    return np.asarray(sums / np.maximum(counts, 1.0))


def _length_px(cell_m: float, gsd_m: float) -> float:
    """Return the length of road in a cell that roads fill, pixels."""
    return cell_m**2 / max(_ROAD_M, cell_m) / gsd_m


def draw_roads(index: ReferenceIndex, low: FloatArray, high: FloatArray, cell_m: float) -> Ground:
    """Draw the map's roads within a box of the plane."""
    columns, rows = np.maximum(np.ceil((high - low) / cell_m).astype(int), 1)
    lines = index.segments_within(low, high).astype(float).reshape(-1, 2, 2) - low
    canvas = np.zeros((int(rows), int(columns)), np.uint8)
    ends = np.round(lines / cell_m * 16.0 - 8.0).astype(np.int32)
    cv2.polylines(canvas, list(ends), False, 255, max(1, round(_ROAD_M / cell_m)), cv2.LINE_AA, 4)
    return Ground(canvas.astype(np.float32) / 255.0, low, cell_m)
