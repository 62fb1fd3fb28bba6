"""Painted scenes: real streets between invented houses, and photographs with houses, trees and shadows painted in.

34 photographs of one survey show no deep shadows of towers, no gravel, no boulevards of eight lanes, no railways in
sand. A painted scene shows what they lack, and its label is right to the pixel. Streets come from OpenStreetMap.
"""

from __future__ import annotations

import mmap
import multiprocessing
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from tiles import Bytes, Floats, Tile, truth_of

__all__ = ["Painter", "Streets", "painted"]

#: Carriageways, metres: narrowest and widest, by the classes of `cut_streets.py`.
WIDTHS = (
    *((10, 17), (9, 15), (8, 20), (8, 16), (7, 11), (6, 9), (5, 8)),  # motorway to unclassified
    *((3.5, 5.5), (2.8, 4.5), (6, 9), (4, 9)),  # service, track, links, pedestrian
)
MOTORWAY, SERVICE, TRACK, PEDESTRIAN = 0, 7, 8, 10
LEAST_LABEL_M = 5.5

#: Red, green, blue.
GREENS = ((86, 104, 62), (104, 118, 76), (70, 88, 60), (120, 128, 84), (60, 76, 48))
DRY = ((176, 160, 124), (156, 136, 104), (190, 178, 148), (132, 116, 88), (168, 148, 120), (146, 140, 112))
WINTER = ((112, 100, 88), (96, 90, 78), (126, 112, 98), (84, 80, 72))
PAVED = ((150, 148, 144), (128, 126, 124), (172, 168, 160), (110, 108, 106), (140, 134, 126))
ASPHALT = ((112, 112, 114), (92, 92, 96), (132, 130, 128), (74, 74, 80), (146, 144, 140))
PALE = ((190, 186, 176), (206, 200, 190), (176, 172, 164))
GRAVEL = ((196, 180, 150), (172, 152, 122), (150, 126, 96), (184, 172, 156), (140, 112, 84))
ROOFS = (
    *((150, 146, 142), (98, 96, 98), (70, 70, 74), (196, 194, 190), (228, 226, 222)),
    *((158, 96, 70), (134, 82, 66), (176, 118, 92), (112, 92, 80), (122, 130, 138), (84, 98, 88)),
)
CROWNS = ((52, 70, 40), (64, 84, 48), (44, 58, 38), (80, 92, 58), (92, 84, 66), (58, 66, 52))
WATER = ((38, 56, 62), (58, 76, 78), (84, 96, 84), (30, 38, 44), (96, 112, 118))
CARS = ((228, 228, 228), (40, 40, 44), (60, 70, 110), (140, 44, 44), (160, 160, 164), (90, 90, 94))


@dataclass(frozen=True)
class Streets:
    """Windows of real streets. Dimensions: P points, L lines, W windows."""

    xy: NDArray[np.int16]  # (P, 2) decimetres about the middle of their window
    starts: NDArray[np.int32]  # (L + 1,) first point of each line
    kinds: NDArray[np.int8]  # (L,) index into WIDTHS
    windows: NDArray[np.int32]  # (W + 1,) first line of each window

    @classmethod
    def read(cls, path: Path) -> Streets:
        with np.load(path) as held:
            return cls(held["xy"], held["starts"], held["codes"], held["windows"])

    def draw(self, rng: Generator) -> list[tuple[Floats, int]]:
        """Return the lines of a window, (N, 2) metres about its middle, each with its kind."""
        w = int(rng.integers(len(self.windows) - 1))
        return [
            (self.xy[self.starts[i] : self.starts[i + 1]].astype(np.float32) / 10, int(self.kinds[i]))
            for i in range(self.windows[w], self.windows[w + 1])
        ]


@dataclass(frozen=True)
class _Sun:
    """Where shadows fall: pixels for each metre of height; how dark, and its colour."""

    per_metre: Floats  # (2,)
    shade: Floats  # (3,)


