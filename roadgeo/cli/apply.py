"""`roadgeo apply`: options, one call, printing."""

from __future__ import annotations

from typing import Any

import click

from roadgeo.cli.accuracy import tell_accuracy
from roadgeo.cli.options import OTHERS, Command, Plugin, each, row, take
from roadgeo.cli.printing import echo, tell
from roadgeo.outputs.registry import offered
from roadgeo.storage.files import make_folder

__all__ = ["apply_command"]


_OPTIONS = (
    take("out_dir"),
    row("--stretch", "", OTHERS,
        "The picture's sides may be in another proportion: it shows the same ground all the same, as a scan does whose "
        "pixels are not square."),
    row("--also products", "NAME", OTHERS,
        "Write a further form, as of `roadgeo locate`: points, gcps, geojson, kmz ... Repeatable.",
        type=Plugin(offered), multiple=True),
    take("crs", "resolution", "resampling", "compression", rare=False),
    take("quiet"),
)  # fmt: skip


@click.command("apply", cls=Command, short_help="Put another picture of a located frame on the map.")
@click.argument("location", metavar="LOCATION.json", type=click.Path())
@click.argument("pictures", metavar="PICTURE...", nargs=-1, required=True, type=click.Path())
@each(_OPTIONS)
def apply_command(location: str, pictures: tuple[str, ...], out_dir: str, **given: Any) -> int:
    """Put PICTUREs on the map by the place that one of their frame was found at.

    LOCATION.json is written by `roadgeo locate`. A PICTURE is another scan, band, exposure or analysis of the same
    frame, of any number of pixels: for each, PICTURE_footprint.tif is drawn on the map (Cloud Optimized GeoTIFF). No
    roads are looked for, and no reference is needed.

    \b
    Examples:
      roadgeo apply photo_mask_location.json infrared.tif
      roadgeo apply photo_mask_location.json band*.tif --out-dir bands --crs EPSG:3857
      roadgeo apply sheet_location.json fine_scan.tif --also kmz --also points

    Exit status: 0 all well, 3 LOCATION.json holds no sure place, 1 error, 2 usage.
    """
    from roadgeo.cli import NOT_LOCATED
    from roadgeo.errors import NotLocatedError
    from roadgeo.outputs.location_document import read_location
    from roadgeo.outputs.orthophoto import ImageOptions
    from roadgeo.running.applying import apply_location

    try:
        place = read_location(location)
    except NotLocatedError as error:
        echo(str(error), err=True)
        return NOT_LOCATED
    make_folder(out_dir)
    image = ImageOptions(given["crs"], given["resolution"], given["resampling"], compression=given["compression"])
    for path in apply_location(place, pictures, out_dir, image, given["products"], given["stretch"]):
        tell(f"wrote {path}")
    tell_accuracy([place.to_dict()], given["crs"])
    return 0
