"""The Python interface: as the command line, but with objects at hand, and without files."""

from __future__ import annotations

import inspect
import os
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields, replace
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, TypedDict, TypeVar, Unpack

from roadgeo._text import read_moment
from roadgeo.errors import MaskError, RoadSourceError, name_package
from roadgeo.geometry.areas import Box
from roadgeo.geometry.mask import RoadMask
from roadgeo.location import Location
from roadgeo.matching.hints import HINTS, STATED, apply_hints, as_keywords, asked_of_camera, read_hint
from roadgeo.matching.options import LocateOptions
from roadgeo.reference.opening import AnyReference, digest_of, say_swapped
from roadgeo.reference.reference import BuildOptions, Reference
from roadgeo.reference.shards import ShardedReference
from roadgeo.roads.kinds import ROAD_KINDS, RoadKind
from roadgeo.running.answers import Answer

if TYPE_CHECKING:
    from datetime import datetime

    import networkx as nx

    from roadgeo._arrays import AnyArray
    from roadgeo.flights.rows import Row
    from roadgeo.running.pictures import PilImage, RasterioDataset, XarrayArray
    from roadgeo.running.verifying import Verified

__all__ = ["Answer", "fence", "index", "locate", "track", "vectorize", "verify"]

_KEYWORD = inspect.Parameter.KEYWORD_ONLY
Function = TypeVar("Function", bound=Callable[..., Any])

#: A reference that is open, its file, its name in the library; or several of them.
References: TypeAlias = "AnyReference | str | os.PathLike[str] | Iterable[AnyReference | str | os.PathLike[str]]"

#: A file; or what other libraries hold: an array (also as nested lists), a PIL image, xarray's or rasterio's.
Picture: TypeAlias = "str | os.PathLike[str] | AnyArray | list[Any] | PilImage | XarrayArray | RasterioDataset"

#: A file or folder, or several.
Files: TypeAlias = "str | os.PathLike[str] | Iterable[str | os.PathLike[str]]"


class FlightHints(TypedDict, total=False):
    """What may be known of a flight (see the table of `matching.hints`)."""

    near: tuple[float, float, float] | str | None
    within: str | Box | None
    gsd: float | tuple[float, float] | str | None
    max_tilt: float | None
    time_limit: float | None


class Hints(FlightHints, total=False):
    """What may be known of an image (see the table of `matching.hints`)."""

    heading: float | tuple[float, float] | str | None
    north_up: bool | None
    focal: float | Literal["exif"] | None
    effort: Literal["quick", "full"] | None


def _hinted(known: type) -> Callable[[Function], Function]:
    """Write hints into a function's signature and docstring, as the table has them, and refuse other keywords."""

    def write(function: Function) -> Function:
        own = inspect.signature(function)
        kinds = {name: known.__annotations__[name].__forward_arg__ for name in HINTS if name in known.__annotations__}
        hints = [inspect.Parameter(name, _KEYWORD, default=None, annotation=kind) for name, kind in kinds.items()]
        signature = own.replace(parameters=[*list(own.parameters.values())[:-1], *hints])

        @wraps(function)
        def call(*given: Any, **named: Any) -> Any:
            signature.bind(*given, **named)
            return function(*given, **named)

        said = "".join(f"    {name} : {HINTS[name].form or 'bool'}\n        {HINTS[name].told}\n" for name in kinds)
        call.__signature__ = signature  # type: ignore[attr-defined]
        call.__doc__ = re.sub(r"    \*\*hints\n(        .*\n)+", rf"\g<0>{said}", function.__doc__ or "")
        return call  # type: ignore[return-value]

    return write


def fence(read: Files = (), write: Files = (), *, network: bool = False) -> bool:
    """Fence this process in, for good: from now on it opens what is given here, and nothing else.

    Commands do so by themselves; a program that reads files of strangers may. Python, its packages, the system's
    libraries, the library of references and the cache stay readable. Threads that run already stay outside, processes
    that start later are inside.

    >>> roadgeo.fence(read=["photo.jpg", "porto.gpkg"], write=["found"])  # doctest: +SKIP
    True

    Parameters
    ----------
    read : path or paths
        Files, with those beside them that share their stem; folders, with all that is in them.
    write : path or paths
        Folders that may be written, and read; they are made if they are missing.
    network : bool
        Whether connections may be made, where the system can forbid them (Linux 6.7 and later).

    Returns
    -------
    bool
        Whether there is a fence: False where the system has no Landlock (Linux 5.13 and later).
    """
    from roadgeo.reference.library import library_dir
    from roadgeo.storage.fence import Fence

    kept = [str(library_dir())] if library_dir().is_dir() else []
    kept.append("/dev/shm")  # noqa: S108 - where locks of several processes lie
    return Fence(_paths(read), (), (*_paths(write), *kept), network).enter()


