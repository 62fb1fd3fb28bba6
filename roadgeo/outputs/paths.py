"""What a result looks like on the map and on disk: the place that a located mask surely has, and names of its files."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from roadgeo._arrays import FloatArray
from roadgeo.errors import OutputError
from roadgeo.location import Location

__all__ = ["FIGURES", "OutputPaths", "Placement", "attributes", "output_paths"]


#: Formats of `OutputPaths.figure`.
FIGURES = ("pdf", "svg", "png")


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

    def _named(self, ending: str) -> Path:
        return self.folder / f"{self.stem}{ending}"

    @property
    def footprint(self) -> Path:
        """The picture or the mask on the map."""
        return self._named("_footprint.tif")

    @property
    def style(self) -> Path:
        """How QGIS draws a mask's footprint."""
        return self._named("_footprint.qml")

    @property
    def geopackage(self) -> Path:
        """Footprint, matches and roads."""
        return self._named("_location.gpkg")

    @property
    def overlay(self) -> Path:
        """The picture of the result."""
        return self._named("_overlay.png")

    def figure(self, kind: str) -> Path:
        """Name the same for papers, in one of the `FIGURES`."""
        return self._named(f"_figure.{kind}")

    @property
    def report(self) -> Path:
        """The page that shows and explains the result."""
        return self._named("_report.html")

    @property
    def explanation(self) -> Path:
        """Why it was or was not located."""
        return self._named("_explain.json")

    @property
    def explanation_picture(self) -> Path:
        """The same to look at."""
        return self._named("_explain.png")

    @property
    def json(self) -> Path:
        """The `Location`."""
        return self._named("_location.json")


def output_paths(folder: str | os.PathLike[str], stem: str) -> OutputPaths:
    """Name the outputs of the mask `stem` in a folder."""
    return OutputPaths(Path(folder), stem)


def attributes(location: Location) -> dict[str, Any]:
    """Return what a footprint carries in every format: plain values."""
    names = ["query", "status", "reason", "reference", "attribution", "gsd_m", "rotation_deg", "tilt_deg"]
    names += ["n_intersections", "n_matched", "inlier_ratio", "log10_odds"]
    sigma = location.corner_sigma_m
    worst = None if sigma is None else float(sigma.max())
    return {**{name: getattr(location, name) for name in names}, "max_corner_sigma_m": worst}
