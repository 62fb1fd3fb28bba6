"""How a batch of masks is read, located and written."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from roadgeo.matching.options import LocateOptions
    from roadgeo.outputs.location_files import OutputOptions
    from roadgeo.running.queries import QueryOptions
    from roadgeo.running.tasks import Task

__all__ = ["BatchOptions", "ReadOptions"]


@dataclass(frozen=True)
class ReadOptions:
    """How masks are read, and the files beside them.

    Attributes
    ----------
    threshold, band
        As for `sources.masks.read_mask`.
    segment, segmenters, class_name, fused_with, threads
        As for `queries.QueryOptions`.
    images : mapping of mask to photograph
        Drawn on the map instead of the masks.
    exif : bool
        Take the focal length from the photograph, or else the mask.
    dem : str
        Terrain model with the height of the ground below the camera; "" for none.
    allow_mirror : bool
        Masks that were mirrored have the place that they have turned over.
    units : "auto", "pixels" or "metres"
        Of roads that come as lines.
    layer : str or None
        Of a file of such roads that has several.
    aspect : float, "unknown" or None
        How many times a pixel is as wide as high; None: once.
    bands : (3,) tuple of int, or None
        The red, green and blue band of photographs, counted from 1.
    """

    threshold: float | None = None
    band: int | None = None
    images: Mapping[str, str] = field(default_factory=dict)
    exif: bool = False
    segment: Literal["auto", "always", "never"] = "auto"
    segmenters: tuple[str, ...] = ()
    class_name: str | None = None
    fused_with: tuple[str, ...] = ()
    threads: int = 1
    dem: str = ""
    allow_mirror: bool = False
    units: Literal["auto", "pixels", "metres"] = "auto"
    layer: str | None = None
    aspect: float | Literal["unknown"] | None = None
    bands: tuple[int, int, int] | None = None

    def photo(self, task: Task, of_photograph: bool) -> str | None:
        """Return the photograph that is drawn, if any: one that was given, or the query itself."""
        return self.images.get(task.mask, task.mask if of_photograph else None)

    def of_query(self) -> QueryOptions:
        """Return the options of one query."""
        from roadgeo.running.queries import QueryOptions

        return QueryOptions(
            self.threshold, self.band, self.segment, self.segmenters, self.class_name, self.fused_with, self.threads,
            "allow" if self.allow_mirror else "tell", self.units, self.layer, self.aspect, self.bands,
        )  # fmt: skip


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
    skip_existing : bool
        Keep results of the same question that are whole and younger than their masks.
    command : tuple of str
        Options that ask for the same on the command line, for the results to name.
    """

    search: LocateOptions = field(default_factory=_usual_search)
    outputs: OutputOptions = field(default_factory=_usual_outputs)
    reading: ReadOptions = field(default_factory=ReadOptions)
    skip_existing: bool = False
    command: tuple[str, ...] = ()
