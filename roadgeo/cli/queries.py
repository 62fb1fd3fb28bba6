"""Options of the query masks to draw, for `simulate` and `evaluate`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click

from roadgeo._options import OTHERS, option
from roadgeo.matching.hints import read_gsd, read_numbers, read_range

if TYPE_CHECKING:
    from roadgeo.evaluation.simulation import SimulationOptions

__all__ = ["Queries", "query_sets"]


def _read_angles(text: str) -> tuple[float, float]:
    low, high = (read_numbers(text, "LO:HI in degrees", (1, 2)) * 2)[:2]
    if not -360 <= low <= high <= 360:
        raise ValueError(f"got {text!r}: LO must not be above HI, both within ±360; expected LO:HI")
    return low, high


# fmt: off
@dataclass(frozen=True, kw_only=True)
class Queries:
    """Which masks are drawn."""

    count: int | None = option("-n --count", "N", OTHERS, "Masks per noise model.  [default: 40]", limits=(1, None))
    noise: tuple[Literal["clean", "segmented", "poor"], ...] = option("--noise", None, OTHERS,
        "What goes wrong in the masks; repeat it for several.",
        default=("clean", "segmented", "poor"), show_default=True)
    roads: Path | None = option("--roads", "FILE", OTHERS,
        "Draw the roads of this file, another map of the place, in place of the reference's own.",
        type=click.Path(exists=True, path_type=Path))
    gsd: tuple[float, float] = option("--gsd", "SIZE|LO:HI", OTHERS,
        "Metres per pixel at the centre.", read=read_gsd, default="0.7:1.4", show_default=True)
    tilt: tuple[float, float] = option("--tilt", "LO:HI", OTHERS,
        "Angle of the optical axis from the vertical, degrees.", read=_read_angles, default="0:30", show_default=True)
    heading: tuple[float, float] = option("--heading", "LO:HI", OTHERS,
        "Where the image's up points, degrees from north.", read=_read_angles, default="0:360", show_default=True)
    size: int = option("--size", "PX", OTHERS,
        "Side of a mask, pixels.", limits=(64, 20_000), default=1500, show_default=True)
    window: float | None = option("--window", "METRES", OTHERS, "Side on the ground, in place of --size.",
        limits=(10, None), rare=True)
    focal: float | None = option("--focal", "PX", OTHERS, "Focal length in pixels.  [default: the side]",
        limits=(1, None))
    intersections: tuple[float, float] = option("--intersections", "LO:HI", OTHERS,
        "How many a mask must show.", read=read_range, default="30:1000000", show_default=True, rare=True)
    road_width: tuple[float, float] = option("--road-width", "LO:HI", OTHERS,
        "Width of a street, metres.", read=read_range, default="8:11", show_default=True, rare=True)
    mirrored: int = option("--mirrored", "N", OTHERS,
        "Draw so many mirrored masks besides, which have no place and must be refused.",
        limits=(0, None), default=0, rare=True)
    seed: int = option("--seed", "N", OTHERS,
        "Other seeds draw other masks.", limits=(0, None), default=0, show_default=True, rare=True)
# fmt: on


def query_sets(asked: Queries) -> tuple[tuple[SimulationOptions, int], ...]:
    """Turn the options into sets of queries, one per noise model, and one of mirrored masks where some are wanted."""
    from roadgeo.evaluation.noise import NOISE_MODELS
    from roadgeo.evaluation.simulation import SimulationOptions, ViewOptions

    fewest, most = asked.intersections
    view = ViewOptions(
        (asked.size, asked.size),
        asked.window,
        asked.gsd,
        asked.tilt,
        asked.heading,
        asked.focal,
        (int(fewest), int(most)),
        asked.road_width,
    )
    kinds = dict.fromkeys(asked.noise)
    sets = [(SimulationOptions(view, NOISE_MODELS[name], name, asked.seed), asked.count or 40) for name in kinds]
    if asked.mirrored:
        noise = NOISE_MODELS[asked.noise[0]]
        sets.append((SimulationOptions(view, noise, "mirrored", asked.seed, mirrored=True), asked.mirrored))
    return tuple(sets)
