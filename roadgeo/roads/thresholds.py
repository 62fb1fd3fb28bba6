"""Interpretation of a raster's values: a mask, probabilities, classes or a photograph; and the thresholds to try.

Values are judged from a sample of pixels spread over the raster and, where neighbours matter, from rows of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, BoolArray
from roadgeo._text import log_of
from roadgeo.errors import MaskError, PhotographError
from roadgeo.geometry.mask import RoadMask
from roadgeo.roads.vectorization import width_by_area

__all__ = [
    *("Sample", "are_labels", "are_patches", "are_roads", "find_numbered", "find_thresholds", "find_unlabelled"),
    "ground_and_road",
    *("refuse_different_bands", "spread_probability"),
]

_LOG = log_of(__name__)

_COLOURED_SHARE = 0.05  # more than this: a photograph
_GREY_SHARE = 0.25  # more than this is neither dark nor light: a soft map on uneven ground
_CRISP_SHARE = 0.02  # less than this: a mask
_MIN_CORRELATION = 0.3  # between the bands of a photograph
_FAINT = 0.05  # bands whose values span less than this, of the widest span, show nothing; and so do such changes
_FAR, _MOST_APART = 0.25, 0.1  # shares of the span between bands that differ in a pixel; and of the roads, such pixels
_MAX_CLASS = 32  # whole numbers up to this, three or more of them, are the classes of a map, unless they are faint

#: Values that are not crisp show roads only where (measured on soft maps and on the photographs of the Massachusetts
#: Roads Dataset in grey, plain and blurred) little of the frame is light, the dark ground is even, and the light area
#: falls into few pieces of one width. In an inverted map dark and light change places.
_MAX_LIGHT = 0.35  # share of the frame
_MAX_SPREAD = 0.22  # standard deviation of the ground, of the difference between light and dark
_MAX_PIECES = 0.3  # pieces times their squared width, of the light area
_MAX_DEPTH = 2.3  # ninth decile of the depth of light pixels, of its mean: 1.8 in a stripe

#: Neighbours in a faint map differ by one level, in a map of classes by any number of them.
_MIN_STEPS_OF_ONE, _MIN_LEVELS_FILLED = 0.8, 0.7
#: Shares of neighbours of one number in a mask of numbered roads: of all, and without the commonest number.
#: Smooth edges of a plain mask are a pixel wide: they have at most two neighbours in three of their value.
_ALIKE, _OTHERS_ALIKE = 0.9, 0.8
#: The same saved as JPEG: its traces around roads are fainter than the first number; edges are as steep as before,
#: of the greatest value nearby (0.99 at least, in a model's maps 0.96 at most); and the greatest values nearby differ,
#: by their standard deviation, of the mean (0.27 at least, 0.06 at most in plain masks).
_RINGING, _NEARBY_PX, _STEEP, _VARIED = 20, 7, 0.98, 0.25
_GREY = 6  # bands of a grey picture differ by this at most, rounded by JPEG or WebP
#: Share of neighbours that differ in a photograph, and their usual difference, of the span.
_RESTLESS, _SMOOTH = 0.3, 0.15
_MANY_LEVELS = 8  # more classes than this do not look like roads

_BINS = 256  # of a histogram that a threshold is found by

#: Further thresholds of a soft map, as shares of the way from the ground's value to the roads'.
_FURTHER = (0.3, 0.7)
#: A further threshold of probabilities, as a share of the model's own: roads count by their probability. On labelled
#: photographs of Boston and Miami, given scale and heading, 8 of 12 are located at it, 7 at the model's own.
_LOWER = 0.27


@dataclass(frozen=True)
class Sample:
    """Values of a raster. Dimensions: n pixels, B bands.

    Attributes
    ----------
    name : str
        Name of the raster, for messages.
    observed : (n, B)
        Observed pixels spread over the raster.
    channel : int
        The band to go by.
    read_rows : callable
        Returns (rows, columns) neighbouring values of that band, from the middle of the raster.
    options : str
        How a band is chosen, for people.
    """

    name: str
    observed: AnyArray
    channel: int
    read_rows: Callable[[], AnyArray]
    options: str = "--band N"

    @cached_property
    def levels(self) -> AnyArray:
        """The different values of that band, ascending."""
        values = self.observed[:, self.channel]
        ends = np.unique([values.min(), values.max()])
        is_mask = ((values == ends[0]) | (values == ends[-1])).all()
        return ends if is_mask else np.unique(values)


def find_thresholds(sample: Sample) -> tuple[float, ...]:
    """Find the thresholds above which values may be road: one for a mask, several for a soft map, the best first.

    Raises
    ------
    PhotographError
        It is a photograph.
    MaskError
        It is a map of several classes.
    """
    values, levels = sample.observed[:, sample.channel].astype(np.float64), sample.levels.astype(np.float64)
    low, high = levels[0], levels[-1]
    if len(levels) <= 2:
        return (float(low + high) / 2 if high > low else float(np.nextafter(high, -np.inf) if high > 0 else high),)
    if np.any(np.diff(np.linspace(low, high, _BINS + 1)) <= 0):
        raise MaskError(
            f"{sample.name}: {len(levels)} values from {low:g} to {high:g}, too alike to part; give a threshold"
        )
    if sample.observed.dtype.kind in "iu" and high <= _MAX_CLASS and not _is_dark_photograph(sample, levels):
        _refuse_classes(sample, levels)
        _LOG.warning(
            "%s: values to %g are read as a faint soft map; numbers of roads, blurred by compression, would look so, "
            "too: save them without loss",
            *(sample.name, high),
        )
        return _spread(values, _otsu(values))
    _refuse_colours(sample, levels)
    if sample.observed.dtype.kind == "f" and low >= 0 and high <= 1:
        _refuse_reflectances(sample, values)
        return _spread(values, 0.5 if high > 0.5 else _otsu(values))  # probabilities
    grey = _grey_share(sample, values)
    usual = 127.0 if sample.observed.dtype == np.uint8 and high > 127 and grey <= _GREY_SHARE else _otsu(values)
    return (usual,) if grey <= _CRISP_SHARE else _spread(values, usual)


def spread_probability(threshold: float) -> tuple[float, ...]:
    """Return the thresholds worth trying on probabilities of road: a model's own first."""
    return threshold, _LOWER * threshold


