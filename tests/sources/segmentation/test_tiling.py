"""Tiles cover a photograph of any size; what they show does not depend on where they lie."""

from pathlib import Path

import cv2
import numpy as np
import PIL.Image
import pytest
import rasterio
from worlds.models import brightness_model
from worlds.rasters import write_raster
from worlds.turned import save_turned

from roadgeo.errors import MaskError
from roadgeo.roads.thresholds import spread_probability
from roadgeo.sources.masks import open_mask, read_mask
from roadgeo.sources.segmentation import probability
from roadgeo.sources.segmentation.network import load_network
from roadgeo.sources.segmentation.photograph import find_ground, open_photograph
from roadgeo.sources.segmentation.probability import NODATA, ProbabilityMap, mean_of
from roadgeo.sources.segmentation.tiling import _look, segment

MODELS = Path(__file__).parents[2] / "data" / "models"
pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


@pytest.fixture
def network(tmp_path: Path):
    return load_network(brightness_model(tmp_path / "m.onnx", props={"tiles_overlap": 25}))


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    """180 x 150 px, a light street across and one down, on uneven ground."""
    rng = np.random.default_rng(0)
    image = rng.integers(20, 90, (150, 180, 3)).astype(np.uint8)
    image[70:80] = image[:, 100:110] = 230
    path = tmp_path / "photo.png"
    cv2.imwrite(str(path), image)
    return path


def streets(shape=(150, 180)) -> np.ndarray:
    found = np.zeros(shape, bool)
    found[70:80] = found[:, 100:110] = True
    return found


def test_tiles_join_without_seams(network, photo: Path) -> None:
    with open_photograph(photo) as opened:
        found = segment(opened, network)
    assert found.values.shape == (150, 180)
    np.testing.assert_array_equal(found.mask(0.5).roads, streets())
    assert found.mask(0.5).observed is None


