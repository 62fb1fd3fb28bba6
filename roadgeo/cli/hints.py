"""What the user knows of the camera: options that `locate` and `evaluate` share, under the names of their fields."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import click

from roadgeo.cli.parameters import CAMERA, HEADING, NEAR, RANGE, WITHIN

if TYPE_CHECKING:
    from roadgeo.reference.reference import AnyReference
    from roadgeo.workflows import LocateOptions

__all__ = ["HINTS", "hint_options", "make_options", "refuse_swapped"]

Command = TypeVar("Command", bound=Callable[..., Any])

#: Parameter: its option on the command line, and what else click is told. All but `near` and `within` are fields of
#: `CameraOptions`.
HINTS: dict[str, tuple[str, dict[str, Any]]] = {
    "gsd_m": (
        "--gsd",
        {"metavar": "LO:HI", "type": RANGE, "help": "Metres per pixel at the middle. Default: 0.1:12."},
    ),
    "max_tilt_deg": (
        "--max-tilt",
        {
            "metavar": "DEG",
            "type": click.FloatRange(0, 80),
            "help": "Greatest angle of the camera from the vertical. Default: 60.",
        },
    ),
    "focal_px": (
        "--camera",
        {
            "metavar": "PIXELS|exif",
            "type": CAMERA,
            "help": "Focal length in pixels of the mask, or exif: as the photograph given by --image (else the mask)"
            " says.",
        },
    ),
    "near": (
        "--near",
        {
            "metavar": "LON,LAT,RADIUS",
            "type": NEAR,
            "help": "The middle lies within RADIUS metres of this place.",
        },
    ),
    "within": (
        "--within",
        {
            "metavar": "AREA",
            "type": WITHIN,
            "help": "The middle lies in this country or state, or within WEST,SOUTH,EAST,NORTH in degrees.",
        },
    ),
    "heading_deg": (
        "--heading",
        {
            "metavar": "DEG[+-DEG]",
            "type": HEADING,
            "help": "Direction of the image's up, clockwise from north: 90+-10. Default of the second number: 10.",
        },
    ),
    "north_up": (
        "--north-up",
        {
            "is_flag": True,
            "help": "The image's up is north: grid north of the reference, within 5 degrees.",
        },
    ),
}


def hint_options(*names: str, **renamed: str) -> Callable[[Command], Command]:
    """Add options for hints, all of them if none is named; `renamed` gives some another name on the command line."""

    def add(command: Command) -> Command:
        for name in reversed(names or tuple(HINTS)):
            option, settings = HINTS[name]
            command = click.option(renamed.get(name, option), name, **settings)(command)
        return command

    return add


def refuse_swapped(near: tuple[float, float, float] | None, references: Sequence[AnyReference]) -> None:
    """Ask what is meant where a place lies on no map, but would with longitude and latitude exchanged.

    Raises
    ------
    click.UsageError
        It is so.
    """
    from roadgeo.reference.reference import swapped_near

    meant = None if near is None else swapped_near(near, references)
    if near is not None and meant is not None:
        raise click.UsageError(
            f"--near={near[0]:.9g},{near[1]:.9g},{near[2]:g} lies on none of the maps; longitude comes first:"
            f" did you mean --near={meant[0]:.9g},{meant[1]:.9g},{meant[2]:g}?"
        )


def make_options(
    method: Literal["auto", "pair"],
    time_limit_s: float | None,
    hints: dict[str, Any],
    effort: Literal["quick", "full"] = "full",
) -> LocateOptions:
    """Put what was given in its place among the options of all stages; the rest stays as it is.

    Raises
    ------
    click.UsageError
        The paper's method knows no hints.
    """
    from dataclasses import replace

    from roadgeo.workflows import LocateOptions

    known = {name: value for name, value in hints.items() if value is not None and value is not False}
    if method == "pair" and known:
        raise click.UsageError(
            "--method pair knows no --camera, --gsd, --heading, --max-tilt, --near, --north-up or --within:"
            " leave them out."
        )
    default = LocateOptions()
    near, within = known.pop("near", None), known.pop("within", None)
    known = {name: value for name, value in known.items() if value != "exif"}
    match = replace(default.match, camera=replace(default.match.camera, **known), within=within)
    search, pair = default.search, default.pair
    if time_limit_s is not None:
        search, pair = replace(search, time_limit_s=time_limit_s), replace(pair, time_limit_s=time_limit_s)
    return replace(default, method=method, near=near, effort=effort, match=match, search=search, pair=pair)
