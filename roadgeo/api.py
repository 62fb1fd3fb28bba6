"""What Python programs call: as the command line does it, but with what they have at hand, and nothing is written."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np

from roadgeo.errors import NotLocatedError, OutputError, PluginError, how_to_install, name_extra
from roadgeo.geometry.areas import Box
from roadgeo.geometry.mask import RoadMask
from roadgeo.location import Location
from roadgeo.matching.hints import apply_hints, read_hint
from roadgeo.matching.index import ReferenceIndex
from roadgeo.matching.options import LocateOptions
from roadgeo.reference.reference import AnyReference, BuildOptions, Reference, swapped_near
from roadgeo.reference.shards import ShardedReference
from roadgeo.roads.kinds import RoadKind

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

    from roadgeo.outputs.subject import Subject

__all__ = ["Answer", "build_reference", "locate"]

#: A reference that is open, its file, its name in the library; or several of them.
References: TypeAlias = "AnyReference | str | os.PathLike[str] | Iterable[AnyReference | str | os.PathLike[str]]"


@dataclass(frozen=True, repr=False)
class Answer(Location):
    """A `Location` with the mask that it is about, and the references that were searched: it can be drawn and written.

    Attributes
    ----------
    mask : RoadMask
        The roads as they were read, or found in a photograph.
    photo : str or None
        The photograph, where the query was one.
    """

    mask: RoadMask = field(default_factory=lambda: RoadMask(np.zeros((1, 1), np.bool_)), repr=False)
    photo: str | None = None
    indexes: tuple[ReferenceIndex, ...] = field(default=(), repr=False)

    def write(self, out_dir: str | os.PathLike[str] = ".", also: Sequence[str] = (), stem: str = "") -> list[Path]:
        """Write the files that `roadgeo locate` writes; return their paths.

        Parameters
        ----------
        also : sequence of str
            Further outputs by name: "overlay", "report", "geojson", "matches" and what else `roadgeo locate --help`
            lists.
        stem : str
            What the names of the files begin with. Default: as the query's file.

        Raises
        ------
        OutputError
            A file cannot be written.
        PluginError
            There is no such output, or one of another package failed; all else is written.
        """
        from roadgeo.outputs.location_files import OutputOptions, write_location
        from roadgeo.outputs.paths import output_paths
        from roadgeo.storage.atomic import writing

        with writing(out_dir):
            Path(out_dir).mkdir(parents=True, exist_ok=True)
        paths = output_paths(out_dir, stem or Path(self.query).stem or "mask")
        options = OutputOptions(products=tuple(also))
        written = write_location(self, self.mask, paths, options, self.photo, self.indexes)
        if written.faults:
            raise PluginError("; ".join(written.faults))
        return written.files

    def plot(self) -> Figure:
        """Draw the mask and its place on the map, as a matplotlib figure.

        Raises
        ------
        NotLocatedError
            There is no place.
        OutputError
            matplotlib is missing.
        """
        from roadgeo.outputs.figure import draw_figure, has_matplotlib

        if not has_matplotlib():
            raise OutputError(f"plot() needs matplotlib: {how_to_install('plot')}")
        subject = self._subject()
        return draw_figure(self, self.mask, subject.roads, subject.attribution)

    def to_xarray(self) -> xr.DataArray:
        """Return the mask on the map, dimensions y and x: 0 outside the footprint, 1 ground, 2 road.

        `attrs["crs"]` and `attrs["transform"]` say where it lies.

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
        transform = (grid.resolution, 0.0, grid.west, 0.0, -grid.resolution, grid.north)
        told = {"crs": subject.crs, "transform": transform, "query": self.query, "attribution": subject.attribution}
        return xr.DataArray(values, {"y": y, "x": x}, ("y", "x"), name="road", attrs=told)

    def _subject(self) -> Subject:
        from roadgeo.outputs.paths import output_paths
        from roadgeo.outputs.subject import Subject

        if not self.located:
            raise NotLocatedError(f"{self.query or 'the mask'} has no place: {self.reason}")
        return Subject(self, self.mask, output_paths(".", "mask"), indexes=self.indexes)


def build_reference(
    roads: Any,
    name: str = "",
    options: BuildOptions | None = None,
    *,
    crs: Any = None,
    path: str | os.PathLike[str] | None = None,
    kinds: RoadKind = "drivable",
    tunnels: bool = False,
    attribution: str | None = None,
) -> Reference:
    """Build a reference from roads, as `roadgeo index` does.

    >>> reference = roadgeo.build_reference("streets.gpkg", "boston")
    >>> reference = roadgeo.build_reference(lines, "boston", crs="EPSG:26986")  # shapely lines, or arrays

    Parameters
    ----------
    roads : path or paths, GeoDataFrame, GeoSeries, osmnx graph, shapely lines, arrays, or Roads
        A path is a road file or a folder of them. Arrays are of shape (N, 2), x or longitude first, one for each line;
        or a single one, where rows of NaN stand between the lines.
    name : str
        What the reference is called. Default: as the file at `path`, if that is given.
    crs : anything that pyproj knows, optional
        CRS of the coordinates. Needed for shapely lines and arrays, and for files that do not say.
    path : path, optional
        Write it there, REF.gpkg and REF.index, and open it from there. Default: nothing is written.
    kinds : "main", "drivable", "vehicles" or "all"
        Which roads are taken, where they tell their kind (see `roadgeo.sources.schemas`).
    tunnels : bool
        Take tunnels too, which a mask does not show.
    attribution : str, optional
        Whom to name beside the map, where the roads do not say.

    Raises
    ------
    CrsError, RoadSourceError
        No CRS; no lines; fewer than three intersections.
    OutputError
        It cannot be written.
    MissingPackageError
        A package of the extra `maps` is not installed.
    """
    from roadgeo.sources.held_roads import choose_roads
    from roadgeo.workflows import build_reference as build

    where = None if path is None else Path(path)
    try:
        chosen = choose_roads(roads, kinds, tunnels, attribution, crs=crs)
        return build(chosen, name or (where.stem if where else ""), options, path=where)
    except ModuleNotFoundError as error:
        raise name_extra(error) or error from error


