"""Pictures that other libraries hold: arrays, PIL images, xarray, rasterio datasets. Nothing of those is imported."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol

import numpy as np

from roadgeo._arrays import AnyArray
from roadgeo._text import log_of
from roadgeo.errors import MaskError
from roadgeo.geometry.georeference import Georeference, stretch_of
from roadgeo.roads.thresholds import are_labels
from roadgeo.storage.crs import crs_name
from roadgeo.storage.orientation import UPRIGHT, turn_upright

__all__ = ["PilImage", "RasterioDataset", "XarrayArray", "as_file", "pixels_of", "read_picture"]

_LOG = log_of(__name__)

_SUBFILE_TYPE = 254  # a tag of TIFF
#: Names of the axes of a picture, and of the columns where they are degrees.
_ROWS, _DEGREES = {"y", "row", "rows", "lat", "latitude"}, {"lon", "longitude"}
_COLUMNS = {"x", "column", "col"} | _DEGREES

#: Modes of PIL whose bands are no colours as they are shown, and the ones to convert them to.
_OTHER_COLOURS = {**dict.fromkeys(("CMYK", "YCbCr", "HSV", "LAB", "RGBX"), "RGB"), "RGBa": "RGBA", "La": "LA"}

#: An axis no longer than this holds bands: a mask has at least 32 rows and columns.
_MAX_BANDS = 16


class PilImage(Protocol):
    """The used part of a PIL image."""

    def getbands(self) -> tuple[str, ...]:
        """Return the names of its bands."""


class XarrayArray(Protocol):
    """The used part of an xarray DataArray."""

    @property
    def dims(self) -> Any:
        """Names of its axes."""

    @property
    def values(self) -> Any:
        """Its array."""


class RasterioDataset(Protocol):
    """The used part of a rasterio dataset."""

    @property
    def name(self) -> str:
        """Its file."""

    def read_masks(self, *bands: Any, **how: Any) -> Any:
        """Return where its bands are valid."""


def read_picture(picture: Any) -> str | AnyArray:
    """Return the input of `sources.masks`: the path of a file, or an (H, W) or (H, W, bands) array.

    Parameters
    ----------
    picture : path, array, PIL image, xarray DataArray or rasterio dataset
        The short axis (up to 16) of an array with three holds the bands: first as rasterio has it (C, H, W), or
        last as others do (H, W, C). A dataset that is a file is read as that file. Pixels that are transparent, masked
        or nodata were not observed. A PIL image is turned upright, as `PIL.ImageOps.exif_transpose` does.

    Raises
    ------
    MaskError
        It is something else.
    """
    if isinstance(picture, str | os.PathLike):
        return os.fspath(picture)
    if hasattr(picture, "read_masks"):  # rasterio
        return _read_dataset(picture)
    if hasattr(picture, "getbands"):  # PIL
        return _read_pil(picture)
    if hasattr(picture, "data_vars"):
        raise MaskError(f"an xarray Dataset; give one of its variables: {', '.join(map(str, picture.data_vars))}")
    if hasattr(picture, "dims") and hasattr(picture, "values"):  # xarray
        return _read_xarray(picture)
    if not (isinstance(picture, list | tuple) or hasattr(picture, "__array__")):
        raise MaskError(
            f"{type(picture).__name__} is no picture; expected a path, an array, or a picture of PIL, xarray, rasterio"
        )
    array = np.ma.asanyarray(picture)
    if array.ndim not in (2, 3):
        raise MaskError(f"an array of shape {array.shape}; expected (rows, columns), with bands first or last")
    array = _bands_last(array)
    # Where the last of four bands is full, as matplotlib and OpenCV read pictures, that one is alpha.
    full = 1.0 if array.dtype.kind == "f" else np.iinfo(array.dtype).max if array.dtype.kind in "iu" else None
    return array[..., :3] if array.ndim == 3 and array.shape[2] == 4 and (array[..., 3] == full).all() else array


def pixels_of(picture: Any) -> dict[str, Any]:
    """Return xarray's notes on a picture, as fields of `ReadOptions`: names of bands, shape of pixels, order of rows.

    PIL states the shape of pixels by their resolution.
    Its `attrs["long_name"]` or the coordinates of its third axis are names. Axes called lat and lon, or a geographic
    CRS as rioxarray writes it, are in degrees.
    """
    if hasattr(picture, "getbands"):  # PIL
        stated = (picture.info.get(name) for name in ("dpi", "jfif_density", "aspect"))
        across, down = next(filter(None, stated), (1.0, 1.0))
        return {"aspect": stretch_of(float(down), float(across))}
    if not (hasattr(picture, "dims") and hasattr(picture, "coords")):
        return {}
    rows, columns = (_axis(picture, names) for names in (_ROWS, _COLUMNS))
    rest = [name for name in picture.dims if name not in (rows, columns)]
    labels = picture.coords[rest[0]].values if len(rest) == 1 and rest[0] in picture.coords else ()
    labels = named if isinstance(named := picture.attrs.get("long_name"), tuple | list) else labels
    labelled: dict[str, Any] = {"names": tuple(label for label in labels if isinstance(label, str))}
    noted: dict[str, Any] = getattr(picture.coords.get("spatial_ref"), "attrs", {})
    crs = crs_name(str(noted["crs_wkt"])) if noted.get("crs_wkt") else None
    numbers = [float(one) for one in str(noted.get("GeoTransform", "")).split()]
    if crs and len(numbers) == 6 and rows is not None and columns is not None:  # rioxarray's, of turned pictures, too
        place = np.array([[*numbers[1:3], numbers[0]], [*numbers[4:6], numbers[3]], [0.0, 0.0, 1.0]])
        size = picture.sizes[columns], picture.sizes[rows]
        aspect, is_mirrored = Georeference(place, crs, size, "geotransform").pixel_shape()
        return {**labelled, "aspect": aspect, "mirror": is_mirrored}
    if rows is None or columns is None or not {rows, columns} <= set(picture.coords):
        return labelled
    x, y = (np.asarray(picture.coords[name].values, float) for name in (columns, rows))
    if min(len(x), len(y)) < 2 or not np.isfinite([*x[[0, -1]], *y[[0, -1]]]).all() or x[0] == x[-1] or y[0] == y[-1]:
        return labelled
    wide, high = (x[-1] - x[0]) / (len(x) - 1), (y[-1] - y[0]) / (len(y) - 1)
    place = np.array([[wide, 0.0, x[0] - wide / 2], [0.0, high, y[0] - high / 2], [0.0, 0.0, 1.0]])
    named_crs = crs or ("EPSG:4326" if str(columns).lower() in _DEGREES else None)
    aspect, is_mirrored = stretch_of(wide, high), wide * high > 0.0 and (y[0], high) not in ((0.0, 1.0), (0.5, 1.0))
    if named_crs is not None:
        aspect, is_mirrored = Georeference(place, named_crs, (len(x), len(y)), "geotransform").pixel_shape()
    return {**labelled, "aspect": aspect, "mirror": bool(is_mirrored)}


def _axis(data: Any, names: set[str]) -> Any:
    return next((name for name in data.dims if str(name).lower() in names), None)


@contextmanager
def as_file(picture: str | AnyArray) -> Iterator[str]:
    """Yield the path of a picture: its own, or a GeoTIFF's that holds an array (H, W) or (H, W, bands) meanwhile.

    Numbers between 0 and 1 become numbers of 8 bits; masked pixels are transparent.
    """
    if isinstance(picture, str):
        yield picture
        return
    import rasterio

    values = np.ma.filled(picture, 0)
    values = values[..., None] if values.ndim == 2 else values
    if values.dtype.kind == "f" and values.size and float(np.nanmax(values)) <= 1.0:
        values = np.rint(255.0 * np.nan_to_num(values)).astype(np.uint8)
    hidden = np.ma.getmaskarray(picture).reshape(values.shape).all(axis=2)
    with TemporaryDirectory(prefix="roadgeo-") as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        path = str(Path(folder) / "photograph.tif")
        height, width, count = values.shape
        with rasterio.open(
            path, "w", driver="GTiff", height=height, width=width, count=count, dtype=values.dtype
        ) as file:
            file.write(np.moveaxis(values, 2, 0))
            if hidden.any():
                file.write_mask(~hidden)
        yield path


def _bands_last(array: AnyArray) -> AnyArray:
    """Move bands that come first to the end; a single band goes."""
    if array.ndim == 3 and array.shape[0] <= _MAX_BANDS < array.shape[2]:
        array = np.moveaxis(array, 0, 2)
    return array[..., 0] if array.ndim == 3 and array.shape[2] == 1 else array


def _transparent(values: AnyArray, alpha: AnyArray) -> AnyArray:
    """Mask transparent pixels; of black drawn on transparent ground the alpha itself shows the roads."""
    if not values[alpha > 0].any():
        return alpha
    hidden = np.repeat((alpha <= alpha.max() // 2)[..., None], values.shape[2], axis=2)  # edges may be smoothed
    masked: AnyArray = np.ma.masked_array(values, hidden)
    return masked


def _read_pil(image: Any) -> AnyArray:
    if getattr(image, "tag_v2", {}).get(_SUBFILE_TYPE, 0) & 1:
        _LOG.warning("the picture is a thumbnail by its tags; `seek` the page that you mean, or give the file's path")
    try:
        image = image.convert(_OTHER_COLOURS[image.mode]) if image.mode in _OTHER_COLOURS else image
    except ValueError as error:
        raise MaskError(f"a picture of PIL's mode {image.mode}; convert it to RGB") from error
    bands = image.getbands()
    if bands[0] == "P" and not are_labels(np.asarray(image)):
        image = image.convert("RGBA" if "transparency" in image.info else "RGB")
        bands = image.getbands()
    values = np.asarray(image)  # PIL turns TIFFs by itself, and forgets that they were to be
    orientation = image.getexif().get(274, UPRIGHT)
    values = turn_upright(values, orientation if orientation in range(1, 9) else UPRIGHT)
    return _transparent(values[..., :-1], values[..., -1]) if bands[-1] == "A" else values


def _read_dataset(dataset: Any) -> str | AnyArray:
    if Path(dataset.name).is_file():
        return str(dataset.name)
    return _bands_last(dataset.read(masked=True))


def _read_xarray(data: Any) -> AnyArray:
    """Take the last two axes, or those called y and x (row and column, latitude and longitude), for the picture's."""
    names = [str(name) for name in data.dims]
    values = np.asarray(data.values)
    if (row_axis := _axis(data, _ROWS)) is None or (column_axis := _axis(data, _COLUMNS)) is None:
        return _bands_last(values)
    rows, columns = data.dims.index(row_axis), data.dims.index(column_axis)
    rest = [i for i in range(values.ndim) if i not in (rows, columns)]
    if len(rest) > 1:
        raise MaskError(f"an array of the dimensions {', '.join(names)}; choose a time or level first")
    return _bands_last(np.transpose(values, (rows, columns, *rest)))