def find_unlabelled(sample: Sample) -> tuple[float | None, str]:
    """Find the value of pixels that have no label in a map of labels, and describe how its values were read.

    Maps for training have 0 for the ground, 1 for road and a third value for ignored pixels: 255 in PASCAL VOC
    and mmsegmentation, -1, or the largest of a type. In other rasters such a third value is the road, and the 1 noise.

    Returns
    -------
    value : float or None
        None where there is no such value.
    told : str
        "" where there is nothing to report.
    """
    values, levels = sample.observed[:, sample.channel], sample.levels
    others = levels[(levels < 0) | (levels > _MAX_CLASS)]
    classes = levels[(levels >= 0) & (levels <= _MAX_CLASS)]
    if len(others) != 1 or len(classes) < 2 or len(levels) < 3 or np.any(levels != np.round(levels)):
        return None, ""
    other, are_two = float(others[0]), classes.tolist() == [0, 1]
    rows = sample.read_rows()
    onesare_roads, others_are = (are_roads(rows == value) for value in (1, other))
    listed = ", ".join(f"{level:g}" for level in (*classes, other))
    if other > 0 and others_are and not (are_two and onesare_roads):
        return None, f"holds the values {listed}: {other:g} is taken for road"
    if are_two:
        return other, f"holds the values {listed}: 1 is taken for road, {other:g} for not observed"
    if other > 0 and sample.observed.dtype.kind in "iu" and not are_roads(rows != other):
        _refuse_classes(replace(sample, observed=sample.observed[values != other]), classes)
    return None, ""


