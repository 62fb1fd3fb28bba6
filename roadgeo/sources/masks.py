"""Where a query mask enters: any raster that GDAL reads becomes a `RoadMask`."""

from __future__ import annotations

import contextlib
import logging
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from roadgeo._arrays import AnyArray, BoolArray
from roadgeo._text import visible
from roadgeo.errors import MaskError, PhotographError
from roadgeo.geometry.mask import PROBABILITY_SURE, PROBABILITY_UNKNOWN, RoadMask
from roadgeo.roads.borders import find_border
from roadgeo.roads.observed import find_voids
from roadgeo.roads.thresholds import (
    Sample,
    are_labels,
    find_thresholds,
    find_unlabelled,
    ground_and_road,
    spread_probability,
)
from roadgeo.roads.vectorization import road_width
from roadgeo.storage.rasters import MAX_SIDE as MAX_RASTER_SIDE
from roadgeo.storage.rasters import open_raster, sidecar_nodata

if TYPE_CHECKING:
    from rasterio import DatasetReader

__all__ = ["PROBABILITY_TAG", "THRESHOLD_TAG", "MaskSource", "open_mask", "read_mask"]

_LOG = logging.getLogger(__name__)

#: Tags that mark our own maps of probability among masks that users made, and the threshold of their model.
PROBABILITY_TAG, THRESHOLD_TAG = "ROADGEO", "THRESHOLD"

MIN_SIDE, MAX_SIDE = 32, 20_000
_MAX_CLASSES = 32  # whose colours a palette holds
_MAX_BANDS = 3  # of a mask, unless one of them is chosen
_STRIP_PIXELS = 1 << 25  # rows are read and thresholded in strips of this size
_SAMPLE_PIXELS = 1 << 18  # size of the sample by which a mask's values are interpreted
_MIDDLE_PIXELS = 1 << 22  # and, where neighbours matter, of a sample of the middle rows
_MAX_ROAD_SHARE = 0.35  # of a frame

#: Larger values, whatever their sign, stand for no value: the least number of a type is often written for nodata.
_MAX_VALUE = 1e30


