"""Query masks whose place is known: views of a road map by a pinhole camera, drawn with the faults of real masks.

Everything is drawn from seeds, query by query: the k-th mask does not depend on how many are drawn, nor by whom.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from roadgeo._arrays import AnyArray
from roadgeo.errors import RoadSourceError
from roadgeo.evaluation.landscape import Landscape, visible_intersections
from roadgeo.evaluation.noise import NoiseModel, Range, draw_mask
from roadgeo.evaluation.truth import Truth
from roadgeo.geometry.frame import polygon_area
from roadgeo.geometry.pinhole import View, make_view, sees_ground

__all__ = [
    "SimulatedQuery",
    "SimulationOptions",
    "ViewOptions",
    "draw_view",
    "footprint_area",
    "simulate",
    "simulate_query",
]

#: Draws of a view before a query is given up.
MAX_TRIES = 4000

_HORIZON = "every view that was drawn holds the horizon; allow less tilt or a longer focal length"


@dataclass(frozen=True)
class ViewOptions:
    """Which views are drawn. A range (low, high) is drawn from anew for each query.

    Attributes
    ----------
    size_px : (int, int)
        Width and height of the frame.
    window_m : float or None
        Where given, the frame is a square of this side on the ground (at the sampling of its centre) instead.
    gsd_m : range
        Metres per pixel across the optical axis at the frame's centre; drawn log-uniformly.
    tilt_deg : range
        Angle of the optical axis from the vertical, towards any direction.
    heading_deg : range
        Direction of the image's up at its centre, clockwise from north.
    focal_px : float or None
        Focal length in pixels. None: the frame's longer side, a field of view of 53 degrees.
    intersections : (int, int)
        Least and greatest number of intersections that the frame must show with three branches or more.
    road_width_m : range
        Width of a street as drawn.
    road_width_px : range or None
        Where given, streets are drawn so wide instead, near and far alike.
    """

    size_px: tuple[int, int] = (1500, 1500)
    window_m: float | None = None
    gsd_m: Range = (1.0, 1.0)
    tilt_deg: Range = (0.0, 0.0)
    heading_deg: Range = (0.0, 0.0)
    focal_px: float | None = None
    intersections: tuple[int, int] = (30, 1_000_000)
    road_width_m: Range = (8.0, 11.0)
    road_width_px: Range | None = None


@dataclass(frozen=True)
class SimulationOptions:
    """A query set.

    Attributes
    ----------
    kind : str
        Names of the queries in tables and files.
    mirrored : bool
        Turn each mask over. A camera above the ground never shows that, so such a mask has no place on any map, and yet
        looks like one that has: locating it is an error.
    """

    view: ViewOptions = field(default_factory=ViewOptions)
    noise: NoiseModel = field(default_factory=NoiseModel)
    kind: str = "clean"
    seed: int = 0
    mirrored: bool = False


@dataclass(frozen=True)
class SimulatedQuery:
    """A mask ((H, W) uint8, roads 255) and where it was taken."""

    mask: AnyArray
    truth: Truth


def simulate(landscape: Landscape, options: SimulationOptions, count: int) -> Iterator[SimulatedQuery]:
    """Draw queries 0 to `count` - 1 of a set."""
    for k in range(count):
        yield simulate_query(landscape, options, k)


def simulate_query(
    landscape: Landscape, options: SimulationOptions, k: int, center: tuple[float, float] | None = None
) -> SimulatedQuery:
    """Draw the k-th query of a set: always the same one for the same landscape and options.

    The frame's middle lies at `center`, if that is given, however few intersections it shows.

    Raises
    ------
    RoadSourceError
        The map has no place for such a view.
    """
    rng = np.random.default_rng([options.seed, zlib.crc32(options.kind.encode()), k])
    if center is not None:
        views = (_view_at(center, options.view, rng) for _ in range(MAX_TRIES))
        view = next(filter(sees_ground, views), None)
        if view is None:
            raise RoadSourceError(_HORIZON)
        return _draw_query(landscape, view, options, k, rng)
    least, most = options.view.intersections
    for _ in range(MAX_TRIES):
        query = _draw_query(landscape, draw_view(landscape, options.view, rng), options, k, rng)
        if least <= query.truth.properties["n_intersections"] <= most:
            return query
    raise RoadSourceError(
        f"no mask with {_range_text(least, most)} intersections left could be drawn; ask for fewer or for less noise"
    )


def draw_view(landscape: Landscape, options: ViewOptions, rng: np.random.Generator) -> View:
    """Draw a view that lies on covered ground and holds enough intersections of the map.

    Raises
    ------
    RoadSourceError
        The map has no such place.
    """
    low, high = landscape.bounds
    holds_horizon = True
    for tries in range(2 * MAX_TRIES):
        if tries < MAX_TRIES or not len(landscape.intersections):
            x, y = rng.uniform(low, high)
        else:  # towns far apart: hardly any ground between their bounds is covered
            x, y = landscape.intersections[rng.integers(len(landscape.intersections))]
        view = _view_at((x, y), options, rng)
        if not sees_ground(view):
            continue
        holds_horizon = False
        if not landscape.covers(view.footprint):
            continue
        if options.intersections[0] <= len(visible_intersections(landscape, view)):
            return view
    if holds_horizon:
        raise RoadSourceError(_HORIZON)
    raise RoadSourceError(
        f"no view that lies on the map and shows {_range_text(*options.intersections)} intersections was found in"
        f" {2 * MAX_TRIES} draws; ask for fewer, for another window, or give a larger map"
    )


def _range_text(least: int, most: int) -> str:
    return f"{least} or more" if most >= 1_000_000 else f"{least} to {most}"


def footprint_area(options: ViewOptions, draws: int = 200) -> float:
    """Average the ground that views show, square metres, over those that the options allow.

    Raises
    ------
    RoadSourceError
        Every view that the options allow holds the horizon.
    """
    rng = np.random.default_rng(0)
    views = [view for view in (_view_at((0.0, 0.0), options, rng) for _ in range(draws)) if sees_ground(view)]
    if not views:
        raise RoadSourceError(_HORIZON)
    return float(np.mean([polygon_area(view.footprint) for view in views]))


def _view_at(center: tuple[float, float], options: ViewOptions, rng: np.random.Generator) -> View:
    """Draw sampling, tilt and heading of a view of `center`."""
    gsd = float(np.exp(rng.uniform(*np.log(options.gsd_m))))
    return make_view(
        center,
        options.size_px if options.window_m is None else (round(options.window_m / gsd),) * 2,
        gsd,
        rng.uniform(*options.tilt_deg),
        rng.uniform(0.0, 360.0),
        rng.uniform(*options.heading_deg),
        options.focal_px,
    )


def _draw_query(
    landscape: Landscape, view: View, options: SimulationOptions, k: int, rng: np.random.Generator
) -> SimulatedQuery:
    in_pixels = options.view.road_width_px is not None
    width = options.view.road_width_px or options.view.road_width_m
    mask, drawn = draw_mask(landscape, view, options.noise, width, rng, in_pixels)
    matrix = landscape.plane.to_crs_matrix() @ view.homography.matrix
    truth = Truth(
        file=f"{options.kind}/q_{k:04d}.png",
        kind=options.kind,
        homography=matrix / matrix[2, 2],
        crs=landscape.plane.crs,
        size=view.size_px,
        on_map=not options.mirrored,
        properties={
            "gsd_m": view.gsd_m,
            "tilt_deg": view.tilt_deg,
            "tilt_azimuth_deg": view.tilt_azimuth_deg,
            "heading_deg": view.heading_deg,
            "focal_px": view.focal_px,
            **drawn,
        },
    )
    return SimulatedQuery(np.ascontiguousarray(mask[:, ::-1]) if options.mirrored else mask, truth)
