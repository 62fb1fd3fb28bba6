"""Locate masks on more and more maps, and report the cost.

    roadgeo simulate SHARD.gpkg -o masks/SHARD -n 6 --noise clean --noise segmented --tilt 0:20   # of some shards
    python examples/scale/measure.py maps/map_*.shards --masks masks --foreign strangers --out measured

For 1, 3, 10 ... of the maps (--counts) all masks with a `truth.json` beside them are located, and those in --foreign,
which show no place on any map. A line for each goes into measured/quick_001.jsonl and so on as it comes: run it again
to go on. A table is printed, and kept in measured/table_quick.csv. Seconds are processor time of one thread, tracing
of the mask included.
"""

import argparse
import csv
import json
import resource
import time
from collections.abc import Collection
from pathlib import Path

import numpy as np

import roadgeo
from roadgeo.evaluation.truth import read_truth
from roadgeo.geometry.projection import metres_apart, to_lonlat
from roadgeo.kernels.warmup import warm_up
from roadgeo.matching.options import LocateOptions

#: A place is right whose middle lies no further than this from the truth.
RIGHT_M = 50.0


def list_masks(masks: Path, foreign: Path | None) -> dict[str, tuple[float, float] | None]:
    """Return the true longitude and latitude of the middle of each mask, None where it has none."""
    found: dict[str, tuple[float, float] | None] = {}
    for table in sorted(masks.rglob("truth.json")):
        for truth in read_truth(table):
            lon, lat = to_lonlat(str(truth.crs), np.array([truth.center]))[0]
            found[str(table.parent / truth.file)] = (float(lon), float(lat))
    return found | ({} if foreign is None else {str(path): None for path in sorted(foreign.glob("*.png"))})


def locate_all(maps: list[Path], masks: dict[str, tuple[float, float] | None], effort: str, out: Path) -> None:
    """Locate the masks that have no line in `out` yet."""
    done = {json.loads(line)["mask"] for line in out.read_text().splitlines()} if out.is_file() else set()
    if done >= set(masks):
        return
    references, options = [roadgeo.open_reference(path) for path in maps], LocateOptions(effort=effort)
    warm_up()
    started = time.process_time()
    roadgeo.locate(next(iter(masks)), references, options)
    first_s = time.process_time() - started
    with out.open("a") as file:
        for mask, truth in masks.items():
            if mask in done:
                continue
            started = time.process_time()
            found = roadgeo.locate(mask, references, options)
            seconds = time.process_time() - started
            away = None
            if found.status == "located" and found.center is not None and truth is not None:
                away = metres_apart(np.array([found.center.lon, found.center.lat]), np.array(truth))
            memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            reported = {"mask": mask, "has_place": truth is not None, "status": found.status, "away_m": away}
            reported |= {"seconds": seconds, "odds": found.log10_odds, "memory_mb": memory, "first_s": first_s}
            file.write(json.dumps(reported) + "\n")
            file.flush()


def summarise(maps: list[Path], masks: Collection[str], out: Path) -> dict[str, float]:
    """Return a row of the table."""
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    rows = [row for row in rows if row["mask"] in masks]
    manifests = [json.loads((path / "manifest.json").read_text()) for path in maps]
    shards = [item for manifest in manifests for item in manifest["shards"] if item["crs"]]
    located = [row for row in rows if row["status"] == "located"]
    right = [result for result in located if result["away_m"] is not None and result["away_m"] <= RIGHT_M]
    refused = [row["seconds"] for row in rows if not row["has_place"]]
    return {
        "maps": len(maps),
        "intersections": sum(shard["own_intersections"] for shard in shards),
        "shards": len(shards),
        "disk_mb": round(sum(shard["bytes"] for shard in shards) / 1e6),
        "masks": sum(row["has_place"] for row in rows),
        "right": len(right),
        "wrong": len(located) - len(right),
        "median_s": round(float(np.median([result["seconds"] for result in right])), 3),
        "p90_s": round(float(np.quantile([result["seconds"] for result in right], 0.9)), 3),
        "strangers": len(refused),
        "refusal_s": round(float(np.median(refused)), 3) if refused else float("nan"),
        "memory_mb": round(max(row["memory_mb"] for row in rows)),
        "first_s": round(rows[0]["first_s"], 2),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("maps", type=Path, nargs="+")
    parser.add_argument("--masks", type=Path, required=True)
    parser.add_argument("--foreign", type=Path)
    parser.add_argument("--counts", type=int, nargs="+", default=[1, 3, 10])
    parser.add_argument("--every", type=int, default=1, help="take every so manieth of the masks")
    parser.add_argument("--effort", choices=["quick", "full"], default="quick")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    masks = dict(list(list_masks(given.masks, given.foreign).items())[:: given.every])
    table = []
    for n in [n for n in given.counts if n <= len(given.maps)]:
        lines = given.out / f"{given.effort}_{n:03d}.jsonl"
        locate_all(given.maps[:n], masks, given.effort, lines)
        table.append(summarise(given.maps[:n], masks, lines))
        print(table[-1], flush=True)
    with (given.out / f"table_{given.effort}.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(table[0]))
        writer.writeheader()
        writer.writerows(table)


if __name__ == "__main__":
    main()