def locate(
    mask: Any,
    reference: References = (),
    options: LocateOptions | None = None,
    *,
    gsd: float | tuple[float, float] | str | None = None,
    near: tuple[float, float, float] | str | None = None,
    within: str | Box | None = None,
    max_tilt: float | None = None,
    north_up: bool | None = None,
    heading: float | tuple[float, float] | str | None = None,
    focal: float | Literal["exif"] | None = None,
    effort: Literal["quick", "full"] | None = None,
    time_limit: float | None = None,
) -> Answer:
    """Find where a photograph, or a mask of roads, lies on a map. Nothing is written.

    An image that is not found is an answer with a reason, not an error.

    >>> answer = roadgeo.locate("drone.png", "porto.gpkg", gsd=0.8)
    >>> answer.status, round(answer.center.lat, 2)
    ('located', 41.15)

    Parameters
    ----------
    mask : path, array, PIL image, xarray DataArray, rasterio dataset or RoadMask
        A photograph, whose roads are found first; or a mask: bright, or 1, where there is road. Arrays have the
        shape (H, W), (H, W, C) or (C, H, W).
    reference : Reference, path or name, or several
        Files REF.gpkg, or names in the library. Default: all of the library.
    options : LocateOptions
        Everything that can be chosen. The following override it; texts are read as on the command line.
    near : (longitude, latitude, metres)
        The middle lies within that distance of this place.
    within : str or (west, south, east, north)
        The middle lies in this country or state, or within these degrees.
    gsd : float or (float, float)
        Metres per pixel at the middle, at least and at most; a single value stands for 0.8 to 1.25 times it.
    heading : float or (float, float)
        Direction of the image's up, degrees clockwise from north, and by how much it may be off (default 10).
    north_up : bool
        The image's up is grid north of the reference, within 5 degrees.
    max_tilt : float
        Greatest angle of the camera from the vertical, degrees.
    focal : float or "exif"
        Focal length in pixels of the image; or as a file's EXIF says.
    effort : "quick" or "full"
        Whether the search ends early, or roads alone are searched too (the default).
    time_limit : float
        Seconds after which the search stops.

    Raises
    ------
    MaskError
        The image cannot be read or shows no roads.
    IndexFormatError
        A reference is missing or unusable.
    ValueError
        A hint makes no sense; `near` lies on no map, but would with longitude and latitude exchanged.
    """
    from roadgeo.running.looks import Sighting
    from roadgeo.running.pictures import read_picture
    from roadgeo.running.queries import locate_query
    from roadgeo.workflows import locate as locate_mask

    given = {
        "near": near,
        "within": within,
        "gsd": gsd,
        "heading": heading,
        "north_up": north_up,
        "max_tilt": max_tilt,
        "focal": focal,
        "effort": effort,
        "time_limit": time_limit,
    }
    options = _with_hints(options or LocateOptions(), given, mask)
    references = _open(reference)
    meant = None if options.near is None else swapped_near(options.near, references)
    if meant is not None:
        raise ValueError(f"near={near} lies on none of the maps; longitude comes first: did you mean near={meant}?")
    if isinstance(mask, RoadMask):
        sighting = Sighting(locate_mask(mask, references, options), mask)
    else:
        sighting = locate_query(read_picture(mask), references, options)
    told = {"options": _told(options), "reference_digest": _digest(references, sighting.location)}
    found = {one.name: getattr(sighting.location, one.name) for one in fields(Location)}
    indexes = tuple(one.index_of(sighting.location) for one in references)
    photo = str(mask) if sighting.of_photograph and isinstance(mask, str | os.PathLike) else None
    return Answer(**{**found, **told}, mask=sighting.mask, photo=photo, indexes=indexes)


def _with_hints(options: LocateOptions, given: dict[str, Any], image: Any) -> LocateOptions:
    """Put what is known where the search looks for it."""
    known = dict(read_hint(name, value) for name, value in given.items() if value is not None)
    if known.get("focal_px") == "exif":
        from roadgeo.sources.exif import focal_in_pixels

        if not isinstance(image, str | os.PathLike):
            raise ValueError('focal="exif" is for files; give the focal length in pixels')
        known["focal_px"] = focal_in_pixels(os.fspath(image))
    return apply_hints(options, known)


def _told(options: LocateOptions) -> dict[str, Any]:
    """Return the options that differ from the usual ones, as the command line writes them down."""
    from roadgeo.running.batch import changed_options

    plain: dict[str, Any] = json.loads(
        json.dumps(changed_options(replace(options, truths=(), threads=1), LocateOptions()), default=repr)
    )
    return plain


def _digest(references: Sequence[AnyReference], location: Location) -> str:
    """Return the digest of the reference of a place, else of all; those that were not written have none."""
    from roadgeo.reference.inspection import reference_digest

    here = [one for one in references if one.name == location.reference][:1] or references
    paths = [one.index.path if isinstance(one, Reference) else one.path for one in here]
    return ", ".join(reference_digest(path) for path in paths if path)


def _open(reference: References) -> list[AnyReference]:
    """Open what is not open yet; nothing named: all of the library."""
    from roadgeo.running.batch import open_references

    given = [reference] if isinstance(reference, Reference | ShardedReference | str | os.PathLike) else list(reference)
    if not given:
        return open_references(())
    return [open_references([os.fspath(one)])[0] if isinstance(one, str | os.PathLike) else one for one in given]
