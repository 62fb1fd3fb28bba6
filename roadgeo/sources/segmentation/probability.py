"""The probability of road at every pixel of a photograph: given by a segmenter, kept, and made into masks."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from roadgeo._arrays import AnyArray
from roadgeo.errors import MaskError
from roadgeo.geometry.mask import PROBABILITY_SURE, PROBABILITY_UNKNOWN, RoadMask
from roadgeo.sources.bands import PROBABILITY_TAG, THRESHOLD_TAG
from roadgeo.storage.files import replacing
from roadgeo.storage.orientation import UPRIGHT, read_orientation, stored_from_upright

__all__ = ["NODATA", "ProbabilityMap", "mean_of"]

#: 0 to 254 stand for probabilities 0 to 1; this for ground that was not observed.
NODATA = PROBABILITY_UNKNOWN

_STRIP_PIXELS = 1 << 22  # averaged at a time


@dataclass(frozen=True)
class ProbabilityMap:
    """Probability of road. Dimensions: H rows, W columns.

    Attributes
    ----------
    values : (H, W) uint8
        254 times the probability; `NODATA` where nothing is known.
    threshold : float
        Probabilities above it are road, by the model's own word.
    name : str
        Size of the photograph.
    model : str
        Its maker.
    pixel : float
        Pixels of the photograph for each of these, along a side.
    """

    values: AnyArray
    threshold: float = 0.5
    name: str = ""
    model: str = ""
    pixel: float = 1.0

    def mask(self, threshold: float) -> RoadMask:
        """Return where the probability exceeds a threshold.

        Raises
        ------
        MaskError
            Nowhere.
        """
        observed = self.values != NODATA
        roads = (self.values > round(PROBABILITY_SURE * threshold)) & observed
        if not roads.any():
            raise MaskError(f"{self.name}: no road is seen with a probability above {threshold:g}")
        return RoadMask(roads, None if observed.all() else observed, self.name, self.values)

    def resized(self, shape: tuple[int, int]) -> ProbabilityMap:
        """Return the same on another grid of (H, W) pixels over the same frame."""
        if shape == self.values.shape:
            return self
        size, observed = shape[::-1], self.values != NODATA
        smaller = shape[0] < self.values.shape[0]
        way = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
        known = np.where(observed, self.values, 0).astype(np.uint8)
        values = np.minimum(cv2.resize(known, size, interpolation=way), PROBABILITY_SURE)
        if not observed.all():
            kept = cv2.resize(observed.view(np.uint8), size, interpolation=cv2.INTER_NEAREST)
            values = np.where(kept > 0, values, NODATA).astype(np.uint8)
        return replace(self, values=values, pixel=self.pixel * self.values.shape[1] / shape[1])

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write a GeoTIFF on the photograph's pixel grid, with nodata where nothing was observed.

        It lies on the photograph when both are opened in QGIS, which puts the pixels of that below the x axis, as they
        are stored: also on a coarser grid, and where the photograph is to be turned.

        Raises
        ------
        OutputError
            It cannot be written.
        """
        import warnings

        import rasterio
        from rasterio.errors import NotGeoreferencedWarning

        from roadgeo.storage.rasters import writing_raster

        height, width = self.values.shape
        packed = {"compress": "deflate", "predictor": 2, "zlevel": 1}  # a third of the time, and smaller than without
        profile = {"driver": "GTiff", "count": 1, "dtype": "uint8", "nodata": NODATA, **packed}
        orientation = read_orientation(self.name)
        if abs(self.pixel * width - width) > 0.5 or orientation != UPRIGHT:
            stored = stored_from_upright(orientation, (round(self.pixel * width), round(self.pixel * height)))
            lies = np.diag([1.0, -1.0, 1.0]) @ stored @ np.diag([self.pixel, self.pixel, 1.0])
            profile["transform"] = rasterio.Affine(*lies[:2].ravel())
        tags = {
            PROBABILITY_TAG: "probability of road, 0 to 254",
            "MODEL": self.model,
            THRESHOLD_TAG: f"{self.threshold:g}",
        }
        with replacing(Path(path), sync=False) as staged, warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with (
                writing_raster(path),
                rasterio.open(staged, "w", height=height, width=width, tiled=True, **profile) as dataset,
            ):
                dataset.update_tags(**tags)
                dataset.write(self.values, 1)


def mean_of(maps: Sequence[ProbabilityMap]) -> ProbabilityMap:
    """Return the mean of the log odds that a model gave in several ways, (H, W) of the first.

    At each pixel those count that observed it.
    """
    first = maps[0]
    height, width = first.values.shape
    values = [item.resized((height, width)).values for item in maps]
    share = (np.arange(256, dtype=np.float32).clip(0, PROBABILITY_SURE) + 0.5) / 255
    log_odds: AnyArray = np.log(share / (1 - share)).astype(np.float32)
    mean = np.empty((height, width), np.uint8)
    step = max(1, _STRIP_PIXELS // width)
    for rows in (slice(top, top + step) for top in range(0, height, step)):
        seen = np.array([value[rows] for value in values])
        count = (seen != NODATA).sum(axis=0, dtype=np.float32)
        odds = np.where(seen != NODATA, log_odds[seen], 0).sum(axis=0) / np.maximum(count, 1)
        mean[rows] = np.where(count > 0, np.rint(PROBABILITY_SURE * (1.0 / (1.0 + np.exp(-odds)))), NODATA)
    return replace(first, values=mean)
