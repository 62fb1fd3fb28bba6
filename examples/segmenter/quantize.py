"""A network in eight bits: it takes less than half the time, and sees the same.

Weights and features become whole numbers of 8 bits (post-training quantization; Jacob et al., CVPR 2018). How
large features become is measured on crops of the training photographs, recoloured and blurred as in training. Weights
are kept to 7 bits: processors that add products in 16 bits would cut larger ones off.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import onnx
from augmentation import Crops
from numpy.typing import NDArray
from onnx import numpy_helper
from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static
from tiles import Tile

__all__ = ["fold", "quantize"]

_IN_8_BITS = ["Conv", "Add", "Relu", "Clip", "Resize"]


def quantize(model: onnx.ModelProto, tiles: list[Tile]) -> onnx.ModelProto:
    """Return a network of float32, from "image" to "road", in 8 bits.

    The last convolutions, which give the logits, and the operators behind them stay in 32 bits: near a road's edge a
    step of 8 bits would be seen.
    """
    side = model.graph.input[0].type.tensor_type.shape.dim[2].dim_value
    with tempfile.TemporaryDirectory() as folder:
        path, wide = Path(folder) / "quantized.onnx", Path(folder) / "wide.onnx"
        onnx.save(model, str(wide))
        quantize_static(
            str(wide),
            str(path),
            _Photographs(tiles, side),
            quant_format=QuantFormat.QDQ,
            op_types_to_quantize=_IN_8_BITS,
            nodes_to_exclude=_last_layers(model.graph),
            per_channel=True,
            reduce_range=True,
            weight_type=QuantType.QInt8,
            activation_type=QuantType.QUInt8,
        )
        return onnx.load(str(path))


class _Photographs(CalibrationDataReader):
    """Twice as many crops as there are photographs, the same on every run."""

    def __init__(self, tiles: list[Tile], side: int) -> None:
        crops = Crops(tiles, side)
        self._photos = (crops.draw(1)[0].numpy() for _ in range(2 * len(tiles)))

    def get_next(self) -> dict[str, NDArray[np.float32]] | None:
        photo = next(self._photos, None)
        return None if photo is None else {"image": np.ascontiguousarray(photo)}


def _last_layers(graph: onnx.GraphProto) -> list[str]:
    """Return the names of the last convolutions and of all that comes after them."""
    last, seen = [], {graph.output[0].name}
    for node in reversed(graph.node):
        if seen.intersection(node.output):
            last.append(node.name)
            seen.update(() if node.op_type == "Conv" else node.input)
    return last


def fold(graph: onnx.GraphProto) -> None:
    """Merge operators: paddings and normalisations into the convolutions beside them.

    onnxruntime does so where a normalisation follows a convolution. Here also where features of two sizes were added
    before (`network.Up`), for a factor for each channel may as well come before enlarging and adding.
    """
    layers = _Layers(graph)
    for node in list(graph.node):
        if node.op_type == "Pad":
            layers.fold_padding(node)
        elif node.op_type == "BatchNormalization":
            layers.fold_normalisation(node)
    used = {name for node in graph.node for name in node.input}
    for weight in [weight for weight in graph.initializer if weight.name not in used]:
        graph.initializer.remove(weight)


class _Layers:
    """A graph's nodes and weights by name."""

    def __init__(self, graph: onnx.GraphProto) -> None:
        self.graph = graph
        self.maker = {name: node for node in graph.node for name in node.output}
        self.weights = {weight.name: weight for weight in graph.initializer}

    def value(self, name: str) -> NDArray[np.float32]:
        return numpy_helper.to_array(self.weights[name])

    def fold_padding(self, pad: onnx.NodeProto) -> None:
        """Let the convolution after a padding with zeros pad by itself."""
        *_, top, left, _, _, bottom, right = self.value(pad.input[1]).tolist()
        for conv in self._replace(pad):
            (pads,) = (item.ints for item in conv.attribute if item.name == "pads")
            pads[:] = [a + b for a, b in zip(pads, (top, left, bottom, right), strict=True)]

    def fold_normalisation(self, norm: onnx.NodeProto) -> None:
        """Scale and shift the two convolutions whose features are added before a normalisation."""
        gain, shift, mean, variance = (self.value(name) for name in norm.input[1:5])
        (epsilon,) = (item.f for item in norm.attribute if item.name == "epsilon")
        factor = gain / np.sqrt(variance + np.float32(epsilon))
        add = self.maker[norm.input[0]]
        if add.op_type != "Add":
            raise SystemExit(f"{norm.name}: normalises what {add.op_type} gives; expected a sum of two convolutions")
        for name, bias in zip(add.input, (shift - mean * factor, np.zeros_like(shift)), strict=True):
            conv = self.maker[name]
            conv = self.maker[conv.input[0]] if conv.op_type == "Resize" else conv
            self._scale(conv, factor, bias)
        self._replace(norm)

    def _scale(self, conv: onnx.NodeProto, factor: NDArray[np.float32], bias: NDArray[np.float32]) -> None:
        """Multiply what a convolution without a bias gives by a factor for each channel, and add a bias."""
        if len(conv.input) > 2:
            raise SystemExit(f"{conv.name}: has a bias; expected none before a normalisation")
        weight, bias_name = conv.input[1], f"{conv.input[1]}_bias"
        values = self.value(weight) * factor[:, None, None, None]
        self.weights[weight].CopyFrom(numpy_helper.from_array(values, weight))
        self.graph.initializer.append(numpy_helper.from_array(bias, bias_name))
        conv.input.append(bias_name)

    def _replace(self, gone: onnx.NodeProto) -> list[onnx.NodeProto]:
        """Take a node out: those after it are given what it was given. Return these."""
        after = [node for node in self.graph.node if gone.output[0] in node.input]
        for node in after:
            node.input[:] = [gone.input[0] if name == gone.output[0] else name for name in node.input]
        self.graph.node.remove(gone)
        return after
