"""Any raster becomes a road mask, or one line says why not."""

import itertools
import logging
import re
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
import pytest
import rasterio
from worlds.rasters import write_raster

from roadgeo.errors import MaskError, PhotographError
from roadgeo.running.pictures import read_picture
from roadgeo.sources.bands import Choice
from roadgeo.sources.masks import open_mask, read_mask

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")

SHAPE = (80, 100)
ROWS, COLUMNS = np.indices(SHAPE)
PATCH = np.ones((40, 25), np.uint8)


@pytest.fixture
def roads() -> np.ndarray:
    """Three streets across the frame."""
    image = np.zeros(SHAPE, np.uint8)
    for line in ([(0, 20), (100, 30)], [(40, 0), (30, 80)], [(70, 0), (80, 80)]):
        cv2.line(image, *line, 1, 5)
    return image.astype(bool)


LOSSY = {".jpg", ".webp", ".jp2"}


@pytest.mark.parametrize(
    ("suffix", "light"),
    [(s, 1) for s in (".png", ".bmp", ".tif")] + [(s, 255) for s in (".png", ".tif", *sorted(LOSSY))],
)
def test_formats(tmp_path: Path, roads: np.ndarray, suffix: str, light: int) -> None:
    path = tmp_path / f"mask{suffix}"
    assert cv2.imwrite(str(path), roads * np.uint8(light))
    mask = read_mask(path, voids=False)
    assert mask.name == str(path)
    assert mask.observed is None
    assert np.mean(mask.roads != roads) < (0.02 if suffix in LOSSY else 1e-9)


@pytest.mark.parametrize(
    ("dtype", "dark", "light"),
    [
        ("bool", 0, 1),
        ("uint8", 0, 1),
        ("uint8", 3, 200),
        ("uint16", 0, 65535),
        ("uint16", 0, 7),
        ("int16", -1, 1),
        ("int32", 0, 100_000),
        ("float32", 0, 1),
        ("float64", -4.0, 4.0),
    ],
)
def test_types_of_values(roads: np.ndarray, dtype: str, dark: float, light: float) -> None:
    values = np.where(roads, light, dark).astype(dtype)
    np.testing.assert_array_equal(read_mask(values).roads, roads)
    np.testing.assert_array_equal(read_mask(values[..., None]).roads, roads)


def test_probabilities_are_parted_at_a_half(roads: np.ndarray) -> None:
    soft = np.clip(cv2.GaussianBlur(roads.astype(np.float32), (0, 0), 1.0), 0, 1)
    np.testing.assert_array_equal(read_mask(soft).roads, soft > 0.5)
    np.testing.assert_array_equal(read_mask(soft, threshold=0.2).roads, soft > 0.2)
    bytes_ = np.rint(soft * 255).astype(np.uint8)
    np.testing.assert_array_equal(read_mask(bytes_).roads, bytes_ > 127)
    np.testing.assert_array_equal(read_mask(bytes_, threshold=100.5).roads, bytes_ > 100)


