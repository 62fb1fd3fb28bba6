"""Crops of the photographs as other cameras, heights, seasons and decades would show them.

34 photographs of one survey are few: what the network does not see here it will not know elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from tiles import Tile, half_size

__all__ = ["Crops"]

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Crops:
    """Draws augmented crops. The same generator state gives the same crop."""

    tiles: list[Tile]
    size: int  # px
    scales: tuple[float, float] = (0.8, 1.6)  # metres per pixel of most of them, of photographs of 1 m

    def __post_init__(self) -> None:
        halves = [half_size(tile) for tile in self.tiles]
        object.__setattr__(self, "_halves", halves)
        # A tile counts by the ground it shows, and more where there are roads to learn from.
        weights = np.array(
            [t.observed.mean() * (0.3 + min((t.road & t.observed).mean() / 0.02, 1.0)) for t in self.tiles]
        )
        object.__setattr__(self, "_weights", weights / weights.sum())
        object.__setattr__(self, "_observed", [np.flatnonzero(t.observed[::4, ::4]) for t in self.tiles])
        object.__setattr__(self, "_road", [np.flatnonzero((t.road & t.observed)[::4, ::4]) for t in self.tiles])

    def draw(self, rng: Generator) -> tuple[Floats, Floats]:
        """Return a photograph (S, S, 3), 0..1, and its truth (S, S, 4), 0..1, as in `Tile.truth`."""
        i = rng.choice(len(self.tiles), p=self._weights)
        scale = _draw_scale(rng, self.scales)
        coarse = scale >= 1.6  # bilinear sampling alone would skip pixels
        tile, shrunk = (self._halves[i], 2.0) if coarse else (self.tiles[i], 1.0)
        matrix = self._place(rng, i, scale, shrunk)
        photo, truth = self._warp(rng, tile, matrix)
        photo = _occlude(rng, photo, truth)
        photo = _recolour(rng, photo)
        photo = _degrade(rng, photo)
        return _mark_voids(rng, photo, truth), truth

    def _place(self, rng: Generator, i: int, scale: float, shrunk: float) -> NDArray[np.float64]:
        """Return a view that shows ground in most of its frame, if a few tries find one."""
        grid = np.linspace(0, self.size - 1, 12)
        corners = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(1, -1, 2)
        for _ in range(6):
            matrix = self._view(rng, self._centre(rng, i), scale, shrunk)
            x, y = np.rint(cv2.perspectiveTransform(corners, matrix)[0] * shrunk).astype(int).T
            h, w = self.tiles[i].truth.shape[:2]
            inside = (x >= 0) & (y >= 0) & (x < w) & (y < h)
            if (self.tiles[i].truth[y[inside], x[inside], 1] > 127).sum() > 0.7 * len(x):
                break
        return matrix

    def _centre(self, rng: Generator, i: int) -> NDArray[np.float64]:
        """Return the middle of the crop, (x, y) in pixels of the whole tile."""
        choices = self._road[i] if rng.random() < 0.5 and len(self._road[i]) else self._observed[i]
        row, column = divmod(int(choices[rng.integers(len(choices))]), -(-self.tiles[i].truth.shape[1] // 4))
        return np.array([column, row]) * 4.0 + rng.uniform(-60, 60, 2)

    def _view(self, rng: Generator, centre: NDArray[np.float64], scale: float, shrunk: float) -> NDArray[np.float64]:
        """Return the homography from crop pixels to pixels of the tile `shrunk` times smaller."""
        quarter = rng.random() < 0.3
        angle = rng.integers(4) * np.pi / 2 if quarter else rng.uniform(0, 2 * np.pi)
        stretch = 1.0 if quarter else np.exp(rng.normal(0, 0.06))
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        linear = turn @ np.diag([scale * stretch * rng.choice([-1, 1]), scale / stretch])
        tilt = np.zeros(2) if quarter else rng.normal(0, 0.12, 2).clip(-0.25, 0.25) / self.size
        to_middle = np.array([[1, 0, -(self.size - 1) / 2], [0, 1, -(self.size - 1) / 2], [0, 0, 1]])
        view = np.eye(3)
        view[:2, :2], view[2, :2] = linear, tilt
        place = np.array([[1, 0, centre[0]], [0, 1, centre[1]], [0, 0, 1]])
        return np.diag([1 / shrunk, 1 / shrunk, 1]) @ place @ view @ to_middle

    def _warp(self, rng: Generator, tile: Tile, matrix: NDArray[np.float64]) -> tuple[Floats, Floats]:
        size, inverse = (self.size, self.size), cv2.WARP_INVERSE_MAP
        kind = cv2.INTER_CUBIC if rng.random() < 0.4 else cv2.INTER_LINEAR
        photo = cv2.warpPerspective(tile.photo, matrix, size, flags=kind | inverse, borderMode=cv2.BORDER_REFLECT_101)
        truth = cv2.warpPerspective(tile.truth, matrix, size, flags=cv2.INTER_LINEAR | inverse)
        return photo.astype(np.float32) / 255, truth.astype(np.float32) / 255


def _draw_scale(rng: Generator, mostly: tuple[float, float]) -> float:
    """Return metres per pixel (of photographs of 1 m): mostly near what the model is run at, now and then far off."""
    if rng.random() < 0.7:
        return float(np.exp(rng.uniform(*np.log(mostly))))
    return float(np.exp(rng.uniform(np.log(0.45), np.log(2.8))))


def _occlude(rng: Generator, photo: Floats, truth: Floats) -> Floats:
    """Cover pieces of road with what lies beside them: trees, shadows, roofs."""
    roads = np.argwhere(truth[..., 2] > 0.5)
    if rng.random() > 0.4 or not len(roads):
        return photo
    photo, (h, w) = photo.copy(), truth.shape[:2]
    for _ in range(rng.integers(2, 14)):
        y, x = roads[rng.integers(len(roads))]
        ry, rx = rng.integers(4, 18, 2)
        shape = np.zeros((2 * ry + 1, 2 * rx + 1), np.float32)
        cv2.ellipse(shape, (int(rx), int(ry)), (int(rx), int(ry)), 0, 0, 360, 1.0, -1)
        sy, sx = rng.integers(ry, h - ry), rng.integers(rx, w - rx)
        if y < ry or x < rx or y >= h - ry or x >= w - rx or truth[sy, sx, 1] < 0.5 or truth[sy, sx, 0] > 0.5:
            continue
        there, source = (
            np.s_[y - ry : y + ry + 1, x - rx : x + rx + 1],
            np.s_[sy - ry : sy + ry + 1, sx - rx : sx + rx + 1],
        )
        cover = photo[there] * rng.uniform(0.3, 0.6) if rng.random() < 0.4 else photo[source].copy()
        alpha = cv2.GaussianBlur(shape, (0, 0), 1.0)[..., None]
        photo[there] += alpha * (cover - photo[there])
    return photo


def _recolour(rng: Generator, photo: Floats) -> Floats:
    """Change light, contrast and colours: other films, seasons, hours, haze."""
    mix, shift = np.eye(3), np.zeros(3)  # what is linear is gathered, and done in one pass over the pixels
    kind = rng.random()
    if kind < 0.6:
        colourful = 0.0 if kind < 0.15 else rng.uniform(0.3, 1.5)
        mix = colourful * mix + (1 - colourful) * np.tile([0.299, 0.587, 0.114], (3, 1))
    if rng.random() < 0.05:
        mix = mix[rng.permutation(3)]
    if rng.random() < 0.6:
        mix, shift = np.diag(rng.normal(1, 0.08, 3)) @ mix, rng.normal(0, 0.02, 3)
    if rng.random() < 0.8:
        middle = float(photo[::4, ::4].mean())
        contrast, light = np.exp(rng.normal(0, 0.2, 2))
        mix, shift = contrast * mix, contrast * (shift - middle) + middle * light
    if rng.random() < 0.15:
        haze = rng.uniform(0.1, 0.45)
        mix, shift = (1 - haze) * mix, (1 - haze) * shift + haze * rng.uniform(0.6, 0.95)
    photo = cv2.transform(photo, np.column_stack([mix, shift])).clip(0, 1)
    if rng.random() < 0.4:
        photo = cv2.pow(photo, float(np.exp(rng.normal(0, 0.3))))
    return photo * _clouds(rng, photo.shape[0]) if rng.random() < 0.25 else photo


def _clouds(rng: Generator, size: int) -> Floats:
    """Return (S, S, 1): light that varies over the crop."""
    coarse = np.exp(rng.normal(0, 0.25, (4, 4))).astype(np.float32)
    return cv2.resize(coarse, (size, size), interpolation=cv2.INTER_CUBIC)[..., None].clip(0.4, 2.0)


def _degrade(rng: Generator, photo: Floats) -> Floats:
    """Blur, sharpen, coarsen, add grain, compress."""
    size = photo.shape[0]
    kind = rng.random()
    if kind < 0.2:
        photo = cv2.GaussianBlur(photo, (0, 0), rng.uniform(0.4, 1.6))
    elif kind < 0.35:
        photo = photo + rng.uniform(0.3, 1.2) * (photo - cv2.GaussianBlur(photo, (0, 0), 1.2))
    elif kind < 0.5:
        small = int(size / rng.uniform(1.2, 2.2))
        photo = cv2.resize(
            cv2.resize(photo, (small, small), interpolation=cv2.INTER_AREA),
            (size, size),
            interpolation=cv2.INTER_LINEAR,
        )
    if rng.random() < 0.3:
        grain = rng.standard_normal((size, size, 1 if rng.random() < 0.5 else 3), np.float32)
        photo = photo + np.float32(rng.uniform(0.01, 0.06)) * grain
    photo = photo.clip(0, 1)
    if rng.random() < 0.3:
        _, packed = cv2.imencode(
            ".jpg", (photo * 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(20, 85))]
        )
        photo = cv2.imdecode(packed, cv2.IMREAD_COLOR).astype(np.float32) / 255
    return photo


def _mark_voids(rng: Generator, photo: Floats, truth: Floats) -> Floats:
    """Paint what was not observed white, black or plain; now and then blot out a box more. Changes `truth`."""
    size = photo.shape[0]
    if rng.random() < 0.1:
        y, x = rng.integers(0, size, 2)
        h, w = rng.integers(20, size // 3, 2)
        truth[y : y + h, x : x + w, 1] = 0
    kind = rng.random()
    colour = 1.0 if kind < 0.5 else 0.0 if kind < 0.75 else rng.random()
    return np.where(truth[..., 1:2] > 0.5, photo, np.float32(colour))
