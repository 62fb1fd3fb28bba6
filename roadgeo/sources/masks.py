"""Where a query mask enters: any raster that is read here becomes a `RoadMask`."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from roadgeo._arrays import AnyArray, BoolArray
from roadgeo._text import listed, log_of
from roadgeo.errors import MaskError, PhotographError
from roadgeo.geometry.mask import PROBABILITY_SURE, PROBABILITY_UNKNOWN, RoadMask
from roadgeo.roads.borders import find_border
from roadgeo.roads.observed import find_voids
from roadgeo.roads.thresholds import (
    Sample,
    are_patches,
    are_roads,
    find_numbered,
    find_thresholds,
    find_unlabelled,
    ground_and_road,
    refuse_different_bands,
    spread_probability,
)
from roadgeo.roads.vectorization import road_width
from roadgeo.sources.bands import Bands, Choice, open_bands
from roadgeo.storage.rasters import MAX_SIDE as MAX_RASTER_SIDE

__all__ = ["MaskSource", "is_photograph", "open_mask", "read_mask"]

_LOG = log_of(__name__)

MIN_SIDE, MAX_SIDE = 32, 20_000
_STRIP_PIXELS = 1 << 25  # rows are read and thresholded in strips of this size
_SAMPLE_PIXELS = 1 << 18  # size of the sample by which a mask's values are interpreted
_MIDDLE_PIXELS = 1 << 22  # and, where neighbours matter, of a sample of the middle rows
_MAX_ROAD_SHARE = 0.35  # of a frame
#: Drawings in two colours, smooth or as JPEG: share of the variance along one line of colours, of pixels beyond either
#: end, how far from an end of 0 to 255 a colour counts as pure, most mixed pixels for each of the rarer end, and least
#: share of neighbours that are equal, as in no photograph.
_ON_A_LINE, _END, _PURE, _MOST_MIXED, _FLAT = 0.97, 0.002, 38, 1.5, 0.5
_MANY_VALUES = 9  # beside a fill that no file declares

#: Larger values, whatever their sign, stand for no value: the least number of a type is often written for nodata.
_MAX_VALUE = 1e30

#: Values of rows (rows, columns, B), and where they are valid; None for everywhere.
_Rows = tuple[AnyArray, BoolArray | None]


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
    with open_mask(source, choice=Choice(band), threshold=threshold, name=name, voids=voids) as opened:
        return opened.read(opened.thresholds[0])


@dataclass(frozen=True)
class MaskSource:
    """An open mask, or a soft map of roads that can be read at several thresholds.

    Attributes
    ----------
    thresholds : tuple of float
        Those worth trying, the most promising first; one for a mask.
    part : str
        What is read of a raster that holds more, for people: "band 2 (road) of 3"; "" where all bands are alike.
    photograph : str
        Why it looks like a photograph, which cannot be read as a mask; "" for a mask.
    """

    thresholds: tuple[float, ...]
    _raster: Bands
    _channel: int
    _voids: bool
    _levels: tuple[float, float] | None  # a soft map's values of ground and of road
    part: str = ""
    photograph: str = ""

    def read(self, threshold: float) -> RoadMask:
        """Read where values lie above a threshold as road.

        Raises
        ------
        MaskError
            It is a photograph, or there are no roads, or hardly anything else.
        """
        if self.photograph:
            raise PhotographError(self.photograph)
        name, is_mask = self._raster.name, self._raster.model_threshold is None
        roads, observed = _separate(self._raster, self._channel, threshold)
        if is_mask:
            roads, observed = _corrected(name, roads, observed)
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
    choice: Choice | None = None,
    threshold: float | None = None,
    name: str | None = None,
    voids: bool = True,
) -> Iterator[MaskSource]:
    """Open a road mask or a soft map of roads; other parameters and errors as of `read_mask`.

    A photograph is no error before it is read (see `MaskSource.photograph`).
    """
    with open_bands(source, choice or Choice(), name) as raster:
        try:
            mask = _interpret(raster, choice or Choice(), threshold, voids)
        except PhotographError as error:
            mask = MaskSource((0.0,), raster, 0, False, None, photograph=str(error))
        yield mask


def is_photograph(source: str | os.PathLike[str] | AnyArray) -> bool:
    """Whether the values of a raster are a photograph's; not where it cannot be read."""
    try:
        with open_mask(source) as mask:
            return bool(mask.photograph)
    except MaskError:
        return False


