"""Measure the camera's pose: simulated views of a map by a known camera, located blind.

    python examples/pose/measure.py REF.gpkg [--count 60] [--seed 5] [--noise segmented] [--out POSES.jsonl]

Views are tilted by 5 to 45 degrees, of any heading, 0.5 to 1 m per pixel, 1200 x 1200, with a focal length of 1200
pixels. Prints the errors with the focal length given and unknown, and how they compare with the claims.
"""

import argparse
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from roadgeo.evaluation.noise import NOISE_MODELS
from roadgeo.evaluation.simulation import SimulationOptions, ViewOptions, simulate_query
from roadgeo.evaluation.trials import read_landscape
from roadgeo.geometry.mask import RoadMask
from roadgeo.geometry.pose import Pose, find_pose
from roadgeo.kernels.warmup import warm_up
from roadgeo.matching.options import LocateOptions
from roadgeo.reference.opening import open_reference
from roadgeo.roads.observed import find_voids
from roadgeo.workflows import locate

FOCAL, SIDE = 1200.0, 1200
VIEW = ViewOptions((SIDE, SIDE), None, (0.5, 1.0), (5.0, 45.0), (0.0, 360.0), FOCAL, (20, 1_000_000))


def true_pose(truth) -> Pose:
    """The exact pose, from the exact homography."""
    found = find_pose(truth.homography, (SIDE, SIDE), 1e-6 * np.eye(8), FOCAL)
    assert found is not None
    return found


def compare(found: Pose, truth: Pose) -> dict[str, float]:
    """Errors, in the units of the targets, and their squares in units of the claimed covariance."""
    angles = (found.angles_deg - truth.angles_deg + 180.0) % 360.0 - 180.0
    away = np.append(found.position - truth.position, angles)
    height = truth.position[2]
    return {
        "height": abs(away[2]) / height,
        "position": math.hypot(away[0], away[1]) / height,
        "angle_deg": float(np.abs(angles).max()),
        "chi2": float(away @ np.linalg.solve(found.covariance, away)) / 6.0,
        "focal": abs(found.focal_px / FOCAL - 1.0),
        "told": found.source == "homography",
        "tilt_deg": truth.tilt_deg,
    }


def report(name: str, rows: list[dict[str, float]]) -> None:
    """Print medians, the 90th percentile and the normalised error."""
    parts = []
    for key, unit, factor in (("height", "% of height", 100), ("position", "% of height", 100), ("angle_deg", "deg", 1),
                              ("focal", "%", 100)):  # fmt: skip
        values = [factor * row[key] for row in rows]
        parts.append(f"{key} {np.median(values):.2f} {unit} (p90 {np.percentile(values, 90):.2f})")
    normalised = math.sqrt(float(np.mean([row["chi2"] for row in rows])))
    typical = math.sqrt(float(np.median([row["chi2"] for row in rows])) / 0.891)  # the median of chi-square(6) / 6
    print(
        f"{name}, n = {len(rows)}: {', '.join(parts)}; normalised error {normalised:.2f}, by the median {typical:.2f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("reference", type=Path)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--noise", default="segmented", choices=list(NOISE_MODELS))
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    warm_up()
    landscape, reference = read_landscape(given.reference), open_reference(given.reference)
    options, usual = SimulationOptions(VIEW, NOISE_MODELS[given.noise], given.noise, given.seed), LocateOptions()
    camera = replace(usual.match.camera, focal_px=FOCAL)
    known = replace(usual, effort="quick", match=replace(usual.match, camera=camera))
    given_focal, unknown, lost = [], [], 0
    for k in range(given.count):
        query = simulate_query(landscape, options, k)
        roads = query.mask > 0
        location = locate(RoadMask(roads, find_voids(roads, 8.0)), reference, known)
        if not location.located or location.homography is None or location.corner_covariance_m2 is None:
            lost += 1
            continue
        truth = true_pose(query.truth)
        for rows, lens in ((given_focal, FOCAL), (unknown, None)):
            found = find_pose(location.homography, (SIDE, SIDE), location.corner_covariance_m2, lens)
            if found is not None:
                rows.append(compare(found, truth))
                if given.out:
                    with given.out.open("a") as file:
                        file.write(json.dumps({"k": k, "given": rows is given_focal, **rows[-1]}) + "\n")
    print(f"{given.count - lost} of {given.count} located")
    report("focal length given", given_focal)
    report("unknown, tilt >= 20", [row for row in unknown if row["tilt_deg"] >= 20.0])
    report("unknown, tilt < 20", [row for row in unknown if row["tilt_deg"] < 20.0])


if __name__ == "__main__":
    main()