def are_labels(values: AnyArray) -> bool:
    """Whether whole numbers are the labels that `find_unlabelled` knows: 0, 1 and another."""
    levels = np.unique(values)
    return len(levels) == 3 and levels[:2].tolist() == [0, 1] and bool(levels[2] > _MAX_CLASS)


def find_numbered(sample: Sample) -> float | None:
    """Return the threshold of a mask whose roads have numbers, such as instances, lanes, speeds or years; else None.

    Its ground is the least value, of none above 0, or the greatest.
    """
    levels = sample.levels
    if len(levels) < 3 or are_labels(levels) or np.ptp(sample.observed, axis=1).max() > _GREY:
        return None
    rows, (low, high) = sample.read_rows(), (levels[:2], levels[-2:])
    pairs = ((low[0], low), (high[1], high))[int(low[0] > 0) :]
    grounds = ((rows != ground, float(np.mean(pair))) for ground, pair in pairs)
    return next(
        (middle for shown, middle in grounds if are_patches(rows, shown) and are_roads(shown)), _find_blurred(rows)
    )


def _find_blurred(rows: AnyArray) -> float | None:
    """Return the threshold of numbers of roads in (rows, columns) that JPEG has blurred; else None."""
    if rows.dtype != np.uint8:
        return None
    is_dark = np.median(rows) < 128
    above = rows if is_dark else ~rows
    shown = cv2.medianBlur(above, 3) > _RINGING
    if np.median(above) > 0 or not are_roads(shown):
        return None
    near, nearby = (np.ones((side, side), np.uint8) for side in (3, _NEARBY_PX))
    edges, greatest = cv2.morphologyEx(above, cv2.MORPH_GRADIENT, near), cv2.dilate(above, nearby)[shown]
    is_steep = np.median(cv2.dilate(edges, nearby)[shown] / greatest) > _STEEP
    is_varied = greatest.std() > _VARIED * greatest.mean()
    return float(_RINGING if is_dark else 255 - _RINGING) if is_steep and is_varied else None


def are_patches(values: AnyArray, shown: BoolArray) -> bool:
    """Whether neighbours among the (rows, columns) shown mostly have one value, of several that are no shares of 1."""
    if not shown.any() or (np.any(values[shown] % 1) and values[shown].max() <= 1):
        return False
    levels, counts = np.unique(values[shown], return_counts=True)
    common = values == levels[np.argmax(counts)]
    pairs = shown[:, 1:] & shown[:, :-1], shown[1:] & shown[:-1]
    equal = np.concatenate([(values[:, 1:] == values[:, :-1])[pairs[0]], (values[1:] == values[:-1])[pairs[1]]])
    both = np.concatenate([(common[:, 1:] & common[:, :-1])[pairs[0]], (common[1:] & common[:-1])[pairs[1]]])
    others = equal[~both]
    return bool(len(equal) and equal.mean() > _ALIKE and (len(others) == 0 or others.mean() > _OTHERS_ALIKE))


def ground_and_road(sample: Sample, threshold: float) -> tuple[float, float]:
    """Return the usual values below and above a threshold that parts them."""
    return _medians(sample.observed[:, sample.channel].astype(np.float64), threshold)


def _medians(values: AnyArray, threshold: float) -> tuple[float, float]:
    above = values > threshold
    return float(np.median(values[~above])), float(np.median(values[above]))


def _spread(values: AnyArray, first: float) -> tuple[float, ...]:
    """Return the first threshold and those between ground and roads that part (n,) values otherwise."""
    above = values > first
    if not above.any() or above.all():
        return (first,)
    ground, road = _medians(values, first)
    chosen = [first]
    inverted = bool(above.mean() > 0.5)  # dark roads on light ground
    areas = [float(np.mean(above != inverted))]
    for share in _FURTHER:
        threshold = ground + share * (road - ground)
        area = float(np.mean((values > threshold) != inverted))
        if area > 0 and all(max(area, other) > 1.15 * min(area, other) for other in areas):
            chosen.append(threshold)
            areas.append(area)
    return tuple(chosen)


