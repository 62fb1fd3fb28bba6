"""Trained networks as ONNX, with the metadata that QGIS Deepness and GeoDeep read.

    python export.py one/roads.onnx other/roads.onnx roads.onnx        # two that were exported, as one
    python export.py one/roads.onnx one/roads.onnx roads.onnx          # one, shown each picture twice
    python export.py one/roads.onnx@640 other/roads.onnx roads.onnx    # the first is shown tiles of 640 px, not 800
    python export.py one/roads.onnx@704 roads.onnx                     # one, shown smaller tiles

The joined network gives the mean of the logits of the two, of which the second is shown the picture turned by half:
they err in different places. Of a smaller picture a network takes less time, and sees further. What is exported runs in
eight bits (`quantize.py`).
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import torch
from network import STRIDE, AnyRoadNet, Roads
from onnx import compose, helper, numpy_helper
from quantize import fold, quantize
from tiles import Tile

__all__ = ["METADATA", "TILE", "export", "in_32_bits", "join"]

TILE = 800  # px: two of them, overlapping by 100, cover 1500; a fixed size, for GeoDeep knows no other
OPSET = 17

METADATA = {
    "model_type": "Segmentor",
    # One output channel: Deepness counts it as two classes, told apart by the threshold.
    "class_names": {"0": "not_road", "1": "road"},
    "resolution": 100,  # cm per pixel
    "tile_size": TILE,
    "tiles_size": TILE,
    "tiles_overlap": 12.5,  # percent
    "standardization_mean": [0.0, 0.0, 0.0],  # the network standardizes by itself
    "standardization_std": [1.0, 1.0, 1.0],
    "seg_thresh": 0.5,
    "ways": 2,  # roadgeo's own key: shown each tile turned by half as well, the mean counts
    "version": "5",
    "training_data": "34 photographs of the Massachusetts Roads Dataset (Mnih, 2013), 1 m per pixel; encoder: ImageNet",
    "licence": "weights as the project, encoder Apache 2.0; photographs and masks trained on state no licence",
}


def export(network: AnyRoadNet, tiles: list[Tile], path: Path) -> Path:
    """Write the network as ONNX: (1, 3, 800, 800) RGB, 0..1, to the probability of road, (1, 1, 800, 800).

    What it runs on in 8 bits is measured on the photographs of the tiles.
    """
    model = in_32_bits(network)
    fold(model.graph)
    return _write(quantize(model, tiles).graph, path)


def in_32_bits(network: AnyRoadNet) -> onnx.ModelProto:
    """Return the network as ONNX, with what is constant computed."""
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


def join(parts: list[tuple[Path, int]], path: Path) -> Path:
    """Write exported networks as one that gives the mean of their logits as a probability.

    Each comes with the side, in pixels, of the tiles that it is shown, a multiple of 32; every second one is shown them
    turned by half. One that is given twice keeps its weights once.
    """
    nodes, weights, logits = [*_turn_by_half("image", "turned")], {}, []
    paths = [part for part, _ in parts]
    for k, (part, side) in enumerate(parts):
        first, seen = paths.index(part), "turned" if k % 2 else "image"
        graph = compose.add_prefix(onnx.load(str(part)), f"{k}_", rename_inputs=False, rename_outputs=False).graph
        shared = {weight.name: weight.name.replace(f"{k}_", f"{first}_", 1) for weight in graph.initializer}
        (last,) = (node for node in graph.node if "road" in node.output)
        if last.op_type != "Sigmoid":
            raise SystemExit(f"{part}: gives no probability; expected a model that train.py wrote")
        nodes += _resize(seen, f"{k}_seen", side, TILE)
        for node in graph.node:
            node.input[:] = [shared.get(name, f"{k}_seen" if name == "image" else name) for name in node.input]
        nodes += [node for node in graph.node if node is not last]
        nodes += _resize(last.input[0], f"{k}_whole", TILE, side)
        nodes += _turn_by_half(f"{k}_whole", f"{k}_back") if k % 2 else []
        logits.append(f"{k}_back" if k % 2 else f"{k}_whole")
        for weight in graph.initializer:
            weight.name = shared[weight.name]
            weights[weight.name] = weight
    nodes += [
        helper.make_node("Mean", logits, ["logit"]),
        helper.make_node("Sigmoid", ["logit"], ["road"]),
    ]
    ports = [helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, None) for name in ("image", "road")]
    return _write(helper.make_graph(nodes, "roads", ports[:1], ports[1:], list(weights.values())), path)


def _resize(before: str, after: str, side: int, side_before: int) -> list[onnx.NodeProto]:
    """Return nodes that give the tile `before` another size, (1, C, side, side)."""
    if side == side_before:
        return [helper.make_node("Identity", [before], [after])]
    scale = np.nextafter(np.float32(side / side_before), np.float32(2))  # sizes are rounded down
    scales = numpy_helper.from_array(np.array([1, 1, scale, scale], np.float32))
    constant = helper.make_node("Constant", [], [f"{after}_scales"], value=scales)
    return [constant, helper.make_node("Resize", [before, "", f"{after}_scales"], [after], mode="linear")]


def _turn_by_half(before: str, after: str) -> list[onnx.NodeProto]:
    """Return nodes that turn (N, C, H, W) by half: rows and columns the other way round."""
    end = np.iinfo(np.int64).min
    values = {"starts": [-1, -1], "ends": [end, end], "axes": [2, 3], "steps": [-1, -1]}
    names = [f"{after}_{name}" for name in values]
    constants = [
        helper.make_node("Constant", [], [name], value=numpy_helper.from_array(np.array(value, np.int64)))
        for name, value in zip(names, values.values(), strict=True)
    ]
    return [*constants, helper.make_node("Slice", [before, *names], [after])]


def _write(graph: onnx.GraphProto, path: Path) -> Path:
    """Write a graph with its sizes and the metadata."""
    for port, channels in ((graph.input[0], 3), (graph.output[0], 1)):
        sizes = helper.make_tensor_type_proto(onnx.TensorProto.FLOAT, (1, channels, TILE, TILE))
        port.type.CopyFrom(sizes)  # the exporter loses them where features are made larger
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=8)
    helper.set_model_props(model, {key: json.dumps(value) for key, value in METADATA.items()})
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, str(path))
    return path


def _part(text: str) -> tuple[Path, int]:
    """Read FILE or FILE@SIDE."""
    name, _, side = text.partition("@")
    if side and (not side.isdigit() or int(side) % STRIDE or not 0 < int(side) <= TILE):
        raise SystemExit(f"{text}: the side of a tile is a multiple of {STRIDE} up to {TILE}, such as {name}@640")
    return Path(name), int(side or TILE)


if __name__ == "__main__":
    if len(sys.argv) < 3:
        raise SystemExit(__doc__)
    *_parts, _joined = sys.argv[1:]
    print("wrote", join([_part(text) for text in _parts], Path(_joined)))
