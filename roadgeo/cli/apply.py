"""`roadgeo apply`: options, one call, printing."""

from __future__ import annotations

from dataclasses import dataclass

from roadgeo._options import OTHERS, option, part, take
from roadgeo.cli.accuracy import tell_accuracy
from roadgeo.cli.options import Shared, Verbosity, argument, command
from roadgeo.cli.printing import echo, tell
from roadgeo.outputs.options import ImageOptions
from roadgeo.storage.files import make_folder

__all__ = ["apply_command"]


# fmt: off
@dataclass(frozen=True, kw_only=True)
class Apply:
    """The parameters of `roadgeo apply`."""

    location: str = argument("LOCATION.json")
    pictures: tuple[str, ...] = argument("PICTURE...", many=True)
    out_dir: str = take(Shared, "out_dir")
    stretch: bool = option("--stretch", "", OTHERS,
        "The picture's sides may be in another proportion: it shows the same ground all the same, as a scan does whose "
        "pixels are not square.")
    products: tuple[str, ...] = take(Shared, "products", group=OTHERS,
        help="Write a further form, as of `roadgeo locate`: points, gcps, geojson, kmz ... Repeatable.")
    image: ImageOptions = part(ImageOptions, "crs", "resolution", "resampling", "compression", rare=False)
    verbosity: Verbosity = part(Verbosity, "quiet")
# fmt: on


@command("apply", Apply)
def apply_command(asked: Apply) -> int:
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
    from roadgeo.running.applying import apply_location

    try:
        place = read_location(asked.location)
    except NotLocatedError as error:
        echo(str(error), err=True)
        return NOT_LOCATED
    make_folder(asked.out_dir)
    for path in apply_location(place, asked.pictures, asked.out_dir, asked.image, asked.products, asked.stretch):
        tell(f"wrote {path}")
    tell_accuracy([place.to_dict()], asked.image.crs)
    return 0