def _interpret(raster: Bands, choice: Choice, threshold: float | None, voids: bool) -> MaskSource:
    """Choose the band, and the thresholds above which its values are road."""
    _require_size(raster.name, *raster.shape, MAX_RASTER_SIDE)
    own = raster.model_threshold
    if own is not None and threshold is None:
        values = tuple(float(round(PROBABILITY_SURE * item)) for item in spread_probability(own))
        return MaskSource(values, raster, 0, False, (0.0, float(PROBABILITY_SURE)))
    _require_mask(raster)
    if choice.road_class is not None:
        raster = _of_class(raster, choice.road_class)
    observed, hidden = _sample(raster)
    plain = _of_colours(_of_two_colours(_without_fill(raster, observed), observed))
    if plain is not raster:
        raster = plain
        observed, hidden = _sample(raster)
    if len(hidden):
        raster = _drawn(raster, observed, hidden)
        observed, _ = _sample(raster)
    if len(observed) == 0:
        raise MaskError(f"{raster.name}: holds no observed pixel, only nodata, NaN or alpha 0; give a mask with roads")
    channel = int(np.argmax(observed.std(axis=0)))
    sample = Sample(raster.name, observed, channel, lambda: _numbers(*_middle(raster), channel), raster.options)
    refuse_different_bands(sample)
    if threshold is None:
        raster, sample = _without_unlabelled(raster, sample)
    number = find_numbered(sample) if threshold is None else None
    if number is not None:
        _LOG.warning(
            "%s: holds a number for each of its roads: all but its ground, to %g, is road", raster.name, number
        )
    threshold = threshold if number is None else number
    thresholds = find_thresholds(sample) if threshold is None else (threshold,)
    if len(thresholds) > 1 and raster.is_lossy:
        _LOG.warning(
            "%s: is read as a soft map, road above %g; numbers of roads, blurred by compression, would look so, too: "
            "save them without loss, or give --threshold",
            *(raster.name, thresholds[0]),
        )
    levels = ground_and_road(sample, thresholds[0]) if len(thresholds) > 1 or own is not None else None
    return MaskSource(thresholds, raster, channel, voids, levels, _part_of(raster, observed, channel, choice))


def _part_of(raster: Bands, observed: AnyArray, channel: int, choice: Choice) -> str:
    """Return which band of (n, B) values is read, and which class, where there are others."""
    total, are_alike = len(raster.all_bands), not raster.is_chosen and (observed == observed[:, :1]).all()
    band = "" if total < 2 or are_alike else f"band {raster.bands[channel]} of {total}"
    return ", ".join(
        filter(None, [raster.page, band, "" if choice.road_class is None else f"class {choice.road_class}"])
    )


def _drawn(raster: Bands, observed: AnyArray, hidden: AnyArray) -> Bands:
    """Take what shows roads by being there, or by not being there, for roads.

    The first are opaque pixels of one dark colour: black roads on transparent ground; or pixels of one value, or of one
    for each road, that look like roads where all others are nodata. The second are nodata, masked or
    transparent pixels that look like roads on ground of one value, or in a soft map with values below theirs. (n, B)
    values of a sample were observed, or not.
    """
    share = len(observed) / (len(observed) + len(hidden))
    if raster.has_alpha and 0 < share <= _MAX_ROAD_SHARE and not observed.any():
        return replace(_where(raster, True), bands=raster.bands[:1])
    middle, valid = _middle(raster)
    shown = ~_finite(middle, valid)
    is_one = len(observed) > 0 and ((observed == observed[0]).all() or are_patches(middle[..., 0], ~shown))
    if 0 < share <= _MAX_ROAD_SHARE and is_one and are_roads(~shown):
        _LOG.warning("%s: all that is observed looks like roads: it is taken for them", raster.name)
        return replace(_where(raster, True), bands=raster.bands[:1])
    edges = [shown[0], shown[-1], shown[:, 0], shown[:, -1]]
    if not 1 - _MAX_ROAD_SHARE <= share < 1 or max(edge.mean() for edge in edges) > 0.5 or not are_roads(shown):
        return raster
    if (observed == observed[0]).all():
        _LOG.warning("%s: its roads are nodata, masked or transparent: they are taken for roads", raster.name)
        return replace(_where(raster, False), bands=raster.bands[:1])
    is_lightest = observed.dtype.kind != "f" and (hidden == hidden[0]).all() and hidden.min() > observed.max()
    if not is_lightest or len(np.unique(observed)) <= 2:
        return raster
    _LOG.warning("%s: its lightest pixels are nodata: they are taken for roads, too", raster.name)
    return _changed(raster, lambda values, _: (values, None))


