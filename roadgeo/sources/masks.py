"""Where a query mask enters: any raster that GDAL or OpenCV reads becomes a `RoadMask`."""

from __future__ import annotations

import logging
import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, BoolArray
from roadgeo.errors import MaskError
from roadgeo.geometry.mask import RoadMask
from roadgeo.roads.observed import find_voids
from roadgeo.roads.vectorization import road_width

if TYPE_CHECKING:
    from rasterio import DatasetReader

__all__ = ["read_mask"]

_LOG = logging.getLogger(__name__)

MIN_SIDE, MAX_SIDE = 32, 20_000
_STRIP_PIXELS = 1 << 25  # rows are read and thresholded so many pixels at a time
_SAMPLE_PIXELS = 1 << 18  # what a mask's values mean is told from about so many
_COLOURED_SHARE, _GREY_SHARE, _GREY_SHARE_ON_DARK = 0.05, 0.25, 0.3  # more than this: a photograph
_MAX_ROAD_SHARE = 0.35  # of a frame
_MAX_CLASS = 32  # whole numbers up to this, three or more of them, are the classes of a map

#: First bytes of the files that OpenCV reads; importing rasterio would take longer than reading the mask.
_PNG_MAGIC, _PNG_END = b"\x89PNG\r\n", b"IEND"
_OPENCV_MAGIC = (_PNG_MAGIC, b"\xff\xd8\xff", b"BM")


@dataclass(frozen=True)
class _Raster:
    """A raster's values, not necessarily in memory. Dimensions: H rows, W columns, B bands (alpha left out).

    `read(top, bottom, step)` returns every `step`-th value of these rows as (rows, columns, B), and where they are
    valid as (rows, columns) bool, or None for everywhere.
    """

    name: str
    shape: tuple[int, int]
    n_bands: int
    read: Callable[[int, int, int], tuple[AnyArray, BoolArray | None]]


def read_mask(
    source: str | os.PathLike[str] | AnyArray,
    *,
    band: int | None = None,
    threshold: float | None = None,
    name: str | None = None,
    voids: bool = True,
) -> RoadMask:
    """Read a road mask.

    Parameters
    ----------
    source : path or array
        A raster file, or an (H, W) or (H, W, bands) array (a masked array's masked pixels are unobserved).
    band : int, optional
        The band that holds the mask, counted from 1. Default: told by the bands, where they can be told apart.
    threshold : float, optional
        Values above it are road. Default: told by the values: half of the range of a probability or of a
        grey scale, otherwise between the two groups of values (Otsu 1979).
    name : str, optional
        What to call the mask. Default: the path as given.
    voids : bool
        Whether to look for black corners that a warped image left in its frame. Nodata, NaN and alpha 0 are never
        taken for observed ground.

    Returns
    -------
    RoadMask

    Raises
    ------
    MaskError
        The file is missing or no raster; or it is empty, too small, too large, a photograph, or of several classes.
    """
    with _open(source, band, name) as raster:
        height, width = raster.shape
        if min(raster.shape) < MIN_SIDE or max(raster.shape) > MAX_SIDE:
            raise MaskError(
                f"{raster.name}: {width} x {height} pixels; expected {MIN_SIDE} to {MAX_SIDE} on each side: "
                + ("give a larger mask" if min(raster.shape) < MIN_SIDE else "reduce it or cut it up")
            )
        roads, observed = _separate(raster, threshold)
    roads, observed = _told_apart(raster.name, roads, observed)
    if voids and observed is None:
        observed = find_voids(roads, road_width(RoadMask(roads, name=raster.name)))
    if observed is not None:
        roads &= observed
    return RoadMask(roads, observed, raster.name)


