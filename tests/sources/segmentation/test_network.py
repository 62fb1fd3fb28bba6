"""Models in the conventions of others run unchanged, or one line says what is wrong with them."""

import json
from pathlib import Path

import numpy as np
import pytest
from onnx import TensorProto, helper
from worlds.models import brightness_model, save

from roadgeo.errors import ModelError
from roadgeo.sources.segmentation.network import DEFAULT_MODEL, load_network

DEEPNESS = {
    "model_type": "Segmentor",
    "class_names": {0: "not_road", 1: "road"},
    "resolution": 20,
    "tiles_size": 64,
    "tiles_overlap": 15,
    "seg_thresh": 0.4,
}
GEODEEP = {"model_type": "Segmentor", "class_names": {"0": "background", "1": "highway"}, "resolution": 50.0}


@pytest.fixture
def picture() -> np.ndarray:
    """Dark on the left, light on the right."""
    image = np.full((64, 64, 3), 40, np.uint8)
    image[:, 32:] = 220
    return image


def sees(network, picture) -> None:
    road = network(picture)
    assert road.shape == (64, 64)
    assert road.dtype == np.float32
    assert road[:, :28].max() < 0.1
    assert road[:, 36:].min() > 0.9


def test_a_model_of_deepness(tmp_path: Path, picture: np.ndarray) -> None:
    network = load_network(brightness_model(tmp_path / "deepness.onnx", props=DEEPNESS))
    assert network.card.resolution_m == 0.2
    assert network.card.overlap == 0.15
    assert network.card.threshold == 0.4
    sees(network, picture)


def test_a_model_of_geodeep(tmp_path: Path, picture: np.ndarray) -> None:
    path = brightness_model(tmp_path / "geodeep.onnx", classes=2, road=1, last=None, props=GEODEEP)
    network = load_network(path)
    assert network.card.channels == (1,)
    assert network.card.tile == (64, 64)
    sees(network, picture)


@pytest.mark.parametrize("last", ["Sigmoid", "Softmax", None, "LogSoftmax"])
@pytest.mark.parametrize("classes", [1, 3])
@pytest.mark.parametrize("shrink", [1, 4])
def test_sigmoid_softmax_or_logits(
    tmp_path: Path, picture: np.ndarray, last: str | None, classes: int, shrink: int
) -> None:
    if classes == 1 and last in ("Softmax", "LogSoftmax"):
        pytest.skip("one class has no softmax")
    names = {0: "road"} if classes == 1 else {0: "not road", 1: "street", 2: "railroad"}
    path = brightness_model(
        tmp_path / "m.onnx", classes=classes, road=classes // 2, last=last, shrink=shrink, props={"names": names}
    )
    sees(load_network(path), picture)


def test_free_sizes_follow_the_metadata(tmp_path: Path) -> None:
    path = brightness_model(tmp_path / "m.onnx", size=None, props={"tile_size": 130})
    assert load_network(path).card.tile == (128, 128)


def test_standardization(tmp_path: Path) -> None:
    props = {"standardization_mean": [0.5, 0.5, 0.5], "standardization_std": [0.25, 0.25, 0.25]}
    network = load_network(brightness_model(tmp_path / "m.onnx", props=props))
    value = network(np.full((64, 64, 3), 159, np.uint8))[0, 0]
    assert value == pytest.approx(1 / (1 + np.exp(-(20 * ((159 / 255 - 0.5) / 0.25) - 10))), rel=1e-4)


def test_the_head_of_roads_is_chosen(tmp_path: Path, picture: np.ndarray) -> None:
    path = brightness_model(tmp_path / "m.onnx", heads=("buildings", "road"))
    network = load_network(path)
    assert network.card.output == "road"
    sees(network, picture)
    assert load_network(path, class_name="buildings").card.output == "buildings"


