"""Measure `roadgeo verify`: masks of cities whose place is known, put down where they belong, and beside it.

    python examples/verify/measure.py OUT.csv REF.gpkg... [--count 40] [--seed 3] [--off 0 30 100 500 1500]

Each reference draws `count` masks (clean, segmented and poor in turn; frames of 512 m, pixels of 0.5 m, any heading) as
GeoTIFFs with a geotransform. Each is put down at each distance in metres, in any direction, and turned by up to 3
degrees where that is not 0. Beyond `--reach` (350 m) nothing can be said but "unknown". A further tenth of the masks
comes from the next reference's roads and has no place on the map at all. One row per trial goes to OUT.csv; a second
run goes on where the first one ended. Prints how many were right, wrong and not judged at each distance.
"""

import argparse
import csv
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
import rasterio

from roadgeo.evaluation.landscape import Landscape
from roadgeo.evaluation.noise import NOISE_MODELS
from roadgeo.evaluation.simulation import SimulationOptions, ViewOptions, draw_view, simulate_query
from roadgeo.evaluation.trials import read_landscape
from roadgeo.geometry.homography import Homography
from roadgeo.kernels.warmup import warm_up
from roadgeo.matching.shifts import Shift, move_about
from roadgeo.reference.opening import open_reference
from roadgeo.reference.reference import Reference
from roadgeo.running.verifying import verify_image

KINDS = ("clean", "segmented", "poor")
SIDE_PX = 1024
VIEW = ViewOptions((SIDE_PX, SIDE_PX), gsd_m=(0.5, 0.5), heading_deg=(0.0, 360.0), intersections=(10, 1_000_000))
MIDDLE = np.array([SIDE_PX, SIDE_PX]) / 2.0
#: A correction is wrong if it puts the middle of the frame farther from the truth than this, metres.
WRONG_M = 10.0


@dataclass(frozen=True)
class Trial:
    """A mask, and its verdict; `off_m` -1: it is from elsewhere."""

    city: str
    k: int
    kind: str
    off_m: float
    verdict: str = ""
    log10_lead: float | None = None
    error_m: float | None = None
    cpu_s: float = 0.0
    reason: str = ""

    @property
    def known_by(self) -> tuple[str, int, float]:
        return self.city, self.k, self.off_m

    @property
    def outcome(self) -> str:
        """Right, wrong, or unknown: not judged."""
        if self.verdict == "unknown":
            return "unknown"
        if self.verdict == "agrees":
            return "right" if self.off_m == 0.0 else "wrong"
        return "right" if self.off_m > 0.0 and self.error_m is not None and self.error_m < WRONG_M else "wrong"


def trials(landscapes: dict[str, Landscape], count: int, distances: Sequence[float]) -> Iterator[Trial]:
    """Yield the trials of all cities in turn, so that a part of the run is a sample of all."""
    for k in range(count + count // 10):
        for city in landscapes:
            for off_m in distances if k < count else [-1.0]:
                yield Trial(city, k, KINDS[k % len(KINDS)], off_m)


def place(trial: Trial, landscapes: dict[str, Landscape], seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw the mask; return it, where it is put down, and where it belongs, both (3, 3), pixel to the plane's CRS."""
    names = list(landscapes)
    own, rng = landscapes[trial.city], np.random.default_rng([seed, trial.k, int(trial.off_m) + 1])
    elsewhere = landscapes[names[names.index(trial.city) - 1]] if trial.off_m < 0.0 else own
    options = SimulationOptions(VIEW, NOISE_MODELS[trial.kind], trial.kind, seed)
    query = simulate_query(elsewhere, options, trial.k)
    truth = query.truth.homography
    if trial.off_m < 0.0:
        truth = own.plane.to_crs_matrix() @ draw_view(own, VIEW, rng).homography.matrix
    truth = truth / truth[2, 2]
    way, turn = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(-3.0, 3.0) if trial.off_m > 0.0 else 0.0
    far = max(trial.off_m, 0.0)
    shift = Shift(far * np.sin(way), far * np.cos(way), turn, 1.0, 0.0)
    return query.mask, move_about(Homography(truth)(MIDDLE), shift) @ truth, truth


def verify(trial: Trial, landscapes: dict[str, Landscape], reference: Reference, folder: Path, seed: int) -> Trial:
    """Write a mask with its place, and have it verified."""
    mask, given, truth = place(trial, landscapes, seed)
    path, crs = folder / "mask.tif", landscapes[trial.city].plane.crs
    profile = {"driver": "GTiff", "width": SIDE_PX, "height": SIDE_PX, "count": 1, "dtype": "uint8"}
    with rasterio.open(path, "w", crs=crs, transform=rasterio.Affine(*given[:2].ravel()), **profile) as file:
        file.write(np.where(mask > 0, 255, 0).astype(np.uint8), 1)
    started = time.process_time()
    verified = verify_image(str(path), [reference])
    told = {name: verified.document.get(name) for name in ("verdict", "reason", "log10_lead")}
    told["cpu_s"] = round(time.process_time() - started, 3)
    if verified.corrected is not None:
        told["error_m"] = float(np.hypot(*(Homography(verified.corrected.matrix)(MIDDLE) - Homography(truth)(MIDDLE))))
    return Trial(**{**asdict(trial), **told})


def report(done: Sequence[Trial]) -> None:
    """Print a line for each distance."""
    for off_m in sorted({trial.off_m for trial in done}):
        here = [trial for trial in done if trial.off_m == off_m]
        count = Counter(trial.outcome for trial in here)
        errors = [trial.error_m for trial in here if trial.error_m is not None and trial.outcome == "right"]
        error = f", within {np.median(errors):.2f} m (median), {max(errors):.2f} m (worst)" if errors else ""
        where = "elsewhere" if off_m < 0.0 else f"{off_m:g} m off"
        print(
            f"{where:>10}: n {len(here)}, right {count['right']}, wrong {count['wrong']}, unknown {count['unknown']}"
            f"{error}; CPU seconds {np.median([trial.cpu_s for trial in here]):.2f} (median)"
        )


def read_trials(path: Path) -> list[Trial]:
    """Read the rows of an earlier run."""
    if not path.exists():
        return []
    numbers = {field.name for field in fields(Trial)} - {"city", "kind", "verdict", "reason"}
    with path.open(newline="") as file:
        rows = [
            {k: (float(v) if v else None) if k in numbers else v for k, v in row.items()}
            for row in csv.DictReader(file)
        ]
    return [Trial(**{**row, "k": int(row["k"])}) for row in rows]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("references", type=Path, nargs="+")
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--off", type=float, nargs="+", default=[0.0, 30.0, 100.0, 500.0, 1500.0], metavar="METRES")
    given = parser.parse_args()
    warm_up()
    landscapes = {path.stem: read_landscape(path) for path in given.references}
    opened = {path.stem: open_reference(path) for path in given.references}
    done = read_trials(given.out)
    known = {trial.known_by for trial in done}
    with tempfile.TemporaryDirectory() as folder, given.out.open("a", newline="") as out:
        writer = csv.DictWriter(out, [field.name for field in fields(Trial)])
        if not done:
            writer.writeheader()
        for trial in trials(landscapes, given.count, given.off):
            if trial.known_by not in known:
                done.append(verify(trial, landscapes, opened[trial.city], Path(folder), given.seed))
                writer.writerow(asdict(done[-1]))
                out.flush()
    report(done)


if __name__ == "__main__":
    main()
