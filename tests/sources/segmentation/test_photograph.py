"""What a frame shows around its photograph, and what a photograph does not show, is no ground: of any reader."""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import PIL.Image
import pytest
import rasterio
from worlds.rasters import write_raster
from worlds.turned import save_turned

from roadgeo.evaluation.demo import PHOTO
from roadgeo.sources.masks import is_photograph
from roadgeo.sources.segmentation.photograph import find_ground, open_photograph

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")

SHAPE, MARGIN = (300, 400), 60
INSIDE = slice(MARGIN, -MARGIN), slice(MARGIN, -MARGIN)


def framed(margin: float, kind: str = "uint8", low: float = 40.0, high: float = 220.0) -> np.ndarray:
    """(H, W) values of uneven ground within a margin of one value, or of paper with its grain."""
    rng = np.random.default_rng(0)
    ground = np.kron(rng.random((30, 40)), np.ones((10, 10))) + 0.2 * rng.random(SHAPE)
    values = np.pad(low + (high - low) * ground / 1.2, MARGIN, constant_values=margin)
    return values.astype(kind)


def _write_page(path: Path, values: np.ndarray) -> Path:
    import PIL.Image

    pages = [PIL.Image.fromarray(values) for _ in range(2)]
    pages[0].save(path, save_all=True, append_images=pages[1:])
    return path


def _with_alpha(path: Path, values: np.ndarray) -> Path:
    bands = np.stack([values, values, values, np.full_like(values, 255)])
    bands[3, :20] = 0
    return write_raster(path, bands, photometric="RGB", alpha="yes")


def _with_mask_band(path: Path, values: np.ndarray) -> Path:
    import rasterio

    write_raster(path, values)
    shown = np.ones(values.shape, bool)
    shown[:20] = False
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(path, "r+") as dataset:
        dataset.write_mask(shown)
    return path