def _separate(raster: _Raster, threshold: float | None) -> tuple[BoolArray, BoolArray | None]:
    """Return where values lie above the threshold, and where they are valid."""
    height, width = raster.shape
    step = int(np.ceil(np.sqrt(height * width / _SAMPLE_PIXELS)))
    sample, valid = raster.read(0, height, step)
    finite = _finite(sample, valid)
    seen = sample.reshape(-1, raster.n_bands) if finite.all() else sample[finite]
    if len(seen) == 0:
        raise MaskError(f"{raster.name}: holds no observed pixel, only nodata, NaN or alpha 0; give a mask with roads")
    channel = int(np.argmax(seen.std(axis=0))) if raster.n_bands > 1 else 0
    if threshold is None:
        threshold = _threshold(raster.name, seen, channel)

    roads = np.zeros(raster.shape, np.bool_)
    observed = None
    rows = max(1, _STRIP_PIXELS // (width * raster.n_bands))
    for top in range(0, height, rows):
        strip = slice(top, min(top + rows, height))
        values, valid = raster.read(strip.start, strip.stop, 1)
        _compare(values[..., channel], threshold, roads[strip])
        finite = _finite(values, valid)
        if not finite.all():
            observed = np.ones(raster.shape, np.bool_) if observed is None else observed
            observed[strip] = finite
            roads[strip] &= finite
    if not roads.any():
        raise MaskError(
            f"{raster.name}: shows no road: no value above {threshold:g}, the largest of a sample is "
            f"{seen[:, channel].max():g}; expected roads as light pixels (or give a lower threshold)"
        )
    return roads, observed


def _compare(values: AnyArray, threshold: float, above: BoolArray) -> None:
    """Set `above` where values exceed the threshold, in the values' own type: many times faster for whole numbers."""
    if values.dtype.kind == "f":
        np.greater(values, threshold, out=above)
        return
    limits = np.iinfo(values.dtype)
    if threshold < limits.max:
        np.greater_equal(values, max(int(np.floor(threshold)) + 1, limits.min), out=above)


def _finite(values: AnyArray, valid: BoolArray | None) -> BoolArray:
    """Return (rows, columns) where values are valid numbers."""
    finite = np.ones(values.shape[:2], np.bool_) if valid is None else valid
    return finite & np.isfinite(values).all(axis=2) if values.dtype.kind == "f" else finite


def _threshold(name: str, seen: AnyArray, channel: int) -> float:
    """Tell from (n, B) values what is road; `channel` is the band to go by."""
    values = seen[:, channel].astype(np.float64)
    levels = np.unique(values)
    low, high = levels[0], levels[-1]
    if len(levels) <= 2:
        return float(low + high) / 2 if high > low else float(np.nextafter(high, -np.inf) if high > 0 else high)
    _refuse_classes(name, seen, levels)
    if seen.dtype.kind == "f" and low >= 0 and high <= 1:
        return 0.5  # probabilities
    _refuse_photograph(name, seen, values)
    if seen.dtype == np.uint8 and high > 127:
        return 127.0
    return _otsu(values)


def _refuse_classes(name: str, seen: AnyArray, levels: AnyArray) -> None:
    """Raise where (n, B) values are the classes of a land cover map: small whole numbers or a handful of colours."""
    if seen.dtype.kind in "iu" and levels[-1] <= _MAX_CLASS:
        listed = ", ".join(f"{level:g}" for level in levels)
        raise MaskError(f"{name}: holds the classes {listed}; expected road and no road: give a threshold or a mask")
    if seen.shape[1] == 1 or np.ptp(seen.astype(np.float64), axis=1).max() <= 0.1 * levels[-1]:
        return
    n_colours = len(np.unique(seen, axis=0)) if len(levels) <= _MAX_CLASS else 0
    if 2 < n_colours <= _MAX_CLASS:
        raise MaskError(f"{name}: holds {n_colours} colours; expected road and no road: choose a band or give a mask")


def _refuse_photograph(name: str, seen: AnyArray, values: AnyArray) -> None:
    """Raise where (n, B) values are coloured, or spread between the usual dark and the usual light (n,) value."""
    span = np.ptp(values)
    coloured = np.mean(np.ptp(seen.astype(np.float64), axis=1) > 0.05 * span) if seen.shape[1] > 1 else 0.0
    counts, edges = np.histogram(values, bins=64)
    dark, light = edges[np.argmax(counts[:32])], edges[32 + np.argmax(counts[32:])]
    off_light = np.abs(values - light) > 0.08 * span
    off = np.mean(off_light & (np.abs(values - dark) > 0.08 * span))
    off_on_dark = off / np.mean(off_light) if np.mean(off_light) > 0.5 else 0.0
    if coloured > _COLOURED_SHARE or off > _GREY_SHARE or off_on_dark > _GREY_SHARE_ON_DARK:
        raise MaskError(
            f"{name}: looks like a photograph, {coloured:.0%} of it coloured and {off:.0%} neither dark nor light; "
            "expected a mask of its roads: segment it first (or give a threshold, if it is a mask)"
        )


def _otsu(values: AnyArray) -> float:
    """Return the value that parts two groups best: largest variance between them (Otsu 1979)."""
    counts, edges = np.histogram(values, bins=256)
    centres = (edges[:-1] + edges[1:]) / 2
    below = np.cumsum(counts)[:-1]
    sums = np.cumsum(counts * centres)
    above = len(values) - below
    between = below * above * (sums[:-1] / below - (sums[-1] - sums[:-1]) / np.maximum(above, 1)) ** 2
    return float(edges[1:-1][np.argmax(between)])


def _told_apart(name: str, roads: BoolArray, observed: BoolArray | None) -> tuple[BoolArray, BoolArray | None]:
    """Put right what nodata, transparency and inverted masks mix up; refuse a mask that is all road."""
    n_roads = int(np.count_nonzero(roads))
    n_seen = roads.size if observed is None else int(np.count_nonzero(observed))
    if n_roads <= 0.5 * n_seen:
        return roads, observed
    if n_roads <= _MAX_ROAD_SHARE * roads.size:
        return roads, None  # what is called nodata, or transparent, is the ground between the roads
    inverted = ~roads if observed is None else observed & ~roads
    if not inverted.any():
        raise MaskError(f"{name}: every pixel is light; expected roads as light pixels on dark ground")
    _LOG.warning("%s: dark roads on light ground: read as inverted", name)
    return inverted, observed


@contextmanager
def _open(source: str | os.PathLike[str] | AnyArray, band: int | None, name: str | None) -> Iterator[_Raster]:
    """Open a source for reading."""
    if not isinstance(source, str | os.PathLike):
        yield _of_array(np.ma.asanyarray(source), band, name or "array", alpha=False)
        return
    path = os.fspath(source)
    name = name or path
    if not path.startswith("/vsi"):
        if not Path(path).exists():
            raise MaskError(f"{name}: no such file; check the path")
        if Path(path).is_dir():
            raise MaskError(f"{name}: is a folder; give a raster file")
        image = _read_with_opencv(path, name)
        if image is not None:
            yield _of_array(image, band, name, alpha=image.ndim == 3 and image.shape[2] == 4)
            return
    with _open_dataset(path, name) as dataset:
        yield _of_dataset(dataset, band, name)


def _read_with_opencv(path: str, name: str) -> AnyArray | None:
    """Decode a PNG, JPEG or BMP without side files as it is stored; None where GDAL has to."""
    with Path(path).open("rb") as file:
        head = file.read(8)
    if not head.startswith(_OPENCV_MAGIC) or Path(path + ".aux.xml").exists():
        return None
    content = np.fromfile(path, np.uint8)
    is_png = head.startswith(_PNG_MAGIC)
    image = (
        None if is_png and _PNG_END not in content[-1024:].tobytes() else cv2.imdecode(content, cv2.IMREAD_UNCHANGED)
    )
    if is_png and image is None:  # GDAL would read the rest as black
        raise MaskError(f"{name}: a PNG that is damaged or cut short; copy or export it again")
    return image


def _of_array(array: AnyArray, band: int | None, name: str, *, alpha: bool) -> _Raster:
    """Wrap an (H, W) or (H, W, bands) array; its last band may be alpha."""
    if array.ndim not in (2, 3) or array.dtype.kind not in "biuf" or array.size == 0:
        raise MaskError(
            f"{name}: an array of shape {array.shape} and type {array.dtype}; expected (rows, columns) or "
            "(rows, columns, bands) of numbers or booleans"
        )
    whole = array if array.ndim == 3 else array[..., None]
    data = np.ma.getdata(whole)
    valid = np.asarray(~np.ma.getmaskarray(whole).any(axis=2)) if np.ma.is_masked(whole) else None
    if alpha:
        data, valid = data[..., :-1], data[..., -1] > 0
    data = data[..., _bands(name, band, data.shape[2])]
    if data.dtype == np.bool_:
        data = data.view(np.uint8)

    def read(top: int, bottom: int, step: int) -> tuple[AnyArray, BoolArray | None]:
        rows = slice(top, bottom, step)
        return data[rows, ::step], None if valid is None else valid[rows, ::step]

    return _Raster(name, (data.shape[0], data.shape[1]), data.shape[2], read)


@contextmanager
def _open_dataset(path: str, name: str) -> Iterator[DatasetReader]:
    """Open a raster with GDAL."""
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning, RasterioError

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        try:
            with rasterio.open(path) as dataset:
                yield dataset
        except RasterioError as error:
            reason = str(error).splitlines()[0]
            raise MaskError(
                f"{name}: not a raster that GDAL or OpenCV can read ({reason}); give an image or GeoTIFF"
            ) from error


def _of_dataset(dataset: DatasetReader, band: int | None, name: str) -> _Raster:
    """Wrap an open GDAL dataset."""
    from rasterio.enums import ColorInterp, MaskFlags
    from rasterio.windows import Window

    colour = [
        i for i, meaning in zip(dataset.indexes, dataset.colorinterp, strict=True) if meaning != ColorInterp.alpha
    ]
    if not colour:
        raise MaskError(f"{name}: holds no band of values; give an image or GeoTIFF")
    chosen = [colour[i] for i in _bands(name, band, len(colour))]
    all_valid = MaskFlags.all_valid in list(dataset.mask_flag_enums)[chosen[0] - 1]

    def read(top: int, bottom: int, step: int) -> tuple[AnyArray, BoolArray | None]:
        window = Window(0, top, dataset.width, bottom - top)
        size = (-(-(bottom - top) // step), -(-dataset.width // step))
        values = dataset.read(chosen, window=window, out_shape=(len(chosen), *size))
        valid = None if all_valid else dataset.read_masks(chosen[0], window=window, out_shape=size) > 0
        return np.moveaxis(values, 0, 2), valid

    return _Raster(name, (dataset.height, dataset.width), len(chosen), read)


def _bands(name: str, band: int | None, n_bands: int) -> list[int]:
    """Return the numbers from 0 of the bands to look at: the chosen one, or up to three."""
    if band is not None:
        if not 1 <= band <= n_bands:
            raise MaskError(f"{name}: has no band {band}; expected 1 to {n_bands}")
        return [band - 1]
    if n_bands > 3:
        raise MaskError(f"{name}: has {n_bands} bands; choose the one that holds the roads")
    return list(range(n_bands))
