"""Drawing the mask of a view with the faults of real masks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, BoolArray, Float32Array, FloatArray, IntArray
from roadgeo.evaluation.landscape import Landscape, Strokes, visible_intersections, visible_strokes
from roadgeo.geometry.frame import polygon_area
from roadgeo.geometry.pinhole import View

__all__ = ["NOISE_MODELS", "NoiseModel", "draw_mask"]

Range = tuple[float, float]


@dataclass(frozen=True)
class NoiseModel:
    """Faults of a mask. A range (low, high) is drawn from anew for each query; shares are of the road length.

    Attributes
    ----------
    missing : range
        Share that is absent, in pieces of 60 to 200 m.
    false_roads : range
        Length of strokes that are no roads.
    outdated : range
        Share of whole streets that only the map knows, and length of streets that only the ground knows.
    blobs, holes : range
        False patches beside the roads and gaps in them, per megapixel.
    occlusions : range
        Trees, shadows and clouds of 10 to 40 m radius that hide all roads under them, per megapixel.
    warp_px : float
        Standard deviation of a smooth random displacement.
    raggedness : float
        How ragged road edges are; 0.5 tears thin roads apart.
    distortion : range
        Radial displacement at the frame's corner by the lens, as a share of the half diagonal, either way.
    """

    missing: Range = (0.0, 0.0)
    false_roads: Range = (0.0, 0.0)
    outdated: Range = (0.0, 0.0)
    blobs: Range = (0.0, 0.0)
    holes: Range = (0.0, 0.0)
    occlusions: Range = (0.0, 0.0)
    warp_px: float = 0.0
    raggedness: float = 0.0
    distortion: Range = (0.0, 0.0)


#: `clean`: as the map. `segmented`: as a good segmenter sees it. `poor`: a weak one, or a difficult photograph.
NOISE_MODELS = {
    "clean": NoiseModel(),
    "segmented": NoiseModel(
        missing=(0.05, 0.10),
        false_roads=(0.02, 0.05),
        outdated=(0.0, 0.03),
        blobs=(3, 9),
        holes=(3, 9),
        occlusions=(0, 3),
        warp_px=0.8,
        raggedness=0.12,
        distortion=(0.0, 0.001),
    ),
    "poor": NoiseModel(
        missing=(0.13, 0.22),
        false_roads=(0.05, 0.12),
        outdated=(0.02, 0.05),
        blobs=(9, 27),
        holes=(9, 27),
        occlusions=(2, 6),
        warp_px=1.5,
        raggedness=0.22,
        distortion=(0.0, 0.003),
    ),
}


def draw_mask(
    landscape: Landscape,
    view: View,
    noise: NoiseModel,
    road_width: Range,
    rng: np.random.Generator,
    in_pixels: bool = False,
) -> tuple[AnyArray, dict[str, Any]]:
    """Draw the view of a camera as a segmenter would return it.

    Parameters
    ----------
    road_width : range
        Width of a street, in metres, so that it looks narrower farther off; or in pixels, the same in all of the frame.

    Returns
    -------
    mask : (H, W) uint8
        Roads 255.
    drawn : dict
        `n_intersections` that keep three branches, their `density_km2`, the shares `missing`, `false_roads` and
        `outdated` as they came out, and `road_share` of the pixels.
    """
    strokes = visible_strokes(landscape, view, rng)
    total = max(float(strokes.length.sum()), 1.0)
    gone = _pick(strokes.street, strokes.length, rng.uniform(*noise.outdated), rng)
    missing = _pick(strokes.piece, np.where(gone, 0.0, strokes.length), rng.uniform(*noise.missing), rng)

    canvas = _Canvas(np.zeros(view.size_px[::-1], np.uint8), view, strokes, road_width, in_pixels, rng)
    _draw_streets(canvas, ~gone & ~missing, rng.uniform(*road_width, landscape.graph.n_edges))
    n_intersections = _count_intact(canvas, visible_intersections(landscape, view))
    new = _draw_new_streets(canvas, rng.uniform(*noise.outdated) * total)
    false = _draw_false_roads(canvas, rng.uniform(*noise.false_roads) * total)
    _draw_patches(canvas, noise)
    mask = _wear(canvas.mask, noise, rng)
    drawn = {
        "n_intersections": n_intersections,
        "density_km2": n_intersections / (polygon_area(view.footprint) / 1e6),
        "missing": float(strokes.length[missing].sum()) / total,
        "false_roads": false / total,
        "outdated": (float(strokes.length[gone].sum()) + new) / total,
        "road_share": float(np.mean(mask > 0)),
    }
    return mask, drawn


@dataclass(frozen=True)
class _Canvas:
    """A mask in the making, (H, W) uint8, and the inputs of its drawing."""

    mask: AnyArray
    view: View
    strokes: Strokes
    road_width: Range
    in_pixels: bool
    rng: np.random.Generator

    def line(self, pixels: FloatArray, width_px: float) -> None:
        """Draw a polyline at (K, 2) pixels, at least 3 pixels wide."""
        # OpenCV counts from pixel centres; 4 fractional bits.
        points = np.round((pixels - 0.5) * 16).astype(np.int32).reshape(-1, 1, 2)
        cv2.polylines(self.mask, [points], False, 255, max(round(width_px), 3), cv2.LINE_8, 4)

    def metres_per_unit(self, pixels: FloatArray) -> FloatArray:
        """(...,) what a road's width at (..., 2) pixels is divided by to have it in pixels."""
        return np.ones(pixels.shape[:-1]) if self.in_pixels else self.view.sampling(pixels)

    def some_width(self) -> float:
        """Width of a street, pixels, at the frame's sampling."""
        return self.rng.uniform(*self.road_width) / (1.0 if self.in_pixels else self.view.gsd_m)

    def some_pixel(self, on_road: float) -> FloatArray:
        """(2,) a pixel of a road with probability `on_road`, else from anywhere in the frame."""
        if self.rng.random() < on_road and len(self.strokes.start):
            return np.asarray(self.strokes.start[self.rng.integers(len(self.strokes.start))])
        return np.asarray(self.rng.uniform((0.0, 0.0), self.view.size_px))


