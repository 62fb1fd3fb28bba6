"""Plain correlation by FFT beside roadgeo: python examples/correlate.py [ROADS] [-n 10].

The simplest method: draw the map's roads, turn the mask to north, scale it to the map, and take the peak of the
normalised cross-correlation. It needs heading and scale, and gets the true ones; roadgeo gets neither. It always
answers, so only right and wrong are counted. ROADS is a file of road lines, by default the demonstration's.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import cv2
import geopandas as gpd
import numpy as np
import shapely
from scipy import fft

import roadgeo
from roadgeo.evaluation.demo import ROADS
from roadgeo.evaluation.landscape import Landscape
from roadgeo.evaluation.noise import NoiseModel
from roadgeo.evaluation.simulation import SimulationOptions, ViewOptions, simulate_query
from roadgeo.evaluation.truth import Truth
from roadgeo.sources.roads import read_roads

CELL_M, ROAD_M, RIGHT_M, SEED = 3.0, 9.0, 20.0, 515
LEVEL = ViewOptions((1000, 1000), gsd_m=(0.8, 1.25), heading_deg=(0.0, 360.0), focal_px=1000.0)
TILTED = ViewOptions((1000, 1000), gsd_m=(0.8, 1.25), heading_deg=(0.0, 360.0), tilt_deg=(10.0, 30.0), focal_px=1000.0)
KINDS = {
    "clean, level": (LEVEL, NoiseModel((0, 0), (0, 0), warp_px=0, raggedness=0)),
    "clean, tilted 10 to 30°": (TILTED, NoiseModel((0, 0), (0, 0), warp_px=0, raggedness=0)),
    "15 to 25 % gone, 5 to 12 % false, tilted": (
        TILTED,
        NoiseModel((0.15, 0.25), (0.05, 0.12), warp_px=0.8, raggedness=0.12),
    ),
}


class DrawnMap:
    """The map's roads as a raster, and its spectrum."""

    def __init__(self, lines: np.ndarray, side: int) -> None:
        """Draw shapely lines, in metres; `side` is the largest template's, in cells."""
        self.west, south, east, self.north = shapely.total_bounds(lines)
        rows, columns = (int(length / CELL_M) + side for length in (self.north - south, east - self.west))
        self.shape = cv2.getOptimalDFTSize(rows + side), cv2.getOptimalDFTSize(columns + side)
        drawn = np.zeros(self.shape, np.uint8)
        for line in shapely.get_parts(lines):
            at = shapely.get_coordinates(line)
            cells = np.stack([at[:, 0] - self.west, self.north - at[:, 1]], axis=1) / CELL_M + side / 2
            cv2.polylines(drawn, [np.round(cells).astype(np.int32)], False, 1, round(ROAD_M / CELL_M))
        self.side, self.spectrum = side, fft.rfft2(drawn.astype(np.float32))

    def find(
        self, template: np.ndarray, seen: np.ndarray, except_at: tuple[float, float, float] | None = None
    ) -> tuple[float, float]:
        """Return x, y of the middle where the correlation on the seen ground is greatest.

        Middles in the circle `except_at` (x, y, radius; metres) are left out.
        """
        n = seen.sum()
        centred = np.where(seen, template - template[seen].mean(), 0.0).astype(np.float32)
        both = self._correlate(centred)
        total = self._correlate(seen.astype(np.float32))
        spread = np.sqrt(np.maximum(total - total**2 / n, 1.0))  # of zeros and ones: the sum of squares is the sum
        correlation = both / spread
        if except_at is not None:
            x, y, radius = except_at
            at = round((x - self.west) / CELL_M - 0.5), round((self.north - y) / CELL_M - 0.5)
            cv2.circle(correlation, at, round(radius / CELL_M), -np.inf, cv2.FILLED)
        row, column = np.unravel_index(np.argmax(correlation), correlation.shape)
        return self.west + (column + 0.5) * CELL_M, self.north - (row + 0.5) * CELL_M

    def _correlate(self, template: np.ndarray) -> np.ndarray:
        product = self.spectrum * np.conj(fft.rfft2(template, self.shape))
        inside = self.shape[0] - self.side, self.shape[1] - self.side
        return np.asarray(fft.irfft2(product, self.shape))[: inside[0], : inside[1]]


def side_of(size_px: int, gsd_m: float) -> int:
    """Return the side of a template, in cells, that holds a square mask at any heading."""
    return int(size_px * gsd_m * np.sqrt(2) / CELL_M) + 2


def turn_north(mask: np.ndarray, truth: Truth, side: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the mask, north up and in cells of the map by its true heading and scale, and the ground that it shows."""
    middle = np.array(truth.size) / 2
    to_map = truth.homography
    ahead = [to_map @ np.append(middle + step, 1.0) for step in ((0, 0), (0, -1), (1, 0))]
    here, up, right = (vector[:2] / vector[2] for vector in ahead)
    scale = np.sqrt(abs(np.linalg.det([up - here, right - here])))
    angle = np.arctan2(*(up - here))  # clockwise from north
    linear = scale / CELL_M * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    matrix = np.column_stack([linear, side / 2 - linear @ middle])
    ones = np.ones(mask.shape, np.float32)
    seen = cv2.warpAffine(ones, matrix, (side, side), flags=cv2.INTER_AREA) > 0.5
    return cv2.warpAffine((mask > 0).astype(np.float32), matrix, (side, side), flags=cv2.INTER_AREA), seen


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("roads", nargs="?", type=Path, default=ROADS)
    parser.add_argument("-n", "--count", type=int, default=10, help="masks of each kind")
    options = parser.parse_args(arguments)
    read = read_roads(options.roads)
    landscape = Landscape.from_lines(read.lines, read.plane)
    reference = roadgeo.index(options.roads)
    crs = simulate_query(landscape, SimulationOptions(LEVEL), 0).truth.crs
    side = side_of(1000, 1.25)
    drawn = DrawnMap(gpd.read_file(options.roads).to_crs(crs).geometry.to_numpy(), side)
    print("| | correlation, heading and scale given | roadgeo, blind | wrong | seconds, each |")
    print("|---|---|---|---|---|")
    for kind, (view, noise) in KINDS.items():
        counts, spent = np.zeros(3, int), np.zeros(2)
        for k in range(options.count):
            query = simulate_query(landscape, SimulationOptions(view, noise, kind, SEED), k)
            started = time.process_time()
            found = drawn.find(*turn_north(query.mask, query.truth, side))
            between = time.process_time()
            answer = roadgeo.locate(query.mask > 0, reference)
            spent += between - started, time.process_time() - between
            counts[0] += np.hypot(*np.subtract(found, query.truth.center)) <= RIGHT_M
            if answer.located:
                off = np.hypot(answer.center.x - query.truth.center[0], answer.center.y - query.truth.center[1])
                counts[1 if off <= RIGHT_M else 2] += 1
        times = " / ".join(f"{value / options.count:.2g}" for value in spent)
        print(f"| {kind} | {counts[0]} of {options.count} | {counts[1]} of {options.count} | {counts[2]} | {times} |")


if __name__ == "__main__":
    main()
