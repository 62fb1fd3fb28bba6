"""How well flights are followed: simulated low flights over real cities, their motion known or taken from their masks.

    OMP_NUM_THREADS=1 python examples/flights.py boston.gpkg slc.gpkg liege.gpkg --flights 20 --seed 7

Each flight is followed as `roadgeo track` does it, and then cut: frames of a flight over the next city come instead, as
if nothing had happened. Counted are the frame at which a flight was placed, whether it was placed right, how far
the middle of each frame lies from the truth, processor time of a tracked frame, and after how many frames a cut was
noticed. The flights of a seed are always the same; the defaults of `TrackOptions` were chosen on seed 100.
"""

import argparse
import json
import time
from collections import Counter
from dataclasses import asdict, dataclass, field
from pathlib import Path

import cv2
import numpy as np
from simulated_flights import Flight, FlightOptions, simulate_flight

from roadgeo._arrays import FloatArray
from roadgeo.evaluation.landscape import Landscape
from roadgeo.flights.motion import Odometer
from roadgeo.flights.tracker import FlightFrame, Tracked, Tracker
from roadgeo.geometry.homography import Homography
from roadgeo.geometry.mask import RoadMask
from roadgeo.reference.network_file import read_network
from roadgeo.reference.opening import open_reference
from roadgeo.reference.reference import Reference
from roadgeo.sources.masks import read_mask

#: A fix is wrong where a frame's middle lies further than this from the truth, metres.
WRONG_M = 50.0
CUT_FRAMES = 6


@dataclass
class Result:
    """The outcome of one flight."""

    city: str
    number: int
    frames: int
    fixed_at: int | None = None
    wrong: bool = False
    errors_m: list[float] = field(default_factory=list)
    sigmas_m: list[float] = field(default_factory=list)
    statuses: dict[str, int] = field(default_factory=dict)
    tracking_ms: list[float] = field(default_factory=list)
    search_s: float = 0.0
    cut_noticed_after: int | None = None
    cut_claimed: int = 0
    motion_errors_px: list[float | None] = field(default_factory=list)


def masks_of(flight: Flight) -> list[RoadMask]:
    return [read_mask(mask, voids=False, name=f"frame {k}") for k, mask in enumerate(flight.masks())]


def fly(flight: Flight, other: Flight, reference: Reference, city: str, own_motion: bool) -> Result:
    result = Result(city, flight.number, len(flight.views))
    tracker, odometer, known = Tracker([reference]), Odometer(), dict[int, Tracked]()
    masks = masks_of(flight)
    for k, mask in enumerate(masks):
        motion, motion_px = (flight.motion[k], 1.5) if k else (None, 1.5)
        if own_motion and k:
            motion, motion_px = odometer.move(masks[k - 1], mask)
            result.motion_errors_px.append(motion_error(flight, k, motion))
        frame = FlightFrame(k, mask.name, float(k), mask, motion, motion_px)
        was_lost, started = tracker.is_lost, time.process_time()
        known.update({first.frame.number: first for first in tracker.feed(frame)})
        spent = time.process_time() - started
        if was_lost:
            result.search_s += spent
        else:
            result.tracking_ms.append(1000.0 * spent)
    for k, item in known.items():
        if item.pose is not None:
            truth = flight.views[k].homography(np.array(flight.options.size_px) / 2)
            result.errors_m.append(float(np.hypot(*(item.pose.center - truth))))
            result.sigmas_m.append(item.pose.sigma_m)
    result.statuses = dict(Counter(entry.status for entry in known.values()))
    result.fixed_at = tracker.fixes[0].last + 1 if tracker.fixes else None
    result.wrong = any(error > WRONG_M for error in result.errors_m)
    if not tracker.is_lost:
        cut(tracker, flight, other, result)
    return result


