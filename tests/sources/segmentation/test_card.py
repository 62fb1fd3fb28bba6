"""What a model tells of itself: in its metadata, in a STAC item beside it, in the shapes of its inputs and outputs."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from onnx import TensorProto, helper
from worlds.models import brightness_model, save

from roadgeo.errors import ModelError
from roadgeo.sources.segmentation.card import ModelCard, read_card
from roadgeo.sources.segmentation.onnx_file import read_onnx

FLOAT, BYTES = TensorProto.FLOAT, TensorProto.UINT8


def card_of(path: Path, class_name: str | None = None) -> ModelCard:
    return read_card(read_onnx(path), path, class_name)


def item(**input_: Any) -> dict[str, Any]:
    """A STAC item of a model whose input is described so."""
    return {"properties": {"mlm:input": [input_], "mlm:output": [{"tasks": ["semantic-segmentation"]}]}}


def beside(path: Path, document: object) -> Path:
    path.with_suffix(".json").write_text(json.dumps(document))
    return path


Z = {"type": "z-score", "mean": 0.4, "stddev": 0.2}


@pytest.mark.parametrize(
    ("scaling", "mean", "std"),
    [
        ({"value_scaling": [Z]}, 0.4, 0.2),
        ({"value_scaling": Z}, 0.4, 0.2),
        ({"value_scaling": [{"type": "z-score", "mean": 102.0, "stddev": 51.0}]}, 0.4, 0.2),
        ({"value_scaling": [{"type": "min-max", "minimum": 51, "maximum": 255}]}, 0.2, 0.8),
        ({"value_scaling": [{"type": "scale", "value": 255}]}, 0.0, 1.0),
        ({"value_scaling": [{}]}, 0.0, 1.0),
        ({"norm_type": "z-score", "statistics": [{"mean": 0.4, "stddev": 0.2}]}, 0.4, 0.2),
        ({"norm_type": "z-score"}, 0.0, 1.0),
        ({"norm_type": "l2", "statistics": [{"mean": 0.4, "stddev": 0.2}]}, 0.0, 1.0),
    ],
)
def test_the_scaling_of_an_item(tmp_path: Path, scaling: dict, mean: float, std: float) -> None:
    card = card_of(beside(brightness_model(tmp_path / "m.onnx"), item(**scaling)))
    assert card.mean == pytest.approx((mean,) * 3)
    assert card.std == pytest.approx((std,) * 3)


def test_each_band_may_be_scaled_by_itself(tmp_path: Path) -> None:
    bands = [{"type": "z-score", "mean": 51.0 * k, "stddev": 51.0} for k in (1, 2, 3)]
    card = card_of(beside(brightness_model(tmp_path / "m.onnx"), item(value_scaling=bands)))
    assert card.mean == pytest.approx((0.2, 0.4, 0.6))


def test_the_tile_of_an_item(tmp_path: Path) -> None:
    path = beside(brightness_model(tmp_path / "m.onnx", size=None), item(input={"shape": [-1, 3, 160, 160]}))
    assert card_of(path).tile == (160, 160)


@pytest.mark.parametrize("document", [{}, [], {"properties": {"gsd": 0.3}}, {"properties": {"mlm:input": [{}]}}])
def test_a_document_that_describes_no_model_is_left_alone(tmp_path: Path, document: object) -> None:
    alone = card_of(brightness_model(tmp_path / "m.onnx"))
    assert card_of(beside(tmp_path / "m.onnx", document)) == alone


@pytest.mark.parametrize(
    ("document", "message"),
    [
        (item(value_scaling=[{"type": "clip"}]), "scaled by 'clip'; expected z-score, min-max or scale"),
        ({"properties": {"mlm:input": [{}], "mlm:output": [{"tasks": ["object-detection"]}]}}, "object-detection"),
        (item(value_scaling=[{"type": "z-score"}]), "make no sense"),
    ],
)
def test_an_item_that_cannot_be_followed(tmp_path: Path, document: object, message: str) -> None:
    path = beside(brightness_model(tmp_path / "m.onnx"), document)
    with pytest.raises(ModelError, match=message):
        card_of(path)


@pytest.mark.parametrize("class_name", [None, "track", "2"])
def test_a_single_channel_is_the_last_of_the_classes(tmp_path: Path, class_name: str | None) -> None:
    names = {0: "sea", 1: "land", 2: "road" if class_name is None else "track"}
    path = brightness_model(tmp_path / "m.onnx", props={"class_names": names})
    assert card_of(path, class_name).channels == (0,)
    with pytest.raises(ModelError, match=r"no class 'house' \(its classes: 0 sea, 1 land, 2"):
        card_of(path, "house")
    with pytest.raises(ModelError, match="choose one of them"):
        card_of(path, "sea")


def test_metadata_of_python(tmp_path: Path) -> None:
    """Old models hold dictionaries as Python prints them."""
    path = brightness_model(tmp_path / "m.onnx", classes=2, raw_props={"names": "{0: 'sea', 1: 'road'}"})
    assert card_of(path).channels == (1,)


@pytest.mark.parametrize(
    ("inputs", "outputs", "message"),
    [
        ([("a", FLOAT, [1, 3, 64, 64]), ("b", FLOAT, [1, 3, 64, 64])], [], "takes 2 inputs; expected one"),
        ([("a", BYTES, [1, 3, 64, 64])], [], r"takes other numbers of shape \(1, 3, 64, 64\)"),
        ([("a", FLOAT, [1, 4, None, 64])], [], r"takes 32-bit floats of shape \(1, 4, any, 64\)"),
        ([("a", FLOAT, [1, 3, 64])], [], r"shape \(1, 3, 64\)"),
        ([("a", FLOAT, [8, 3, 64, 64])], [], r"shape \(8, 3, 64, 64\)"),
        ([("a", FLOAT, [1, 3, 64, 64])], [("b", FLOAT, [1, 7])], "gives no image"),
        ([("a", FLOAT, [1, 3, 64, 64])], [("b", BYTES, [1, 1, 64, 64])], "gives no image"),
    ],
)
def test_shapes_that_are_not_those_of_a_segmentation(tmp_path: Path, inputs: list, outputs: list, message: str) -> None:
    ports = [[helper.make_tensor_value_info(*one) for one in some] for some in (inputs, outputs)]
    nodes = [helper.make_node("Identity", ["a"], ["b"])]
    path = save(helper.make_graph(nodes, "g", *ports), tmp_path / "m.onnx")
    with pytest.raises(ModelError, match=message):
        card_of(path)


def test_too_many_classes(tmp_path: Path) -> None:
    names = {k: f"class {k}" for k in range(1001)}
    with pytest.raises(ModelError, match="1001 classes"):
        card_of(brightness_model(tmp_path / "m.onnx", props={"class_names": names}))


def test_without_any_word_the_values_are_taken_as_they_are(tmp_path: Path) -> None:
    card = card_of(brightness_model(tmp_path / "m.onnx"))
    assert (card.mean, card.std, card.threshold) == ((0.0,) * 3, (1.0,) * 3, 0.5)
    assert card.is_probability is True
    assert np.prod(card.tile) == 64 * 64
