"""`roadgeo track`: options, one call, printing."""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from roadgeo._options import RESULTS, option, part, take
from roadgeo._text import read_moment
from roadgeo.cli import NOT_LOCATED
from roadgeo.cli.accuracy import tell_accuracy
from roadgeo.cli.options import Known, Shared, Verbosity, argument, command, make_options, open_maps, threaded
from roadgeo.cli.printing import echo, is_set, paint, tell
from roadgeo.running.options import SEGMENTING, ReadOptions
from roadgeo.storage.files import make_folder

if TYPE_CHECKING:
    from roadgeo.flights.frames import FrameOptions
    from roadgeo.flights.rows import Row
    from roadgeo.flights.tracker import Tracked

__all__ = ["track_command"]

#: Heading of the options of flights.
FLIGHT = "The flight"

_HELP = """Follow a flight over the map, frame by frame.

FRAMES overlap, each with the one before: masks or photographs (files, folders or patterns, in order), or a video. One
low frame shows too few roads to be located; so frames are stitched until the map knows them, and from there on
each is followed from the one before:

\b
  located    placed by the search, with those that waited beside it
  tracked    followed from the frame before; the map agrees
  predicted  by its motion alone: hardly a road agrees here
  lost       not known; the search begins anew

\b
What is written to --out-dir:
  flight.gpkg     footprints, centres and the track, styled for QGIS
  flight.geojson  the same for the web, with times
  flight.gpx      the track, for GPS programs
  flight.csv      one row a frame, columns named as in MISB ST 0601
  flight.html     the flight on the map, to play in a browser; needs no network

\b
Examples:
  roadgeo track frames/ --reference boston-ma --motion odometry.csv
  roadgeo track flight.mp4 --every 0.5 --start 2024-05-01T09:30:00Z --out-dir found
  roadgeo track frame_*.png --json > flight.jsonl
  roadgeo track frames/ --focal 640 --mavlink udpout:127.0.0.1:14550
  roadgeo track --unordered strip_1951/*.tif --out-dir found

Exit status: 0 every frame placed, 3 at least one lost, 1 error, 2 usage.
\f

How a frame moved is told by the photographs, or roughly by the masks alone; best is --motion FILE, what your odometry
knows: a CSV with the columns frame (the file's name) and h00 ... h22, row by row, the homography that takes a pixel
(column, row) of the frame to the pixel of the frame before that shows the same ground. The first frame needs none.

Frames of an archive are in no order: with --unordered each pair is registered, by what the pictures show or by the
roads of the masks; what overlaps is solved together, located together, and each frame is placed.

With --focal the place of the camera is computed, too, which is not the ground in the frame's middle. That is what an
autopilot needs; --mavlink sends it as soon as it is known, for PX4 (GLOBAL_POSITION_SENSOR) and ArduPilot
(EXTERNAL_POSITION_ESTIMATE), with its standard deviation and delay; without --focal, the frame's middle. It needs
pymavlink.
"""


# fmt: off
@dataclass(frozen=True, kw_only=True)
class Track:
    """The parameters of `roadgeo track`."""

    frames: tuple[str, ...] = argument("FRAMES...", many=True)
    references: tuple[str, ...] = take(Shared, "references")
    known: Known = part(Known, "near", "within", "gsd_m", "max_tilt_deg")
    focal_px: float | Literal["exif"] | None = take(Known, "focal_px", form="PIXELS",
        help="Focal length in pixels: places are then the camera's.")
    out_dir: str = take(Shared, "out_dir")
    name: str = option("--name", None, RESULTS, "What the results are called. Default: flight.",
        default="flight", rare=True)
    as_json: bool = take(Shared, "as_json", help="Print one JSON object per frame and line, as it is known.")
    mavlink: str | None = take(Shared, "mavlink", group=RESULTS, rare=True)
    motion: str | None = option("--motion", "FILE", FLIGHT, "How each frame moved: see above.", type=click.Path())
    motion_sigma: float | None = option("--motion-sigma", "PX", FLIGHT,
        "How far off the motion may put a corner. Default: 1.5, of masks 12.", limits=(0, None), above=True, rare=True)
    unordered: bool = option("--unordered", "", FLIGHT, "The frames are in no order; all are solved together.")
    every: float = option("--every", "SECONDS", FLIGHT,
        "Take a frame of a video every so often. Default: 1.", limits=(0, None), default=1.0)
    interval: float | None = option("--interval", "SECONDS", FLIGHT,
        "Time between images. Default: as EXIF states it, where all have times, else 1.",
        limits=(0, None), above=True, rare=True)
    aspect: float | None = take(ReadOptions, "aspect", group=FLIGHT,
        help="How many times a pixel is as wide as high. Default: as the file states it, else 1.")
    start: datetime | None = option("--start", "TIME", FLIGHT, "When the first frame was taken.", read=read_moment)
    reading: ReadOptions = part(ReadOptions, *(name for name in SEGMENTING if name != "segmenter"))
    segmenter: str = take(ReadOptions, "segmenter", form="MODEL.onnx", help="Who finds the roads.",
        plugins="", type=click.Path())
    time_limit_s: float = take(Known, "time_limit_s", group=FLIGHT, default=10.0,
        help="Stop each search then. Default: 10.")
    recursive: bool = take(Shared, "recursive", group=FLIGHT, rare=True)
    verbosity: Verbosity = part(Verbosity)
