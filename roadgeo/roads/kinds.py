"""Roads that a mask would show: kinds by OpenStreetMap's `highway` tag and the equivalents of other maps."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Literal, get_args

import numpy as np

from roadgeo._arrays import AnyArray, BoolArray, IntArray

__all__ = [
    "KNOWN_HIGHWAYS",
    "MAIN_CLASSES",
    "NO_ROADS",
    "ROAD_KINDS",
    "RoadKind",
    "drives",
    "highways",
    "in_tunnel",
    "main_ranks",
]

#: From few roads to many. "main": motorways to tertiary roads. "drivable": with residential and other public streets.
#: "vehicles": with service roads and tracks. "all": with footways, cycleways, steps; whatever is a line.
RoadKind = Literal["main", "drivable", "vehicles", "all"]
ROAD_KINDS: tuple[RoadKind, ...] = get_args(RoadKind)

#: Main roads, the greatest first.
MAIN_CLASSES = ("motorway", "trunk", "primary", "secondary", "tertiary")

_MAIN = {name + link for name in MAIN_CLASSES for link in ("", "_link")}
_DRIVABLE = _MAIN | {"residential", "unclassified", "living_street", "road", "residential_link"}
_VEHICLES = _DRIVABLE | {"service", "track", "track_grade1", "track_grade2", "track_grade3", "track_grade4"}
_VEHICLES |= {"track_grade5", "busway", "bus_guideway", "raceway", "escape"}
_PATHS = {"pedestrian", "footway", "cycleway", "path", "bridleway", "steps", "crossing", "via_ferrata", "unknown"}
_MEMBERS: dict[RoadKind, set[str]] = {"main": _MAIN, "drivable": _DRIVABLE, "vehicles": _VEHICLES}
KNOWN_HIGHWAYS = _VEHICLES | _PATHS

#: Lines that carry a `highway` tag and are no road, or none yet.
NO_ROADS = {
    "abandoned", "bus_stop", "construction", "corridor", "demolished", "disused", "elevator", "no", "none", "planned",
    "platform", "proposed", "razed", "rest_area", "services",
}  # fmt: skip

_TUNNELS = {"yes", "true", "t", "1", "tunnel", "avalanche_protector", "is_tunnel"}


def highways(kind: RoadKind) -> list[str] | None:
    """Return the values of `highway` that a kind is made of, sorted; None for "all", which has no list."""
    return sorted(_MEMBERS[kind]) if kind != "all" else None


def drives(values: AnyArray, kind: RoadKind) -> BoolArray:
    """Return which lines are roads of a kind.

    Parameters
    ----------
    values : (L,) object
        Values of `highway`: text, several with semicolons between them, of which one is enough. Lines without a value,
        "", are roads of an unknown kind: all kinds but "main" take them.
    kind : RoadKind

    Returns
    -------
    (L,) bool
    """
    if kind == "all":
        return _each(values, lambda names: not names or bool(names - NO_ROADS))
    members = _MEMBERS[kind]
    return _each(values, lambda names: bool(names & members) if names else kind != "main")


def main_ranks(values: AnyArray) -> IntArray:
    """Return (L,) the rank of each line among main roads, by values of `highway`: 0 for motorways; -1: no main road."""
    ranks = np.full(len(values), -1)
    for rank, name in reversed(list(enumerate(MAIN_CLASSES))):
        ranks[~_each(values, {name, f"{name}_link"}.isdisjoint)] = rank
    return ranks


def in_tunnel(values: AnyArray) -> BoolArray:
    """Return which lines run in a tunnel all the way, by values of `tunnel`, lower case, as in `drives`; (L,) bool."""
    return _each(values, lambda names: bool(names) and names <= _TUNNELS)


def _each(values: AnyArray, test: Callable[[set[str]], bool]) -> BoolArray:
    """Apply a test of a set of names to every value; equal values are tested once."""
    tested = cache(lambda text: test(set(text.split(";")) - {""}))
    return np.array([tested(value) for value in values], bool)
