"""What a frame shows around its photograph, and what a photograph does not show, is no ground: of any reader."""

from pathlib import Path

import numpy as np
import pytest
from worlds.rasters import write_raster
from worlds.turned import save_turned

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
