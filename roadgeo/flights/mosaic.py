"""Frames of a flight stitched on one plane: a larger query than any of them.

Frames are chained by the homographies between neighbours. On the plane of a tilted frame a flight shrinks towards the
horizon; so the plane is levelled: turned until all frames show about as much ground, as they do from one height.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, BoolArray, FloatArray
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.homography import Homography, shift
from roadgeo.geometry.mask import PROBABILITY_SURE, PROBABILITY_UNKNOWN, RoadMask
from roadgeo.roads.vectorization import road_width

__all__ = ["Mosaic", "chain", "draw_mosaic", "level", "road_px", "stitch"]


#: Roads are drawn about so wide, so that large frames do not make a larger mosaic than tracing needs.
ROAD_PX = 9.0
#: A larger mosaic is drawn coarser.
_MAX_PIXELS = 16_000_000
#: A pixel is road where more than this share of the frames that see it show one: roads are missed more often than they
#: are invented.
_SHARE = 0.34
#: How much the height over the ground varies during a flight, as a share of it; tangent of a usual tilt of the camera.
_HEIGHT_SIGMA, _TILT_SIGMA = 0.04, 0.3


@dataclass(frozen=True)
class Mosaic:
    """Frames on one plane. Dimension: K frames.

    Attributes
    ----------
    mask : RoadMask
        The ground that they show together.
    to_mosaic : (K, 3, 3) float64
        Pixel of each frame to pixel of the mask, GDAL's corner convention.
    """

    mask: RoadMask
    to_mosaic: FloatArray


def chain(motion: Sequence[FloatArray] | FloatArray) -> FloatArray:
    """Return (K, 3, 3), pixel of each frame to pixel of the first, from K motions, of which the first is ignored."""
    matrices = [np.eye(3)]
    for step in list(motion)[1:]:
        product = matrices[-1] @ step
        matrices.append(product / np.linalg.norm(product))
    return np.stack(matrices)


def level(chained: FloatArray, frame: Frame) -> FloatArray:
    """Take chained frames (K, 3, 3) to a plane on which all show about as much ground.

    Returns
    -------
    (K, 3, 3) float64
        Pixel of each frame to that plane; its unit is half a frame's diagonal, its origin the middle of the first one.
    """
    unit = frame.half_diagonal
    to_unit = np.array([[1.0, 0.0, -frame.center[0]], [0.0, 1.0, -frame.center[1]], [0.0, 0.0, unit]]) / unit
    local = to_unit @ chained @ np.linalg.inv(to_unit)  # the middle of each frame is (0, 0)
    local = local / np.cbrt(np.linalg.det(local))[:, None, None]

    def residuals(line: FloatArray) -> FloatArray:
        # The area scale at a frame's middle is det / w^3, and a line at infinity changes w alone.
        w = local[:, 2, 2] + local[:, :2, 2] @ line
        size = -1.5 * np.log(np.maximum(w, 1e-6))
        return np.concatenate(((size - size.mean()) / 2.0 / _HEIGHT_SIGMA, line / _TILT_SIGMA))

    from scipy.optimize import least_squares

    line = least_squares(residuals, np.zeros(2), max_nfev=40).x if len(local) > 1 else np.zeros(2)
    levelled = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [line[0], line[1], 1.0]]) @ local @ to_unit
    middle = np.append(frame.center, 1.0)
    return np.asarray(levelled * np.sign(levelled[:, 2] @ middle)[:, None, None])


def road_px(masks: Sequence[RoadMask]) -> float:
    """Return the usual width of a road in frames, pixels."""
    shown = [road_width(mask) for mask in masks if mask.roads.any()]
    return float(np.median(shown)) if shown else 1.0


def stitch(masks: Sequence[RoadMask], motion: Sequence[FloatArray], road_px: float) -> Mosaic | None:
    """Lay frames of one size on one plane; None where no camera above a plane moves so.

    Parameters
    ----------
    motion : K matrices (3, 3)
        Pixel of each frame to pixel of the one before; the first is ignored.
    road_px : float
        Width of a road in the frames.
    """
    return draw_mosaic(masks, chain(motion), road_px)


def draw_mosaic(masks: Sequence[RoadMask], to_plane: FloatArray, road_px: float) -> Mosaic | None:
    """Lay frames of one size, whose pixels (K, 3, 3) `to_plane` takes to one plane, on it, levelled; see above."""
    height, width = masks[0].shape
    frame = Frame(width, height)
    levelled = level(to_plane, frame)
    corners = np.stack([Homography(matrix)(frame.corners) for matrix in levelled])
    if not _is_sound(corners):
        return None
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    per_unit = frame.half_diagonal * min(1.0, ROAD_PX / road_px)
    scale = min(per_unit, float(np.sqrt(_MAX_PIXELS / np.prod(high - low))))
    to_pixel = np.array([[scale, 0.0, -scale * low[0]], [0.0, scale, -scale * low[1]], [0.0, 0.0, 1.0]])
    to_mosaic = to_pixel @ levelled
    columns, rows = np.ceil((high - low) * scale).astype(int) + 1
    shown, observed, probability = _paint_all(masks, to_mosaic, (rows, columns))
    return Mosaic(RoadMask(shown, observed, masks[0].name, probability), to_mosaic)


def _paint_all(
    masks: Sequence[RoadMask], matrices: FloatArray, shape: tuple[int, int]
) -> tuple[BoolArray, BoolArray, AnyArray | None]:
    """Return where frames show road, the ground they observe, and how probable roads are, on a mosaic (rows, columns).

    The probability is the mean of the frames', as in `RoadMask`; None where they have none.
    """
    roads, observed = np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)
    total = np.zeros(shape, np.uint16) if any(mask.probability is not None for mask in masks) else None
    for mask, matrix in zip(masks, matrices, strict=True):
        _paint(mask, matrix, roads, observed, total)
    shown = (observed > 0) & (roads > _SHARE * observed)
    if total is None:
        return shown, observed > 0, None
    mean = np.minimum(total // np.maximum(observed, 1), PROBABILITY_SURE)
    return shown, observed > 0, np.where(observed > 0, mean, PROBABILITY_UNKNOWN).astype(np.uint8)


def _is_sound(corners: FloatArray) -> bool:
    """Whether all frames (K, 4, 2) look at the plane from above, none much larger than another."""
    if not np.isfinite(corners).all():
        return False
    x, y = corners[..., 0], corners[..., 1]
    areas = 0.5 * np.sum(x * np.roll(y, -1, axis=1) - y * np.roll(x, -1, axis=1), axis=1)
    return bool(areas.min() > 0.0 and areas.max() < 16.0 * areas.min())


def _paint(mask: RoadMask, matrix: FloatArray, roads: AnyArray, count: AnyArray, total: AnyArray | None) -> None:
    """Count where a frame shows road, and where it sees at all, on the mosaic; both (R, C) uint8 are changed.

    `total` (R, C) uint16: the probability of road is added to it.
    """
    height, width = mask.shape
    corners = Homography(matrix)(Frame(width, height).corners)
    left, top = np.maximum(np.floor(corners.min(axis=0)).astype(int) - 1, 0)
    right, bottom = np.ceil(corners.max(axis=0)).astype(int) + 2
    part = np.s_[top:bottom, left:right]
    # OpenCV counts from pixel centres.
    size, warp = roads[part].shape[::-1], shift(-0.5 - left, -0.5 - top) @ matrix @ shift(0.5, 0.5)
    values = mask.roads.view(np.uint8) * np.uint8(255)
    known = (
        np.full(mask.shape, 255, np.uint8) if mask.observed is None else mask.observed.view(np.uint8) * np.uint8(255)
    )
    roads[part] += cv2.warpPerspective(values, warp, size, flags=cv2.INTER_AREA) > 127
    sees = cv2.warpPerspective(known, warp, size, flags=cv2.INTER_NEAREST) > 127
    count[part] += sees
    if total is not None:
        sure = mask.roads * np.uint8(PROBABILITY_SURE) if mask.probability is None else mask.probability
        sure = np.where(sure == PROBABILITY_UNKNOWN, np.uint8(0), sure)
        total[part] += cv2.warpPerspective(sure, warp, size, flags=cv2.INTER_AREA) * sees
