"""Probability maps of a segmenter, which stay beside the results of a photograph."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from roadgeo.errors import MaskError, OutputError

if TYPE_CHECKING:
    from roadgeo.outputs.paths import OutputPaths
    from roadgeo.sources.segmentation.probability import ProbabilityMap

__all__ = ["ENDING", "is_ours", "keep_probability", "probability_path"]

#: The end of their names. Masks of users may end so, too; our own carry a tag.
ENDING = "_mask.tif"


def probability_path(paths: OutputPaths) -> Path:
    """Return where the probability map of a photograph is kept."""
    return paths.folder / f"{paths.stem}{ENDING}"


def is_ours(path: Path) -> bool:
    """Whether a file is a probability map that we wrote, not a mask of the user's."""
    from roadgeo.sources.bands import PROBABILITY_TAG
    from roadgeo.storage.rasters import open_raster

    if not path.is_file():
        return False
    try:
        with open_raster(path) as raster:
            return PROBABILITY_TAG in raster.tags()
    except MaskError:
        return False


def keep_probability(probability: ProbabilityMap | None, paths: OutputPaths) -> list[Path]:
    """Write the probabilities of a segmenter.

    Raises
    ------
    OutputError
        A file of the user's has that name, or it cannot be written.
    """
    if probability is None:
        return []
    path = probability_path(paths)
    if path.exists() and not is_ours(path):
        raise OutputError(f"{path}: exists, and was not written by roadgeo; choose another --out-dir")
    probability.write(path)
    return [path]
