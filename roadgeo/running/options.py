"""How queries are read, and how a batch of them is located and written."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from roadgeo.matching.options import LocateOptions
    from roadgeo.outputs.location_files import OutputOptions
    from roadgeo.running.tasks import Task
    from roadgeo.sources.bands import Choice

__all__ = ["BatchOptions", "ReadOptions", "is_model"]


@dataclass(frozen=True)
class ReadOptions:
    """How what is given is read.

    Attributes
    ----------
    threshold : float or None
        Values of a mask, or probabilities, above it are road. Default: by the histogram of the values.
    band : int or None
        The band that holds a mask, counted from 1.
    segment : "auto", "always" or "never"
        Whether photographs are recognised, everything is taken for one, or nothing.
    segmenter : str
        A plugin, or the file of a model (.onnx). Default: the model that ships.
    class_name : str or None
        The class of a model that is road, or the number that stands for road in a map of classes. Default: by the names
        of the model's classes.
    names : tuple of str
        Names of the bands of an array.
    threads : int
        Threads of a model; fixed, so that results are the same on every run.
    mirror : bool or None
        Whether the input is mirrored. Default: as the georeference of its file states.
    units : "auto", "pixels" or "metres"
        Unit of roads that come as lines (see `sources.drawn_roads`).
    layer : tuple of str
        Layers of such roads, where their file has several.
    aspect : float or None
        How many times a pixel is as wide as high. Default: as the georeference of its file states, or once.
    bands : (3,) tuple of int, or None
        The red, green and blue band of a photograph, counted from 1. Default: by their names, or the first three.
    """

    threshold: float | None = None
    band: int | None = None
    segment: Literal["auto", "always", "never"] = "auto"
    segmenter: str = ""
    class_name: str | None = None
    threads: int = 1
    mirror: bool | None = None
    units: Literal["auto", "pixels", "metres"] = "auto"
    layer: tuple[str, ...] = ()
    aspect: float | None = None
    bands: tuple[int, int, int] | None = None
    names: tuple[str, ...] = ()

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


@dataclass(frozen=True)
class BatchOptions:
    """The work done for every mask of a batch.

    Attributes
    ----------
    images : mapping of mask to photograph
        Drawn on the map instead of the masks.
    exif : tuple of str
        Hints, by `matching.hints.Hint.goes_to`, that are taken from the photograph, or else the mask.
    dem : str
        Terrain model with the height of the ground below the camera; "" for none.
    skip_existing : bool
        Keep results of the same question that are whole and younger than their masks.
    taken : int, or (lon, lat), or None
        The place of the last answer for an image that is written as its place (see `choosing.take_place`).
    command : tuple of str
        Options that ask for the same on the command line, for the results to name.
    """

    search: LocateOptions = field(default_factory=_usual_search)
    outputs: OutputOptions = field(default_factory=_usual_outputs)
    reading: ReadOptions = field(default_factory=ReadOptions)
    images: Mapping[str, str] = field(default_factory=dict)
    exif: tuple[str, ...] = ()
    dem: str = ""
    skip_existing: bool = False
    taken: int | tuple[float, float] | None = None
    command: tuple[str, ...] = ()

    def photo(self, task: Task, of_photograph: bool) -> str | None:
        """Return the photograph that is drawn, if any: one that was given, or the query itself."""
        return self.images.get(task.mask, task.mask if of_photograph else None)
