"""How flights are followed whose link fails: simulated ones over real cities, their motion taken from their masks.

    OMP_NUM_THREADS=1 python examples/faulty_flights.py OUT.csv porto.gpkg liege.gpkg [--flights 3] [--seed 7]

In each flight a frame is repeated, frames are missing, or the aircraft is displaced, for 3 to 7 frames; then the flight
goes on. Counted are frames that lie farther from the truth than five standard deviations, the stage that first put
one there, and flights whose last frames are placed rightly again. A row of each flight goes to OUT.csv.
"""

import argparse
import csv
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from itertools import pairwise, product
from pathlib import Path

import cv2
import numpy as np
from flights import masks_of, motion_error
from simulated_flights import Flight, FlightOptions, simulate_flight, with_fault

from roadgeo.evaluation.landscape import Landscape
from roadgeo.flights.motion import Odometer
from roadgeo.flights.tracker import FlightFrame, Tracked, Tracker
from roadgeo.reference.network_file import read_network
from roadgeo.reference.opening import open_reference
from roadgeo.reference.reference import Reference

FAULTS = ("frozen", "missing", "slipped")
#: As a video shows it: a frame moves by a fourteenth of its height.
VIEWS = FlightOptions(
    size_px=(500, 400),
    n_frames=(24, 24),
    overlap=0.93,
    gsd_m=(0.9, 1.3),
    turn_deg=0.5,
    sway_deg=0.2,
    intersections=(4, 60),
)
#: Frames are wrong beyond this number of standard deviations; a motion is, beyond this number of pixels.
WRONG_SIGMAS, WRONG_PX = 5.0, 50.0
#: Frames at the end of a flight, and the distance, metres, within which half of them are found again.
LAST, RIGHT_M = 6, 50.0


@dataclass(frozen=True)
class Result:
    """The outcome of one flight; `stage` where it first went wrong, or ""."""

    city: str
    number: int
    fault: str
    at: int
    length: int
    frames: int
    placed: int
    wrong: int
    worst_m: float
    worst_sigma_m: float
    stage: str
    found_again: bool


def draw(landscape: Landscape, options: FlightOptions, number: int, fault: str) -> tuple[Flight, int, int]:
    """Draw a flight with a fault; return it, the frame at which it fails, and for how many frames."""
    rng = np.random.default_rng([options.seed, number, FAULTS.index(fault)])
    for k in range(number, number + 100_000, 1000):
        flight, at, length = simulate_flight(landscape, options, k), int(rng.integers(6, 12)), int(rng.integers(3, 8))
        faulty = with_fault(flight, fault, at, length)
        if all(landscape.covers(view.footprint) for view in faulty.views):
            return faulty, at, length
    raise ValueError("the map has no room for such a flight")


def fly(flight: Flight, reference: Reference) -> tuple[list[Tracked], list[float | None]]:
    """Follow a flight; return the last state of each frame, and by how many pixels its motion is wrong."""
    tracker, odometer, known = Tracker([reference]), Odometer(), dict[int, Tracked]()
    masks, motion_px = masks_of(flight), list[float | None]([0.0])
    known.update((news.frame.number, news) for news in tracker.feed(FlightFrame(0, "0", 0.0, masks[0])))
    for k, (before, mask) in enumerate(pairwise(masks), 1):
        motion, error_px = odometer.move(before, mask)
        motion_px.append(motion_error(flight, k, motion))
        news = tracker.feed(FlightFrame(k, str(k), float(k), mask, motion, error_px))
        known.update((state.frame.number, state) for state in news)
    return [known[k] for k in sorted(known)], motion_px


def judge(
    flight: Flight, tracked: Sequence[Tracked], motion_px: Sequence[float | None]
) -> Iterator[tuple[str, float, float]]:
    """Yield of each frame what was wrong first ("" for nothing), the error and the standard deviation, metres."""
    for view, state, px in zip(flight.views, tracked, motion_px, strict=True):
        if state.pose is None:
            yield "", np.nan, np.nan
            continue
        error = float(np.hypot(*(state.pose.center - view.homography(np.array(view.size_px) / 2.0))))
        sigma = state.pose.sigma_m
        stage = f"{'motion' if px is None or px > WRONG_PX else 'roads'}, {state.status}"
        yield stage if error > WRONG_SIGMAS * sigma else "", error, sigma


def measure(path: Path, landscape: Landscape, options: FlightOptions, number: int, fault: str) -> Result:
    """Draw a flight with a fault, follow it, and describe what came of it."""
    flight, at, length = draw(landscape, options, number, fault)
    tracked, motion_px = fly(flight, open_reference(path))
    frames = list(judge(flight, tracked, motion_px))
    wrong = [frame for frame in frames if frame[0]]
    stage, _, _ = wrong[0] if wrong else ("", 0.0, 0.0)
    _, worst_m, sigma_m = max(wrong, key=lambda frame: frame[1], default=("", 0.0, 0.0))
    placed = sum(np.isfinite(error) for _, error, _ in frames)
    found_again = sum(not stage and error < RIGHT_M for stage, error, _ in frames[-LAST:]) >= LAST / 2
    return Result(
        path.stem, number, fault, at, length, len(frames), placed,
        len(wrong), round(worst_m, 1), round(sigma_m, 2), stage, found_again,
    )  # fmt: skip


def summarize(results: Sequence[Result]) -> None:
    """Print a line for each fault, and for all."""
    for fault in (*FAULTS, "all"):
        here = [result for result in results if fault in (result.fault, "all")]
        stages = dict(Counter(result.stage for result in here if result.stage))
        print(
            f"{fault:8} {len(here)} flights: {sum(result.wrong > 0 for result in here)} with wrong frames"
            f" ({sum(result.wrong for result in here)}; the first by {stages}),"
            f" {sum(result.found_again for result in here)} found again"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("references", nargs="+", type=Path, help="REF.gpkg of each city")
    parser.add_argument("--flights", type=int, default=3, help="per city and fault")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    cv2.setNumThreads(1)
    options, results = replace(VIEWS, seed=given.seed), []
    landscapes = {path: Landscape.from_network(read_network(path)) for path in given.references}
    with given.out.open("w", newline="") as out:
        writer = csv.DictWriter(out, [field.name for field in fields(Result)])
        writer.writeheader()
        for number, (path, landscape), fault in product(range(given.flights), landscapes.items(), FAULTS):
            results.append(measure(path, landscape, options, number, fault))
            writer.writerow(asdict(results[-1]))
            out.flush()
            print(*asdict(results[-1]).values(), flush=True)
    summarize(results)


if __name__ == "__main__":
    main()
