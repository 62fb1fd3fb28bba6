"""A model over a whole photograph: overlapping tiles, blended, strip by strip so that memory is bounded."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, BoolArray, Float32Array
from roadgeo._progress import Say, say_nothing
from roadgeo.errors import MaskError
from roadgeo.geometry.mask import PROBABILITY_SURE, extent
from roadgeo.sources.segmentation.card import TILE_STEP
from roadgeo.sources.segmentation.network import Network
from roadgeo.sources.segmentation.photograph import Photograph, find_ground, is_plain
from roadgeo.sources.segmentation.probability import NODATA, ProbabilityMap

__all__ = ["MAX_MAP_PIXELS", "map_shape", "segment"]

#: A larger map takes hours, and shows nothing that a smaller one of the same ground does not.
MAX_MAP_PIXELS = 1_000_000_000

#: Steps down and to the right by which a tile is read, in the order in which the ways are taken.
_WAYS = ((1, 1), (-1, -1), (1, -1), (-1, 1))
#: No model is surer than this where ways are averaged: one of them would outweigh all others.
_SURE = np.float32(1e-4)
_LONGER = 4 / 3  # a picture that much longer than a tile is one tile, if it may be: two would mostly overlap


def map_shape(photograph: Photograph, scale: float, step: int = 1) -> tuple[int, int]:
    """Return (H, W) of a photograph as shown to a model: `scale` pixels for each of its own, along a side.

    Both are multiples of `step`.
    """
    height, width = photograph.height * scale, photograph.width * scale
    return step * max(1, round(height / step)), step * max(1, round(width / step))


def segment(
    photograph: Photograph,
    network: Network,
    scale: float = 1.0,
    say: Say = say_nothing,
    *,
    step: int = 1,
    ways: int = 1,
) -> ProbabilityMap:
    """Find the roads in a photograph.

    Parameters
    ----------
    scale : float
        Pixels shown to the model for each of the photograph's, along a side.
    step : int
        Pixels shown to the model for each pixel of the map, along a side: memory grows with the map, not with the
        photograph.
    ways : int
        Number of ways in which each tile is shown, at most 4: as it is, turned by half, mirrored left to right
        and top to bottom. The mean counts: roads that are seen one way only are mostly none.

    Raises
    ------
    MaskError
        The photograph cannot be read, shows nothing, or is too large at this scale.
    ModelError
        The model fails.
    """
    shape = map_shape(photograph, scale, step)
    if math.prod(shape) > MAX_MAP_PIXELS:
        raise MaskError(
            f"{photograph.name}: {shape[1]} x {shape[0]} pixels at the model's scale; expected at most "
            f"{MAX_MAP_PIXELS:,} in all: give the size of a pixel (--gsd), or cut the photograph up"
        )
    values = np.full((shape[0] // step, shape[1] // step), NODATA, np.uint8)
    ground = find_ground(photograph, values.shape)
    if not ground.any():
        raise MaskError(f"{photograph.name}: shows no ground, only nodata, white or black; give a photograph")
    _segment_part(photograph, network, extent(ground), values, say, step=step, ways=ways)
    values[~ground] = NODATA
    pixel = photograph.width / values.shape[1]
    return ProbabilityMap(values, network.card.threshold, photograph.name, network.name, pixel)


def _segment_part(
    photograph: Photograph,
    network: Network,
    part: tuple[slice, slice],
    values: AnyArray,
    say: Say,
    *,
    step: int,
    ways: int,
) -> None:
    """Fill in the rows and columns of a map, (H, W) of the photograph: what lies around them is not shown to a model.

    A model is trained on ground, and finds fewer roads beside a margin.
    """
    inside = values[part]
    shape = step * inside.shape[0], step * inside.shape[1]
    y_scale, n_columns = photograph.height / (step * values.shape[0]), step * values.shape[1]
    first, left = (step * side.start for side in part)

    def read(top: int, n_rows: int) -> AnyArray:
        x, width = (photograph.width * n / n_columns for n in (left, shape[1]))
        return photograph.read(x, (first + top) * y_scale, width, n_rows * y_scale, (n_rows, shape[1]))[0]

    what = f"finding roads in {photograph.name}"
    say(what, 0.0)
    done, rest = 0, np.empty((0, shape[1]), np.float32)
    for rows in _blend(read, shape, _tiling_of(network, shape), partial(_look, network, ways)):
        rows = np.concatenate([rest, rows])
        n = len(rows) // step
        inside[done : done + n] = np.rint(PROBABILITY_SURE * _reduce(rows[: n * step], step))
        done, rest = done + n, rows[n * step :]
        say(what, done * step / shape[0])


def _look(network: Network, ways: int, tile: AnyArray) -> Float32Array:
    """Return a model's result for a tile, shown in some ways: the mean of the logits, as a probability."""
    if ways == 1:
        return network(tile)
    answers = [network(np.ascontiguousarray(tile[::down, ::right]))[::down, ::right] for down, right in _WAYS[:ways]]
    road = np.clip(answers, _SURE, 1 - _SURE)
    return np.asarray(1 / (1 + np.exp(-np.log(road / (1 - road)).mean(axis=0))), np.float32)