@dataclass(frozen=True)
class _Raster:
    """A raster's values, not necessarily in memory. Dimensions: H rows, W columns, B bands (alpha left out).

    `read(top, bottom, step)` returns every `step`-th value of these rows as (rows, columns, B), and where they are
    valid as (rows, columns) bool, or None for everywhere. `has_alpha`: they are valid where they are not transparent.
    `n_unread`: bands beyond those that are read. `model_threshold`: of a map of probability that we wrote.
    """

    name: str
    shape: tuple[int, int]
    n_bands: int
    read: Callable[[int, int, int], tuple[AnyArray, BoolArray | None]]
    has_alpha: bool = False
    n_unread: int = 0
    model_threshold: float | None = None


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
        The band that holds the mask, counted from 1. Default: by the bands' content, where that is clear.
    threshold : float, optional
        Values above it are road. Default: by the values: half of the range of a probability or of a
        grey scale, otherwise between the two groups of values (Otsu 1979).
    name : str, optional
        Name of the mask. Default: the path as given.
    voids : bool
        Whether to look for black corners that a warped image left in its frame, and for the surroundings of a scanned
        map: margins, the line around it, captions. Nodata, NaN and alpha 0 are never taken for observed ground.

    Returns
    -------
    RoadMask

    Raises
    ------
    PhotographError
        It is a photograph.
    MaskError
        The file is missing or no raster; or it is empty, too small, too large, or of several classes.
    """
    with open_mask(source, band=band, threshold=threshold, name=name, voids=voids) as opened:
        return opened.read(opened.thresholds[0])


@dataclass(frozen=True)
class MaskSource:
    """An open mask, or a soft map of roads that can be read at several thresholds.

    Attributes
    ----------
    thresholds : tuple of float
        Those worth trying, the most promising first; one for a mask.
    """

    thresholds: tuple[float, ...]
    _raster: _Raster
    _channel: int
    _voids: bool
    _levels: tuple[float, float] | None  # a soft map's values of ground and of road

    def read(self, threshold: float) -> RoadMask:
        """Read where values lie above a threshold as road.

        Raises
        ------
        MaskError
            There are no roads, or hardly anything else.
        """
        name, is_mask = self._raster.name, self._raster.model_threshold is None
        roads, observed = _separate(self._raster, self._channel, threshold)
        if is_mask:
            roads, observed = _told_apart(name, roads, observed)
        if self._voids and is_mask:
            width = road_width(RoadMask(roads, name=name))
            roads, observed = _without_border(name, roads, observed, width)
            observed = find_voids(roads, width) if observed is None else observed
        if observed is not None:
            roads &= observed
        return RoadMask(roads, observed, name, self._probability(roads))

    def _probability(self, roads: BoolArray) -> AnyArray | None:
        """Return the probability of each pixel, as `RoadMask.probability`; None of a mask, which has none."""
        if self._levels is None:
            return None
        if self._raster.model_threshold is not None:
            return _between(self._raster, self._channel, 0.0, float(PROBABILITY_SURE))
        sure = _between(self._raster, self._channel, *self._levels)
        dark = roads.any() and np.median(sure[roads]) < PROBABILITY_SURE / 2  # roads on light ground
        return np.where(sure == PROBABILITY_UNKNOWN, sure, PROBABILITY_SURE - sure) if dark else sure


@contextmanager
def open_mask(
    source: str | os.PathLike[str] | AnyArray,
    *,
    band: int | None = None,
    threshold: float | None = None,
    name: str | None = None,
    voids: bool = True,
) -> Iterator[MaskSource]:
    """Open a road mask or a soft map of roads: parameters and errors as of `read_mask`."""
    with _open(source, band, name) as raster:
        _require_size(raster.name, *raster.shape, MAX_RASTER_SIDE)
        own = raster.model_threshold
        if own is not None and threshold is None:
            values = tuple(float(round(PROBABILITY_SURE * item)) for item in spread_probability(own))
            yield MaskSource(values, raster, 0, False, (0.0, float(PROBABILITY_SURE)))
            return
        _require_mask(raster)
        raster = _drawn(raster)
        seen = _sample(raster)
        channel = int(np.argmax(seen.std(axis=0))) if raster.n_bands > 1 else 0
        sample = Sample(raster.name, seen, channel, lambda: _numbers(*_middle(raster), channel))
        if threshold is None:
            raster, sample = _without_unlabelled(raster, sample)
        thresholds = find_thresholds(sample) if threshold is None else (threshold,)
        levels = ground_and_road(sample, thresholds[0]) if len(thresholds) > 1 or own is not None else None
        yield MaskSource(thresholds, raster, channel, voids, levels)


def _drawn(raster: _Raster) -> _Raster:
    """Take the opaque pixels for roads where they are of one dark colour: black roads on transparent ground."""
    if not raster.has_alpha:
        return raster
    step = _sample_step(raster)
    parts = [raster.read(strip.start, strip.stop, step) for strip in _strips(raster, step)]
    opaque = np.concatenate([_finite(*part).ravel() for part in parts])
    values = np.concatenate([values[_finite(values, valid)] for values, valid in parts])
    if not 0 < opaque.mean() <= _MAX_ROAD_SHARE or values.any():
        return raster

    def read(top: int, bottom: int, step: int) -> tuple[AnyArray, BoolArray | None]:
        return _finite(*raster.read(top, bottom, step)).view(np.uint8)[..., None], None

    return _Raster(raster.name, raster.shape, 1, read)


def _without_unlabelled(raster: _Raster, sample: Sample) -> tuple[_Raster, Sample]:
    """Leave out pixels without a label in a map of labels, and report how its values were read."""
    unlabelled, reason = find_unlabelled(sample)
    if reason:
        _LOG.warning("%s: %s; another --threshold tells them apart otherwise", visible(raster.name), reason)
    if unlabelled is None:
        return raster, sample

    def read(top: int, bottom: int, step: int) -> tuple[AnyArray, BoolArray | None]:
        values, valid = raster.read(top, bottom, step)
        labelled = values[..., sample.channel] != unlabelled
        return values, labelled if valid is None else labelled & valid

    labelled = replace(raster, read=read)
    seen = sample.seen[sample.seen[:, sample.channel] != unlabelled]
    return labelled, replace(sample, seen=seen, read_rows=lambda: _numbers(*_middle(labelled), sample.channel))


def _sample_step(raster: _Raster) -> int:
    return int(np.ceil(np.sqrt(raster.shape[0] * raster.shape[1] / _SAMPLE_PIXELS)))


def _sample(raster: _Raster) -> AnyArray:
    """Return (n, B) observed values, from all over a raster."""
    step = _sample_step(raster)
    parts = [raster.read(strip.start, strip.stop, step) for strip in _strips(raster, step)]
    seen = np.concatenate([_observed(values, valid) for values, valid in parts])
    if len(seen) == 0:
        raise MaskError(f"{raster.name}: holds no observed pixel, only nodata, NaN or alpha 0; give a mask with roads")
    return seen


def _middle(raster: _Raster) -> tuple[AnyArray, BoolArray | None]:
    """Read the rows in the middle of a raster: (rows, columns, B), and where they are valid."""
    height, width = raster.shape
    rows = min(height, max(_MIDDLE_PIXELS // width, MIN_SIDE))
    top = (height - rows) // 2
    return raster.read(top, top + rows, 1)


def _numbers(values: AnyArray, valid: BoolArray | None, channel: int) -> AnyArray:
    """Return (rows, columns) values of a band; where they are no numbers, the smallest."""
    finite = _finite(values, valid)
    chosen = values[..., channel]
    return chosen if finite.all() else np.where(finite, chosen, chosen[finite].min() if finite.any() else 0)


def _separate(raster: _Raster, channel: int, threshold: float) -> tuple[BoolArray, BoolArray | None]:
    """Return where values of a band lie above the threshold, and where they are valid."""
    roads = np.zeros(raster.shape, np.bool_)
    observed = None
    for strip in _strips(raster, 1):
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
            f"{_sample(raster)[:, channel].max():g}; expected roads as light pixels (or give a lower threshold)"
        )
    return roads, observed


def _between(raster: _Raster, channel: int, ground: float, road: float) -> AnyArray:
    """Return where values of a band lie between ground and road, as `RoadMask.probability`."""
    shares = np.full(raster.shape, PROBABILITY_UNKNOWN, np.uint8)
    for strip in _strips(raster, 1):
        values, valid = raster.read(strip.start, strip.stop, 1)
        finite = _finite(values, valid)
        share = np.clip((values[..., channel][finite].astype(np.float32) - ground) / (road - ground), 0.0, 1.0)
        shares[strip][finite] = np.rint(PROBABILITY_SURE * share)
    return shares


def _strips(raster: _Raster, step: int) -> Iterator[slice]:
    """Cut the rows into strips that are read at a time, each of a multiple of `step` rows."""
    height, width = raster.shape
    rows = step * max(1, _STRIP_PIXELS // (width * raster.n_bands * step))
    for top in range(0, height, rows):
        yield slice(top, min(top + rows, height))


def _compare(values: AnyArray, threshold: float, above: BoolArray) -> None:
    """Set `above` where values exceed the threshold, in the values' own type: many times faster for whole numbers."""
    if values.dtype.kind == "f":
        np.greater(values, threshold, out=above)
        return
    limits = np.iinfo(values.dtype)
    if threshold < limits.max:
        np.greater_equal(values, max(int(np.floor(threshold)) + 1, limits.min), out=above)


