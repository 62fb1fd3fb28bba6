"""Flights whose way is known: overlapping frames of one camera, as road masks, and how each follows from the last.

Frames are views of a road map with the faults of real masks (`noise`). Some roads are hidden in all frames of a
flight, as trees hide them; others are missed in one frame and seen in the next. All is drawn from seeds, flight by
flight.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from roadgeo._arrays import AnyArray, FloatArray
from roadgeo.errors import RoadSourceError
from roadgeo.evaluation.landscape import Landscape, visible_intersections
from roadgeo.evaluation.noise import NoiseModel, Range, draw_mask
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.homography import Homography, shift
from roadgeo.geometry.pinhole import View, make_view, sees_ground
from roadgeo.roads.graph import RoadGraph

__all__ = ["FLIGHT_NOISE", "Flight", "FlightOptions", "simulate_flight", "with_fault"]

#: Draws of a flight before it is given up.
MAX_TRIES = 3000

#: Faults of one frame; `FlightOptions.hidden` holds all frames' faults.
FLIGHT_NOISE = NoiseModel(
    missing=(0.10, 0.15),
    false_roads=(0.02, 0.06),
    blobs=(3, 9),
    holes=(3, 9),
    warp_px=0.8,
    raggedness=0.15,
)


@dataclass(frozen=True)
class FlightOptions:
    """Which flights are drawn. A range (low, high) is drawn from anew for each flight.

    Attributes
    ----------
    size_px : (int, int)
        Width and height of a frame.
    n_frames : (int, int)
    overlap : float
        Share of a frame that the next one shows again.
    gsd_m : range
        Metres per pixel in the middle of the frame; it varies by some hundredths on the way, as height does.
    tilt_deg : range
        Greatest angle of the camera from the vertical, towards any side; it sways by `sway_deg`.
    turn_deg : float
        Standard deviation of the change of course from one frame to the next.
    sway_deg : float
        Standard deviation of how far the camera sways from its usual tilt, in both directions.
    intersections : (int, int)
        Nine of ten frames show as many intersections as this.
    hidden : range
        Share of the streets that all frames miss; `noise` adds those that a single frame misses.
    motion_px : float
        Error of the given motion: standard deviation of a corner's place in the frame before.
    """

    size_px: tuple[int, int] = (640, 480)
    n_frames: tuple[int, int] = (20, 40)
    overlap: float = 0.6
    gsd_m: Range = (0.35, 0.7)
    tilt_deg: Range = (0.0, 20.0)
    turn_deg: float = 3.0
    sway_deg: float = 0.7
    intersections: tuple[int, int] = (2, 8)
    hidden: Range = (0.05, 0.10)
    road_width_m: Range = (7.0, 11.0)
    motion_px: float = 0.7
    noise: NoiseModel = field(default_factory=lambda: FLIGHT_NOISE)
    seed: int = 0


@dataclass(frozen=True)
class Flight:
    """The frames of one flight. Dimension: K frames.

    Attributes
    ----------
    views : tuple of View
        Where each was taken, on the landscape's plane.
    motion : (K, 3, 3) float64
        Measured motion: pixel of a frame to pixel of the frame before; the identity for the first.
    """

    landscape: Landscape
    options: FlightOptions
    number: int
    views: tuple[View, ...]
    motion: FloatArray

    def masks(self) -> Iterator[AnyArray]:
        """Draw the frames one after another, (H, W) uint8, roads 255."""
        rng = _generator(self.options, self.number, "masks")
        seen = replace(self.landscape, graph=self._seen)
        shown = None
        for view in self.views:
            if view is not shown:  # the picture of a link that stands still is the same to the pixel
                shown, mask = view, draw_mask(seen, view, self.options.noise, self.options.road_width_m, rng)[0]
            yield mask

    @cached_property
    def _seen(self) -> RoadGraph:
        """The roads without those that no frame sees."""
        rng = _generator(self.options, self.number, "hidden")
        graph = self.landscape.graph
        kept = np.flatnonzero(rng.random(graph.n_edges) >= rng.uniform(*self.options.hidden))
        return RoadGraph.from_polylines(graph.xy, graph.edges[kept], [graph.polyline(e) for e in kept.tolist()])


def simulate_flight(landscape: Landscape, options: FlightOptions, number: int) -> Flight:
    """Draw one flight: always the same one for the same landscape, options and number.

    Raises
    ------
    RoadSourceError
        The map has no room for such a flight.
    """
    rng = _generator(options, number, "views")
    least, most = options.intersections
    for _ in range(MAX_TRIES):
        views = _draw_views(landscape, options, rng)
        if views is None:
            continue
        seen = np.array([len(visible_intersections(landscape, view)) for view in views])
        if np.mean((seen >= least) & (seen <= most)) >= 0.9:
            return Flight(landscape, options, number, views, _motion(views, options.motion_px, rng))
    raise RoadSourceError(
        f"no flight whose frames show {least} to {most} intersections was found in {MAX_TRIES} draws; give a larger"
        " map, or ask for other ones"
    )


def with_fault(flight: Flight, fault: str, at: int, length: int) -> Flight:
    """Return a flight whose link fails at a frame, for a number of frames.

    `fault`: "frozen", the frame is shown again and again; "missing", no frame comes; "slipped", the aircraft is
    displaced to the right by as far as it flies meanwhile. The flight then goes on.
    """
    views = flight.views
    if fault == "frozen":
        views = (*views[:at], *[views[at]] * length, *views[at + length :])
    elif fault == "missing":
        views = (*views[:at], *views[at + length :])
    else:
        east, north = views[at + length].homography(_middle(flight)) - views[at].homography(_middle(flight))
        views = (*views[:at], *(_moved(view, north, -east) for view in views[at:]))
    rng = _generator(flight.options, flight.number, fault)
    return replace(flight, views=views, motion=_motion(views, flight.options.motion_px, rng))


def _middle(flight: Flight) -> FloatArray:
    return np.array(flight.options.size_px) / 2.0


def _moved(view: View, east_m: float, north_m: float) -> View:
    return replace(view, homography=Homography(shift(east_m, north_m) @ view.homography.matrix))


def _generator(options: FlightOptions, number: int, what: str) -> np.random.Generator:
    return np.random.default_rng([options.seed, zlib.crc32(what.encode()), number])


def _draw_views(landscape: Landscape, options: FlightOptions, rng: np.random.Generator) -> tuple[View, ...] | None:
    """Fly along a wandering course; None where it leaves the ground whose roads are known."""
    low, high = landscape.bounds
    n = int(rng.integers(options.n_frames[0], options.n_frames[1] + 1))
    place = rng.uniform(low, high)
    gsd = float(np.exp(rng.uniform(*np.log(options.gsd_m))))
    heading = rng.uniform(0.0, 360.0)
    tilt, towards = rng.uniform(*options.tilt_deg), rng.uniform(0.0, 2.0 * np.pi)
    if not landscape.covers(place[None]):
        return None
    lean = tilt * np.array([np.cos(towards), np.sin(towards)])  # forwards, to the right
    turn, sway, rise = 0.0, np.zeros(2), 0.0
    views: list[View] = []
    for _ in range(n):
        ahead, right = lean + sway
        azimuth = heading + np.degrees(np.arctan2(right, ahead))
        scale = gsd * np.exp(rise)
        leaning = min(float(np.hypot(ahead, right)), options.tilt_deg[1])
        view = make_view((place[0], place[1]), options.size_px, scale, leaning, azimuth, heading)
        if not sees_ground(view) or not landscape.covers(view.footprint):
            return None
        views.append(view)
        step = (1.0 - options.overlap) * options.size_px[1] * scale
        place = place + step * np.array([np.sin(np.radians(heading)), np.cos(np.radians(heading))])
        # Everything sways about where it was: each follows from the last one, and returns.
        turn = 0.7 * turn + rng.normal(0.0, options.turn_deg * 0.7)
        sway = 0.7 * sway + rng.normal(0.0, options.sway_deg * 0.7, 2)
        rise = 0.9 * rise + rng.normal(0.0, 0.01)
        heading += turn
    return tuple(views)


def _motion(views: tuple[View, ...], error_px: float, rng: np.random.Generator) -> FloatArray:
    """Return a measurement of the motion, (K, 3, 3): each corner of a frame is placed with an error."""
    motion = [np.eye(3)]
    for before, view in pairwise(views):
        corners = Frame(*view.size_px).corners
        exact = before.homography.inverse() @ view.homography
        motion.append(_through(corners, exact(corners) + rng.normal(0.0, error_px, (4, 2))).matrix)
    return np.stack(motion)


def _through(source: FloatArray, target: FloatArray) -> Homography:
    """Return the homography that takes four points to four others, (4, 2) each."""
    import cv2

    matrix = cv2.getPerspectiveTransform(source.astype(np.float32), target.astype(np.float32))
    return Homography(np.asarray(matrix, np.float64))