# fmt: on


@command("track", Track, help=_HELP)
def track_command(asked: Track) -> int:
    """Follow a flight over the map, frame by frame; for the help see above."""
    from roadgeo.cli.progress import name_counts
    from roadgeo.flights.frames import follow_frames
    from roadgeo.flights.report import Thumbnails
    from roadgeo.flights.rows import make_rows
    from roadgeo.flights.tracker import TrackOptions

    focal_px = asked.focal_px
    if focal_px == "exif":
        raise click.UsageError("--focal exif: of frames give the focal length in pixels.")
    if asked.unordered and (asked.mavlink or asked.motion):
        raise click.UsageError("--unordered frames are no flight: leave out --mavlink and --motion.")
    hints = replace(asked.known, time_limit_s=asked.time_limit_s)
    options, reading = TrackOptions(locate=make_options(hints)), _frame_options(asked)
    opened: Any = open_maps(asked.references, options.locate.near)
    make_folder(asked.out_dir)
    # Frames are printed as they come; later knowledge of earlier ones replaces their rows.
    states: dict[int, Tracked] = {}
    pictures = Thumbnails()
    with _sender(asked.mavlink) as send:
        for frame, news in follow_frames(asked.frames, reading, opened, options, asked.unordered):
            pictures.add(frame.number, frame.mask)
            states.update({state.frame.number: _without_mask(state) for state in news})
            fresh = make_rows(news, asked.start, focal_px)
            send(fresh[-1])
            for row in fresh:
                _print(row)
    tracked = [states[number] for number in sorted(states)]
    if not tracked:
        raise click.UsageError(f"No frames in {', '.join(asked.frames)}.")
    rows = make_rows(tracked, asked.start, focal_px)
    files = _write(Path(asked.out_dir), asked.name, tracked, rows, pictures)
    counts = Counter(row.status for row in rows)
    tell_accuracy(row.to_dict() for row in rows)
    tell(f"{len(rows)} frames: {name_counts(counts)}; wrote {', '.join(files)}", err=True)
    return NOT_LOCATED if counts["lost"] else 0


@contextmanager
def _sender(url: str | None) -> Iterator[Callable[[Row], None]]:
    """Yield a function that sends the place of the latest frame; its time is when it was read, unless it has a time."""
    if url is None:
        yield lambda _: None
        return
    from roadgeo.flights.mavlink import MavlinkSender, fix_of

    with MavlinkSender(url) as sender:
        read_at = time.time()

        def send(row: Row) -> None:
            nonlocal read_at
            fix = fix_of(row.to_dict(), read_at if row.time is None else row.time.timestamp())
            if fix is not None:
                sender.send(fix)
            read_at = time.time()

        yield send


def _frame_options(asked: Track) -> FrameOptions:
    from roadgeo.flights.frames import FrameOptions
    from roadgeo.flights.motion import read_motion

    gsd_m = asked.known.gsd_m
    return FrameOptions(
        reading=threaded(replace(asked.reading, segmenter=asked.segmenter)),
        gsd_m=None if isinstance(gsd_m, str) else gsd_m,
        motion=None if asked.motion is None else read_motion(asked.motion),
        motion_px=asked.motion_sigma,
        every_s=asked.every,
        interval_s=asked.interval,
        aspect=asked.aspect,
        recursive=asked.recursive,
    )


def _without_mask(tracked: Tracked) -> Tracked:
    """Forget the pixels of a frame: a long flight has many."""
    import numpy as np

    from roadgeo.geometry.mask import RoadMask

    bare = RoadMask(np.zeros((1, 1), np.bool_), name=tracked.frame.name)
    return replace(tracked, frame=replace(tracked.frame, mask=bare))


def _write(folder: Path, name: str, tracked: list[Tracked], rows: list[Row], pictures: Any) -> list[str]:
    from roadgeo.flights.outputs import WRITERS
    from roadgeo.flights.report import render_flight
    from roadgeo.storage.files import write_text

    written = []
    for ending, (write, _) in WRITERS.items():
        path = folder / f"{name}{ending}"
        path.unlink(missing_ok=True)  # a stale result must not be mistaken for this run's
        write(path, rows)
        written += [str(path)] if path.exists() else []
    page = folder / f"{name}.html"
    write_text(page, render_flight(name, tracked, rows, pictures.kept))
    return [*written, str(page)]


_SHOWN = {"located": "green", "tracked": "green", "predicted": "yellow", "lost": "red"}


def _print(row: Row) -> None:
    if is_set("as_json"):
        echo(json.dumps(row.to_dict()))
    else:
        from roadgeo.outputs.wording import format_lonlat

        status = paint(row.status, _SHOWN[row.status])
        where = "" if row.center is None else f" at {format_lonlat(*row.center)}, sigma {row.sigma_m:.1f} m"
        why = f": {row.reason}" if is_set("verbose") or row.status in ("lost", "predicted") else ""
        tell(f"{row.name}: {status}{where}{why}")