def test_a_stac_item_beside_the_model(tmp_path: Path, picture: np.ndarray) -> None:
    path = brightness_model(tmp_path / "m.onnx", classes=2, road=1, last=None)
    item = {
        "type": "Feature",
        "properties": {
            "gsd": 0.3,
            "mlm:tasks": ["semantic-segmentation"],
            "mlm:input": [
                {
                    "input": {"shape": [1, 3, 64, 64], "dim_order": ["batch", "channel", "height", "width"]},
                    "value_scaling": [{"type": "min-max", "minimum": 0, "maximum": 255}],
                }
            ],
            "mlm:output": [
                {"classification:classes": [{"value": 0, "name": "background"}, {"value": 1, "name": "roads"}]}
            ],
        },
    }
    path.with_suffix(".json").write_text(json.dumps(item))
    network = load_network(path)
    assert network.card.resolution_m == 0.3
    assert network.card.mean == (0.0, 0.0, 0.0)
    assert network.card.std == (1.0, 1.0, 1.0)
    assert network.card.channels == (1,)
    sees(network, picture)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"props": {"model_type": "Detector"}}, "model for Detector"),
        ({"classes": 2}, "names no class after roads .* --class"),
        ({"classes": 2, "props": {"class_names": {0: "sea", 1: "land"}}}, "0 sea, 1 land"),
        ({"props": {"resolution": -5}}, "make no sense"),
        ({"props": {"resolution": "wide"}}, "make no sense"),
        ({"props": {"standardization_std": [0, 0, 0]}}, "make no sense"),
        ({"props": {"standardization_mean": [1, 2]}}, "make no sense"),
        ({"props": {"tiles_overlap": 200}}, "make no sense"),
        ({"props": {"class_names": 7}}, "make no sense"),
        ({"raw_props": {"seg_thresh": "["}}, "make no sense"),
        ({"raw_props": {"ways": "5"}}, "ways 5, expected 1 to 4"),
        ({"size": 8}, "tiles of 8 x 8"),
        ({"size": None, "props": {"tile_size": 100_000}}, "tiles of"),
    ],
)
def test_what_cannot_be_run_is_said(tmp_path: Path, options: dict, message: str) -> None:
    path = brightness_model(tmp_path / "m.onnx", **options)
    with pytest.raises(ModelError, match=message) as raised:
        load_network(path)
    assert "\n" not in str(raised.value)


def test_the_class_can_be_named(tmp_path: Path) -> None:
    path = brightness_model(tmp_path / "m.onnx", classes=2, props={"class_names": {0: "grey", 1: "green"}})
    assert load_network(path, class_name="grey").card.channels == (0,)
    assert load_network(path, class_name="1").card.channels == (1,)
    with pytest.raises(ModelError, match="no class 'blue'"):
        load_network(path, class_name="blue")


def one_node(path: Path, operator: str, **attributes: object) -> Path:
    """A model of one operator, whose output is said to be an image of a road."""
    shape = [1, 3, 64, 64]
    ports = [[helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)] for name in ("image", "road")]
    graph = helper.make_graph([helper.make_node(operator, ["image"], ["road"], **attributes)], "g", *ports)
    return save(graph, path, props={"class_names": {0: "road", 1: "a", 2: "b"}})


def test_values_between_0_and_1_are_taken_for_probabilities(tmp_path: Path) -> None:
    network = load_network(one_node(tmp_path / "m.onnx", "Identity"))
    assert network(np.full((64, 64, 3), 51, np.uint8)) == pytest.approx(np.full((64, 64), 0.2))


def test_a_model_that_cannot_be_loaded(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"cannot be loaded .* made for a newer version") as raised:
        load_network(one_node(tmp_path / "m.onnx", "NoSuchOperator"))
    assert "\n" not in str(raised.value)


def test_a_model_that_fails_while_it_runs(tmp_path: Path) -> None:
    network = load_network(brightness_model(tmp_path / "m.onnx"))
    with pytest.raises(ModelError, match=r"fails while it runs .*; is it made for RGB pictures") as raised:
        network(np.zeros((32, 32, 3), np.uint8))
    assert "\n" not in str(raised.value)


def test_a_model_that_gives_no_image(tmp_path: Path) -> None:
    path = one_node(tmp_path / "m.onnx", "Flatten", axis=2)
    with pytest.raises(ModelError, match=r"gives an array of shape \(3, 4096\)"):
        load_network(path)


def test_without_onnxruntime_the_command_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ModelError, match=r"pip install 'roadgeo\[segment\]'"):
        load_network(DEFAULT_MODEL)


def test_without_the_model_that_ships_one_is_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("roadgeo.sources.segmentation.network.DEFAULT_MODEL", tmp_path / "none.onnx")
    with pytest.raises(ModelError, match="give one that finds roads: --segmenter"):
        load_network()