def _changed(raster: Bands, change: Callable[[AnyArray, BoolArray | None], _Rows]) -> Bands:
    """Return a raster whose rows are changed as they are read."""
    return replace(raster, read=lambda *rows: change(*raster.read(*rows)))


def _where(raster: Bands, observed: bool) -> Bands:
    """Take the pixels of a raster that were observed for roads, or those that were not."""
    return _changed(raster, lambda *read: ((_finite(*read) == observed).view(np.uint8)[..., None], None))


def _of_class(raster: Bands, number: int) -> Bands:
    """Take the pixels of one class for roads.

    Raises
    ------
    MaskError
        There are none of them, or several bands.
    """
    if len(raster.bands) > 1:
        raise MaskError(f"{raster.name}: has several bands; choose the one that holds the classes: {raster.options}")
    classes = np.unique(_sample(raster)[0])
    if number not in classes:
        held = listed([f"{value:g}" for value in classes])
        raise MaskError(f"{raster.name}: holds no value {number}, but {held}; give the one that is road with --class")
    return _changed(raster, lambda values, valid: ((values == number).view(np.uint8), _finite(values, valid)))


def _without_fill(raster: Bands, observed: AnyArray) -> Bands:
    """Leave out pixels of a value that lies far from all others, and does not look like roads: nodata by no name.

    (n, B) values of a sample were observed.
    """
    for end in () if len(observed) == 0 else (observed.min(), observed.max()):
        is_fill = (observed == end).all(axis=1)
        others = np.unique(observed[~is_fill])
        if not is_fill.any() or len(others) < _MANY_VALUES:
            continue
        least, greatest = float(others[0]), float(others[-1])
        if max(least - float(end), float(end) - greatest) > greatest - least and not are_roads(
            (_middle(raster)[0] == end).all(axis=2)
        ):
            _LOG.warning("%s: its value %g, far from all others, is taken for not observed", raster.name, end)
            return _changed(raster, partial(_all_but, end))
    return raster


def _of_two_colours(raster: Bands, observed: AnyArray) -> Bands:
    """Take how much of the lighter of two colours each pixel has, where all are mixtures, as smooth edges and JPEG are.

    (n, B) values of a sample were observed.
    """
    if observed.shape[1] != 3 or observed.dtype.kind not in "iu" or not _coloured(observed):
        return raster
    parts, axes = np.linalg.eigh(np.cov(observed.T.astype(np.float64)))
    axis = axes[:, -1] * (1.0 if axes[:, -1].sum() >= 0.0 else -1.0)
    low, high = np.quantile(observed @ axis, [_END, 1.0 - _END])
    if high <= low or parts[-1] < _ON_A_LINE * parts.sum():
        return raster

    def share(values: AnyArray) -> AnyArray:
        shares: AnyArray = np.clip((values @ axis - low) / (high - low), 0.0, 1.0)
        return np.rint(255.0 * shares).astype(np.uint8)

    sampled = share(observed)
    dark, light = np.mean(sampled < _PURE), np.mean(sampled > 255 - _PURE)
    rows, _ = _middle(raster)
    flat = np.mean((rows[:, 1:] == rows[:, :-1]).all(axis=2))
    if 1.0 - dark - light > _MOST_MIXED * min(dark, light) or flat < _FLAT:
        return raster
    return replace(_changed(raster, lambda values, valid: (share(values)[..., None], valid)), bands=raster.bands[:1])


