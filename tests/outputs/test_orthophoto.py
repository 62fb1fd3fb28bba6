from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
import rasterio
from outputs.test_location_files import located
from rasterio.enums import ColorInterp
from worlds.rasters import write_raster
from worlds.turned import save_turned

from roadgeo.errors import CrsError, MaskError
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.warping import cover, source_pixels, warp
from roadgeo.outputs import orthophoto
from roadgeo.outputs.options import ImageOptions
from roadgeo.outputs.orthophoto import (
    choose_target,
    image_homography,
    read_preview,
    warp_image,
)

PLACE = located().places[0]
MASK_SIZE = (400, 300)


def positions(height: int, width: int, dtype: str = "uint16") -> np.ndarray:
    """Two bands: 100 + 10 times the column and the row of each pixel's centre; linear, so interpolation keeps them."""
    rows, columns = np.indices((height, width)) + 0.5
    return (100 + 10 * np.stack([columns, rows])).astype(dtype)


def places(raster: rasterio.DatasetReader) -> np.ndarray:
    """(2, rows, columns): x and y of the middles of pixels."""
    rows, columns = np.indices(raster.shape) + 0.5
    return np.stack([raster.transform.c + raster.transform.a * columns, raster.transform.f + raster.transform.e * rows])


@pytest.mark.parametrize(
    ("crs", "scale", "resampling"),
    [
        (None, 1, "nearest"),
        (None, 2, "bilinear"),
        (None, 1, "cubic"),
        (None, 1, "lanczos"),
        ("EPSG:3857", 1, "cubic"),
        ("EPSG:4326", 1, "bilinear"),
        ("EPSG:4326", 2, "nearest"),
    ],
)
def test_every_pixel_shows_the_ground_where_it_lies(
    tmp_path: Path, crs: str | None, scale: int, resampling: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(orthophoto, "_BLOCK", 150)
    source = write_raster(tmp_path / "a.tif", positions(300 * scale, 400 * scale))
    homography, size = image_homography(PLACE, MASK_SIZE, source)
    assert size == (400 * scale, 300 * scale)
    warp_image(source, tmp_path / "b.tif", PLACE, homography, {}, ImageOptions(crs=crs, resampling=resampling))
    with rasterio.open(tmp_path / "b.tif") as raster:
        column, row, alpha = raster.read().astype(float)
        assert raster.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        x, y = places(raster)
        if crs:
            assert raster.crs == rasterio.CRS.from_user_input(crs)
            x, y = pyproj.Transformer.from_crs(crs, PLACE.crs, always_xy=True).transform(x, y)
    shown = alpha == 65535
    expected = Homography(homography).inverse()(np.stack([x, y], axis=-1))
    inner = shown & (expected > 3).all(axis=-1) & (expected < np.array([400, 300]) * scale - 3).all(axis=-1)
    assert inner.sum() > 0.9 * 400 * 300 * scale**2 * 0.5
    error = np.stack([column, row], axis=-1)[inner] / 10 - 10 - expected[inner]
    assert np.abs(error).max() < (0.56 if resampling == "nearest" else 0.12)
    outside = ((expected < -0.01) | (expected > np.array([400, 300]) * scale + 0.01)).any(axis=-1)
    assert not shown[outside].any()
    assert shown[~outside & ((expected > 0.01) & (expected < np.array([400, 300]) * scale - 0.01)).all(axis=-1)].all()


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_picture_is_drawn_upright(tmp_path: Path, orientation: int) -> None:
    picture = np.random.default_rng(4).integers(0, 256, (300, 400, 3)).astype(np.uint8)
    drawn = []
    for turn in (1, orientation):
        source = save_turned(tmp_path / f"{turn}.png", picture, turn)
        homography, size = image_homography(PLACE, MASK_SIZE, source)
        assert size == (400, 300)
        warp_image(source, tmp_path / f"{turn}.tif", PLACE, homography, {})
        with rasterio.open(tmp_path / f"{turn}.tif") as raster:
            drawn.append(raster.read())
        np.testing.assert_array_equal(read_preview(source, 400)[..., :3], picture)
    np.testing.assert_array_equal(*drawn)


def test_a_mask_of_the_stored_pixels_is_told_so(tmp_path: Path) -> None:
    source = save_turned(tmp_path / "photo.png", np.zeros((400, 300, 3), np.uint8), 6)
    reported = (
        r"is 300 x 400 pixels, its mask 400 x 300: .*make the mask of the upright picture.* \(EXIF orientation 6\)"
    )
    with pytest.raises(MaskError, match=reported):
        image_homography(PLACE, MASK_SIZE, source)


@pytest.mark.parametrize(
    ("bands", "dtype", "colors"),
    [
        (1, "uint8", [ColorInterp.gray, ColorInterp.alpha]),
        (3, "uint8", [ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha]),
        (3, "uint16", [ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha]),
        (7, "uint16", [ColorInterp.gray, *[ColorInterp.undefined] * 6, ColorInterp.alpha]),
    ],
)
def test_bands_and_depth_are_kept(tmp_path: Path, bands: int, dtype: str, colors: list[ColorInterp]) -> None:
    photometric = {"photometric": "RGB"} if bands == 3 else {}
    levels = np.arange(200, 200 + bands, dtype=dtype)
    source = write_raster(tmp_path / "a.tif", np.tile(levels[:, None, None], (1, 30, 40)), **photometric)
    homography, _ = image_homography(PLACE, MASK_SIZE, source)
    warp_image(source, tmp_path / "b.tif", PLACE, homography, {"ROADGEO_QUERY": "a"})
    with rasterio.open(tmp_path / "b.tif") as raster:
        assert list(raster.colorinterp) == colors
        assert raster.dtypes[0] == dtype
        assert raster.tags()["ROADGEO_QUERY"] == "a"
        values = raster.read()
    shown = values[-1] > 0
    assert (values[:-1, shown] == levels[:, None]).all()
    assert (values[:, ~shown] == 0).all()


def test_alpha_of_the_picture_is_kept(tmp_path: Path) -> None:
    bands = np.full((4, 300, 400), 200, "uint8")
    bands[:, :, 200:] = 0
    source = write_raster(tmp_path / "a.tif", bands, photometric="RGB", alpha="yes")
    homography, _ = image_homography(PLACE, MASK_SIZE, source)
    warp_image(source, tmp_path / "b.tif", PLACE, homography, {})
    with rasterio.open(tmp_path / "b.tif") as raster:
        values = raster.read()
    assert len(values) == 4
    assert (values[:3, values[3] > 0] == 200).all()  # nothing of the unknown black bled into the known
    assert (values[3] > 0).sum() < 0.55 * 400 * 300


@pytest.mark.parametrize(("dtype", "nodata"), [("float32", None), ("float32", -9999.0), ("int16", None), ("int16", 7)])
def test_other_types_have_a_nodata_value(tmp_path: Path, dtype: str, nodata: float | None) -> None:
    values = np.full((1, 300, 400), 50, dtype)
    if nodata is not None:
        values[:, :, 200:] = nodata
    source = write_raster(tmp_path / "a.tif", values, nodata=nodata)
    homography, _ = image_homography(PLACE, MASK_SIZE, source)
    warp_image(source, tmp_path / "b.tif", PLACE, homography, {})
    with rasterio.open(tmp_path / "b.tif") as raster:
        known = raster.dataset_mask() > 0
        values = raster.read(1)
        assert raster.count == 1
    assert 0.2 * known.size < known.sum() < 0.8 * known.size
    np.testing.assert_allclose(values[known], 50, rtol=1e-6)


def test_a_large_picture_in_rows_is_tiled_first_and_read_coarser(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(orthophoto, "_TILED_BYTES", 1000)
    monkeypatch.setattr(orthophoto, "_MAX_SOURCE", 100)
    source = write_raster(tmp_path / "a.tif", positions(300, 400))
    homography, _ = image_homography(PLACE, MASK_SIZE, source)
    grid = warp_image(source, tmp_path / "b.tif", PLACE, homography, {}, ImageOptions(max_pixels=2000))
    assert grid.width * grid.height < 2300
    with rasterio.open(tmp_path / "b.tif") as raster:
        column, row, _ = raster.read().astype(float)
        x, y = places(raster)
    expected = Homography(homography).inverse()(np.stack([x, y], axis=-1))
    inner = (expected > 12).all(axis=-1) & (expected < (388, 288)).all(axis=-1)
    assert np.abs(np.stack([column, row], axis=-1)[inner] / 10 - 10 - expected[inner]).max() < 4
    assert [path.name for path in tmp_path.iterdir()] == ["a.tif", "b.tif"]


def test_what_cannot_be_drawn_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("no picture")
    with pytest.raises(MaskError, match="not a raster"):
        image_homography(PLACE, MASK_SIZE, tmp_path / "a.txt")
    source = write_raster(tmp_path / "a.tif", np.zeros((1, 300, 300), "uint8"))
    with pytest.raises(MaskError, match="300 x 300 pixels, its mask 400 x 300"):
        image_homography(PLACE, MASK_SIZE, source)
    with pytest.raises(CrsError, match="banana"):
        warp_image(source, tmp_path / "b.tif", PLACE, PLACE.homography, {}, ImageOptions(crs="EPSG:banana"))


@pytest.mark.parametrize(
    ("dtype", "n_bands"),
    [("uint8", 1), ("uint8", 3), ("uint8", 4), ("uint16", 1), ("uint16", 3), ("uint16", 4), ("float32", 1)],
)
def test_a_preview_is_small_and_shows_what_is_known(tmp_path: Path, dtype: str, n_bands: int) -> None:
    scale = {"uint8": 1, "uint16": 200, "float32": 0.01}[dtype]
    ramp = np.tile(np.linspace(10, 240, 600), (400, 1)) * scale
    bands = np.repeat(ramp[None], min(n_bands, 3), axis=0).astype(dtype)
    bands[:, :, -100:] = 0
    profile = {"nodata": 0}
    if n_bands == 4:
        alpha = np.where(np.arange(600) < 500, np.iinfo(dtype).max, 0).astype(dtype)
        bands = np.concatenate([bands, np.tile(alpha, (400, 1))[None]])
        profile = {"photometric": "RGB", "alpha": "yes"}
    preview = read_preview(write_raster(tmp_path / "a.tif", bands, **profile), 300)
    assert preview.shape == (200, 300, 4)
    assert preview.dtype == np.uint8
    assert (preview[:, :248, 3] == 255).all()
    assert (preview[:, 252:, 3] == 0).all()
    row = preview[100, :248].astype(int)
    assert (np.diff(row[:, 0]) >= 0).all()
    assert row[-1, 0] - row[0, 0] > 180
    assert np.array_equal(row[:, 0], row[:, 2])


@pytest.mark.parametrize(("ground", "road"), [(0, 1), (1, 2)])
def test_a_preview_of_labels_shows_roads_on_ground(tmp_path: Path, ground: int, road: int) -> None:
    labels = np.full((1, 40, 40), ground, np.uint8)
    labels[:, 20:24] = road
    preview = read_preview(write_raster(tmp_path / "a.tif", labels), 1000)
    assert preview[[5, 22], 5, 0].tolist() == [0, 255]


def test_a_preview_of_a_palette_shows_its_colours(tmp_path: Path) -> None:
    labels = np.repeat(np.array([[0, 1]], np.uint8), 40, axis=0).repeat(20, axis=1)[None]
    colors = {0: (10, 20, 30, 255), 1: (200, 100, 50, 255)}
    preview = read_preview(write_raster(tmp_path / "a.tif", labels, colors=colors, photometric="palette"), 1000)
    assert preview[5, 5].tolist() == [10, 20, 30, 255]
    assert preview[5, 35].tolist() == [200, 100, 50, 255]


def blobs(height: int, width: int) -> np.ndarray:
    """Smooth colours (3, rows, columns)."""
    rows, columns = np.indices((height, width))
    waves = [np.sin(columns / 17 + k) * np.cos(rows / (13 + k)) for k in range(3)]
    return np.asarray(128 + 100 * np.stack(waves), np.uint8)


@pytest.mark.parametrize("compression", ["deflate", "zstd", "jpeg", "webp"])
def test_a_result_is_compressed_as_asked_for(tmp_path: Path, compression: Any) -> None:
    source = write_raster(tmp_path / "a.tif", blobs(300, 400), photometric="RGB")
    homography, _ = image_homography(PLACE, MASK_SIZE, source)
    drawn = []
    for name in ("deflate", compression):
        warp_image(source, tmp_path / "b.tif", PLACE, homography, {}, ImageOptions(compression=name))
        with rasterio.open(tmp_path / "b.tif") as raster:
            assert raster.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
            assert name in str(raster.compression.value).lower() or name == "jpeg"
            drawn.append((raster.read((1, 2, 3)).astype(int), raster.dataset_mask() > 0))
    (exact, shown), (kept, also_shown) = drawn
    assert (shown == also_shown).all()
    assert np.abs(kept - exact)[:, shown].mean() <= (3 if compression in ("jpeg", "webp") else 0)


@pytest.mark.parametrize(("compression", "bands"), [("jpeg", 2), ("webp", 1), ("jpeg", 7)])
def test_a_compression_that_cannot_hold_a_picture_is_refused(tmp_path: Path, compression: Any, bands: int) -> None:
    source = write_raster(tmp_path / "a.tif", np.full((bands, 300, 400), 7, "uint8"))
    with pytest.raises(MaskError, match=rf"{compression} holds .*; the picture has {bands} of uint8: choose deflate"):
        warp_image(source, tmp_path / "b.tif", PLACE, PLACE.homography, {}, ImageOptions(compression=compression))
    assert [path.name for path in tmp_path.iterdir()] == ["a.tif"]


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
def test_overviews_show_the_same_ground_and_no_dark_edge(tmp_path: Path, dtype: str) -> None:
    source = write_raster(tmp_path / "a.tif", np.full((1, 900, 1200), 200, dtype))
    homography, _ = image_homography(PLACE, MASK_SIZE, source)
    warp_image(source, tmp_path / "b.tif", PLACE, homography, {})
    with rasterio.open(tmp_path / "b.tif") as raster:
        factors, shown = raster.overviews(1), (raster.dataset_mask() > 0).mean()
    assert factors[:1] == [2]
    for level in range(len(factors)):
        with rasterio.open(tmp_path / "b.tif", overview_level=level) as raster:
            values, alpha = raster.read()
        assert (np.abs(values[alpha > 0].astype(int) - 200) <= 4).all()  # eight bits of an edge
        assert (values[alpha == 0] == 0).all()
        assert (alpha > 0).mean() == pytest.approx(shown, abs=0.02)


@pytest.mark.parametrize("k1", [0.0, -0.08])
@pytest.mark.parametrize("crs", [None, "EPSG:4326"])
def test_where_pixels_come_from_is_as_good_as_exact(k1: float, crs: str | None) -> None:
    place = replace(PLACE, matrix=PLACE.matrix @ np.array([[1, 0, 0], [0, 1, 0], [4e-4, -3e-4, 1]]), lens_k1=k1)
    target = choose_target(place, ImageOptions(crs))
    grid = cover((1600, 1200), place.homography, None, 4_000_000, target.to_target)
    size, lens = (grid.width, grid.height), place.lens((1600, 1200))
    found = source_pixels(place.homography, grid, 0, 0, size, (1600, 1200), target.to_place, lens)
    columns, rows = (np.linspace(0, side - 1, 40).astype(int) for side in size)
    centers = Homography(grid.to_crs_matrix())(np.stack(np.meshgrid(columns + 0.5, rows + 0.5), axis=2))
    exact = Homography(place.homography).inverse()(centers if target.to_place is None else target.to_place(centers))
    exact = exact if lens is None else lens.bend(exact)
    inside = ((exact > 0) & (exact < (1600, 1200))).all(axis=2)
    assert inside.any()
    off = found[rows][:, columns] - exact
    assert np.abs(off[inside]).max() < 0.01


def test_a_picture_that_lies_north_up_keeps_its_pixels() -> None:
    """Lines half a pixel beside the picture's own would shift what is not interpolated, and blur the rest."""
    to_crs = np.array([[0.7, 0.0, 5000.35], [0.0, -0.7, 9000.21], [0.0, 0.0, 1.0]])
    picture = np.random.default_rng(3).integers(0, 256, (40, 50), np.uint8)
    grid = cover((50, 40), to_crs, None, 4_000_000)
    assert (grid.width, grid.height) == (50, 40)
    assert np.array_equal(warp(picture, to_crs, grid), picture)
    grid = cover((50, 40), to_crs, 0.5, 4_000_000)  # rasters of one resolution lie on the same lines
    assert (grid.west, grid.north) == (5000.0, 9000.5)
