"""The input of all outputs: a location with everything at hand for drawing it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from roadgeo._arrays import AnyArray, FloatArray
from roadgeo.errors import CrsError, OutputError
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.mask import RoadMask, plane_to_pixel
from roadgeo.geometry.placement import Matches, Placement
from roadgeo.geometry.warping import MapGrid, cover
from roadgeo.location import Content, Location
from roadgeo.matching.explanation import Explanation
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.scene import trace_query
from roadgeo.outputs.drawing.layers import Box
from roadgeo.outputs.drawing.svg import thin_lines
from roadgeo.outputs.options import ImageOptions
from roadgeo.outputs.orthophoto import Target, choose_target, image_homography, read_preview
from roadgeo.outputs.paths import OutputPaths
from roadgeo.outputs.placing import placement_of
from roadgeo.roads.graph import RoadGraph
from roadgeo.storage.orientation import read_orientation, stored_from_upright

__all__ = ["Match", "Subject", "ViewLimits"]

#: Rows and columns of the grid of control points, from corner to corner.
_GRID = 5

#: A warped mask is drawn in memory, so it is made coarser beyond this.
_MASK_MAX_PIXELS = 100_000_000


@dataclass(frozen=True)
class ViewLimits:
    """How much the views of a result hold.

    Attributes
    ----------
    margin, reach : float
        Ground shown around the footprint at first, and ground whose roads are there to be moved to, in lengths of the
        footprint's longer side.
    max_map_vertices, max_query_vertices : int
        Vertices of the roads of the map, and of the mask.
    max_matches : int
        Those with the largest residuals are listed and drawn.
    picture_px, picture_bytes : int
        Longer side of the photograph or mask, and size of each of its two copies: in its frame and on the map.
    overview_bytes : int
        Size of the picture of the whole map.
    """

    margin: float = 0.12
    reach: float = 0.7
    max_map_vertices: int = 80_000
    max_query_vertices: int = 25_000
    max_matches: int = 1500
    picture_px: int = 1400
    picture_bytes: int = 300_000
    overview_bytes: int = 150_000


class Match(NamedTuple):
    """An intersection in the picture and on the map.

    Attributes
    ----------
    column, row : float
        Where the picture shows it, pixels from the corner of the first one.
    x, y : float
        Where the map has it, in the place's CRS.
    fitted_column, fitted_row : float
        Where the homography places it in the picture.
    dx_m, dy_m : float
        From where the homography puts the picture's to the map's.
    """

    column: float
    row: float
    x: float
    y: float
    fitted_column: float
    fitted_row: float
    dx_m: float
    dy_m: float


@dataclass(frozen=True)
class Subject:
    """The input of the outputs. Members that need a place raise an `OutputError` without it.

    Attributes
    ----------
    photo : Path or None
        The photograph that the mask was made of, which is drawn in its stead.
    indexes : sequence of ReferenceIndex
        The maps that were searched.
    explanation : Explanation or None
        Given where one was asked for.
    views : ViewLimits
        How much pages and pictures show.
    """

    location: Location
    mask: RoadMask
    paths: OutputPaths
    image: ImageOptions = field(default_factory=ImageOptions)
    photo: Path | None = None
    indexes: Sequence[ReferenceIndex] = ()
    explanation: Explanation | None = None
    views: ViewLimits = field(default_factory=ViewLimits)

    @property
    def picture(self) -> Path:
        """The file that is drawn: the photograph, or else the mask, as it came."""
        return self.photo or Path(self.mask.name or f"{self.paths.stem}.png")

    @property
    def attribution(self) -> str:
        """Whom the map's licence asks to name."""
        return str(self.index.meta.get("attribution") or "") if self.indexes else self.location.attribution

    @property
    def index(self) -> ReferenceIndex:
        """The map that it lies on, or the first that was searched."""
        return self.index_of(self.location.reference)

    def index_of(self, name: str) -> ReferenceIndex:
        """Return the map of a name, or the first that was searched.

        Raises
        ------
        OutputError
            No map is given.
        """
        if not self.indexes:
            raise OutputError(f"{self.location.query}: no map is given to draw it on")
        return next((index for index in self.indexes if index.name == name), self.indexes[0])

    @property
    def has_place(self) -> bool:
        """Whether it lies anywhere, be it surely or not."""
        return self.location.place is not None

    @cached_property
    def place(self) -> Placement:
        """Where it lies."""
        return placement_of(self.location)

    @cached_property
    def _registered(self) -> tuple[FloatArray, tuple[int, int]]:
        if self.photo is None:
            return self.place.homography, self.mask_size
        return image_homography(self.place, self.mask_size, self.photo)

    @property
    def homography(self) -> FloatArray:
        """(3, 3) from the picture's pixels (column, row; GDAL corner convention) to the place's CRS."""
        return self._registered[0]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the picture."""
        return self._registered[1]

    @property
    def mask_size(self) -> tuple[int, int]:
        """Width and height of the mask."""
        return self.mask.shape[1], self.mask.shape[0]

    @property
    def box(self) -> Box:
        """The frame, in the mask's pixels."""
        return 0.0, 0.0, float(self.mask_size[0]), float(self.mask_size[1])

    @property
    def kind(self) -> str:
        """Kind of the image, in words: "photograph" or "mask"."""
        return "mask" if self.photo is None and self.mask.probability is None else "photograph"

    @cached_property
    def reduced(self) -> AnyArray | None:
        """(h, w, 4) uint8, the photograph as views show it; None without one."""
        return None if self.photo is None else read_preview(self.photo, self.views.picture_px)

    @cached_property
    def _content(self) -> Content:
        """The mask's roads and intersections, traced again where they are not at hand."""
        if self.location.content is not None and self.location.content.graph is not None:
            return self.location.content
        scene, graph = trace_query(self.mask)
        return Content(scene.size, graph, scene.intersections.xy)

    @property
    def graph(self) -> RoadGraph:
        """The mask's roads, query plane."""
        assert self._content.graph is not None  # noqa: S101 - it was traced
        return self._content.graph

    @cached_property
    def lines(self) -> list[FloatArray]:
        """The mask's roads (V, 2) as views show them, pixels.

        Raises
        ------
        MaskError
            It shows none.
        """
        lines = [plane_to_pixel(line) for line in self.graph.polylines()]
        return thin_lines(lines, self.views.max_query_vertices, 0.4)

    @property
    def crossings(self) -> FloatArray:
        """(N, 2) intersections of the mask, pixels."""
        return plane_to_pixel(self._content.xy)

    def largest_residuals(self) -> Matches | None:
        """Return the matches with the largest residuals, in falling order, as many as views show."""
        matches = None if self.location.place is None else self.location.place.matches
        if matches is None:
            return None
        first = np.argsort(-matches.residual_m, kind="stable")[: self.views.max_matches]
        return Matches(matches.query_xy[first], matches.reference_xy[first], matches.residual_m[first])

    def runner_up(self) -> FloatArray | None:
        """Position (2,) in the CRS of the middle of the best other place; of a refusal, of the best that it had.

        None where it lies on another map.
        """
        location = self.location
        other = location.runner_up if self.has_place else next(iter(location.alternatives), None)
        if other is None or other.reference != location.reference:
            return None
        return np.array(other.center_in(location.crs or other.crs)[:2])

    @cached_property
    def target(self) -> Target:
        """CRS of the drawn raster, and the way there and back."""
        return choose_target(self.place, self.image)

    @property
    def crs(self) -> str:
        """CRS of the drawn raster."""
        return self.target.crs

    @cached_property
    def grid(self) -> MapGrid:
        """Pixels of the drawn raster.

        Raises
        ------
        CrsError
            The footprint lies outside what the CRS is made for.
        """
        max_pixels = self.image.max_pixels if self.photo else min(self.image.max_pixels, _MASK_MAX_PIXELS)
        grid = cover(self.size, self.homography, self.image.resolution, max_pixels, self.target.to_target)
        if grid.width == 0:
            raise CrsError(f"the footprint lies outside what {self.crs} is made for; choose another --crs")
        return grid

    @cached_property
    def roads(self) -> FloatArray:
        """(S, 4) segments x1, y1, x2, y2 of the map's roads, in the place's CRS."""
        ends = self.index.segments.reshape(-1, 2).astype(float)
        return self.index.plane.to_crs(ends).reshape(-1, 4)

    @cached_property
    def stored(self) -> Homography:
        """From the picture's pixels to its file's, where that is to be turned (see `storage.orientation`)."""
        return Homography(stored_from_upright(read_orientation(self.picture), self.size))

    def control_points(self) -> list[list[float]]:
        """Column, row, x, y of 25 points on a grid over the picture, in the pixels of its file as they are stored."""
        pixels, lens = Frame(*self.size).grid(_GRID), self.place.lens(self.size)
        straight = pixels if lens is None else lens.straighten(pixels)
        points: list[list[float]] = np.hstack([self.stored(pixels), Homography(self.homography)(straight)]).tolist()
        return points

    def matches(self) -> list[Match]:
        """Return the intersections that were found both in the picture and on the map.

        Raises
        ------
        OutputError
            There is no place, or its map is not at hand.
        """
        place, matches = self.place, self.place.matches
        if matches is None:
            raise OutputError(f"{self.location.query}: its matched intersections are not known any more")
        to_map, to_picture = Homography(self.homography), Homography(self.homography).inverse()
        mapped = place.to_crs(plane_to_pixel(matches.query_xy))
        lens = place.lens(self.size)
        straight = to_picture(mapped)  # the picture's, which may be larger than the mask
        fitted = to_picture(matches.reference_xy)
        offset = matches.reference_xy - to_map(straight)
        pixels, fitted = (straight, fitted) if lens is None else (lens.bend(straight), lens.bend(fitted))
        return [Match(*row) for row in np.hstack([pixels, matches.reference_xy, fitted, offset]).tolist()]

    def outline(self) -> FloatArray:
        """Ring (32, 2) of longitude and latitude around the footprint, counterclockwise; see `antimeridian`."""
        from roadgeo.geometry.projection import to_lonlat

        pixels = np.roll(Frame(*self.size).outline()[::-1], 1, axis=0)  # from the top left corner, still
        return to_lonlat(self.place.crs, Homography(self.homography)(pixels))
