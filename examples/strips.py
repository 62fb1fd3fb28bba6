"""How well strips of an archive are placed: simulated frames that overlap by 60 %, shuffled.

    OMP_NUM_THREADS=1 python examples/strips.py boston.gpkg slc.gpkg liege.gpkg --strips 5 --seed 7

Counted are strips of which all frames were placed, frames placed, and how far their middles lie from the truth.
"""

import argparse
import time
from pathlib import Path

import cv2
import numpy as np
from simulated_flights import FlightOptions, simulate_flight

from roadgeo.evaluation.landscape import Landscape
from roadgeo.flights.strips import place_strips
from roadgeo.flights.tracker import FlightFrame
from roadgeo.reference.network_file import read_network
from roadgeo.reference.opening import open_reference
from roadgeo.sources.masks import read_mask


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("references", nargs="+", help="REF.gpkg of each city")
    parser.add_argument("--strips", type=int, default=5, help="per city")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    cv2.setNumThreads(1)
    options = FlightOptions(
        (700, 700), (6, 12), gsd_m=(0.8, 1.2), tilt_deg=(0.0, 4.0), intersections=(5, 200), seed=given.seed
    )
    errors, n_frames, whole = list[float](), 0, list[bool]()
    for path in given.references:
        landscape, reference = Landscape.from_network(read_network(Path(path))), open_reference(path)
        for k in range(given.strips):
            flight = simulate_flight(landscape, options, k)
            masks = [read_mask(mask, voids=False, name=str(n)) for n, mask in enumerate(flight.masks())]
            order = np.random.default_rng([given.seed, k]).permutation(len(masks))
            started = time.process_time()
            tracked = place_strips(
                [(FlightFrame(n, str(i), float(n), masks[i]), None) for n, i in enumerate(order)], [reference]
            )
            spent = time.process_time() - started
            placed = [sighting for sighting in tracked if sighting.pose is not None]
            off = []
            for item in placed:
                truth = flight.views[int(item.frame.name)].homography(item.frame.frame.center)
                off.append(float(np.hypot(*(item.pose.center - truth))))
            errors += off
            n_frames += len(masks)
            whole.append(len(placed) == len(masks))
            reported = f"{reference.name} {k}: {len(placed)} of {len(masks)} placed, in {spent:.1f} s CPU"
            print(f"{reported}, largest error {max(off, default=0.0):.1f} m", flush=True)
    print(f"{sum(whole)} of {len(whole)} strips whole, {len(errors)} of {n_frames} frames placed")
    print(f"error m: median {np.median(errors):.2f}, p95 {np.quantile(errors, 0.95):.2f}, max {max(errors):.1f}")
    print(f"frames more than 20 m off: {sum(error > 20.0 for error in errors)}")


if __name__ == "__main__":
    main()