class Painter:
    """Paints scenes of `size` pixels."""

    def __init__(self, streets: Streets | None, tiles: list[Tile], size: int = 768) -> None:
        self.streets, self.tiles, self.size = streets, tiles, size
        ground = np.array([tile.observed.mean() * (tile.road.mean() + 0.01) for tile in tiles])
        self._weights = ground / ground.sum()

    def scene(self, rng: Generator) -> tuple[Bytes, Bytes]:
        """Return a painted scene, (S, S, 3) RGB, and its truth (S, S, 5) as in `Tile.truth`."""
        if self.streets is None:
            return self.photograph(rng)
        canvas = _Canvas(rng, self.size, float(np.exp(rng.uniform(np.log(0.4), np.log(1.9)))))
        rural = rng.random() < 0.35
        canvas.lay_ground(rural)
        if rng.random() < 0.25:
            canvas.lay_water()
        if rng.random() < 0.25:
            canvas.lay_rails()
        canvas.lay_streets(self.streets.draw(rng), rural)
        if rng.random() < (0.2 if rural else 0.6):
            canvas.lay_parking()
        canvas.drive_cars(rng.uniform(0, 0.5) ** 2, parked=rng.uniform(0, 0.6) if rng.random() < 0.5 else 0.0)
        canvas.build(rng.uniform(0.02, 0.3) if rural else rng.uniform(0.2, 1.0), in_rows=rng.random() < 0.6)
        canvas.plant(float(rng.choice([0.05, 0.3, 1.0])) * rng.uniform(0.3, 1.0))
        return canvas.finish()

    def photograph(self, rng: Generator) -> tuple[Bytes, Bytes]:
        """Return a part of a photograph with something painted in, and its truth."""
        tile = self.tiles[int(rng.choice(len(self.tiles), p=self._weights))]
        h, w = tile.photo.shape[:2]
        size = min(self.size, h, w)
        tries = [(int(rng.integers(h - size + 1)), int(rng.integers(w - size + 1))) for _ in range(16)]
        y, x = max(tries, key=lambda at: tile.observed[at[0] : at[0] + size : 8, at[1] : at[1] + size : 8].mean())
        part = np.s_[y : y + size, x : x + size]
        canvas = _Canvas(rng, size, 1.0, tile.photo[part].copy(), tile.truth[part].copy())
        if rng.random() < 0.5:
            canvas.repave()
        if rng.random() < 0.15:
            canvas.lay_rails()
        if rng.random() < 0.1:
            canvas.lay_water()
        if rng.random() < 0.4:
            canvas.lay_parking()
        if rng.random() < 0.4:
            canvas.drive_cars(rng.uniform(0, 0.5) ** 2, parked=0.0)
        if rng.random() < 0.7:
            canvas.build(rng.uniform(0.02, 0.5), tall=rng.random() < 0.6)
        if rng.random() < 0.6:
            canvas.plant(rng.uniform(0.05, 0.6))
        return canvas.finish()