def _observed(values: AnyArray, valid: BoolArray | None) -> AnyArray:
    """Return (n, B) values of pixels that are valid numbers."""
    finite = _finite(values, valid)
    return values.reshape(-1, values.shape[2]) if finite.all() else np.asarray(values[finite])


def _finite(values: AnyArray, valid: BoolArray | None) -> BoolArray:
    """Return (rows, columns) where values are valid numbers."""
    finite = np.ones(values.shape[:2], np.bool_) if valid is None else valid
    if values.dtype.kind != "f":
        return finite
    limit = values.dtype.type(min(_MAX_VALUE, float(np.finfo(values.dtype).max)))
    return np.asarray(finite & (np.abs(values) <= limit).all(axis=2), np.bool_)


def _told_apart(name: str, roads: BoolArray, observed: BoolArray | None) -> tuple[BoolArray, BoolArray | None]:
    """Put right what nodata, transparency and inverted masks mix up; refuse a mask that is all road."""
    n_roads = int(np.count_nonzero(roads))
    n_seen = roads.size if observed is None else int(np.count_nonzero(observed))
    if n_roads <= 0.5 * n_seen:
        return roads, observed
    if n_roads <= _MAX_ROAD_SHARE * roads.size:
        return roads, None  # nodata, or transparent pixels, are the ground between the roads
    inverted = ~roads if observed is None else observed & ~roads
    if not inverted.any():
        raise MaskError(f"{name}: every pixel is light; expected roads as light pixels on dark ground")
    _LOG.warning("%s: dark roads on light ground: read as inverted", visible(name))
    return inverted, observed


