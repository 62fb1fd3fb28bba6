"""`roadgeo apply`: other pictures of a located frame."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from worlds.demo import DRONE

from roadgeo.cli import main
from roadgeo.errors import MaskError
from roadgeo.evaluation.demo import PHOTO
from roadgeo.outputs.location_document import read_location

CORNERS = np.array([[0.0, 0.0], [1280.0, 0.0], [1280.0, 960.0], [0.0, 960.0]])


@pytest.fixture(scope="module")
def located(porto: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The location of the demonstration's drone mask, with its photograph drawn by `locate` itself."""
    folder = tmp_path_factory.mktemp("located")
    given = ["-r", str(porto), "--image", str(PHOTO), "--effort", "quick", "-q", "-o", str(folder)]
    assert main(["locate", str(DRONE), *given]) == 0
    return folder


def test_the_photograph_comes_out_as_if_locate_had_drawn_it(located: Path, tmp_path: Path) -> None:
    given = ["--also", "geojson", "--also", "points", "-o", str(tmp_path), "-q"]
    assert main(["apply", str(located / "drone_location.json"), str(PHOTO), *given]) == 0
    names = {path.name for path in tmp_path.iterdir()}
    stem = PHOTO.stem
    assert names == {f"{stem}_footprint.tif", f"{stem}_footprint.geojson", f"{PHOTO.name}.points"}
    with (
        rasterio.open(tmp_path / f"{stem}_footprint.tif") as ours,
        rasterio.open(located / "drone_footprint.tif") as his,
    ):
        assert (ours.transform, ours.crs) == (his.transform, his.crs)
        assert (ours.read() == his.read()).all()


def flat(value: object) -> list[float]:
    """All numbers of a JSON value."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        return [number for item in value for number in flat(item)]
    return [float(value)] if isinstance(value, int | float) else []


def test_what_is_read_is_what_was_written(located: Path) -> None:
    document = json.loads((located / "drone_location.json").read_text())
    reported = read_location(located / "drone_location.json").to_dict()
    for key in ("homography", "footprint", "center", "camera", "corner_covariance_m2", "lens_k1", "size"):
        assert flat(reported[key]) == pytest.approx(flat(document[key]), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize(
    ("crs", "said"), [("EPSG:32629?", "'EPSG:32629\\?' is no CRS that PROJ knows"), ("x" * 900, "'x{60}' is no CRS")]
)
def test_a_crs_that_nobody_knows_is_refused(crs: str, said: str, located: Path, tmp_path: Path) -> None:
    document = json.loads((located / "drone_location.json").read_text())
    (tmp_path / "a_location.json").write_text(json.dumps({**document, "crs": crs}))
    with pytest.raises(MaskError, match=said):
        read_location(tmp_path / "a_location.json")


def test_another_size_is_scaled_and_another_shape_only_where_asked(
    located: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    photo = cv2.imread(str(PHOTO))
    height, width = photo.shape[:2]
    cv2.imwrite("small.png", cv2.resize(photo, (width // 2, height // 2)))
    cv2.imwrite("flat.png", cv2.resize(photo, (width, height // 2)))
    location = str(located / "drone_location.json")
    assert main(["apply", location, "small.png", "-q"]) == 0
    assert main(["apply", location, "flat.png", "-q"]) == 1
    assert "expected the same frame" in capfd.readouterr().err
    assert not Path("flat_footprint.tif").exists()
    assert main(["apply", location, "flat.png", "--stretch", "-q"]) == 0
    with rasterio.open("small_footprint.tif") as small, rasterio.open("flat_footprint.tif") as flat:
        assert np.allclose(small.bounds, flat.bounds, atol=4)


def test_what_is_no_location_is_refused_in_a_line(
    located: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    document = json.loads((located / "drone_location.json").read_text())
    changes = (
        {"homography": [[1, 2], [3, 4]]},
        {"size": [10**9, 5]},
        {"camera": {"x": 1}},
        *({"homography": np.diag([scale, scale, 1.0]).tolist()} for scale in (1e-12, 1.0, 1e300)),
        {"homography": (1e-12 * np.eye(3)).tolist(), "footprint": [[0, 0], [1e-9, 0], [1e-9, 1e-9], [0, 1e-9]]},
        {"homography": np.diag([1e-9, 1e-9, 1.0]).tolist(), "footprint": (1e-9 * CORNERS).tolist()},
    )
    for wrong in ("{", "[]", '{"schema": "other/1"}', *(json.dumps({**document, **change}) for change in changes)):
        Path("a.json").write_text(wrong)
        assert main(["apply", "a.json", str(PHOTO)]) == 1
        assert "give the *_location.json that `roadgeo locate` wrote" in capfd.readouterr().err
    Path("a.json").write_text(json.dumps({**document, "status": "ambiguous"}))
    assert main(["apply", "a.json", str(PHOTO)]) == 3
    assert main(["apply", str(located / "drone_location.json"), str(PHOTO), "--also", "matches"]) == 1
    assert "have `roadgeo locate` write it" in capfd.readouterr().err
    assert {path.name for path in tmp_path.iterdir()} == {"a.json"}