class _Canvas:
    """A picture that is painted, layer by layer, with its truth."""

    def __init__(
        self, rng: Generator, size: int, metres: float, photo: Bytes | None = None, truth: Bytes | None = None
    ) -> None:
        self.rng, self.size, self.m = rng, size, 1 / metres  # m: pixels in a metre
        self.photo = np.zeros((size, size, 3), np.uint8) if photo is None else photo
        self.given = truth
        self.road = np.zeros((size, size), np.uint8) if truth is None else (truth[..., 0] > 127).astype(np.uint8)
        self.known = np.ones((size, size), np.uint8)
        self.taken = np.zeros((size, size), np.uint8)
        self.shadow = np.zeros((size, size), np.uint8)
        angle, height = rng.uniform(0, 2 * np.pi), rng.uniform(0.35, 2.5)
        direction = np.array([np.cos(angle), np.sin(angle)], np.float32)
        shade = rng.uniform(0.2, 0.62) * np.array([0.92, 1.0, rng.uniform(1.0, 1.3)])
        self.sun = _Sun(direction * np.float32(height * self.m), shade.astype(np.float32))
        self.lean = (direction[::-1] * rng.uniform(-0.35, 0.35) * self.m).astype(np.float32)
        self._distance: Floats | None = None
        self.lines: list[tuple[NDArray[np.int32], float]] = []  # of streets: 1/16 pixel; width, metres

    # -- ground ------------------------------------------------------------------------------------------------------

    def lay_ground(self, rural: bool) -> None:
        """Fields or yards, each of a colour and texture of its own."""
        rng, theme = self.rng, int(self.rng.integers(4))
        palette = np.array((GREENS, DRY, WINTER, (*GREENS, *DRY))[theme] + (() if rural else PAVED), np.float32)
        cell = rng.uniform(80, 300) if rural else rng.uniform(15, 60)
        cells = self._cells(cell * self.m)
        colours = palette[rng.integers(len(palette), size=cells.max() + 1)] * rng.uniform(
            0.85, 1.15, (cells.max() + 1, 1)
        )
        if not rural:
            colours = 0.6 * colours + 0.4 * colours.mean(0)
        ground = colours.astype(np.float32)[cells]
        if rural and rng.random() < 0.6:
            ground += self._furrows(cells)[..., None]
        if rural and rng.random() < 0.5:
            edges = cv2.morphologyEx(cells.astype(np.float32), cv2.MORPH_GRADIENT, np.ones((3, 3))) > 0
            ground[edges] = rng.choice(np.array((*CROWNS, *DRY), np.float32))
        self.photo = self._rough(ground, rng.uniform(4, 16), rng.uniform(3, 12))

    def _cells(self, side: float) -> NDArray[np.int32]:
        n = max(2, int((self.size / side) ** 2))
        seeds = np.ones((self.size, self.size), np.uint8)
        seeds[tuple(self.rng.integers(self.size, size=(2, n)))] = 0
        _, cells = cv2.distanceTransformWithLabels(seeds, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
        return np.asarray(cells, np.int32)

    def _furrows(self, cells: NDArray[np.int32]) -> Floats:
        rng, n = self.rng, int(cells.max()) + 1
        angle, strength = rng.uniform(0, np.pi, n), rng.uniform(0, 14, n) * (rng.random(n) < 0.6)
        pitch = rng.uniform(3, 9, n) * self.m
        y, x = np.mgrid[: self.size, : self.size].astype(np.float32)
        wave = (2 * np.pi / np.maximum(pitch, 3)).astype(np.float32)
        phase = (
            x * (np.cos(angle).astype(np.float32) * wave)[cells] + y * (np.sin(angle).astype(np.float32) * wave)[cells]
        )
        return np.asarray(np.sin(phase) * strength.astype(np.float32)[cells], np.float32)

    def _rough(self, values: Floats, broad: float, fine: float) -> Bytes:
        """Make it uneven, in broad spots and fine ones."""
        rng, noise = self.rng, _noise()
        for strength, zoom in ((broad, 1), (fine, 0)):
            y, x = rng.integers(noise[zoom].shape[0] - self.size + 1, size=2)
            part = noise[zoom][y : y + self.size, x : x + self.size]
            part = part[:: rng.choice([-1, 1]), :: rng.choice([-1, 1])]
            values = values + (strength * part)[..., None] * rng.uniform(0.8, 1.2, 3).astype(np.float32)
        return np.asarray(values.clip(0, 255).astype(np.uint8))

    # -- what is no road -----------------------------------------------------------------------------------------------

    def _curve(self, wander: float) -> NDArray[np.int32]:
        """Return a smooth line across the picture, (N, 2) in 1/16 pixel."""
        rng, s = self.rng, self.size
        angle, t = rng.uniform(0, np.pi), np.linspace(-0.8, 0.8, 60)
        across = wander * (np.sin(t * rng.uniform(2, 7) + rng.uniform(0, 6)) + rng.uniform(-1, 1) * t * t)
        along = np.stack([t, across + rng.uniform(-0.35, 0.35)], 1) * s
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        return np.rint((along @ turn.T + s / 2) * 16).astype(np.int32)

    def _paint_under_roads(self, layer: Bytes, alpha: Bytes) -> None:
        """Lay a picture over all that is no road."""
        share = alpha.astype(np.float32) / 255
        if self.given is not None:
            share = share * (1 - cv2.GaussianBlur(cv2.dilate(self.road, np.ones((7, 7))).astype(np.float32), (0, 0), 1))
        share = share[..., None]
        self.photo = (self.photo * (1 - share) + layer * share).astype(np.uint8)

    def lay_water(self) -> None:
        """A river or lake, with banks that are pale now and then."""
        rng, mask = self.rng, np.zeros((self.size, self.size), np.uint8)
        if rng.random() < 0.7:
            width = max(2, int(rng.uniform(12, 90) * self.m))
            cv2.polylines(mask, [self._curve(0.12)], False, 255, width, cv2.LINE_AA, 4)
        else:
            centre, radius = rng.integers(self.size, size=2), rng.uniform(20, 160) * self.m
            t = np.linspace(0, 2 * np.pi, 40, endpoint=False)
            r = radius * (1 + 0.2 * np.sin(2 * t + rng.uniform(0, 6)) + 0.15 * np.sin(3 * t + rng.uniform(0, 6)))
            ring = centre + np.stack([r * np.cos(t), r * np.sin(t)], 1)
            cv2.fillPoly(mask, [ring.astype(np.int32)], 255, cv2.LINE_AA)
        bank = max(1, int(rng.uniform(1, 6) * self.m)) * 2 + 1
        if rng.random() < 0.7:
            pale = np.array((*GRAVEL, *PALE, *GREENS)[rng.integers(13)], np.float32)
            self._paint_under_roads(self._plain(pale, 8), cv2.dilate(mask, np.ones((bank, bank))))
        self._paint_under_roads(self._plain(np.array(WATER[rng.integers(len(WATER))], np.float32), 3), mask)
        self.taken |= cv2.dilate(mask, np.ones((9, 9))) > 127

    def lay_rails(self) -> None:
        """A railway: ballast, and rails on it where pixels are small."""
        rng, line = self.rng, self._curve(0.06)
        for track in range(int(rng.integers(1, 4))):
            shifted = line + int(track * 16 * rng.uniform(4, 7) * self.m)
            mask, colour = np.zeros((self.size, self.size), np.uint8), (*WINTER, *PAVED)[rng.integers(9)]
            cv2.polylines(mask, [shifted], False, 255, max(1, round(rng.uniform(3, 6) * self.m)), cv2.LINE_AA, 4)
            self._paint_under_roads(self._plain(np.array(colour, np.float32), 8), mask)
            shade = rng.choice([50, 70, 190])
            for side in (-0.75, 0.75):
                rail = np.zeros_like(mask)
                cv2.polylines(rail, [shifted + round(16 * side * self.m)], False, 150, 1, cv2.LINE_AA, 4)
                self._paint_under_roads(self._plain(np.full(3, shade, np.float32), 2), rail)
            self.taken |= cv2.dilate(mask, np.ones((5, 5))) > 127

    def lay_parking(self) -> None:
        """Parking lots: asphalt and rows of cars, off the roads."""
        rng = self.rng
        for x, y, angle, distance in self._spots(int(rng.integers(2, 12))):
            width, depth = rng.uniform(18, 90) * self.m, rng.uniform(16, 60) * self.m
            if distance < depth / 2 or not self._take(x, y, angle, width, depth, 1.0):
                continue
            mask = np.zeros((self.size, self.size), np.uint8)
            cv2.fillPoly(mask, [_box(x, y, angle, width, depth)], 255, cv2.LINE_AA, 4)
            colour = np.array((*ASPHALT, *PALE)[rng.integers(8)], np.float32)
            self._paint_under_roads(self._plain(colour, 5), mask)
            full, row = rng.uniform(0, 0.9), 0.0
            while row < depth / self.m - 5:
                for along in np.arange(2, width / self.m - 3, 2.8):
                    if rng.random() < full:
                        dx, dy = (along * self.m - width / 2), (row + 2.7) * self.m - depth / 2
                        cx, cy = (
                            x + dx * np.cos(angle) - dy * np.sin(angle),
                            y + dx * np.sin(angle) + dy * np.cos(angle),
                        )
                        self._fill(_box(cx, cy, angle, 1.9 * self.m, 4.4 * self.m), CARS[rng.integers(len(CARS))])
                row += 5.2 if rng.random() < 0.5 else 11.5

    # -- roads -------------------------------------------------------------------------------------------------------

    def lay_streets(self, lines: list[tuple[Floats, int]], rural: bool) -> None:
        """Draw streets, turned and shifted at random, and their truth."""
        rng, s = self.rng, self.size
        angle, shift = rng.uniform(0, 2 * np.pi), rng.uniform(-0.5, 0.5, 2) * max(2000 - s / self.m, 0) * 0.35
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]], np.float32)
        surface = ASPHALT if rng.random() < 0.6 else PALE if rng.random() < 0.4 else GRAVEL
        base = np.array(surface[rng.integers(len(surface))], np.float32)
        small = GRAVEL if rural or rng.random() < 0.2 else surface
        bare = rng.random() < 0.15  # roads as what lies about them
        verge, drawn = rng.uniform(0, 5) * (rng.random() < 0.7), []
        for xy, kind in lines:
            if kind == PEDESTRIAN and rng.random() < 0.5:
                continue
            at = np.rint(((xy + shift) @ turn.T * self.m + s / 2) * 16).astype(np.int32)
            if (at.max(0) < 0).any() or (at.min(0) > 16 * s).any():
                continue
            drawn.append((at, kind, rng.uniform(*WIDTHS[kind]), rng.uniform(0.92, 1.08)))
        self.lines = [(at, width) for at, _, width, _ in drawn]
        if verge:
            colour = tuple(float(c) for c in (*PAVED, *PALE, *GREENS)[rng.integers(13)])
            for at, kind, width, _ in drawn:
                if kind < SERVICE:
                    self._line(self.photo, at, width + 2 * verge, colour)
        order = sorted(range(len(drawn)), key=lambda i: -drawn[i][1])
        local = cv2.blur(self.photo, (31, 31)) if bare else None
        layer = np.zeros_like(self.photo) if bare else self.photo
        for i in order:
            at, kind, width, light = drawn[i]
            own = np.array(small[rng.integers(len(small))], np.float32) if kind in (SERVICE, TRACK) else base
            self._line(layer, at, width, tuple(float(c) for c in (own * light).clip(1, 255)))
        if local is not None:
            mask = cv2.GaussianBlur((layer.max(2) > 0).astype(np.float32), (0, 0), 0.7)[..., None]
            mix = np.float32(rng.uniform(0.3, 0.75))
            near = mix * local.astype(np.float32) + (1 - mix) * layer
            self.photo = (self.photo * (1 - mask) + near * mask).astype(np.uint8)
        self._mark(drawn, rng)
        for at, kind, width, _ in drawn:
            if kind in (SERVICE, PEDESTRIAN):  # maps differ in whether they have these
                self._line(self.known, at, width + 3, 0)
            else:
                self._line(self.road, at, max(width, LEAST_LABEL_M), 1, plain=True)
        self.known |= self.road

    def _mark(self, drawn: list[tuple[NDArray[np.int32], int, float, float]], rng: Generator) -> None:
        """Paint lane marks, medians, and the wear of wheels."""
        for at, kind, width, _ in drawn:
            if kind < SERVICE and width > 11 and rng.random() < 0.5:  # a median
                strip = rng.uniform(1.5, 5)
                colour = (*GREENS, *PALE)[rng.integers(8)]
                self._line(self.photo, at, strip, tuple(float(c) for c in colour))
            elif kind < SERVICE and self.m > 0.7 and rng.random() < 0.4:
                self._line(self.photo, at, 0.3, (210.0, 208.0, 190.0))
        if rng.random() < 0.5:
            cracks = self._rough(np.full(self.photo.shape, 128, np.float32), rng.uniform(2, 12), rng.uniform(2, 10))
            self.photo = np.clip(self.photo.astype(np.int16) + cracks - 128, 0, 255).astype(np.uint8)

    def _line(
        self, image: Bytes, at: NDArray[np.int32], width_m: float, colour: object, *, plain: bool = False
    ) -> None:
        thick = width_m * self.m
        whole = int(thick) + int(self.rng.random() < thick - int(thick))
        cv2.polylines(image, [at], False, colour, max(1, whole), cv2.LINE_8 if plain else cv2.LINE_AA, 4)

    def repave(self) -> None:
        """Give the roads of a photograph another surface: gravel, concrete, dirt, dark, or nearly as what is beside."""
        rng = self.rng
        inner = cv2.GaussianBlur(self.road.astype(np.float32), (0, 0), rng.uniform(0.8, 1.6))[..., None]
        photo = self.photo.astype(np.float32)
        if not self.road.any():
            return
        mean = photo[self.road > 0].mean(0)
        if rng.random() < 0.35:  # low contrast
            target = cv2.blur(photo, (41, 41))
            smooth = cv2.blur(photo, (7, 7))
            photo += inner * np.float32(rng.uniform(0.4, 0.85)) * (target - smooth)
        else:
            surface = (GRAVEL, PALE, ASPHALT)[rng.integers(3)]
            target = np.array(surface[rng.integers(len(surface))], np.float32)
            texture = np.float32(rng.uniform(0.4, 1.0))
            smooth = cv2.blur(photo, (5, 5))
            changed = texture * (photo - smooth) + target + np.float32(rng.uniform(0.3, 1.0)) * (smooth - mean)
            photo += inner * (changed - photo)
        self.photo = photo.clip(0, 255).astype(np.uint8)

    def drive_cars(self, density: float, *, parked: float) -> None:
        """Put cars on roads, along them, and at their sides."""
        spots = np.argwhere(self.road)
        if not len(spots) or self.m < 0.5:
            return
        across, number = self._across(), int(density * len(spots) / (60 * self.m**2))
        chosen = [spots[self.rng.integers(len(spots), size=number)]]
        if parked:
            inside = cv2.distanceTransform(self.road, cv2.DIST_L2, 5) / self.m
            side = np.argwhere((inside > 0.9) & (inside < 1.8))
            if len(side):
                chosen.append(side[self.rng.integers(len(side), size=int(parked * len(side) / (5 * self.m**2)))])
        for y, x in np.concatenate(chosen)[:3000]:
            dx, dy = across[y, x]
            long = self.rng.choice([4.4, 4.4, 4.8, 9.0]) * self.m
            box = _box(x, y, float(np.arctan2(dy, dx)) + np.pi / 2, long, 1.9 * self.m)
            self._fill(box, CARS[self.rng.integers(len(CARS))])

    # -- what stands -------------------------------------------------------------------------------------------------

    def build(self, density: float, *, tall: bool | None = None, in_rows: bool = False) -> None:
        """Put up houses along the roads, with their shadows; leaning where the camera stands aside."""
        rng, roofs = self.rng, []
        tall = rng.random() < 0.35 if tall is None else tall
        big = rng.uniform(18, 55) if tall else rng.uniform(9, 22)
        highest = float(np.exp(rng.uniform(np.log(15), np.log(140)))) if tall else rng.uniform(5, 14)
        number = int(density * (self.size / self.m) ** 2 / (2.2 * big**2))
        hues = rng.choice(len(ROOFS), size=int(rng.integers(2, 7)), replace=False)
        for x, y, angle, width, depth in self._rows(big, density) if in_rows else ():
            if self._take(x, y, angle, width, depth, 0.9):
                height = highest * rng.uniform(0.3, 1.0) ** 2 + 3
                roofs.append((x, y, angle, width, depth, height, hues[rng.integers(len(hues))]))
        spread = rng.uniform(15, 60) * self.m  # most houses stand along roads
        for x, y, angle, distance in self._spots(min(2 * number, 2500)):
            if rng.random() > np.exp(-distance / spread) + 0.1:
                continue
            width, depth = big * rng.uniform(0.5, 1.2) * self.m, big * rng.uniform(0.4, 1.0) * self.m
            if distance - depth / 2 < rng.uniform(0.5, 6) * self.m or not self._take(x, y, angle, width, depth, 0.9):
                continue
            height = highest * rng.uniform(0.3, 1.0) ** 2 + 3
            roofs.append((x, y, angle, width, depth, height, hues[rng.integers(len(hues))]))
        for x, y, angle, width, depth, height, _ in roofs:
            foot = _box(x, y, angle, width, depth).astype(np.float32)
            far = foot + self.sun.per_metre * height * 16
            hull = cv2.convexHull(np.concatenate([foot, far]).astype(np.float32))
            cv2.fillPoly(self.shadow, [np.rint(hull).astype(np.int32)], 255, cv2.LINE_AA, 4)
        self._cast()
        for x, y, angle, width, depth, height, hue in sorted(roofs, key=lambda item: item[5]):
            colour = np.array(ROOFS[hue], np.float32) * rng.uniform(0.8, 1.15)
            foot = _box(x, y, angle, width, depth)
            top = foot + np.rint(self.lean * height * 16).astype(np.int32)
            walls = cv2.convexHull(np.concatenate([foot, top]))
            self._fill(walls, colour * rng.uniform(0.5, 0.9))
            self._fill(top, colour)
            if height < 14 and rng.random() < 0.7:  # a gable: one half lies in less light
                half = np.stack([top[0], top[1], (top[1] + top[2]) // 2, (top[3] + top[0]) // 2])
                self._fill(half, colour * rng.uniform(0.65, 0.9))
            elif rng.random() < 0.6:
                for _ in range(int(rng.integers(1, 5))):
                    t = rng.uniform(0.15, 0.85, 2)
                    spot = top[0] + t[0] * (top[1] - top[0]) + t[1] * (top[3] - top[0])
                    side = rng.uniform(0.05, 0.2, 2) * (width, depth)
                    self._fill(_box(spot[0] / 16, spot[1] / 16, angle, *side), colour * rng.uniform(0.6, 1.2))

    def _rows(self, side: float, density: float) -> Iterator[tuple[int, int, float, float, float]]:
        """Yield places of houses side by side along the streets: x, y, angle, width and depth, pixels."""
        rng, number = self.rng, 0
        setback, gap, full = rng.uniform(1.5, 9), rng.uniform(0, 8), rng.uniform(0.6, 1.0)
        deep = side * rng.uniform(0.6, 1.3)
        for at, road_m in self.lines:
            for a, b in zip(at[:-1] / 16, at[1:] / 16, strict=True):
                length = float(np.hypot(*(b - a)))
                ahead = (b - a) / max(length, 1e-6)
                along = 0.0
                while along < length and number < 2500:
                    width = side * rng.uniform(0.6, 1.1)
                    along += (width + gap) * self.m
                    for hand in (-1, 1):
                        depth = deep * rng.uniform(0.8, 1.2)
                        off = (road_m / 2 + setback + depth / 2) * self.m * hand
                        x, y = a + ahead * along + off * np.array([-ahead[1], ahead[0]])
                        if 0 <= x < self.size and 0 <= y < self.size and rng.random() < full * min(2 * density, 1):
                            number += 1
                            yield int(x), int(y), float(np.arctan2(ahead[1], ahead[0])), width * self.m, depth * self.m

    def plant(self, density: float) -> None:
        """Plant trees: in yards, in rows along roads, in woods; each throws a shadow."""
        rng = self.rng
        number = min(int(density * (self.size / self.m) ** 2 / 250), 2500)
        woods = cv2.resize(
            rng.normal(0, 1, (6, 6)).astype(np.float32), (self.size, self.size), interpolation=cv2.INTER_CUBIC
        )
        distance, crowns = self._from_road(), []
        least = rng.choice([-1.0, 0.5, 2.5, 5.0]) * self.m  # how far they keep off the roads
        lush = rng.uniform(-0.8, 0.6)
        at = rng.integers(self.size, size=(number, 2))
        rows = np.argwhere((distance > 0.5 * self.m) & (distance < 6 * self.m))
        if len(rows) and rng.random() < 0.6:
            at = np.concatenate([at, rows[rng.integers(len(rows), size=number // 5)]])
        hues = rng.choice(len(CROWNS), size=3, replace=False)
        for y, x in at:
            beside = distance[y, x] < 8 * self.m
            if distance[y, x] < least or (not beside and woods[y, x] < lush and rng.random() < 0.8):
                continue
            if self.taken[y, x] and rng.random() < 0.9:
                continue
            crowns.append((x, y, max(0.8, rng.uniform(1.5, 5.5) * self.m), rng.uniform(4, 14), hues[rng.integers(3)]))
        for x, y, radius, height, _ in crowns:
            dx, dy = self.sun.per_metre * height
            cv2.circle(self.shadow, (int(x + dx), int(y + dy)), int(radius), 255, -1, cv2.LINE_AA)
        self._cast()
        light = -self.sun.per_metre / max(float(np.hypot(*self.sun.per_metre)), 1e-6)
        for x, y, radius, _, hue in crowns:
            colour = np.array(CROWNS[hue], np.float32) * rng.uniform(0.75, 1.25)
            cv2.circle(self.photo, (int(x), int(y)), int(radius), tuple(map(float, colour)), -1, cv2.LINE_AA)
            if radius > 2:
                lit = int(x + light[0] * radius * 0.3), int(y + light[1] * radius * 0.3)
                cv2.circle(self.photo, lit, int(radius * 0.6), tuple(map(float, (colour * 1.25).clip(0, 255))), -1)

    def _cast(self) -> None:
        """Darken what lies in shadow, softly at the edge, and begin anew."""
        if not self.shadow.any():
            return
        share = cv2.GaussianBlur(self.shadow, (0, 0), 0.8).astype(np.float32)[..., None] / 255
        self.photo = (self.photo * (1 - share * (1 - self.sun.shade))).clip(0, 255).astype(np.uint8)
        self.shadow[:] = 0

    def _from_road(self) -> Floats:
        if self._distance is None:
            away = cv2.distanceTransform(1 - self.road, cv2.DIST_L2, 5) if self.road.any() else None
            self._distance = np.full(self.road.shape, 50 * self.m, np.float32) if away is None else away
        return self._distance

    def _across(self) -> Floats:
        """Return (S, S, 2): the direction away from the nearest road, or across the road."""
        inside = cv2.distanceTransform(self.road, cv2.DIST_L2, 5) if self.road.any() else 0
        smooth = cv2.GaussianBlur(self._from_road() - inside, (0, 0), max(1.0, 2 * self.m))
        return np.dstack([cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)])

    def _spots(self, number: int) -> list[tuple[int, int, float, float]]:
        """Return places off the roads: x, y, the angle along the nearest road, the distance from it, pixels."""
        distance, across = self._from_road(), self._across()
        ys, xs = self.rng.integers(self.size, size=(2, number))
        return [
            (int(x), int(y), float(np.arctan2(across[y, x, 1], across[y, x, 0])) + np.pi / 2, float(distance[y, x]))
            for y, x in zip(ys, xs, strict=True)
            if distance[y, x] > 0
        ]

    def _take(self, x: int, y: int, angle: float, width: float, depth: float, slack: float) -> bool:
        """Take ground, unless it is taken or a road's."""
        ring = _box(x, y, angle, width * slack, depth * slack) // 16
        points = np.concatenate([ring, (ring + np.roll(ring, 1, 0)) // 2, [[x, y]]])
        points = points[((points >= 0) & (points < self.size)).all(1)]
        if self.taken[points[:, 1], points[:, 0]].any() or (self._from_road()[points[:, 1], points[:, 0]] < 1).any():
            return False
        cv2.fillPoly(self.taken, [ring], 1)
        return True

    def _fill(self, ring: NDArray[np.int32], colour: object) -> None:
        cv2.fillPoly(self.photo, [ring], tuple(float(min(c, 255)) for c in colour), cv2.LINE_AA, 4)  # type: ignore[attr-defined]

    def _plain(self, colour: Floats, rough: float) -> Bytes:
        return self._rough(np.broadcast_to(colour, self.photo.shape).astype(np.float32), rough / 2, rough)

    def finish(self) -> tuple[Bytes, Bytes]:
        """Return the picture and its truth."""
        if self.given is not None:
            void = self.given[..., 1] < 128
            self.photo[void] = 255
            return self.photo, self.given
        if self.rng.random() < 0.6:
            self.photo = cv2.GaussianBlur(self.photo, (0, 0), self.rng.uniform(0.3, 0.9))
        return self.photo, truth_of(self.road > 0, np.ones_like(self.road, bool), self.known > 0)


def _box(x: float, y: float, angle: float, width: float, depth: float) -> NDArray[np.int32]:
    """Return the corners of a rectangle, `width` along `angle`, (4, 2) in 1/16 pixel."""
    c, s = np.cos(angle), np.sin(angle)
    corners = np.array([[-width, -depth], [width, -depth], [width, depth], [-width, depth]]) / 2
    return np.rint((corners @ np.array([[c, s], [-s, c]]) + (x, y)) * 16).astype(np.int32)


@cache
def _noise() -> tuple[Floats, Floats]:
    """Return fine and broad noise of about unit strength, the same in every process."""
    rng, side = np.random.default_rng(0), 1600
    fine = cv2.GaussianBlur(rng.normal(0, 1, (side, side)).astype(np.float32), (0, 0), 0.7) * 2.2
    broad = np.zeros_like(fine)
    for cells in (12, 25, 50, 100, 200):
        broad += cv2.resize(
            rng.normal(0, 0.5, (cells, cells)).astype(np.float32), (side, side), interpolation=cv2.INTER_CUBIC
        )
    return fine, broad


@contextmanager
def painted(painter: Painter, workers: int, seed: int, photographs: float = 0.4) -> Iterator[Iterator[Bytes | None]]:
    """Yield what yields pictures, (S, S, 8), that processes paint ahead, and None where none is ready.

    Without workers each is painted when it is asked for. A share of them are photographs that were painted over.
    """

    def paint(number: int) -> Bytes:
        rng = np.random.default_rng((seed, number))
        return np.dstack(painter.photograph(rng) if rng.random() < photographs else painter.scene(rng))

    if not workers:
        yield (paint(number) for number in range(1 << 62))
        return
    context, slots = multiprocessing.get_context("fork"), 4 * workers
    shape = (slots, painter.size, painter.size, 8)
    room = np.frombuffer(mmap.mmap(-1, int(np.prod(shape))), np.uint8).reshape(shape)  # shared with the processes
    free, done = context.SimpleQueue(), context.SimpleQueue()

    def work(worker: int) -> None:
        cv2.setNumThreads(1)
        os.nice(5)
        for number in range(worker, 1 << 62, workers):
            slot = free.get()
            picture = paint(number)
            room[slot, : picture.shape[0], : picture.shape[1]] = picture
            done.put(slot)

    def collect() -> Iterator[Bytes | None]:
        while True:
            if done.empty():
                yield None
                continue
            slot = done.get()
            yield room[slot]
            free.put(slot)

    for slot in range(slots):
        free.put(slot)
    processes = [context.Process(target=work, args=(worker,), daemon=True) for worker in range(workers)]
    for process in processes:
        process.start()
    try:
        yield collect()
    finally:
        for process in processes:
            process.terminate()
