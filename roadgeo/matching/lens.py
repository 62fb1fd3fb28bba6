"""A lens behind a fit: one parameter of radial distortion, estimated together with the homography where it pays."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np

from roadgeo._arrays import BoolArray, FloatArray, IntArray
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.lens import Lens
from roadgeo.kernels.lens import MeetLimits, lens_rows, meet_roads
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.refinement import (
    SIGMA_M,
    SIGMA_PX,
    TOLERANCE_M,
    Refined,
    RefineOptions,
    corner_covariance,
    corner_sigmas,
    denormalise,
    max_radius_m,
    normalise,
    point_weight,
    robust_rms,
    scatter_m,
)
from roadgeo.matching.scene import MIN_COS, Scene
from roadgeo.roads.intersections import Intersections

__all__ = [
    "ENOUGH",
    "FEWEST",
    "K1_SIGMA",
    "LensEquations",
    "LensFit",
    "Observed",
    "find_lens",
    "fit_lens",
    "grow_whole",
    "straighten_scene",
]

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
        self.sigma_m = math.hypot(SIGMA_M, SIGMA_PX * gsd)
        self.max_radius = max_radius_m(gsd)
        self.weight = point_weight(scene, self.unit)
        self.min_cos = MIN_COS
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

    def by_center(self, k1: float) -> FloatArray:
        """Return the derivatives (S, 2, 2) of normalised places by where the middle of the lens is, in pixels."""
        scene, (homography, uv) = self.scene, self._seen(k1)
        stretch = Lens.of(k1, scene.size, y_up=True).stretch(scene.points)
        return np.asarray(homography.jacobian(uv) / scene.half_size @ (np.eye(2) - stretch))

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

        The search radius follows from the `inverse` (9, 9) of the normal matrix until now, times `slack`.
        """
        n, (x, y) = len(self.points), self.origin
        rows, residuals, sigma, own = np.empty((n, 9)), np.empty(n), np.empty(n), np.empty(n)
        limits = MeetLimits(
            self.unit, float(x), float(y), slack, self.max_radius, self.min_cos,
            self.sigma_m, SIGMA_M, SIGMA_PX / self.scene.half_size,
        )  # fmt: skip
        inverse = np.ascontiguousarray(inverse)
        meet_roads(
            self.p, k1, self.half_side, self.points, self.directions, inverse, limits, self.roads,
            rows, residuals, sigma, own,
        )  # fmt: skip
        met = np.isfinite(residuals)
        return Observed(rows[met], residuals[met], sigma[met], own[met], met)


#: A fit that puts this much more of the roads on roads is worth another one.
_MORE = 0.01
#: And where a fit has grown over more of the frame, this much more.
_BETTER = 0.02
#: Standard deviation of a k1 that is held.
_HELD = 1e-6


#: Where less than this share of the mask's roads agrees, a lens is tried, else only where residuals hint at one.
ENOUGH = 0.8
#: Prior standard deviation of k1, which counts when it is this many of its standard deviations from 0, and moves the
#: frame's corners by at least this many pixels.
K1_SIGMA, _SIGNIFICANCE, _LEAST_PX = 0.1, 5.0, 5.0
#: Cells of the frame a side. The fit begins with those around the one where most road points lie
#: on roads, as far as they do in this part of its share.
_CORE = (10, 0.75)
#: Road points that a fit needs; factor on its uncertainty while it grows.
FEWEST, _SLACK = 12, 2.0
#: Values of k1 to begin with in turn, where beginning with 0 does not explain enough; first with few road points, and
#: with all of them where a lens shows.
_STARTS = (-0.15, -0.08, 0.08)
#: Iterations and new starts, at most.
_N_ITERATIONS, _N_RESTARTS = 30, 3
#: A fit that after this many iterations has met less than this share of the road points is dropped: wrong places end at
#: 0.2 to 0.4, right ones at 0.75 to 0.9 (training masks).
_SOON, _HOPELESS = 8, 0.4
#: With this number of road points a lens is looked for first.
_QUICK_POINTS = 300


@dataclass(frozen=True)
class LensFit:
    """A refined homography from the straightened query plane, with its lens.

    `k1_sigma` is the standard deviation of k1, `share` that part of the road points that lies on roads.
    """

    refined: Refined
    k1_sigma: float
    share: float

    @property
    def k1(self) -> float:
        """Of the lens."""
        return self.refined.lens_k1

    @property
    def matrix(self) -> FloatArray:
        """(3, 3) straightened query plane to reference plane."""
        return self.refined.matrix


