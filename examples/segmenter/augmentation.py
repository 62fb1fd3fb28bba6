"""Crops of pictures as other cameras, heights, seasons and decades would show them; many at a time, on any device.

34 photographs of one survey are few: the network learns nothing that it does not see here. Everything is done
in PyTorch where the network trains, for processors would draw crops more slowly than an accelerator learns from them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from tiles import Bytes, Tile
from torch import Tensor
from torch.nn import functional

__all__ = ["Crops"]

CHANNELS = 8  # red, green, blue, and the five of `tiles.truth_of`
LEVELS = 3  # each picture at its own size, at a half and at a quarter: bilinear sampling alone would skip pixels
TRIES = 4  # views drawn for a crop, of which the first counts that shows ground


@dataclass
class _Pictures:
    """Pictures of any sizes in one array of bytes, each with its smaller copies."""

    pixels: Tensor  # (N, 8) uint8
    table: Tensor  # (P, LEVELS, 3) int64: first pixel, rows, columns
    known: list[list[tuple[int, int, int]]]  # the same on this side

    def put(self, index: int, picture: Bytes) -> None:
        """Replace a picture by one of the same size."""
        item = torch.from_numpy(picture).to(self.pixels.device)
        for (start, rows, columns), values in zip(self.known[index], _smaller(item), strict=True):
            self.pixels[start : start + rows * columns] = values.reshape(-1, CHANNELS)

    @classmethod
    def hold(cls, sizes: Sequence[tuple[int, int]], device: str) -> _Pictures:
        table, start = [], 0
        for rows, columns in sizes:
            levels = []
            for level in range(LEVELS):
                h, w = rows >> level, columns >> level
                levels.append((start, h, w))
                start += h * w
            table.append(levels)
        pixels = torch.zeros(start, CHANNELS, dtype=torch.uint8, device=device)
        return cls(pixels, torch.tensor(table, device=device), table)

    def sample(self, index: Tensor, level: Tensor, x: Tensor, y: Tensor) -> Tensor:
        """Return (B, 8, ...) 0..1 at (B, ...) places of the pictures at a level; the truth is 0 outside of them."""
        start, rows, columns = (part.view(-1, *[1] * (x.ndim - 1)) for part in self.table[index, level].unbind(1))
        inside = (x >= -0.5) & (y >= -0.5) & (x <= columns - 0.5) & (y <= rows - 0.5)
        x, y = _reflect(x, columns), _reflect(y, rows)
        left, top = x.floor(), y.floor()
        fx, fy = (x - left).unsqueeze(-1), (y - top).unsqueeze(-1)
        left, top = left.long(), top.long()
        right, below = (left + 1).minimum(columns - 1), (top + 1).minimum(rows - 1)
        above, under = start + top * columns, start + below * columns
        value = torch.lerp(
            torch.lerp(self.pixels[above + left].float(), self.pixels[above + right].float(), fx),
            torch.lerp(self.pixels[under + left].float(), self.pixels[under + right].float(), fx),
            fy,
        )
        value = value.movedim(-1, 1) / 255
        value[:, 3:7] *= inside.unsqueeze(1)
        value[:, 7].masked_fill_(~inside, 1.0)  # that there is no road outside is known
        return value


class Crops:
    """Draws augmented crops of photographs, and of painted scenes that come and go."""

    def __init__(
        self,
        tiles: list[Tile],
        size: int,
        *,
        scales: tuple[float, float] = (0.75, 1.6),  # metres per pixel of most crops, of photographs of 1 m
        scenes: int = 0,
        scene_size: int = 768,
        device: str = "cpu",
        seed: int = 0,
    ) -> None:
        self.size, self.scales, self.n_tiles, self.device = size, scales, len(tiles), device
        self.rng = torch.Generator(device).manual_seed(seed)
        self._host = np.random.default_rng(seed)  # numbers that are needed on this side
        sizes = [(tile.photo.shape[0], tile.photo.shape[1]) for tile in tiles]
        self.pictures = _Pictures.hold([*sizes, *[(scene_size, scene_size)] * scenes], device)
        for i, tile in enumerate(tiles):
            self.pictures.put(i, np.dstack([tile.photo, tile.truth]))
        # A tile counts by the ground it shows, and more where there are roads to learn from.
        weights = [t.observed.mean() * (0.3 + min((t.road & t.observed).mean() / 0.02, 1.0)) for t in tiles]
        self._weights = torch.tensor(np.array(weights), dtype=torch.float32, device=device)
        self._ground = _places([t.observed for t in tiles], device)
        self._roads = _places([t.road & t.observed for t in tiles], device)
        self._scene_size, self._room, self._put = scene_size, scenes, 0

    def put(self, picture: Bytes) -> None:
        """Add a scene, (S, S, 8): photograph and truth. The oldest goes where there is no room."""
        self.pictures.put(self.n_tiles + self._put % self._room, picture)
        self._put += 1

    @property
    def n_put(self) -> int:
        """How many scenes have been put."""
        return self._put

    def draw(self, number: int, share: float = 0.0) -> tuple[Tensor, Tensor]:
        """Return photographs (B, 3, S, S), 0..1, and truths (B, 5, S, S), of which a share are of scenes."""
        index, middle, scale = self._choose(number, share)
        # From scale 1.5 on of the half, from 3 on of the quarter.
        level = (scale / 1.5).log2().floor().add(1).clamp(0, LEVELS - 1).long()
        shrunk = 2.0**level
        matrix = self._place(index, level, shrunk, middle, scale)
        line = torch.arange(self.size, device=self.device, dtype=torch.float32)
        y, x = torch.meshgrid(line, line, indexing="ij")
        seen = self.pictures.sample(index, level, *_view(matrix, x, y, shrunk))
        photo, truth = seen[:, :3], seen[:, 3:].contiguous()
        look = _Look(self.rng, self._host, number, self.size, self.device)
        photo = look.cover(photo, truth)
        photo = look.recolour(photo)
        photo = look.degrade(photo)
        return look.mark_voids(photo, truth), truth

    def _choose(self, number: int, share: float) -> tuple[Tensor, Tensor, Tensor]:
        """Return pictures, the middles of views of them, (B, TRIES, 2), and metres per pixel of each crop."""
        held = min(self._put, self._room)
        painted = round(number * share) if held else 0
        real = number - painted
        index = torch.multinomial(self._weights, real, replacement=True, generator=self.rng)
        chance, at_road = self._uniform(real), self._uniform(real, 1) < 0.5
        middle = torch.where(
            at_road[..., None], self._draw_places(self._roads, index), self._draw_places(self._ground, index)
        )
        narrow = self._uniform(real, low=math.log(self.scales[0]), high=math.log(self.scales[1]))
        scale = torch.where(chance < 0.7, narrow, self._uniform(real, low=-0.9, high=1.4))
        if painted:
            scenes = self.n_tiles + torch.randint(held, (painted,), generator=self.rng, device=self.device)
            index = torch.cat([index, scenes])
            # Scenes are painted at 0.4 to 1.9 m per pixel.
            scale = torch.cat([scale, self._uniform(painted, low=math.log(0.75), high=math.log(1.8))])
            middle = torch.cat([middle, self._scene_size * self._uniform(painted, TRIES, 2, low=0.3, high=0.7)])
        return index, middle + self._uniform(number, TRIES, 2, low=-60, high=60), scale.exp()

    def _draw_places(self, places: tuple[Tensor, Tensor, Tensor], index: Tensor) -> Tensor:
        """Return (N, TRIES, 2): places in pictures."""
        xy, start, count = places
        chosen = start[index, None] + (self._uniform(len(index), TRIES) * count[index, None]).long()
        return xy[chosen.clamp(max=len(xy) - 1)]

    def _place(self, index: Tensor, level: Tensor, shrunk: Tensor, middle: Tensor, scale: Tensor) -> Tensor:
        """Return homographies from crop pixels to pixels of the whole picture, (B, 3, 3), that show ground."""
        n = len(index)
        views = torch.stack([self._homography(middle[:, k], scale) for k in range(TRIES)], 1)
        grid = torch.linspace(0, self.size - 1, 10, device=self.device)
        y, x = torch.meshgrid(grid, grid, indexing="ij")
        shares = []
        for k in range(TRIES):
            seen = self.pictures.sample(index, level, *_view(views[:, k], x, y, shrunk))
            shares.append((seen[:, 4] > 0.5).float().mean((1, 2)))
        good = torch.stack(shares, 1)
        best = torch.where(good > 0.7, 2.0 - 0.1 * torch.arange(TRIES, device=self.device), good).argmax(1)
        return views[torch.arange(n, device=self.device), best]

    def _homography(self, middle: Tensor, scale: Tensor) -> Tensor:
        n = len(middle)
        straight = self._uniform(n) < 0.3
        quarters = torch.randint(4, (n,), generator=self.rng, device=self.device) * (math.pi / 2)
        angle = torch.where(straight, quarters, self._uniform(n, high=2 * math.pi))
        stretch = torch.where(straight, 1.0, (0.06 * self._normal(n)).exp())
        mirrored = torch.where(self._uniform(n) < 0.5, -1.0, 1.0)
        across, along = scale * stretch * mirrored, scale / stretch
        tilt = (0.12 * self._normal(n, 2)).clamp(-0.25, 0.25) / self.size * ~straight[:, None]
        c, s, half = angle.cos(), angle.sin(), (self.size - 1) / 2
        ones = torch.ones_like(c)
        view = torch.stack(
            [c * across, -s * along, 0 * c, s * across, c * along, 0 * c, tilt[:, 0], tilt[:, 1], ones], 1
        )
        view = view.view(n, 3, 3)
        view[:, :2] += middle[:, :, None] * view[:, 2:]
        to_middle = torch.tensor([[1, 0, -half], [0, 1, -half], [0, 0, 1]], device=self.device)
        return view @ to_middle

    def _uniform(self, *shape: int, low: float = 0.0, high: float = 1.0) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=self.rng, device=self.device)

    def _normal(self, *shape: int) -> Tensor:
        return torch.randn(*shape, generator=self.rng, device=self.device)


class _Look:
    """Draws how a batch of pictures looks."""

    def __init__(self, rng: torch.Generator, host: np.random.Generator, n: int, size: int, device: str) -> None:
        self.rng, self.host, self.n, self.size, self.device = rng, host, n, size, device

    def uniform(self, low: float = 0.0, high: float = 1.0, *shape: int) -> Tensor:
        shape = shape or (self.n, 1, 1, 1)
        return low + (high - low) * torch.rand(shape, generator=self.rng, device=self.device)

    def normal(self, *shape: int) -> Tensor:
        return torch.randn(shape, generator=self.rng, device=self.device)

    def happens(self, chance: float) -> Tensor:
        return self.uniform() < chance

    def some(self, share: float) -> Tensor:
        """Return the indices of a share of the pictures, one or more: slow steps are applied to these alone."""
        chosen = self.host.permutation(self.n)[: max(1, round(share * self.n))]
        return torch.from_numpy(chosen).to(self.device)

    def cloud(self, number: int, cells: int) -> Tensor:
        """Return (N, 1, S, S) of smooth noise of about unit strength."""
        coarse = self.normal(number, 1, cells, cells)
        return functional.interpolate(coarse, size=(self.size, self.size), mode="bicubic", align_corners=False)

    def cover(self, photo: Tensor, truth: Tensor) -> Tensor:
        """Cover ground in spots, pieces of road too, with other parts of the picture: trees, shadows, roofs."""
        some = self.some(0.4)
        n, own = len(some), photo[some]
        shift = self.host.integers(self.size // 4, 3 * self.size // 4, 2).tolist()
        other, beside = own.roll(shift, (2, 3)), truth[some, :2].roll(shift, (2, 3))
        spots = 0.8 * (self.cloud(n, self.size // 12) + self.cloud(n, self.size // 28))
        spots = ((spots - self.uniform(1.1, 2.2, n, 1, 1, 1)) * 4).sigmoid()
        share = spots * (1 - beside[:, :1]) * (beside[:, 1:] > 0.9)
        in_shadow = self.uniform(0, 1, n, 1, 1, 1) < 0.4
        other = torch.where(in_shadow, own * self.uniform(0.3, 0.6, n, 1, 1, 1), other)
        photo[some] = torch.lerp(own, other, share)
        return photo

    def recolour(self, photo: Tensor) -> Tensor:
        """Change light, contrast and colours: other films, seasons, hours, haze, lenses."""
        kind = self.uniform()
        grey = (photo * torch.tensor([0.299, 0.587, 0.114], device=self.device).view(1, 3, 1, 1)).sum(1, keepdim=True)
        colourful = torch.where(kind < 0.15, 0.0, torch.where(kind < 0.6, self.uniform(0.3, 1.5), 1.0))
        photo = grey + colourful * (photo - grey)
        order = torch.rand(self.n, 3, generator=self.rng, device=self.device).argsort(1)
        order = torch.where(self.happens(0.05)[:, 0, 0], order, torch.arange(3, device=self.device))
        photo = photo.gather(1, order[:, :, None, None].expand_as(photo))
        tint = self.happens(0.6) * (kind >= 0.15)
        photo = photo * (1 + tint * 0.08 * self.normal(self.n, 3, 1, 1)) + tint * 0.02 * self.normal(self.n, 3, 1, 1)
        changed = self.happens(0.8)
        contrast = (changed * 0.25 * self.normal(self.n, 1, 1, 1)).exp()
        light = (changed * 0.22 * self.normal(self.n, 1, 1, 1)).exp()
        middle = photo.mean((1, 2, 3), keepdim=True)
        photo = contrast * (photo - middle) + middle * light
        haze = self.happens(0.15) * self.uniform(0.1, 0.5)
        photo = (1 - haze) * photo + haze * self.uniform(0.6, 0.95)
        photo = photo.clamp(1e-4, 1).pow((self.happens(0.4) * 0.3 * self.normal(self.n, 1, 1, 1)).exp())
        some = self.some(0.25)
        photo[some] *= (0.22 * self.cloud(len(some), 4)).exp().clamp(0.4, 2.0)
        line = torch.linspace(-1, 1, self.size, device=self.device)
        radius = line[:, None] ** 2 + line**2
        return photo * (1 - self.happens(0.1) * self.uniform(0.1, 0.35) * radius)

    def degrade(self, photo: Tensor) -> Tensor:
        """Blur, sharpen, coarsen, add grain and scratches, compress."""
        blurred, sharpened = self.some(0.2), self.some(0.2)
        photo[blurred] = _blur(photo[blurred], self.uniform(0.4, 1.7, len(blurred)))
        own, far = photo[sharpened], self.uniform(0.7, 1.5, len(sharpened))
        photo[sharpened] = own + self.uniform(0.3, 1.6, len(own), 1, 1, 1) * (own - _blur(own, far))
        some, small = self.some(0.15), int(self.size / self.host.uniform(1.2, 2.4))
        coarse = functional.interpolate(photo[some], size=(small, small), mode="area")
        photo[some] = functional.interpolate(coarse, size=photo.shape[2:], mode="bilinear", align_corners=False)
        for some, channels in ((self.some(0.15), 1), (self.some(0.15), 3)):
            grain = self.normal(len(some), channels, self.size, self.size)
            photo[some] += self.uniform(0.01, 0.07, len(some), 1, 1, 1) * grain
        some = self.some(0.06)
        photo[some] = self._scratch(photo[some])
        some, photo = self.some(0.35), photo.clamp(0, 1)
        photo[some] = _compress(photo[some], self.uniform(0.4, 4.0, len(some)))
        return photo.clamp(0, 1)

    def _scratch(self, photo: Tensor) -> Tensor:
        line, item = torch.linspace(-1, 1, self.size, device=self.device), (len(photo), 1, 1, 1)
        for _ in range(2):
            angle, offset = self.uniform(0, math.pi, *item), self.uniform(-0.9, 0.9, *item)
            distance = (angle.cos() * line + angle.sin() * line[:, None] - offset).abs()
            photo = torch.where(distance < self.uniform(0.5, 2.0, *item) / self.size, self.uniform(0, 1, *item), photo)
        return photo

    def mark_voids(self, photo: Tensor, truth: Tensor) -> Tensor:
        """Paint what was not observed white, black or plain; now and then blot out a box more. Changes `truth`."""
        line = torch.arange(self.size, device=self.device, dtype=torch.float32)
        inside = self.happens(0.1)
        for axis in (line, line[:, None]):
            start, length = self.uniform(0, self.size), self.uniform(20, self.size / 3)
            inside = inside & (axis >= start) & (axis < start + length)
        truth[:, 1:2] *= ~inside
        kind = self.uniform()
        colour = torch.where(kind < 0.5, 1.0, torch.where(kind < 0.75, 0.0, self.uniform()))
        return torch.where(truth[:, 1:2] > 0.5, photo, colour)


def _places(flags: list[NDArray[np.bool_]], device: str) -> tuple[Tensor, Tensor, Tensor]:
    """Return (N, 2) x, y of every fourth pixel along a side that is flagged, and each picture's first and number."""
    found = [np.argwhere(flag[::4, ::4])[:, ::-1] * 4.0 for flag in flags]
    found = [
        result if len(result) else np.array([[f.shape[1] / 2, f.shape[0] / 2]])
        for result, f in zip(found, flags, strict=True)
    ]
    count = np.array([len(result) for result in found])
    xy = torch.from_numpy(np.concatenate(found)).float().to(device)
    return xy, torch.from_numpy(count.cumsum() - count).to(device), torch.from_numpy(count).to(device)


