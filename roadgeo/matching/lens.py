"""A lens behind a fit: one parameter of radial distortion, estimated together with the homography where it pays."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from roadgeo._arrays import BoolArray, FloatArray
from roadgeo.geometry.lens import Lens
from roadgeo.kernels.residuals import road_residuals
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.refinement import (
    Refined,
    RefineOptions,
    corner_covariance,
    corner_sigmas,
    denormalise,
    normalise,
    refine,
    scatter_m,
    spacing_m,
)
from roadgeo.matching.scene import Scene
from roadgeo.roads.intersections import Intersections

__all__ = ["LensFit", "LensOptions", "find_lens", "fit_lens", "straighten_scene"]


@dataclass(frozen=True)
class LensOptions:
    """When a lens is believed, and how it is found.

    Attributes
    ----------
    enough : float
        Where less than this share of the mask's roads agrees, a lens is tried, else only where residuals hint at one.
    sigma : float
        Prior standard deviation of k1.
    significance : float
        k1 counts when it is so many of its standard deviations from 0 ...
    least_px : float
        ... and moves the frame's corners by at least so much.
    linear_sigma, place_sigma_m, perspective_sigma : float
        How far off the homography may be that the fit begins with.
    starts : tuple of float
        Values of k1 to begin with in turn, where beginning with 0 does not explain enough.
    n_iterations : int
        At most.
    """

    enough: float = 0.8
    sigma: float = 0.1
    significance: float = 5.0
    least_px: float = 3.0
    linear_sigma: float = 0.02
    place_sigma_m: float = 5.0
    perspective_sigma: float = 0.05
    starts: tuple[float, ...] = (-0.15, -0.08, 0.08)
    n_iterations: int = 14


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


class _Problem:
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

    def rows(self, k1: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return places (S, 2) and unit directions (S, 2) on the map, and derivatives (S, 2, 9) of the places."""
        scene, p = self.scene, self.p
        lens = Lens.of(k1, scene.size, y_up=True)
        uv = (lens.straighten(scene.points) - scene.center) / scene.half_size
        turned = lens.straighten_directions(scene.points, scene.directions)
        linear, w = p[:6].reshape(2, 3), 1.0 + uv @ p[6:8]
        w = np.where(w < 0.02, np.nan, w)[:, None]
        xy = (uv @ linear[:, :2].T + linear[:, 2]) / w
        jacobian = (linear[None, :, :2] - xy[:, :, None] * p[6:8]) / w[:, :, None]
        along = np.einsum("nij,nj->ni", jacobian, turned)
        rows = np.zeros((len(uv), 2, 9))
        for axis in range(2):
            rows[:, axis, 3 * axis : 3 * axis + 3] = np.c_[uv, np.ones(len(uv))] / w
        rows[:, :, 6:8] = -xy[:, :, None] * uv[:, None, :] / w[:, :, None]
        rows[:, :, 8] = np.einsum("nij,nj->ni", jacobian, lens.moves(scene.points) / scene.half_size)
        return xy, along / np.linalg.norm(along, axis=1, keepdims=True), rows

    def observe(self, k1: float, inverse: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
        """Find the roads near points whose places are sure enough.

        Return rows (M, 9), residuals (M,) in metres, their standard deviations (M,), and which points (S,) they are of.
        """
        xy, along, rows = self.rows(k1)
        spread = np.einsum("nai,ij,naj->n", rows, inverse, rows)
        sigma = self.sigma_m * np.sqrt(1.0 + spread)
        sure = np.isfinite(sigma) & (3.0 * sigma <= self.max_radius)
        out = np.empty((int(sure.sum()), 3))
        mapped = np.ascontiguousarray(self.origin + self.unit * xy[sure])
        road_residuals(mapped, np.ascontiguousarray(along[sure]), 3.0 * sigma[sure], self.min_cos, self.roads, out)
        met = np.isfinite(out[:, 0])
        which = sure.copy()
        which[sure] = met
        across = np.einsum("nai,na->ni", rows[which], out[met, 1:])
        return across, out[met, 0], sigma[which], which


def fit_lens(
    matrix: FloatArray,
    scene: Scene,
    index: ReferenceIndex,
    k1: float = 0.0,
    refinement: RefineOptions | None = None,
    options: LensOptions | None = None,
) -> LensFit | None:
    """Adjust a homography and k1 to the roads of the map by Gauss-Newton with Cauchy weights; None where that fails.

    Points far out take part when those nearer the middle say where they lie: how sure each is follows from the fit.
    """
    options, refinement = options or LensOptions(), refinement or RefineOptions()
    problem = _Problem(matrix, scene, index, refinement)
    sigmas = np.array([options.linear_sigma] * 6 + [options.perspective_sigma] * 2 + [options.sigma])
    sigmas[[2, 5]] = options.place_sigma_m / problem.unit
    hold = (problem.sigma_m / problem.unit / sigmas) ** 2
    inverse = np.diag(1.0 / hold)
    lasting = np.zeros(9)
    lasting[6:] = (problem.sigma_m / problem.unit / np.array([refinement.perspective_sigma] * 2 + [options.sigma])) ** 2
    rms, n_met, last_held = math.inf, 0, options.n_iterations // 2
    for iteration in range(options.n_iterations):
        rows, residuals, sigma, _ = problem.observe(k1, inverse)
        if len(rows) < 12:
            return None
        weights = 1.0 / (1.0 + (residuals / sigma) ** 2)
        held = lasting + hold * 0.5**iteration * (iteration < last_held)
        normal = problem.weight * (rows * weights[:, None]).T @ rows + np.diag(held)
        right = problem.weight * (rows * weights[:, None]).T @ (residuals / problem.unit)
        right -= lasting * np.append(np.append(np.zeros(6), problem.p[6:8]), k1)
        try:
            inverse = np.asarray(np.linalg.inv(normal), float)
        except np.linalg.LinAlgError:
            return None
        step = inverse @ right
        problem.p, k1 = problem.p + step[:8], float(np.clip(k1 + step[8], -0.5, 0.5))
        slope = max(float((weights * (2.0 * weights - 1.0)).sum()), 0.1 * float(weights.sum()))
        rms = math.sqrt(float(((weights * residuals) ** 2).sum()) * float(weights.sum())) / slope
        if (
            iteration > last_held
            and len(rows) <= n_met
            and np.abs(step[:8]).max() * problem.unit < refinement.tolerance_m
        ):
            break
        n_met = len(rows)
    covariance = inverse * (scatter_m(rms, problem.sigma_m, refinement) / problem.unit) ** 2
    if not np.isfinite(covariance).all() or not np.isfinite(problem.p).all():
        return None
    found = denormalise(problem.p, scene.center, scene.half_size, problem.origin, problem.unit)
    corners = corner_covariance(problem.p, covariance[:8, :8], scene, problem.unit, refinement)
    refined = Refined(found / found[2, 2], corner_sigmas(corners), rms, corners, k1)
    return LensFit(refined, math.sqrt(max(covariance[8, 8], 0.0)), n_met / len(scene.points))


def find_lens(
    matrix: FloatArray,
    scene: Scene,
    index: ReferenceIndex,
    agreeing: float,
    refinement: RefineOptions,
    options: LensOptions,
) -> LensFit | None:
    """Fit a lens where it pays: None where the residuals of a refined homography do not show one.

    `agreeing` is the share of the mask's roads that agree without a lens.
    """
    if agreeing >= options.enough and not _hints_at_lens(_Problem(matrix, scene, index, refinement), options):
        return None
    found = _fit_from_many(matrix, scene, index, refinement, options)
    if found is None or abs(found.k1) < options.significance * found.k1_sigma:
        return None
    corners = scene.corners.astype(float)
    moved = Lens.of(found.k1, scene.size, y_up=True).bend(corners) - corners
    return found if np.hypot(*moved.T).max() >= options.least_px else None


def _fit_from_many(
    matrix: FloatArray, scene: Scene, index: ReferenceIndex, refinement: RefineOptions, options: LensOptions
) -> LensFit | None:
    """Fit a lens from one value of k1 after another, until enough of the roads lie on roads; return the best."""
    best = None
    nothing = np.full(len(scene.intersections), -1, np.int64)
    for k1 in (0.0, *options.starts):
        start = matrix
        if k1:
            held = refine(matrix, straighten_scene(scene, k1), index, nothing, refinement, held=True)
            if held is None:
                continue
            start = held.matrix
        found = fit_lens(start, scene, index, k1, refinement, options)
        if found is not None and (best is None or found.share > best.share):
            best = found
        if best is not None and best.share >= options.enough:
            break
    return best


def _hints_at_lens(problem: _Problem, options: LensOptions) -> bool:
    """Whether one step from a pinhole would make k1 significant."""
    rows, residuals, sigma, _ = problem.observe(0.0, np.zeros((9, 9)))
    if len(rows) < 12:
        return False
    weights = 1.0 / (1.0 + (residuals / sigma) ** 2)
    scaled = problem.weight * weights[:, None] * rows
    inverse = np.linalg.pinv(scaled.T @ rows)
    step = inverse @ (scaled.T @ (residuals / problem.unit))
    rms = math.sqrt(float(np.average(residuals**2, weights=weights)))
    return bool(abs(step[8]) > 0.5 * options.significance * rms / problem.unit * math.sqrt(max(inverse[8, 8], 0.0)))


def straighten_scene(scene: Scene, k1: float) -> Scene:
    """Return a scene as a pinhole would have seen it: what a lens with k1 shows, put where it belongs."""
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
