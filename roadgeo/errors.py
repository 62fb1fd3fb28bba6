"""Errors, named by what failed.

A message holds what was wrong, what was got, what was expected and what to do, on one line. A mask that merely is not
found on the map is no error: it is a `Location` with a reason.
"""

import re
import sys
from pathlib import Path

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
    "RoadSourceError",
    "RoadgeoError",
    "how_to_install",
    "name_extra",
]

#: Packages that come with an extra, and which: the core locates masks on references that were built elsewhere.
_EXTRAS = {
    "geopandas": "maps",
    "mapbox_vector_tile": "serve",
    "networkx": "maps",
    "onnxruntime": "segment",
    "osmium": "maps",
    "osmnx": "maps",
    "pandas": "maps",
    "pyarrow": "maps",
    "pymavlink": "mavlink",
    "pyogrio": "maps",
    "python_multipart": "serve",
    "requests": "maps",
    "scipy": "track",
    "shapely": "maps",
    "starlette": "serve",
    "uvicorn": "serve",
}


class RoadgeoError(Exception):
    """Base of every error that roadgeo raises on purpose."""

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


class IndexFormatError(RoadgeoError):
    """A reference's files are missing, damaged, hostile, stale or of another format version."""


class NotLocatedError(RoadgeoError):
    """A place was asked of a mask that was not located."""


class MissingPackageError(RoadgeoError):
    """A package of an extra is not installed."""


class OutputError(RoadgeoError):
    """A result could not be written."""


class PluginError(RoadgeoError):
    """A plugin is missing, cannot be loaded, or does not do what is asked of its kind."""


def name_extra(error: ModuleNotFoundError) -> MissingPackageError | None:
    """Return the error that names the extra of a package that is not installed; None if it is of no extra."""
    package = (error.name or "").partition(".")[0]
    if package not in _EXTRAS:
        return None
    extra = _EXTRAS[package]
    return MissingPackageError(f"this needs {package}, which is not installed (extra {extra}): {how_to_install(extra)}")


def how_to_install(extra: str) -> str:
    """Return the command that adds what an extra of this package needs, to the Python that runs now.

    It does not name roadgeo itself, whose source, a checkout or a file, is not known any more.
    """
    from importlib.metadata import PackageNotFoundError, requires

    try:
        asked = requires("roadgeo") or []
    except PackageNotFoundError:  # run from its source
        asked = []
    found = (re.fullmatch(r"([\w.-]+(?:\[[\w,-]+\])?)[^;]*;\s*extra == ['\"]([\w-]+)['\"]", one) for one in asked)
    packages = " ".join(_quoted(one[1]) for one in found if one and one[2] == extra) or f"'roadgeo[{extra}]'"
    parts = Path(sys.prefix).parts
    if "pipx" in parts:
        return f"pipx inject roadgeo {packages}"
    if "uv" in parts and "tools" in parts:
        return f"uv pip install --python {_quoted(sys.executable)} {packages}"
    return f"{_quoted(sys.executable or 'python')} -m pip install {packages}"


def _quoted(word: str) -> str:
    """Quote a word that a shell, of whatever system, would take apart."""
    return word if re.fullmatch(r"[\w./:\\+-]+", word) else f'"{word}"'