def _pick(group: IntArray, length: FloatArray, share: float, rng: np.random.Generator) -> BoolArray:
    """Pick whole groups at random until they hold a share of the length; (S,) whether a stroke was picked."""
    if share <= 0.0 or len(group) == 0:
        return np.zeros(len(group), bool)
    groups, member = np.unique(group, return_inverse=True)
    lengths = np.bincount(member, length)
    order = rng.permutation(len(groups))
    before = np.cumsum(lengths[order]) - lengths[order]
    picked = np.zeros(len(groups), bool)
    picked[order] = before < share * lengths.sum()
    return picked[member] & (length > 0)


def _draw_streets(canvas: _Canvas, kept: BoolArray, widths: FloatArray) -> None:
    """Draw each unbroken run of kept strokes of a piece as one line, as wide as its street at its middle."""
    strokes = canvas.strokes
    chosen = np.flatnonzero(kept)
    if len(chosen) == 0:
        return
    broken = np.not_equal(np.diff(chosen), 1) | np.not_equal(np.diff(strokes.piece[chosen]), 0)
    for run in np.split(chosen, np.flatnonzero(broken) + 1):
        middle = run[len(run) // 2]
        width = widths[strokes.street[middle]] / float(canvas.metres_per_unit(strokes.start[middle]))
        canvas.line(np.vstack([strokes.start[run], strokes.end[run[-1:]]]), width)


def _count_intact(canvas: _Canvas, pixels: FloatArray) -> int:
    """How many of the intersections at (K, 2) pixels show three branches: road runs on a circle around each."""
    view = canvas.view
    radius = 1.5 * np.maximum(np.mean(canvas.road_width) / canvas.metres_per_unit(pixels), 3.0) + 5.0
    angle = np.linspace(0.0, 2 * np.pi, 180, endpoint=False)
    ring = pixels[:, None] + radius[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    column, row = np.clip(ring.astype(int), 0, np.array(view.size_px) - 1).transpose(2, 0, 1)
    road = canvas.mask[row, column] > 0
    return int(((road & ~np.roll(road, 1, axis=1)).sum(axis=1) >= 3).sum())


def _draw_new_streets(canvas: _Canvas, wanted_px: float) -> float:
    """Connect points of the roads by slightly bent streets that no map knows; return the length drawn, pixels."""
    start, rng = canvas.strokes.start, canvas.rng
    drawn = 0.0
    for _ in range(1000 if len(start) else 0):
        if drawn >= wanted_px:
            break
        a, b = start[rng.integers(len(start), size=2)]
        length = float(np.hypot(*(b - a)))
        if 60.0 <= length * canvas.view.gsd_m <= 300.0:
            bend = rng.normal(0.0, 0.1) * np.array([a[1] - b[1], b[0] - a[0]])
            t = np.linspace(0.0, 1.0, 12)[:, None]
            canvas.line(a + t * (b - a) + 4 * t * (1 - t) * bend, canvas.some_width())
            drawn += length
    return drawn


def _draw_false_roads(canvas: _Canvas, wanted_px: float) -> float:
    """Draw wandering strokes of 40 to 260 m, half of them from a road; return the length drawn, pixels."""
    rng = canvas.rng
    drawn = 0.0
    while drawn < wanted_px:
        length = rng.uniform(40.0, 260.0) / canvas.view.gsd_m
        heading = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(0.0, 0.06, max(int(length / 10), 1)))
        steps = 10.0 * np.column_stack([np.cos(heading), np.sin(heading)])
        canvas.line(canvas.some_pixel(0.5) + np.vstack([[0.0, 0.0], np.cumsum(steps, axis=0)]), canvas.some_width())
        drawn += length
    return drawn


def _draw_patches(canvas: _Canvas, noise: NoiseModel) -> None:
    """Draw false blobs near the roads, holes in them, and regions that hide them altogether."""
    rng = canvas.rng

    def ellipses(per_megapixel: Range, radius_px: Range, on_road: float, spread_px: float, value: int) -> None:
        for _ in range(rng.poisson(rng.uniform(*per_megapixel) * canvas.mask.size / 1e6)):
            center = (canvas.some_pixel(on_road) + rng.normal(0.0, spread_px, 2)).astype(int).tolist()
            axes = rng.uniform(*radius_px, 2).astype(int).tolist()
            cv2.ellipse(canvas.mask, center, axes, rng.uniform(0, 180), 0, 360, value, -1)

    gsd = canvas.view.gsd_m
    ellipses(noise.blobs, (4, 14), 0.6, 12.0, 255)
    ellipses(noise.holes, (2, 6), 1.0, 4.0, 0)
    ellipses(noise.occlusions, (10 / gsd, 40 / gsd), 0.8, 10.0, 0)


def _wear(mask: AnyArray, noise: NoiseModel, rng: np.random.Generator) -> AnyArray:
    """Bend the mask by the lens and by chance, and tear the edges of its roads."""
    height, width = mask.shape
    distortion = rng.uniform(*noise.distortion) * rng.choice([-1, 1])
    if distortion or noise.warp_px:
        row, column = np.mgrid[0:height, 0:width].astype(np.float32)
        x, y = column - (width - 1) / 2, row - (height - 1) / 2
        lens = distortion * 4 * (x * x + y * y) / (width**2 + height**2)
        column = column + lens * x + noise.warp_px * _smooth_noise((height, width), 18, rng)
        row = row + lens * y + noise.warp_px * _smooth_noise((height, width), 18, rng)
        mask = cv2.remap(mask, column.astype(np.float32), row.astype(np.float32), cv2.INTER_LINEAR)
    if noise.raggedness:
        soft = cv2.GaussianBlur(mask.astype(np.float32) / 255, (0, 0), 1.5)
        ragged = noise.raggedness * _smooth_noise((height, width), 4, rng) * (soft > 0.03)  # no salt on open ground
        mask = (soft + ragged) * 255
    return np.where(mask > 127, 255, 0).astype(np.uint8)


def _smooth_noise(shape: tuple[int, int], scale_px: int, rng: np.random.Generator) -> Float32Array:
    """(H, W) float32 random field that varies over `scale_px`, mean 0 and standard deviation 1."""
    coarse = rng.standard_normal((shape[0] // scale_px + 2, shape[1] // scale_px + 2)).astype(np.float32)
    smooth = cv2.resize(coarse, shape[::-1], interpolation=cv2.INTER_CUBIC)
    return np.asarray((smooth - smooth.mean()) / max(float(smooth.std()), 1e-6), np.float32)