def _refuse_classes(sample: Sample, levels: AnyArray) -> None:
    """Raise where small whole numbers are the classes of a map and not a faint map, whose neighbours differ by one."""
    rows = sample.read_rows().astype(np.float64)
    pairs = ((rows[1:], rows[:-1]), (rows[:, 1:], rows[:, :-1]))
    steps = np.concatenate([np.abs(one - other).ravel() for one, other in pairs])
    upper = np.concatenate([np.maximum(one, other).ravel() for one, other in pairs])[steps > 0]
    steps = steps[steps > 0]
    filled = len(levels) / (levels[-1] - levels[0] + 1)
    if filled >= _MIN_LEVELS_FILLED:
        if len(steps) and min(np.mean(steps[upper == level] == 1) for level in np.unique(upper)) >= _MIN_STEPS_OF_ONE:
            return
        if len(levels) >= _MANY_LEVELS and _shows_roads(rows, _otsu(rows.ravel())):
            return
    raise _several_classes(sample, levels)


def _several_classes(sample: Sample, levels: AnyArray) -> MaskError:
    listed = ", ".join(f"{level:g}" for level in levels)
    what = f"{sample.name}: holds the classes {listed}; expected road and no road"
    return MaskError(f"{what}: give the one that is road with --class N, or a threshold")


def _is_dark_photograph(sample: Sample, levels: AnyArray) -> bool:
    """Whether small whole numbers change all over the frame, and by little from pixel to pixel, as no classes do."""
    rows = sample.read_rows().astype(np.float64)
    steps = np.abs(np.diff(rows, axis=1))
    changes = steps[steps > 0]
    is_filled = len(levels) >= _MANY_LEVELS and len(levels) >= _MIN_LEVELS_FILLED * (levels[-1] - levels[0] + 1)
    is_smooth = len(changes) > 0 and np.median(changes) <= max(_SMOOTH * (levels[-1] - levels[0]), 1.0)
    return bool(is_filled and is_smooth and len(changes) > _RESTLESS * steps.size)


def _refuse_colours(sample: Sample, levels: AnyArray) -> None:
    """Raise where values are a handful of colours: a land cover map."""
    colours = sample.observed
    if colours.shape[1] == 1 or np.ptp(colours.astype(np.float64), axis=1).max() <= 0.1 * levels[-1]:
        return
    n_colours = len(np.unique(colours, axis=0)) if len(levels) <= _MAX_CLASS else 0
    if 2 < n_colours <= _MAX_CLASS:
        raise MaskError(
            f"{sample.name}: holds {n_colours} colours; expected road and no road: choose a band or give a mask"
        )


def refuse_different_bands(sample: Sample) -> None:
    """Raise where bands show different things: classes one by one, a mask and its probability or count.

    A photograph is left alone: it has three bands, none of which is crisp, and which do not add up to one value.
    """
    bands = np.ascontiguousarray(sample.observed.T)
    if (bands == bands[0]).all():
        return
    bands = bands.astype(np.float64)
    span = np.ptp(bands, axis=1)
    shown = span > (_FAINT * span.max() if len(bands) > 2 else 0.0)  # colours may have traces of others
    if np.count_nonzero(shown) < 2:
        return
    shares = (bands[shown] - bands[shown].min(axis=1, keepdims=True)) / span[shown, None]
    is_crisp = (np.minimum(shares, 1.0 - shares) < _CRISP_SHARE).mean(axis=1) > 1.0 - _CRISP_SHARE
    if len(shares) > 2 and not is_crisp.any() and bands.sum(axis=0).std() > _FAINT * bands.std(axis=1).sum():
        return
    first = shares[np.argmax(is_crisp)]
    roads = min(np.mean(first > 0.5), np.mean(first <= 0.5))
    apart = [min(np.mean(np.abs(band - like) > _FAR) for like in (first, 1.0 - first)) for band in shares]
    if max(apart) > _MOST_APART * roads:
        if len(bands) == 3 and len(sample.levels) > 2:
            _refuse_colours(sample, sample.levels)
        raise _several_bands(sample)


