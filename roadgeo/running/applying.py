"""Another picture of a frame that was located: put on the map by the location that is written already."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np

from roadgeo.errors import OutputError
from roadgeo.geometry.mask import RoadMask
from roadgeo.location import Location
from roadgeo.outputs.options import ImageOptions
from roadgeo.outputs.paths import output_paths
from roadgeo.outputs.placing import placement_of
from roadgeo.outputs.registry import FOOTPRINT, MATCH_POINTS, MATCHES, Output, find_outputs
from roadgeo.outputs.subject import Subject
from roadgeo.storage.files import replacing
from roadgeo.storage.rasters import raster_size

__all__ = ["apply_location"]


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
    location = _stretched(location, picture) if stretch else location
    width, height = placement_of(location).size
    mask = RoadMask(np.zeros((height, width), np.bool_), name=str(picture))
    paths = output_paths(folder, picture.stem)
    subject = Subject(location, mask, paths, image, picture)
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
    place, size = placement_of(location), raster_size(picture)
    scale = np.diag([place.size[0] / size[0], place.size[1] / size[1], 1.0])
    return replace(location, places=(replace(place.in_pixels(size, scale), lens_k1=0.0),))
