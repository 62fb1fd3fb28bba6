"""A photograph, read strip by strip at any scale: RGB of 8 bits, and where it shows ground at all."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, BoolArray
from roadgeo.errors import MaskError
from roadgeo.storage.rasters import MAX_SIDE, open_raster, page_of, read_palette

if TYPE_CHECKING:
    from rasterio import DatasetReader

__all__ = ["Photograph", "find_ground", "find_voids", "open_photograph"]

MIN_SIDE = 64
_STRIP_PIXELS = 1 << 21  # read at a time
_SAMPLE_SIDE = 1024  # deep values are stretched by the range of a sample of this size

#: A void is a plain white or black area (JPEG smears its values and its edge), larger than any white roof.
_WHITE, _BLACK = 250, 3
_DARKEST, _LIGHTEST = 8, 245  # of stretched values
_FEW_VALUES = (
    64  # 8-bit values that span less, but for half a hundredth at either end, are stretched: night, haze, a flat scan
)
_SHOWN_SHARE = 0.1  # of a frame that is not filled, at least
_FILLED_SHARE = 0.01  # of the frame that has the least or the greatest value, at least, where it is a fill
_VOID_CORE_PX, _VOID_AREA_PX, _VOID_EDGE_PX = 15, 20_000, 9


@dataclass(frozen=True)
class Photograph:
    """An open photograph.

    Attributes
    ----------
    name : str
    width, height : int
        Pixels.
    read : callable
        `read(left, top, width, height, shape)` returns this part of it, in its own pixels, as (H, W, 3) uint8 RGB of
        the given shape (H, W), and as (H, W) bool where it is not nodata.
    page : str
        Page of a file with several, for people.
    """

    name: str
    width: int
    height: int
    read: Callable[[float, float, float, float, tuple[int, int]], tuple[AnyArray, BoolArray]]
    page: str = ""

    def stretched(self, wide: float, high: float) -> Photograph:
        """Return the same with these numbers of columns and rows for each of its own."""

        def read(
            left: float, top: float, width: float, height: float, shape: tuple[int, int]
        ) -> tuple[AnyArray, BoolArray]:
            return self.read(left / wide, top / high, width / wide, height / high, shape)

        return replace(self, width=round(wide * self.width), height=round(high * self.height), read=read)


@contextmanager
def open_photograph(path: str | os.PathLike[str], bands: tuple[int, int, int] | None = None) -> Iterator[Photograph]:
    """Open a photograph.

    Parameters
    ----------
    bands : (3,) tuple of int, optional
        Numbers from 1 of the red, green and blue band. Default: by their names, or else the first three.

    Raises
    ------
    MaskError
        It is missing, no raster, too small or too large, or has no bands of colour or grey.
    """
    name = os.fspath(path)
    with open_raster(path) as dataset:
        if min(dataset.shape) < MIN_SIDE or max(dataset.shape) > MAX_SIDE:
            raise MaskError(
                f"{name}: {dataset.width} x {dataset.height} pixels; expected {MIN_SIDE} to {MAX_SIDE} on each side"
            )
        chosen = _choose_bands(dataset, name) if bands is None else _require_bands(dataset, name, bands)
        stretch = _find_stretch(dataset, chosen, name)
        turn = 255 if dataset.tags(ns="IMAGE_STRUCTURE").get("MINISWHITE") == "YES" else 0  # a negative, by its tag

        @lru_cache(maxsize=1)  # where there is ground is found first, and a picture of one tile is that read again
        def read(
            left: float, top: float, width: float, height: float, shape: tuple[int, int]
        ) -> tuple[AnyArray, BoolArray]:
            values, valid = _read(dataset, chosen, (left, top, width, height), shape)
            return stretch(values) ^ np.uint8(turn), valid

        yield Photograph(name, dataset.width, dataset.height, read, page_of(dataset))


def _choose_bands(dataset: DatasetReader, name: str) -> list[int]:
    """Return the numbers of the red, green and blue band, or one of grey."""
    from rasterio.enums import ColorInterp

    meaning = dict(zip(dataset.colorinterp, dataset.indexes, strict=True))
    named = {str(text).strip().lower(): i for text, i in zip(dataset.descriptions, dataset.indexes, strict=True)}
    for known in (named, {colour.name: i for colour, i in meaning.items()}):
        if {"red", "green", "blue"} <= known.keys():
            return [known["red"], known["green"], known["blue"]]
    shown = [i for i, m in zip(dataset.indexes, dataset.colorinterp, strict=True) if m != ColorInterp.alpha]
    if not shown:
        raise MaskError(f"{name}: holds no band of values; give a photograph")
    return shown[:3] if len(shown) >= 3 else shown[:1]


def _require_bands(dataset: DatasetReader, name: str, bands: Sequence[int]) -> list[int]:
    """Return the bands that were asked for, if there are such."""
    missing = next((band for band in bands if not 1 <= band <= dataset.count), None)
    if missing is not None:
        raise MaskError(f"{name}: has no band {missing}; expected 1 to {dataset.count}")
    return list(bands)


def _read(
    dataset: DatasetReader,
    bands: list[int],
    part: tuple[float, float, float, float],
    shape: tuple[int, int],
    nearest: bool = False,
) -> tuple[AnyArray, BoolArray]:
    """Read a part as (H, W, B) values and (H, W) validity; averaged where it is reduced, or `nearest` values."""
    from rasterio.enums import Resampling
    from rasterio.windows import Window

    window = Window(*part)
    reduced = part[3] > shape[0]
    resampling = Resampling.nearest if nearest else Resampling.average if reduced else Resampling.bilinear
    values = dataset.read(bands, window=window, out_shape=(len(bands), *shape), resampling=resampling)
    valid = dataset.dataset_mask(window=window, out_shape=shape) > 0
    if values.dtype.kind == "f":
        valid &= np.isfinite(values).all(axis=0)
    return np.moveaxis(values, 0, 2), valid


def _find_stretch(dataset: DatasetReader, bands: list[int], name: str) -> Callable[[AnyArray], AnyArray]:
    """Return a function from (H, W, B) values to (H, W, 3) 8-bit RGB."""
    palette = read_palette(dataset) if dataset.count == 1 and dataset.dtypes[0] == "uint8" else None
    if palette is not None:
        table = palette
        return lambda values: table[values[..., 0]]
    kind = dataset.dtypes[bands[0] - 1]
    scale = max(dataset.shape) / _SAMPLE_SIDE
    shape = max(1, round(dataset.height / max(scale, 1))), max(1, round(dataset.width / max(scale, 1)))
    whole = (0, 0, dataset.width, dataset.height)
    (sample, valid), (exact, _) = (_read(dataset, bands, whole, shape, nearest) for nearest in (False, True))
    if not valid.any():
        raise MaskError(f"{name}: holds no observed pixel; give a photograph that shows ground")
    fills = _find_fills(exact[valid])
    shown = valid & ~np.isin(exact, fills).all(axis=2)
    if shown.sum() < _SHOWN_SHARE * valid.sum():
        fills, shown = [], valid
    seen = sample[shown].astype(np.float64)
    low, high = np.percentile(seen, [1, 99])
    if kind == "uint8" and not 0 < np.ptp(np.percentile(seen, [0.5, 99.5])) < _FEW_VALUES:
        return _as_rgb

    def stretch(values: AnyArray) -> AnyArray:
        scaled = (np.nan_to_num(values.astype(np.float32)) - low) / max(high - low, 1e-9)
        # Neither black nor white, which would mean that there is no photograph.
        found = np.clip(_DARKEST + (_LIGHTEST - _DARKEST) * scaled, _DARKEST, _LIGHTEST).astype(np.uint8)
        for fill in fills:
            found[(values == fill).all(axis=2)] = 255 if fill > high else 0
        return _as_rgb(found)

    return stretch


def _find_fills(seen: AnyArray) -> list[float]:
    """Return the least and the greatest of (n, B) values where many pixels have it in all bands: a fill, maybe."""
    ends = (float(seen.min()), float(seen.max()))
    return [end for end in ends if (seen == end).all(axis=1).mean() > _FILLED_SHARE]


def _as_rgb(values: AnyArray) -> AnyArray:
    return values if values.shape[2] == 3 else np.repeat(values, 3, axis=2)


def find_ground(photograph: Photograph, shape: tuple[int, int]) -> BoolArray:
    """Return where a photograph shows ground: neither nodata nor part of a void. On a grid of (H, W) pixels."""
    height, width = shape
    ground, white, black = (np.empty(shape, np.bool_) for _ in range(3))
    pixel = photograph.height / height
    n_rows = max(1, _STRIP_PIXELS // width)
    for top in range(0, height, n_rows):
        strip = slice(top, min(top + n_rows, height))
        rows = strip.stop - top
        rgb, ground[strip] = photograph.read(0.0, top * pixel, float(photograph.width), rows * pixel, (rows, width))
        white[strip], black[strip] = is_plain(rgb)
    ground &= ~find_voids(white, black)
    return ground


def find_voids(white: BoolArray, black: BoolArray) -> BoolArray:
    """Return (H, W) where there is no photograph, given where it is as good as white and as good as black.

    Only large plain areas count; a little of their edge, which is smeared, goes with them.
    """
    void = np.zeros(white.shape, np.uint8)
    for plain in (white, black):
        if np.count_nonzero(plain) < min(_VOID_AREA_PX, plain.size // 10):
            continue
        core = np.ones((_VOID_CORE_PX, _VOID_CORE_PX), np.uint8)
        opened = cv2.morphologyEx(plain.view(np.uint8), cv2.MORPH_OPEN, core)
        _, labels, stats, _ = cv2.connectedComponentsWithStats(opened, ltype=cv2.CV_32S)
        large = stats[:, cv2.CC_STAT_AREA] >= min(_VOID_AREA_PX, plain.size // 10)
        large[0] = False
        void |= large[labels].view(np.uint8)
    if not void.any():
        return void.view(np.bool_)
    grown: AnyArray = cv2.dilate(void, np.ones((_VOID_EDGE_PX, _VOID_EDGE_PX), np.uint8))
    return grown.view(np.bool_)


def is_plain(rgb: AnyArray) -> tuple[BoolArray, BoolArray]:
    """Return where (H, W, 3) RGB is as good as white, and as good as black."""
    return rgb.min(axis=2) >= _WHITE, rgb.max(axis=2) <= _BLACK
