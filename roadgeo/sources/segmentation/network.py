"""A segmentation model that runs: tiles of a photograph to the probability of road."""

from __future__ import annotations

import importlib.util
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, Float32Array
from roadgeo.errors import ModelError
from roadgeo.sources.segmentation.card import ModelCard, read_card
from roadgeo.sources.segmentation.onnx_file import read_onnx

__all__ = ["DEFAULT_MODEL", "INSTALL", "Network", "load_network"]

DEFAULT_MODEL = Path(__file__).parent / "model" / "roads.onnx"
INSTALL = "pip install 'roadgeo[segment]'"


@dataclass
class Network:
    """A loaded model.

    Attributes
    ----------
    name : str
        Its file's name.
    card : ModelCard
    """

    name: str
    card: ModelCard
    _session: Any = field(repr=False)
    _input: str = field(repr=False)
    _is_probability: bool = field(repr=False)

    def __call__(self, tile: AnyArray) -> Float32Array:
        """Return the probability of road, (H, W) float32, of a tile of the model's own size, (H, W, 3) uint8 RGB."""
        return self._to_probability(self._run(tile), tile.shape[:2])

    def _run(self, tile: AnyArray) -> Float32Array:
        """Return the model's output (C, h, w)."""
        card = self.card
        scale, shift = np.array(card.std, np.float32) * np.float32(255), np.array(card.mean, np.float32)
        values = tile / scale - shift / np.array(card.std, np.float32)
        picture = np.ascontiguousarray(np.moveaxis(values.astype(np.float32), 2, 0)[None])
        try:
            (given,) = self._session.run([card.output], {self._input: picture})
        except Exception as error:  # onnxruntime raises classes of its own, one for each status
            reason = " ".join(str(error).split())[:300]
            raise ModelError(f"{self.name}: fails while it runs ({reason}); is it made for RGB pictures?") from error
        output: Float32Array = np.asarray(given, np.float32)
        output = output[0] if output.ndim == 4 else output
        if output.ndim != 3 or min(output.shape) == 0 or max(self.card.channels) >= len(output):
            raise ModelError(f"{self.name}: gives an array of shape {np.shape(given)}; expected (1, classes, h, w)")
        return output

    def _to_probability(self, output: Float32Array, shape: tuple[int, ...]) -> Float32Array:
        """Turn (C, h, w) probabilities or logits into the probability of road on the tile's own grid."""
        if not self._is_probability:
            output = np.clip(output, -60, 60)
            if len(output) == 1:
                output = np.reciprocal(np.exp(-output) + np.float32(1))
            else:
                output = np.exp(output - output.max(axis=0))
                output /= output.sum(axis=0)
        road: Float32Array = output[list(self.card.channels)].sum(axis=0).clip(0, 1)
        road = np.where(np.isfinite(road), road, np.float32(0))
        if road.shape != shape[:2]:
            road = np.asarray(cv2.resize(road, (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR), np.float32)
        return road


def load_network(
    path: str | os.PathLike[str] | None = None, *, class_name: str | None = None, threads: int = 1
) -> Network:
    """Check a model and load it: the one that ships, or one of your own.

    The number of threads is fixed, so that results are the same on every run.

    Raises
    ------
    ModelError
        onnxruntime is missing, or the file is no model that can be run here.
    """
    if importlib.util.find_spec("onnxruntime") is None:
        raise ModelError(f"to find the roads in a photograph onnxruntime is needed: {INSTALL}")
    path = Path(path) if path is not None else DEFAULT_MODEL
    if path == DEFAULT_MODEL and not path.exists():
        raise ModelError("no model is installed with roadgeo; give one that finds roads: --segmenter MODEL.onnx")
    model = read_onnx(path)
    card = read_card(model, path, class_name)
    session = _open_session(model.content, str(path), threads)
    network = Network(path.name, card, session, model.inputs[0].name, card.is_probability is True)
    if card.is_probability is None:
        network._is_probability = _gives_probability(network)
    return network


def _without_telemetry() -> Any:
    """Return onnxruntime, told to report nothing: else it keeps an identifier of the device, and sends what it did."""
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # read while it is imported
    import onnxruntime

    onnxruntime.disable_telemetry_events()  # where the program that uses roadgeo has imported it before
    return onnxruntime


def _open_session(content: bytes, name: str, threads: int) -> Any:
    onnxruntime = _without_telemetry()
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
    options.use_deterministic_compute = True
    options.log_severity_level = 4  # what goes wrong is raised, and need not be printed too
    options.enable_mem_pattern = False
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # waiting threads leave the core to others
    try:
        return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # as above
        reason = " ".join(str(error).split())[:300]
        raise ModelError(f"{name}: cannot be loaded ({reason}); is it damaged, or made for a newer version?") from error


def _gives_probability(network: Network) -> bool:
    """Tell probabilities from logits by what a model makes of plain and of noisy tiles: logits leave 0 to 1."""
    height, width = network.card.tile
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, (height, width, 3)).astype(np.uint8)
    smooth = cv2.GaussianBlur(noise, (0, 0), 9).astype(np.float32)
    smooth = np.clip(128 + 12 * (smooth - 128), 0, 255).astype(np.uint8)
    for tile in (noise, smooth, np.zeros_like(noise), np.full_like(noise, 255)):
        output = network._run(tile)
        if output.min() < -1e-3 or output.max() > 1 + 1e-3:
            return False
    return True