def _reduce(rows: Float32Array, step: int) -> Float32Array:
    """Return the means of blocks of `step` x `step` values."""
    if step == 1 or len(rows) == 0:
        return rows[::step, ::step]
    size = rows.shape[1] // step, rows.shape[0] // step
    return np.asarray(cv2.resize(rows, size, interpolation=cv2.INTER_AREA), np.float32)


class _Tiling(NamedTuple):
    """The visible part of a tile: its (height, width), where it begins in the tile, the tile's size, the overlap."""

    size: tuple[int, int]
    margin: tuple[int, int]
    tile: tuple[int, int]
    overlap: float


def _tiling_of(network: Network, shape: tuple[int, int]) -> _Tiling:
    """Return the tiles of a picture of (H, W) pixels: of free size, no more than else, and no larger than they need."""
    tile, overlap = network.card.tile, network.card.overlap
    if not network.any_size:
        return _Tiling(network.seen, network.margin, tile, overlap)
    height, width = (_least(length, side, overlap) for length, side in zip(shape, tile, strict=True))
    return _Tiling((height, width), (0, 0), (height, width), overlap)


def _least(length: int, tile: int, overlap: float) -> int:
    """Return the least side of as many tiles as cover a length with ones of side `tile`, or of one a little longer."""
    n_more = 0 if length <= _LONGER * tile else len(_starts(length, tile, overlap)) - 1
    return TILE_STEP * math.ceil(length / (1 + n_more * (1 - overlap)) / TILE_STEP)


def _blend(
    read: Callable[[int, int], AnyArray],
    shape: tuple[int, int],
    tiles: _Tiling,
    network: Callable[[AnyArray], Float32Array],
) -> Iterator[Float32Array]:
    """Yield the rows of a map from the top down, each when no further tile reaches it."""
    height, width = shape
    size, (above, before) = tiles.size, tiles.margin
    tops, lefts = _starts(height, size[0], tiles.overlap), _starts(width, size[1], tiles.overlap)
    weight = _weight(size, tiles.overlap)
    total, weights = np.zeros((size[0], width), np.float32), np.zeros((size[0], width), np.float32)
    for top, next_top in zip(tops, [*tops[1:], height], strict=True):
        first = max(top - above, 0)
        rgb = read(first, min(top - above + tiles.tile[0], height) - first)
        for left in lefts:
            rows, columns = min(size[0], height - top), min(size[1], width - left)
            start = max(left - before, 0)
            part = rgb[:, start : left - before + tiles.tile[1]]
            if _is_empty(part):
                road = np.zeros((rows, columns), np.float32)
            else:
                filled = _fill(part, tiles.tile, (first - (top - above), start - (left - before)))
                road = network(filled)[:rows, :columns]
            total[:rows, left : left + columns] += weight[:rows, :columns] * road
            weights[:rows, left : left + columns] += weight[:rows, :columns]
        done = next_top - top
        yield np.divide(total[:done], weights[:done])
        for item in (total, weights):
            item[: size[0] - done] = item[done:].copy()
            item[size[0] - done :] = 0


def _starts(length: int, tile: int, overlap: float) -> list[int]:
    """Return where tiles begin along a side: evenly spread, with at least this share of overlap."""
    if length <= tile:
        return [0]
    # A few pixels less overlap than asked for are better than one more row of tiles.
    n = math.ceil((length - tile) / (tile * (1 - overlap)) - 0.01) + 1
    return [round(i * (length - tile) / (n - 1)) for i in range(n)]


def _weight(tile: tuple[int, int], overlap: float) -> Float32Array:
    """Return (H, W) weights that fall off towards the edges of a tile, where a model sees least around it."""
    ramps = []
    for side in tile:
        distance = np.minimum(np.arange(side) + 0.5, side - 0.5 - np.arange(side))
        ramps.append(np.minimum(distance / max(overlap * side, 1.0), 1.0))
    weight: Float32Array = np.outer(*ramps).astype(np.float32)
    return weight


def _fill(part: AnyArray, tile: tuple[int, int], missing: tuple[int, int]) -> AnyArray:
    """Return a part of a photograph at the size of a tile: its reflection fills the missing margins.

    `missing`: rows above it and columns to its left; the others lack below and to its right.
    """
    rows, columns = part.shape[:2]
    above, left = missing
    below, right = tile[0] - rows - above, tile[1] - columns - left
    if not any((above, below, left, right)):
        return part
    fits = max(above, below) < rows and max(left, right) < columns
    border = cv2.BORDER_REFLECT_101 if fits else cv2.BORDER_REFLECT
    filled: AnyArray = cv2.copyMakeBorder(np.ascontiguousarray(part), above, below, left, right, border)
    return filled


def _is_empty(part: AnyArray) -> BoolArray | bool:
    """Whether a part is plain white or black throughout: nothing to show a model."""
    white, black = is_plain(part)
    return bool(white.all() or black.all())
