"""What a result looks like on the map and on disk: the place that a located mask surely has, and names of its files."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from roadgeo._arrays import FloatArray
from roadgeo.errors import OutputError
from roadgeo.location import Location
from roadgeo.outputs.registry import FOOTPRINT, GEOPACKAGE, JSON, Output

__all__ = ["OutputPaths", "Placement", "output_paths"]


@dataclass(frozen=True)
class Placement:
    """What a located `Location` surely has; see there for shapes and frames."""

    crs: str
    homography: FloatArray
    footprint: FloatArray
    gsd_m: float

    @classmethod
    def of(cls, location: Location) -> Placement:
        """Take it from a location that has a place.

        Raises
        ------
        OutputError
            It has none.
        """
        crs, homography, footprint, gsd_m = location.crs, location.homography, location.footprint, location.gsd_m
        if crs is None or homography is None or footprint is None or gsd_m is None:
            raise OutputError(f"{location.query} has no place on the map to draw: it is {location.status}")
        return cls(crs, homography, footprint, gsd_m)


@dataclass(frozen=True)
class OutputPaths:
    """Where the files of one result go; `stem` is what their names begin with."""

    folder: Path
    stem: str

    def of(self, output: Output, picture: str = "") -> Path:
        """Name the file of an output; `picture` is the name of the photograph's or the mask's own file."""
        return output.path(self.folder, self.stem, picture)

    @property
    def footprint(self) -> Path:
        """The picture or the mask on the map."""
        return self.of(FOOTPRINT)

    @property
    def geopackage(self) -> Path:
        """Footprint, matches and roads."""
        return self.of(GEOPACKAGE)

    @property
    def json(self) -> Path:
        """The `Location`."""
        return self.of(JSON)


def output_paths(folder: str | os.PathLike[str], stem: str) -> OutputPaths:
    """Name the outputs of the mask `stem` in a folder."""
    return OutputPaths(Path(folder), stem)
