"""Figures 9 and 10: images that were located rightly, the roads seen in them, and where they lie on the map."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import experiments as paper
import numpy as np

from roadgeo.evaluation.scoring import score
from roadgeo.evaluation.trials import MaskFiles, Trial
from roadgeo.geometry.homography import shift
from roadgeo.matching.scene import read_query
from roadgeo.reference.opening import open_reference

_ROWS = 3
#: As in the paper, "a padding with size 1000m is added"; metres per pixel of the map.
_PADDING_M, _PIXEL_M = 1000.0, 2.0


def draw_places(path: Path, images: Any, masks: MaskFiles, done: Sequence[Trial], reference: Path) -> None:
    """Draw the first images that the trials located rightly: the image, its roads and intersections, and its place."""
    right = [k for k, trial in enumerate(done) if score(trial.truth, trial.answer).right][:_ROWS]
    if not right:
        return
    figure, panels = paper.axes(len(right), 3, squeeze=False)
    (part,) = open_reference(reference).parts
    index = part.open()
    for (photo, seen, ground), k in zip(panels, right, strict=True):
        _, pixels = images.view(k)
        query = read_query(str(masks.folder / masks.truths[k].file))
        x, y = (query.scene.intersections.xy * (1, -1)).T
        photo.imshow(pixels)
        seen.imshow(query.scene.field < 1.0, cmap="gray", extent=(0, *query.scene.size, 0))
        seen.scatter(x, y, s=10, color="C3")
        matrix = np.array(done[k].answer["homography"])
        matrix = np.linalg.inv(index.plane.to_crs_matrix()) @ matrix
        _draw_ground(ground, index, matrix, pixels)
        for ax in (photo, seen, ground):
            ax.set(xticks=[], yticks=[])
    figure.set_size_inches(12.0, 4.0 * len(right))
    figure.savefig(path, dpi=80)


def _draw_ground(ax: Any, index: Any, matrix: np.ndarray, pixels: Any) -> None:
    """Draw an image where `matrix` puts it, pixels to plane metres, and the map's roads in yellow."""
    height, width = pixels.shape[:2]
    corners = cv2.perspectiveTransform(np.array([[[0, 0], [width, 0], [width, height], [0, height]]], float), matrix)[0]
    low, high = corners.min(axis=0) - _PADDING_M, corners.max(axis=0) + _PADDING_M
    to_canvas = np.diag([1 / _PIXEL_M, -1 / _PIXEL_M, 1.0]) @ shift(-low[0], -high[1])
    columns, rows = np.ceil((high - low) / _PIXEL_M).astype(int).tolist()
    canvas = cv2.warpPerspective(pixels, shift(-0.5, -0.5) @ to_canvas @ matrix @ shift(0.5, 0.5), (columns, rows))
    ax.imshow(canvas, extent=(low[0], high[0], low[1], high[1]))
    from matplotlib.collections import LineCollection

    roads = np.reshape(index.segments_within(low, high), (-1, 2, 2))
    ax.add_collection(LineCollection(roads, colors="yellow", linewidths=0.8))
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