def _view(matrix: Tensor, x: Tensor, y: Tensor, shrunk: Tensor) -> tuple[Tensor, Tensor]:
    """Return where the crop's pixels lie in a picture that many times smaller, (B, H, W) each."""
    a = matrix.view(-1, 9, 1, 1).unbind(1)
    w = a[6] * x + a[7] * y + a[8]
    shrunk = shrunk.view(-1, 1, 1)
    return tuple((row / w + 0.5) / shrunk - 0.5 for row in (a[0] * x + a[1] * y + a[2], a[3] * x + a[4] * y + a[5]))


def _smaller(picture: Tensor) -> list[Tensor]:
    """Return (H, W, 8) at its own size, at a half, ...: each pixel the mean of four."""
    levels = [picture]
    for _ in range(LEVELS - 1):
        whole = levels[-1].movedim(2, 0)[None].float()
        levels.append(functional.avg_pool2d(whole, 2)[0].round().to(torch.uint8).movedim(0, 2))
    return levels


def _reflect(x: Tensor, length: Tensor) -> Tensor:
    """Return coordinates mirrored at both ends until they lie within."""
    last = (length - 1).float()
    return last - (last - x.abs().remainder(2 * last)).abs()


def _blur(photo: Tensor, sigma: Tensor) -> Tensor:
    """Blur each picture by a Gaussian of its own."""
    n, channels, h, w = photo.shape
    reach = torch.arange(-5, 6, device=photo.device)
    kernel = torch.exp(-0.5 * (reach / sigma.clamp(min=1e-3)[:, None]) ** 2)
    kernel = (kernel / kernel.sum(1, keepdim=True)).repeat_interleave(channels, 0)
    padded = functional.pad(photo, (5, 5, 5, 5), mode="reflect").reshape(1, n * channels, h + 10, w + 10)
    rows = functional.conv2d(padded, kernel[:, None, :, None], groups=n * channels)
    return functional.conv2d(rows, kernel[:, None, None, :], groups=n * channels).view(n, channels, h, w)


