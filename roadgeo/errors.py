"""Errors, named by the part that failed, and the codes of reasons.

A message holds what was wrong, what was got, what was expected and what to do, on one line. A mask that merely is not
found on the map is no error: it is a `Location` with a reason.
"""

import re
import sys
from enum import StrEnum
from pathlib import Path
from typing import ClassVar

from roadgeo._text import visible

__all__ = [
    "CrsError",
    "IndexFormatError",
    "MaskError",
    "MissingPackageError",
    "ModelError",
    "NoRoadsError",
    "NotLocatedError",
    "OutputError",
    "PhotographError",
    "PluginError",
    "Reason",
    "RoadSourceError",
    "RoadgeoError",
    "how_to_install",
    "is_of_memory",
    "name_package",
]

#: Packages by the extra, or else the package, to install for them. Onboard computers may lack those without an extra.
_BRINGS = {
    "pymavlink": "mavlink",
    "pyarrow": "parquet",
    "pandas": "geopandas",
    **{
        name.replace("-", "_"): name
        for name in (
            *("geopandas", "h11", "mapbox-vector-tile", "networkx", "onnxruntime", "osmium", "osmnx"),
            *("pyogrio", "python-multipart", "requests", "scipy", "shapely", "starlette", "uvicorn"),
        )
    },
}


class Reason(StrEnum):
    """Why a mask was located, or not: a code for programs, beside the sentence for people."""

    LOCATED = "located"
    #: The user took one of the places that a refusal listed.
    CHOSEN = "chosen"
    #: Two places fit almost equally; or two looks at one scene find two.
    TWO_PLACES = "two_places"
    TWO_LOOKS = "two_looks"
    #: The middle is uncertain by much of the frame, as along a road that is all that is seen.
    HALF_A_PLACE = "half_a_place"
    #: The mask shows too few intersections, or hardly a road.
    FEW_INTERSECTIONS = "few_intersections"
    FEW_ROADS = "few_roads"
    #: The map has too few around the place that was given.
    FEW_NEAR = "few_near"
    #: Stopped before everything was tried.
    TIME_LIMIT = "time_limit"
    #: The roads fit better at a place that the hints exclude.
    FITS_ELSEWHERE = "fits_elsewhere"
    #: The roads fit better with the image mirrored, left to right.
    MIRRORED = "mirrored"
    #: No place explains clearly more than others do.
    NOTHING_STANDS_OUT = "nothing_stands_out"
    #: Something did, but not by enough for all the looks that were taken.
    TOO_MANY_LOOKS = "too_many_looks"
    #: The mask, the photograph or what goes with it cannot be read or used; a result cannot be written.
    INVALID = "invalid"
    NOT_WRITTEN = "not_written"
    #: There is no reference, or none that can be used.
    NO_REFERENCE = "no_reference"
    #: A segmenter or another plugin failed.
    PLUGIN = "plugin"
    MEMORY = "memory"
    #: The fault is roadgeo's own.
    FAULT = "fault"


class RoadgeoError(Exception):
    """Base of every error that roadgeo raises on purpose; `code` gives programs its meaning for an image."""

    code: ClassVar[Reason] = Reason.INVALID

    def __str__(self) -> str:
        """Return the message in one line, whatever names and files it quotes."""
        return visible(super().__str__())


class RoadSourceError(RoadgeoError):
    """Roads could not be read, fetched, or are of no use (no lines, empty, unknown place, no network)."""


class NoRoadsError(RoadSourceError):
    """A source can be read and holds no roads."""


class CrsError(RoadgeoError):
    """A coordinate reference system is missing or cannot serve."""


class MaskError(RoadgeoError):
    """A query raster could not be read, or is not a road mask."""


class PhotographError(MaskError):
    """A query raster is a photograph: its roads have to be segmented first."""


class ModelError(RoadgeoError):
    """A segmentation model is missing, damaged, hostile, or not of a kind that can be run here."""

    code = Reason.PLUGIN


class IndexFormatError(RoadgeoError):
    """A reference's files are missing, damaged, hostile, stale or of another format version."""

    code = Reason.NO_REFERENCE


class NotLocatedError(RoadgeoError):
    """A place was asked of a mask that was not located."""


class MissingPackageError(RoadgeoError):
    """A package is not installed."""


class OutputError(RoadgeoError):
    """A result could not be written."""

    code = Reason.NOT_WRITTEN


class PluginError(RoadgeoError):
    """A plugin is missing, cannot be loaded, or does not do what is asked of its kind."""

    code = Reason.PLUGIN


#: How libraries word that they were given no memory.
_NO_MEMORY = re.compile(
    r"out of memory|insufficient memory|no memory left|bad.?alloc|cannot allocate|unable to allocate", re.I
)


def is_of_memory(error: BaseException) -> bool:
    """Whether an error, of whatever library, states that there is no memory left."""
    is_one = isinstance(error, MemoryError) or bool(_NO_MEMORY.search(str(error)))
    return is_one or (error.__cause__ is not None and is_of_memory(error.__cause__))


def name_package(error: ModuleNotFoundError) -> MissingPackageError | None:
    """Return the error that names how to install a package that is missing; None if roadgeo does not use it."""
    package = (error.name or "").partition(".")[0]
    if package not in _BRINGS:
        return None
    return MissingPackageError(f"this needs {package}, which is not installed: {how_to_install(_BRINGS[package])}")


def how_to_install(name: str) -> str:
    """Return the command that adds a package, or what an extra of roadgeo needs, to the Python that runs now.

    It does not name roadgeo itself, whose source, a checkout or a file, is not known any more.
    """
    from importlib.metadata import PackageNotFoundError, requires

    try:
        asked = requires("roadgeo") or []
    except PackageNotFoundError:  # run from its source
        asked = []
    matches = (re.fullmatch(r"([\w.-]+(?:\[[\w,-]+\])?)[^;]*;\s*extra == ['\"]([\w-]+)['\"]", query) for query in asked)
    brought = " ".join(_quoted(match[1]) for match in matches if match and match[2] == name)
    packages = brought or (name if name in _BRINGS else f"'roadgeo[{name}]'")
    parts = Path(sys.prefix).parts
    if "pipx" in parts:
        return f"pipx inject roadgeo {packages}"
    if "uv" in parts and "tools" in parts:
        return f"uv pip install --python {_quoted(sys.executable)} {packages}"
    return f"{_quoted(sys.executable or 'python')} -m pip install {packages}"


def _quoted(word: str) -> str:
    """Quote a word that a shell, of whatever system, would take apart."""
    return word if re.fullmatch(r"[\w./:\\+-]+", word) else f'"{word}"'
