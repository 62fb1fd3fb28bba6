"""What a model tells of itself: in its metadata, in a STAC item beside it, in the shapes of its inputs and outputs."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from onnx import TensorProto, helper, numpy_helper
from worlds.models import brightness_model, save

from roadgeo.errors import ModelError
from roadgeo.sources.segmentation.card import ModelCard, read_card
from roadgeo.sources.segmentation.onnx_file import open_onnx

FLOAT, BYTES, INT64 = TensorProto.FLOAT, TensorProto.UINT8, TensorProto.INT64


def card_of(path: Path, class_name: str | None = None) -> ModelCard:
    return read_card(open_onnx(path), class_name)


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
        ({}, 0.0, 1.0),
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


def test_the_tile_and_the_pixel_of_an_item(tmp_path: Path) -> None:
    described = item(input={"shape": [-1, 3, 160, 160]})
    described["properties"] |= {"gsd": 0.3, "mlm:tasks": ["semantic-segmentation"]}
    card = card_of(beside(brightness_model(tmp_path / "m.onnx", size=None), described))
    assert (card.tile, card.resolution_m) == ((160, 160), 0.3)


@pytest.mark.parametrize("document", [{}, [], {"properties": {"gsd": 0.3}}, {"properties": {"mlm:input": [{}]}}])
def test_a_document_that_describes_no_model_is_left_alone(tmp_path: Path, document: object) -> None:
    alone = card_of(brightness_model(tmp_path / "m.onnx"))
    assert card_of(beside(tmp_path / "m.onnx", document)) == alone


@pytest.mark.parametrize(
    ("document", "message"),
    [
        (item(value_scaling=[{"type": "clip"}]), "scaled by 'clip'; expected z-score, min-max or scale"),
        ({"properties": {"mlm:input": [{}], "mlm:output": [{"tasks": ["object-detection"]}]}}, "object-detection"),
        (item(value_scaling=[{"type": "z-score"}]), "are invalid"),
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


def model_of(path: Path, inputs: list[tuple], output: tuple) -> Path:
    """A model that gives values of some shape and kind, whatever it takes."""
    ports = [[helper.make_tensor_value_info(*item) for item in some] for some in (inputs, [output])]
    name, kind, shape = output
    constant = numpy_helper.from_array(np.zeros(shape, helper.tensor_dtype_to_np_dtype(kind)))
    return save(helper.make_graph([helper.make_node("Constant", [], [name], value=constant)], "g", *ports), path)


@pytest.mark.parametrize(
    ("inputs", "output", "message"),
    [
        ([("a", FLOAT, [1, 3, 64, 64]), ("c", FLOAT, [1, 3, 64, 64])], None, "takes 2 inputs; expected one"),
        ([("a", INT64, [1, 3, 64, 64])], None, r"takes int64 of shape \(1, 3, 64, 64\); expected float32, float16"),
        ([("a", FLOAT, [1, 4, None, 64])], None, r"takes float32 of shape \(1, 4, any, 64\)"),
        ([("a", FLOAT, [1, 3, 64])], None, r"shape \(1, 3, 64\)"),
        ([("a", FLOAT, [8, 3, 64, 64])], None, r"shape \(8, 3, 64, 64\)"),
        ([("a", FLOAT, [1, 3, 64, 64])], ("b", FLOAT, [1, 7]), "gives no image"),
    ],
)
def test_shapes_that_are_not_those_of_a_segmentation(
    tmp_path: Path, inputs: list, output: tuple | None, message: str
) -> None:
    path = model_of(tmp_path / "m.onnx", inputs, output or ("b", FLOAT, [1, 1, 64, 64]))
    with pytest.raises(ModelError, match=message):
        card_of(path)


@pytest.mark.parametrize(
    ("taken", "last"), [([1, 3, 64, 96], False), ([None, 64, 96, 3], True), ([1, None, 64, 96], False)]
)
@pytest.mark.parametrize("kind", [FLOAT, BYTES, TensorProto.FLOAT16, TensorProto.DOUBLE])
def test_channels_may_come_last_and_numbers_be_others(tmp_path: Path, taken: list, last: bool, kind: int) -> None:
    card = card_of(model_of(tmp_path / "m.onnx", [("a", kind, taken)], ("b", FLOAT, [1, 1, 64, 96])))
    assert (card.tile, card.channels_last) == ((64, 96), last)
    assert np.dtype(card.kind) == helper.tensor_dtype_to_np_dtype(kind)


@pytest.mark.parametrize(
    ("names", "class_name", "channels"),
    [
        (None, None, ()),
        (None, "4", (4,)),
        ({0: "sea", 1: "road", 2: "street"}, None, (1, 2)),
        ({0: "sea", 1: "road", 2: "track"}, "track", (2,)),
    ],
)
@pytest.mark.parametrize("shape", [[1, 1, 64, 64], [1, 64, 64, 1], [1, 64, 64]])
def test_classes_that_are_road(
    tmp_path: Path, shape: list[int], names: dict[int, str] | None, class_name: str | None, channels: tuple[int, ...]
) -> None:
    path = model_of(tmp_path / "m.onnx", [("a", FLOAT, [1, 3, 64, 64])], ("b", INT64, shape))
    if names:
        classes = [{"value": key, "name": name} for key, name in names.items()]
        beside(path, {"properties": {"mlm:input": [{}], "mlm:output": [{"classification:classes": classes}]}})
    card = card_of(path, class_name)
    assert card.gives_classes
    assert card.channels == channels
    with pytest.raises(ModelError, match="no class 'house'"):
        card_of(path, "house")


def test_a_model_that_takes_pictures_as_they_are_scales_them_itself(tmp_path: Path) -> None:
    path = model_of(tmp_path / "m.onnx", [("a", BYTES, [1, 3, 64, 64])], ("b", FLOAT, [1, 1, 64, 64]))
    with pytest.raises(ModelError, match="takes 8-bit values, and values of another mean"):
        card_of(beside(path, item(value_scaling=[Z])))


def test_many_classes_are_not_all_listed(tmp_path: Path) -> None:
    names = {k: f"class {k}" for k in range(1001)}
    with pytest.raises(ModelError, match="99 class 99 and 901 more"):
        card_of(brightness_model(tmp_path / "m.onnx", props={"class_names": names}), "road")


def test_without_any_word_the_values_are_taken_as_they_are(tmp_path: Path) -> None:
    card = card_of(brightness_model(tmp_path / "m.onnx"))
    assert (card.mean, card.std, card.threshold) == ((0.0,) * 3, (1.0,) * 3, 0.5)
    assert card.is_probability is True
    assert np.prod(card.tile) == 64 * 64
