"""A segmentation model that runs: tiles of a photograph to the probability of road."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, Float32Array
from roadgeo._text import listed, log_of
from roadgeo.errors import ModelError
from roadgeo.sources.segmentation.card import TILE_STEP, ModelCard, channels_come_last, read_card, size_of
from roadgeo.sources.segmentation.onnx_file import OnnxModel, open_onnx

__all__ = ["DEFAULT_MODEL", "Network", "load_network"]

_LOG = log_of(__name__)

DEFAULT_MODEL = Path(__file__).parent / "model" / "roads.onnx.gz"

#: Pixels of the input, along a side, that one of the output may stand for.
_STRIDES = (1, 2, 4, 8, 16, 32)
_CLEARLY = 0.1  # lead of a correlation that outweighs the guess by size


@dataclass
class Network:
    """A loaded model.

    Attributes
    ----------
    name : str
        Its file's name.
    card : ModelCard
    seen : (height, width)
        The middle of a tile, pixels, that a model's output covers: all of it, or less where its output is cropped.
    """

    name: str
    card: ModelCard
    seen: tuple[int, int]
    _model: OnnxModel = field(repr=False)
    _is_probability: bool = field(default=False, repr=False)
    _size: tuple[int, int] | None = field(default=None, repr=False)  # of its output

    @property
    def any_size(self) -> bool:
        """Whether tiles of other sizes than the card's do as well, and all of each is visible."""
        return self.card.any_size and self.seen == self._size == self.card.tile

    @property
    def margin(self) -> tuple[int, int]:
        """Rows above and columns to the left of the visible part of a tile."""
        (height, width), (rows, columns) = self.card.tile, self.seen
        return (height - rows) // 2, (width - columns) // 2

    def __call__(self, tile: AnyArray) -> Float32Array:
        """Return the probability of road in the visible part of a tile.

        Parameters
        ----------
        tile : (H, W, 3) uint8
            RGB, of the model's own size, or of another where it takes any.

        Returns
        -------
        (rows, columns) float32
            Probabilities, of the size `seen`, or of the tile's.
        """
        road = self._to_probability(self._run(tile))
        size, seen = (tile.shape[:2], tile.shape[:2]) if self.any_size else (self._size, self.seen)
        if road.shape != size:
            raise ModelError(f"{self.name}: gives {road.shape[::-1]} pixels, before {size}; expected one size")
        if road.shape != seen:
            road = np.asarray(cv2.resize(road, seen[::-1], interpolation=cv2.INTER_LINEAR), np.float32)
        return road

    def _run(self, tile: AnyArray) -> Float32Array:
        """Return the model's output (C, h, w)."""
        card = self.card
        values = tile
        if card.kind != "uint8":
            scale, shift = np.array(card.std, np.float32) * np.float32(255), np.array(card.mean, np.float32)
            values = (tile / scale - shift / np.array(card.std, np.float32)).astype(np.float32)
        picture = np.ascontiguousarray(values if card.channels_last else np.moveaxis(values, 2, 0), card.kind)
        given = self._model.run(card.output, picture[None])
        output: Float32Array = np.asarray(given, np.float32)
        output = output[0] if output.shape[:-3] == (1,) else output
        output = np.moveaxis(output, 2, 0) if output.ndim == 3 and channels_come_last(output.shape) else output
        n_channels = 1 if card.gives_classes else max(card.channels) + 1
        if output.ndim != 3 or min(output.shape) == 0 or len(output) < n_channels:
            raise ModelError(f"{self.name}: gives an array of shape {np.shape(given)}; expected (1, classes, h, w)")
        return output

    def _to_probability(self, output: Float32Array) -> Float32Array:
        """Turn (C, h, w) probabilities, logits or classes into the probability of road (h, w)."""
        if self.card.gives_classes:
            return self._of_classes(output[0])
        road: Float32Array
        if not self._is_probability:
            output = np.clip(output, -60, 60)
            if len(output) == 1:
                output = np.reciprocal(np.exp(-output) + np.float32(1))
            else:
                output = np.exp(output - output.max(axis=0))
                output /= output.sum(axis=0)
        road = output[list(self.card.channels)].sum(axis=0).clip(0, 1)
        road[~np.isfinite(road)] = 0
        return road

    def _of_classes(self, classes: Float32Array) -> Float32Array:
        """Turn the class of each pixel into 1 where it is road."""
        roads = self.card.channels
        if not roads:
            held = np.unique(classes[classes != 0])
            if len(held) > 1:
                numbers = listed([f"{item:g}" for item in held])
                raise ModelError(f"{self.name}: gives the classes {numbers}; choose the road: --class NUMBER")
            return np.asarray(classes != 0, np.float32)
        return np.asarray(np.isin(classes, roads), np.float32)


