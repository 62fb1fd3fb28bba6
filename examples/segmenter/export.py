"""A trained network as ONNX in 8 bits, calibrated, with the metadata that QGIS Deepness reads.

    python export.py DATA runs/all.pt roads.onnx --held-out 0 runs/fold0.pt

Three in ten of the pixels that a network calls .3 should be road. How far a network trained in the same way is from
that is measured on photographs that it has not seen, the fold's, and mended in the last layer: log odds become
`a` times themselves plus `b`. The exported network runs in 8 bits (`quantize.py`).
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import torch
from network import RoadNet, Roads
from numpy.typing import NDArray
from onnx import helper
from quantize import fold, quantize
from scipy.optimize import minimize
from tiles import Tile, fold_of, read_tiles
from training import load, probabilities

__all__ = ["METADATA", "TILE", "calibrate", "export", "in_32_bits", "measure_calibration"]

TILE = 800  # px: two of them, overlapping by 100, cover 1500; other multiples of 32 px do as well
OPSET = 17

METADATA = {
    "model_type": "Segmentor",
    # One output channel: Deepness counts it as two classes, which the threshold separates.
    "class_names": {"0": "not_road", "1": "road"},
    "resolution": 100,  # cm per pixel
    "tiles_size": TILE,
    "tiles_overlap": 12.5,  # percent
    "standardization_mean": [0.0, 0.0, 0.0],  # the network standardizes by itself
    "standardization_std": [1.0, 1.0, 1.0],
    "version": "6",
    "training_data": "34 photographs of the Massachusetts Roads Dataset (Mnih, 2013), 1 m per pixel; painted scenes on "
    "streets of OpenStreetMap; encoder: ImageNet",
    "licence": "weights as the project, encoder Apache 2.0; photographs and masks trained on state no licence",
}


def export(network: RoadNet, tiles: list[Tile], path: Path, threshold: float = 0.5) -> Path:
    """Write the network as ONNX: (1, 3, H, W) RGB, 0..1, to the probability of road, (1, 1, H, W).

    What it runs on in 8 bits is measured on the photographs of the tiles. Above the threshold masks show road.
    """
    model = in_32_bits(network)
    fold(model.graph)
    return _write(quantize(model, tiles).graph, path, threshold)


def in_32_bits(network: RoadNet) -> onnx.ModelProto:
    """Return the network as ONNX, with its constants computed."""
    image, roads = torch.zeros(1, 3, TILE, TILE), Roads(network).float().eval()
    names = {"input_names": ["image"], "output_names": ["road"]}
    options = onnxruntime.SessionOptions()
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_BASIC
    with tempfile.TemporaryDirectory() as folder:
        path, simple = str(Path(folder) / "wide.onnx"), str(Path(folder) / "simple.onnx")
        torch.onnx.export(roads, (image,), path, opset_version=OPSET, dynamo=False, **names)
        options.optimized_model_filepath = simple
        onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        return onnx.load(simple)


def measure_calibration(seen: NDArray[np.float32], road: NDArray[np.bool_]) -> tuple[float, float]:
    """Return a, b so that the log odds a l + b of the pixels fit best what is road (Platt 1999)."""
    odds, sign = np.log(seen / (1 - seen)).astype(np.float64), np.where(road, 1.0, -1.0)

    def surprise(fit: NDArray[np.float64]) -> float:
        return float(np.logaddexp(0, -sign * (fit[0] * odds + fit[1])).mean())

    a, b = minimize(surprise, (1.0, 0.0)).x
    return float(a), float(b)


@torch.no_grad()
def calibrate(network: RoadNet, a: float, b: float) -> None:
    """Let the last layer give a times its log odds plus b."""
    last = network.heads.road[0]
    last.weight.mul_(a)
    last.bias.mul_(a).add_(b)


def _held_out_pixels(network: RoadNet, tiles: list[Tile]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return what a network sees at every fifth pixel of photographs, and whether it is road."""
    every, parts = np.s_[2::5, 2::5], []
    for tile in tiles:
        ground = tile.observed[every]
        parts.append((probabilities(network, tile.photo)[every][ground], tile.road[every][ground]))
    seen, road = (np.concatenate(item) for item in zip(*parts, strict=True))
    return seen.clip(1e-5, 1 - 1e-5), road


def _print_reliability(seen: NDArray[np.float32], road: NDArray[np.bool_]) -> None:
    tenth = np.minimum((10 * seen).astype(int), 9)
    print("of pixels called 0 to .1, .1 to .2, ... are road:", *(f"{road[tenth == i].mean():.2f}" for i in range(10)))


def _write(graph: onnx.GraphProto, path: Path, threshold: float) -> Path:
    """Write a graph with its sizes and the metadata."""
    for port, channels in ((graph.input[0], 3), (graph.output[0], 1)):
        sizes = helper.make_tensor_type_proto(onnx.TensorProto.FLOAT, (1, channels, "height", "width"))
        port.type.CopyFrom(sizes)  # the exporter loses them where features are made larger
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=8)
    helper.set_model_props(
        model, {key: json.dumps(value) for key, value in (METADATA | {"seg_thresh": threshold}).items()}
    )
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, str(path))
    return path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="folder with images/ and masks/")
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("path", type=Path, help="the ONNX file to write")
    parser.add_argument("--held-out", nargs=2, metavar=("FOLD", "CHECKPOINT"), help="default: not calibrated")
    parser.add_argument("--folds", type=int, default=3)
    options = parser.parse_args()
    tiles, network, threshold = read_tiles(options.data), load(options.checkpoint), 0.5
    if options.held_out:
        number, other = options.held_out
        unseen = [tile for i, tile in enumerate(tiles) if fold_of(i, options.folds) == int(number)]
        seen, road = _held_out_pixels(load(Path(other)), unseen)
        a, b = measure_calibration(seen, road)
        print(f"log odds become {a:.3f} times themselves plus {b:.3f}")
        _print_reliability(seen, road)
        _print_reliability(1 / (1 + np.exp(-(a * np.log(seen / (1 - seen)) + b))), road)
        calibrate(network, a, b)
        threshold = round(1 / (1 + math.exp(-b)), 2)  # one half, before calibration
    print("wrote", export(network, tiles, options.path, threshold))


if __name__ == "__main__":
    main()
