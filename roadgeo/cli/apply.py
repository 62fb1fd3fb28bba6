"""`roadgeo apply`: options, one call, printing."""

from __future__ import annotations

from typing import Any

import click

from roadgeo.cli.accuracy import tell_accuracy
from roadgeo.cli.folders import make_folder
from roadgeo.cli.parameters import CRS, Plugin, out_dir_option
from roadgeo.cli.printing import echo
from roadgeo.outputs.registry import offered

__all__ = ["apply_command"]


@click.command("apply", short_help="Put another picture of a located frame on the map.")
@click.argument("location", metavar="LOCATION.json", type=click.Path())
@click.argument("pictures", metavar="PICTURE...", nargs=-1, required=True, type=click.Path())
@out_dir_option()
@click.option(
    "--stretch",
    is_flag=True,
    help="The picture's sides may be in another proportion: it shows the same ground all the same, as a scan does whose"
    " pixels are not square.",
)
@click.option(
    "--also",
    "products",
    metavar="NAME",
    type=Plugin("roadgeo.outputs", names=offered),
    multiple=True,
    help="Write a further form, as of `roadgeo locate`: points, gcps, iiif, geojson, kmz ... Repeatable.",
)
@click.option(
    "--crs", metavar="CRS", type=CRS, help="CRS of what is drawn, such as EPSG:3857. Default: the location's own."
)
@click.option(
    "--resolution",
    metavar="SIZE",
    type=click.FloatRange(min=0, min_open=True),
    help="Pixel size of what is drawn, in units of its CRS. Default: the picture's own.",
)
@click.option(
    "--resampling",
    type=click.Choice(["nearest", "bilinear", "cubic", "lanczos"]),
    default="cubic",
    show_default=True,
    help="How values between pixels are found; nearest for classes.",
)
@click.option(
    "--compression",
    type=click.Choice(["deflate", "zstd", "jpeg", "webp"]),
    default="deflate",
    show_default=True,
    help="Of what is drawn; jpeg and webp make photographs of 8 bits five times smaller, and lose some detail.",
)
@click.option("-q", "--quiet", is_flag=True, help="Say nothing but errors.")
def apply_command(location: str, pictures: tuple[str, ...], out_dir: str, quiet: bool, **given: Any) -> int:
    """Put PICTUREs on the map by the place that one of their frame was found at.

    LOCATION.json is what `roadgeo locate` wrote. A PICTURE is another scan, band, exposure or analysis of the same
    frame, of any number of pixels: for each, PICTURE_footprint.tif is drawn on the map (Cloud Optimized GeoTIFF). No
    roads are looked for, and no reference is needed.

    \b
    Examples:
      roadgeo apply photo_mask_location.json infrared.tif
      roadgeo apply photo_mask_location.json band*.tif --out-dir bands --crs EPSG:3857
      roadgeo apply sheet_location.json fine_scan.tif --also iiif --also points

    Exit status: 0 all well, 3 LOCATION.json tells of no sure place, 1 error, 2 usage.
    """
    from roadgeo.cli import NOT_LOCATED
    from roadgeo.errors import NotLocatedError
    from roadgeo.outputs.orthophoto import ImageOptions
    from roadgeo.running.applying import apply_location, read_location

    try:
        place = read_location(location)
    except NotLocatedError as error:
        echo(str(error), err=True)
        return NOT_LOCATED
    make_folder(out_dir)
    image = ImageOptions(given["crs"], given["resolution"], given["resampling"], compression=given["compression"])
    for path in apply_location(place, pictures, out_dir, image, given["products"], given["stretch"]):
        if not quiet:
            echo(f"wrote {path}")
    if not quiet:
        tell_accuracy([place.to_dict()], given["crs"])
    return 0