def load_network(
    path: str | os.PathLike[str] | None = None, *, class_name: str | None = None, threads: int = 1
) -> Network:
    """Check a model and load it: the one that ships, or one of your own.

    Raises
    ------
    ModelError
        onnxruntime is missing, or the file is no model that can be run here.
    """
    path = Path(path) if path is not None else DEFAULT_MODEL
    if path == DEFAULT_MODEL and not path.exists():
        raise ModelError("no model is installed with roadgeo; give one that finds roads: --segmenter MODEL.onnx")
    model = open_onnx(path, threads)
    card = read_card(model, class_name)
    network = Network(path.name.removesuffix(".gz"), card, card.tile, model, card.is_probability is True)
    if card.is_probability is None and not card.gives_classes:
        network._is_probability = _gives_probability(network)
    output = next(port for port in model.outputs if port.name == card.output)
    network._size = size_of(output)
    if network._size != card.tile:
        network._size, network.seen = _what_is_seen(network)
    return network


def _gives_probability(network: Network) -> bool:
    """Distinguish probabilities from logits by a model's output for plain and for noisy tiles: logits leave 0 to 1."""
    height, width = network.card.tile
    noise, smooth = _noise(height, width)
    for tile in (noise, smooth, np.zeros_like(noise), np.full_like(noise, 255)):
        output = network._run(tile)
        if output.min() < -1e-3 or output.max() > 1 + 1e-3:
            return False
    return True


def _noise(height: int, width: int) -> tuple[AnyArray, AnyArray]:
    """Return two pictures (height, width, 3), of single pixels and of blobs."""
    noise = np.random.default_rng(0).integers(0, 256, (height, width, 3)).astype(np.uint8)
    smooth = cv2.GaussianBlur(noise, (0, 0), 9).astype(np.float32)
    return noise, np.clip(128 + 12 * (smooth - 128), 0, 255).astype(np.uint8)


def _what_is_seen(network: Network) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the (height, width) of an output, and of the middle of a tile that it shows.

    A whole share of a tile's sides is all of it, in larger pixels; any other the middle, for models without padding
    leave out the edge. That is held against what a model gives for a picture and for the same moved sideways, which
    determines the size of its pixels.
    """
    height, width = network.card.tile
    small = np.zeros((2 * TILE_STEP, 2 * TILE_STEP, 3), np.uint8)
    if network.card.any_size and network._run(small).shape[1:] == small.shape[:2]:
        return (height, width), (height, width)
    moved = max(width // 2 // _STRIDES[-1], 1) * _STRIDES[-1]
    _, picture = _noise(height, width + moved)
    here = network._run(np.ascontiguousarray(picture[:, :width]))
    rows, columns = here.shape[1:]
    if (rows, columns) == (height, width):
        return (height, width), (height, width)
    there = network._run(np.ascontiguousarray(picture[:, moved:]))
    stretch = width / columns
    strides = [k for k in _STRIDES if k * rows <= height and k * columns <= width]
    is_whole = height * columns == width * rows and stretch in _STRIDES
    expected = stretch if is_whole or not strides else 1.0
    likeness = {k: _likeness(here, there, round(moved / k)) for k in {*strides, stretch}}
    best = max(likeness, key=likeness.__getitem__)
    stride = best if likeness[best] > likeness[expected] + _CLEARLY else expected
    if stride == stretch:
        return (rows, columns), (height, width)
    _LOG.warning(
        "%s: gives %d x %d pixels of tiles of %d x %d: taken for their middle",
        *(network.name, columns, rows, width, height),
    )
    return (rows, columns), (round(rows * stride), round(columns * stride))


def _likeness(here: Float32Array, there: Float32Array, moved: int) -> float:
    """Return the correlation of two outputs (C, h, w) where the second shows the first's content moved by columns."""
    columns = here.shape[2] - moved
    if columns < 2:
        return 0.0
    with np.errstate(all="ignore"):
        a, b = (part - part.mean(dtype=float) for part in (here[..., moved:], there[..., :columns]))
        likeness = float((a * b).sum() / np.sqrt((a**2).sum() * (b**2).sum()))
    return likeness if np.isfinite(likeness) else 0.0
