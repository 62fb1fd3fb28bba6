"""A photograph, read strip by strip at any scale: RGB of 8 bits, and where it shows ground at all."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, BoolArray
from roadgeo._text import log_of
from roadgeo.errors import MaskError
from roadgeo.storage.rasters import MAX_SIDE, open_raster, page_of, read_palette, value_bands

if TYPE_CHECKING:
    from rasterio import DatasetReader

__all__ = ["Photograph", "find_ground", "find_voids", "open_photograph"]

_LOG = log_of(__name__)

MIN_SIDE = 64
_SIDES = ("left", "top", "right", "bottom")
_STRIP_PIXELS = 1 << 21  # read at a time
_SAMPLE_SIDE = 1024  # deep values are stretched by the range of a sample of this size

#: A void is a plain white or black area (JPEG smears its values and its edge), larger than any white roof.
_WHITE, _BLACK = 250, 3
_VOID_CORE_PX, _VOID_AREA_PX, _VOID_EDGE_PX = 15, 20_000, 9
_DARKEST, _LIGHTEST = 8, 245  # of stretched values
#: 8-bit values that span less, but for half a hundredth at either end, are stretched: night, haze, a flat scan.
_FEW_VALUES = 64
_COARSE = 64  # of a sample's pixels one is looked at first
_SHOWN_SHARE = 0.1  # of a frame that lies within margins and is not filled, at least
_FILL_PATCH_PX, _FILL_AREA_PX, _MANY_VALUES = 5, 400, 9
#: A line of a margin has one value, but for paper's grain (share of the range of values in the middle of the frame)
#: and for what is written there (share of the line).
_GRAIN, _PLAIN_SHARE = 0.04, 0.9
_MARGIN_EDGE_PX = 2  # of the sample, by which a margin is wider than its plain lines


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
        return replace(
            self,
            width=round(wide * self.width),
            height=round(high * self.height),
            read=lambda x, y, w, h, shape: self.read(x / wide, y / high, w / wide, h / high, shape),
        )

    def cut(self, left: float, top: float, width: int, height: int) -> Photograph:
        """Return a part of it."""
        return replace(self, width=width, height=height, read=lambda x, y, *rest: self.read(left + x, top + y, *rest))


@contextmanager
def open_photograph(
    path: str | os.PathLike[str], bands: tuple[int, int, int] | None = None, name: str | None = None
) -> Iterator[Photograph]:
    """Open a photograph.

    Parameters
    ----------
    bands : (3,) tuple of int, optional
        Numbers from 1 of the red, green and blue band. Default: by their names, or else the first three.
    name : str, optional
        Its name in messages. Default: the path.

    Raises
    ------
    MaskError
        It is missing, no raster, too small or too large, or has no bands of colour or grey.
    """
    name = os.fspath(path) if name is None else name
    with open_raster(path) as dataset:
        if min(dataset.shape) < MIN_SIDE or max(dataset.shape) > MAX_SIDE:
            raise MaskError(
                f"{name}: {dataset.width} x {dataset.height} pixels; expected {MIN_SIDE} to {MAX_SIDE} on each side"
            )
        chosen = _choose_bands(dataset, name) if bands is None else _require_bands(dataset, name, bands)
        tones, box = _find_tones(dataset, chosen, name)
        turn = 255 if dataset.tags(ns="IMAGE_STRUCTURE").get("MINISWHITE") == "YES" else 0  # a negative, by its tag

        @lru_cache(maxsize=1)  # where there is ground is found first, and a picture of one tile is that read again
        def read(
            left: float, top: float, width: float, height: float, shape: tuple[int, int]
        ) -> tuple[AnyArray, BoolArray]:
            values, valid = _read(dataset, chosen, (left, top, width, height), shape)
            return tones.rgb(values) ^ np.uint8(turn), valid & box.covers((left, top, width, height), shape)

        yield Photograph(name, dataset.width, dataset.height, read, page_of(path))


class _Box(NamedTuple):
    """A part of a picture, pixels."""

    left: float
    top: float
    right: float
    bottom: float

    def covers(self, part: tuple[float, float, float, float], shape: tuple[int, int]) -> BoolArray:
        """Return (H, W) where the pixels of a part (left, top, width, height) on a grid of that shape lie inside."""
        left, top, width, height = part
        x = left + width * (np.arange(shape[1]) + 0.5) / shape[1]
        y = top + height * (np.arange(shape[0]) + 0.5) / shape[0]
        covered: BoolArray = ((y > self.top) & (y < self.bottom))[:, None] & (x > self.left) & (x < self.right)
        return covered


def _choose_bands(dataset: DatasetReader, name: str) -> list[int]:
    """Return the numbers of the red, green and blue band, or one of grey."""
    meaning = dict(zip(dataset.colorinterp, dataset.indexes, strict=True))
    named = {str(text).strip().lower(): i for text, i in zip(dataset.descriptions, dataset.indexes, strict=True)}
    for names in (named, {colour.name: i for colour, i in meaning.items()}):
        if {"red", "green", "blue"} <= names.keys():
            return [names["red"], names["green"], names["blue"]]
    shown = value_bands(dataset)
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


@dataclass(frozen=True)
class _Tones:
    """How the values of a photograph become RGB of 8 bits.

    Attributes
    ----------
    palette : (256, 3) or None
        Colours that values stand for.
    span : (low, high) or None
        Values that become dark and light; None: they are 8 bit, and stay.
    fills : sequence of ((B,), int)
        Values of areas that show nothing, though no file declares them, and the black or white that they become.
    """

    palette: AnyArray | None = None
    span: tuple[float, float] | None = None
    fills: Sequence[tuple[AnyArray, int]] = ()

    def rgb(self, values: AnyArray) -> AnyArray:
        """Return (H, W, B) values as (H, W, 3) RGB."""
        values = values if self.palette is None else self.palette[values[..., 0]]
        shown = values if self.span is None else self._stretched(values, *self.span)
        for fill, plain in self.fills:
            shown = np.where(_patches_of(fill, values)[..., None], np.uint8(plain), shown)
        return shown if shown.shape[2] == 3 else np.repeat(shown, 3, axis=2)

    def _stretched(self, values: AnyArray, low: float, high: float) -> AnyArray:
        """Return values as neither black nor white, which would mean that there is no photograph."""
        scaled = (np.nan_to_num(values.astype(np.float32)) - low) / max(high - low, 1e-9)
        shown: AnyArray = np.clip(_DARKEST + (_LIGHTEST - _DARKEST) * scaled, _DARKEST, _LIGHTEST).astype(np.uint8)
        return shown


def _find_tones(dataset: DatasetReader, bands: list[int], name: str) -> tuple[_Tones, _Box]:
    """Return how values become RGB, and what of the frame lies within its margins: both by what a sample shows."""
    height, width = dataset.shape
    palette = read_palette(dataset) if dataset.count == 1 and dataset.dtypes[0] == "uint8" else None
    scale = max(max(dataset.shape) / _SAMPLE_SIDE, 1.0)
    shape = max(1, round(height / scale)), max(1, round(width / scale))
    whole = (0.0, 0.0, float(width), float(height))
    (sample, valid), (exact, _) = (_read(dataset, bands, whole, shape, nearest) for nearest in (False, True))
    if not valid.any():
        raise MaskError(f"{name}: holds no observed pixel; give a photograph that shows ground")
    if palette is not None:
        exact, sample = (palette[values[..., 0]] for values in (exact, sample))
    rows, columns = _within_margins(exact, valid)
    box = _Box(columns.start * scale, rows.start * scale, columns.stop * scale, rows.stop * scale)
    _report_margins(name, box, (width, height))
    exact, sample, valid = (values[rows, columns] for values in (exact, sample, valid))
    fills, shown = _find_fills(name, exact, valid)
    very_low, low, high, very_high = np.percentile(sample[shown].astype(np.float64), [0.5, 1, 99, 99.5])
    keeps = dataset.dtypes[bands[0] - 1] == "uint8" and not 0 < very_high - very_low < _FEW_VALUES
    plain = [(fill, 255 if fill.min() > (_WHITE if keeps else high) else 0) for fill in fills]
    return _Tones(palette, None if keeps else (low, high), plain), box


def _within_margins(values: AnyArray, valid: BoolArray) -> tuple[slice, slice]:
    """Return the rows and columns of (H, W, B) values without the plain lines around them; all where little is left."""
    height, width = values.shape[:2]
    middle = values[height // 4 : height - height // 4, width // 4 : width - width // 4]
    grain = _GRAIN * np.ptp(np.percentile(middle, [1, 99]))
    y, x = (np.flatnonzero(valid.any(axis=axis)) for axis in (1, 0))
    box = declared = slice(int(y[0]), int(y[-1]) + 1), slice(int(x[0]), int(x[-1]) + 1)
    while (inner := _less_margin(values, valid, box, grain)) != box:
        box = inner
    shows_much = values[box].size >= _SHOWN_SHARE * values.size
    return box if shows_much and box != declared else (slice(0, height), slice(0, width))


def _less_margin(values: AnyArray, valid: BoolArray, box: tuple[slice, slice], grain: float) -> tuple[slice, slice]:
    """Return a part of (H, W, B) values without the lines at its edges that are of one value each, where observed."""
    part, shown = values[box], valid[box]
    inner = []
    for axis, side in enumerate(box):
        lines, observed = (part, shown) if axis == 0 else (part.swapaxes(0, 1), shown.T)
        middle = np.median(lines, axis=1, keepdims=True).astype(np.float32)
        off = np.abs(lines.astype(np.float32) - middle).max(axis=2)
        n_plain, n_observed = ((off <= grain) & observed).sum(axis=1), observed.sum(axis=1)
        uneven = np.flatnonzero((n_plain < _PLAIN_SHARE * n_observed) | (n_observed < 0.5 * lines.shape[1]))
        first, last = (uneven[0], uneven[-1]) if len(uneven) else (0, len(lines) - 1)
        before, after = (n + _MARGIN_EDGE_PX if n else 0 for n in (int(first), len(lines) - 1 - int(last)))
        inner.append(slice(side.start + before, max(side.stop - after, side.start + before + 1)))
    return inner[0], inner[1]


def _report_margins(name: str, box: _Box, size: tuple[int, int]) -> None:
    margins = box.left, box.top, size[0] - box.right, size[1] - box.bottom
    if max(margins) > 0.5:
        listed = ", ".join(f"{px:.0f} px {side}" for px, side in zip(margins, _SIDES, strict=True) if px > 0.5)
        _LOG.warning("%s: plain margins are not observed: %s", name, listed)


def _find_fills(name: str, values: AnyArray, valid: BoolArray) -> tuple[list[AnyArray], BoolArray]:
    """Return the (B,) colours that (H, W, B) values have in patches, and where the picture is: apart from their edges.

    It may be the least, the greatest, or a corner's. Patches are large, but where the colour lies far from all others,
    or in several corners.
    """
    seen, shown = np.ascontiguousarray(values[valid].T), valid
    fills: list[AnyArray] = []
    corners = values[[0, 0, -1, -1], [0, -1, 0, -1]]
    for fill in np.unique([np.full_like(seen[:, 0], end) for end in (seen.min(), seen.max())] + [*corners], axis=0):
        alike = (values == fill).all(axis=2) & valid
        if np.count_nonzero(alike) < min(_FILL_AREA_PX, _VOID_AREA_PX, alike.size // 10):  # no patch is so small
            continue
        rest = seen[:, ~alike[valid]]
        if all(len(np.unique(rest[:, ::step])) < _MANY_VALUES for step in (_COARSE, 1)):  # all where a few do not tell
            continue
        least, greatest = float(rest.min()), float(rest.max())
        is_apart = max(least - float(fill.max()), float(fill.min()) - greatest) > greatest - least
        is_sure = is_apart or np.count_nonzero((corners == fill).all(axis=1)) > 1
        is_fill = find_voids(alike, least=_FILL_AREA_PX if is_sure else None)
        if is_fill.any() and (valid & ~is_fill).sum() >= _SHOWN_SHARE * valid.sum():
            fills.append(fill)
            edges = cv2.dilate(is_fill.view(np.uint8), np.ones((_VOID_CORE_PX, _VOID_CORE_PX), np.uint8)) > 0
            shown = shown & ~edges & (values != fill).any(axis=2)
            listed = ", ".join(f"{value:g}" for value in np.unique(fill))
            _LOG.warning("%s: areas of the value %s are taken for not observed", name, listed)
    return fills, shown if shown.any() else valid


def _patches_of(fill: AnyArray, values: AnyArray) -> BoolArray:
    """Return where (H, W, B) values are those of a fill, and so are all of a small square."""
    is_fill, patch = (values == fill).all(axis=2).view(np.uint8), np.ones((_FILL_PATCH_PX, _FILL_PATCH_PX), np.uint8)
    return np.asarray(cv2.morphologyEx(is_fill, cv2.MORPH_OPEN, patch) > 0)


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


def find_voids(*plain: BoolArray, least: int | None = None) -> BoolArray:
    """Return (H, W) where there is no photograph, given where it is as good as white, as good as black, a fill.

    Only large plain areas count, of at least so many pixels; a little of their edge, which is smeared, goes with them.
    """
    void = np.zeros(plain[0].shape, np.uint8)
    least = least or min(_VOID_AREA_PX, void.size // 10)
    for one in plain:
        if np.count_nonzero(one) < least:
            continue
        core = np.ones((_VOID_CORE_PX, _VOID_CORE_PX), np.uint8)
        opened = cv2.morphologyEx(one.view(np.uint8), cv2.MORPH_OPEN, core)
        _, labels, stats, _ = cv2.connectedComponentsWithStats(opened, ltype=cv2.CV_32S)
        large = stats[:, cv2.CC_STAT_AREA] >= least
        large[0] = False
        void |= large[labels].view(np.uint8)
    if not void.any():
        return void.view(np.bool_)
    grown: AnyArray = cv2.dilate(void, np.ones((_VOID_EDGE_PX, _VOID_EDGE_PX), np.uint8))
    return grown.view(np.bool_)


def is_plain(rgb: AnyArray) -> tuple[BoolArray, BoolArray]:
    """Return where (H, W, 3) RGB is as good as white, and as good as black."""
    return rgb.min(axis=2) >= _WHITE, rgb.max(axis=2) <= _BLACK
