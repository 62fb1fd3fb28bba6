"""Road points of a scene on a map as nine parameters see them: eight of a homography, and one of the lens before it."""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np

from roadgeo._arrays import BoolArray, FloatArray, IntArray
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.lens import Lens
from roadgeo.kernels.lens import MeetLimits, lens_rows, meet_roads
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.refinement import RefineOptions, normalise, spacing_m
from roadgeo.matching.scene import Scene

__all__ = ["LensEquations", "Observed"]

#: Steps that take the homography of the core from one k1 to another.
_STEPS = 4
#: Points nearer to the horizon than this w are not seen.
_LEAST_W = 0.02
#: Road points that the share of a cell and its neighbours is counted against, where there are fewer.
_FEWEST = 12


class Observed(NamedTuple):
    """Roads that were met by M of S points.

    Attributes
    ----------
    rows : (M, 9) float64
        Derivatives of the points' places across the roads, normalised.
    residuals, sigma : (M,) float64
        Ways to the roads and their standard deviations, metres.
    own : (M,) float64
        These where the places are known, in that of the middle of the frame: a pixel may reach further.
    which : (S,) bool
        The points.
    """

    rows: FloatArray
    residuals: FloatArray
    sigma: FloatArray
    own: FloatArray
    which: BoolArray

    @property
    def cauchy(self) -> FloatArray:
        """Weights (M,) that keep outliers from a fit."""
        return np.asarray(1.0 / (1.0 + (self.residuals / self.sigma) ** 2))

    @property
    def normals(self) -> FloatArray:
        """Unit vectors (M, 2) across the roads."""
        across = self.rows[:, [2, 5]]
        return np.asarray(across / np.linalg.norm(across, axis=1, keepdims=True))

    @property
    def scaled(self) -> FloatArray:
        """Residuals (M,) as if each pixel reached as far as in the middle of the frame, metres."""
        return np.asarray(self.residuals / self.own)


