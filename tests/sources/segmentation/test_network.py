"""Models in the conventions of others run unchanged, or one line says what is wrong with them."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from onnx import TensorProto, helper, numpy_helper
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
TWO_CLASSES = {"model_type": "Segmentor", "class_names": {"0": "background", "1": "highway"}, "resolution": 50.0}


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


def test_a_model_of_two_classes(tmp_path: Path, picture: np.ndarray) -> None:
    path = brightness_model(tmp_path / "two.onnx", classes=2, road=1, last=None, props=TWO_CLASSES)
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
        tmp_path / "m.onnx", classes=classes, road=classes // 2, last=last, shrink=shrink, props={"class_names": names}
    )
    sees(load_network(path), picture)


def test_free_sizes_follow_the_metadata(tmp_path: Path) -> None:
    path = brightness_model(tmp_path / "m.onnx", size=None, props={"tiles_size": 130})
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


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"props": {"model_type": "Detector"}}, "model for Detector"),
        ({"classes": 2}, "names no class after roads .* --class"),
        ({"classes": 2, "props": {"class_names": {0: "sea", 1: "land"}}}, "0 sea, 1 land"),
        ({"props": {"resolution": -5}}, "are invalid"),
        ({"props": {"resolution": "wide"}}, "are invalid"),
        ({"props": {"standardization_std": [0, 0, 0]}}, "are invalid"),
        ({"props": {"standardization_mean": [1, 2]}}, "are invalid"),
        ({"props": {"tiles_overlap": 200}}, "are invalid"),
        ({"props": {"class_names": 7}}, "are invalid"),
        ({"raw_props": {"seg_thresh": "["}}, "are invalid"),
        ({"size": 8}, "tiles of 8 x 8"),
        ({"size": None, "props": {"tiles_size": 100_000}}, "tiles of"),
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


# --- layouts: files of `data/models` hold the same model in the ways in which people export theirs -------------------

MODELS = Path(__file__).parents[2] / "data" / "models"


def streets(side: int = 512) -> np.ndarray:
    """Light streets of some widths on dark, uneven ground."""
    rng = np.random.default_rng(3)
    image = cv2.GaussianBlur(rng.integers(20, 90, (side, side, 3)).astype(np.uint8), (0, 0), 2)
    for at, to in rng.integers(0, side, (14, 2, 2)):
        cv2.line(image, tuple(map(int, at)), tuple(map(int, to)), (225, 220, 215), int(rng.integers(5, 13)))
    return image


def likeness(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])


@pytest.mark.parametrize(
    ("name", "alike"), [("fp16", 0.9999), ("nhwc", 0.9999), ("uint8", 0.9999), ("argmax", 0.95), ("half", 0.95)]
)
def test_a_model_is_read_in_every_layout(name: str, alike: float) -> None:
    base, other = load_network(MODELS / "base.onnx"), load_network(MODELS / f"{name}.onnx")
    assert other.seen == other.card.tile == (512, 512)
    assert likeness(base(streets()), other(streets())) > alike


def test_a_model_that_crops_its_tiles_is_read_as_their_middle(caplog: pytest.LogCaptureFixture) -> None:
    base, cropped = load_network(MODELS / "base.onnx"), load_network(MODELS / "crop448.onnx")
    assert (cropped.seen, cropped.margin) == ((448, 448), (32, 32))
    np.testing.assert_array_equal(cropped(streets()), base(streets())[32:-32, 32:-32])
    assert "crop448.onnx: gives 448 x 448 pixels of tiles of 512 x 512: taken for their middle" in caplog.text


def resized_model(path: Path, stated: list[int | None], crop: int, stride: int, stretch: int = 0) -> Path:
    """A model that leaves out `crop` pixels on each side, and gives one for each `stride`, or so many in all."""
    weight = numpy_helper.from_array(np.full((1, 3, 1, 1), 20 / 3, np.float32), "w")
    nodes = [helper.make_node("Conv", ["image", "w"], ["seen"])]
    stored = [weight, numpy_helper.from_array(np.array([crop, crop]), "low")]
    stored += [
        numpy_helper.from_array(np.array([256 - crop] * 2), "high"),
        numpy_helper.from_array(np.array([2, 3]), "axes"),
        numpy_helper.from_array(np.array([1, 1, stretch or 1, stretch or 1]), "size"),
    ]
    nodes += [helper.make_node("Slice", ["seen", "low", "high", "axes"], ["middle"])]
    if stretch:
        nodes += [helper.make_node("Resize", ["middle", "", "", "size"], ["road"], mode="linear")]
    else:
        sides = {"kernel_shape": [stride] * 2, "strides": [stride] * 2}
        nodes += [helper.make_node("AveragePool", ["middle"], ["road"], **sides)]
    ports = (("image", [1, 3, 256, 256]), ("road", [1, 1, *stated]))
    taken, given = ([helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)] for name, shape in ports)
    return save(helper.make_graph(nodes, "g", taken, given, stored), path)


@pytest.mark.parametrize(
    ("side", "crop", "stride", "stretch", "seen"),
    [
        (256, 0, 1, 0, 256),
        (64, 0, 4, 0, 256),
        (216, 20, 1, 0, 216),
        (108, 20, 2, 0, 216),
        (128, 64, 1, 0, 128),  # half of the tile, cropped, not in larger pixels
        (224, 0, 1, 224, 256),  # all of it, in larger pixels
        (512, 0, 1, 512, 256),
    ],
)
@pytest.mark.parametrize("is_stated", [True, False])
def test_what_is_seen_of_a_tile_is_told_by_what_moves(
    tmp_path: Path, side: int, crop: int, stride: int, stretch: int, seen: int, is_stated: bool
) -> None:
    stated = [side, side] if is_stated else [None, None]
    network = load_network(resized_model(tmp_path / "m.onnx", stated, crop, stride, stretch))
    assert network.seen == (seen, seen)
    whole = load_network(resized_model(tmp_path / "whole.onnx", [256, 256], 0, 1))(streets(256))
    edge = (256 - seen) // 2
    assert likeness(network(streets(256)), whole[edge : edge + seen, edge : edge + seen]) > 0.85


def test_classes_without_names(tmp_path: Path) -> None:
    ports = [
        [helper.make_tensor_value_info("image", TensorProto.UINT8, [1, 3, 64, 64])],
        [helper.make_tensor_value_info("classes", TensorProto.INT64, [1, 64, 64])],
    ]
    nodes = [helper.make_node("ArgMax", ["image"], ["classes"], axis=1, keepdims=0)]
    path = save(helper.make_graph(nodes, "g", *ports), tmp_path / "m.onnx")
    picture = np.zeros((64, 64, 3), np.uint8)
    picture[:20, :, 1] = picture[40:, :, 2] = 9
    with pytest.raises(ModelError, match=r"m\.onnx: gives the classes 1, 2; choose the road: --class NUMBER"):
        load_network(path)(picture)
    np.testing.assert_array_equal(load_network(path, class_name="2")(picture) > 0.5, picture[..., 2] > 0)
    picture[:20] = 0
    np.testing.assert_array_equal(load_network(path)(picture) > 0.5, picture[..., 2] > 0)


def one_node(path: Path, operator: str, names: tuple[str, ...] = ("road", "a", "b"), **attributes: object) -> Path:
    """A model of one operator, whose output is said to be an image of a road."""
    shape = [1, 3, 64, 64]
    ports = [[helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)] for name in ("image", "road")]
    graph = helper.make_graph([helper.make_node(operator, ["image"], ["road"], **attributes)], "g", *ports)
    return save(graph, path, props={"class_names": dict(enumerate(names))})


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
    path = one_node(tmp_path / "m.onnx", "Flatten", ("road",), axis=2)
    with pytest.raises(ModelError, match=r"gives an array of shape \(3, 4096\)"):
        load_network(path)


def test_without_onnxruntime_the_command_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ModelError, match=r"-m pip install onnxruntime"):
        load_network(DEFAULT_MODEL)


def test_without_the_model_that_ships_one_is_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("roadgeo.sources.segmentation.network.DEFAULT_MODEL", tmp_path / "none.onnx")
    with pytest.raises(ModelError, match="give one that finds roads: --segmenter"):
        load_network()
