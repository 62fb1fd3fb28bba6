"""Locate one mask after another in one process, and watch what must not grow.

    python tests/support/endurance.py [--count 10000]

Masks are read from files, some of them of another town, some damaged; the reference is opened anew now and then. Prints
one JSON object: resident memory (MB), median processor time of a locate (ms) and open files in each tenth of the run.
"""

import argparse
import json
import resource
import statistics
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import shapely
import shapely.affinity

sys.path.insert(0, str(Path(__file__).parents[1]))

from worlds.scenes import random_lines, random_network

from roadgeo.errors import MaskError
from roadgeo.matching.index import build_index
from roadgeo.matching.options import LocateOptions
from roadgeo.reference.opening import open_reference
from roadgeo.reference.reference import Reference
from roadgeo.workflows import locate

SIDE = 300


def resident_mb() -> float:
    """Memory now; where the system does not tell, the most there has been."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 1e6
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def draw_masks(folder: Path, count: int) -> list[Path]:
    """Draw views of the town and of another one, and leave some of the files damaged."""
    rng = np.random.default_rng(0)
    towns = [shapely.MultiLineString(random_lines(seed, 1000.0, 60.0)) for seed in (1, 2)]
    paths = []
    for k in range(count):
        x, y = rng.uniform(250, 750, 2)
        seen = shapely.affinity.rotate(towns[k % 5 == 3], rng.uniform(0, 360), origin=(x, y))
        mask = np.zeros((SIDE, SIDE), np.uint8)
        for line in seen.geoms:
            at = (np.array(line.coords) - (x, y)) * (1, -1) + SIDE / 2
            cv2.polylines(mask, [np.rint(at).astype(np.int32)], False, 255, 6)
        content = cv2.imencode(".png", mask)[1].tobytes()
        paths.append(folder / f"{k}.png")
        paths[-1].write_bytes(content[: len(content) // 2] if k % 10 == 7 else content)
    return paths


def main(count: int, effort: str = "quick") -> dict[str, Any]:
    """Locate `count` masks, and tell what each tenth of them took."""
    folder = Path(tempfile.mkdtemp(prefix="roadgeo-endurance-"))
    network = random_network(1, 1000.0, 60.0)
    Reference(build_index(network), network).save(folder / "town.gpkg")
    masks = draw_masks(folder, 50)
    options = LocateOptions(effort=effort)
    became: Counter[str] = Counter()
    reported: dict[str, list[float]] = {"resident_mb": [], "median_ms": [], "open_files": []}
    for tenth in range(10):
        spent = []
        for k in range(tenth * count // 10, (tenth + 1) * count // 10):
            if k % 50 == 0:
                reference = open_reference(folder / "town.gpkg")
            started = time.process_time()
            try:
                became[locate(masks[k % len(masks)], reference, options).status] += 1
            except MaskError:
                became["damaged"] += 1
            spent.append(time.process_time() - started)
        reported["resident_mb"].append(round(resident_mb(), 1))
        reported["median_ms"].append(round(1000 * statistics.median(spent), 2))
        reported["open_files"].append(sum(1 for _ in Path("/dev/fd").iterdir()))
        print(tenth + 1, {name: values[-1] for name, values in reported.items()}, file=sys.stderr)
    return {"locates": count, **reported, "became": dict(became)}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=10_000)
    print(json.dumps(main(parser.parse_args().count)))
