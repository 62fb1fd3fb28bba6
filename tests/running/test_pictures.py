"""What other libraries hold becomes an array of rows and columns, bands last."""

from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
import rasterio
import xarray
from PIL import Image, ImageOps
from rasterio.io import MemoryFile
from worlds.rasters import write_raster
from worlds.turned import save_turned

from roadgeo.errors import MaskError
from roadgeo.running.pictures import pixels_of, read_picture

GREY = np.arange(40 * 50, dtype=np.uint8).reshape(40, 50)
RGB = np.stack([GREY, GREY + 1, GREY + 2], axis=-1)


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_a_dataset_that_is_no_file_is_read_with_its_nodata() -> None:
    shape = {"count": 3, "height": 40, "width": 50, "dtype": "uint8"}
    with MemoryFile() as file:
        with file.open(driver="GTiff", nodata=0, **shape) as dataset:
            dataset.write(np.moveaxis(RGB, 2, 0))
        with file.open() as dataset:
            read = read_picture(dataset)
    assert np.array_equal(np.ma.getdata(read), RGB)
    assert np.array_equal(np.ma.getmaskarray(read), RGB == 0)


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_a_dataset_that_is_a_file_is_that_file(tmp_path: Path) -> None:
    path = write_raster(tmp_path / "a.tif", GREY)
    with rasterio.open(path) as dataset:
        assert read_picture(dataset) == str(path)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("kind", ["jpg", "png", "tif"])
def test_a_picture_of_pil_is_turned_upright(tmp_path: Path, kind: str, orientation: int) -> None:
    path = save_turned(tmp_path / f"a.{kind}", RGB, orientation)
    for image in (Image.open(path), ImageOps.exif_transpose(Image.open(path))):
        read = read_picture(image)
        assert read.shape == RGB.shape
        assert np.abs(read.astype(int) - RGB).mean() < (40 if kind == "jpg" else 1e-9)


@pytest.mark.parametrize("kind", ["jpg", "png", "tif"])
def test_a_picture_of_pil_has_the_pixels_that_its_resolution_states(tmp_path: Path, kind: str) -> None:
    for dpi, aspect in (((100, 200), pytest.approx(2.0, rel=0.01)), ((72, 72), None), ((0, 0), None)):
        Image.fromarray(GREY).save(tmp_path / f"a.{kind}", dpi=dpi)
        with Image.open(tmp_path / f"a.{kind}") as image:
            assert pixels_of(image) == {"aspect": aspect}