def fit_lens(
    matrix: FloatArray,
    scene: Scene,
    index: ReferenceIndex,
    k1: float = 0.0,
    refinement: RefineOptions | None = None,
    start: float | None = None,
    held: bool = False,
) -> LensFit | None:
    """Adjust a homography and k1 to the roads of the map by Gauss-Newton with Cauchy weights; None where that fails.

    It begins with the part of the frame that the homography lays on roads, and grows from there: points further out
    take part when nearer ones fix their places, and the certainty of each follows from the fit.

    Parameters
    ----------
    matrix : (3, 3)
        Query plane, as a pinhole behind a lens with `k1` shows it, to reference plane: right to some metres over part
        of the frame.
    start : float, optional
        Value of k1 to begin with, other than `k1`.
    held : bool
        Hold k1 where it begins, at 0 for a pinhole.
    """
    refinement = refinement or RefineOptions()
    equations = LensEquations(matrix, scene, index, refinement)
    core, _ = equations.core(k1, *_CORE)
    if core.sum() < FEWEST:
        return None
    prior = equations.prior(_HELD if held else K1_SIGMA)
    rows = equations.begin(k1, start, core)
    k1 = k1 if start is None else start
    inverse = _inverse(rows.reshape(-1, 9), np.full(2 * len(rows), 0.5 * equations.weight), prior)
    rms, n_met, slack = math.inf, 0, _SLACK
    for iteration in range(_N_ITERATIONS):
        # Points further out take part as soon as the fit until now fixes their places.
        seen = equations.observe(k1, inverse, slack)
        rows, cauchy, n_seen = seen.rows, seen.cauchy, len(seen.rows)
        if n_seen < FEWEST or (iteration > _SOON and n_seen < _HOPELESS * len(scene.points)):
            return None
        weights = equations.weight * cauchy / seen.own**2
        inverse = _inverse(rows, weights, prior)
        right = (rows * weights[:, None]).T @ (seen.residuals / equations.unit)
        right[6:] -= prior[6:] * np.append(equations.p[6:8], k1)
        step = inverse @ right
        equations.p = equations.p + step[:8]
        k1 = k1 if held else float(np.clip(k1 + step[8], -0.5, 0.5))
        if not np.isfinite(step).all():
            return None
        rms = robust_rms(seen.scaled, cauchy)
        if n_seen <= n_met and np.abs(step[:8]).max() * equations.unit < TOLERANCE_M:
            if slack == 1.0:
                break
            slack = 1.0
        n_met = n_seen
    covariance = inverse * (scatter_m(rms, equations.sigma_m) / equations.unit) ** 2
    found = denormalise(equations.p, scene.center, scene.half_size, equations.origin, equations.unit)
    corners = corner_covariance(equations.p, covariance[:8, :8], scene, equations.unit, refinement)
    refined = Refined(found / found[2, 2], corner_sigmas(corners), rms, corners, k1)
    return LensFit(refined, math.sqrt(max(covariance[8, 8], 0.0)), len(rows) / len(scene.points))


def _inverse(rows: FloatArray, weights: FloatArray, prior: FloatArray) -> FloatArray:
    """Return the inverse of the normal matrix of weighted rows (M, 9) and a diagonal prior (9,); NaN if it has none."""
    try:
        return np.asarray(np.linalg.inv((rows * weights[:, None]).T @ rows + np.diag(prior)), float)
    except np.linalg.LinAlgError:
        return np.full((9, 9), np.nan)


def find_lens(
    matrix: FloatArray,
    scene: Scene,
    index: ReferenceIndex,
    agreeing: float,
    refinement: RefineOptions,
) -> LensFit | None:
    """Fit a lens where it pays: None where the residuals of a refined homography do not show one.

    `agreeing` is the share of the mask's roads that agree without a lens.
    """
    if agreeing >= ENOUGH and not _hints_at_lens(LensEquations(matrix, scene, index, refinement)):
        return None
    rough = _fit_from_many(matrix, _thinned(scene, _QUICK_POINTS), index, refinement)
    if rough is None or _moves_px(rough, scene) < 0.5 * _LEAST_PX:
        return None
    found = _improved(rough, scene, index, refinement)
    return found if _is_significant(found, scene) else None


def grow_whole(matrix: FloatArray, scene: Scene, index: ReferenceIndex, refinement: RefineOptions) -> LensFit | None:
    """Grow a homography anew from the part of the frame that it lays on roads, without a lens.

    It may have settled where only that part agrees. None where hardly more of the roads come to lie on roads.
    """
    before = LensEquations(matrix, scene, index, refinement).observe(0.0, np.zeros((9, 9)))
    found = fit_lens(matrix, scene, index, 0.0, refinement, held=True)
    better = found is not None and found.share > len(before.rows) / len(scene.points) + _BETTER
    return found if better else None