def _refuse_reflectances(sample: Sample, values: AnyArray) -> None:
    """Raise where numbers from 0 to 1 are no probability of road: a photograph's colours, or several classes'.

    Colours are light and dark together, classes shut each other out.
    """
    bands = sample.observed[:, np.ptp(sample.observed, axis=0) > 0].astype(np.float64)
    if bands.shape[1] < 2 or np.mean(np.ptp(bands, axis=1) > 0.05 * np.ptp(values)) <= _COLOURED_SHARE:
        return
    if np.corrcoef(bands.T).min() > _MIN_CORRELATION:
        _grey_share(sample, values)
    raise _several_bands(sample)


def _several_bands(sample: Sample) -> MaskError:
    what = f"{sample.name}: holds {sample.observed.shape[1]} bands that differ"
    return MaskError(f"{what}; choose the one that holds the roads: {sample.options}")


def _grey_share(sample: Sample, values: AnyArray) -> float:
    """Return the share of (n,) values that are neither dark nor light.

    Raises
    ------
    PhotographError
        They are coloured, or what is light does not look like roads.
    """
    span = np.ptp(values)
    bands = sample.observed.astype(np.float64)
    coloured = np.mean(np.ptp(bands, axis=1) > 0.05 * span) if bands.shape[1] > 1 else 0.0
    counts, edges = np.histogram(values, bins=64)
    dark, light = edges[np.argmax(counts[:32])], edges[32 + np.argmax(counts[32:])]
    off_light = np.abs(values - light) > 0.08 * span
    off = float(np.mean(off_light & (np.abs(values - dark) > 0.08 * span)))
    if coloured <= _COLOURED_SHARE and (
        off <= _CRISP_SHARE or _shows_roads(sample.read_rows().astype(np.float64), _otsu(values))
    ):
        return off
    rows = sample.read_rows()
    if (
        coloured <= _COLOURED_SHARE
        and len(sample.levels) <= _MAX_CLASS
        and are_patches(rows, np.full(rows.shape, True))
    ):
        raise _several_classes(sample, sample.levels)
    raise PhotographError(
        f"{sample.name}: looks like a photograph, {coloured:.0%} of it coloured and {off:.0%} neither dark nor light; "
        "expected a mask of its roads: segment it first (or give a threshold, if it is a mask)"
    )


def _shows_roads(rows: AnyArray, threshold: float) -> bool:
    """Return whether light (rows, columns) look like roads on even ground: see the constants above."""
    light: BoolArray = rows > threshold
    if np.count_nonzero(light) > 0.5 * light.size:
        light, rows = ~light, -rows
    n_light = int(np.count_nonzero(light))
    if not 0 < n_light <= _MAX_LIGHT * light.size:
        return False
    ground, roads = rows[~light], rows[light]
    if ground.std() > _MAX_SPREAD * (roads.mean() - ground.mean()):
        return False
    depth = cv2.distanceTransform(light.view(np.uint8), cv2.DIST_L2, 3)[light]
    if np.quantile(depth, 0.9) > _MAX_DEPTH * depth.mean():
        return False
    n_pieces = cv2.connectedComponents(light.view(np.uint8))[0] - 1
    return bool(n_pieces * width_by_area(RoadMask(light)) ** 2 <= _MAX_PIECES * n_light)


def are_roads(shown: BoolArray) -> bool:
    """Whether some of (rows, columns) look like roads."""
    return bool(0 < shown.mean() <= _MAX_LIGHT) and _shows_roads(shown.astype(np.float64), 0.5)


def _otsu(values: AnyArray) -> float:
    """Return the value that parts two groups best: largest variance between them (Otsu 1979)."""
    counts, edges = np.histogram(values, bins=_BINS)
    centres = (edges[:-1] + edges[1:]) / 2
    below = np.cumsum(counts)[:-1]
    sums = np.cumsum(counts * centres)
    above = len(values) - below
    between = below * above * (sums[:-1] / below - (sums[-1] - sums[:-1]) / np.maximum(above, 1)) ** 2
    return float(edges[1:-1][np.argmax(between)])