@pytest.mark.parametrize(("any_size", "tiles"), [(True, {(160, 128)}), (False, {(128, 128)})])
def test_tiles_are_no_larger_than_they_need_be(
    tmp_path: Path, photo: Path, any_size: bool, tiles: set[tuple[int, int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """150 rows are one tile instead of two; 180 columns are two with a quarter in common, for which 128 are enough."""
    props = {"tiles_overlap": 25, "tiles_size": 128}
    network = load_network(brightness_model(tmp_path / "free.onnx", size=None if any_size else 128, props=props))
    call, shown = type(network).__call__, set()
    monkeypatch.setattr(type(network), "__call__", lambda self, tile: shown.add(tile.shape[:2]) or call(self, tile))
    with open_photograph(photo) as opened:
        found = segment(opened, network)
    assert shown == tiles
    np.testing.assert_array_equal(found.mask(0.5).roads, streets())


@pytest.mark.parametrize(
    ("names", "shown"),
    [
        (("", "", "", ""), (0, 1, 2)),
        (("Blue", "Green", "Red", "NIR"), (2, 1, 0)),
        (("nir", "red", "green", "blue"), (1, 2, 3)),
        (("red", "", "", ""), (0, 1, 2)),
    ],
)
def test_colours_are_taken_by_their_names(tmp_path: Path, names: tuple[str, ...], shown: tuple[int, ...]) -> None:
    bands = np.stack([np.full((70, 80), value, np.uint8) for value in (10, 60, 110, 160)])
    with open_photograph(write_raster(tmp_path / "bands.tif", bands, names=names)) as photograph:
        rgb, _ = photograph.read(0, 0, 80, 70, (70, 80))
    assert tuple(rgb[0, 0]) == tuple(bands[list(shown), 0, 0])


def test_bands_are_taken_in_the_order_asked_for(tmp_path: Path) -> None:
    values = np.array([10, 60, 110, 160], np.uint8)
    path = write_raster(tmp_path / "bgrn.tif", np.tile(values[:, None, None], (1, 70, 80)))
    with open_photograph(path, (3, 2, 1)) as photograph:
        rgb, _ = photograph.read(0, 0, 80, 70, (70, 80))
    assert rgb[0, 0].tolist() == [110, 60, 10]
    with pytest.raises(MaskError, match="has no band 5; expected 1 to 4"), open_photograph(path, (5, 2, 1)):
        pass


@pytest.mark.parametrize("shape", [(64, 64), (70, 300), (90, 66)])
def test_small_photographs_are_filled_up_by_reflection(tmp_path: Path, network, shape: tuple[int, int]) -> None:
    image = np.full((*shape, 3), 30, np.uint8)
    image[:, 20:30] = 240
    cv2.imwrite(str(tmp_path / "small.png"), image)
    with open_photograph(tmp_path / "small.png") as opened:
        found = segment(opened, network, 0.6)
    roads = found.mask(0.5).roads
    assert roads.shape == (round(0.6 * shape[0]), round(0.6 * shape[1]))
    assert roads[:, 14:16].all()
    assert not roads[:, :10].any()


@pytest.mark.parametrize("shape", [(700, 900), (400, 500), (512, 2000), (70, 70)])
def test_a_model_that_crops_its_tiles_sees_the_same_up_to_the_edge(tmp_path: Path, shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(5)
    image = cv2.GaussianBlur(rng.integers(0, 256, (*shape, 3)).astype(np.uint8), (0, 0), 2)
    cv2.imwrite(str(tmp_path / "photo.png"), image)
    with open_photograph(tmp_path / "photo.png") as opened:
        base, cropped = (segment(opened, load_network(MODELS / f"{name}.onnx")) for name in ("base", "crop448"))
    assert np.ptp(base.values.astype(int)) > 20
    assert np.abs(base.values.astype(int) - cropped.values).max() <= 1


def test_voids_are_not_observed(tmp_path: Path, network, photo: Path) -> None:
    image = cv2.imread(str(photo))
    image[:, :60] = 255
    image[95:, 120:] = 0
    rgba = np.concatenate([np.moveaxis(image[..., ::-1], 2, 0), np.full((1, 150, 180), 255, np.uint8)])
    rgba[3, :30] = 0
    with open_photograph(write_raster(tmp_path / "void.tif", rgba, photometric="RGB", alpha="yes")) as opened:
        found = segment(opened, network)
    observed = found.mask(0.5).observed
    assert observed is not None
    assert not observed[:30].any()
    assert not observed[:, :60].any()
    assert not observed[95:, 120:].any()
    assert observed[40:85, 70:].all()


@pytest.mark.parametrize("step", [2, 3, 7])
def test_a_large_photograph_is_kept_at_a_smaller_size(network, photo: Path, step: int) -> None:
    with open_photograph(photo) as opened:
        whole, small = segment(opened, network, step * 0.5), segment(opened, network, step * 0.5, step=step)
    assert small.values.shape == (75, 90)
    expected = cv2.resize(whole.values, (90, 75), interpolation=cv2.INTER_AREA)
    assert np.abs(small.values.astype(int) - expected).max() <= 3


def test_a_photograph_of_nothing_is_refused(tmp_path: Path, network) -> None:
    cv2.imwrite(str(tmp_path / "white.png"), np.full((150, 180, 3), 255, np.uint8))
    with open_photograph(tmp_path / "white.png") as opened, pytest.raises(MaskError, match="shows no ground"):
        segment(opened, network)


@pytest.mark.parametrize("kind", ["grey", "uint16", "palette", "float"])
def test_other_values_are_made_rgb(tmp_path: Path, network, kind: str) -> None:
    ground = np.where(streets(), 220, 50)
    values = {
        "grey": ground.astype(np.uint8),
        "uint16": (ground * 40).astype(np.uint16),
        "palette": streets().astype(np.uint8),
        "float": ground.astype(np.float32) / 7,
    }[kind]
    colors = {0: (50, 50, 50, 255), 1: (220, 220, 220, 255)} if kind == "palette" else None
    with open_photograph(write_raster(tmp_path / "photo.tif", values, colors=colors)) as opened:
        np.testing.assert_array_equal(segment(opened, network).mask(0.5).roads, streets())


@pytest.mark.parametrize("void", [False, True])
def test_a_map_that_was_kept_is_read_as_it_was(tmp_path: Path, void: bool) -> None:
    """So that what is located again rests on the same probability, and on the same observed ground."""
    values = np.full((70, 80), 12, np.uint8)
    values[30:38], values[33:35, :60] = 90, 240
    values[:3, :] = 250  # as a scan's margin, or a border, would look
    if void:
        values[:, 70:] = NODATA
    seen = ProbabilityMap(values, 0.26, "photo.jpg", "m.onnx")
    seen.write(tmp_path / "photo_mask.tif")
    with open_mask(tmp_path / "photo_mask.tif") as opened:
        assert len(opened.thresholds) == 2
        for given, share in zip(opened.thresholds, spread_probability(0.26), strict=True):
            read, made = opened.read(given), seen.mask(share)
            np.testing.assert_array_equal(read.roads, made.roads)
            np.testing.assert_array_equal(read.probability, made.probability)
            assert (read.observed is None) == (made.observed is None) == (not void)
    np.testing.assert_array_equal(read_mask(tmp_path / "photo_mask.tif", threshold=100).probability, values)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_map_of_a_photograph_that_is_to_be_turned_lies_on_its_stored_pixels(tmp_path: Path, orientation: int) -> None:
    """QGIS turns no pictures, and puts the pixels of one without a place below the x axis."""
    values = np.arange(60 * 80, dtype=np.uint8).reshape(60, 80) % 200
    photo = save_turned(tmp_path / "photo.png", values, orientation)
    ProbabilityMap(values, name=str(photo)).write(tmp_path / "photo_mask.tif")
    with PIL.Image.open(photo) as picture, rasterio.open(tmp_path / "photo_mask.tif") as found:
        stored = np.asarray(picture)
        transform = found.transform if orientation > 1 else rasterio.Affine.scale(1, -1)
        for row, column in ((0, 0), (3, 70), (59, 79)):
            x, y = transform @ (column + 0.5, row + 0.5)
            assert stored[int(-y), int(x)] == values[row, column]
    again = read_mask(tmp_path / "photo_mask.tif", threshold=100)
    assert again.shape == (60, 80)


def test_a_map_of_a_large_photograph_lies_on_it(tmp_path: Path) -> None:
    """QGIS draws what has no transform from 0, a unit a pixel, downwards; so are the roads that are traced drawn."""
    seen = ProbabilityMap(np.full((700, 800), 12, np.uint8)).resized((70, 80))
    seen.write(tmp_path / "photo_mask.tif")
    with rasterio.open(tmp_path / "photo_mask.tif") as dataset:
        assert tuple(dataset.bounds) == (0.0, -700.0, 800.0, 0.0)
        assert dataset.crs is None


def test_a_map_on_the_photographs_pixels_has_no_transform(tmp_path: Path) -> None:
    ProbabilityMap(np.full((71, 83), 12, np.uint8), pixel=1.0001).write(tmp_path / "photo_mask.tif")
    with rasterio.open(tmp_path / "photo_mask.tif") as dataset:
        assert dataset.transform.is_identity


def test_another_grid_keeps_what_was_not_observed() -> None:
    values = np.full((60, 80), 200, np.uint8)
    values[:, :40] = NODATA
    for shape in ((30, 40), (120, 160)):
        other = ProbabilityMap(values).resized(shape).values
        assert (other[:, : shape[1] // 2] == NODATA).all()
        assert (other[:, shape[1] // 2 + 2 :] == 200).all()


def test_the_mean_of_two_ways_counts_where_one_observed_nothing() -> None:
    a, b = np.full((50, 60), 127, np.uint8), np.full((100, 120), 127, np.uint8)
    a[:10], b[:20] = 220, 200
    a[20:30], b[40:60] = 240, 10
    a[40:], b[80:] = NODATA, 220
    mean = mean_of([ProbabilityMap(a, name="a"), ProbabilityMap(b, name="b")]).values
    assert 200 <= mean[5, 5] <= 220
    assert 100 < mean[25, 25] < 160
    assert mean[45, 5] == pytest.approx(220, abs=1)
    both = mean_of([ProbabilityMap(np.full((9, 9), NODATA, np.uint8))] * 2).values
    assert (both == NODATA).all()


def test_the_mean_is_taken_strip_by_strip(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a large photograph the numbers with a point would take gigabytes."""
    values = np.random.default_rng(1).integers(0, 256, (2, 70, 40)).astype(np.uint8)
    whole, maps = [], [ProbabilityMap(value, 0.3) for value in values]
    for pixels in (1 << 20, 1000):
        monkeypatch.setattr(probability, "_STRIP_PIXELS", pixels)
        whole.append(mean_of(maps))
    np.testing.assert_array_equal(whole[0].values, whole[1].values)
    assert whole[0].threshold == 0.3


def test_more_ways_average_what_is_seen(network, photo: Path) -> None:
    def sees_the_corner(tile: np.ndarray) -> np.ndarray:
        seen = np.full(tile.shape[:2], 0.1, np.float32)
        seen[: len(seen) // 2, : seen.shape[1] // 2] = 0.9
        return seen

    tile = np.zeros((20, 30, 3), np.uint8)
    np.testing.assert_array_equal(_look(sees_the_corner, 1, tile), sees_the_corner(tile))
    both = _look(sees_the_corner, 2, tile)
    assert both[0, 0] == pytest.approx(0.5)
    assert both[-1, -1] == pytest.approx(0.5)
    assert both[0, -1] == pytest.approx(0.1)
    four = _look(sees_the_corner, 4, tile)
    assert np.ptp(four) < 1e-6
    assert np.isfinite(_look(lambda tile: np.ones(tile.shape[:2], np.float32), 4, tile)).all()
    with open_photograph(photo) as opened:  # a model of single pixels sees the same each way
        item, many = segment(opened, network), segment(opened, network, ways=4)
    np.testing.assert_array_equal(item.mask(0.5).roads, many.mask(0.5).roads)


@pytest.mark.parametrize(
    ("kind", "low", "high"),
    [("uint8", 0, 30), ("uint8", 100, 130), ("uint8", 220, 250), ("uint16", 0, 255), ("float32", 0.0, 0.1)],
)
def test_few_values_are_stretched(tmp_path: Path, kind: str, low: float, high: float) -> None:
    """At night, in haze, of a flat scan."""
    grey = np.random.default_rng(0).random((120, 150))
    path = write_raster(
        tmp_path / "a.tif", (low + (high - low) * grey).round(3 if kind == "float32" else 0).astype(kind)
    )
    with open_photograph(path) as opened:
        rgb, _ = opened.read(0.0, 0.0, 150.0, 120.0, (120, 150))
        assert find_ground(opened, (120, 150)).all()
    assert np.percentile(rgb, 5) < 35
    assert np.percentile(rgb, 95) > 215


@pytest.mark.parametrize(
    ("kind", "fill"),
    [("uint16", 0), ("uint16", 65535), ("int16", -9999), ("float32", -9999.0), ("float32", np.nan), ("uint8", 0)],
)
def test_a_fill_that_no_file_declares_is_no_ground(tmp_path: Path, kind: str, fill: float) -> None:
    values = (60 + 150 * np.random.default_rng(0).random((300, 400))).astype(kind)
    values[:, :120] = fill
    with open_photograph(write_raster(tmp_path / "a.tif", values)) as opened:
        rgb, _ = opened.read(0.0, 0.0, 400.0, 300.0, (300, 400))
        ground = find_ground(opened, (300, 400))
    assert not ground[:, :115].any()
    assert ground[:, 130:].all()
    assert np.ptp(rgb[:, 130:]) > 130


@pytest.mark.parametrize("kind", ["uint8", "uint16"])
def test_a_negative_by_its_tag_is_shown_as_viewers_do(tmp_path: Path, kind: str) -> None:
    values = np.tile(np.linspace(1, 254, 150), (120, 1)).astype(kind)
    path = write_raster(tmp_path / "a.tif", values, photometric="MINISWHITE")
    with open_photograph(path) as opened:
        rgb, _ = opened.read(0.0, 0.0, 150.0, 120.0, (120, 150))
    assert rgb[60, 10, 0] > 200
    assert rgb[60, 140, 0] < 55
