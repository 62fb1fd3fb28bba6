"""Measure `roadgeo verify`: georeferenced masks of cities, half of them moved and turned, and masks of other places.

    python examples/verify/measure.py OUT REF.gpkg... [--count 134] [--seed 3]

Each reference draws `count` masks (clean, segmented and poor in turn; 0.5 to 2 m pixels, any heading, 1000 x 1000) as
GeoTIFFs with a geotransform; every other one is wrong: by 5 to 300 m, up to 5 degrees. A tenth as many
come from another reference's roads and must not be judged. One line of JSON per mask goes to OUT; a second run goes on
where the first one ended. Prints the shares and errors.
"""

import argparse
import json
import math
import tempfile
from pathlib import Path

import numpy as np
import rasterio

from roadgeo.evaluation.noise import NOISE_MODELS
from roadgeo.evaluation.simulation import SimulationOptions, ViewOptions, draw_view, simulate_query
from roadgeo.evaluation.trials import read_landscape
from roadgeo.geometry.homography import Homography
from roadgeo.kernels.warmup import warm_up
from roadgeo.matching.shifts import Shift, move_about
from roadgeo.reference.opening import open_reference
from roadgeo.running.verifying import verify_image

KINDS = ("clean", "segmented", "poor")
VIEW = ViewOptions((1000, 1000), gsd_m=(0.5, 2.0), heading_deg=(0.0, 360.0), intersections=(10, 1_000_000))


def displaced(k: int, seed: int) -> Shift:
    """A shift and a turn for every other mask."""
    rng = np.random.default_rng([seed, k])
    far, way, turn = math.exp(rng.uniform(math.log(5), math.log(300))), rng.uniform(0, 2 * np.pi), rng.uniform(-5, 5)
    return (
        Shift(far * math.sin(way), far * math.cos(way), turn if k % 2 else 0.0, 1.0, 0.0)
        if k % 2
        else Shift(0, 0, 0, 1, 0)
    )


def trial(k: int, seed: int, landscape, elsewhere, reference, folder: Path) -> dict:
    """Draw one mask, write it with its place, and have it verified."""
    kind = KINDS[k // 2 % len(KINDS)]
    query = simulate_query(elsewhere or landscape, SimulationOptions(VIEW, NOISE_MODELS[kind], kind, seed), k)
    truth = query.truth.homography
    if elsewhere is not None:  # put down somewhere on this map
        view = draw_view(landscape, VIEW, np.random.default_rng([seed, k, 1]))
        truth = landscape.plane.to_crs_matrix() @ view.homography.matrix
    center = Homography(truth)(np.array([500.0, 500.0]))
    lie = displaced(k, seed)
    given = move_about(center, lie) @ (truth / truth[2, 2])
    path = folder / "mask.tif"
    profile = {"driver": "GTiff", "width": 1000, "height": 1000, "count": 1, "dtype": "uint8"}
    with rasterio.open(
        path, "w", crs=landscape.plane.crs, transform=rasterio.Affine(*given[:2].ravel()), **profile
    ) as file:
        file.write(np.where(query.mask > 0, 255, 0).astype(np.uint8), 1)
    verified = verify_image(str(path), [reference])
    found = verified.document
    record = {"k": k, "kind": kind, "foreign": elsewhere is not None, "moved": bool(k % 2), **lie.__dict__}
    record |= {name: found.get(name) for name in ("verdict", "reason", "log10_lead", "seconds")}
    record["off_m"] = (found.get("displacement") or {}).get("off_m")
    if verified.corrected is not None:
        record["error_m"] = float(np.hypot(*(Homography(verified.corrected.matrix)(np.array([500.0, 500.0])) - center)))
    return record


def report(records: list[dict]) -> None:
    """Print shares and errors."""
    own = [record for record in records if not record["foreign"]]
    right = [item for item in own if item["verdict"] == ("off" if item["moved"] else "agrees")]
    wrong = [item for item in own if item["verdict"] == ("agrees" if item["moved"] else "off")]
    errors = [result["error_m"] for result in right if result["moved"]]
    print(
        f"{len(right)} of {len(own)} right ({len(right) / len(own):.1%}), {len(wrong)} wrong, "
        f"{len(own) - len(right) - len(wrong)} not judged"
    )
    print(
        f"displacement recovered within {np.median(errors):.2f} m (median), {np.percentile(errors, 95):.2f} m (p95),"
        f" {max(errors):.2f} m (worst)"
    )
    foreign = [record for record in records if record["foreign"]]
    print(
        f"{sum(item['verdict'] == 'unknown' for item in foreign)} of {len(foreign)} masks of other places not judged;"
        f" the highest lead 10^{max((item['log10_lead'] or 0.0 for item in foreign), default=0.0):.1f}"
    )
    print(f"seconds: median {np.median([record['seconds'] for record in records]):.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("references", type=Path, nargs="+")
    parser.add_argument("--count", type=int, default=134)
    parser.add_argument("--seed", type=int, default=3)
    given = parser.parse_args()
    warm_up()
    done = [json.loads(line) for line in given.out.read_text().splitlines()] if given.out.exists() else []
    known = {(item["city"], item["foreign"], item["k"]) for item in done}
    landscapes = [read_landscape(path) for path in given.references]
    with tempfile.TemporaryDirectory() as folder, given.out.open("a") as out:
        opened = [open_reference(path) for path in given.references]
        for k in range(given.count + given.count // 10):  # all places in turn: a part of the run is a sample of all
            for n, path in enumerate(given.references):
                elsewhere = landscapes[n - 1] if k >= given.count else None
                if (path.stem, elsewhere is not None, k) in known:
                    continue
                record = trial(k, given.seed, landscapes[n], elsewhere, opened[n], Path(folder))
                done.append({"city": path.stem, **record})
                out.write(json.dumps(done[-1]) + "\n")
                out.flush()
    report(done)


if __name__ == "__main__":
    main()