def test_a_thumbnail_of_pil_is_mentioned(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    Image.fromarray(GREY).save(tmp_path / "a.tif", tiffinfo={254: 1})
    with Image.open(tmp_path / "a.tif") as image:
        read_picture(image)
    assert "is a thumbnail" in caplog.text


def paletted(**info: Any) -> Image.Image:
    """Two colours: 0 is a dark red, 1 is white."""
    image = Image.fromarray((GREY > 100).astype(np.uint8), "L").convert("P")
    image.putdata(list((GREY > 100).astype(np.uint8).ravel()))
    image.putpalette([90, 10, 10, 255, 255, 255])
    image.info.update(info)
    return image


def test_a_palette_stands_for_its_colours() -> None:
    read = read_picture(paletted())
    assert read[GREY > 100].tolist() == [[255, 255, 255]] * (GREY > 100).sum()
    assert read[0, 0].tolist() == [90, 10, 10]


def test_labels_in_a_palette_stay_labels() -> None:
    labels = (GREY > 100).astype(np.uint8)
    labels[:5] = 255
    image = Image.fromarray(labels, "P")
    image.putpalette([0, 0, 0, 128, 0, 0, *[9] * 759, 224, 224, 192])
    np.testing.assert_array_equal(read_picture(image), labels)


def test_a_transparent_colour_of_a_palette_was_not_observed() -> None:
    read = read_picture(paletted(transparency=0))
    assert np.array_equal(np.ma.getmaskarray(read)[..., 0], GREY <= 100)
    assert (np.ma.getdata(read)[GREY > 100] == 255).all()


def test_black_on_transparent_ground_is_seen_by_its_alpha() -> None:
    alpha = np.where(GREY > 100, 255, 0).astype(np.uint8)
    drawn = Image.fromarray(np.dstack([np.zeros_like(RGB), alpha]))
    assert np.array_equal(read_picture(drawn), alpha)


@pytest.mark.parametrize(
    ("dims", "axes"),
    [
        (("y", "x"), (0, 1)),
        (("x", "y"), (1, 0)),
        (("lon", "lat"), (1, 0)),
        (("one", "other"), (0, 1)),  # not named: as they stand
    ],
)
def test_axes_by_their_names(dims: tuple[str, str], axes: tuple[int, int]) -> None:
    read = read_picture(xarray.DataArray(GREY.transpose(axes), dims=dims))
    assert np.array_equal(read, GREY)


@pytest.mark.parametrize("dims", [("band", "y", "x"), ("y", "x", "band"), ("x", "band", "y")])
def test_bands_come_last(dims: tuple[str, ...]) -> None:
    axes = {"y": 0, "x": 1, "band": 2}
    data = xarray.DataArray(RGB.transpose([axes[name] for name in dims]), dims=dims)
    assert np.array_equal(read_picture(data), RGB)


def test_of_several_times_one_is_to_be_chosen() -> None:
    data = xarray.DataArray(RGB[None], dims=("time", "y", "x", "band"))
    with pytest.raises(MaskError, match="dimensions time, y, x, band; choose a time or level first"):
        read_picture(data)


def axes(steps: tuple[float, float], **coords: object) -> dict[str, object]:
    return {"y": 4e6 + steps[1] * np.arange(40), "x": 5e5 + steps[0] * np.arange(50), **coords}


@pytest.mark.parametrize(
    ("coords", "aspect", "mirror"),
    [
        (axes((1.0, -1.0)), None, False),
        (axes((1.0, 1.0)), None, True),
        (axes((1.5, -1.0)), 1.5, False),
        ({"y": np.arange(40), "x": np.arange(50)}, None, False),  # numbers of pixels
        ({"lat": 60 + 1e-5 * np.arange(40), "lon": 9 + 1e-5 * np.arange(50)}, 0.5, True),
        ({"lat": 60 - 1e-5 * np.arange(40), "lon": 9 + 1e-5 * np.arange(50)}, 0.5, False),
    ],
)
def test_the_shape_of_pixels_is_as_the_axes_state_it(
    coords: dict[str, object], aspect: float | None, mirror: bool
) -> None:
    known = pixels_of(xarray.DataArray(np.zeros((40, 50)), dims=tuple(coords), coords=coords))
    assert known["mirror"] is mirror
    assert known["aspect"] == (None if aspect is None else pytest.approx(aspect, rel=0.01))


def test_a_crs_says_that_axes_are_degrees() -> None:
    wkt = pyproj.CRS(4326).to_wkt()
    coords = {"y": 60 - 1e-5 * np.arange(40), "x": 9 + 1e-5 * np.arange(50), "spatial_ref": ((), 0, {"crs_wkt": wkt})}
    known = pixels_of(xarray.DataArray(np.zeros((40, 50)), dims=("y", "x"), coords=coords))
    assert known["aspect"] == pytest.approx(0.5, rel=0.01)


def test_names_of_bands() -> None:
    bands = xarray.DataArray(np.zeros((2, 40, 50)), dims=("band", "y", "x"), coords={"band": ["road", "building"]})
    assert pixels_of(bands)["names"] == ("road", "building")
    assert pixels_of(bands.assign_coords(band=[1, 2])) == {"names": ()}
    of_rioxarray = bands.assign_coords(band=[1, 2]).assign_attrs(long_name=("background", "road"))
    assert pixels_of(of_rioxarray)["names"] == ("background", "road")
    assert pixels_of(np.zeros((3, 4))) == {}


@pytest.mark.parametrize("picture", [3.14, None, 5, {}, object(), b"abc"])
def test_what_is_no_picture_is_named(picture):
    with pytest.raises(MaskError, match=rf"^{type(picture).__name__} is no picture; expected a path, an array"):
        read_picture(picture)


def test_a_dataset_of_xarray_names_its_variables():
    data = xarray.Dataset({"road": (("y", "x"), np.zeros((40, 50))), "width": (("y", "x"), np.zeros((40, 50)))})
    with pytest.raises(MaskError, match="give one of its variables: road, width"):
        read_picture(data)


@pytest.mark.parametrize(("kind", "full"), [(np.uint8, 255), (np.uint16, 65535), (np.float32, 1.0)])
@pytest.mark.parametrize("first", [False, True])
def test_a_full_fourth_band_is_alpha(kind, full, first):
    bands = np.random.default_rng(0).integers(0, 2, (40, 50, 4)).astype(kind)
    assert read_picture(np.moveaxis(bands, 2, 0) if first else bands).shape == (40, 50, 4)
    bands[..., 3] = full
    assert read_picture(np.moveaxis(bands, 2, 0) if first else bands).shape == (40, 50, 3)


@pytest.mark.parametrize("crs", ["EPSG:32629", "EPSG:3857", "+proj=utm +zone=29 +ellps=intl +towgs84=-87,-98,-121"])
@pytest.mark.parametrize("turned", [0.0, 30.0])
@pytest.mark.parametrize(("wide", "high"), [(1.0, -1.0), (1.0, 1.0), (2.0, -1.0)])
def test_the_geotransform_of_rioxarray_states_the_shape_of_pixels(crs, turned, wide, high):
    """It gives no coordinates to the axes of a turned picture."""
    place = rasterio.Affine.translation(-957_000, 5_000_000) if crs == "EPSG:3857" else None
    place = place or rasterio.Affine.translation(530_000, 4_557_000)
    place = place @ rasterio.Affine.rotation(turned) @ rasterio.Affine.scale(wide, high)
    stated = {"crs_wkt": pyproj.CRS(crs).to_wkt(), "GeoTransform": " ".join(map(str, place.to_gdal()))}
    data = xarray.DataArray(np.zeros((40, 50)), dims=("y", "x")).assign_coords(spatial_ref=0)
    data.spatial_ref.attrs.update(stated)
    assert pixels_of(data)["mirror"] == (high > 0)
    assert (pixels_of(data)["aspect"] or 1.0) == pytest.approx(wide / abs(high), rel=1e-2)


@pytest.mark.parametrize("mode", ["CMYK", "YCbCr", "HSV", "RGBX", "RGBa"])
def test_colours_of_pil_are_those_that_it_shows(mode):
    shown = Image.fromarray(np.full((40, 50, 3), (200, 90, 30), np.uint8))
    picture = shown.convert("RGBA").convert("RGBa") if mode == "RGBa" else shown.convert(mode)
    assert np.abs(read_picture(picture).astype(int) - (200, 90, 30)).max() <= 5


def test_colours_that_pil_does_not_show_are_refused(monkeypatch):
    def refuse(*_):
        raise ValueError("conversion from LAB to RGB not supported")  # before Pillow 12

    monkeypatch.setattr(Image.Image, "convert", refuse)
    with pytest.raises(MaskError, match="mode LAB; convert it to RGB"):
        read_picture(Image.new("LAB", (50, 40)))
