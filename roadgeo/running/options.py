"""How queries are read, and how a batch of them is located and written."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from roadgeo._options import IMAGE, RESULTS, option
from roadgeo.matching.hints import Taken, read_taken

if TYPE_CHECKING:
    from roadgeo.matching.options import LocateOptions
    from roadgeo.outputs.location_files import OutputOptions
    from roadgeo.running.tasks import Task
    from roadgeo.sources.bands import Choice

__all__ = ["SEGMENTING", "BatchOptions", "ReadOptions", "is_model"]

#: How photographs and masks are read, of the options of `ReadOptions`.
SEGMENTING = ("segment", "segmenter", "class_name", "threshold", "band", "bands")


def read_bands(text: str) -> tuple[int, ...]:
    """Read the numbers of a red, a green and a blue band.

    Raises
    ------
    ValueError
        They are none.
    """
    numbers = [int(part) if part.strip().isdecimal() else 0 for part in text.split(",")]
    if len(numbers) != 3 or min(numbers) < 1:
        raise ValueError(f"got {text!r}, expected R,G,B: three numbers from 1")
    return tuple(numbers)


# fmt: off
@dataclass(frozen=True)
class ReadOptions:
    """How an image is read; each option is explained beside it.

    Attributes
    ----------
    names : tuple of str
        Names of the bands of an array.
    threads : int
        Threads of a model; fixed, so that results are the same on every run.
    """

    mirror: bool | None = option("--mirror/--no-mirror", "", IMAGE,
        "The image is mirrored (film scanned from its back), or is not. Default: as its file says.",
        default=None, rare=True)
    aspect: float | None = option("--aspect", "RATIO", IMAGE,
        "How many times a pixel is as wide as high, of scans that are stretched. Default: as the file says, or 1.",
        limits=(0.25, 4.0), rare=True)
    segment: Literal["auto", "always", "never"] = option("--segment", None, IMAGE,
        "Which images are photographs, whose roads are found first: those that look so, all, or none. Default: auto.",
        default="auto", rare=True)
    segmenter: str = option("--segmenter", "NAME|MODEL.onnx", IMAGE,
        "Who finds the roads of photographs: a plugin (`roadgeo --plugins`), or a model as QGIS Deepness or "
        "STAC describe them. Default: the model that ships.",
        plugins="roadgeo.segmenters", ending=".onnx", default="", rare=True)
    class_name: str | None = option("--class", "NAME|N", IMAGE,
        "Class of the model that is road, or its number in a map of classes. Default: by the names.", rare=True)
    threshold: float | None = option("--threshold", "T", IMAGE,
        "Values above T are road; of photographs, probabilities. Default: by the values.", rare=True)
    band: int | None = option("--band", "N", IMAGE,
        "Band that holds the mask. Default: by the bands.", limits=(1, None), rare=True)
    bands: tuple[int, int, int] | None = option("--bands", "R,G,B", IMAGE,
        "Red, green and blue band of photographs: 3,2,1. Default: by their names, or the first three.",
        read=read_bands, rare=True)
    units: Literal["auto", "pixels", "metres"] = option("--units", None, IMAGE,
        "What the coordinates are of roads that come as lines (GeoJSON, GeoPackage ...). auto: told by the CRS.",
        default="auto", show_default=True, rare=True)
    layer: tuple[str, ...] = option("--layer", "NAME", IMAGE,
        "Layer of roads that come as lines. Repeatable.", default=(), rare=True)
    names: tuple[str, ...] = ()
    threads: int = 1
    # fmt: on

    @property
    def choice(self) -> Choice:
        """The bands and values that are read of a raster that may be a mask."""
        from roadgeo.sources.bands import Choice

        is_number = self.class_name is not None and self.class_name.isdecimal()
        return Choice(self.band, int(str(self.class_name)) if is_number else None, self.names)

    @property
    def may_be_mask(self) -> bool:
        """Whether a query may be a mask; plugins are shown all that is given."""
        return self.segment == "never" or (self.segment == "auto" and is_model(self.segmenter))


def is_model(segmenter: str) -> bool:
    """Whether a segmenter is a model, the file of one or "", the model that ships; not the name of a plugin."""
    return not segmenter or segmenter.lower().endswith(".onnx")


def _usual_search() -> LocateOptions:
    from roadgeo.matching.options import LocateOptions

    return LocateOptions()


def _usual_outputs() -> OutputOptions:
    from roadgeo.outputs.location_files import OutputOptions

    return OutputOptions()


# fmt: off
@dataclass(frozen=True)
class BatchOptions:
    """The work done for every mask of a batch; each option is explained beside it.

    Attributes
    ----------
    images : mapping of mask to photograph
        Drawn on the map instead of the masks.
    exif : tuple of str
        Hints, by `matching.hints.Hint.goes_to`, that are taken from the photograph, or else the mask.
    command : tuple of str
        Options that ask for the same on the command line, for the results to name.
    """

    search: LocateOptions = field(default_factory=_usual_search)
    outputs: OutputOptions = field(default_factory=_usual_outputs)
    reading: ReadOptions = field(default_factory=ReadOptions)
    images: Mapping[str, str] = field(default_factory=dict)
    exif: tuple[str, ...] = ()
    command: tuple[str, ...] = ()
    dem: str = option("--dem", "FILE", IMAGE,
        "Terrain model (GeoTIFF, metres): how high the ground lies, and so how high the camera was above the sea.",
        default="", is_path=True, rare=True)
    skip_existing: bool = option("--skip-existing/--overwrite", "", RESULTS,
        "Keep results younger than their images, or make them anew, the default.", rare=True)
    taken: Taken | None = option("--take", "N|LON,LAT", RESULTS,
        "Write a place that the last answer for the image lists, as chosen by you: the N-th, or the one nearest to"
        " LON,LAT. Nothing is searched, unless there is no answer yet.", read=read_taken, rare=True)
    # fmt: on

    def photo(self, task: Task, of_photograph: bool) -> str | None:
        """Return the photograph that is drawn, if any: one that was given, or the query itself."""
        return self.images.get(task.mask, task.mask if of_photograph else None)
