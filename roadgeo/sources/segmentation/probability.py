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

__all__ = ["NODATA", "ProbabilityMap", "fuse"]

#: 0 to 254 stand for probabilities 0 to 1; this for ground that was not observed.
NODATA = PROBABILITY_UNKNOWN

_STRIP_PIXELS = 1 << 22  # fused at a time


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
        seen = self.values != NODATA
        roads = (self.values > round(PROBABILITY_SURE * threshold)) & seen
        if not roads.any():
            raise MaskError(f"{self.name}: no road is seen with a probability above {threshold:g}")
        return RoadMask(roads, None if seen.all() else seen, self.name, self.values)

    def resized(self, shape: tuple[int, int]) -> ProbabilityMap:
        """Return the same on another grid of (H, W) pixels over the same frame."""
        if shape == self.values.shape:
            return self
        size, seen = shape[::-1], self.values != NODATA
        smaller = shape[0] < self.values.shape[0]
        way = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
        values: AnyArray = cv2.resize(np.where(seen, self.values, 0).astype(np.uint8), size, interpolation=way)
        if not seen.all():
            known = cv2.resize(seen.view(np.uint8), size, interpolation=cv2.INTER_NEAREST)
            values = np.where(known > 0, np.minimum(values, PROBABILITY_SURE), NODATA).astype(np.uint8)
        values = np.minimum(values, PROBABILITY_SURE) if seen.all() else values
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


def fuse(maps: Sequence[ProbabilityMap]) -> ProbabilityMap:
    """Fuse looks at one scene: the mean of the log odds of those that saw a pixel; the frame is the first one's.

    Models of one threshold mean the same by a probability, which is kept; of others only the thresholds mean the same.

    Raises
    ------
    MaskError
        They show frames of different proportions.
    """
    first = maps[0]
    alike = all(item.threshold == first.threshold for item in maps)
    height, width = first.values.shape
    for entry in maps:
        rows, columns = entry.values.shape
        if abs(rows * width - columns * height) > 0.01 * rows * width:
            raise MaskError(
                f"{entry.name}: {columns} x {rows} pixels, but {first.name} {width} x {height}; "
                "expected looks at the same frame: cut them alike, or locate them one by one"
            )
    values = [item.resized((height, width)).values for item in maps]
    thresholds = [0.5 if alike else item.threshold for item in maps]
    fused = np.empty((height, width), np.uint8)
    step = max(1, _STRIP_PIXELS // width)
    for top in range(0, height, step):
        fused[top : top + step] = _mean([value[top : top + step] for value in values], thresholds)
    models = dict.fromkeys(item.model for item in maps)
    return ProbabilityMap(fused, first.threshold if alike else 0.5, first.name, " + ".join(models), first.pixel)


def _mean(values: Sequence[AnyArray], thresholds: Sequence[float]) -> AnyArray:
    """Return the mean of the log odds of those (H, W) that observed a pixel, as a probability."""
    total, count = np.zeros(values[0].shape, np.float32), np.zeros(values[0].shape, np.float32)
    for value, threshold in zip(values, thresholds, strict=True):
        seen = value != NODATA
        total += np.where(seen, _log_odds(value, threshold), 0)
        count += seen
    share = 1.0 / (1.0 + np.exp(-total / np.maximum(count, 1)))
    return np.where(count > 0, np.rint(254 * share), NODATA).astype(np.uint8)


def _log_odds(values: AnyArray, threshold: float) -> AnyArray:
    """Return the log odds of each value, 0 at the threshold, for models differ in how sure they are."""
    table = (np.arange(256, dtype=np.float32).clip(0, 254) + 0.5) / 255
    odds = np.log(table / (1 - table)) - np.log(threshold / (1 - threshold))
    found: AnyArray = odds.astype(np.float32)[values]
    return found