class LensEquations:
    """Road points of a scene on one map, as nine parameters see them: eight of the homography, and k1."""

    def __init__(self, matrix: FloatArray, scene: Scene, index: ReferenceIndex, options: RefineOptions) -> None:
        self.scene, self.options = scene, options
        self.p, self.origin, self.unit = normalise(matrix, scene.center, scene.half_size)
        self.roads = index.road_buckets
        gsd = self.unit / scene.half_size
        self.sigma_m = math.hypot(options.sigma_m, options.sigma_px * gsd)
        self.max_radius = options.max_radius_m + options.max_radius_px * gsd
        self.weight = min(1.0, spacing_m(scene, self.unit) / options.correlation_m)
        self.min_cos = math.cos(math.radians(options.max_turn_deg))
        self.points = np.ascontiguousarray((scene.points - scene.center) / scene.half_size)
        self.directions = np.ascontiguousarray(scene.directions)
        self.half_side = max(scene.size) / 2 / scene.half_size

    def rows(self, k1: float) -> tuple[FloatArray, FloatArray]:
        """Return places (S, 2) on the map, normalised, and their derivatives (S, 2, 9)."""
        places, rows = np.empty((len(self.points), 2)), np.empty((len(self.points), 2, 9))
        lens_rows(self.p, k1, self.half_side, self.points, self.directions, places, rows)
        return places, rows

    def held(self, sigmas: FloatArray) -> FloatArray:
        """Return the weights that hold parameters whose standard deviations are `sigmas`."""
        return np.asarray((self.sigma_m / self.unit / sigmas) ** 2)

    def prior(self, k1_sigma: float) -> FloatArray:
        """Return the weights (9,) that hold the perspective and k1 near 0."""
        return np.append(np.zeros(6), self.held(np.array([self.options.perspective_sigma] * 2 + [k1_sigma])))

    def local_scale(self, k1: float) -> tuple[FloatArray, FloatArray]:
        """Return how far on the ground a pixel reaches across each road (S,), metres; and see below.

        Also the derivatives (S, 2, 2) of normalised places by where the middle of the lens is, in pixels.
        """
        scene, (homography, uv) = self.scene, self._seen(k1)
        stretch = Lens.of(k1, scene.size, y_up=True).stretch(scene.points)
        jacobian = homography.jacobian(uv) / scene.half_size
        whole = jacobian @ stretch
        along = np.linalg.norm((whole @ scene.directions[:, :, None])[..., 0], axis=1)
        return self.unit * np.abs(np.linalg.det(whole)) / along, jacobian @ (np.eye(2) - stretch)

    def _seen(self, k1: float) -> tuple[Homography, FloatArray]:
        """Return the normalised homography, and its points (S, 2) as a pinhole sees them; NaN near the horizon."""
        uv = self._straight(k1)
        seen = 1.0 + uv @ self.p[6:8] >= _LEAST_W
        return Homography(np.append(self.p, 1.0).reshape(3, 3)), np.where(seen[:, None], uv, np.nan)

    def _straight(self, k1: float) -> FloatArray:
        """Return the normalised points (S, 2) as a pinhole sees them."""
        scene = self.scene
        return np.asarray(
            (Lens.of(k1, scene.size, y_up=True).straighten(scene.points) - scene.center) / scene.half_size
        )

    def core(self, k1: float, n_cells: int, least: float) -> tuple[BoolArray, BoolArray]:
        """Return which points (S,) lie on roads in the part of the frame where most do, and which lie in that part.

        It is made of those of the frame's `n_cells` x `n_cells` cells, around the best one, in which at least the part
        `least` of its share of points lies on roads.
        """
        met = self.observe(k1, np.zeros((9, 9))).which
        inside = self.cells(met, n_cells, least)[self.cell_of(n_cells)]
        return met & inside, inside

    def cells(self, met: BoolArray, n: int, least: float) -> BoolArray:
        """Return the cells (n, n), rows first, of the core, given which points (S,) lie on roads."""
        row, column = self.cell_of(n)
        counts = np.zeros((2, n, n))
        np.add.at(counts[0], (row, column), met)
        np.add.at(counts[1], (row, column), 1.0)
        # A cell is judged together with its neighbours: alone it has a few points.
        hits, points = (9.0 * cv2.blur(one, (3, 3), borderType=cv2.BORDER_CONSTANT) for one in counts)
        shares = hits / np.maximum(points, _FEWEST)
        best = np.unravel_index(shares.argmax(), shares.shape)
        good = shares >= least * shares.max()
        _, parts = cv2.connectedComponents(good.astype(np.uint8), connectivity=4)
        return np.asarray(parts == parts[best])

    def cell_of(self, n: int) -> tuple[IntArray, IntArray]:
        """Return the row and the column (S,) of the cell that each point lies in, of n x n."""
        column, row = np.clip((self.scene.points / self.scene.size * (n, -n)).astype(int), 0, n - 1).T
        return row, column

    def begin(self, k1: float, start: float | None, core: BoolArray) -> FloatArray:
        """Return the derivatives (C, 2, 9) of core points' places.

        With another k1 to `start` from, let the parameters put the points where they did.
        """
        places, rows = self.rows(k1)
        if start is None or start == k1:
            return rows[core]
        target = places[core]
        for _ in range(_STEPS):
            places, rows = self.rows(start)
            flat = rows[core, :, :8].reshape(-1, 8)
            away = (target - places[core]).ravel()
            self.p = self.p + np.linalg.solve(flat.T @ flat + 1e-4 * np.eye(8), flat.T @ away)
        return self.rows(start)[1][core]

    def observe(self, k1: float, inverse: FloatArray, slack: float = 1.0) -> Observed:
        """Find the roads near points whose places are sure enough.

        How far off a place may be follows from the `inverse` (9, 9) of the normal matrix so far, times `slack`.
        """
        n, (x, y) = len(self.points), self.origin
        rows, residuals, sigma, own = np.empty((n, 9)), np.empty(n), np.empty(n), np.empty(n)
        limits = MeetLimits(
            self.unit, float(x), float(y), slack, self.max_radius, self.min_cos,
            self.sigma_m, self.options.sigma_m, self.options.sigma_px / self.scene.half_size,
        )  # fmt: skip
        inverse = np.ascontiguousarray(inverse)
        meet_roads(
            self.p, k1, self.half_side, self.points, self.directions, inverse, limits, self.roads,
            rows, residuals, sigma, own,
        )  # fmt: skip
        met = np.isfinite(residuals)
        return Observed(rows[met], residuals[met], sigma[met], own[met], met)
