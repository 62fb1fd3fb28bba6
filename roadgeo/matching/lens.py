"""A lens behind a fit: one parameter of radial distortion, estimated together with the homography where it pays."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo.geometry.lens import Lens
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.lens_equations import LensEquations
from roadgeo.matching.refinement import (
    Refined,
    RefineOptions,
    corner_covariance,
    corner_sigmas,
    denormalise,
    robust_rms,
    scatter_m,
)
from roadgeo.matching.scene import Scene
from roadgeo.roads.intersections import Intersections

__all__ = [
    "LensFit",
    "LensOptions",
    "core_excess",
    "find_lens",
    "fit_lens",
    "grow_whole",
    "is_significant",
    "regrow",
    "straighten_scene",
]

#: A fit that puts so much more of the roads on roads is worth another one.
_MORE = 0.01
#: And where a fit has grown over more of the frame, so much more.
_BETTER = 0.02
#: Standard deviation of a k1 that is held.
_HELD = 1e-6


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
    n_cells, core_share : int, float
        The frame is divided into so many cells a side. The fit begins with those around the one where most road points
        lie on roads, as far as they do in this part of its share.
    fewest : int
        Road points that a fit needs.
    slack : float
        While a fit grows, places may be so many times further off than it says.
    starts : tuple of float
        Values of k1 to begin with in turn, where beginning with 0 does not explain enough; first with few road points,
        and with all of them where a lens shows.
    n_iterations, n_restarts : int
        At most.
    soon, hopeless : int, float
        A fit that after so many iterations has met less than this share of the road points is given up: wrong places
        end at 0.2 to 0.4, right ones at 0.75 to 0.9 (training masks).
    max_places : int
        So many places that were dropped are grown anew, those first where most road points in one part of the frame
        lie on roads beyond the share `chance_share` ...
    quick_points, quick_starts : int, tuple of float
        ... first with so many road points and these values of k1 to begin with ...
    least_share : float
        ... and verified where so many of them end on roads.
    center_sigma_px : float
        Standard deviation of the place of the lens's middle in each direction: conventions differ by half a pixel.
    """

    enough: float = 0.8
    sigma: float = 0.1
    significance: float = 5.0
    least_px: float = 5.0
    n_cells: int = 10
    core_share: float = 0.75
    fewest: int = 12
    slack: float = 2.0
    starts: tuple[float, ...] = (-0.15, -0.08, 0.08)
    n_iterations: int = 30
    n_restarts: int = 3
    soon: int = 8
    hopeless: float = 0.4
    max_places: int = 12
    chance_share: float = 0.3
    quick_points: int = 300
    quick_starts: tuple[float, ...] = (0.0, -0.07, -0.15)
    least_share: float = 0.6
    center_sigma_px: float = 0.5


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
    options: LensOptions | None = None,
    start: float | None = None,
    held: bool = False,
) -> LensFit | None:
    """Adjust a homography and k1 to the roads of the map by Gauss-Newton with Cauchy weights; None where that fails.

    It begins with the part of the frame that the homography lays on roads, and grows from there: points further out
    take part when those nearer say where they lie, and how sure each is follows from the fit.

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
    options, refinement = options or LensOptions(), refinement or RefineOptions()
    equations = LensEquations(matrix, scene, index, refinement)
    core, _ = equations.core(k1, options.n_cells, options.core_share)
    if core.sum() < options.fewest:
        return None
    prior = equations.prior(_HELD if held else options.sigma)
    rows = equations.begin(k1, start, core)
    k1 = k1 if start is None else start
    inverse = _inverse(rows.reshape(-1, 9), np.full(2 * len(rows), 0.5 * equations.weight), prior)
    rms, n_met, slack = math.inf, 0, options.slack
    for iteration in range(options.n_iterations):
        # Points further out take part as soon as the fit so far says where they lie.
        seen = equations.observe(k1, inverse, slack)
        rows, cauchy, n_seen = seen.rows, seen.cauchy, len(seen.rows)
        if n_seen < options.fewest or (iteration > options.soon and n_seen < options.hopeless * len(scene.points)):
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
        if n_seen <= n_met and np.abs(step[:8]).max() * equations.unit < refinement.tolerance_m:
            if slack == 1.0:
                break
            slack = 1.0
        n_met = n_seen
    covariance = inverse * (scatter_m(rms, equations.sigma_m, refinement) / equations.unit) ** 2
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
    options: LensOptions,
) -> LensFit | None:
    """Fit a lens where it pays: None where the residuals of a refined homography do not show one.

    `agreeing` is the share of the mask's roads that agree without a lens.
    """
    if agreeing >= options.enough and not _hints_at_lens(LensEquations(matrix, scene, index, refinement), options):
        return None
    rough = _fit_from_many(matrix, _thinned(scene, options.quick_points), index, refinement, options)
    if rough is None or _moves_px(rough, scene) < 0.5 * options.least_px:
        return None
    found = _improved(rough, scene, index, refinement, options)
    return found if is_significant(found, scene, options) else None


def grow_whole(
    matrix: FloatArray, scene: Scene, index: ReferenceIndex, refinement: RefineOptions, options: LensOptions
) -> LensFit | None:
    """Grow a homography anew from the part of the frame that it lays on roads, without a lens.

    It may have settled where only that part agrees. None where hardly more of the roads come to lie on roads.
    """
    before = LensEquations(matrix, scene, index, refinement).observe(0.0, np.zeros((9, 9)))
    found = fit_lens(matrix, scene, index, 0.0, refinement, options, held=True)
    better = found is not None and found.share > len(before.rows) / len(scene.points) + _BETTER
    return found if better else None


def is_significant(found: LensFit, scene: Scene, options: LensOptions) -> bool:
    """Whether a fit shows a lens: that of a pinhole finds some k1, too."""
    enough_px = _moves_px(found, scene) >= options.least_px
    return enough_px and abs(found.k1) >= options.significance * found.k1_sigma


def _moves_px(found: LensFit, scene: Scene) -> float:
    """Return how far the lens moves the frame's corners, at most."""
    corners = scene.corners.astype(float)
    moved = Lens.of(found.k1, scene.size, y_up=True).bend(corners) - corners
    return float(np.hypot(*moved.T).max())


