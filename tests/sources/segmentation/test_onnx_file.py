"""ONNX files are looked at before they run; what is more than a network is refused in one line."""

import gzip
from itertools import pairwise
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper
from worlds.models import brightness_model, save

from roadgeo.errors import ModelError
from roadgeo.sources.segmentation import onnx_file
from roadgeo.sources.segmentation.network import load_network
from roadgeo.sources.segmentation.onnx_file import Port, open_onnx

CORPUS = Path(__file__).parents[2] / "corpus"
IMAGE = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, 64, 64])
GIVEN = helper.make_tensor_value_info("road", TensorProto.FLOAT, [1, 1, 64, 64])


def graph_of(nodes, stored=(), inputs=(IMAGE,), sparse=()):
    return helper.make_graph(list(nodes), "g", list(inputs), [GIVEN], list(stored), sparse_initializer=list(sparse))


def node(operator, inputs, outputs, **attributes):
    return helper.make_node(operator, inputs, outputs, **attributes)


def tensor(name, kind, dims, **content):
    made = TensorProto(name=name, data_type=kind, **content)
    made.dims.extend(dims)
    return made


def external():
    made = tensor("w", TensorProto.FLOAT, [1, 3, 1, 1], data_location=TensorProto.EXTERNAL)
    made.external_data.add(key="location", value="/etc/passwd")
    return [node("Conv", ["image", "w"], ["road"])], [made]


def loop():
    body = helper.make_graph(
        [node("Identity", ["go"], ["on"]), node("Identity", ["x"], ["y"])],
        "body",
        [
            helper.make_tensor_value_info("i", TensorProto.INT64, []),
            helper.make_tensor_value_info("go", TensorProto.BOOL, []),
            helper.make_tensor_value_info("x", TensorProto.FLOAT, None),
        ],
        [
            helper.make_tensor_value_info("on", TensorProto.BOOL, []),
            helper.make_tensor_value_info("y", TensorProto.FLOAT, None),
        ],
    )
    return [node("Loop", ["", "", "image"], ["road"], body=body)], []


def constant_attribute():
    lying = tensor("", TensorProto.FLOAT, [1 << 20, 1 << 20], raw_data=b"1234")
    return [node("Constant", [], ["road"], value=lying)], []