def _with_palette(path: Path, values: np.ndarray) -> Path:
    return write_raster(path, values, colors={i: (i, i // 2, 255 - i, 255) for i in range(256)})


READERS = {
    "geotiff.tif": write_raster,
    "rgb.tif": lambda path, values: write_raster(path, np.stack([values, values // 2, values])),
    "png.png": lambda path, values: write_raster(path, values, "PNG"),
    "jpeg.jpg": lambda path, values: write_raster(path, values, "JPEG", quality=85),
    "jpeg_in.tif": lambda path, values: write_raster(path, values, compress="jpeg"),
    "webp.webp": lambda path, values: write_raster(path, np.stack([values] * 3), "WEBP", quality=80),
    "jpeg2000.jp2": lambda path, values: write_raster(path, values, "JP2OpenJPEG"),
    "bmp.bmp": lambda path, values: write_raster(path, values, "BMP"),
    "alpha.tif": _with_alpha,
    "mask_band.tif": _with_mask_band,
    "page.tif": _write_page,
    "palette.tif": _with_palette,
    "turned.jpg": lambda path, values: save_turned(path, values, 6),
}


def grounds(path: Path) -> np.ndarray:
    """(H, W) where a photograph shows ground, on its own pixels."""
    with open_photograph(path) as opened:
        return find_ground(opened, (opened.height, opened.width))


def is_ground_inside_alone(ground: np.ndarray) -> bool:
    """All but a few pixels at the edge of the photograph, and nothing around it."""
    around = np.ones(ground.shape, bool)
    around[INSIDE] = False
    core = ground[MARGIN + 12 : -MARGIN - 12, MARGIN + 12 : -MARGIN - 12]
    return not ground[around].any() and bool(core.mean() > 0.99)


@pytest.mark.parametrize("margin", [255, 0, 236])
@pytest.mark.parametrize("reader", READERS)
def test_margins_are_no_ground(tmp_path: Path, reader: str, margin: int, caplog: pytest.LogCaptureFixture) -> None:
    path = READERS[reader](tmp_path / reader, framed(margin))
    assert is_ground_inside_alone(grounds(path))
    assert "plain margins are not observed" in caplog.text


@pytest.mark.parametrize(
    ("kind", "margin", "low", "high"),
    [("uint8", 255, 0, 30), ("uint8", 0, 100, 130), ("uint16", 65535, 300, 900), ("float32", -9999.0, 0.0, 0.2)],
)
def test_margins_do_not_count_where_few_values_are_stretched(
    tmp_path: Path, kind: str, margin: float, low: float, high: float
) -> None:
    path = write_raster(tmp_path / "a.tif", framed(margin, kind, low, high))
    assert is_ground_inside_alone(grounds(path))
    with open_photograph(path) as opened:
        rgb, _ = opened.read(0.0, 0.0, 520.0, 420.0, (420, 520))
    assert np.ptp(np.percentile(rgb[INSIDE], [5, 95])) > 130


@pytest.mark.parametrize("reader", ["geotiff.tif", "png.png", "jpeg.jpg", "alpha.tif", "mask_band.tif", "page.tif"])
@pytest.mark.parametrize(
    ("kind", "fill", "low", "high"),
    [
        *(("uint8", 255, 0, 30), ("uint8", 0, 100, 130), ("uint8", 255, 200, 240), ("uint16", 65535, 300, 900)),
        *(("uint16", 0, 20000, 22000), ("int16", -9999, 0, 4000), ("float32", -9999.0, 0.0, 0.2)),
    ],
)
def test_nor_do_small_corners_of_a_turned_picture(
    tmp_path: Path, reader: str, kind: str, fill: float, low: float, high: float
) -> None:
    if (kind not in ("uint8", "uint16") and reader != "geotiff.tif") or (kind != "uint8" and reader == "jpeg.jpg"):
        pytest.skip("no such file")
    values = framed(fill, kind, low, high)[INSIDE]
    y, x = (np.minimum(at, at[::-1, ::-1]) for at in np.indices(values.shape))
    values[x + y < 60] = fill
    path = READERS[reader](tmp_path / reader, values)
    with open_photograph(path) as opened:
        rgb, _ = opened.read(0.0, 0.0, 400.0, 300.0, (300, 400))
    assert np.ptp(np.percentile(rgb[60:-60, 60:-60, 0], [5, 95])) > 130


@pytest.mark.parametrize(("low", "high"), [(0, 30), (100, 130), (225, 250)])
@pytest.mark.parametrize("suffix", ["tif", "png", "gif"])
def test_few_colours_of_a_palette_are_stretched(tmp_path: Path, suffix: str, low: float, high: float) -> None:
    import PIL.Image

    PIL.Image.fromarray(framed(0, "uint8", low, high)[INSIDE]).convert("P").save(tmp_path / f"a.{suffix}")
    with open_photograph(tmp_path / f"a.{suffix}") as opened:
        rgb, _ = opened.read(0.0, 0.0, 400.0, 300.0, (300, 400))
    assert np.ptp(np.percentile(rgb, [5, 95])) > 130


def test_margins_may_have_grain_and_writing_and_a_line(tmp_path: Path) -> None:
    """As a print scanned on its sheet, with a number beside it and a line around it."""
    values = framed(236)
    around = np.ones(values.shape, bool)
    around[INSIDE] = False
    values[around] += np.random.default_rng(1).normal(0, 2, around.sum()).round().astype(int).astype(np.uint8)
    values[20:30, 30:60] = 10
    for at in (MARGIN - 4, -MARGIN + 3):
        values[at, MARGIN - 4 : -MARGIN + 4] = values[MARGIN - 4 : -MARGIN + 4, at] = 0
    assert is_ground_inside_alone(grounds(write_raster(tmp_path / "a.tif", values)))


@pytest.mark.parametrize("reader", ["geotiff.tif", "rgb.tif", "png.png", "alpha.tif", "mask_band.tif", "page.tif"])
@pytest.mark.parametrize("fill", [0, 128, 255])
def test_a_fill_in_the_corners_is_no_ground(tmp_path: Path, reader: str, fill: int) -> None:
    """As beside a picture that was turned: nobody declares it, and it may have any value."""
    values = framed(0)[INSIDE]
    values = np.pad(values, 30, mode="reflect")
    y, x = np.indices(values.shape)
    away = x + y < 220
    values[away] = fill
    ground = grounds(READERS[reader](tmp_path / reader, values))
    assert ground[away].mean() < 0.02
    assert ground[30:, 30:][x[30:, 30:] + y[30:, 30:] > 250].mean() > 0.98


def test_a_plain_sea_does_not_hide_the_picture(tmp_path: Path) -> None:
    """Where nearly all is plain, what varies is no picture with margins."""
    values = np.full((300, 400), 90, np.uint8)
    values[140:160, 190:210] = np.random.default_rng(0).integers(0, 255, (20, 20))
    assert grounds(write_raster(tmp_path / "a.tif", values)).all()


@pytest.mark.parametrize("how", ["alpha", "nodata"])
def test_the_tips_of_a_turned_picture_are_no_margins(
    tmp_path: Path, how: str, caplog: pytest.LogCaptureFixture
) -> None:
    """Lines at the edge of its frame show little of it; what the file declares is nodata is no plain margin."""
    values = np.clip(framed(90)[INSIDE], 1, 255)
    y, x = np.indices(values.shape)
    shown = abs(x - 200) / 200 + abs(y - 150) / 150 < 1
    values = np.where(shown, values, 0).astype(np.uint8)
    if how == "alpha":
        bands = np.stack([values, values, values, np.where(shown, 255, 0).astype(np.uint8)])
        path = write_raster(tmp_path / "a.tif", bands, photometric="RGB", alpha="yes")
    else:
        path = write_raster(tmp_path / "a.tif", values, nodata=0)
    ground = grounds(path)
    assert not ground[~shown].any()
    assert [np.ptp(np.flatnonzero(ground.any(axis=axis))) for axis in (1, 0)] == pytest.approx(SHAPE, abs=8)
    assert "margins" not in caplog.text


# --- forms in which people have photographs ---------------------------------------------------------------------------


@cache
def coloured() -> np.ndarray:
    """(H, W, 3) uint8 RGB of the demonstration's photograph."""
    return cv2.cvtColor(cv2.imread(str(PHOTO)), cv2.COLOR_BGR2RGB)[200:500, 300:700]


def deep(kind: str, scale: float, offset: float = 0.0, **profile: Any) -> Callable[[Path], object]:
    """Write with values of another type."""
    return lambda path: write_raster(path, (np.moveaxis(coloured(), 2, 0) * scale + offset).astype(kind), **profile)


def in_mode(mode: str, **how: Any) -> Callable[[Path], object]:
    """Write in a mode of PIL's."""
    return lambda path: PIL.Image.fromarray(coloured()).convert(mode).save(path, **how)


def with_infrared(kind: str, **profile: Any) -> Callable[[Path], object]:
    """Write with a fourth band, of the near infrared."""

    def write(path: Path) -> object:
        bands = np.moveaxis(coloured(), 2, 0)
        return write_raster(path, np.stack([*bands, np.maximum(255 - bands[1], 1)]).astype(kind), **profile)

    return write


def masked_in_tiles(path: Path) -> None:
    """Write tiles with an internal mask; what it hides is black."""
    shown = np.ones(coloured().shape[:2], bool)
    shown[:40, :40] = False
    bands = np.moveaxis(coloured(), 2, 0) * shown.astype(np.uint8)
    write_raster(path, bands, photometric="RGB", tiled=True, blockxsize=128, blockysize=128)
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(path, "r+") as dataset:
        dataset.write_mask(shown)


FORMS: dict[str, Callable[[Path], object]] = {
    "16 bit.tif": deep("uint16", 257.0, photometric="RGB"),
    "11 bit, no colours named.tif": deep("uint16", 8.0, 300.0, photometric="MINISBLACK"),
    "16 bit.png": deep("uint16", 257.0, driver="PNG"),
    "signed.tif": deep("int16", 8.0, photometric="MINISBLACK"),
    "reflectance.tif": deep("float32", 0.3 / 255.0, photometric="MINISBLACK"),
    "big-endian.tif": deep("uint8", 1.0, photometric="RGB", ENDIANNESS="BIG"),
    "big-endian, large, 16 bit.tif": deep("uint16", 257.0, photometric="RGB", ENDIANNESS="BIG", bigtiff="YES"),
    "bands apart.tif": deep("uint8", 1.0, photometric="RGB", interleave="band", compress="lzw"),
    "YCbCr.tif": deep("uint8", 1.0, photometric="YCBCR", compress="jpeg"),
    "jpeg 2000.jp2": deep("uint8", 1.0, driver="JP2OpenJPEG"),
    "masked tiles.tif": masked_in_tiles,
    "infrared.tif": with_infrared("uint8", photometric="RGB"),
    "infrared, no colours named.tif": with_infrared("uint16", photometric="MINISBLACK"),
    "infrared for alpha.tif": with_infrared("uint8", photometric="RGB", alpha="yes"),
    "CMYK.jpg": in_mode("CMYK", quality=95),
    "CMYK.tif": in_mode("CMYK"),
    "palette.png": lambda path: PIL.Image.fromarray(coloured()).quantize(256).save(path),
    "palette.gif": lambda path: PIL.Image.fromarray(coloured()).quantize(256).save(path),
    "palette.tif": lambda path: PIL.Image.fromarray(coloured()).quantize(256).save(path),
    "grey.jpg": in_mode("L", quality=95),
    "grey with alpha.png": in_mode("LA"),
    "alpha.png": in_mode("RGBA"),
    "progressive.jpg": in_mode("RGB", progressive=True, quality=95),
    "webp.webp": in_mode("RGB", quality=95),
    "array.npy": lambda path: np.save(path, coloured()),
    **{
        f"turned {n}.{suffix}": lambda path, n=n: save_turned(path, coloured(), n)
        for n in range(2, 9)
        for suffix in ("jpg", "tif")
    },
}


@pytest.mark.parametrize("form", FORMS)
def test_a_photograph_is_the_same_in_every_form(tmp_path: Path, form: str) -> None:
    FORMS[form](tmp_path / form)
    assert is_photograph(tmp_path / form)
    with open_photograph(tmp_path / form) as opened:
        assert (opened.height, opened.width) == coloured().shape[:2]
        rgb, valid = opened.read(0.0, 0.0, opened.width, opened.height, (opened.height, opened.width))
    assert valid[40:, 40:].all()
    assert valid[:40, :40].all() == (form != "masked tiles.tif")
    seen, right = (np.moveaxis(picture[40:, 40:], 2, 0) for picture in (rgb, coloured()))
    if "grey" in form:
        seen, right = (picture.mean(axis=0, keepdims=True) for picture in (seen, right))
    for band, same in zip(seen, right, strict=True):
        assert np.corrcoef(band.ravel(), same.ravel())[0, 1] > 0.95
