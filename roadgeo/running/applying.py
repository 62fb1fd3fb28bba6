"""Another picture of a frame that was located: put on the map by the location that is written already."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from roadgeo._arrays import FloatArray
from roadgeo.errors import CrsError, MaskError, NotLocatedError, OutputError
from roadgeo.geometry.frame import Frame, polygon_area
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.mask import RoadMask
from roadgeo.geometry.transformation import LONLAT, exactness
from roadgeo.location import SCHEMA, Camera, Location, Place
from roadgeo.outputs.orthophoto import ImageOptions
from roadgeo.outputs.paths import output_paths
from roadgeo.outputs.registry import FOOTPRINT, MATCH_POINTS, MATCHES, Output, find_outputs
from roadgeo.outputs.subject import Subject
from roadgeo.storage.crs import name_crs
from roadgeo.storage.files import replacing
from roadgeo.storage.rasters import raster_size

__all__ = ["apply_location", "read_location"]

_MAX_BYTES = 64 << 20

#: How far the corners by the homography may lie from the footprint, in lengths of its side; and pixel sizes, metres.
_TOLERANCE, _GSD_M = 1e-5, (1e-4, 1e4)


def read_location(path: str | os.PathLike[str]) -> Location:
    """Read the place in a `*_location.json`; the matches behind it are not stored.

    Raises
    ------
    MaskError
        It is no such file.
    NotLocatedError
        The mask has no place.
    """
    name = os.fspath(path)
    try:
        document = _read_document(Path(path))
        location = None if document.get("homography") is None else _from_document(document)
    except (CrsError, OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise MaskError(
            f"{name}: no location ({error}); give the *_location.json that `roadgeo locate` wrote"
        ) from error
    if location is None or not location.on_map:
        raise NotLocatedError(f"{name}: {document.get('query')} has no sure place: {document.get('reason')}")
    return location


def _read_document(path: Path) -> dict[str, Any]:
    if path.stat().st_size > _MAX_BYTES:
        raise ValueError("too large")
    document = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(document, dict) or document.get("schema") != SCHEMA:
        raise ValueError(f"not of schema {SCHEMA}")
    return document


def _from_document(document: dict[str, Any]) -> Location:
    """Take the place out of a document, checking every number."""
    width, height = (int(side) for side in document["size"])
    if not (0 < width < 10**6 and 0 < height < 10**6):
        raise ValueError(f"a frame of {width} x {height} pixels")
    camera = document.get("camera")
    homography = _array(document["homography"], (3, 3))
    footprint = _array(document["footprint"], (4, 2))
    _require_one_place(homography, footprint, (width, height))
    crs, place = name_crs(str(document["crs"])), _place(document)
    sigma, covariance = document.get("corner_sigma_m"), document.get("corner_covariance_m2")
    return Location(
        str(document["query"]),
        document["status"],
        str(document["reason"]),
        str(document.get("reference") or ""),
        str(document.get("attribution") or ""),
        crs,
        (width, height),
        homography,
        footprint,
        _array(document["footprint_lonlat"], (4, 2)),
        place,
        gsd_m=float(document["gsd_m"]),
        rotation_deg=float(document["rotation_deg"]),
        lens_k1=float(document.get("lens_k1") or 0.0),
        lonlat_accuracy_m=exactness(crs, LONLAT, (place.lon, place.lat)).sigma_m,
        corner_sigma_m=None if sigma is None else _array(sigma, (4,)),
        corner_covariance_m2=None if covariance is None else _array(covariance, (8, 8)),
        log10_odds=document.get("log10_odds"),
        camera=None if camera is None else _camera(camera),
        mirrored=bool(document.get("mirrored")),
    )


def _require_one_place(homography: FloatArray, footprint: FloatArray, size: tuple[int, int]) -> None:
    """Raise where a homography does not take the frame to its footprint, or pixels have no size of this Earth."""
    with np.errstate(all="ignore"):
        corners = Homography(homography)(Frame(*size).corners)
        side = float(np.sqrt(polygon_area(footprint)))
        apart = float(np.abs(corners - footprint).max())
    if not apart <= _TOLERANCE * side:
        raise ValueError("the homography does not lead to the footprint")
    if not _GSD_M[0] <= side / np.sqrt(size[0] * size[1]) <= _GSD_M[1]:
        raise ValueError(f"a frame of {side:g} m")


def _place(document: dict[str, Any]) -> Place:
    x, y, lon, lat = _numbers(document["center"], ("x", "y", "lon", "lat"))
    return Place(x, y, lon, lat, float(document.get("log10_odds") or 0.0))


def _camera(camera: dict[str, Any]) -> Camera:
    names = ("x", "y", "lon", "lat", "height_m", "heading_deg", "pitch_deg", "roll_deg", "focal_px")
    x, y, lon, lat, height, heading, pitch, roll, focal = _numbers(camera, names)
    covariance, rotation = _array(camera["covariance"], (6, 6)), _array(camera["rotation"], (3, 3))
    lens = (focal, float(camera["sigma"]["focal_px"]), str(camera["source"]))
    ground = (camera.get("ground_m"), camera.get("ground_spread_m"))
    return Camera(x, y, lon, lat, height, heading, pitch, roll, *lens, covariance, rotation, *ground)


def _numbers(document: dict[str, Any], names: Sequence[str]) -> list[float]:
    return [float(number) for number in _array([document[name] for name in names], (len(names),))]


def _array(values: Any, shape: tuple[int, ...]) -> FloatArray:
    array = np.array(values, float)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"expected {' x '.join(map(str, shape))} numbers")
    return array


def apply_location(
    location: Location,
    pictures: Sequence[str],
    out_dir: str | os.PathLike[str] = ".",
    image: ImageOptions | None = None,
    products: Sequence[str] = (),
    stretch: bool = False,
) -> list[Path]:
    """Put pictures of a located frame on the map: another scan, band or date, of any number of pixels.

    Parameters
    ----------
    products : sequence of str
        Further outputs, as of `roadgeo locate --also`.
    stretch : bool
        Let a picture's sides be in another proportion than the located frame's: it shows the same ground all the same.

    Returns
    -------
    list of Path
        The files written; for each picture all of them or none.

    Raises
    ------
    MaskError
        A picture cannot be read, or shows another frame.
    OutputError
        A file cannot be written, or an output needs values that a location does not hold.
    """
    outputs = [FOOTPRINT, *find_outputs(products)]
    unfit = [output.name for output in outputs if output in (MATCHES, MATCH_POINTS) or not output.needs_place]
    if unfit:
        raise OutputError(f"{', '.join(unfit)}: shows what a mask was matched by; have `roadgeo locate` write it")
    written: list[Path] = []
    for picture in pictures:
        written += _apply_one(location, Path(picture), Path(out_dir), image or ImageOptions(), outputs, stretch)
    return written


def _apply_one(
    location: Location, picture: Path, folder: Path, image: ImageOptions, outputs: Sequence[Output], stretch: bool
) -> list[Path]:
    frame = _stretched(location, picture) if stretch else location
    assert frame.size is not None  # noqa: S101 - `read_location` gave it
    width, height = frame.size
    mask = RoadMask(np.zeros((height, width), np.bool_), name=str(picture))
    paths = output_paths(folder, picture.stem)
    subject = Subject(frame, mask, paths, image, picture)
    targets = {output: paths.of(output, picture.name) for output in outputs}
    clash = next((path for path in targets.values() if path.resolve() == picture.resolve()), None)
    if clash is not None:
        raise OutputError(f"{clash}: is the picture itself; choose another --out-dir")
    with ExitStack() as files:
        for output, path in targets.items():
            output.write(files.enter_context(replacing(path, sync=False)), subject)
    return list(targets.values())


def _stretched(location: Location, picture: Path) -> Location:
    """Return the location of a frame of a picture's own pixels, each side scaled by itself."""
    from dataclasses import replace

    assert location.size is not None  # noqa: S101
    assert location.homography is not None  # noqa: S101
    size = raster_size(picture)
    scale = np.diag([location.size[0] / size[0], location.size[1] / size[1], 1.0])
    return replace(location, size=size, homography=location.homography @ scale, lens_k1=0.0)