HOSTILE = {
    "external data": (external, "another file"),
    "custom operator": (lambda: ([node("Evil", ["image"], ["road"], domain="com.evil")], []), r"com\.evil\.Evil"),
    "loop": (loop, "control flow"),
    "random": (lambda: ([node("RandomNormalLike", ["image"], ["road"])], []), "random"),
    "gigabyte initialiser": (
        lambda: ([node("Conv", ["image", "w"], ["road"])], [tensor("w", TensorProto.FLOAT, [1 << 16, 1 << 16])]),
        "cannot be loaded",
    ),
    "negative size": (
        lambda: ([node("Conv", ["image", "w"], ["road"])], [tensor("w", TensorProto.FLOAT, [-5])]),
        "cannot be loaded",
    ),
    "constant that lies": (constant_attribute, "cannot be loaded"),
    "text": (
        lambda: (
            [node("Cast", ["image"], ["t"], to=TensorProto.STRING), node("StringConcat", ["t", "t"], ["road"])],
            [],
        ),
        "uses text",
    ),
    "patterns": (lambda: ([node("RegexFullMatch", ["image"], ["road"], pattern="(a*)*b")], []), "uses text"),
    "strings": (lambda: ([], [tensor("w", TensorProto.STRING, [1], string_data=[b"x"])]), "a tensor of text"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_what_is_more_than_a_network_is_refused(tmp_path: Path, name: str) -> None:
    build, message = HOSTILE[name]
    path = save(graph_of(*build()), tmp_path / "model.onnx")
    with pytest.raises(ModelError, match=message) as raised:
        load_network(path)
    assert "\n" not in str(raised.value)
    assert str(path) in str(raised.value)


def ints(name, *values):
    return numpy_helper.from_array(np.array(values), name)


GROWING = {
    "ConstantOfShape": ([node("ConstantOfShape", ["s"], ["road"])], [ints("s", 1, 1, 100_000, 100_000)]),
    "Expand": ([node("Expand", ["image", "s"], ["road"])], [ints("s", 1_000_000, 3, 64, 64)]),
    "Tile": ([node("Tile", ["image", "s"], ["road"])], [ints("s", 1, 1, 1_000, 10_000)]),
    "Pad": ([node("Pad", ["image", "s"], ["road"])], [ints("s", 0, 0, 0, 0, 0, 0, 1_000_000, 1_000)]),
    "ConvTranspose": (
        [node("ConvTranspose", ["image", "w"], ["road"], strides=[4_000, 4_000])],
        [numpy_helper.from_array(np.ones((3, 1, 3, 3), np.float32), "w")],
    ),
    "OneHot": (
        [node("Cast", ["image"], ["i"], to=TensorProto.INT64), node("OneHot", ["i", "s", "v"], ["road"])],
        [ints("s", 10_000_000), numpy_helper.from_array(np.array([0, 1], np.float32), "v")],
    ),
    "a size that is computed": (
        [node("Mul", ["s", "s"], ["t"]), node("ConstantOfShape", ["t"], ["road"])],
        [ints("s", 1, 1, 1_000, 1_000)],
    ),
    "every value by every": (
        [
            *(node("Reshape", ["image", "c"], ["a"]), node("Reshape", ["image", "r"], ["b"])),
            *(node("MatMul", ["a", "b"], ["m"]), node("Reshape", ["m", "c"], ["n"]), node("Mul", ["n", "b"], ["road"])),
        ],
        [ints("c", -1, 1), ints("r", 1, -1)],
    ),
}


@pytest.mark.parametrize("name", GROWING)
def test_what_grows_beyond_measure_fails_at_once(tmp_path: Path, name: str) -> None:
    nodes, stored = GROWING[name]
    given = helper.make_tensor_value_info("road", TensorProto.FLOAT, None)
    path = save(helper.make_graph(nodes, "g", [IMAGE], [given], stored), tmp_path / "model.onnx")
    with pytest.raises(ModelError, match=r"fails while it runs|cannot be loaded") as raised:
        open_onnx(path).run("road", np.zeros((1, 3, 64, 64), np.float32))
    assert "\n" not in str(raised.value)


def test_a_model_that_takes_too_long_is_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("roadgeo.sources.segmentation.onnx_file._MAX_SECONDS", 0.05)
    weight = numpy_helper.from_array(np.ones((3, 3, 31, 31), np.float32), "w")
    names = ["image", *(f"x{k}" for k in range(999)), "road"]
    nodes = [node("Conv", [a, "w"], [b], pads=[15] * 4) for a, b in pairwise(names)]
    path = save(graph_of(nodes, [weight]), tmp_path / "model.onnx")
    with pytest.raises(ModelError, match="fails while it runs"):
        open_onnx(path).run("road", np.zeros((1, 3, 64, 64), np.float32))


def test_functions_are_refused(tmp_path: Path) -> None:
    path = brightness_model(tmp_path / "model.onnx")
    model = onnx.load(str(path))
    twin = helper.make_function(
        "own", "twin", ["x"], ["y"], [node("Identity", ["x"], ["y"])], [helper.make_opsetid("", 17)]
    )
    model.functions.append(twin)
    onnx.save(model, str(path))
    with pytest.raises(ModelError, match="functions"):
        open_onnx(path)


def test_a_network_is_read(tmp_path: Path) -> None:
    model = open_onnx(brightness_model(tmp_path / "model.onnx", classes=2, props={"resolution": 50}))
    assert model.inputs == (Port("image", "float32", (1, 3, 64, 64)),)
    assert model.outputs == (Port("output", "float32", (1, 2, 64, 64)),)
    assert model.last["output"] == "Sigmoid"
    assert model.metadata == {"resolution": "50"}


@pytest.mark.parametrize("left", [0.0, 0.01, 0.1, 0.5, 0.95])
def test_what_is_damaged_is_said_to_be(tmp_path: Path, left: float) -> None:
    path = brightness_model(tmp_path / "model.onnx")
    whole = path.read_bytes()
    path.write_bytes(whole[: int(left * len(whole))])
    with pytest.raises(ModelError, match="not an ONNX model"):
        open_onnx(path)


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="no such model"):
        open_onnx(tmp_path / "none.onnx")


def test_a_compressed_model_is_read_within_bounds(tmp_path: Path) -> None:
    plain = brightness_model(tmp_path / "model.onnx", classes=2, props={"resolution": 50})
    packed = tmp_path / "model.onnx.gz"
    packed.write_bytes(gzip.compress(Path(plain).read_bytes()))
    assert open_onnx(packed).metadata == open_onnx(plain).metadata
    packed.write_bytes(packed.read_bytes()[:-9])
    with pytest.raises(ModelError, match="cannot be unpacked"):
        open_onnx(packed)
    packed.write_bytes(gzip.compress(bytes(20_000_000)))
    with pytest.raises(ModelError, match="unpacks to more than 4 times its size"):
        open_onnx(packed)


def test_a_file_that_is_two_networks_is_refused(tmp_path: Path) -> None:
    """onnxruntime would take it for its own format; if it came to that, it reads the network that was looked at."""
    content = b"\x12\x06xxORTM" + (CORPUS / "onnx" / "plain.onnx").read_bytes()
    (tmp_path / "two.onnx").write_bytes(content)
    with pytest.raises(ModelError, match="in onnxruntime's own format, which cannot be looked at"):
        open_onnx(tmp_path / "two.onnx")
    assert onnx_file._open_session(content, 1).get_outputs()