def _without_border(
    name: str, roads: BoolArray, observed: BoolArray | None, road_width_px: float
) -> tuple[BoolArray, BoolArray | None]:
    """Leave out what a scan shows around its map."""
    on_map = find_border(roads, road_width_px)
    if on_map is None or not (roads & on_map).any():
        return roads, observed
    _LOG.warning("%s: what lies beyond the border of the map is left out", visible(name))
    return roads & on_map, on_map if observed is None else observed & on_map


@contextmanager
def _open(source: str | os.PathLike[str] | AnyArray, band: int | None, name: str | None) -> Iterator[_Raster]:
    """Open a source for reading."""
    if not isinstance(source, str | os.PathLike):
        yield _of_array(np.ma.asanyarray(source), band, name or "array")
        return
    with open_raster(source, name) as dataset:
        yield _of_dataset(dataset, band, name or os.fspath(source), sidecar_nodata(source))


def _require_size(name: str, height: int, width: int, most: int) -> None:
    """Refuse by its header what is too small to show roads, or too large to decode."""
    low, high = min(height, width), max(height, width)
    if low < MIN_SIDE or high > most:
        raise MaskError(
            f"{name}: {width} x {height} pixels; expected {MIN_SIDE} to {MAX_SIDE} on each side: "
            + ("give a larger mask" if low < MIN_SIDE else "reduce it or cut it up")
        )


def _require_mask(raster: _Raster) -> None:
    """Refuse what has more pixels or bands than a mask, as a photograph if its middle rows look like one."""
    if max(raster.shape) <= MAX_SIDE and raster.n_unread == 0:
        return
    values, valid = _middle(raster)
    seen = _observed(values, valid)
    many = f"{raster.name}: has {raster.n_bands + raster.n_unread} bands; choose the one that holds the roads"
    try:
        if len(seen):
            channel = int(np.argmax(seen.std(axis=0)))
            find_thresholds(Sample(raster.name, seen, channel, lambda: _numbers(values, valid, channel)))
    except PhotographError as error:
        if raster.n_unread:
            raise PhotographError(f"{many}, if it is a mask: the first of them look like a photograph") from error
        raise
    except MaskError:
        pass  # the error below comes first
    _require_size(raster.name, *raster.shape, MAX_SIDE)
    raise MaskError(many)


def _of_array(array: AnyArray, band: int | None, name: str) -> _Raster:
    """Wrap an (H, W) or (H, W, bands) array."""
    if array.ndim not in (2, 3) or array.dtype.kind not in "biuf" or array.size == 0:
        raise MaskError(
            f"{name}: an array of shape {array.shape} and type {array.dtype}; expected (rows, columns) or "
            "(rows, columns, bands) of numbers or booleans"
        )
    whole = array if array.ndim == 3 else array[..., None]
    data = np.ma.getdata(whole)
    valid = np.asarray(~np.ma.getmaskarray(whole).any(axis=2)) if np.ma.is_masked(whole) else None
    chosen = _bands(name, band, data.shape[2])
    n_unread = 0 if band is not None else data.shape[2] - len(chosen)
    data = data[..., chosen]
    if data.dtype == np.bool_:
        data = data.view(np.uint8)

    def read(top: int, bottom: int, step: int) -> tuple[AnyArray, BoolArray | None]:
        rows = slice(top, bottom, step)
        return data[rows, ::step], None if valid is None else valid[rows, ::step]

    return _Raster(name, (data.shape[0], data.shape[1]), data.shape[2], read, n_unread=n_unread)