def _paths(given: Files) -> tuple[str, ...]:
    try:
        return tuple(map(os.fsdecode, (given,) if isinstance(given, str | bytes | os.PathLike) else given))
    except TypeError as error:
        raise MaskError(
            f"{type(given).__name__} is no path, nor several; expected files, folders or patterns"
        ) from error


def _path(given: str | os.PathLike[str]) -> str:
    try:
        return os.fsdecode(given)
    except TypeError as error:
        raise MaskError(f"{type(given).__name__} is no path; expected a file's") from error


def index(
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
    """Build a reference of a place, or from roads, as `roadgeo index` does.

    >>> reference = roadgeo.index("porto_roads.gpkg", attribution="© OpenStreetMap contributors", path="city.gpkg")
    >>> reference
    <Reference 'city': 2,649 intersections, EPSG:32629, city.gpkg>

    The roads of `roadgeo.index("Boston, MA", path="boston.gpkg")` come from OpenStreetMap; from lines or arrays a
    reference is made by `roadgeo.index(lines, "porto", crs="EPSG:32629")`.

    Parameters
    ----------
    roads : str, (west, south, east, north), path or paths, GeoDataFrame, osmnx graph, shapely lines, arrays, or Roads
        A place that OpenStreetMap knows, where there is no file of that name; a box in degrees; a road file or a folder
        of them. Arrays are of shape (N, 2), x or longitude first, one for each line; or a single one, where rows of NaN
        stand between the lines.
    name : str
        Name of the reference. Default: as the file at `path`, or as what is given.
    crs : anything that pyproj knows, optional
        CRS of the coordinates. Needed for shapely lines and arrays, and for files without one.
    path : path, optional
        Write it there, REF.gpkg and REF.index, and open it from there. Default: nothing is written.
    kinds : "main", "drivable", "vehicles" or "all"
        Kinds of roads to take, where they have kinds (see `roadgeo.sources.schemas`).
    tunnels : bool
        Take tunnels too, which a mask does not show.
    attribution : str, optional
        Attribution beside the map, where the roads have none.

    Raises
    ------
    CrsError, RoadSourceError
        No CRS; no lines; fewer than three intersections; no such place, or no network.
    OutputError
        It cannot be written.
    MissingPackageError
        A package is not installed, as on an onboard computer.
    """
    try:
        from roadgeo.sources.roads import choose_roads, fetch_roads
        from roadgeo.workflows import build_reference

        where = None if path is None else Path(_path(path))
        if kinds not in ROAD_KINDS:
            raise RoadSourceError(f"kinds={kinds!r}: expected one of {', '.join(ROAD_KINDS)}")
        is_box = isinstance(roads, tuple) and len(roads) == 4 and all(isinstance(road, int | float) for road in roads)
        name = name or (where.stem if where else _name_of(roads, is_box))
        if is_box or _is_place(roads):
            chosen = fetch_roads(**{"bbox" if is_box else "place": roads}, which=kinds, tunnels=tunnels)
        else:
            chosen = choose_roads(roads, kinds, tunnels, attribution, crs=crs)
        return build_reference(chosen, name, options, path=where)
    except ModuleNotFoundError as error:
        raise name_package(error) or error from error


def _name_of(roads: Any, is_box: bool) -> str:
    """Return a name for a place, a box or a file; nothing for other roads."""
    from roadgeo.reference.library import make_slug

    if not isinstance(roads, str | os.PathLike):
        return "box" if is_box else ""
    return make_slug(str(roads) if _is_place(roads) else Path(roads).name.split(".")[0])


def _is_place(roads: Any) -> bool:
    """Whether what is given names a place, not a file: none is there, and it does not end like one."""
    return isinstance(roads, str) and not Path(roads).exists() and not re.search(r"[/\\]|\.\w{2,9}$", roads)


@_hinted(Hints)
def locate(
    mask: Picture | RoadMask,
    reference: References = (),
    options: LocateOptions | None = None,
    *,
    take: int | tuple[float, float] | None = None,
    **hints: Unpack[Hints],
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
        Everything that can be chosen. Hints override it.
    take : int or (longitude, latitude)
        The place, counted from 1 among `places` or nearest to this one, that is the answer; its status is "chosen".
        With an answer that is there already, `answer.take` takes a place without another search.
    **hints
        What is known of the image; texts are read as on the command line. "exif" for `near`, `gsd`, `heading` or
        `focal`: as the camera states it in a file's EXIF and XMP, with the errors of such statements.

    Raises
    ------
    MaskError
        The image cannot be read or shows no roads.
    NotLocatedError
        There is no such place to take.
    IndexFormatError
        A reference is missing or unusable.
    ValueError
        A hint makes no sense; `near` lies on no map, but would with longitude and latitude exchanged.
    """
    from roadgeo.running.choosing import take_place
    from roadgeo.running.locating import changed_options
    from roadgeo.running.options import ReadOptions
    from roadgeo.running.passes import Sighting
    from roadgeo.running.pictures import pixels_of, read_picture
    from roadgeo.running.queries import locate_query
    from roadgeo.workflows import locate as locate_mask

    options = _with_hints(options or LocateOptions(), hints, mask)
    if isinstance(take, int) and take < 1:
        raise ValueError(f"take={take!r}: places are counted from 1")
    given = mask if isinstance(mask, RoadMask) else read_picture(mask)
    references = _open(reference)
    if said := say_swapped(options.near, references):
        raise ValueError(said)
    if isinstance(given, RoadMask):
        sighting = Sighting(locate_mask(given, references, options), given)
    else:
        sighting = locate_query(given, references, options, ReadOptions(**pixels_of(mask)))
    if take is not None:
        sighting = sighting.answering(take_place(sighting.location, take, options))
    changed = changed_options(replace(options, truths=(), threads=1), LocateOptions())
    origin = {"options": changed, "reference_digest": digest_of(references, sighting.location.reference)}
    answer = {field.name: getattr(sighting.location, field.name) for field in fields(Location)}
    answer["reason"] = as_keywords(sighting.location.reason)
    indexes = tuple(item.index_of(sighting.location) for item in references)
    picture = None if isinstance(given, RoadMask) or not sighting.of_photograph else given
    photo, pixels = (picture, None) if isinstance(picture, str) else (None, picture)
    return Answer(**{**answer, **origin}, mask=sighting.mask, photo=photo, pixels=pixels, indexes=indexes)


def _with_hints(options: LocateOptions, given: Mapping[str, Any], image: Any) -> LocateOptions:
    """Put what is known where the search looks for it."""
    hints = dict(read_hint(name, value) for name, value in given.items() if value is not None)
    if asked := asked_of_camera(hints):
        from roadgeo.sources.camera import read_stated

        if not isinstance(image, str | os.PathLike):
            raise ValueError('"exif" is for files; give the value, or leave it out')
        try:
            hints.update(read_stated(asked, os.fspath(image)))
        except MaskError as error:
            raise MaskError(as_keywords(str(error))) from error
    return apply_hints(options, hints)


def verify(
    image: str | os.PathLike[str],
    reference: References = (),
    *,
    tolerance: float = 3.0,
    reach: float = 350.0,
    max_turn: float = 6.0,
    crs: str | None = None,
) -> Verified:
    """Check whether a georeferenced image lies where it claims to, as `roadgeo verify` does. Nothing is written.

    >>> verified = roadgeo.verify("drone_footprint.tif", "porto.gpkg")
    >>> verified.verdict
    'agrees'

    Parameters
    ----------
    image : path
        A mask or a photograph with a geotransform, control points or a world file.
    reference : Reference, path or name, or several
        As of `locate`.
    tolerance, reach : float
        It agrees if it is off by less, on average over the frame; nothing beyond `reach` is reported. Metres.
    max_turn : float
        By how much it may be turned, degrees.
    crs : str
        CRS of world files, which name no CRS.

    Returns
    -------
    Verified
        Its `verdict` is "agrees", "off", "unknown" or "error"; its `document` has the displacement and the reason.

    Raises
    ------
    IndexFormatError
        A reference is missing or unusable.
    """
    from roadgeo.matching.checking import CheckOptions
    from roadgeo.running.verifying import VerifyRun, verify_image

    usual = CheckOptions()
    options = replace(usual, tolerance_m=tolerance, search=replace(usual.search, reach_m=reach, turn_deg=max_turn))
    return verify_image(_path(image), _open(reference), VerifyRun(options=options, crs=crs))


@_hinted(FlightHints)
def track(
    frames: Files,
    reference: References = (),
    *,
    motion: str | os.PathLike[str] | None = None,
    unordered: bool = False,
    every: float = 1.0,
    interval: float | None = None,
    start: datetime | str | None = None,
    focal: float | None = None,
    **hints: Unpack[FlightHints],
) -> list[Row]:
    """Follow a flight over the map, frame by frame, as `roadgeo track` does. Nothing is written.

    >>> rows = roadgeo.track("frames", "porto.gpkg", gsd=1.0)
    >>> [row.status for row in rows]
    ['located', 'tracked', 'tracked']

    Parameters
    ----------
    frames : path or paths
        Images in order, folders, patterns, or a video.
    reference : Reference, path or name, or several
        As of `locate`.
    motion : path
        A table of how each frame moved (see `roadgeo track --help`). Default: seen in the frames.
    unordered : bool
        The frames are in no order: all are solved together.
    every, interval : float
        Seconds between the frames that are taken of a video, and between images: by default as EXIF or their names
        state it, where all of them have times, else 1.
    start : datetime or str
        When the first frame was taken.
    focal : float
        Focal length, pixels: the places of the camera are given too.
    **hints
        As of `locate`; each search is stopped after 10 seconds by default.

    Returns
    -------
    list of Row
        One for each frame: its `status` is "located", "tracked", "predicted" or "lost".

    Raises
    ------
    MaskError
        A frame cannot be read, or there are no frames, or they are no files.
    IndexFormatError
        A reference is missing or unusable.
    """
    from roadgeo.flights.frames import FrameOptions, follow_frames
    from roadgeo.flights.motion import read_motion
    from roadgeo.flights.rows import make_rows
    from roadgeo.flights.tracker import TrackOptions, latest

    options = TrackOptions(locate=_with_hints(LocateOptions(), {"time_limit": 10.0, **hints}, None))
    moved = None if motion is None else read_motion(_path(motion))
    reading = FrameOptions(gsd_m=_hint("gsd", hints.get("gsd")), motion=moved, every_s=every, interval_s=interval)
    paths, begun = _paths(frames), read_moment(start) if isinstance(start, str) else start
    opened: Any = _open(reference)
    tracked = latest(follow_frames(paths, reading, opened, options, unordered))
    if not tracked:
        raise MaskError(f"no frames in {', '.join(paths)}")
    return make_rows(tracked, begun, _hint("focal", focal))


def vectorize(image: Picture, *, gsd: float | tuple[float, float] | str | None = None) -> nx.MultiGraph:
    """Return the roads that are seen in a mask or a photograph, as `roadgeo vectorize` shows them.

    >>> graph = roadgeo.vectorize("drone.png")
    >>> graph.number_of_edges() > 100
    True

    Parameters
    ----------
    image : path, array, PIL image, xarray DataArray or rasterio dataset
        As of `locate`.
    gsd : float or (float, float)
        Metres per pixel, as of `locate`: photographs are shown to the network at its own.

    Returns
    -------
    networkx.MultiGraph
        Pixels (column, row) of the image: nodes with `x` and `y`, edges with `geometry` and `length`.

    Raises
    ------
    MaskError
        It cannot be read, or shows no roads.
    """
    from roadgeo.geometry.mask import plane_to_pixel
    from roadgeo.matching.scene import trace_query
    from roadgeo.running.options import ReadOptions
    from roadgeo.running.pictures import read_picture
    from roadgeo.running.queries import read_roads

    roads = read_roads(read_picture(image), _hint("gsd", gsd), ReadOptions())
    _, graph = trace_query(roads.mask)
    return graph.to_networkx(
        lambda xy: roads.coarser * plane_to_pixel(xy),
        name=os.fspath(image) if isinstance(image, str | os.PathLike) else "array",
    )


def _hint(name: str, value: Any) -> Any:
    hint = None if value is None else read_hint(name, value)[1]
    if hint == STATED:
        raise ValueError(f"{name}: {STATED!r} is for `locate`; give the value, or leave it out")
    return hint


def _open(reference: References) -> list[AnyReference]:
    """Open what is not open yet; nothing named: all of the library."""
    from roadgeo.reference.opening import open_reference, open_references

    opened = Reference | ShardedReference
    one = isinstance(reference, opened | str | bytes | os.PathLike) or not isinstance(reference, Iterable)
    given: Any = [reference] if one else reference
    return [item if isinstance(item, opened) else open_reference(item) for item in given] or open_references(())