def core_excess(
    matrix: FloatArray, scene: Scene, index: ReferenceIndex, refinement: RefineOptions, options: LensOptions
) -> float:
    """Return by how many road points the part of the frame that lies on roads exceeds what chance gives there."""
    core, inside = LensEquations(matrix, scene, index, refinement).core(0.0, options.n_cells, options.core_share)
    return float(core.sum() - options.chance_share * inside.sum())


def regrow(
    matrix: FloatArray, scene: Scene, index: ReferenceIndex, refinement: RefineOptions, options: LensOptions
) -> LensFit | None:
    """Grow a homography anew from the part of the frame that it lays on roads; None where that does not go far."""
    quick = _thinned(scene, options.quick_points)
    for k1 in options.quick_starts:
        rough = fit_lens(matrix, quick, index, 0.0, refinement, options, k1)
        if rough is not None and rough.share >= options.least_share:
            return _improved(rough, scene, index, refinement, options)
    return None


def _thinned(scene: Scene, n_points: int) -> Scene:
    """Return a scene with about so many of its road points."""
    return scene.of_points(slice(None, None, max(1, len(scene.points) // n_points)))


def _fit_from_many(
    matrix: FloatArray, scene: Scene, index: ReferenceIndex, refinement: RefineOptions, options: LensOptions
) -> LensFit | None:
    """Fit a lens from one value of k1 after another, until enough of the roads lie on roads; return the best."""
    best = None
    for k1 in (0.0, *options.starts):
        found = fit_lens(matrix, scene, index, 0.0, refinement, options, k1)
        if found is not None and (best is None or found.share > best.share):
            best = found
        if best is not None and best.share >= options.enough:
            break
    return best


def _improved(
    found: LensFit, scene: Scene, index: ReferenceIndex, refinement: RefineOptions, options: LensOptions
) -> LensFit:
    """Fit anew from where a fit ended, as long as more of the roads come to lie on roads: it may have been stuck."""
    for _ in range(options.n_restarts):
        starts = (found.k1,) if found.share >= options.enough else (found.k1, 0.0, 2.0 * found.k1)
        again = (fit_lens(found.matrix, scene, index, found.k1, refinement, options, k1) for k1 in starts)
        best = max((one for one in again if one is not None), key=lambda one: one.share, default=None)
        if best is None or best.share < found.share:
            break
        more, found = best.share > found.share + _MORE, best
        if not more:
            break
    return found


def _hints_at_lens(problem: LensEquations, options: LensOptions) -> bool:
    """Whether one step from a pinhole would make k1 significant."""
    seen = problem.observe(0.0, np.zeros((9, 9)))
    if len(seen.rows) < 12:
        return False
    scaled = (problem.weight * seen.cauchy / seen.own**2)[:, None] * seen.rows
    inverse = np.linalg.pinv(scaled.T @ seen.rows)
    step = inverse @ (scaled.T @ (seen.residuals / problem.unit))
    rms = math.sqrt(float(np.average(seen.scaled**2, weights=seen.cauchy)))
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
