"""Place and paths of a result: the fields that every located mask has, and the names of its files."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from roadgeo._arrays import AnyArray, FloatArray
from roadgeo.errors import OutputError
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.lens import Lens
from roadgeo.geometry.mask import plane_to_pixel
from roadgeo.geometry.warping import MapGrid, Transform, cover, warp
from roadgeo.location import Location
from roadgeo.outputs.registry import FOOTPRINT, GEOPACKAGE, JSON, Output
from roadgeo.roads.graph import RoadGraph

__all__ = ["OutputPaths", "Placement", "output_paths"]


@dataclass(frozen=True)
class Placement:
    """The fields that every located `Location` has; see there for shapes and frames."""

    crs: str
    homography: FloatArray
    footprint: FloatArray
    gsd_m: float
    size: tuple[int, int] = (1, 1)
    lens_k1: float = 0.0

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
        return cls(crs, homography, footprint, gsd_m, location.size or (1, 1), location.lens_k1)

    def lens(self, size: tuple[int, int]) -> Lens | None:
        """Return the lens in front of a picture of the frame, of `size` (width, height); None without one."""
        return Lens.of(self.lens_k1, size) if self.lens_k1 else None

    def to_crs(self, pixels: FloatArray) -> FloatArray:
        """Take (..., 2) pixels of the mask (column, row; GDAL corner convention) to the CRS."""
        lens = self.lens(self.size)
        return Homography(self.homography)(pixels if lens is None else lens.straighten(pixels))

    def draw(
        self,
        image: AnyArray,
        size: tuple[int, int],
        max_pixels: int,
        ways: Sequence[Transform] = (None, None),
        smooth: bool = True,
    ) -> tuple[AnyArray, MapGrid]:
        """Draw a picture of the frame, whose mask has `size` (width, height), on a grid of its own.

        `ways` lead to the CRS of the grid, and back (see `orthophoto.Target`).
        """
        seen = image.shape[1], image.shape[0]
        to_crs = self.homography @ np.diag([size[0] / seen[0], size[1] / seen[1], 1.0])
        grid = cover(seen, to_crs, None, max_pixels, ways[0])
        interpolation = cv2.INTER_LINEAR if smooth else cv2.INTER_NEAREST
        return warp(image, to_crs, grid, ways[1], interpolation, self.lens(seen)), grid

    def map_roads(self, graph: RoadGraph) -> list[FloatArray]:
        """Lay the mask's roads (query plane) on the map: (V, 2) each, but for those that reach beyond the horizon.

        A homography keeps lines straight, so mapping their vertices is exact.
        """
        if graph.n_edges == 0:
            return []
        mapped = self.to_crs(plane_to_pixel(graph.coords))
        whole = np.logical_and.reduceat(np.isfinite(mapped).all(axis=1), graph.offsets[:-1])
        parts = zip(graph.offsets[:-1].tolist(), graph.offsets[1:].tolist(), strict=True)
        return [mapped[first:last] for (first, last), seen in zip(parts, whole.tolist(), strict=True) if seen]


@dataclass(frozen=True)
class OutputPaths:
    """Paths of the files of one result; their names begin with `stem`."""

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