def _is_significant(found: LensFit, scene: Scene) -> bool:
    """Whether a fit shows a lens: that of a pinhole finds some k1, too."""
    enough_px = _moves_px(found, scene) >= _LEAST_PX
    return enough_px and abs(found.k1) >= _SIGNIFICANCE * found.k1_sigma


def _moves_px(found: LensFit, scene: Scene) -> float:
    """Return how far the lens moves the frame's corners, at most."""
    corners = scene.corners.astype(float)
    moved = Lens.of(found.k1, scene.size, y_up=True).bend(corners) - corners
    return float(np.hypot(*moved.T).max())


def _thinned(scene: Scene, n_points: int) -> Scene:
    """Return a scene with about this number of its road points."""
    return scene.of_points(slice(None, None, max(1, len(scene.points) // n_points)))


def _fit_from_many(
    matrix: FloatArray, scene: Scene, index: ReferenceIndex, refinement: RefineOptions
) -> LensFit | None:
    """Fit a lens from one value of k1 after another, until enough of the roads lie on roads; return the best."""
    best = None
    for k1 in (0.0, *_STARTS):
        found = fit_lens(matrix, scene, index, 0.0, refinement, k1)
        if found is not None and (best is None or found.share > best.share):
            best = found
        if best is not None and best.share >= ENOUGH:
            break
    return best


def _improved(found: LensFit, scene: Scene, index: ReferenceIndex, refinement: RefineOptions) -> LensFit:
    """Fit anew from where a fit ended, as long as more of the roads come to lie on roads: it may have been stuck."""
    for _ in range(_N_RESTARTS):
        starts = (found.k1,) if found.share >= ENOUGH else (found.k1, 0.0, 2.0 * found.k1)
        again = (fit_lens(found.matrix, scene, index, found.k1, refinement, k1) for k1 in starts)
        best = max((one for one in again if one is not None), key=lambda one: one.share, default=None)
        if best is None or best.share < found.share:
            break
        more, found = best.share > found.share + _MORE, best
        if not more:
            break
    return found


def _hints_at_lens(problem: LensEquations) -> bool:
    """Whether one step from a pinhole would make k1 significant."""
    seen = problem.observe(0.0, np.zeros((9, 9)))
    if len(seen.rows) < 12:
        return False
    scaled = (problem.weight * seen.cauchy / seen.own**2)[:, None] * seen.rows
    inverse = np.linalg.pinv(scaled.T @ seen.rows)
    step = inverse @ (scaled.T @ (seen.residuals / problem.unit))
    rms = math.sqrt(float(np.average(seen.scaled**2, weights=seen.cauchy)))
    return bool(abs(step[8]) > 0.5 * _SIGNIFICANCE * rms / problem.unit * math.sqrt(max(inverse[8, 8], 0.0)))


def straighten_scene(scene: Scene, k1: float) -> Scene:
    """Return a scene as a pinhole would have seen it: its points moved back by a lens with k1."""
    lens = Lens.of(k1, scene.size, y_up=True)
    found = scene.intersections
    vectors = np.stack([np.cos(found.rays), np.sin(found.rays)], axis=-1).astype(float)
    turned = lens.straighten_directions(np.broadcast_to(found.xy[:, None], vectors.shape), vectors)
    rays = np.arctan2(turned[..., 1], turned[..., 0]).astype(found.rays.dtype)
    straight = Intersections(lens.straighten(found.xy), rays, found.tangents, found.residual, found.node)
    rows, columns = scene.field.shape
    cells = np.stack(np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5), axis=-1) * scene.field_scale
    seen = (Lens.of(k1, scene.size).bend(cells) / scene.field_scale - 0.5).astype(np.float32)
    field = cv2.remap(scene.field, seen[..., 0], seen[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    observed = cv2.remap(scene.observed.astype(np.uint8), seen[..., 0], seen[..., 1], cv2.INTER_NEAREST)
    return replace(
        scene,
        intersections=straight,
        branches=straight.branches(),
        points=lens.straighten(scene.points),
        directions=lens.straighten_directions(scene.points, scene.directions),
        dense_points=lens.straighten(scene.dense_points),
        dense_directions=lens.straighten_directions(scene.dense_points, scene.dense_directions),
        field=np.asarray(field, np.float32),
        observed=observed > 0,
    )
