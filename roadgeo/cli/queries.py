"""Options of the query masks to draw, for `simulate` and `evaluate`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from roadgeo.cli.options import GSD, OTHERS, RANGE, Read, each, row
from roadgeo.matching.hints import read_numbers

if TYPE_CHECKING:
    from roadgeo.evaluation.simulation import SimulationOptions

__all__ = ["QUERY_OPTIONS", "query_options", "query_sets"]


def _read_angles(text: str) -> tuple[float, float]:
    low, high = (read_numbers(text, "LO:HI in degrees", (1, 2)) * 2)[:2]
    if not -360 <= low <= high <= 360:
        raise ValueError(f"got {text!r}: LO must not be above HI, both within ±360; expected LO:HI")
    return low, high


#: Degrees, least and greatest.
ANGLES = Read("angles", _read_angles)

#: Adds the options that `query_sets` takes.
query_options = each((
    row("-n --count", "N", OTHERS, "Masks per noise model.  [default: 40]", type=click.IntRange(1)),
    row("--noise", ("clean", "segmented", "poor"), OTHERS,
        "What goes wrong in the masks; repeat it for several.",
        multiple=True, default=["clean", "segmented", "poor"], show_default=True),
    row("--roads", "FILE", OTHERS,
        "Draw the roads of this file, another map of the place, in place of the reference's own.",
        type=click.Path(exists=True, path_type=Path)),
    row("--gsd", "SIZE|LO:HI", OTHERS,
        "Metres per pixel at the centre.", type=GSD, default="0.7:1.4", show_default=True),
    row("--tilt", "LO:HI", OTHERS,
        "Angle of the optical axis from the vertical, degrees.", type=ANGLES, default="0:30", show_default=True),
    row("--heading", "LO:HI", OTHERS,
        "Where the image's up points, degrees from north.", type=ANGLES, default="0:360", show_default=True),
    row("--size", "PX", OTHERS,
        "Side of a mask, pixels.", type=click.IntRange(64, 20_000), default=1500, show_default=True),
    row("--window", "METRES", OTHERS, "Side on the ground, in place of --size.", type=click.FloatRange(10), rare=True),
    row("--focal", "PX", OTHERS, "Focal length in pixels.  [default: the side]", type=click.FloatRange(1)),
    row("--intersections", "LO:HI", OTHERS,
        "How many a mask must show.", type=RANGE, default="30:1000000", show_default=True, rare=True),
    row("--road-width", "LO:HI", OTHERS,
        "Width of a street, metres.", type=RANGE, default="8:11", show_default=True, rare=True),
    row("--mirrored", "N", OTHERS,
        "Draw so many masks turned over besides, which have no place and must be refused.",
        type=click.IntRange(0), default=0, rare=True),
    row("--seed", "N", OTHERS,
        "Other seeds draw other masks.", type=click.IntRange(0), default=0, show_default=True, rare=True),
))  # fmt: skip


#: Names of the parameters of `query_sets`, and of `--roads`.
QUERY_OPTIONS = {
    *("count", "noise", "roads", "gsd", "tilt", "heading", "size", "window", "focal"),
    *("intersections", "road_width", "mirrored", "seed"),
}


#: Options of `ViewOptions` by their names there.
_VIEW = {
    "window_m": "window",
    "gsd_m": "gsd",
    "tilt_deg": "tilt",
    "heading_deg": "heading",
    "focal_px": "focal",
    "road_width_m": "road_width",
}


def query_sets(options: Mapping[str, Any]) -> tuple[tuple[SimulationOptions, int], ...]:
    """Turn the options into sets of queries, one per noise model, and one of mirrored masks where some are wanted."""
    from roadgeo.evaluation.noise import NOISE_MODELS
    from roadgeo.evaluation.simulation import SimulationOptions, ViewOptions

    fewest, most = options["intersections"]
    given: dict[str, Any] = {field: options[name] for field, name in _VIEW.items()}
    view = ViewOptions((options["size"],) * 2, intersections=(int(fewest), int(most)), **given)
    noise, seed, count = options["noise"], options["seed"], options["count"] or 40
    sets = [(SimulationOptions(view, NOISE_MODELS[name], name, seed), count) for name in dict.fromkeys(noise)]
    if options["mirrored"]:
        turned = SimulationOptions(view, NOISE_MODELS[noise[0]], "mirrored", seed, mirrored=True)
        sets.append((turned, options["mirrored"]))
    return tuple(sets)