def _of_colours(raster: Bands) -> Bands:
    """Take all but the ground, which is black or white, for road where each road has a colour of its own."""
    values, valid = _middle(raster)
    if values.dtype.kind not in "iu" or not _coloured(values):
        return raster
    for ground in (0, np.iinfo(values.dtype).max):
        shown = (values != ground).any(axis=2) & _finite(values, valid)
        if _coloured(values[shown]) and are_roads(shown) and are_patches(_packed(values), shown):
            _LOG.warning("%s: holds a colour for each of its roads: all but its ground is road", raster.name)
            drawn = _changed(raster, partial(_unlike, ground))
            return replace(drawn, bands=raster.bands[:1])
    return raster


def _coloured(values: AnyArray) -> bool:
    """Whether any of (..., B) values are other than grey."""
    return any(bool((values[..., band] != values[..., 0]).any()) for band in range(1, values.shape[-1]))


def _packed(values: AnyArray) -> AnyArray:
    """Return one number for each colour (..., B)."""
    packed: AnyArray = values @ np.array([1, 1 << 20, 1 << 40][: values.shape[-1]])
    return packed


def _unlike(ground: int, values: AnyArray, valid: BoolArray | None) -> _Rows:
    return (values != ground).any(axis=2, keepdims=True).view(np.uint8), valid


def _all_but(fill: float, values: AnyArray, valid: BoolArray | None) -> _Rows:
    not_fill = (values != fill).any(axis=2)
    return values, not_fill if valid is None else not_fill & valid


def _without_unlabelled(raster: Bands, sample: Sample) -> tuple[Bands, Sample]:
    """Leave out pixels without a label in a map of labels, and report how its values were read."""
    unlabelled, reason = find_unlabelled(sample)
    if reason:
        _LOG.warning("%s: %s; another --threshold tells them apart otherwise", raster.name, reason)
    if unlabelled is None:
        return raster, sample

    def leave_out(values: AnyArray, valid: BoolArray | None) -> _Rows:
        labelled = values[..., sample.channel] != unlabelled
        return values, labelled if valid is None else labelled & valid

    labelled = _changed(raster, leave_out)
    rest = sample.observed[sample.observed[:, sample.channel] != unlabelled]
    return labelled, replace(sample, observed=rest, read_rows=lambda: _numbers(*_middle(labelled), sample.channel))


def _sample(raster: Bands) -> tuple[AnyArray, AnyArray]:
    """Return (n, B) values from all over a raster, those observed and the others."""
    step = math.ceil(math.sqrt(raster.shape[0] * raster.shape[1] / _SAMPLE_PIXELS))
    parts = [raster.read(strip.start, strip.stop, step) for strip in _strips(raster, step)]
    finite = np.concatenate([_finite(*part) for part in parts])
    values = np.concatenate([values for values, _ in parts])
    return values[finite], values[~finite]


def _middle(raster: Bands) -> tuple[AnyArray, BoolArray | None]:
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


def _separate(raster: Bands, channel: int, threshold: float) -> tuple[BoolArray, BoolArray | None]:
    """Return where values of a band lie above the threshold, and where they are valid."""
    roads, limit = np.zeros(raster.shape, np.bool_), float(threshold)
    observed = None
    for strip in _strips(raster, 1):
        values, valid = raster.read(strip.start, strip.stop, 1)
        np.greater(values[..., channel], limit if values.dtype.kind == "f" else math.floor(limit), out=roads[strip])
        finite = _finite(values, valid)
        if not finite.all():
            observed = np.ones(raster.shape, np.bool_) if observed is None else observed
            observed[strip] = finite
            roads[strip] &= finite
    if not roads.any():
        raise MaskError(
            f"{raster.name}: shows no road: no value above {threshold:g}, the largest of a sample is "
            f"{_sample(raster)[0][:, channel].max():g}; expected roads as light pixels (or give a lower threshold)"
        )
    return roads, observed


