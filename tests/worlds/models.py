"""Tiny ONNX models that see a road where a picture is light, in the conventions of several tools."""

import json
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

__all__ = ["brightness_model", "save"]


def brightness_model(
    path: Path,
    *,
    size: int | None = 64,
    classes: int = 1,
    road: int = 0,
    last: str | None = "Sigmoid",
    shrink: int = 1,
    props: dict[str, object] | None = None,
    raw_props: dict[str, str] | None = None,
    heads: tuple[str, ...] = ("output",),
) -> Path:
    """Write a model whose class `road` is likely where the mean of RGB exceeds a half: logit 20 (mean - 0.5)."""
    weight = np.zeros((classes, 3, 1, 1), np.float32)
    weight[road] = 20 / 3
    bias = np.zeros(classes, np.float32)
    bias[road] = -10.0
    nodes, outputs = [], []
    side = None if size is None else size // shrink
    for head in heads:
        nodes.append(helper.make_node("Conv", ["image", f"w_{head}", f"b_{head}"], [f"c_{head}"]))
        at = f"c_{head}"
        if shrink > 1:
            nodes.append(
                helper.make_node("AveragePool", [at], [f"p_{head}"], kernel_shape=[shrink] * 2, strides=[shrink] * 2)
            )
            at = f"p_{head}"
        extra = {"axis": 1} if last in ("Softmax", "LogSoftmax") else {}
        nodes.append(helper.make_node(last or "Identity", [at], [head], **extra))
        outputs.append(helper.make_tensor_value_info(head, TensorProto.FLOAT, [1, classes, side, side]))
    stored = []
    for head in heads:  # all but the last see dark roads
        sign = np.float32(1 if head == heads[-1] else -1)
        stored += [
            numpy_helper.from_array(sign * item, f"{name}_{head}") for name, item in (("w", weight), ("b", bias))
        ]
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, size, size])
    graph = helper.make_graph(nodes, "brightness", [image], outputs, stored)
    return save(graph, path, props, raw_props)


def save(
    graph: onnx.GraphProto, path: Path, props: dict[str, object] | None = None, raw: dict[str, str] | None = None
) -> Path:
    """Write a graph as a model of opset 17."""
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    texts = {key: json.dumps(value) for key, value in (props or {}).items()} | (raw or {})
    if texts:
        helper.set_model_props(model, texts)
    onnx.save(model, str(path))
    return path
