"""The answer for Python: a location with all that it takes to draw and to write it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from roadgeo._arrays import AnyArray
from roadgeo.errors import NotLocatedError, PluginError
from roadgeo.geometry.mask import RoadMask
from roadgeo.location import Location
from roadgeo.matching.index import ReferenceIndex

if TYPE_CHECKING:
    import xarray as xr

    from roadgeo.outputs.plot import Plot
    from roadgeo.outputs.subject import Subject

__all__ = ["Answer"]


@dataclass(frozen=True, repr=False)
class Answer(Location):
    """A `Location` with the mask that it is about, and the references that were searched: it can be drawn and written.

    Attributes
    ----------
    mask : RoadMask
        The roads as they were read, or found in a photograph.
    photo : str or None
        The photograph, where the query was one.
    pixels : array or None
        The same, where it was no file: (H, W) or (H, W, bands).
    """

    mask: RoadMask = field(default_factory=lambda: RoadMask(np.zeros((1, 1), np.bool_)), repr=False)
    photo: str | None = None
    pixels: AnyArray | None = field(default=None, repr=False)
    indexes: tuple[ReferenceIndex, ...] = field(default=(), repr=False)

    def write(self, out_dir: str | os.PathLike[str] = ".", also: Sequence[str] = (), stem: str = "") -> list[Path]:
        """Write the files that `roadgeo locate` writes; return their paths.

        >>> answer = roadgeo.locate("drone.png", "porto.gpkg")
        >>> [path.name for path in answer.write("found", also=["geojson"])]  # doctest: +NORMALIZE_WHITESPACE
        ['drone_location.json', 'drone_footprint.tif', 'drone_footprint.qml', 'drone_location.gpkg',
         'drone_footprint.geojson']

        Parameters
        ----------
        also : sequence of str
            Further outputs by name: "overlay", "report", "geojson", "matches" and others that `roadgeo locate --help`
            lists.
        stem : str
            Start of the files' names. Default: as the query's file.

        Raises
        ------
        OutputError
            A file cannot be written.
        PluginError
            There is no such output, or one of another package failed; all else is written.
        """
        from roadgeo.outputs.location_files import OutputOptions, write_location
        from roadgeo.outputs.paths import output_paths
        from roadgeo.running.pictures import as_file
        from roadgeo.storage.files import make_folder

        make_folder(out_dir)
        paths = output_paths(out_dir, stem or Path(self.query).stem or "mask")
        options = OutputOptions(products=tuple(also))
        photo = self.photo if self.pixels is None else self.pixels
        with nullcontext() if photo is None else as_file(photo) as file:
            written = write_location(self, self.mask, paths, options, file, self.indexes)
        if written.faults:
            raise PluginError("; ".join(written.faults))
        return written.files

    def take(self, place: int | tuple[float, float]) -> Answer:
        """Return the answer with one of its `places` as the one that you take; nothing is searched again.

        >>> refused = roadgeo.locate("elsewhere.png", "porto.gpkg", effort="quick")
        >>> refused.take(2).status
        'chosen'

        Parameters
        ----------
        place : int or (longitude, latitude)
            Its number, from 1, or a point near it.

        Raises
        ------
        NotLocatedError
            There is no such place.
        """
        from roadgeo.running.choosing import take_place

        return cast(Answer, take_place(self, place))

    def plot(self) -> Plot:
        """Draw the mask's place on the map; notebooks show it.

        >>> roadgeo.locate("drone.png", "porto.gpkg").plot().save("drone.svg")

        Raises
        ------
        NotLocatedError
            There is no place.
        """
        from roadgeo.outputs.plot import draw_plot

        return draw_plot(self._subject())

    def to_xarray(self) -> xr.DataArray:
        """Return the mask on the map, dimensions y and x: 0 outside the footprint, 1 ground, 2 road.

        `attrs["crs"]` and `attrs["transform"]` give its place.

        >>> roadgeo.locate("drone.png", "porto.gpkg").to_xarray().dims
        ('y', 'x')

        Raises
        ------
        NotLocatedError
            There is no place.
        """
        import xarray as xr

        from roadgeo.outputs.footprint import warp_mask

        subject = self._subject()
        grid, values = subject.grid, warp_mask(subject)
        x = grid.west + grid.resolution * (np.arange(grid.width) + 0.5)
        y = grid.north - grid.resolution * (np.arange(grid.height) + 0.5)
        transform = tuple(grid.to_crs_matrix()[:2].ravel().tolist())
        about = {"crs": subject.crs, "transform": transform, "query": self.query, "attribution": subject.attribution}
        return xr.DataArray(values, {"y": y, "x": x}, ("y", "x"), name="road", attrs=about)

    def _subject(self) -> Subject:
        from roadgeo.outputs.paths import output_paths
        from roadgeo.outputs.subject import Subject

        if not self.on_map:
            raise NotLocatedError(f"{self.query or 'the mask'} has no place: {self.reason}")
        return Subject(self, self.mask, output_paths(".", "mask"), indexes=self.indexes)
