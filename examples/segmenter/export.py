"""The trained network as ONNX, with the metadata that QGIS Deepness and GeoDeep read."""

from __future__ import annotations

import json
from pathlib import Path

import onnx
import torch
from network import RoadNet, Roads

__all__ = ["METADATA", "TILE", "export"]

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
    "version": "3",
    "training_data": "34 photographs of the Massachusetts Roads Dataset (Mnih, 2013), 1 m per pixel",
    "licence": "weights as the project; the photographs and masks they were trained on state no licence",
}


def export(network: RoadNet, path: Path) -> Path:
    """Write the network as ONNX: (1, 3, 800, 800) RGB, 0..1, to the probability of road, (1, 1, 800, 800)."""
    image = torch.zeros(1, 3, TILE, TILE)
    names = {"input_names": ["image"], "output_names": ["road"]}
    torch.onnx.export(Roads(network).float().eval(), (image,), str(path), opset_version=OPSET, dynamo=False, **names)
    model = onnx.load(str(path))
    onnx.helper.set_model_props(model, {key: json.dumps(value) for key, value in METADATA.items()})
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, str(path))
    return path