def _of_dataset(dataset: DatasetReader, band: int | None, name: str, nodata: float | None) -> _Raster:
    """Wrap an open GDAL dataset; `nodata` is the value of a side file."""
    from rasterio.enums import ColorInterp, MaskFlags
    from rasterio.windows import Window

    colour = [
        i for i, meaning in zip(dataset.indexes, dataset.colorinterp, strict=True) if meaning != ColorInterp.alpha
    ]
    if not colour:
        raise MaskError(f"{name}: holds no band of values; give an image or GeoTIFF")
    chosen = [colour[i] for i in _bands(name, band, len(colour))]
    kinds = {str(dataset.dtypes[i - 1]) for i in chosen}
    if not all(kind.startswith(("bool", "int", "uint", "float")) for kind in kinds):
        raise MaskError(f"{name}: holds values of type {', '.join(sorted(kinds))}; expected real numbers")
    palette = _palette(dataset, colour[0]) if len(colour) == 1 else None
    all_valid = MaskFlags.all_valid in list(dataset.mask_flag_enums)[chosen[0] - 1]

    def read(top: int, bottom: int, step: int) -> tuple[AnyArray, BoolArray | None]:
        window = Window(0, top, dataset.width, bottom - top)
        # Every step-th value of all, for to read fewer GDAL would go to overviews: blurred, or of another file.
        values = np.moveaxis(dataset.read(chosen, window=window)[:, ::step, ::step], 0, 2)
        valid = None if all_valid else dataset.read_masks(chosen[0], window=window)[::step, ::step] > 0
        if nodata is not None and dataset.nodata is None:
            known = (values != nodata).all(axis=2)
            valid = known if valid is None else valid & known
        if palette is None:
            return values, valid
        shown = palette[values[..., 0]]
        return shown[..., :3], shown[..., 3] > 0 if valid is None else valid & (shown[..., 3] > 0)

    has_alpha = len(colour) < dataset.count or (palette is not None and not palette[:, 3].all())
    n_unread = 0 if band is not None else len(colour) - len(chosen)
    n_bands = len(chosen) if palette is None else 3
    return _Raster(name, (dataset.height, dataset.width), n_bands, read, has_alpha, n_unread, _model_threshold(dataset))


def _model_threshold(dataset: DatasetReader) -> float | None:
    """Return the threshold of the model that made a map of probability, where that is one that we wrote."""
    tags = dataset.tags()
    if PROBABILITY_TAG not in tags or dataset.count != 1 or dataset.dtypes[0] != "uint8":
        return None
    with contextlib.suppress(ValueError):
        threshold = float(tags.get(THRESHOLD_TAG, ""))
        return threshold if 0.0 < threshold < 1.0 else None
    return None


def _palette(dataset: DatasetReader, band: int) -> AnyArray | None:
    """Return the (256, 4) colours that values stand for; None where the values mean what they are, as classes do."""
    if dataset.dtypes[band - 1] != "uint8" or dataset.colorinterp[band - 1].name != "palette":
        return None
    colours = dataset.colormap(band)
    palette = np.array([colours.get(value, (0, 0, 0, 255)) for value in range(256)], np.uint8)
    used = np.unique(dataset.read(band))
    shown = palette[used, :3]
    is_picture = len(used) > _MAX_CLASSES or (shown == shown[:, :1]).all()  # or greys
    return palette if is_picture and not are_labels(used) else None


def _bands(name: str, band: int | None, n_bands: int) -> list[int]:
    """Return the numbers from 0 of the bands to look at: the chosen one, or the first three."""
    if band is not None:
        if not 1 <= band <= n_bands:
            raise MaskError(f"{name}: has no band {band}; expected 1 to {n_bands}")
        return [band - 1]
    return list(range(min(n_bands, _MAX_BANDS)))