def _between(raster: Bands, channel: int, ground: float, road: float) -> AnyArray:
    """Return where values of a band lie between ground and road, as `RoadMask.probability`."""
    shares = np.full(raster.shape, PROBABILITY_UNKNOWN, np.uint8)
    for strip in _strips(raster, 1):
        values, valid = raster.read(strip.start, strip.stop, 1)
        finite = _finite(values, valid)
        share = np.clip((values[..., channel][finite].astype(np.float32) - ground) / (road - ground), 0.0, 1.0)
        shares[strip][finite] = np.rint(PROBABILITY_SURE * share)
    return shares


def _strips(raster: Bands, step: int) -> Iterator[slice]:
    """Cut the rows into strips that are read at a time, each of a multiple of `step` rows."""
    height, width = raster.shape
    rows = step * max(1, _STRIP_PIXELS // (width * len(raster.bands) * step))
    for top in range(0, height, rows):
        yield slice(top, min(top + rows, height))


def _finite(values: AnyArray, valid: BoolArray | None) -> BoolArray:
    """Return (rows, columns) where values are valid numbers."""
    finite = np.ones(values.shape[:2], np.bool_) if valid is None else valid
    if values.dtype.kind != "f":
        return finite
    limit = values.dtype.type(min(_MAX_VALUE, float(np.finfo(values.dtype).max)))
    return np.asarray(finite & (np.abs(values) <= limit).all(axis=2), np.bool_)


def _corrected(name: str, roads: BoolArray, observed: BoolArray | None) -> tuple[BoolArray, BoolArray | None]:
    """Put right what nodata, transparency and inverted masks mix up; refuse a mask that is all road."""
    n_roads = int(np.count_nonzero(roads))
    n_observed = roads.size if observed is None else int(np.count_nonzero(observed))
    if n_roads <= 0.5 * n_observed:
        return roads, observed
    if n_roads <= _MAX_ROAD_SHARE * roads.size:
        return roads, None  # nodata, or transparent pixels, are the ground between the roads
    inverted = ~roads if observed is None else observed & ~roads
    if not inverted.any():
        raise MaskError(f"{name}: every pixel is light; expected roads as light pixels on dark ground")
    _LOG.warning("%s: dark roads on light ground: read as inverted", name)
    return inverted, observed


def _without_border(
    name: str, roads: BoolArray, observed: BoolArray | None, road_width_px: float
) -> tuple[BoolArray, BoolArray | None]:
    """Leave out what a scan shows around its map."""
    on_map = find_border(roads, road_width_px)
    if on_map is None or not (roads & on_map).any():
        return roads, observed
    _LOG.warning("%s: what lies beyond the border of the map is left out", name)
    return roads & on_map, on_map if observed is None else observed & on_map


def _require_size(name: str, height: int, width: int, most: int) -> None:
    """Refuse by its header what is too small to show roads, or too large to decode."""
    low, high = min(height, width), max(height, width)
    if low < MIN_SIDE or high > most:
        raise MaskError(
            f"{name}: {width} x {height} pixels; expected {MIN_SIDE} to {MAX_SIDE} on each side: "
            + ("give a larger mask" if low < MIN_SIDE else "reduce it or cut it up")
        )


def _require_mask(raster: Bands) -> None:
    """Refuse what has more pixels or bands than a mask, as a photograph if its middle rows look like one."""
    if max(raster.shape) <= MAX_SIDE and raster.n_unread == 0:
        return
    values, valid = _middle(raster)
    observed = values[_finite(values, valid)]
    many = f"{raster.name}: has {len(raster.all_bands)} bands; choose the one that holds the roads"
    try:
        if len(observed):
            channel = int(np.argmax(observed.std(axis=0)))
            find_thresholds(Sample(raster.name, observed, channel, lambda: _numbers(values, valid, channel)))
    except PhotographError as error:
        if raster.n_unread:
            raise PhotographError(f"{many}, if it is a mask: the first of them look like a photograph") from error
        raise
    except MaskError:
        pass  # the error below comes first
    _require_size(raster.name, *raster.shape, MAX_SIDE)
    raise MaskError(f"{many}: {raster.options}")
