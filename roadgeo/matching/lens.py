"""Lens distortion: a single radial parameter, estimated together with the homography where it improves the fit."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from roadgeo._arrays import BoolArray, FloatArray
from roadgeo.geometry.lens import Lens
from roadgeo.kernels.structs import Held
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.refinement import Equations, Refined, RefineOptions
from roadgeo.matching.scene import FEWEST, LEAST_SHARE, NOTICEABLE, Scene, and_pixels
from roadgeo.roads.intersections import Intersections

__all__ = [
    "ENOUGH",
    "find_lens",
    "fit_lens",
    "grow_whole",
    "straighten_scene",
]

#: No other fit is tried if this share of the mask's roads agrees.
ENOUGH = 0.8
#: Significance of k1 in its standard deviations, and the least movement of the frame's corners, pixels.
_SIGNIFICANCE, _LEAST_PX = 5.0, 5.0
#: Cells along each side of the frame; the part of the best cell's share of road points on roads that cells need where a
#: fit begins; and about the number of points there that are held at first.
_CORE, _N_HELD = (10, 0.75), 50
#: `RefineOptions.max_radius` while a fit grows. At twice the radius every point meets some road, and a part of the
#: frame that meets wrong roads bends the whole fit.
_MAX_RADIUS = and_pixels(10.0)
#: Starting values of k1, tried in turn until a fit explains enough.
_STARTS = (0.0, -0.15, -0.08, 0.08)


def find_lens(matrix: FloatArray, scene: Scene, index: ReferenceIndex, refinement: RefineOptions) -> Refined | None:
    """Fit a lens; return None if the roads show no distortion."""
    best = None
    for start in _STARTS:
        fitted = fit_lens(matrix, scene, index, refinement, start=start)
        if fitted is not None and (best is None or fitted.share > best.share):
            best = fitted
        if best is not None and best.share >= ENOUGH:
            break
    if best is None or _moves_px(best, scene) < 0.5 * _LEAST_PX:
        return None
    fitted = fit_lens(best.matrix, scene, index, refinement, best.lens_k1)
    if fitted is None or abs(fitted.lens_k1) < _SIGNIFICANCE * fitted.k1_sigma:  # a pinhole's image yields some k1, too
        return None
    return fitted if _moves_px(fitted, scene) >= _LEAST_PX else None


def grow_whole(matrix: FloatArray, scene: Scene, index: ReferenceIndex, refinement: RefineOptions) -> Refined | None:
    """Grow a homography anew from the part of the frame that it fits to roads, without a lens.

    A fit may have settled where only that part agrees. Returns None if hardly more of the road points lie on roads.
    """
    before = Equations(matrix, scene, index, refinement).meet().mean()
    fitted = fit_lens(matrix, scene, index, refinement, None)
    return fitted if fitted is not None and fitted.share > before + NOTICEABLE else None


def fit_lens(
    matrix: FloatArray,
    scene: Scene,
    index: ReferenceIndex,
    refinement: RefineOptions,
    k1: float | None = 0.0,
    start: float | None = None,
) -> Refined | None:
    """Adjust a homography and k1 to the roads of the map; return None if the adjustment fails.

    The fit begins with the part of the frame that the homography fits to roads, and grows outwards: a point takes part
    once nearer points fix its place, and its uncertainty follows from the fit.

    Parameters
    ----------
    matrix : (3, 3)
        Query plane, as a pinhole behind a lens with `k1` shows it, to reference plane: right to some metres over part
        of the frame.
    k1 : float or None
        None: without a lens.
    start : float, optional
        Value of k1 to begin with, other than `k1`.
    """
    equations = Equations(matrix, scene, index, replace(refinement, max_radius=_MAX_RADIUS), k1)
    (core,) = np.nonzero(_core(equations.meet(), scene.points, scene.size))
    if len(core) < FEWEST:
        return None
    some = core[:: max(1, len(core) // _N_HELD)]
    points, places = equations.samples.xy[some], equations.places(equations.samples.xy[some])
    if start is not None and start != k1:  # let the parameters put the points where they did
        straight = Lens(start, (0.0, 0.0), equations.samples.half_side).straighten(points)
        homography, _ = cv2.findHomography(straight, places)
        if homography is None:
            return None
        equations.p[:] = np.append((homography / homography[2, 2]).ravel()[:8], start)
    held = Held(points, places, 0.5 * equations.weight * len(core) / len(some))
    none = equations.pairs(points[:0], places[:0], 0.0)
    fitted = equations.adjust(none, held)
    return None if fitted is None or fitted.share < max(LEAST_SHARE, FEWEST / len(equations.samples.xy)) else fitted


def _core(met: BoolArray, points: FloatArray, size: tuple[int, int]) -> BoolArray:
    """Return which points (S,) that met roads lie in the connected part of the frame with most such points.

    The part consists of cells in which the share of points that met roads is nearly as great as in the best cell. A
    small part may meet roads by chance.
    """
    n, least = _CORE
    column, row = np.clip((points / size * (n, -n)).astype(int), 0, n - 1).T
    counts = np.zeros((2, n, n))
    np.add.at(counts[0], (row, column), met)
    np.add.at(counts[1], (row, column), 1.0)
    # A cell is judged together with its neighbours: alone it has few points.
    hits, all_points = (9.0 * cv2.blur(count, (3, 3), borderType=cv2.BORDER_CONSTANT) for count in counts)
    shares = hits / np.maximum(all_points, FEWEST)
    good = shares >= least * shares.max()
    part = cv2.connectedComponents(good.astype(np.uint8), connectivity=4)[1][row, column]
    n_met = np.bincount(part, met)
    n_met[0] = 0.0  # of the other cells
    return np.asarray(met & (part == n_met.argmax()))


def _moves_px(fitted: Refined, scene: Scene) -> float:
    """Return how far the lens moves the frame's corners, at most."""
    corners = scene.corners.astype(float)
    moved = Lens.of(fitted.lens_k1, scene.size, y_up=True).bend(corners) - corners
    return float(np.hypot(*moved.T).max())


def straighten_scene(scene: Scene, k1: float) -> Scene:
    """Return a scene as a pinhole would have seen it: its points moved back by a lens with k1."""
    lens = Lens.of(k1, scene.size, y_up=True)
    own = scene.intersections
    vectors = np.stack([np.cos(own.rays), np.sin(own.rays)], axis=-1).astype(float)
    turned = lens.straighten_directions(np.broadcast_to(own.xy[:, None], vectors.shape), vectors)
    rays = np.arctan2(turned[..., 1], turned[..., 0]).astype(own.rays.dtype)
    straight = Intersections(lens.straighten(own.xy), rays, own.tangents, own.residual, own.node)
    rows, columns = scene.field.shape
    cells = np.stack(np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5), axis=-1) * scene.field_scale
    source = (Lens.of(k1, scene.size).bend(cells) / scene.field_scale - 0.5).astype(np.float32)
    field = cv2.remap(scene.field, source[..., 0], source[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    soft = scene.probability
    if soft is not None:
        soft = np.asarray(cv2.remap(soft, source[..., 0], source[..., 1], cv2.INTER_LINEAR), np.float32)
    observed = cv2.remap(scene.observed.astype(np.uint8), source[..., 0], source[..., 1], cv2.INTER_NEAREST)
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
        probability=soft,
    )
