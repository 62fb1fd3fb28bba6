"""Options of the query masks to draw, for `simulate` and `evaluate`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from roadgeo.cli.options import GSD, RANGE, Read, option
from roadgeo.matching.hints import read_numbers

if TYPE_CHECKING:
    from roadgeo.evaluation.simulation import SimulationOptions

__all__ = ["QUERY_OPTIONS", "query_options", "query_sets"]

Command = TypeVar("Command", bound=Callable[..., Any])


def _read_angles(text: str) -> tuple[float, float]:
    low, high = (read_numbers(text, "LO:HI in degrees", (1, 2)) * 2)[:2]
    if not -360 <= low <= high <= 360:
        raise ValueError(f"got {text!r}: LO must not be above HI, both within ±360; expected LO:HI")
    return low, high


#: Degrees, least and greatest.
ANGLES = Read("angles", _read_angles)

_OPTIONS = [
    option(
        "-n",
        "--count",
        metavar="N",
        type=click.IntRange(1),
        help="Masks per noise model.  [default: 40]",
    ),
    option(
        "--noise",
        type=click.Choice(["clean", "segmented", "poor"]),
        multiple=True,
        default=["clean", "segmented", "poor"],
        show_default=True,
        help="What goes wrong in the masks; repeat it for several.",
    ),
    option(
        "--roads",
        metavar="FILE",
        type=click.Path(exists=True, path_type=Path),
        help="Draw the roads of this file, another map of the place, in place of the reference's own.",
    ),
    option(
        "--gsd",
        metavar="SIZE|LO:HI",
        type=GSD,
        default="0.7:1.4",
        show_default=True,
        help="Metres per pixel at the centre.",
    ),
    option(
        "--tilt",
        metavar="LO:HI",
        type=ANGLES,
        default="0:30",
        show_default=True,
        help="Of the optical axis from the vertical, degrees.",
    ),
    option(
        "--heading",
        metavar="LO:HI",
        type=ANGLES,
        default="0:360",
        show_default=True,
        help="Where the image's up points, degrees from north.",
    ),
    option(
        "--size",
        metavar="PX",
        type=click.IntRange(64, 20_000),
        default=1500,
        show_default=True,
        help="Side of a mask, pixels.",
    ),
    option(
        "--window",
        type=click.FloatRange(10),
        metavar="METRES",
        help="Side on the ground, in place of --size.",
    ),
    option("--focal", type=click.FloatRange(1), metavar="PX", help="Focal length in pixels.  [default: the side]"),
    option(
        "--intersections",
        metavar="LO:HI",
        type=RANGE,
        default="30:1000000",
        show_default=True,
        help="How many a mask must show.",
    ),
    option(
        "--road-width",
        metavar="LO:HI",
        type=RANGE,
        default="8:11",
        show_default=True,
        help="Of a street, metres.",
    ),
    option(
        "--mirrored",
        metavar="N",
        type=click.IntRange(0),
        default=0,
        help="Draw so many masks turned over besides, which have no place and must be refused.",
    ),
    option(
        "--seed",
        metavar="N",
        type=click.IntRange(0),
        default=0,
        show_default=True,
        help="Other seeds draw other masks.",
    ),
]


#: Names of the parameters of `query_sets`, and of `--roads`.
QUERY_OPTIONS = {
    *("count", "noise", "roads", "gsd", "tilt", "heading", "size", "window", "focal"),
    *("intersections", "road_width", "mirrored", "seed"),
}


def query_options(command: Command) -> Command:
    """Add the options that `query_sets` takes."""
    for add in reversed(_OPTIONS):
        command = add(command)
    return command


def query_sets(options: Mapping[str, Any]) -> tuple[tuple[SimulationOptions, int], ...]:
    """Turn the options into sets of queries, one per noise model, and one of mirrored masks where some are wanted."""
    from roadgeo.evaluation.noise import NOISE_MODELS
    from roadgeo.evaluation.simulation import SimulationOptions, ViewOptions

    fewest, most = options["intersections"]
    view = ViewOptions(
        size_px=(options["size"], options["size"]),
        window_m=options["window"],
        gsd_m=options["gsd"],
        tilt_deg=options["tilt"],
        heading_deg=options["heading"],
        focal_px=options["focal"],
        intersections=(int(fewest), int(most)),
        road_width_m=options["road_width"],
    )
    noise, seed, count = options["noise"], options["seed"], options["count"] or 40
    sets = [(SimulationOptions(view, NOISE_MODELS[name], name, seed), count) for name in dict.fromkeys(noise)]
    if options["mirrored"]:
        turned = SimulationOptions(view, NOISE_MODELS[noise[0]], "mirrored", seed, mirrored=True)
        sets.append((turned, options["mirrored"]))
    return tuple(sets)