def motion_error(flight: Flight, k: int, motion: FloatArray | None) -> float | None:
    """How far the middle of a frame is put from where the frame before shows it, pixels; None: nowhere."""
    if motion is None:
        return None
    middle = np.array(flight.options.size_px) / 2
    truth = flight.views[k - 1].homography.inverse()(flight.views[k].homography(middle))
    return float(np.hypot(*(Homography(motion)(middle) - truth)))


def cut(tracker: Tracker, flight: Flight, other: Flight, result: Result) -> None:
    """Go on with frames from elsewhere, and motion as if the flight went on."""
    for k, mask in enumerate(masks_of(other)[:CUT_FRAMES]):
        frame = FlightFrame(len(flight.views) + k, mask.name, 0.0, mask, flight.motion[1 + k])
        news = tracker.feed(frame)
        if any(new.status == "lost" for new in news):
            result.cut_noticed_after = k + 1
            return
        result.cut_claimed += news[-1].status == "tracked"


def summarize_motion(results: list[Result]) -> dict[str, float]:
    """How good the motion of masks is."""
    values = [error for result in results for error in result.motion_errors_px]
    known = np.array([error for error in values if error is not None])
    return {
        "motion known": len(known) / len(values),
        "motion error px, median": float(np.median(known)),
        "motion error px, p95": float(np.quantile(known, 0.95)),
        "motion off by more than 50 px": float(np.mean(known > 50.0)),
    }


def summarize(results: list[Result]) -> dict[str, float]:
    errors = np.concatenate([result.errors_m for result in results] or [np.zeros(0)])
    sigmas = np.concatenate([result.sigmas_m for result in results])
    tracking = np.concatenate([result.tracking_ms for result in results])
    cuts = [result.cut_noticed_after for result in results if result.fixed_at]
    return {
        "flights": len(results),
        "frames": sum(result.frames for result in results),
        "fixed within 12 frames": float(
            np.mean([result.fixed_at is not None and result.fixed_at <= 12 for result in results])
        ),
        "fixed": float(np.mean([result.fixed_at is not None for result in results])),
        "wrong flights": sum(result.wrong for result in results),
        "frames placed": len(errors) / sum(result.frames for result in results),
        "error m, median": float(np.median(errors)),
        "error m, p95": float(np.quantile(errors, 0.95)),
        "error m, max": float(errors.max()),
        "error / sigma, rms": float(np.sqrt(np.mean((errors / sigmas) ** 2))),
        "tracking ms, mean": float(tracking.mean()),
        "tracking ms, p99": float(np.quantile(tracking, 0.99)),
        "cuts noticed within 3 frames": float(np.mean([n is not None and n <= 3 for n in cuts])),
        "search s, median": float(np.median([result.search_s for result in results])),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("references", nargs="+", help="REF.gpkg of each city")
    parser.add_argument("--flights", type=int, default=20, help="per city")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--motion", choices=["given", "masks"], default="given")
    parser.add_argument("--out", type=Path, help="write a JSON line for each flight")
    given = parser.parse_args()
    cv2.setNumThreads(1)
    options = FlightOptions(seed=given.seed)
    landscapes = [Landscape.from_network(read_network(Path(path))) for path in given.references]
    references = [open_reference(path) for path in given.references]
    results = []
    for k in range(given.flights):
        flights = [simulate_flight(landscape, options, k) for landscape in landscapes]
        for c, flight in enumerate(flights):
            other = flights[(c + 1) % len(flights)]
            results.append(fly(flight, other, references[c], references[c].name, given.motion == "masks"))
            first = results[-1]
            reported = f"{first.city} {k}: fixed at {first.fixed_at} of {first.frames}, {first.statuses}"
            largest = max(first.errors_m, default=0.0)
            print(f"{reported}, largest error {largest:.1f} m, cut noticed after {first.cut_noticed_after}", flush=True)
            if given.out:
                with given.out.open("a") as file:
                    file.write(json.dumps(asdict(first)) + "\n")
    reported = summarize(results) | (summarize_motion(results) if given.motion == "masks" else {})
    for name, value in reported.items():
        print(f"{name:32} {value:.3g}")


if __name__ == "__main__":
    main()