#: JPEG's table of steps for brightness, of quality 50.
_STEPS = (
    *((16, 11, 10, 16, 24, 40, 51, 61), (12, 12, 14, 19, 26, 58, 60, 55), (14, 13, 16, 24, 40, 57, 69, 56)),
    *((14, 17, 22, 29, 51, 87, 80, 62), (18, 22, 37, 56, 68, 109, 103, 77), (24, 35, 55, 64, 81, 104, 113, 92)),
    *((49, 64, 78, 87, 103, 121, 120, 101), (72, 92, 95, 98, 112, 100, 103, 99)),
)


def _compress(photo: Tensor, coarser: Tensor) -> Tensor:
    """Return pictures as JPEG leaves them: cosines of blocks of 8 x 8 in whole steps, colour in coarser ones."""
    n, channels, h, w = photo.shape
    k = torch.arange(8, device=photo.device, dtype=torch.float32)
    cosines = torch.cos((2 * k + 1) * k[:, None] * math.pi / 16) * 0.5
    cosines[0] /= math.sqrt(2)
    waves = torch.kron(cosines, cosines)  # (64, 64): each row a wave of a block
    to_luma = torch.tensor([[0.299, 0.587, 0.114], [-0.169, -0.331, 0.5], [0.5, -0.419, -0.081]], device=photo.device)
    steps = torch.tensor(_STEPS, device=photo.device, dtype=torch.float32).flatten() / 255
    steps = torch.stack([steps, 1.5 * steps, 1.5 * steps])[None, :, None] * coarser.view(n, 1, 1, 1)
    luma = (to_luma @ photo.flatten(2)).view(n, channels, h // 8, 8, w // 8, 8)
    blocks = luma.transpose(3, 4).reshape(n, channels, -1, 64)
    blocks = ((blocks @ waves.T) / steps).round() * steps @ waves
    luma = blocks.view(n, channels, h // 8, w // 8, 8, 8).transpose(3, 4).reshape(n, channels, h * w)
    return (torch.linalg.inv(to_luma) @ luma).view(n, channels, h, w)
