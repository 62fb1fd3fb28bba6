"""The bands of values of a file or an array as they are stored, and the ones among them to look at for roads."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from roadgeo._arrays import AnyArray, BoolArray
from roadgeo._text import listed
from roadgeo.errors import MaskError
from roadgeo.roads.thresholds import are_labels, are_patches, are_roads
from roadgeo.storage.rasters import open_array, open_raster, page_of, read_palette, sidecar_nodata, value_bands

if TYPE_CHECKING:
    from rasterio import DatasetReader

__all__ = ["PROBABILITY_TAG", "THRESHOLD_TAG", "Bands", "Choice", "open_bands"]

#: Tags that mark our own maps of probability among masks that users made, and the threshold of their model.
PROBABILITY_TAG, THRESHOLD_TAG = "ROADGEO", "THRESHOLD"

_MAX_CLASSES = 32  # whose colours a palette holds
_MAX_BANDS = 3  # of a mask, unless one of them is chosen
_MIDDLE_PIXELS = 1 << 22  # by which alpha is judged

#: Words for roads in names of bands, and words for properties of roads, or for all else.
_ROADS = re.compile(r"\b(?:road|street|highway|stra(?:ss|ß)e|route|estrada|carreter|calle|strad[ae])[^\W\d]*", re.I)
_OTHERS = re.compile(r"\b(?:no|non|not|off|age|background|distance|count|uncertain\w*|std|var\w*|entropy)\b", re.I)


@dataclass(frozen=True)
class Choice:
    """The bands and values that are to be read of a raster.

    Attributes
    ----------
    band : int or None
        Counted from 1. Default: the band whose name is a word for roads, or else the first three.
    road_class : int or None
        The value that stands for road in a map of classes.
    names : tuple of str
        Names of an array's bands.
    """

    band: int | None = None
    road_class: int | None = None
    names: tuple[str, ...] = ()


@dataclass(frozen=True)
class Bands:
    """A raster's values, not necessarily in memory. Dimensions: H rows, W columns, B bands (alpha left out).

    Attributes
    ----------
    read : callable
        `read(top, bottom, step)` returns every `step`-th value of these rows as (rows, columns, B), and where they are
        valid as (rows, columns) bool, or None for everywhere.
    bands : (B,) tuple of str
        Number and name of each band that is read, for people: "2 (road)".
    all_bands : tuple of str
        The same of all bands.
    page : str
        Page of a file with several, for people.
    has_alpha : bool
        Values are valid where they are not transparent.
    model_threshold : float or None
        Threshold of a map of probability that we wrote.
    option : str
        The option that chooses a band, before its number; "" of an array, of which one is given.
    is_lossy : bool
        Values are about those that were saved, as of JPEG.
    """

    name: str
    shape: tuple[int, int]
    read: Callable[[int, int, int], tuple[AnyArray, BoolArray | None]]
    bands: tuple[str, ...]
    all_bands: tuple[str, ...] = ()
    has_alpha: bool = False
    is_chosen: bool = False
    page: str = ""
    model_threshold: float | None = None
    option: str = "--band "
    is_lossy: bool = False

    @property
    def n_unread(self) -> int:
        """Bands beyond those that are read, where none was chosen."""
        return 0 if self.is_chosen else max(len(self.all_bands) - len(self.bands), 0)

    @property
    def options(self) -> str:
        """How a band is chosen, for people."""
        return f"{self.option}{listed(self.all_bands)}"


@contextmanager
def open_bands(source: str | os.PathLike[str] | AnyArray, choice: Choice, name: str | None) -> Iterator[Bands]:
    """Open a file or an array (H, W) or (H, W, bands).

    Raises
    ------
    MaskError
        It cannot be read, holds no numbers, or lacks the band.
    """
    if not isinstance(source, str | os.PathLike):
        name = name or "array"
        with open_array(np.ma.asanyarray(source), name, choice.names) as dataset:
            yield replace(_of_dataset(dataset, choice, name, None, ""), option="")
        return
    with open_raster(source, name) as dataset:
        yield _of_dataset(dataset, choice, name or os.fspath(source), sidecar_nodata(source), page_of(source))


def _of_dataset(dataset: DatasetReader, choice: Choice, name: str, nodata: float | None, page: str) -> Bands:
    """Wrap an open GDAL dataset; `nodata` is the value of a side file."""
    from rasterio.enums import MaskFlags
    from rasterio.windows import Window

    colour = value_bands(dataset)
    if not colour:
        raise MaskError(f"{name}: holds no band of values; give an image or GeoTIFF")
    meanings = [dataset.colorinterp[i - 1].name for i in colour]
    is_coloured = {"red", "green", "blue"} <= {*meanings}
    labels = _labels(
        [dataset.descriptions[i - 1] or (meanings[n] if is_coloured else "") for n, i in enumerate(colour)]
    )
    picked, is_chosen = _choose(name, choice, labels)
    chosen = [colour[i] for i in picked]
    kinds = {str(dataset.dtypes[i - 1]) for i in chosen}
    if not all(kind.startswith(("bool", "int", "uint", "float")) for kind in kinds):
        raise MaskError(f"{name}: holds values of type {', '.join(sorted(kinds))}; expected real numbers")
    palette = _palette(dataset, colour[0]) if len(colour) == 1 and choice.road_class is None else None
    flags = list(dataset.mask_flag_enums)[chosen[0] - 1]
    all_valid = MaskFlags.all_valid in flags
    least = _half_opaque(dataset, chosen[0]) if MaskFlags.alpha in flags else 0

    def read(top: int, bottom: int, step: int) -> tuple[AnyArray, BoolArray | None]:
        window = Window(0, top, dataset.width, bottom - top)
        # Every step-th value of all, for to read fewer GDAL would go to overviews: blurred, or of another file.
        values = np.moveaxis(dataset.read(chosen, window=window)[:, ::step, ::step], 0, 2)
        valid = None if all_valid else dataset.read_masks(chosen[0], window=window)[::step, ::step] > least
        if nodata is not None and dataset.nodata is None:
            given = (values != nodata).all(axis=2)
            valid = given if valid is None else valid & given
        if palette is None:
            return values, valid
        shown = palette[values[..., 0]]
        return shown[..., :3], shown[..., 3] > 0 if valid is None else valid & (shown[..., 3] > 0)

    has_alpha = len(colour) < dataset.count or (palette is not None and not palette[:, 3].all())
    bands = tuple(labels[i] for i in picked) if palette is None else ("red", "green", "blue")
    size, own, kept = (dataset.height, dataset.width), _model_threshold(dataset), dataset.tags(ns="IMAGE_STRUCTURE")
    is_lossy = "JPEG_QUALITY" in kept or kept.get("COMPRESSION_REVERSIBILITY") == "LOSSY"
    return Bands(name, size, read, bands, labels, has_alpha, is_chosen, page, own, is_lossy=is_lossy)


def _half_opaque(dataset: DatasetReader, band: int) -> int:
    """Return half of the greatest alpha in the middle rows: where less shows, edges were smoothed."""
    from rasterio.windows import Window

    rows = min(dataset.height, max(_MIDDLE_PIXELS // dataset.width, 1))
    window = Window(0, (dataset.height - rows) // 2, dataset.width, rows)
    return int(dataset.read_masks(band, window=window).max()) // 2


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
    palette = read_palette(dataset, band, 4) if dataset.dtypes[band - 1] == "uint8" else None
    if palette is None:
        return None
    values = dataset.read(band)
    used = np.unique(values)
    shown = palette[used, :3]
    if (shown == shown[:, :1]).all() and not are_labels(used):  # greys
        return palette
    are_instances = are_patches(values, values > 0) and are_roads(values > 0)  # each of a colour
    return palette if len(used) > _MAX_CLASSES and not are_labels(used) and not are_instances else None


def _labels(names: Sequence[str]) -> tuple[str, ...]:
    """Return number and name of each band."""
    return tuple(f"{n} ({name.strip()})" if name and name.strip() else f"{n}" for n, name in enumerate(names, 1))


def _choose(name: str, choice: Choice, labels: Sequence[str]) -> tuple[list[int], bool]:
    """Return the numbers from 0 of the bands to look at, and whether one was chosen: by the user, or by its name."""
    if choice.band is not None:
        if not 1 <= choice.band <= len(labels):
            raise MaskError(f"{name}: has no band {choice.band}; expected 1 to {len(labels)}")
        return [choice.band - 1], True
    texts = [label.replace("_", " ") for label in labels]
    alone = [
        i for i, text in enumerate(texts) if re.fullmatch(r"[\W\d]*", _ROADS.sub("", text)) and _ROADS.search(text)
    ]
    among = [i for i, text in enumerate(texts) if _ROADS.search(text) and not _OTHERS.search(text)]
    named = next((indices for indices in (alone, among) if len(indices) == 1), None)
    return named or list(range(min(len(labels), _MAX_BANDS))), named is not None