def test_scores_are_parted_where_they_part(roads: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    scores = np.where(roads, 5.0, -3.0) + rng.normal(0, 0.3, SHAPE)
    np.testing.assert_array_equal(read_mask(scores).roads, roads)


def test_a_band_is_chosen(tmp_path: Path, roads: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    bands = rng.integers(0, 255, (5, *SHAPE)).astype(np.uint8)
    bands[3] = roads * 255
    path = write_raster(tmp_path / "bands.tif", bands)
    np.testing.assert_array_equal(read_mask(path, band=4).roads, roads)
    np.testing.assert_array_equal(read_mask(np.moveaxis(bands, 0, 2), band=4).roads, roads)
    with pytest.raises(MaskError, match="has 5 bands; choose"):
        read_mask(path)
    with pytest.raises(MaskError, match="no band 6; expected 1 to 5"):
        read_mask(path, band=6)


@pytest.mark.parametrize(
    ("dark", "light"),
    [
        ((0, 0, 0), (255, 255, 255)),
        ((0, 0, 0), (0, 0, 255)),
        ((0, 0, 0), (10, 200, 90)),
        ((0, 128, 0), (255, 255, 255)),
        ((9, 40, 9), (90, 0, 250)),
    ],
)
def test_two_colours_are_road_and_no_road(
    tmp_path: Path, roads: np.ndarray, dark: tuple[int, ...], light: tuple[int, ...]
) -> None:
    path = tmp_path / "drawing.png"
    cv2.imwrite(str(path), np.array([dark, light], np.uint8)[roads.astype(int)])
    np.testing.assert_array_equal(read_mask(path).roads, roads)


@pytest.mark.parametrize("ending", [".png", ".jpg", "array"])
@pytest.mark.parametrize(
    ("ground", "road"),
    [
        ((0, 0, 0), (255, 0, 0)),
        ((255, 255, 255), (255, 0, 0)),
        ((255, 255, 255), (255, 255, 0)),
        ((0, 120, 0), (255, 0, 0)),
        ((68, 1, 84), (253, 231, 37)),
    ],
)
def test_mixtures_of_two_colours_are_smooth_edges(
    tmp_path: Path, roads: np.ndarray, ground: tuple[int, ...], road: tuple[int, ...], ending: str
) -> None:
    shares = cv2.GaussianBlur(np.kron(roads, np.ones((4, 4))), (0, 0), 1.0)[..., None]
    drawing = np.rint(shares * road + (1 - shares) * ground).astype(np.uint8)
    if ending != "array":
        PIL.Image.fromarray(drawing).save(tmp_path / f"a{ending}", quality=75)
    found = read_mask(drawing if ending == "array" else tmp_path / f"a{ending}", voids=False).roads
    assert np.mean(found == (shares[..., 0] > 0.5)) > 0.99


@pytest.mark.parametrize("ending", [".png", ".jpg"])
def test_a_photograph_of_two_colours_is_no_drawing(tmp_path: Path, roads: np.ndarray, ending: str) -> None:
    """No two pixels of a photograph are the same for long."""
    large = np.kron(roads, np.ones((4, 4), bool))[..., None]
    grain = np.random.default_rng(0).normal(0, 6, (*large.shape[:2], 1))
    picture = np.clip(np.where(large, (200, 200, 190), (60, 90, 50)) + grain, 0, 255).astype(np.uint8)
    PIL.Image.fromarray(picture).save(tmp_path / f"a{ending}", quality=90)
    with pytest.raises(PhotographError):
        read_mask(tmp_path / f"a{ending}")


@pytest.mark.parametrize("library", ["file", "PIL"])
@pytest.mark.parametrize("colour", [(255, 0, 0), (255, 255, 255), (0, 0, 0)])
def test_smooth_edges_of_alpha_do_not_widen_roads(
    tmp_path: Path, roads: np.ndarray, colour: tuple[int, ...], library: str
) -> None:
    shares = cv2.GaussianBlur(np.kron(roads, np.ones((4, 4))), (0, 0), 3.0)
    alpha = np.rint(200 * shares).astype(np.uint8)
    drawing = np.dstack([np.full((*alpha.shape, 3), colour, np.uint8), alpha])
    PIL.Image.fromarray(drawing).save(tmp_path / "a.png")
    source = tmp_path / "a.png" if library == "file" else read_picture(PIL.Image.open(tmp_path / "a.png"))
    found = read_mask(source, voids=False).roads
    assert found.sum() == pytest.approx((shares > 0.5).sum(), rel=0.1)


@pytest.mark.parametrize("others", [2, 3, 127])
@pytest.mark.parametrize("kind", [np.uint8, np.int32, "palette"])
def test_classes_beside_roads_are_asked_for(tmp_path: Path, roads: np.ndarray, others: int, kind: object) -> None:
    """What is numbered next to roads, such as buildings, is no fainter or surer road."""
    houses = (
        ((ROWS // 12) % 2 == 1)
        & ((COLUMNS // 12) % 3 == 1)
        & ~cv2.dilate(roads.astype(np.uint8), PATCH[:5, :5]).astype(bool)
    )
    road = 255 if others == 127 else 1
    values = np.where(roads, road, np.where(houses, others, 0))
    source = values.astype(np.uint8 if kind == "palette" else kind)
    if kind == "palette":
        source = write_raster(tmp_path / "a.tif", source, colors={k: (k, 90, 255 - k, 255) for k in range(256)})
    with pytest.raises(MaskError, match=r"holds the classes 0, .*--class N"):
        read_mask(source)
    with open_mask(source, choice=Choice(road_class=road)) as mask:
        np.testing.assert_array_equal(mask.read(mask.thresholds[0]).roads, roads)


def test_a_palette(tmp_path: Path, roads: np.ndarray) -> None:
    colors = {0: (255, 255, 255, 255), 1: (200, 0, 0, 255)}
    path = write_raster(tmp_path / "a.tif", roads.astype(np.uint8), colors=colors, photometric="palette")
    np.testing.assert_array_equal(read_mask(path).roads, roads)


def test_a_photograph_in_a_palette(tmp_path: Path, roads: np.ndarray) -> None:
    """Numbers of its colours mean nothing: here they are high on roads, which are no lighter than the ground."""
    numbers = np.random.default_rng(0).integers(0, 19, roads.shape)
    values = np.where(roads, 237 + numbers, numbers).astype(np.uint8)
    shown = zip([*range(19), *range(237, 256)], ground().reshape(3, -1).T[::7][:38], strict=True)
    colors = {i: (*map(int, color), 255) for i, color in shown}
    with pytest.raises(PhotographError, match="looks like a photograph"):
        read_mask(write_raster(tmp_path / "photo.tif", values, colors=colors, photometric="palette"))


@pytest.mark.parametrize("kind", ["nodata", "nan", "alpha", "alpha png", "masked array", "mask band"])
def test_what_was_not_observed(tmp_path: Path, roads: np.ndarray, kind: str) -> None:
    seen = np.ones(SHAPE, bool)
    seen[:, 60:] = False
    values = roads * np.uint8(255)
    path = tmp_path / "mask.tif"
    source: object = path
    if kind == "nodata":
        write_raster(path, np.where(seen, values, 7)[None], nodata=7)
    elif kind == "nan":
        write_raster(path, np.where(seen, roads, np.nan).astype(np.float32)[None])
    elif kind == "alpha":
        write_raster(path, np.stack([values] * 3 + [seen * np.uint8(255)]), photometric="RGB", alpha="yes")
    elif kind == "alpha png":
        source = tmp_path / "mask.png"
        cv2.imwrite(str(source), np.dstack([values] * 3 + [seen * np.uint8(255)]))
    elif kind == "mask band":
        with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True):
            write_raster(path, values[None])
            with rasterio.open(path, "r+") as dataset:
                dataset.write_mask(seen)
    else:
        source = np.ma.masked_array(values, ~seen)
    mask = read_mask(source)
    assert mask.observed is not None
    np.testing.assert_array_equal(mask.observed, seen)
    np.testing.assert_array_equal(mask.roads, roads & seen)


@pytest.mark.parametrize("kind", ["nodata", "alpha"])
def test_ground_that_is_called_nodata_is_ground(tmp_path: Path, roads: np.ndarray, kind: str) -> None:
    path = tmp_path / ("mask.tif" if kind == "nodata" else "mask.png")
    if kind == "nodata":
        write_raster(path, roads[None] * np.uint8(255), nodata=0)
    else:
        cv2.imwrite(str(path), np.dstack([np.full(SHAPE, 40, np.uint8)] * 3 + [roads * np.uint8(255)]))
    mask = read_mask(path)
    assert mask.observed is None
    np.testing.assert_array_equal(mask.roads, roads)


def test_an_inverted_mask_is_read_and_said_so(roads: np.ndarray, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        np.testing.assert_array_equal(read_mask(~roads).roads, roads)
    assert "inverted" in caplog.text
    values = np.ma.masked_array((~roads).astype(np.uint8), np.arange(SHAPE[1]) >= 60 + np.zeros(SHAPE))
    np.testing.assert_array_equal(read_mask(values).roads, roads & ~values.mask)


VOC = [0, 0, 0, 128, 0, 0, *[9] * 759, 224, 224, 192]  # colours of the classes 0, 1 and 255


def write_labels(path: Path, labels: np.ndarray, kind: str) -> Path:
    """Write 0, 1 and 255 as tools for training do."""
    if kind == "palette.png":
        image = PIL.Image.fromarray(labels, "P")
        image.putpalette(VOC)
        image.save(path)
    elif kind == "palette.tif":
        colors = {i: (*VOC[3 * i : 3 * i + 3], 255) for i in range(256)}
        write_raster(path, labels, colors=colors, photometric="palette")
    elif kind == "float.tif":
        cv2.imwrite(str(path), labels.astype(np.float32))
    else:
        cv2.imwrite(str(path), labels if kind == "grey.png" else np.repeat(labels[..., None], 3, axis=2))
    return path


@pytest.mark.parametrize("kind", ["grey.png", "colours.png", "palette.png", "palette.tif", "float.tif"])
def test_labels_with_a_value_for_none(
    tmp_path: Path, roads: np.ndarray, kind: str, caplog: pytest.LogCaptureFixture
) -> None:
    labels = roads.astype(np.uint8)
    labels[:30, 70:] = labels[60:, :15] = 255
    found = read_mask(write_labels(tmp_path / kind, labels, kind))
    np.testing.assert_array_equal(found.roads, labels == 1)
    np.testing.assert_array_equal(found.observed, labels != 255)
    assert "holds the values 0, 1, 255: 1 is taken for road, 255 for not observed" in caplog.text


@pytest.mark.parametrize(("dtype", "none"), [(np.int8, -1), (np.int16, -9999), (np.uint16, 65535), (np.int64, 100)])
def test_other_values_for_no_label(roads: np.ndarray, dtype: type, none: int) -> None:
    labels = roads.astype(dtype)
    labels[:30, 70:] = none
    found = read_mask(labels)
    np.testing.assert_array_equal(found.roads, labels == 1)
    np.testing.assert_array_equal(found.observed, labels != none)


def test_where_255_is_the_road_1_is_noise_or_ground(roads: np.ndarray, caplog: pytest.LogCaptureFixture) -> None:
    rng = np.random.default_rng(0)
    noisy = np.where(roads, 255, rng.random(roads.shape) < 0.02).astype(np.uint8)
    np.testing.assert_array_equal(read_mask(noisy).roads, roads)
    assert "0, 1, 255: 255 is taken for road" in caplog.text
    inside = np.where(roads, 255, 1).astype(np.uint8)
    inside[:, :10] = 0  # what a warped image leaves in its frame
    np.testing.assert_array_equal(read_mask(inside, voids=False).roads, inside == 255)


def test_a_threshold_says_what_labels_are_road(roads: np.ndarray) -> None:
    labels = roads.astype(np.uint8)
    labels[:30, 70:] = 255
    np.testing.assert_array_equal(read_mask(labels, threshold=0.5, voids=False).roads, labels > 0)


def test_classes_in_a_palette_are_named_by_their_numbers(tmp_path: Path, roads: np.ndarray) -> None:
    image = PIL.Image.fromarray(np.where(roads, 1, np.arange(SHAPE[1]) // 50 * 5).astype(np.uint8), "P")
    image.putpalette([0, 0, 0, 128, 0, 0, *[9] * 9, 0, 128, 0])
    image.save(tmp_path / "classes.png")
    with pytest.raises(MaskError, match="holds the classes 0, 1, 5"):
        read_mask(tmp_path / "classes.png")


def test_transparent_entries_of_a_palette_are_not_observed(tmp_path: Path, roads: np.ndarray) -> None:
    labels = roads.astype(np.uint8)
    labels[:, 60:80], labels[:, 80:] = 2, 3
    image = PIL.Image.fromarray(labels, "P")
    image.putpalette([0, 0, 0, 255, 255, 255, 200, 200, 200, 255, 255, 255])
    image.save(tmp_path / "a.png", transparency=bytes([255, 255, 0, 0]))
    found = read_mask(tmp_path / "a.png")
    np.testing.assert_array_equal(found.observed, np.arange(SHAPE[1]) < 60 + np.zeros(SHAPE))
    np.testing.assert_array_equal(found.roads, labels == 1)


def test_a_palette_of_three_greys_is_a_soft_map(tmp_path: Path, roads: np.ndarray) -> None:
    image = PIL.Image.fromarray(roads.astype(np.uint8), "P")
    image.putpixel((3, 3), 2)
    image.putpalette([10, 10, 10, 250, 250, 250, 120, 120, 120])
    image.save(tmp_path / "grey.png")
    np.testing.assert_array_equal(read_mask(tmp_path / "grey.png").roads, roads)


def test_strips_join(tmp_path: Path, roads: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("roadgeo.sources.masks._STRIP_PIXELS", 7 * SHAPE[1])
    path = write_raster(tmp_path / "mask.tif", np.where(roads, 200, 9)[None].astype(np.uint8), nodata=3)
    np.testing.assert_array_equal(read_mask(path).roads, roads)
    holed = np.where(roads, 1.0, 0.0)
    holed[50:, 50:] = np.nan
    mask = read_mask(holed)
    np.testing.assert_array_equal(mask.observed, np.isfinite(holed))
    np.testing.assert_array_equal(mask.roads, roads & np.isfinite(holed))


def test_a_photograph_is_refused_by_name(tmp_path: Path) -> None:
    photo, path = np.moveaxis(ground(), 0, 2), tmp_path / "photo.jpg"
    grey = cv2.cvtColor(photo, cv2.COLOR_BGR2GRAY)
    for picture in (photo, grey):
        cv2.imwrite(str(path), picture)
        with pytest.raises(PhotographError, match="looks like a photograph"):
            read_mask(path)
    assert read_mask(path, threshold=150).roads.any()
    for void in (0.4, 0.8):
        grey[:, : int(SHAPE[1] * void)] = 255
        with pytest.raises(PhotographError):
            read_mask(grey)


def ground() -> np.ndarray:
    """Return (3, H, W) of a photograph."""
    rng = np.random.default_rng(0)
    uneven = cv2.GaussianBlur(rng.normal(0, 0.5, (*SHAPE, 3)) + rng.normal(0, 1, (*SHAPE, 1)), (0, 0), 3)
    return np.moveaxis(np.clip(110 + 400 * uneven, 0, 255).astype(np.uint8), 2, 0)


def test_a_photograph_of_many_bands_is_none_the_less_one(tmp_path: Path, roads: np.ndarray) -> None:
    """Infrared is a fourth band, and not the mask's."""
    path = write_raster(tmp_path / "rgbn.tif", np.concatenate([ground(), ground()[:1]]), photometric="MINISBLACK")
    with pytest.raises(PhotographError, match="has 4 bands; choose the one that holds the roads, if it is a mask"):
        read_mask(path)
    stack = write_raster(tmp_path / "stack.tif", np.stack([roads * np.uint8(255)] * 4), photometric="MINISBLACK")
    with pytest.raises(
        MaskError, match=r"has 4 bands; choose the one that holds the roads: --band 1, 2, 3, 4$"
    ) as refused:
        read_mask(stack)
    assert not isinstance(refused.value, PhotographError)
    with pytest.raises(MaskError, match=r"has 4 bands; choose the one that holds the roads: --band 1, 2, 3, 4$"):
        read_mask(write_raster(tmp_path / "nothing.tif", np.full((4, *SHAPE), np.nan, np.float32)))


def test_bands_of_numbers_from_0_to_1(tmp_path: Path, roads: np.ndarray) -> None:
    """Reflectances are a photograph, classes want to be chosen from, and a soft map is drawn in any colour."""
    reflected = ground().astype(np.float32) / 255 * np.float32([[[0.3]], [[0.35]], [[0.4]]])
    with pytest.raises(PhotographError, match="looks like a photograph"):
        read_mask(np.moveaxis(reflected, 0, 2))
    soft = np.clip(cv2.GaussianBlur(roads.astype(np.float32), (0, 0), 1.0), 0, 1)
    classes = np.dstack([0.6 * (1 - soft), 0.4 * (1 - soft), soft])
    with pytest.raises(MaskError, match="holds 3 bands that differ; choose the one that holds the roads") as refused:
        read_mask(classes)
    assert not isinstance(refused.value, PhotographError)
    np.testing.assert_array_equal(read_mask(classes, band=3).roads, soft > 0.5)
    np.testing.assert_array_equal(read_mask(soft[..., None] * np.float32([0, 1, 0])).roads, soft > 0.5)
    np.testing.assert_array_equal(read_mask(np.dstack([soft] * 3)).roads, soft > 0.5)


@pytest.mark.parametrize("suffix", [".tif", ".png"])
def test_a_photograph_may_be_larger_than_a_mask(
    tmp_path: Path, roads: np.ndarray, monkeypatch: pytest.MonkeyPatch, suffix: str
) -> None:
    monkeypatch.setattr("roadgeo.sources.masks.MAX_SIDE", 90)
    photo, mask = tmp_path / f"photo{suffix}", tmp_path / f"mask{suffix}"
    cv2.imwrite(str(photo), np.moveaxis(ground(), 0, 2))
    cv2.imwrite(str(mask), roads * np.uint8(255))
    with pytest.raises(PhotographError, match="looks like a photograph"):
        read_mask(photo)
    with pytest.raises(MaskError, match="100 x 80 pixels; expected 32 to 90 on each side: reduce") as refused:
        read_mask(mask)
    assert not isinstance(refused.value, PhotographError)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.zeros(SHAPE, np.uint8), "shows no road"),
        (np.full(SHAPE, 255, np.uint8), "every pixel is light"),
        (np.full(SHAPE, np.nan), "no observed pixel"),
        (np.eye(10), "10 x 10 pixels; expected 32"),
        (np.arange(8000).reshape(SHAPE) % 4, "holds the classes 0, 1, 2, 3"),
        (np.kron(np.random.default_rng(0).integers(0, 13, (8, 10)), PATCH[:10, :10]), "holds the classes 0, 1, 2"),
        (np.kron([[0, 1, 255, 3], [1, 3, 0, 0]], PATCH), "holds the classes 0, 1, 3; expected road"),
        (np.ma.masked_array(np.zeros(SHAPE), COLUMNS >= 70), "shows no road"),  # nodata of no road's shape
        (np.ma.masked_array(np.zeros(SHAPE), ROWS < 9), "shows no road"),
        (np.ma.masked_array(np.zeros(SHAPE), abs(ROWS - 40) + abs(COLUMNS - 50) < 30), "shows no road"),
        (np.zeros((3, 4, 5, 6)), r"shape \(3, 4, 5, 6\)"),
        (np.array([["road"]]), "numbers or booleans"),
    ],
)
def test_what_is_no_mask(values: np.ndarray, message: str) -> None:
    with pytest.raises(MaskError, match=message) as raised:
        read_mask(values)
    assert "\n" not in str(raised.value)


def soft_map(roads: np.ndarray, seed: int = 0) -> np.ndarray:
    """Roads blurred on uneven grey ground."""
    rng = np.random.default_rng(seed)
    uneven = cv2.resize(
        rng.standard_normal((4, 5)).astype(np.float32), roads.shape[::-1], interpolation=cv2.INTER_CUBIC
    )
    soft = cv2.GaussianBlur(roads * np.float32(255), (0, 0), 4) * 0.8 + 18 + 10 * uneven
    return np.clip(soft, 0, 255).astype(np.uint8)


@pytest.fixture
def town() -> np.ndarray:
    image = np.zeros((400, 500), np.uint8)
    for line in ([(0, 50), (500, 90)], [(120, 0), (100, 400)], [(300, 0), (360, 400)], [(0, 250), (500, 240)]):
        cv2.line(image, *line, 1, 9)
    return image.astype(bool)


def test_a_soft_map_is_read_at_several_thresholds(town: np.ndarray) -> None:
    soft = soft_map(town)
    with open_mask(soft) as opened:
        thresholds = opened.thresholds
        masks = [opened.read(threshold) for threshold in thresholds]
    assert len(thresholds) >= 2
    overlap = np.mean(masks[0].roads & town) / np.mean(masks[0].roads | town)
    assert overlap > 0.6
    np.testing.assert_array_equal(read_mask(soft).roads, masks[0].roads)
    areas = sorted(np.mean(mask.roads) for mask in masks)
    assert all(larger > 1.1 * smaller for smaller, larger in itertools.pairwise(areas))


def test_a_mask_has_one_threshold_and_does_not_say_how_sure_it_is(town: np.ndarray) -> None:
    for values in (town, town * np.uint8(255), np.where(town, 3.0, -3.0)):
        with open_mask(values) as opened:
            assert len(opened.thresholds) == 1
            assert opened.read(opened.thresholds[0]).probability is None
    with open_mask(soft_map(town), threshold=60) as opened:
        assert opened.thresholds == (60,)
        assert opened.read(60).probability is None


@pytest.mark.parametrize("inverted", [False, True])
def test_a_soft_map_says_how_sure_each_pixel_is(town: np.ndarray, inverted: bool) -> None:
    sure = np.where(np.arange(500) < 250, 1.0, 0.5)  # on the right, half as sure
    share = cv2.GaussianBlur(town.astype(np.float32), (0, 0), 1.5) * sure
    values = np.ma.masked_array(1.0 - share if inverted else share, np.zeros(share.shape, bool))
    values[:40] = np.ma.masked
    with open_mask(values.astype(np.float32)) as opened:
        mask = opened.read(0.6 if inverted else 0.4)
    probability = mask.probability
    assert probability is not None
    assert probability.dtype == np.uint8
    assert (probability[:40] == 255).all()
    assert (probability[40:] < 255).all()
    left, right = (probability[40:, half][town[40:, half]] for half in (slice(250), slice(250, None)))
    assert np.median(left) > 1.5 * np.median(right)
    assert np.median(probability[40:][~town[40:]]) == 0
    np.testing.assert_array_equal(mask.mirrored().probability, probability[:, ::-1])


@pytest.mark.parametrize("sigma", [1, 2, 4])
def test_a_faint_map_is_no_map_of_classes(tmp_path: Path, town: np.ndarray, sigma: float) -> None:
    faint = np.rint(cv2.GaussianBlur(town * np.float32(12), (0, 0), sigma)).astype(np.uint8)
    path = tmp_path / "faint.png"
    cv2.imwrite(str(path), np.dstack([faint] * 3 + [np.full_like(faint, 255)]))
    for source in (faint, path, 0.04 * cv2.GaussianBlur(town.astype(np.float32), (0, 0), sigma)):
        roads = read_mask(source).roads
        assert np.mean(roads & town) / np.mean(roads | town) > 0.6


def test_a_land_cover_map_in_colours_is_refused(tmp_path: Path) -> None:
    colours = np.array([(0, 0, 0), (0, 200, 0), (200, 0, 0), (255, 255, 255)], np.uint8)
    picture = colours[(np.arange(SHAPE[0])[:, None] // 20 + np.zeros(SHAPE, int)) % 4]
    cv2.imwrite(str(tmp_path / "classes.png"), picture)
    with pytest.raises(MaskError, match="holds 4 colours"):
        read_mask(tmp_path / "classes.png")


def test_files_that_are_none(tmp_path: Path, roads: np.ndarray) -> None:
    good = tmp_path / "good.png"
    cv2.imwrite(str(good), roads * np.uint8(255))
    (tmp_path / "text.tif").write_text("no raster")
    (tmp_path / "empty.png").touch()
    (tmp_path / "cut.png").write_bytes(good.read_bytes()[:60])
    for name, message in (
        ("none.png", "no such file"),
        ("", "is a folder"),
        ("text.tif", "is text, whatever its name says"),
        ("empty.png", "is empty"),
        ("cut.png", "damaged or cut short"),
    ):
        with pytest.raises(MaskError, match=message) as raised:
            read_mask(tmp_path / name)
        assert "\n" not in str(raised.value)


def test_a_png_is_not_decoded_where_a_chunk_claims_more_than_there_is(tmp_path: Path) -> None:
    """300 bytes that claimed a chunk of a gigabyte took as much memory."""
    content = cv2.imencode(".png", np.eye(64, dtype=np.uint8) * 255)[1].tobytes()
    (tmp_path / "whole.png").write_bytes(content + b"what some programs append")
    assert read_mask(tmp_path / "whole.png").roads.sum() == 64
    at = content.index(b"IDAT") - 4
    (tmp_path / "a.png").write_bytes(content[:at] + (1 << 30).to_bytes(4, "big") + content[at + 4 :])
    with pytest.raises(MaskError, match="damaged or cut short"):
        read_mask(tmp_path / "a.png")


def test_voids_are_told_on_request(tmp_path: Path) -> None:
    image = np.zeros((400, 400), np.uint8)
    for x in range(15, 400, 30):
        cv2.line(image, (x, 0), (x + 8, 400), 255, 4)
        cv2.line(image, (0, x), (400, x + 5), 255, 4)
    cv2.fillConvexPoly(image, np.array([(0, 0), (400, 0), (400, 150)]), 0)
    mask = read_mask(image)
    assert mask.observed is not None
    assert not mask.observed[5, 395]
    assert not mask.roads[~mask.observed].any()
    assert read_mask(image, voids=False).observed is None


def test_real_masks_are_read_and_photographs_refused(data_dir: Path) -> None:
    masks = sorted((data_dir / "massachusetts").glob("**/masks/*.png"))[::4]
    assert masks
    for path in masks:
        values = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if values.any():
            mask = read_mask(path)
            assert mask.observed is None
            np.testing.assert_array_equal(mask.roads, values > 127)
    for path in sorted((data_dir / "massachusetts" / "segmentation" / "images").glob("*.jpg"))[::4]:
        with pytest.raises(MaskError, match="photograph"):
            read_mask(path)


# --- several bands that differ ----------------------------------------------------------------------------------------


@pytest.fixture
def houses() -> np.ndarray:
    """Blocks between the streets."""
    image = np.zeros(SHAPE, bool)
    image[35:60, 45:65] = image[40:70, 5:25] = True
    return image


def stack(kind: str, roads: np.ndarray, houses: np.ndarray) -> np.ndarray:
    """Return (bands, H, W) of which the one at `ROAD_BAND` shows the roads."""
    rng = np.random.default_rng(0)
    soft = np.clip(cv2.GaussianBlur(roads.astype(np.float32), (0, 0), 1.0), 0, 1)
    return {
        "road, building": np.stack([roads, houses]).astype(np.uint8) * 255,
        "building, road": np.stack([houses, roads]).astype(np.uint8),
        "one-hot": np.stack([~roads & ~houses, houses, roads]).astype(np.uint8),
        "softmax": np.stack([1 - np.maximum(soft, houses), houses * (1 - soft), soft]).astype(np.float32),
        "softmax in bytes": np.rint(255 * np.stack([(1 - soft) * ~houses, (1 - soft) * houses, soft])).astype(np.uint8),
        "mask, percent": np.stack([roads, 100 * np.clip(soft + rng.normal(0, 0.1, SHAPE), 0, 1)]).astype(np.uint8),
        "mask, count": np.stack([roads, rng.poisson(9, SHAPE)]).astype(np.uint16),
        "mask, age": np.stack([roads, rng.gamma(2, 400, SHAPE)]).astype(np.float32),
        "two probabilities": np.rint(255 * np.stack([soft, cv2.blur(1.0 * houses, (9, 9))])).astype(np.uint8),
    }[kind]  # fmt: skip


ROAD_BAND = {"building, road": 1, "one-hot": 2, "softmax": 2, "softmax in bytes": 2}
STACKS = [
    *("road, building", "building, road", "one-hot", "softmax", "softmax in bytes", "mask, percent", "mask, count"),
    *("mask, age", "two probabilities"),
]


@pytest.mark.parametrize("where", ["tif", "array"])
@pytest.mark.parametrize("kind", STACKS)
def test_bands_that_differ_are_asked_for(
    tmp_path: Path, roads: np.ndarray, houses: np.ndarray, kind: str, where: str
) -> None:
    bands = stack(kind, roads, houses)
    source = (
        np.moveaxis(bands, 0, 2)
        if where == "array"
        else write_raster(tmp_path / "a.tif", bands, photometric="MINISBLACK")
    )
    option = "--band " if where == "tif" else ""
    with pytest.raises(MaskError, match=f"{len(bands)} bands that differ; choose .* roads: {option}1, 2") as refused:
        read_mask(source)
    assert not isinstance(refused.value, PhotographError)
    found = read_mask(source, band=ROAD_BAND.get(kind, 0) + 1)
    assert np.mean(found.roads != roads) < 0.02


@pytest.mark.parametrize("kind", STACKS)
def test_the_band_that_is_named_road_is_read(tmp_path: Path, roads: np.ndarray, houses: np.ndarray, kind: str) -> None:
    bands = stack(kind, roads, houses)
    number = ROAD_BAND.get(kind, 0)
    names = ["other_class", "background", "rural"][: len(bands)]
    names[number] = "Road_mask"
    path = write_raster(tmp_path / "a.tif", bands, names=names, photometric="MINISBLACK")
    with open_mask(path) as opened:
        assert opened.part == f"band {number + 1} (Road_mask) of {len(bands)}"
        assert np.mean(opened.read(opened.thresholds[0]).roads != roads) < 0.02
    names[number] = "band of no name"
    with pytest.raises(MaskError, match=r"--band 1 \((other_class|band of no name)\), 2 \("):
        read_mask(write_raster(path, bands, names=names, photometric="MINISBLACK"))
    names[number] = "roads"
    with open_mask(np.moveaxis(bands, 0, 2), choice=Choice(names=tuple(names))) as opened:
        assert opened.part == f"band {number + 1} (roads) of {len(bands)}"


@pytest.mark.parametrize(
    ("names", "chosen"),
    [
        (("road", "road_uncertainty"), 1),
        (("not_road", "road"), 2),
        (("estradas", "edificios"), 1),
        (("Straßen", "Gebäude"), 1),
        (("mask", "street probability"), 2),
        (("class_0", "highways", "railroad crossing"), 2),
        (("road a", "road b"), None),
        (("railroad", "rural"), None),
        (("", ""), None),
    ],
)
def test_names_of_bands(roads: np.ndarray, houses: np.ndarray, names: tuple[str, ...], chosen: int | None) -> None:
    bands = np.dstack([roads, houses, ~roads][: len(names)]).astype(np.uint8)
    if chosen is None:
        with pytest.raises(MaskError, match="bands that differ"), open_mask(bands, choice=Choice(names=names)):
            pass
        return
    with open_mask(bands, choice=Choice(names=names)) as opened:
        assert opened.part.startswith(f"band {chosen} ")


def test_colours_of_a_png_are_bands(tmp_path: Path, roads: np.ndarray, houses: np.ndarray) -> None:
    path = tmp_path / "classes.png"
    cv2.imwrite(str(path), np.dstack([roads & False, roads, houses]).astype(np.uint8) * 255)
    with pytest.raises(MaskError, match=r"--band 1 \(red\), 2 \(green\), 3 \(blue\)"):
        read_mask(path)
    np.testing.assert_array_equal(read_mask(path, band=2).roads, roads)


@pytest.mark.parametrize("kind", [np.uint8, np.int32, np.float32])
def test_a_class_is_chosen(tmp_path: Path, roads: np.ndarray, houses: np.ndarray, kind: type) -> None:
    classes = (3 * roads + 2 * (houses & ~roads)).astype(kind)
    if kind is np.float32:
        classes += 40
    else:
        with pytest.raises(MaskError, match=r"holds the classes 0, 2, 3; expected road .* --class N"):
            read_mask(classes)
    number = int(classes.max())
    path = write_raster(tmp_path / "classes.tif", classes[None])
    with open_mask(path, choice=Choice(road_class=number)) as opened:
        assert opened.part == f"class {number}"
        np.testing.assert_array_equal(opened.read(opened.thresholds[0]).roads, roads)
    with pytest.raises(MaskError, match=r"holds no value 7, but \d+, \d+, \d+; give the one that is road with --class"):
        open_mask(path, choice=Choice(road_class=7)).__enter__()


def test_a_pale_photograph_with_a_few_bright_pixels_is_no_stack_of_classes() -> None:
    pale = (np.moveaxis(ground(), 0, 2) // 4 + 90).astype(np.uint8)
    pale[np.random.default_rng(0).random(SHAPE) < 0.002] = 255
    pale[10:12, 10:12] = (255, 0, 0)
    with pytest.raises(PhotographError):
        read_mask(pale)


# --- nodata that is the roads' value ----------------------------------------------------------------------------------


@pytest.mark.parametrize("ground_value", [0, 255])
@pytest.mark.parametrize("kind", ["nodata", "sidecar", "nan", "masked", "alpha", "soft"])
def test_roads_that_are_called_nodata_are_roads(
    tmp_path: Path, roads: np.ndarray, caplog: pytest.LogCaptureFixture, kind: str, ground_value: int
) -> None:
    values = np.where(roads, 255 - ground_value, ground_value).astype(np.uint8)
    if kind == "nodata":
        source = write_raster(tmp_path / "a.tif", values[None], nodata=255 - ground_value)
    elif kind == "sidecar":
        source = tmp_path / "a.png"
        cv2.imwrite(str(source), values)
        note = f"<NoDataValue>{255 - ground_value}</NoDataValue>"
        Path(f"{source}.aux.xml").write_text(f'<PAMDataset><PAMRasterBand band="1">{note}</PAMRasterBand></PAMDataset>')
    elif kind == "nan":
        source = np.where(roads, np.nan, float(ground_value))
    elif kind == "masked":
        source = np.ma.masked_array(values, roads)
    elif kind == "alpha":
        source = tmp_path / "a.png"
        cv2.imwrite(str(source), np.dstack([np.full(SHAPE, ground_value, np.uint8)] * 3 + [~roads * np.uint8(255)]))
    else:
        if ground_value:
            pytest.skip("light roads only")
        soft = np.maximum(roads * np.uint8(255), np.rint(180 * cv2.GaussianBlur(roads.astype(np.float32), (0, 0), 1.0)))
        source = write_raster(tmp_path / "a.tif", soft.astype(np.uint8)[None], nodata=255)
    assert np.mean(read_mask(source, voids=False).roads != roads) < 0.02
    assert "are taken for roads" in caplog.text


def test_an_ignored_border_of_roads_is_no_road(tmp_path: Path, roads: np.ndarray) -> None:
    """Labels as of PASCAL VOC: 255 around each object."""
    wide = cv2.dilate(roads.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    labels = np.where(roads, 1, np.where(wide, 255, 0)).astype(np.uint8)
    found = read_mask(write_raster(tmp_path / "a.tif", labels[None], nodata=255), voids=False)
    np.testing.assert_array_equal(found.roads, roads)


@pytest.mark.parametrize("kind", ["uint8", "uint16", "int16"])
def test_a_dark_photograph_is_no_map_of_classes(kind: str) -> None:
    dark = (
        (cv2.GaussianBlur(np.random.default_rng(0).random((200, 240)), (0, 0), 1.5) * 150 - 60).clip(0, 30).astype(kind)
    )
    with pytest.raises(PhotographError):
        read_mask(dark)


@pytest.mark.parametrize(("kind", "fill"), [("uint16", 65535), ("int16", -9999), ("float32", -9999.0)])
def test_a_fill_in_a_photograph_is_no_road(kind: str, fill: float, caplog: pytest.LogCaptureFixture) -> None:
    picture = (200 + 2000 * np.random.default_rng(0).random((200, 240))).astype(kind)
    picture[np.add.outer(np.arange(200), np.arange(240)) < 150] = fill
    with pytest.raises(PhotographError):
        read_mask(picture)
    assert "is taken for not observed" in caplog.text


@pytest.mark.parametrize(("kind", "fill"), [("float32", -9999.0), ("int16", -32768), ("uint8", 255)])
def test_a_fill_in_a_soft_map_is_not_observed(roads: np.ndarray, kind: str, fill: float) -> None:
    soft = np.rint(100 * cv2.GaussianBlur(roads.astype(np.float32), (0, 0), 1.0)).astype(kind)
    soft[:, :20] = fill
    found = read_mask(soft, voids=False)
    assert found.observed is not None
    assert not found.observed[:, :20].any()
    assert found.observed[:, 20:].all()
    assert np.mean(found.roads[:, 20:] != roads[:, 20:]) < 0.05


def streets() -> np.ndarray:
    """Draw a grid of them, (400, 500)."""
    roads = np.zeros((400, 500), np.uint8)
    for at in range(40, 400, 90):
        cv2.line(roads, (0, at), (500, at + 60), 1, 6)
        cv2.line(roads, (at, 0), (at + 40, 400), 1, 6)
    return roads


def numbered(roads: np.ndarray, kind: str, length: int = 12) -> np.ndarray:
    """Give each road a number."""
    bands = np.indices(roads.shape).sum(axis=0) // length % 15  # pieces along the roads
    numbers = {
        "instances": 1 + bands,
        "many": 40 + 11 * bands,
        "lanes": 1 + bands % 3,
        "speeds": np.array([30, 50, 90])[bands % 3],
        "far apart": np.array([20, 120, 250])[bands % 3],
        "years": 1990 + bands,
        "float years": 1990.0 + bands,
        "miles": np.array([30, 50, 90])[bands % 3] * 1.609,
    }[kind]
    types = {"years": "uint16", "float years": "float32", "miles": "float64"}
    return (roads * numbers).astype(types.get(kind, "uint8"))


NUMBERED = ["instances", "many", "lanes", "speeds", "far apart", "years", "float years", "miles"]


@pytest.mark.parametrize("container", ["array", "tif", "png", "nodata", "masked", "rgb", "colours", "palette"])
@pytest.mark.parametrize("kind", NUMBERED)
def test_numbers_above_0_are_road(
    roads: np.ndarray, kind: str, container: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    values = numbered(roads, kind)
    if (container == "png" and kind in ("float years", "miles")) or (
        container == "palette" and ("years" in kind or kind == "miles")
    ):
        pytest.skip("no such file")
    path = tmp_path / "a.png"
    if container == "png":
        cv2.imwrite(str(path), values)
    source = {
        "array": lambda: values,
        "masked": lambda: np.ma.masked_equal(values, 0),
        "rgb": lambda: np.dstack([values] * 3),
        "colours": lambda: (
            np.random.default_rng(1).integers(1, 256, (4000, 3)).astype(np.uint8)[values.astype(int)]
            * (values > 0).astype(np.uint8)[..., None]
        ),
        "palette": lambda: write_raster(
            tmp_path / "a.tif", values, colors={k: (k * 37 % 256, k * 91 % 256, 9, 255) for k in range(256)}
        ),
        "png": lambda: path,
        "tif": lambda: write_raster(tmp_path / "a.tif", values),
        "nodata": lambda: write_raster(tmp_path / "a.tif", values, nodata=0),
    }[container]()
    found = read_mask(source, voids=False)
    np.testing.assert_array_equal(found.roads, roads)
    assert "road" in caplog.text


@pytest.mark.parametrize("ground", [0, 255])
@pytest.mark.parametrize("quality", [50, 75, 95])
@pytest.mark.parametrize("suffix", ["jpg", "webp"])
@pytest.mark.parametrize("kind", ["many", "speeds"])
def test_numbers_that_are_saved_with_loss_are_road(
    kind: str, suffix: str, quality: int, ground: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    roads = streets()
    values = numbered(roads, kind, 60)
    PIL.Image.fromarray(values ^ np.uint8(ground)).save(tmp_path / f"a.{suffix}", quality=quality)
    found = read_mask(tmp_path / f"a.{suffix}", voids=False)
    assert np.mean(found.roads != roads) < 0.02
    assert "a number for each of its roads" in caplog.text


@pytest.mark.parametrize("kind", ["instances", "lanes", "far apart"])
def test_numbers_that_loss_makes_a_soft_map_of_are_told_or_refused(
    kind: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    values = numbered(streets(), kind, 60)
    for suffix, quality in itertools.product(("jpg", "webp", "tif", "jp2"), (50, 75, 95)):
        caplog.clear()
        lossy = {"tif": {"compression": "jpeg"}, "jp2": {"quality_layers": [100 - quality], "irreversible": True}}
        PIL.Image.fromarray(values).save(tmp_path / f"a.{suffix}", quality=quality, **lossy.get(suffix, {}))
        try:
            read_mask(tmp_path / f"a.{suffix}", voids=False)
        except MaskError as error:
            assert "holds the classes" in str(error)  # noqa: PT017 - either of the two
        else:
            assert re.search("numbers of roads, blurred by compression|a number for each of its roads", caplog.text)


@pytest.mark.parametrize("sigma", [1.0, 2.0, 4.0])
@pytest.mark.parametrize("peak", [60, 120, 255])
def test_a_soft_map_of_uneven_roads_holds_no_numbers(sigma: float, peak: int, caplog: pytest.LogCaptureFixture) -> None:
    roads = streets()
    trust = 0.3 + 0.7 * np.abs(np.sin(np.add.outer(np.arange(400), np.arange(500)) / 40))
    read_mask(np.rint(peak * trust * cv2.GaussianBlur(roads.astype(np.float32), (0, 0), sigma)).astype(np.uint8))
    assert "a number for each of its roads" not in caplog.text


@pytest.mark.parametrize("container", ["array", "tif", "rgb", "colours"])
@pytest.mark.parametrize("ground", [-1, 255, 65535, -9999])
@pytest.mark.parametrize("kind", NUMBERED)
def test_the_ground_between_numbers_may_be_any(
    roads: np.ndarray, kind: str, ground: int, container: str, tmp_path: Path
) -> None:
    values = np.where(roads, numbered(roads, kind).astype("float64" if kind == "miles" else "int32"), ground)
    colours = np.random.default_rng(1).integers(0, 255, (4000, 3))[values.astype(int) % 4000]
    source = {
        "array": lambda: values,
        "tif": lambda: write_raster(tmp_path / "a.tif", values),
        "rgb": lambda: np.dstack([values] * 3),
        "colours": lambda: np.where(roads[..., None], colours, 255).astype(np.uint8),
    }[container]()
    np.testing.assert_array_equal(read_mask(source, voids=False).roads, roads)


@pytest.mark.parametrize("kind", ["nodata", "nan", "masked", "minus infinity", "alpha"])
@pytest.mark.parametrize("value", [0, 1, 7])
def test_what_alone_is_observed_is_road(roads: np.ndarray, kind: str, value: int, tmp_path: Path) -> None:
    values = np.where(roads, value, 255).astype(np.uint8)
    path = tmp_path / "a.png"
    if kind == "alpha":
        cv2.imwrite(str(path), np.dstack([np.full(SHAPE, value, np.uint8)] * 3 + [roads * np.uint8(255)]))
    source = {
        "nodata": lambda: write_raster(tmp_path / "a.tif", values, nodata=255),
        "nan": lambda: np.where(roads, float(value), np.nan),
        "minus infinity": lambda: np.where(roads, float(value), -np.inf),
        "masked": lambda: np.ma.masked_array(values, ~roads),
        "alpha": lambda: path,
    }[kind]()
    np.testing.assert_array_equal(read_mask(source, voids=False).roads, roads)
